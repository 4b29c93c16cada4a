//! Generated captures are imported by ign-capture and judged by ign-geometry: neither shares code with the renderer.

use std::fs;
use std::path::{Path, PathBuf};

use ign_capture::{Background, Frame, ImportOptions, Scene, import};
use ign_demo::{DemoError, DemoOptions, Shape, generate};
use ign_geometry::{NO_TRIANGLE, rasterize};

fn options() -> DemoOptions {
    DemoOptions {
        size: 72,
        views: 10,
        held_out: Some(3),
        ..DemoOptions::default()
    }
}

fn generated(options: &DemoOptions) -> (tempfile::TempDir, PathBuf) {
    let dir = tempfile::tempdir().expect("a scratch folder");
    let out = dir.path().join("deep/demo");
    let summary = generate(&out, options, &|_, _| {}).expect("a capture");
    assert_eq!(summary.dir, out);
    (dir, out)
}

fn imported(out: &Path) -> Scene {
    import(out, &ImportOptions::default()).expect("no faults")
}

/// The values of a .npy file as this crate writes it.
fn npy(path: &Path) -> Vec<f32> {
    let bytes = fs::read(path).expect("the file");
    let start = 10 + u16::from_le_bytes([bytes[8], bytes[9]]) as usize;
    assert_eq!(start % 64, 0);
    bytes[start..]
        .chunks_exact(4)
        .map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]))
        .collect()
}

#[test]
fn captures_of_all_shapes_are_imported_without_any_fault() {
    for shape in Shape::ALL {
        let (_keep, out) = generated(&DemoOptions {
            shape,
            size: 32,
            ..options()
        });
        let scene = imported(&out);
        assert!(scene.warnings.is_empty(), "{:?}", scene.warnings);
        assert_eq!((scene.train.len(), scene.held_out.len()), (7, 3));
        assert_eq!(scene.background, Background::Black);
        assert_eq!(scene.name, format!("demo/{}", shape.name()));
        // As fine as pictures of 32 px show.
        assert!((4_000..7_000).contains(&scene.mesh.triangles.len()));
        assert!(scene.mesh.colors.is_some());
        // Observations are exact, and of training views only.
        assert!(scene.points.len() > 300);
        for point in &scene.points {
            assert!(
                !point.views.is_empty()
                    && point.views.iter().all(|view| scene.train.contains(view))
            );
        }
    }
}

#[test]
fn true_depth_agrees_with_the_rasterised_mesh() {
    let (_keep, out) = generated(&options());
    let scene = imported(&out);
    let (mut compared, mut only_one) = (0, 0);
    for &view in &scene.held_out {
        let stem = scene.views[view].name.strip_suffix(".png").expect("a PNG");
        let depth = npy(&out.join(format!("truth/depth/{stem}.npy")));
        let raster = rasterize(&scene.mesh, &scene.views[view].camera);
        assert_eq!(depth.len(), raster.depth.len());
        for (i, &truth) in depth.iter().enumerate() {
            match (truth > 0.0, raster.triangle[i] != NO_TRIANGLE) {
                (true, true) => {
                    // Same triangles, same pixel centres: what is left is f32 and the pose's text form.
                    assert!(
                        (truth - raster.depth[i]).abs() < 1e-5 * truth,
                        "{truth} {}",
                        raster.depth[i]
                    );
                    compared += 1;
                }
                (false, false) => {}
                _ => only_one += 1,
            }
        }
    }
    assert!(compared > 1000, "{compared} pixels compared");
    // A centre within rounding of a silhouette may fall to either side.
    assert!(
        only_one <= 2,
        "{only_one} pixels hit by one of the two alone"
    );
}

#[test]
fn masks_are_the_coverage_of_the_rasterised_mesh() {
    let (_keep, out) = generated(&options());
    let scene = imported(&out);
    let frame = Frame::Whole { long_side: 72 };
    let camera = scene.frame_camera(0, &frame, 1);
    let image = scene.load_view(0, &camera).expect("a view");
    let mask = image.mask.expect("a mask");
    let fine = camera.with_intrinsics(camera.intrinsics.resized(288, 288));
    let raster = rasterize(&scene.mesh, &fine);
    let mut partial = 0;
    for y in 0..72 {
        for x in 0..72 {
            let hit =
                |i: usize| raster.triangle[(y * 4 + i / 4) * 288 + x * 4 + i % 4] != NO_TRIANGLE;
            let covered = (0..16).filter(|&i| hit(i)).count() as f32 / 16.0;
            let found = mask[y * 72 + x];
            // One sub-sample within rounding of the edge, and 8 bits.
            assert!(
                (covered - found).abs() < 1.5 / 16.0,
                "({x}, {y}): {covered} {found}"
            );
            partial += usize::from(found > 0.0 && found < 1.0);
            if found == 0.0 {
                assert_eq!(image.rgb[(y * 72 + x) * 3..][..3], [0.0; 3]);
            }
        }
    }
    assert!(partial > 50);
}

#[test]
fn highlights_only_add_light_and_matte_objects_have_none() {
    let pictures = |gloss: f64| {
        let (keep, out) = generated(&DemoOptions { gloss, ..options() });
        let read = |path: PathBuf| image::open(path).expect("an image").into_rgb8().into_raw();
        let names: Vec<String> = fs::read_to_string(out.join("test.txt"))
            .expect("names")
            .lines()
            .map(str::to_owned)
            .collect();
        let image: Vec<u8> = names
            .iter()
            .flat_map(|name| read(out.join("images").join(name)))
            .collect();
        let diffuse: Vec<u8> = names
            .iter()
            .flat_map(|name| read(out.join("truth/diffuse").join(name)))
            .collect();
        drop(keep);
        (image, diffuse)
    };
    let (image, diffuse) = pictures(0.0);
    assert_eq!(image, diffuse);
    let (image, glossy_diffuse) = pictures(0.8);
    assert_eq!(
        diffuse, glossy_diffuse,
        "gloss changes the highlights alone"
    );
    assert!(
        image
            .iter()
            .zip(&diffuse)
            .all(|(image, diffuse)| image >= diffuse)
    );
    let bright = image
        .iter()
        .zip(&diffuse)
        .filter(|(image, diffuse)| image.saturating_sub(**diffuse) > 60)
        .count();
    assert!(bright > 60, "{bright} values in highlights");
}

#[test]
fn the_same_options_give_the_same_files_and_another_seed_others() {
    let options = DemoOptions {
        size: 24,
        views: 4,
        held_out: Some(1),
        ..DemoOptions::default()
    };
    let (_keep_a, a) = generated(&options);
    let (_keep_b, b) = generated(&options);
    let (_keep_c, c) = generated(&DemoOptions { seed: 1, ..options });
    for name in [
        "mesh.ply",
        "test.txt",
        "capture.toml",
        "sparse/0/images.txt",
        "sparse/0/points3D.txt",
        "images/view_0001.png",
    ] {
        let read = |dir: &Path| fs::read(dir.join(name)).expect("the file");
        assert_eq!(read(&a), read(&b), "{name}");
        if name != "test.txt" {
            assert_ne!(read(&a), read(&c), "{name}");
        }
    }
}

#[test]
fn occupied_folders_and_bad_options_are_refused() {
    let dir = tempfile::tempdir().expect("a scratch folder");
    let out = dir.path().join("demo");
    fs::create_dir(&out).expect("a folder");
    fs::write(out.join("mine.txt"), "keep").expect("a file");
    let result = generate(&out, &options(), &|_, _| {});
    assert!(matches!(result, Err(DemoError::Occupied { .. })));
    assert_eq!(
        fs::read_dir(dir.path()).expect("the folder").count(),
        1,
        "nothing is left beside it"
    );

    let bad = [
        DemoOptions {
            size: 8,
            ..options()
        },
        DemoOptions {
            gloss: f64::NAN,
            ..options()
        },
        DemoOptions {
            views: 2,
            ..options()
        },
        DemoOptions {
            held_out: Some(9),
            ..options()
        },
        DemoOptions {
            misregistration: f64::NAN,
            ..options()
        },
    ];
    for options in bad {
        let result = generate(&dir.path().join("other"), &options, &|_, _| {});
        assert!(
            matches!(result, Err(DemoError::Option { .. })),
            "{options:?}"
        );
    }
    // An empty folder is fine, and progress ends with all views.
    fs::remove_file(out.join("mine.txt")).expect("removed");
    let last = std::cell::Cell::new((0, 0));
    generate(
        &out,
        &DemoOptions {
            size: 16,
            ..options()
        },
        &|done, total| last.set((done, total)),
    )
    .expect("a capture");
    assert_eq!(last.get(), (10, 10));
}

#[test]
fn an_orbit_is_held_out_beside_the_views() {
    let (_keep, out) = generated(&DemoOptions {
        size: 24,
        views: 4,
        held_out: None,
        orbit: Some(3),
        ..DemoOptions::default()
    });
    let held_out = fs::read_to_string(out.join("test.txt")).expect("a list");
    let names: Vec<&str> = held_out.lines().collect();
    assert_eq!(
        names,
        ["orbit_0000.png", "orbit_0001.png", "orbit_0002.png"]
    );
    let images = fs::read_dir(out.join("images")).expect("images").count();
    assert_eq!(images, 7);
    let pair = DemoOptions {
        orbit: Some(3),
        held_out: Some(2),
        ..DemoOptions::default()
    };
    let folder = tempfile::tempdir().expect("a folder");
    assert!(generate(&folder.path().join("x"), &pair, &|_, _| {}).is_err());
}

#[test]
fn proxy_and_poses_are_off_by_as_much_as_asked_and_the_photographs_are_the_same() {
    let options = DemoOptions {
        held_out: Some(1),
        views: 24,
        ..options()
    };
    let wanted = 2.0;
    let (_keep_exact, exact) = generated(&options);
    let (_keep_off, off) = generated(&DemoOptions {
        misregistration: wanted,
        ..options
    });
    for name in ["images/view_0003.png", "masks/view_0003.png"] {
        let read = |dir: &Path| fs::read(dir.join(name)).expect("the file");
        assert_eq!(read(&exact), read(&off), "{name}");
    }
    let (exact, off) = (imported(&exact), imported(&off));
    let rms = |values: &[f64]| {
        (values.iter().map(|it| it * it).sum::<f64>() / values.len() as f64).sqrt()
    };
    // Turned by a half of it about each of two axes across the view.
    let camera = &exact.views[0].camera;
    let middle = camera.center() + camera.world_from_camera().matrix3.z_axis * 4.0;
    let pixel = 4.0 / camera.intrinsics.fx;
    let shifts: Vec<f64> = exact
        .views
        .iter()
        .zip(&off.views)
        .map(|(exact, off)| {
            let at = |camera: &ign_geometry::Camera| camera.project(middle).expect("in front").px;
            at(&exact.camera).distance(at(&off.camera))
        })
        .collect();
    let across = 2f64.sqrt() * wanted / 2.0;
    let found = rms(&shifts);
    assert!(
        (found / across - 1.0).abs() < 0.3,
        "{found} px for {across}"
    );
    let dents: Vec<f64> = exact
        .mesh
        .positions
        .iter()
        .zip(&off.mesh.positions)
        .map(|(exact, off)| exact.distance(*off) / pixel)
        .collect();
    let found = rms(&dents);
    assert!(
        (found / wanted - 1.0).abs() < 0.3,
        "{found} px for {wanted}"
    );
}
