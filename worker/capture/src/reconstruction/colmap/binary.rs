//! COLMAP's binary files: little endian, no padding.
//!
//! Counts in the files are believed only as far as the file is long: nothing is allocated for records that cannot be
//! there. A file that ends early is one fault, with the byte at which the record began.

use std::fs::File;
use std::io::{self, BufRead, BufReader, Read};
use std::path::Path;

use glam::DVec3;

use super::{REEXPORT_HINT, Source, known_error, pose};
use crate::distortion::{ModelKind, SourceCamera};
use crate::fault::Faults;
use crate::reconstruction::{Model, ModelImage, ModelPoint, add_camera};

/// Longest name of a photograph that is believed.
const NAME_BYTES: usize = 4096;

/// An image takes at least this much: id, pose, camera, an empty name, no points.
const IMAGE_BYTES: u64 = 4 + 56 + 4 + 1 + 8;

/// Why reading stopped.
enum Stop {
    /// The file ends inside a record.
    Truncated,
    Io(io::Error),
    Garbled(String),
}

impl From<io::Error> for Stop {
    fn from(error: io::Error) -> Self {
        if error.kind() == io::ErrorKind::UnexpectedEof {
            Self::Truncated
        } else {
            Self::Io(error)
        }
    }
}

/// A file with the place of the record being read.
struct Bytes {
    reader: BufReader<File>,
    length: u64,
    position: u64,
    record_at: u64,
}

impl Bytes {
    fn open(source: &Source, faults: &mut Faults) -> Option<Self> {
        let open = || -> io::Result<Self> {
            let file = File::open(&source.path)?;
            let length = file.metadata()?.len();
            Ok(Self {
                reader: BufReader::with_capacity(1 << 16, file),
                length,
                position: 0,
                record_at: 0,
            })
        };
        match open() {
            Ok(bytes) => Some(bytes),
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

    fn take<const N: usize>(&mut self) -> Result<[u8; N], Stop> {
        let mut buffer = [0; N];
        self.reader.read_exact(&mut buffer)?;
        self.position += N as u64;
        Ok(buffer)
    }

    fn u32(&mut self) -> Result<u32, Stop> {
        Ok(u32::from_le_bytes(self.take()?))
    }

    fn i32(&mut self) -> Result<i32, Stop> {
        Ok(i32::from_le_bytes(self.take()?))
    }

    fn u64(&mut self) -> Result<u64, Stop> {
        Ok(u64::from_le_bytes(self.take()?))
    }

    fn f64(&mut self) -> Result<f64, Stop> {
        Ok(f64::from_le_bytes(self.take()?))
    }

    fn f64s<const N: usize>(&mut self) -> Result<[f64; N], Stop> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = self.f64()?;
        }
        Ok(values)
    }

    /// A count of records that take at least `record_bytes` each: more than the file can hold is truncation.
    fn count(&mut self, record_bytes: u64) -> Result<u64, Stop> {
        let count = self.u64()?;
        let left = self.length.saturating_sub(self.position);
        if count
            .checked_mul(record_bytes)
            .is_none_or(|bytes| bytes > left)
        {
            Err(Stop::Truncated)
        } else {
            Ok(count)
        }
    }

    fn skip(&mut self, bytes: u64) -> Result<(), Stop> {
        let signed = i64::try_from(bytes).ok().ok_or(Stop::Truncated)?;
        self.reader.seek_relative(signed)?;
        self.position += bytes;
        Ok(())
    }

    fn name(&mut self) -> Result<String, Stop> {
        let mut name = Vec::new();
        // One more than is believed, to tell a long name from one that ends there.
        let mut limited = (&mut self.reader).take(NAME_BYTES as u64 + 1);
        let read = limited.read_until(0, &mut name)?;
        self.position += read as u64;
        if name.pop() != Some(0) {
            return Err(if read > NAME_BYTES {
                Stop::Garbled("an image's name does not end".into())
            } else {
                Stop::Truncated
            });
        }
        String::from_utf8(name)
            .ok()
            .ok_or_else(|| Stop::Garbled("an image's name is no UTF-8 text".into()))
    }

    fn begin_record(&mut self) {
        self.record_at = self.position;
    }

    fn at(&self, source: &Source) -> String {
        format!("{} (byte {})", source.shown, self.record_at)
    }

    /// Turns the way reading ended into a fault.
    fn finish(&self, source: &Source, faults: &mut Faults, what: &str, result: Result<(), Stop>) {
        let at = self.at(source);
        let again = "copy the file again, or re-export the model";
        match result {
            Ok(()) if self.position < self.length => faults.warning(
                format!(
                    "{} bytes follow the last record",
                    self.length - self.position
                ),
                format!("{} (byte {})", source.shown, self.position),
                again,
            ),
            Ok(()) => {}
            Err(Stop::Truncated) => {
                faults.error(
                    format!(
                        "the file is truncated: it ends after {} bytes, inside {what}",
                        self.length
                    ),
                    at,
                    again,
                );
            }
            Err(Stop::Io(error)) => {
                faults.error(format!("cannot read on: {error}"), at, "check the disk");
            }
            Err(Stop::Garbled(message)) => faults.error(message, at, again),
        }
    }
}

pub(super) fn cameras(source: &Source, model: &mut Model, faults: &mut Faults) {
    let Some(mut bytes) = Bytes::open(source, faults) else {
        return;
    };
    let result = read_cameras(&mut bytes, source, model, faults);
    bytes.finish(source, faults, "the list of cameras", result);
}

fn read_cameras(
    bytes: &mut Bytes,
    source: &Source,
    model: &mut Model,
    faults: &mut Faults,
) -> Result<(), Stop> {
    for _ in 0..bytes.count(24)? {
        bytes.begin_record();
        let id = bytes.u32()?;
        let model_id = bytes.i32()?;
        let (width, height) = (bytes.u64()?, bytes.u64()?);
        let Some(kind) = ModelKind::by_id(model_id) else {
            // The length of its parameter list is unknown, so the cameras behind it cannot be found.
            return Err(Stop::Garbled(format!(
                "camera {id} has the unknown model number {model_id}"
            )));
        };
        let mut params = Vec::with_capacity(kind.params);
        for _ in 0..kind.params {
            params.push(bytes.f64()?);
        }
        let camera = match (u32::try_from(width), u32::try_from(height)) {
            (Ok(width), Ok(height)) => {
                SourceCamera::from_params(kind.model, width, height, &params).ok_or_else(|| {
                    (
                        format!("has the wrong number of parameters for {}", kind.name),
                        REEXPORT_HINT,
                    )
                })
            }
            _ => Err((
                format!("has a picture size of {width}x{height}"),
                REEXPORT_HINT,
            )),
        };
        add_camera(model, faults, id, &bytes.at(source), camera);
    }
    Ok(())
}

pub(super) fn images(source: &Source, model: &mut Model, faults: &mut Faults) {
    let Some(mut bytes) = Bytes::open(source, faults) else {
        return;
    };
    let result = read_images(&mut bytes, source, model, faults);
    bytes.finish(source, faults, "the list of images", result);
}

fn read_images(
    bytes: &mut Bytes,
    source: &Source,
    model: &mut Model,
    faults: &mut Faults,
) -> Result<(), Stop> {
    for _ in 0..bytes.count(IMAGE_BYTES)? {
        bytes.begin_record();
        let id = bytes.u32()?;
        let values = bytes.f64s::<7>()?;
        let camera_id = bytes.u32()?;
        let name = bytes.name()?;
        let points = bytes.count(24)?;
        bytes.skip(points * 24)?;
        let at = bytes.at(source);
        match pose(&values) {
            Ok(camera_from_world) => model.images.push(ModelImage {
                id,
                name,
                camera_id,
                camera_from_world,
                mask_path: None,
                at,
            }),
            Err(message) => {
                faults.error(format!("image {name} {message}"), at, "re-export the model");
            }
        }
    }
    Ok(())
}

pub(super) fn points(source: &Source, model: &mut Model, faults: &mut Faults) {
    let Some(mut bytes) = Bytes::open(source, faults) else {
        return;
    };
    let result = read_points(&mut bytes, source, model, faults);
    bytes.finish(source, faults, "the list of points", result);
}

fn read_points(
    bytes: &mut Bytes,
    source: &Source,
    model: &mut Model,
    faults: &mut Faults,
) -> Result<(), Stop> {
    for _ in 0..bytes.count(8 + 24 + 3 + 8 + 8)? {
        bytes.begin_record();
        let id = bytes.u64()?;
        let position = DVec3::from_array(bytes.f64s::<3>()?);
        let color = bytes.take::<3>()?;
        let error_px = bytes.f64()?;
        let track = bytes.count(8)?;
        let mut image_ids = Vec::with_capacity(track as usize);
        for _ in 0..track {
            image_ids.push(bytes.u32()?);
            bytes.u32()?;
        }
        if position.is_finite() {
            model.points.push(ModelPoint {
                position,
                color,
                error_px: known_error(error_px),
                image_ids,
            });
        } else {
            let message = format!("point {id} has a position that is not finite");
            faults.error(message, bytes.at(source), "re-export the model");
        }
    }
    Ok(())
}

/// How many images the file says that it lists, and can.
pub(super) fn count_images(path: &Path) -> u64 {
    let count = || -> io::Result<u64> {
        let mut file = File::open(path)?;
        let length = file.metadata()?.len();
        let mut count = [0; 8];
        file.read_exact(&mut count)?;
        Ok(u64::from_le_bytes(count).min(length / IMAGE_BYTES))
    };
    count().unwrap_or(0)
}
