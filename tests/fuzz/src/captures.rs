//! A small sound capture on disk, of which one file is another at a time.

use std::path::Path;

use ign_capture::{Frame, ImportOptions, Scene, import};
use tempfile::TempDir;

/// Photographs: 8 by 6 pixels.
pub(crate) const SIZE: (u32, u32) = (8, 6);
/// Names of the photographs in the model.
pub(crate) const NAMES: [&str; 4] = ["a.png", "b.png", "c.png", "d.png"];

/// A capture folder.
pub(crate) struct Capture {
    folder: TempDir,
}

impl Capture {
    /// Photographs and mesh, and the files of a camera format.
    pub(crate) fn new(files: &[(&str, &[u8])]) -> Self {
        let capture = Self {
            folder: TempDir::with_prefix("ign-fuzz-").expect("a folder"),
        };
        for (index, name) in NAMES.iter().enumerate() {
            capture.write(&format!("images/{name}"), &photograph(index as u8));
        }
        capture.write("mesh.ply", MESH.as_bytes());
        for (path, bytes) in files {
            capture.write(path, bytes);
        }
        capture
    }

    pub(crate) fn dir(&self) -> &Path {
        self.folder.path()
    }

    pub(crate) fn write(&self, path: &str, bytes: &[u8]) {
        let path = self.dir().join(path);
        std::fs::create_dir_all(path.parent().expect("a folder")).expect("a folder");
        std::fs::write(path, bytes).expect("a file");
    }

    /// Imports the capture with `bytes` as the file at `path`, and looks at what came out.
    pub(crate) fn import_with(&self, path: &str, bytes: &[u8]) {
        self.write(path, bytes);
        if let Ok(scene) = import(self.dir(), &ImportOptions::default()) {
            check(&scene);
        }
    }
}

/// Whatever a scene was read from, its cameras and the pictures in them are usable.
pub(crate) fn check(scene: &Scene) {
    for (index, view) in scene.views.iter().enumerate() {
        view.camera.intrinsics.validate().expect("valid intrinsics");
        assert!(
            view.camera.camera_from_world.is_finite(),
            "view {}",
            view.name
        );
        let frame = Frame::Object {
            size: 8,
            margin: 0.1,
        };
        let camera = scene.frame_camera(index, &frame, 2);
        if let Ok(image) = scene.load_view(index, &camera) {
            let in_range = |value: &f32| (0.0..=1.0).contains(value);
            assert!(
                image.rgb.iter().chain(&image.inside).all(in_range),
                "view {}",
                view.name
            );
            assert!(
                image.mask.iter().flatten().all(in_range),
                "mask of view {}",
                view.name
            );
        }
    }
    let count = scene.views.len();
    assert!(
        scene
            .train
            .iter()
            .chain(&scene.held_out)
            .all(|view| *view < count)
    );
    assert!(scene.points.iter().all(|point| point.position.is_finite()));
}

/// An 8-bit PNG.
pub(crate) fn photograph(shade: u8) -> Vec<u8> {
    let picture = image::RgbImage::from_fn(SIZE.0, SIZE.1, |x, y| {
        image::Rgb([30 * x as u8, 40 * y as u8, 50 * shade])
    });
    encoded(&picture.into(), image::ImageFormat::Png)
}

pub(crate) fn encoded(picture: &image::DynamicImage, format: image::ImageFormat) -> Vec<u8> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    picture.write_to(&mut bytes, format).expect("encoded");
    bytes.into_inner()
}

/// A tetrahedron around the origin.
pub(crate) const MESH: &str = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\n\
    property float z\nelement face 4\nproperty list uchar int vertex_indices\nend_header\n\
    0.5 0 -0.3\n-0.4 0.4 -0.3\n-0.4 -0.4 -0.3\n0 0 0.6\n3 0 1 2\n3 0 1 3\n3 1 2 3\n3 0 2 3\n";

/// COLMAP's text files: cameras, images, points. All look at the origin along their z axis, from 2 away.
pub(crate) const CAMERAS_TXT: &str = "# cameras\n1 PINHOLE 8 6 9 9 4 3\n2 SIMPLE_RADIAL 8 6 9 4 3 -0.1\n\
    3 OPENCV_FISHEYE 8 6 9 9 4 3 0.1 0 0 0\n4 FULL_OPENCV 8 6 9 9 4 3 0.1 0 0 0 0 0 0 0\n";
pub(crate) const IMAGES_TXT: &str = "# images\n1 1 0 0 0 0 0 2 1 a.png\n1 2 1 3 4 -1\n2 0.8 0.6 0 0 0 0 2 2 b.png\n\n\
    3 0.8 0 0.6 0 0 0 2 3 c.png\n\n4 0.6 0 0.8 0 0.1 0 2 4 d.png\n\n";
pub(crate) const POINTS_TXT: &str =
    "# points\n1 0.1 0.2 0.3 10 20 30 0.5 1 0 2 0\n2 0 0 0 255 255 255 0.1 3 1 4 2\n";

/// The same as COLMAP writes it in binary.
pub(crate) fn cameras_bin() -> Vec<u8> {
    let mut bytes = 2_u64.to_le_bytes().to_vec();
    for (id, model, params) in [
        (1_u32, 1_i32, &[9.0, 9.0, 4.0, 3.0][..]),
        (2, 2, &[9.0, 4.0, 3.0, -0.1]),
    ] {
        bytes.extend(id.to_le_bytes());
        bytes.extend(model.to_le_bytes());
        bytes.extend(u64::from(SIZE.0).to_le_bytes());
        bytes.extend(u64::from(SIZE.1).to_le_bytes());
        bytes.extend(params.iter().flat_map(|value: &f64| value.to_le_bytes()));
    }
    bytes
}

pub(crate) fn images_bin() -> Vec<u8> {
    let mut bytes = 4_u64.to_le_bytes().to_vec();
    let poses = [
        [1.0, 0.0, 0.0, 0.0],
        [0.8, 0.6, 0.0, 0.0],
        [0.8, 0.0, 0.6, 0.0],
        [0.6, 0.0, 0.8, 0.0],
    ];
    for (index, (name, rotation)) in NAMES.iter().zip(poses).enumerate() {
        bytes.extend((index as u32 + 1).to_le_bytes());
        let pose = rotation.into_iter().chain([0.0, 0.0, 2.0]);
        bytes.extend(pose.flat_map(f64::to_le_bytes));
        bytes.extend((index as u32 % 2 + 1).to_le_bytes());
        bytes.extend(name.bytes().chain([0]));
        bytes.extend(1_u64.to_le_bytes());
        bytes.extend([1.5, 2.5].into_iter().flat_map(f64::to_le_bytes));
        bytes.extend(u64::MAX.to_le_bytes());
    }
    bytes
}

pub(crate) fn points_bin() -> Vec<u8> {
    let mut bytes = 2_u64.to_le_bytes().to_vec();
    for id in [1_u64, 2] {
        bytes.extend(id.to_le_bytes());
        bytes.extend([0.1, 0.2, 0.3].into_iter().flat_map(f64::to_le_bytes));
        bytes.extend([10, 20, 30]);
        bytes.extend(0.5_f64.to_le_bytes());
        bytes.extend(2_u64.to_le_bytes());
        bytes.extend([1_u32, 0, 2, 3].into_iter().flat_map(u32::to_le_bytes));
    }
    bytes
}
