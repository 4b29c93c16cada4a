//! `ign-worker render`: images of a bundle, from its files alone.

use std::num::NonZero;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use ign_geometry::Camera;
use ign_proto::FilePath;
use ign_render::BundleRenderer;

use crate::gpu;
use crate::output::{self, Steps};

#[derive(Debug, clap::Args)]
#[command(group = clap::ArgGroup::new("what").required(true))]
pub(crate) struct Options {
    /// The bundle's folder.
    bundle: PathBuf,
    /// N views on a circle around the object.
    #[arg(long, value_name = "N", group = "what")]
    orbit: Option<NonZero<u32>>,
    /// The cameras of a JSON file: a list of {name, width, height, fx, fy, cx, cy, `camera_from_world`}, the last as
    /// rows of a 3x4 or 4x4 matrix; x right, y down, z forward.
    #[arg(long, value_name = "FILE", group = "what")]
    cameras: Option<PathBuf>,
    /// The camera of a reference view or of a held-out view.
    #[arg(long, value_name = "NAME", group = "what")]
    view: Option<String>,
    /// Folder for the images, which are PNG files.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Long side of the images in pixels [default: 512 for an orbit, otherwise the camera's own].
    #[arg(long, value_name = "PX", value_parser = clap::value_parser!(u32).range(1..=16384))]
    size: Option<u32>,
    /// CPU threads [default: all cores].
    #[arg(long, env = "IGN_THREADS", value_name = "N")]
    threads: Option<NonZero<usize>>,
}

/// Side of an orbit's images.
const ORBIT_SIZE: u32 = 512;

/// A view to render.
struct View {
    name: String,
    camera: Camera,
    /// Whether `camera` is in the capture's world; otherwise in the bundle's normalised frame.
    in_world: bool,
}

pub(crate) fn run(options: &Options) -> Result<()> {
    gpu::prepare(options.threads)?;
    let renderer = BundleRenderer::open(&options.bundle, ign_nets::select_device())
        .with_context(|| format!("cannot open the bundle {}", options.bundle.display()))?;
    let views = views(options, &renderer)?;
    let mut steps = Steps::new("views rendered", views.len() as u64);
    for (done, view) in views.iter().enumerate() {
        let camera = match options.size {
            Some(size) => sized(&view.camera, size),
            None => view.camera,
        };
        let image = if view.in_world {
            renderer.render(&camera)
        } else {
            renderer.render_normalised(&camera)
        };
        let path = image_path(&options.out, &view.name)?;
        if let Some(parent) = path.parent() {
            std::fs::create_dir_all(parent)
                .with_context(|| format!("cannot create {}", parent.display()))?;
        }
        image
            .save(&path)
            .with_context(|| format!("cannot write {}", path.display()))?;
        output::data(&path.display().to_string());
        steps.set(done as u64 + 1);
    }
    steps.finish();
    Ok(())
}

fn views(options: &Options, renderer: &BundleRenderer) -> Result<Vec<View>> {
    if let Some(count) = options.orbit {
        let size = options.size.unwrap_or(ORBIT_SIZE);
        let cameras = renderer.orbit(count.get() as usize, size);
        let named = cameras.into_iter().enumerate().map(|(index, camera)| View {
            name: format!("{index:04}"),
            camera,
            in_world: false,
        });
        return Ok(named.collect());
    }
    if let Some(file) = &options.cameras {
        let named = ign_render::read_cameras(file)?
            .into_iter()
            .map(|(name, camera)| View {
                name,
                camera,
                in_world: true,
            });
        return Ok(named.collect());
    }
    let name = options.view.clone().unwrap_or_default();
    let camera = renderer.view_camera(&name)?;
    Ok(vec![View {
        name,
        camera,
        in_world: false,
    }])
}

/// The same view with a long side of `size` pixels.
fn sized(camera: &Camera, size: u32) -> Camera {
    let intrinsics = camera.intrinsics;
    let scale = f64::from(size) / f64::from(intrinsics.width.max(intrinsics.height));
    let side = |pixels: u32| ((f64::from(pixels) * scale).round() as u32).max(1);
    Camera {
        intrinsics: intrinsics.resized(side(intrinsics.width), side(intrinsics.height)),
        ..*camera
    }
}

/// `NAME.png` below `out`; an image extension of the view's own name is replaced. Names come from files that others
/// wrote, so they are checked like the paths of a bundle.
fn image_path(out: &Path, name: &str) -> Result<PathBuf> {
    let checked: FilePath = name
        .parse()
        .with_context(|| format!("view {name:?} cannot name a file"))?;
    let name = checked.as_str();
    let stem = match name.rsplit_once('.') {
        Some((stem, extension))
            if ["png", "jpg", "jpeg", "webp", "tif", "tiff"]
                .contains(&extension.to_ascii_lowercase().as_str()) =>
        {
            stem
        }
        _ => name,
    };
    Ok(out.join(format!("{stem}.png")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn images_stay_below_their_folder() {
        let path = |name| image_path(Path::new("out"), name);
        assert_eq!(path("0001").unwrap(), Path::new("out/0001.png"));
        assert_eq!(
            path("cam0/DSC 1.JPG").unwrap(),
            Path::new("out/cam0/DSC 1.png")
        );
        assert_eq!(path("v1.2").unwrap(), Path::new("out/v1.2.png"));
        for name in ["../x", "/etc/x", ""] {
            assert!(path(name).is_err(), "{name}");
        }
    }
}
