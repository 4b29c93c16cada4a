//! A small sound capture on disk, to be damaged or looked at by the tests.

use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};

use glam::{DQuat, DVec3};
use ign_capture::{Fault, ImportError, ImportOptions, Scene, Severity, import};
use ign_geometry::{Camera, CameraIntrinsics};

pub(crate) const WIDTH: u32 = 80;
pub(crate) const HEIGHT: u32 = 60;
pub(crate) const VIEWS: usize = 12;
/// PINHOLE, off centre, focal lengths that differ.
pub(crate) const PINHOLE: &str = "1 PINHOLE 80 60 90 95 41.5 28.25";

/// A folder with images/, sparse/0/ in text form and mesh.ply.
pub(crate) struct Capture {
    keep: tempfile::TempDir,
}

impl Capture {
    /// Twelve grey photographs around an octahedron, one PINHOLE camera.
    pub(crate) fn sound() -> Self {
        Self::with_camera(PINHOLE)
    }

    /// The same with another line in cameras.txt.
    pub(crate) fn with_camera(camera: &str) -> Self {
        let capture = Self {
            keep: tempfile::tempdir().expect("a scratch folder"),
        };
        capture.write("sparse/0/cameras.txt", &format!("# cameras\n{camera}\n"));
        let mut images = String::from("# images\n");
        for view in 0..VIEWS {
            let pose = Self::camera(view).camera_from_world;
            let (q, t) = (DQuat::from_mat3(&pose.matrix3), pose.translation);
            writeln!(
                images,
                "{} {} {} {} {} {} {} {} 1 {}\n",
                view + 1,
                q.w,
                q.x,
                q.y,
                q.z,
                t.x,
                t.y,
                t.z,
                Self::name(view)
            )
            .expect("a line");
            capture.photograph(view, |_, _| [90, 100, 110]);
        }
        capture.write("sparse/0/images.txt", &images);
        capture.write("sparse/0/points3D.txt", "1 0.5 0 0 10 20 30 0.4 1 0 3 0\n");
        capture.write("mesh.ply", &octahedron(0.5));
        capture
    }

    pub(crate) fn dir(&self) -> &Path {
        self.keep.path()
    }

    pub(crate) fn path(&self, relative: &str) -> PathBuf {
        self.dir().join(relative)
    }

    pub(crate) fn name(view: usize) -> String {
        format!("img {view}.png")
    }

    /// The pose of a view; the intrinsics are those of [`PINHOLE`].
    pub(crate) fn camera(view: usize) -> Camera {
        let intrinsics = CameraIntrinsics {
            fx: 90.0,
            fy: 95.0,
            cx: 41.5,
            cy: 28.25,
            width: WIDTH,
            height: HEIGHT,
        };
        let angle = std::f64::consts::TAU * view as f64 / VIEWS as f64;
        let eye = DVec3::new(2.2 * angle.cos(), 2.2 * angle.sin(), 0.6);
        Camera::look_at(intrinsics, eye, DVec3::ZERO, DVec3::new(0.2, 0.1, 1.0)).expect("a camera")
    }

    pub(crate) fn write(&self, relative: &str, text: &str) {
        let path = self.path(relative);
        fs::create_dir_all(path.parent().expect("a folder")).expect("a folder");
        fs::write(path, text).expect("a file");
    }

    pub(crate) fn replace(&self, relative: &str, from: &str, to: &str) {
        let text = fs::read_to_string(self.path(relative)).expect("the file");
        assert!(text.contains(from), "{relative} does not hold {from:?}");
        self.write(relative, &text.replacen(from, to, 1));
    }

    pub(crate) fn remove(&self, relative: &str) {
        let path = self.path(relative);
        if path.is_dir() {
            fs::remove_dir_all(path)
        } else {
            fs::remove_file(path)
        }
        .expect("removed");
    }

    pub(crate) fn photograph(&self, view: usize, color: impl Fn(u32, u32) -> [u8; 3]) {
        let image = image::RgbImage::from_fn(WIDTH, HEIGHT, |x, y| image::Rgb(color(x, y)));
        let path = self.path(&format!("images/{}", Self::name(view)));
        fs::create_dir_all(path.parent().expect("a folder")).expect("a folder");
        image.save(path).expect("a picture");
    }

    pub(crate) fn mask(&self, file: &str, size: (u32, u32), value: impl Fn(u32, u32) -> u8) {
        fs::create_dir_all(self.path("masks")).expect("a folder");
        let image = image::GrayImage::from_fn(size.0, size.1, |x, y| image::Luma([value(x, y)]));
        image
            .save(self.path(&format!("masks/{file}")))
            .expect("a mask");
    }

    pub(crate) fn import(&self) -> Scene {
        import(self.dir(), &ImportOptions::default()).expect("a sound capture")
    }

    /// The faults of a capture that cannot be imported.
    pub(crate) fn faults(&self) -> Vec<Fault> {
        faults(self.dir(), &ImportOptions::default())
    }
}

pub(crate) fn faults(dir: &Path, options: &ImportOptions) -> Vec<Fault> {
    match import(dir, options) {
        Err(ImportError::Faults(faults)) => faults,
        Err(other) => panic!("not a list of faults: {other}"),
        Ok(_) => panic!("the capture was imported"),
    }
}

/// Errors as (place, message), in their order.
pub(crate) fn errors(faults: &[Fault]) -> Vec<(&str, &str)> {
    let errors = faults
        .iter()
        .filter(|fault| fault.severity == Severity::Error);
    errors
        .map(|fault| (fault.at.as_str(), fault.message.as_str()))
        .collect()
}

pub(crate) fn octahedron(radius: f64) -> String {
    let mut text = String::from(
        "ply\nformat ascii 1.0\nelement vertex 6\nproperty float x\nproperty float y\nproperty float z\n\
         element face 8\nproperty list uchar int vertex_indices\nend_header\n",
    );
    for (x, y, z) in [
        (1, 0, 0),
        (-1, 0, 0),
        (0, 1, 0),
        (0, -1, 0),
        (0, 0, 1),
        (0, 0, -1),
    ] {
        let scaled = |v: i32| f64::from(v) * radius;
        writeln!(text, "{} {} {}", scaled(x), scaled(y), scaled(z)).expect("a line");
    }
    for (a, b) in [(0, 2), (2, 1), (1, 3), (3, 0)] {
        writeln!(text, "3 {a} {b} 4\n3 {b} {a} 5").expect("lines");
    }
    text
}
