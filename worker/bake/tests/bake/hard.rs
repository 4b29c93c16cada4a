//! Captures that strain the numbers: placed far from the origin or at odd scales, without light, without contrast.

use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};

use glam::{DMat3, DQuat, DVec3};
use ign_bake::bake;
use ign_bundle::Bundle;

use crate::{capture, job, recipe};

/// Few references, few views, black and saturated photographs: every figure stays finite.
#[test]
fn hard_captures_bake_with_finite_figures() {
    let dir = tempfile::tempdir().expect("a folder");
    for (name, fill) in [("black", Some(0u8)), ("white", Some(255)), ("few", None)] {
        let folder = dir.path().join(name);
        std::fs::create_dir(&folder).expect("a folder");
        let capture = capture(&folder, 0.5);
        if let Some(value) = fill {
            for entry in std::fs::read_dir(capture.join("images")).expect("images") {
                let path = entry.expect("an entry").path();
                let mut image = image::open(&path).expect("an image").into_rgb8();
                image.pixels_mut().for_each(|pixel| pixel.0 = [value; 3]);
                image.save(&path).expect("written");
            }
        }
        let recipe = recipe(&[
            ("references", if name == "few" { "2" } else { "6" }),
            ("effects", "on"),
        ]);
        let bundle = bake(&job(&capture, &folder.join("work"), recipe), &|_| {}).expect("a bake");
        let metrics = Bundle::open(&bundle)
            .expect("it verifies")
            .metrics()
            .expect("metrics")
            .expect("there");
        for row in &metrics.methods {
            assert!(
                row.mse.is_finite() && row.mse_object.is_finite() && row.psnr.is_finite(),
                "{name}: {}",
                row.name
            );
        }
    }
}

/// A copy of `capture` whose world is `p * scale + offset`, as a georeferenced scan has it: coordinates with all
/// their digits, in a mesh of f64.
fn placed(capture: &Path, out: &Path, scale: f64, offset: DVec3) -> PathBuf {
    let sparse = out.join("sparse/0");
    fs::create_dir_all(&sparse).expect("a folder");
    for folder in ["images", "masks"] {
        fs::create_dir(out.join(folder)).expect("a folder");
        for entry in fs::read_dir(capture.join(folder)).expect("a folder") {
            let entry = entry.expect("an entry");
            fs::copy(entry.path(), out.join(folder).join(entry.file_name())).expect("a copy");
        }
    }
    fs::copy(capture.join("test.txt"), out.join("test.txt")).expect("a copy");
    fs::copy(
        capture.join("sparse/0/cameras.txt"),
        sparse.join("cameras.txt"),
    )
    .expect("a copy");

    let images = fs::read_to_string(capture.join("sparse/0/images.txt")).expect("images");
    let mut moved = String::new();
    for line in images.lines() {
        let words: Vec<&str> = line.split_whitespace().collect();
        if words.len() == 10 && words[9].contains('.') && !line.starts_with('#') {
            let at = |i: usize| words[i].parse::<f64>().expect("a number");
            let rotation =
                DMat3::from_quat(DQuat::from_xyzw(at(2), at(3), at(4), at(1)).normalize());
            let t = DVec3::new(at(5), at(6), at(7)) * scale - rotation * offset;
            writeln!(
                moved,
                "{} {} {} {} {} {:?} {:?} {:?} {} {}\n",
                words[0], words[1], words[2], words[3], words[4], t.x, t.y, t.z, words[8], words[9]
            )
            .expect("a line");
        }
    }
    fs::write(sparse.join("images.txt"), moved).expect("written");
    fs::write(sparse.join("points3D.txt"), "").expect("written");

    let mesh = ign_geometry::read_mesh(&capture.join("mesh.ply")).expect("a mesh");
    let mut ply = format!(
        "ply\nformat ascii 1.0\nelement vertex {}\nproperty double x\nproperty double y\nproperty double z\n\
         property double nx\nproperty double ny\nproperty double nz\nelement face {}\n\
         property list uchar int vertex_indices\nend_header\n",
        mesh.positions.len(),
        mesh.triangles.len()
    );
    for (p, n) in mesh.positions.iter().zip(&mesh.normals) {
        let p = *p * scale + offset;
        writeln!(
            ply,
            "{:?} {:?} {:?} {:?} {:?} {:?}",
            p.x, p.y, p.z, n.x, n.y, n.z
        )
        .expect("a line");
    }
    for [a, b, c] in &mesh.triangles {
        writeln!(ply, "3 {a} {b} {c}").expect("a line");
    }
    fs::write(out.join("mesh.ply"), ply).expect("written");
    out.to_owned()
}

/// The held-out renderings of a bundle, by file name.
fn renderings(bundle: &Path) -> Vec<(PathBuf, image::RgbImage)> {
    let mut files: Vec<PathBuf> = fs::read_dir(bundle.join("held_out"))
        .expect("held-out images")
        .map(|entry| entry.expect("an entry").path())
        .filter(|path| path.extension().is_some_and(|e| e == "png"))
        .collect();
    files.sort();
    files
        .into_iter()
        .map(|path| {
            let image = image::open(&path).expect("an image").into_rgb8();
            (path.file_name().expect("a name").into(), image)
        })
        .collect()
}

/// Where a capture lies and how large its unit is changes nothing: the same images within 1/255.
#[test]
fn georeferenced_and_odd_scales_give_the_same_images() {
    let dir = tempfile::tempdir().expect("a folder");
    let original = capture(dir.path(), 0.8);
    let bake_at = |name: &str, scale: f64, offset: DVec3| {
        let folder = dir.path().join(name);
        let placed = placed(&original, &folder.join("capture"), scale, offset);
        let recipe = recipe(&[("effects", "on")]);
        renderings(&bake(&job(&placed, &folder.join("work"), recipe), &|_| {}).expect("a bake"))
    };
    let expected = bake_at("recentred", 1.0, DVec3::ZERO);
    assert!(expected.len() >= 2);
    for (name, scale, offset) in [
        ("millions", 1.0, DVec3::new(4.5e5, 5.2e6, 1.1e6)),
        ("tens of millions", 1.0, DVec3::new(-1.7e7, 1.0e7, 3.0e6)),
        ("tiny", 1e-4, DVec3::new(3e-4, 0.0, -1e-4)),
        ("huge", 1e4, DVec3::new(0.0, 2e4, 5e3)),
    ] {
        let found = bake_at(name, scale, offset);
        assert_eq!(found.len(), expected.len(), "{name}");
        for ((file, image), (other_file, other)) in found.iter().zip(&expected) {
            assert_eq!(file, other_file, "{name}");
            let worst = image
                .iter()
                .zip(other.iter())
                .map(|(a, b)| a.abs_diff(*b))
                .max();
            assert!(
                worst <= Some(1),
                "{name}, {}: differs by {worst:?} of 255",
                file.display()
            );
        }
    }
}
