//! `RealityCapture`'s and `RealityScan`'s "internal/external camera parameters", a CSV table.
//!
//! One row per photograph: its name, the position, `heading`, `pitch` and `roll` in degrees, the focal length `f` as
//! for a picture 36 mm wide, the principal point `px`, `py` from the picture's centre, radial terms `k1..k4` and
//! tangential ones `t1`, `t2` (`OpenCV`'s p1, p2). Lengths within the picture count in its longer side; the table holds
//! no sizes, they come from the photographs. At zero angles a camera looks down with its top to the north:
//! `world_from_camera = Rz(-heading) Rx(pitch) Ry(roll)` with camera axes x right, y up, z backwards.
//! Source: Epic's `RealityCapture` knowledge base, "XMP camera math"; `RealityCapture` help, "Registration export".

use csv::{ReaderBuilder, StringRecord, Trim};
use glam::{DMat3, DVec3};

use super::photo_index::PhotoIndex;
use super::pose::{self, FLIP_Y_AND_Z};
use super::{Model, ModelImage, json};
use crate::distortion::{Brown, SourceCamera};
use crate::fault::Faults;

const EXPORT_HINT: &str =
    "export the registration again as \"Internal/External camera parameters\"";

/// Width in millimetres of the film that focal lengths are given for.
const FILM_WIDTH: f64 = 36.0;

/// Where the columns stand.
struct Columns {
    name: usize,
    /// x, y, alt, heading, pitch, roll, f.
    needed: [usize; 7],
    /// px, py, k1..k4, t1, t2; zero where the table has none.
    further: [Option<usize>; 8],
}

const NEEDED: [&str; 7] = ["x", "y", "alt", "heading", "pitch", "roll", "f"];
const FURTHER: [&str; 8] = ["px", "py", "k1", "k2", "k3", "k4", "t1", "t2"];

impl Columns {
    fn of(names: &StringRecord) -> Result<Self, String> {
        let find = |wanted: &str| {
            names
                .iter()
                .position(|name| name.eq_ignore_ascii_case(wanted))
        };
        let missing: Vec<&str> = NEEDED
            .into_iter()
            .filter(|wanted| find(wanted).is_none())
            .collect();
        if !missing.is_empty() {
            return Err(format!("the table has no column {}", missing.join(", ")));
        }
        Ok(Self {
            name: find("#name").ok_or("the table has no column #name")?,
            needed: NEEDED.map(|wanted| find(wanted).unwrap_or_default()),
            further: FURTHER.map(find),
        })
    }
}

pub(super) fn parse(
    bytes: &[u8],
    shown: &str,
    photographs: &PhotoIndex,
    faults: &mut Faults,
) -> Model {
    let mut model = Model::default();
    let errors_before = faults.error_count();
    let text = json::without_mark(bytes);
    // Other comments may stand before the line with the columns' names, which begins like one.
    let mut skipped_lines = 0;
    let mut table = text;
    while let Some(end) = table.iter().position(|&byte| byte == b'\n') {
        let starts = table
            .get(..5)
            .is_some_and(|start| start.eq_ignore_ascii_case(b"#name"));
        if starts {
            break;
        }
        table = &table[end + 1..];
        skipped_lines += 1;
    }
    let mut reader = ReaderBuilder::new()
        .flexible(true)
        .trim(Trim::All)
        .from_reader(table);
    let columns = match reader
        .headers()
        .map_err(|error| error.to_string())
        .and_then(Columns::of)
    {
        Ok(columns) => columns,
        Err(message) => {
            faults.error(
                message,
                format!("{shown}:{}", skipped_lines + 1),
                EXPORT_HINT,
            );
            return model;
        }
    };
    let mut row = StringRecord::new();
    loop {
        let at = |line: u64| format!("{shown}:{}", skipped_lines + line);
        match reader.read_record(&mut row) {
            Ok(false) => break,
            Ok(true) => {
                let at = at(row.position().map_or(0, csv::Position::line));
                if let Err(message) = camera(&row, &columns, &at, photographs, &mut model, faults) {
                    faults.error(message, at, EXPORT_HINT);
                }
            }
            Err(error) => {
                let line = error.position().map_or(0, csv::Position::line);
                faults.error("the row is no UTF-8 text", at(line), EXPORT_HINT);
            }
        }
    }
    if model.images.is_empty() && faults.error_count() == errors_before {
        faults.error("the table has no cameras", shown, EXPORT_HINT);
    }
    model.has_all_images = faults.error_count() == errors_before;
    model
}

fn camera(
    row: &StringRecord,
    columns: &Columns,
    at: &str,
    photographs: &PhotoIndex,
    model: &mut Model,
    faults: &mut Faults,
) -> Result<(), String> {
    let number = |column: usize, what: &str| {
        let text = row
            .get(column)
            .ok_or_else(|| format!("the row ends before {what}"))?;
        text.parse::<f64>()
            .ok()
            .filter(|value| value.is_finite())
            .ok_or_else(|| format!("{what} is no finite number: {text:?}"))
    };
    let name = photographs.name_of(row.get(columns.name).unwrap_or_default())?;
    let mut needed = [0.0; 7];
    for ((value, column), what) in needed.iter_mut().zip(columns.needed).zip(NEEDED) {
        *value = number(column, what)?;
    }
    let mut further = [0.0; 8];
    for ((value, column), what) in further.iter_mut().zip(columns.further).zip(FURTHER) {
        if let Some(column) = column {
            *value = number(column, what)?;
        }
    }
    let [x, y, alt, heading, pitch, roll, f] = needed;
    let [px, py, k1, k2, k3, k4, t1, t2] = further;
    let world_from_axes = DMat3::from_rotation_z(-heading.to_radians())
        * DMat3::from_rotation_x(pitch.to_radians())
        * DMat3::from_rotation_y(roll.to_radians());
    let pose = pose::camera_from_world(world_from_axes * FLIP_Y_AND_Z, DVec3::new(x, y, alt))
        .map_err(|message| format!("image {name} {message}"))?;
    let camera = photographs.size_of(&name).map(|(width, height)| {
        let (w, h) = (f64::from(width), f64::from(height));
        let side = w.max(h);
        SourceCamera::from(Brown {
            width,
            height,
            fx: f * side / FILM_WIDTH,
            fy: f * side / FILM_WIDTH,
            cx: px * side + w / 2.0,
            cy: py * side + h / 2.0,
            radial: [k1, k2, k3, k4, 0.0, 0.0],
            tangential: [t1, t2],
            ..Brown::default()
        })
    });
    let camera = camera.and_then(|camera| {
        super::sound(camera)
            .map_err(|message| faults.error(format!("image {name} {message}"), at, EXPORT_HINT))
            .ok()
    });
    let mut image = ModelImage::new(name, pose, at.to_owned());
    image.camera_id = model.push_camera(camera);
    model.push_image(image);
    Ok(())
}
