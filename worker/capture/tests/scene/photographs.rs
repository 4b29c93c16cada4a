//! Damaged, turned and oddly coloured photographs, and what masks mean.

use std::fs;
use std::path::PathBuf;

use crate::common::{Capture, HEIGHT, VIEWS, WIDTH, errors};
use ign_capture::{Background, Fault, Frame, ViewImage};

/// A picture written by another program, see `tests/reference/make_photos.py`.
fn reference(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
        .join("tests/reference/photos")
        .join(name)
}

/// A capture in which two photographs of 40x24 pixels and a camera of that size are among the others.
fn capture_with(file: &str, camera: &str) -> Capture {
    let capture = Capture::sound();
    let text = fs::read_to_string(capture.path("sparse/0/images.txt")).expect("the images");
    let text = text
        .lines()
        .map(|line| match line.strip_suffix(" 1 img 3.png") {
            Some(pose) => format!("{pose} 2 img 3.png"),
            None => line.to_owned(),
        })
        .collect::<Vec<_>>();
    capture.write("sparse/0/images.txt", &(text.join("\n") + "\n"));
    let cameras = fs::read_to_string(capture.path("sparse/0/cameras.txt")).expect("the cameras");
    capture.write("sparse/0/cameras.txt", &format!("{cameras}{camera}\n"));
    fs::copy(reference(file), capture.path("images/img 3.png")).expect("a photograph");
    capture
}

const SMALL: &str = "2 PINHOLE 40 24 45 45 20 12";

fn only_error(faults: &[Fault]) -> (&str, &str) {
    let errors = errors(faults);
    assert_eq!(errors.len(), 1, "{errors:#?}");
    errors[0]
}

#[test]
fn a_turned_photograph_is_explained_and_never_turned() {
    // The tag says 6; the camera has the size of the pixels as they are stored.
    let capture = capture_with("turned.jpg", SMALL);
    let scene = capture.import();
    assert!(scene.warnings.is_empty(), "{:?}", scene.warnings);
    let image = scene.load_view(3, &scene.views[3].camera).expect("a view");
    let expected = fs::read(reference("turned.jpg.srgb")).expect("its pixels");
    for (value, expected) in image.rgb.iter().zip(expected.chunks_exact(2)) {
        let expected = f32::from(u16::from_le_bytes([expected[0], expected[1]])) / 65535.0;
        assert!((value - expected).abs() < 3.0 / 255.0);
    }
    // The camera has the size of the turned picture.
    let faults = capture_with("turned.jpg", "2 PINHOLE 24 40 45 45 12 20").faults();
    let (at, message) = only_error(&faults);
    assert_eq!(at, "images/img 3.png");
    assert!(
        message.contains("40x24") && message.contains("its orientation tag is 6"),
        "{message}"
    );
}

#[test]
fn what_would_be_misread_is_refused_with_a_fix() {
    for (file, expected) in [
        ("cmyk.jpg", "CMYK"),
        ("cmyk.tiff", "CMYK"),
        ("cicp_pq.png", "high dynamic range"),
    ] {
        let faults = capture_with(file, SMALL).faults();
        let (at, message) = only_error(&faults);
        assert_eq!(at, "images/img 3.png");
        assert!(message.contains(expected), "{message}");
        assert!(faults[0].hint.contains("RGB"), "{}", faults[0].hint);
    }
    // Adobe RGB by its Exif tags alone is converted, and said.
    let scene = capture_with("adobe_exif.jpg", SMALL).import();
    let warnings: Vec<&str> = scene.warnings.iter().map(|w| w.message.as_str()).collect();
    assert_eq!(warnings.len(), 1, "{warnings:?}");
    assert!(warnings[0].contains("Adobe RGB by their Exif tags"));
}

#[test]
fn files_cut_short_are_named_by_preflight() {
    for file in [
        "busy_420.jpg",
        "busy_progressive.jpg",
        "sixteen.png",
        "strips_lzw.tiff",
        "alpha.webp",
    ] {
        let capture = capture_with(
            file,
            if file.starts_with("busy") {
                "2 PINHOLE 117 83 130 130 58 41"
            } else {
                SMALL
            },
        );
        let path = capture.path("images/img 3.png");
        let bytes = fs::read(&path).expect("the picture");
        // Tags of a TIFF file stand at its end or start; its pixels are what is cut here.
        for share in [2, 3, 5] {
            fs::write(&path, &bytes[..bytes.len() * (share - 1) / share]).expect("cut short");
            let faults = capture.faults();
            let (at, message) = only_error(&faults);
            assert_eq!(at, "images/img 3.png", "{file}");
            assert!(message.contains("damaged"), "{file}: {message}");
        }
    }
}

fn object_frame(capture: &Capture) -> (Background, ViewImage) {
    let scene = capture.import();
    let camera = scene.frame_camera(0, &Frame::Whole { long_side: WIDTH }, 1);
    let image = scene.load_view(0, &camera).expect("a view");
    (scene.background, image)
}

/// Writes all photographs with an alpha channel.
fn cut_out(capture: &Capture, alpha: impl Fn(u32) -> u8) {
    for view in 0..VIEWS {
        let image =
            image::RgbaImage::from_fn(WIDTH, HEIGHT, |x, _| image::Rgba([188, 100, 50, alpha(x)]));
        let path = capture.path(&format!("images/{}", Capture::name(view)));
        image.save(path).expect("a picture");
    }
}

#[test]
fn alpha_channels_are_masks_over_black() {
    let capture = Capture::sound();
    cut_out(&capture, |x| match x {
        0..20 => 0,
        20..60 => 255,
        _ => 55,
    });
    let (background, image) = object_frame(&capture);
    assert_eq!(background, Background::Black);
    let mask = image.mask.as_ref().expect("a mask");
    let at = |x: usize| (image.rgb[3 * x], mask[x]);
    assert_eq!(at(5), (0.0, 0.0));
    assert_eq!(at(30), (188.0 / 255.0, 1.0));
    // 188 is half the light of white; 55/255 of it is 0.1087, which sRGB encodes as 0.365.
    let (color, covered) = at(70);
    assert!((covered - 55.0 / 255.0).abs() < 1e-6);
    assert!((color - 0.365).abs() < 2.5 / 255.0, "{color}");
}

#[test]
fn alpha_channels_that_hide_nothing_are_no_masks() {
    let capture = Capture::sound();
    cut_out(&capture, |_| 255);
    let scene = capture.import();
    assert_eq!(scene.background, Background::Silhouette);
    assert!(scene.views.iter().all(|view| view.mask.is_none()));
    assert!(scene.warnings[0].message.contains("hide nothing"));
    // Cut out in all but one.
    cut_out(&capture, |x| if x < 30 { 0 } else { 255 });
    capture.photograph(7, |_, _| [9, 9, 9]);
    let scene = capture.import();
    assert_eq!(scene.warnings.len(), 1);
    let message = &scene.warnings[0].message;
    assert!(
        message.starts_with("1 of 12 photographs have no alpha channel, the first is img 7.png")
    );
    assert!(scene.views[7].mask.is_none() && scene.views[6].mask.is_some());
}

#[test]
fn ignored_pixels_have_no_part_in_anything() {
    for (meaning, ignored) in [("white_is_ignored", 255), ("black_is_ignored", 0)] {
        let capture = Capture::sound();
        capture.write("capture.toml", &format!("masks = \"{meaning}\"\n"));
        // A hand in the left part of view 0, drawn in red.
        capture.photograph(0, |x, _| if x < 31 { [255, 0, 0] } else { [0, 100, 200] });
        capture.mask("img 0.png", (WIDTH, HEIGHT), |x, _| {
            if x < 31 { ignored } else { 255 - ignored }
        });
        let scene = capture.import();
        assert_eq!(scene.background, Background::Silhouette);
        assert!(
            scene.warnings[0]
                .message
                .starts_with("1 of 12 photographs have a mask of what to ignore")
        );
        let camera = scene.frame_camera(
            0,
            &Frame::Whole {
                long_side: WIDTH / 2,
            },
            1,
        );
        let image = scene.load_view(0, &camera).expect("a view");
        assert!(image.mask.is_none());
        for (at, color) in image.rgb.chunks_exact(3).enumerate() {
            let inside = match at % 40 {
                0..15 => 0.0,
                15 => 0.5,
                _ => 1.0,
            };
            assert!((image.inside[at] - inside).abs() < 1e-6, "{at}");
            let expected = if inside > 0.0 {
                [0.0, 100.0 / 255.0, 200.0 / 255.0]
            } else {
                [0.0; 3]
            };
            for (value, expected) in color.iter().zip(expected) {
                assert!((value - expected).abs() < 1e-6, "{at}: {color:?}");
            }
        }
        // Nothing is ignored in the other views.
        assert!(scene.views[1].ignored.is_none());
    }
}

#[test]
fn masks_are_found_in_sub_folders() {
    let capture = Capture::sound();
    capture.replace("sparse/0/images.txt", "img 5.png", "left/img 5.png");
    fs::create_dir_all(capture.path("images/left")).expect("a folder");
    fs::rename(
        capture.path("images/img 5.png"),
        capture.path("images/left/img 5.png"),
    )
    .expect("moved");
    fs::create_dir_all(capture.path("masks/left")).expect("a folder");
    for view in (0..VIEWS).filter(|&view| view != 5) {
        capture.mask(&format!("img {view}.png"), (WIDTH, HEIGHT), |x, _| {
            u8::from(x > 40) * 255
        });
    }
    capture.mask("left/img 5.png.png", (WIDTH, HEIGHT), |x, _| {
        u8::from(x > 40) * 255
    });
    let scene = capture.import();
    assert!(scene.views.iter().all(|view| view.mask.is_some()));
}
