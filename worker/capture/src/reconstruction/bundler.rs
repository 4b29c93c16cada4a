//! Bundler's `bundle.out` and the list of its images.
//!
//! Camera axes are x right, y up, z backwards; pixels are measured from the picture's centre, y upwards; the radius is
//! bent by `1 + k1 r^2 + k2 r^4`. The file holds no sizes: they come from the photographs. Cameras of focal length
//! zero were not aligned and are left out. Source: Bundler v0.4 User's Manual, "Output Format and Scene
//! Representation".

use std::path::{Path, PathBuf};
use std::str::{FromStr, Lines, SplitAsciiWhitespace};

use glam::{DAffine3, DMat3, DVec2, DVec3};

use super::photo_index::PhotoIndex;
use super::pose::{self, FLIP_Y_AND_Z};
use super::{Model, ModelImage, ModelPoint};
use crate::distortion::{Brown, SourceCamera};
use crate::fault::Faults;

const AGAIN: &str = "copy the file again, or export it again";

/// Where the list of images of `bundle` lies inside the capture.
pub(super) fn find_list(dir: &Path, bundle: &Path) -> Option<PathBuf> {
    let folder = bundle.parent().unwrap_or(Path::new(""));
    let stem = bundle.file_stem()?.to_str()?;
    let beside = |name: &str| folder.join(name);
    [
        beside(&format!("{stem}.list.txt")),
        beside(&format!("{stem}.out.list.txt")),
        beside("list.txt"),
        folder.parent().unwrap_or(folder).join("list.txt"),
    ]
    .into_iter()
    .find(|path| dir.join(path).is_file())
}

/// The words of a text with their lines.
struct Words<'a> {
    lines: Lines<'a>,
    rest: SplitAsciiWhitespace<'a>,
    line: usize,
}

impl<'a> Words<'a> {
    fn of(text: &'a str) -> Self {
        Self {
            lines: text.lines(),
            rest: "".split_ascii_whitespace(),
            line: 0,
        }
    }

    /// The next word; lines that begin with `#` have none.
    fn next(&mut self) -> Option<&'a str> {
        loop {
            if let Some(word) = self.rest.next() {
                return Some(word);
            }
            let line = self.lines.next()?;
            self.line += 1;
            if !line.starts_with('#') {
                self.rest = line.split_ascii_whitespace();
            }
        }
    }

    fn number<T: FromStr>(&mut self, what: &str) -> Result<T, String> {
        let word = self
            .next()
            .ok_or_else(|| format!("the file ends before {what}"))?;
        word.parse()
            .ok()
            .ok_or_else(|| format!("{what} is no number: {word:?}"))
    }

    fn numbers<const N: usize>(&mut self, what: &str) -> Result<[f64; N], String> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = self.number(what)?;
        }
        Ok(values)
    }
}

/// Reads `bundle`; `list` names the photograph of each camera, one per line.
pub(super) fn parse(
    bundle: &[u8],
    list: &str,
    shown: &str,
    photographs: &PhotoIndex,
    faults: &mut Faults,
) -> Model {
    let mut model = Model::default();
    let Ok(text) = std::str::from_utf8(bundle) else {
        faults.error("the file is no text", shown, AGAIN);
        return model;
    };
    let errors_before = faults.error_count();
    let mut words = Words::of(text);
    let result = read(&mut words, list, shown, photographs, &mut model, faults);
    if let Err(message) = result {
        faults.error(message, format!("{shown}:{}", words.line), AGAIN);
    }
    model.has_all_images = faults.error_count() == errors_before;
    model
}

fn read(
    words: &mut Words<'_>,
    list: &str,
    shown: &str,
    photographs: &PhotoIndex,
    model: &mut Model,
    faults: &mut Faults,
) -> Result<(), String> {
    let cameras: usize = words.number("the number of cameras")?;
    let points: usize = words.number("the number of points")?;
    let mut names = list.lines().map(str::trim).filter(|line| !line.is_empty());
    // Per camera of the file, the id of its image in the model.
    let mut image_ids: Vec<Option<u32>> = Vec::new();
    let mut unaligned = 0;
    for index in 0..cameras {
        let [f, k1, k2] = words.numbers("a camera's focal length and distortion")?;
        let line = words.line;
        let rows = words.numbers::<9>("a camera's rotation")?;
        let translation = DVec3::from_array(words.numbers("a camera's translation")?);
        let name = names.next();
        if f == 0.0 {
            unaligned += 1;
            image_ids.push(None);
            continue;
        }
        let at = format!("{shown}:{line}");
        let Some(written) = name else {
            return Err(format!("camera {index} has no name in the list of images"));
        };
        let entry = Entry {
            written,
            lens: [f, k1, k2],
            rotation: DMat3::from_cols_array(&rows).transpose(),
            translation,
            at,
        };
        image_ids.push(image(entry, photographs, model, faults));
    }
    if unaligned > 0 {
        faults.warning(
            format!("{unaligned} of {cameras} cameras were not aligned and are left out"),
            shown,
            "nothing to do, unless they are needed",
        );
    }
    for _ in 0..points {
        let position = DVec3::from_array(words.numbers("a point's position")?);
        let mut color = [0; 3];
        for value in &mut color {
            *value = words.number("a point's colour")?;
        }
        let seen: usize = words.number("the number of a point's views")?;
        let mut point = ModelPoint {
            position,
            color,
            error_px: None,
            image_ids: Vec::new(),
        };
        let mut errors = Vec::new();
        for _ in 0..seen {
            let camera: usize = words.number("a view's camera")?;
            words.number::<u64>("a view's key")?;
            let at = DVec2::from_array(words.numbers("a view's pixel")?);
            let id = *image_ids
                .get(camera)
                .ok_or_else(|| format!("a point is seen by camera {camera} of {cameras}"))?;
            let Some(id) = id else { continue };
            point.image_ids.push(id);
            errors.extend(reprojection_error(model, id, position, at));
        }
        if !position.is_finite() {
            return Err("a point has a position that is not finite".into());
        }
        point.error_px = super::mean(&errors);
        model.points.push(point);
    }
    if words.next().is_some() {
        return Err("more follows the last point".into());
    }
    Ok(())
}

/// An aligned camera as it stands in the file.
struct Entry<'a> {
    /// Its line in the list of images.
    written: &'a str,
    /// f, k1, k2.
    lens: [f64; 3],
    rotation: DMat3,
    translation: DVec3,
    at: String,
}

/// Enters an aligned camera; its image's id, where it is sound.
fn image(
    entry: Entry<'_>,
    photographs: &PhotoIndex,
    model: &mut Model,
    faults: &mut Faults,
) -> Option<u32> {
    let Entry {
        lens: [f, k1, k2],
        at,
        ..
    } = entry;
    let name = match photographs.name_of(without_guess(entry.written)) {
        Ok(name) => name,
        Err(message) => {
            faults.error(
                message,
                at,
                "the list must name one photograph in images/ per line",
            );
            return None;
        }
    };
    let pose = pose::rotation(FLIP_Y_AND_Z * entry.rotation).and_then(|rotation| {
        let translation = FLIP_Y_AND_Z * entry.translation;
        translation
            .is_finite()
            .then(|| DAffine3::from_rotation_translation(rotation, translation))
            .ok_or("has a position that is not finite")
    });
    let camera_from_world = match pose {
        Ok(pose) => pose,
        Err(message) => {
            faults.error(format!("image {name} {message}"), at, AGAIN);
            return None;
        }
    };
    let camera = photographs.size_of(&name).map(|(width, height)| {
        SourceCamera::from(Brown {
            width,
            height,
            fx: f,
            fy: f,
            cx: f64::from(width) / 2.0,
            cy: f64::from(height) / 2.0,
            radial: [k1, k2, 0.0, 0.0, 0.0, 0.0],
            ..Brown::default()
        })
    });
    let camera = camera.and_then(|camera| {
        super::sound(camera)
            .map_err(|message| faults.error(format!("image {name} {message}"), at.as_str(), AGAIN))
            .ok()
    });
    let mut image = ModelImage::new(name, camera_from_world, at);
    image.camera_id = model.push_camera(camera);
    Some(model.push_image(image))
}

/// A line of the list without the numbers behind the path: `path 0 2432.5`.
fn without_guess(line: &str) -> &str {
    line.rsplit_once(' ')
        .filter(|(_, focal)| focal.parse::<f64>().is_ok())
        .and_then(|(rest, _)| rest.trim_end().strip_suffix(" 0"))
        .map_or(line, str::trim_end)
}

/// How far a point's image lies from where it was seen, in pixels; `seen` from the picture's centre, y upwards.
fn reprojection_error(model: &Model, id: u32, position: DVec3, seen: DVec2) -> Option<f64> {
    let image = model.images.get(id as usize - 1)?;
    let camera = model.cameras.get(&image.camera_id)?.as_ref()?;
    let seen = DVec2::new(camera.cx + seen.x, camera.cy - seen.y);
    model.reprojection_error(id, position, seen)
}
