//! Agisoft Metashape's cameras as XML ("Export Cameras", Agisoft XML).
//!
//! A camera's `transform` is a 4x4 matrix, row by row, from camera axes (ours) into the frame of its component. The
//! component's transform (the chunk's, in files before components) is a similarity into the world: rotation,
//! translation and scale. It is applied here, because it is applied to the meshes that Metashape exports in local
//! coordinates. A chunk with a coordinate reference system has its world at the centre of the earth, while meshes are
//! exported in map coordinates: that is a warning.
//!
//! The principal point is measured from the picture's centre, f in pixels;
//! `u = w/2 + cx + x' (f + b1) + y' b2`, `v = h/2 + cy + y' f`, where p1 bends x more and p2 bends y more: the other
//! way round than in `OpenCV`. Fisheye lenses have the same terms on the angle. Cameras that are disabled or have no
//! transform of their own are left out. Source: Agisoft Metashape User Manual, "Camera models".

use glam::{DAffine3, DMat3, DVec3};

use super::photo_index::PhotoIndex;
use super::pose::{self, Similarity};
use super::xml::{Node, Tree};
use super::{Model, ModelImage};
use crate::distortion::{Brown, SourceCamera};
use crate::fault::Faults;

const AGAIN: &str = "export the cameras again from Metashape as Agisoft XML";

/// The file, and how faults call a place in it.
struct Xml<'a> {
    tree: &'a Tree,
    shown: &'a str,
}

impl Xml<'_> {
    fn at(&self, node: Node<'_>) -> String {
        format!("{}:{}", self.shown, node.line())
    }
}

pub(super) fn parse(
    bytes: &[u8],
    shown: &str,
    photographs: &PhotoIndex,
    faults: &mut Faults,
) -> Model {
    let mut model = Model::default();
    let Ok(text) = std::str::from_utf8(bytes) else {
        faults.error("the file is no UTF-8 text", shown, AGAIN);
        return model;
    };
    let tree = match Tree::parse(text) {
        Ok(tree) => tree,
        Err(error) => {
            let message = format!("the file cannot be read: {}", error.message);
            faults.error(message, format!("{shown}:{}", error.line), AGAIN);
            return model;
        }
    };
    let xml = Xml { tree: &tree, shown };
    let errors_before = faults.error_count();
    let Some(chunk) = choose_chunk(&xml, faults) else {
        return model;
    };
    let mut sensors: Vec<Sensor<'_>> = chunk
        .child("sensors")
        .into_iter()
        .flat_map(|list| list.children("sensor"))
        .map(|node| Sensor {
            node,
            entered: None,
        })
        .collect();
    let frames = Frames::of(&xml, chunk, faults);
    let (mut unaligned, mut disabled, mut following) = (0, 0, 0);
    for camera in aligned_or_not(chunk) {
        if is_off(camera) {
            disabled += 1;
            continue;
        }
        let Some(transform) = camera.child("transform") else {
            match camera.attribute("master_id") {
                Some(_) => following += 1,
                None => unaligned += 1,
            }
            continue;
        };
        let Some(world) = frames.world_from(camera) else {
            // Left out with its component, which was said.
            continue;
        };
        let at = xml.at(camera);
        let label = camera.attribute("label").unwrap_or_default();
        let name = match photographs.name_of(label) {
            Ok(name) => name,
            Err(message) => {
                faults.error(
                    message,
                    at,
                    "labels must name one photograph in images/ each",
                );
                continue;
            }
        };
        let pose = numbers::<16>(transform)
            .ok_or("has a transform that is no 4x4 matrix")
            .and_then(|matrix| placed(&matrix, world));
        match pose {
            Ok(pose) => {
                let sensor = camera.attribute("sensor_id").unwrap_or_default();
                let mut image = ModelImage::new(name, pose, at);
                image.camera_id = camera_id(&mut sensors, sensor, &image, &xml, &mut model, faults);
                model.push_image(image);
            }
            Err(message) => faults.error(format!("image {name} {message}"), at, AGAIN),
        }
    }
    for (count, what) in [
        (disabled, "are disabled"),
        (unaligned, "were not aligned"),
        (
            following,
            "follow another one in a multi-camera system, which is not supported,",
        ),
    ] {
        if count > 0 {
            faults.warning(
                format!("{count} cameras {what} and are left out"),
                shown,
                "nothing to do, unless they are needed",
            );
        }
    }
    if model.images.is_empty() && faults.error_count() == errors_before {
        faults.error(
            "the file has no aligned cameras",
            shown,
            "align the photographs in Metashape and export the cameras again",
        );
    }
    model.has_all_images = faults.error_count() == errors_before;
    model
}

/// The chunk with the most aligned cameras.
fn choose_chunk<'a>(xml: &Xml<'a>, faults: &mut Faults) -> Option<Node<'a>> {
    let chunks: Vec<(Node<'_>, usize)> = xml
        .tree
        .nodes()
        .filter(|node| node.name() == "chunk")
        .map(|chunk| (chunk, count_aligned(chunk)))
        .collect();
    let taken = chunks
        .iter()
        .enumerate()
        .rev()
        .max_by_key(|(_, (_, aligned))| *aligned);
    let Some((taken, &(chunk, aligned))) = taken else {
        faults.error("the file has no chunk", xml.shown, AGAIN);
        return None;
    };
    if chunks.len() > 1 {
        let label = |chunk: Node<'_>| chunk.attribute("label").unwrap_or("?").to_owned();
        let others: Vec<String> = chunks
            .iter()
            .enumerate()
            .filter(|(index, _)| *index != taken)
            .map(|(_, (chunk, aligned))| format!("{} ({aligned} images)", label(*chunk)))
            .collect();
        faults.warning(
            format!(
                "the file has {} chunks; {} with {aligned} images is used, left out: {}",
                chunks.len(),
                label(chunk),
                others.join(", ")
            ),
            xml.at(chunk),
            "export the cameras of one chunk, or merge the chunks",
        );
    }
    Some(chunk)
}

/// All cameras of a chunk, in groups or not.
fn aligned_or_not(chunk: Node<'_>) -> impl Iterator<Item = Node<'_>> {
    chunk
        .child("cameras")
        .into_iter()
        .flat_map(|list| list.descendants("camera"))
}

fn count_aligned(chunk: Node<'_>) -> usize {
    aligned_or_not(chunk)
        .filter(|camera| !is_off(*camera) && camera.child("transform").is_some())
        .count()
}

fn is_off(camera: Node<'_>) -> bool {
    matches!(camera.attribute("enabled"), Some("false" | "0" | "False"))
}

/// From the components' frames into the world.
struct Frames {
    /// By the component's id.
    components: Vec<(String, Similarity)>,
    /// For cameras that name no component.
    chunk: Similarity,
    /// The only component whose cameras are taken.
    only: Option<String>,
}

impl Frames {
    fn of(xml: &Xml<'_>, chunk: Node<'_>, faults: &mut Faults) -> Self {
        let similarity = |node: Node<'_>, faults: &mut Faults| {
            let transform = node.child("transform")?;
            match read_similarity(transform) {
                Ok(similarity) => Some(similarity),
                Err(message) => {
                    let what = node.name();
                    faults.error(format!("the {what} {message}"), xml.at(transform), AGAIN);
                    None
                }
            }
        };
        let chunk_transform = similarity(chunk, faults);
        let components: Vec<(String, Option<Similarity>)> = chunk
            .child("components")
            .into_iter()
            .flat_map(|list| list.children("component"))
            .map(|component| {
                let id = component.attribute("id").unwrap_or_default().to_owned();
                (id, similarity(component, faults))
            })
            .collect();
        let mut counts: Vec<(&str, usize)> =
            components.iter().map(|(id, _)| (id.as_str(), 0)).collect();
        for camera in aligned_or_not(chunk) {
            let id = camera.attribute("component_id");
            let entry = counts.iter_mut().find(|(known, _)| Some(*known) == id);
            if let Some((_, count)) = entry
                && !is_off(camera)
                && camera.child("transform").is_some()
            {
                *count += 1;
            }
        }
        counts.retain(|(_, count)| *count > 0);
        let is_placed = |id: &str| {
            components
                .iter()
                .any(|(known, similarity)| known == id && similarity.is_some())
        };
        let mut only = None;
        if counts.len() > 1 {
            let all_are_placed = counts.iter().all(|(id, _)| is_placed(id));
            let list = |skipped: Option<&str>| {
                let parts: Vec<String> = counts
                    .iter()
                    .filter(|(id, _)| Some(*id) != skipped)
                    .map(|(id, count)| format!("component {id} ({count} images)"))
                    .collect();
                parts.join(", ")
            };
            if all_are_placed {
                faults.warning(
                    format!("the cameras fell into components, each with its own transform; all are used: {}", list(None)),
                    xml.shown,
                    "check that they fit each other, or export one component",
                );
            } else {
                let largest = counts.iter().rev().max_by_key(|(_, count)| *count);
                only = largest.map(|(id, _)| (*id).to_owned());
                faults.warning(
                    format!(
                        "the cameras fell into {} components that are not placed to each other; the largest, {}, is used, \
                         left out: {}",
                        counts.len(),
                        only.as_deref().unwrap_or_default(),
                        list(only.as_deref())
                    ),
                    xml.shown,
                    "align the photographs so that they form one component",
                );
            }
        }
        let is_georeferenced = chunk
            .child("reference")
            .map(Node::text)
            .is_some_and(|text| !text.trim().is_empty() && !text.contains("LOCAL_CS"));
        let some_are_placed =
            chunk_transform.is_some() || components.iter().any(|(_, s)| s.is_some());
        if is_georeferenced && some_are_placed {
            faults.warning(
                "the chunk has a coordinate reference system: its cameras are in geocentric coordinates",
                xml.shown,
                "meshes exported in map coordinates do not fit: set the chunk's system to local coordinates and export \
                 cameras and mesh again",
            );
        }
        let chunk = chunk_transform.unwrap_or(Similarity::IDENTITY);
        Self {
            components: components
                .into_iter()
                .map(|(id, similarity)| (id, similarity.unwrap_or(chunk)))
                .collect(),
            chunk,
            only,
        }
    }

    /// The world from the frame of a camera's component; `None` where the component is left out.
    fn world_from(&self, camera: Node<'_>) -> Option<Similarity> {
        let Some(id) = camera.attribute("component_id") else {
            return self.only.is_none().then_some(self.chunk);
        };
        if self.only.as_deref().is_some_and(|only| only != id) {
            return None;
        }
        let component = self.components.iter().find(|(known, _)| known == id);
        Some(component.map_or(self.chunk, |(_, similarity)| *similarity))
    }
}

/// Rotation, translation and scale as elements, or all of them as one 4x4 matrix.
fn read_similarity(transform: Node<'_>) -> Result<Similarity, &'static str> {
    if let Some(matrix) = numbers::<16>(transform) {
        let axes = DMat3::from_cols_array(&upper_left(&matrix)).transpose();
        return similarity(
            axes,
            [matrix[3], matrix[7], matrix[11]],
            axes.col(0).length(),
        );
    }
    let part = |name: &'static str| transform.child(name);
    let rotation = match part("rotation") {
        None => DMat3::IDENTITY,
        Some(node) => numbers::<9>(node)
            .map(|rows| DMat3::from_cols_array(&rows).transpose())
            .ok_or("has a rotation that is no 3x3 matrix")?,
    };
    let translation = match part("translation") {
        None => [0.0; 3],
        Some(node) => numbers::<3>(node).ok_or("has a translation that is no 3-vector")?,
    };
    let scale = match part("scale") {
        None => 1.0,
        Some(node) => numbers::<1>(node).ok_or("has a scale that is no number")?[0],
    };
    similarity(rotation, translation, scale)
}

fn similarity(
    rotation: DMat3,
    translation: [f64; 3],
    scale: f64,
) -> Result<Similarity, &'static str> {
    let translation = DVec3::from_array(translation);
    if !(scale.is_finite() && scale > 0.0 && translation.is_finite()) {
        return Err("has a transform that is not finite, or of scale zero");
    }
    Ok(Similarity {
        scale,
        rotation: DMat3::from_quat(pose::rotation(rotation)?),
        translation,
    })
}

/// The camera of a matrix from camera axes into a component, in the world.
fn placed(matrix: &[f64; 16], world: Similarity) -> Result<DAffine3, &'static str> {
    let axes = DMat3::from_cols_array(&upper_left(matrix)).transpose();
    let center = DVec3::new(matrix[3], matrix[7], matrix[11]);
    pose::camera_from_world(world.rotation * axes, world.apply(center))
}

/// The 3x3 rows of a 4x4 matrix.
fn upper_left(m: &[f64; 16]) -> [f64; 9] {
    [m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]]
}

/// A sensor; its camera enters the model with the first image that needs it.
struct Sensor<'a> {
    node: Node<'a>,
    entered: Option<u32>,
}

/// The model's id of a sensor's camera, which is entered, or its fault reported, when it is first asked for.
fn camera_id(
    sensors: &mut [Sensor<'_>],
    wanted: &str,
    image: &ModelImage,
    xml: &Xml<'_>,
    model: &mut Model,
    faults: &mut Faults,
) -> u32 {
    let sensor = sensors
        .iter_mut()
        .find(|sensor| sensor.node.attribute("id") == Some(wanted));
    let Some(sensor) = sensor else {
        faults.error(
            format!(
                "image {} names sensor {wanted:?}, which the file does not have",
                image.name
            ),
            image.at.as_str(),
            AGAIN,
        );
        return model.push_camera(None);
    };
    if let Some(id) = sensor.entered {
        return id;
    }
    let camera = source_camera(sensor.node)
        .and_then(|camera| super::sound(camera).map_err(|message| (message, AGAIN)));
    let camera = match camera {
        Ok(camera) => Some(camera),
        Err((message, hint)) => {
            let message = format!("sensor {wanted} {message}");
            faults.error(message, xml.at(sensor.node), hint);
            None
        }
    };
    let id = model.push_camera(camera);
    sensor.entered = Some(id);
    id
}

fn source_camera(sensor: Node<'_>) -> Result<SourceCamera, (String, &'static str)> {
    let plain = |message: &str| (message.to_owned(), AGAIN);
    let calibrations = || sensor.children("calibration");
    // The one that the alignment has adjusted, beside the one it began with.
    let calibration = calibrations()
        .find(|calibration| calibration.attribute("class") == Some("adjusted"))
        .or_else(|| calibrations().last());
    let resolution = calibration
        .and_then(|calibration| calibration.child("resolution"))
        .or_else(|| sensor.child("resolution"))
        .ok_or_else(|| plain("has no resolution"))?;
    let side = |name: &str| {
        let text = resolution.attribute(name).unwrap_or_default();
        text.parse().unwrap_or(f64::NAN)
    };
    let (width, height) =
        super::picture_size(side("width"), side("height")).map_err(|message| (message, AGAIN))?;
    let kind = calibration
        .and_then(|calibration| calibration.attribute("type"))
        .or(sensor.attribute("type"))
        .unwrap_or("frame");
    let fisheye = match kind {
        "frame" => false,
        "fisheye" => true,
        "spherical" => return Ok(SourceCamera::panorama(width, height)),
        other => {
            return Err((
                format!("has the unsupported type {other:?}"),
                "use frame, fisheye or spherical cameras, or undistort the photographs in Metashape",
            ));
        }
    };
    let calibration = calibration.ok_or_else(|| plain("has no calibration"))?;
    if calibration.child("fx").is_some() {
        return Err((
            "has the calibration of an old PhotoScan".to_owned(),
            "open the project in Metashape and export the cameras again",
        ));
    }
    let number = |name: &'static str| match calibration.child(name) {
        None => Ok(0.0),
        Some(node) => numbers::<1>(node)
            .map(|[value]| value)
            .ok_or_else(|| plain(&format!("has no number for {name}"))),
    };
    if number("p3")? != 0.0 || number("p4")? != 0.0 {
        return Err((
            "has the tangential terms p3 and p4, which are not supported".to_owned(),
            "optimise the cameras without p3 and p4 and export them again",
        ));
    }
    let f = number("f")?;
    Ok(Brown {
        width,
        height,
        fx: f + number("b1")?,
        fy: f,
        cx: f64::from(width) / 2.0 + number("cx")?,
        cy: f64::from(height) / 2.0 + number("cy")?,
        skew: number("b2")?,
        fisheye,
        radial: [
            number("k1")?,
            number("k2")?,
            number("k3")?,
            number("k4")?,
            0.0,
            0.0,
        ],
        tangential: [number("p2")?, number("p1")?],
        ..Brown::default()
    }
    .into())
}

/// Exactly `N` finite numbers as an element's text.
fn numbers<const N: usize>(node: Node<'_>) -> Option<[f64; N]> {
    let mut words = node.text().split_ascii_whitespace();
    let mut values = [0.0; N];
    for value in &mut values {
        *value = words
            .next()?
            .parse()
            .ok()
            .filter(|value: &f64| value.is_finite())?;
    }
    words.next().is_none().then_some(values)
}
