//! COLMAP's text files. Each faulty line is reported; reading goes on behind it.

use std::fs::File;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::str::{FromStr, SplitAsciiWhitespace};

use glam::DVec3;

use super::{REEXPORT_HINT, Source, known_error, pose};
use crate::distortion::{ModelKind, SourceCamera};
use crate::fault::Faults;
use crate::reconstruction::{Model, ModelImage, ModelPoint, add_camera};

const LINE_HINT: &str = "re-export the model as text, or delete the line";

/// Lines of a text file with their numbers, without loading the file whole.
struct Lines {
    reader: BufReader<File>,
    line: String,
    number: usize,
}

impl Lines {
    fn open(source: &Source, faults: &mut Faults) -> Option<Self> {
        match File::open(&source.path) {
            Ok(file) => Some(Self {
                reader: BufReader::new(file),
                line: String::new(),
                number: 0,
            }),
            Err(error) => {
                faults.error(
                    format!("cannot read the file: {error}"),
                    source.shown.as_str(),
                    "check its permissions",
                );
                None
            }
        }
    }

    /// Steps to the next line; false at the end or where the file is no text (which is reported).
    fn advance(&mut self, source: &Source, faults: &mut Faults) -> bool {
        self.line.clear();
        self.number += 1;
        match self.reader.read_line(&mut self.line) {
            Ok(0) => false,
            Ok(_) => true,
            Err(error) => {
                faults.error(
                    format!("cannot read on: {error}"),
                    self.at(source),
                    "re-export the model as text",
                );
                false
            }
        }
    }

    /// Steps to the next line that is neither empty nor a comment.
    fn advance_to_data(&mut self, source: &Source, faults: &mut Faults) -> bool {
        while self.advance(source, faults) {
            let trimmed = self.line.trim();
            if !trimmed.is_empty() && !trimmed.starts_with('#') {
                return true;
            }
        }
        false
    }

    fn at(&self, source: &Source) -> String {
        format!("{}:{}", source.shown, self.number)
    }
}

/// The next word as a number, or what is wrong with it.
fn number<T: FromStr>(words: &mut SplitAsciiWhitespace<'_>, what: &str) -> Result<T, String> {
    let word = words
        .next()
        .ok_or_else(|| format!("the line ends before {what}"))?;
    word.parse()
        .ok()
        .ok_or_else(|| format!("{what} is no number: {word:?}"))
}

pub(super) fn cameras(source: &Source, model: &mut Model, faults: &mut Faults) {
    let Some(mut lines) = Lines::open(source, faults) else {
        return;
    };
    while lines.advance_to_data(source, faults) {
        let at = lines.at(source);
        let mut words = lines.line.split_ascii_whitespace();
        let id = match number::<u32>(&mut words, "the camera's id") {
            Ok(id) => id,
            Err(message) => {
                faults.error(message, at, LINE_HINT);
                continue;
            }
        };
        add_camera(model, faults, id, &at, camera(&mut words));
    }
}

fn camera(words: &mut SplitAsciiWhitespace<'_>) -> Result<SourceCamera, (String, &'static str)> {
    let garbled = |message: String| (format!("cannot be read: {message}"), LINE_HINT);
    let name = words
        .next()
        .ok_or_else(|| garbled("the line ends before the model's name".into()))?;
    let kind = ModelKind::by_name(name)
        .ok_or_else(|| (format!("has the unknown model {name}"), REEXPORT_HINT))?;
    let width = number(words, "the width").map_err(garbled)?;
    let height = number(words, "the height").map_err(garbled)?;
    let mut params = Vec::with_capacity(kind.params);
    for _ in 0..kind.params {
        params.push(number(words, "a parameter").map_err(garbled)?);
    }
    if words.next().is_some() {
        return Err(garbled(format!(
            "more than the {} parameters of {name}",
            kind.params
        )));
    }
    SourceCamera::from_params(kind.model, width, height, &params).ok_or_else(|| {
        (
            format!("has the wrong number of parameters for {name}"),
            REEXPORT_HINT,
        )
    })
}

pub(super) fn images(source: &Source, model: &mut Model, faults: &mut Faults) {
    let Some(mut lines) = Lines::open(source, faults) else {
        return;
    };
    while lines.advance_to_data(source, faults) {
        let at = lines.at(source);
        match image(&lines.line, &at) {
            Ok(image) => model.images.push(image),
            Err(message) => faults.error(message, at.as_str(), LINE_HINT),
        }
        // Two lines per image: the second one (its 2D points) may be empty, and is not needed.
        if !lines.advance(source, faults) {
            faults.error(
                "the file ends between an image and its points",
                at,
                "each image has two lines, the second may be empty; copy the file again",
            );
            break;
        }
    }
}

fn image(line: &str, at: &str) -> Result<ModelImage, String> {
    let mut words = line.split_ascii_whitespace();
    let id = number(&mut words, "the image's id")?;
    let mut values = [0.0; 7];
    for value in &mut values {
        *value = number(&mut words, "the pose")?;
    }
    let camera_id = number(&mut words, "the camera's id")?;
    // The name is the rest of the line: it may hold blanks.
    let name = words.collect::<Vec<_>>().join(" ");
    if name.is_empty() {
        return Err(format!("image {id} has no name"));
    }
    let camera_from_world = pose(&values).map_err(|message| format!("image {name} {message}"))?;
    Ok(ModelImage {
        id,
        name,
        camera_id,
        camera_from_world,
        mask_path: None,
        at: at.to_owned(),
    })
}

pub(super) fn points(source: &Source, model: &mut Model, faults: &mut Faults) {
    let Some(mut lines) = Lines::open(source, faults) else {
        return;
    };
    while lines.advance_to_data(source, faults) {
        match point(&lines.line) {
            Ok(point) => model.points.push(point),
            Err(message) => faults.error(message, lines.at(source), LINE_HINT),
        }
    }
}

fn point(line: &str) -> Result<ModelPoint, String> {
    let mut words = line.split_ascii_whitespace();
    let id: u64 = number(&mut words, "the point's id")?;
    let mut position = [0.0; 3];
    for value in &mut position {
        *value = number(&mut words, "the position")?;
    }
    let mut color = [0; 3];
    for value in &mut color {
        *value = number(&mut words, "the colour")?;
    }
    let error_px: f64 = number(&mut words, "the error")?;
    let mut image_ids = Vec::new();
    while let Some(word) = words.next() {
        image_ids.push(
            word.parse()
                .ok()
                .ok_or_else(|| format!("an image id of the track is no number: {word:?}"))?,
        );
        number::<u32>(&mut words, "the point's index in the track")?;
    }
    let position = DVec3::from_array(position);
    if !position.is_finite() {
        return Err(format!("point {id} has a position that is not finite"));
    }
    Ok(ModelPoint {
        position,
        color,
        error_px: known_error(error_px),
        image_ids,
    })
}

/// How many images the file lists: two lines each, of which the second may be empty.
pub(super) fn count_images(path: &Path) -> u64 {
    let Ok(file) = File::open(path) else {
        return 0;
    };
    let mut lines = BufReader::new(file).split(b'\n').map_while(Result::ok);
    let mut count = 0;
    while let Some(line) = lines.next() {
        let line = line.trim_ascii();
        if !line.is_empty() && !line.starts_with(b"#") {
            count += 1;
            lines.next();
        }
    }
    count
}
