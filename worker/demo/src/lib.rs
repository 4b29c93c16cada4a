//! Demo captures: a painted, glossy surface of revolution, ray-traced into a COLMAP workspace with ground truth.
//!
//! The capture is what a museum would deliver in the best case: exact poses, masks, a proxy that is the rendered
//! surface itself. Beside it lies what no photograph can tell, for the held-out views: the diffuse part of the image
//! and the depth. So the demo bake can be run without any download, and tests can judge against the truth.
//!
//! ```text
//! images/*.png       8-bit sRGB on black; the colour is multiplied by the coverage in linear light
//! masks/*.png        coverage
//! sparse/0/*.txt     COLMAP model, PINHOLE, principal point off centre
//! mesh.ply           the very triangles that were traced, with normals and vertex colours
//! test.txt           held-out views
//! capture.toml
//! truth/diffuse/NAME.png, truth/depth/NAME.npy   of the held-out views
//! ```
//!
//! Paths: `shape` makes the triangles, `paint` their colour, `trace` finds what a ray hits, `light` shades it,
//! `path` places the cameras, `render` makes one view, `reconstruction` puts proxy and poses a little off, `write` puts
//! it on disk.

mod light;
mod paint;
mod path;
mod reconstruction;
mod render;
mod shape;
mod trace;
mod write;

use std::fs;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use light::{Gloss, Lighting};
use paint::Paint;
use shape::Surface;
use trace::Tracer;

/// What is on the pedestal.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Shape {
    /// A tall terracotta vase with black and cream painting.
    #[default]
    Vase,
    /// A wide blue-and-white bowl whose inside is painted as well.
    Bowl,
    /// A ball of lattice enamel: convex, so that nothing is hidden behind itself.
    Sphere,
}

impl Shape {
    /// All shapes.
    pub const ALL: [Self; 3] = [Self::Vase, Self::Bowl, Self::Sphere];

    /// Its name on command lines.
    pub fn name(self) -> &'static str {
        match self {
            Self::Vase => "vase",
            Self::Bowl => "bowl",
            Self::Sphere => "sphere",
        }
    }
}

impl FromStr for Shape {
    type Err = DemoError;

    fn from_str(name: &str) -> Result<Self, DemoError> {
        let found = Self::ALL.into_iter().find(|shape| shape.name() == name);
        found.ok_or_else(|| DemoError::Option {
            reason: format!("unknown shape {name:?}: vase, bowl or sphere"),
        })
    }
}

/// What to generate.
#[derive(Debug, Clone, PartialEq)]
pub struct DemoOptions {
    /// The object.
    pub shape: Shape,
    /// 0: matte, no highlights at all; 1: a fresh glaze.
    pub gloss: f64,
    /// Width and height of the images in pixels.
    pub size: u32,
    /// Number of views, the held-out ones included.
    pub views: usize,
    /// How many of them are held out; an eighth of them when `None`.
    pub held_out: Option<usize>,
    /// Holds out so many frames of one round about the object, beside the views, in place of some of the views.
    pub orbit: Option<usize>,
    /// Varies the painting and the camera path.
    pub seed: u64,
    /// The object turns in front of the lamps and the camera moves only up, down and nearer: seen from the object, the
    /// lamps go round with the camera. Constant light, which every method here assumes, is then broken.
    pub turntable: bool,
    /// How far the proxy that is delivered is from the surface that was traced, as the standard deviation of dents and
    /// bulges in widths of a pixel; its poses are off by half as many pixels. 0: exact.
    pub misregistration: f64,
}

impl Default for DemoOptions {
    fn default() -> Self {
        Self {
            shape: Shape::Vase,
            gloss: 0.75,
            size: 160,
            views: 96,
            held_out: None,
            orbit: None,
            seed: 0,
            turntable: false,
            misregistration: 0.0,
        }
    }
}

/// Limits that keep a mistyped option from filling the disk.
const LARGEST_SIZE: u32 = 4096;
const MOST_VIEWS: usize = 10_000;
/// Pixels; with more of it proxies fold over.
const MOST_MISREGISTRATION: f64 = 8.0;

impl DemoOptions {
    /// Views of the spiral that are held out.
    fn held_out_count(&self) -> usize {
        match self.orbit {
            Some(_) => 0,
            None => self.held_out.unwrap_or((self.views / 8).max(1)),
        }
    }

    fn check(&self) -> Result<(), DemoError> {
        let refuse = |reason: String| Err(DemoError::Option { reason });
        if !(16..=LARGEST_SIZE).contains(&self.size) {
            return refuse(format!(
                "size is {}, expected 16 to {LARGEST_SIZE} pixels",
                self.size
            ));
        }
        if !(0.0..=1.0).contains(&self.gloss) {
            return refuse(format!("gloss is {}, expected 0 to 1", self.gloss));
        }
        if !(3..=MOST_VIEWS).contains(&self.views) {
            return refuse(format!(
                "views is {}, expected 3 to {MOST_VIEWS}",
                self.views
            ));
        }
        if !(0.0..=MOST_MISREGISTRATION).contains(&self.misregistration) {
            return refuse(format!(
                "misregistration is {}, expected 0 to {MOST_MISREGISTRATION} pixels",
                self.misregistration
            ));
        }
        if let Some(frames) = self.orbit {
            if !(2..=MOST_VIEWS).contains(&frames) {
                return refuse(format!(
                    "orbit is {frames}, expected 2 to {MOST_VIEWS} frames"
                ));
            }
            if self.held_out.is_some() || self.turntable {
                return refuse("an orbit is held out by itself, under constant light".into());
            }
        }
        if self.held_out_count() + 2 > self.views {
            return refuse(format!(
                "{} of {} views held out leaves fewer than 2 for training",
                self.held_out_count(),
                self.views
            ));
        }
        Ok(())
    }
}

/// What was generated.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DemoSummary {
    /// The capture folder.
    pub dir: PathBuf,
    /// Training views.
    pub train: usize,
    /// Held-out views.
    pub held_out: usize,
    /// Triangles of the mesh.
    pub triangles: usize,
}

/// Why no capture was generated.
#[derive(Debug, thiserror::Error)]
pub enum DemoError {
    /// An option out of range.
    #[error("{reason}")]
    Option {
        /// Which, and what is expected.
        reason: String,
    },
    /// Something is there already.
    #[error("{} exists and is not an empty folder", path.display())]
    Occupied {
        /// The wanted capture folder.
        path: PathBuf,
    },
    /// A file or folder that cannot be written.
    #[error("cannot write {}", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the system says.
        #[source]
        source: std::io::Error,
    },
    /// An image that cannot be encoded or written.
    #[error("cannot write image {}", path.display())]
    Image {
        /// The file.
        path: PathBuf,
        /// What the encoder says.
        #[source]
        source: image::ImageError,
    },
    /// A proxy that cannot be displaced.
    #[error("cannot displace the proxy")]
    Proxy {
        /// Why.
        #[source]
        source: ign_geometry::MeshError,
    },
    /// A camera that cannot be placed.
    #[error("cannot place camera {view}")]
    Camera {
        /// Index of the view.
        view: usize,
        /// Why.
        #[source]
        source: ign_geometry::CameraError,
    },
}

/// Generates a capture in `out`, which must not exist or be empty. The same options give the same files.
///
/// `progress` is told how many of the views are done, from the calling thread. All files are written to a folder
/// beside `out` which takes its name at the very end, so that `out` is complete or absent.
///
/// # Errors
/// [`DemoError`]: an option out of range, `out` occupied, or a write that failed.
pub fn generate(
    out: &Path,
    options: &DemoOptions,
    progress: &dyn Fn(usize, usize),
) -> Result<DemoSummary, DemoError> {
    options.check()?;
    let staging = Staging::beside(out)?;

    let surface = Surface::new(options.shape, options.size);
    let paint = Paint::new(options.shape, options.seed);
    let tracer = Tracer::new(&surface);
    let lighting = Lighting::bake(&surface, &tracer);
    let mut views = path::spiral(options, surface.center)?;
    views.extend(path::orbit(options, surface.center)?);

    write::folders(&staging.dir)?;
    let colors = write::vertex_colors(&surface, &paint, &lighting);
    write::lists(&staging.dir, &views, options)?;
    let renderer = render::Renderer {
        surface: &surface,
        paint: &paint,
        tracer: &tracer,
        lighting: &lighting,
        gloss: Gloss::new(options.gloss),
        turntable: options.turntable,
    };
    progress(0, views.len());
    for (done, view) in views.iter().enumerate() {
        write::view(&staging.dir, view, &renderer.render(&view.camera))?;
        progress(done + 1, views.len());
    }

    let seen = write::observations(&views, &surface, &tracer);
    let cameras = reconstruction::cameras(&views, options);
    let proxy = reconstruction::proxy(surface, options)?;
    write::mesh(&staging.dir, &proxy, &colors)?;
    write::model(&staging.dir, (&views, &cameras), &seen, &proxy, &colors)?;

    let held_out = views.iter().filter(|view| view.held_out).count();
    staging.publish(out)?;
    Ok(DemoSummary {
        dir: out.to_owned(),
        train: views.len() - held_out,
        held_out,
        triangles: proxy.triangles.len(),
    })
}

/// The unfinished capture; removed when dropped before it was published.
struct Staging {
    dir: PathBuf,
}

impl Staging {
    fn beside(out: &Path) -> Result<Self, DemoError> {
        let io = |path: &Path| {
            let path = path.to_owned();
            move |source| DemoError::Io { path, source }
        };
        let name = out.file_name().ok_or_else(|| DemoError::Option {
            reason: format!("{} is no name for a folder", out.display()),
        })?;
        let occupied = match fs::read_dir(out) {
            Ok(mut entries) => entries.next().is_some(),
            Err(error) => error.kind() != std::io::ErrorKind::NotFound,
        };
        if occupied {
            return Err(DemoError::Occupied {
                path: out.to_owned(),
            });
        }
        let parent = match out.parent() {
            Some(parent) if !parent.as_os_str().is_empty() => parent,
            _ => Path::new("."),
        };
        fs::create_dir_all(parent).map_err(io(parent))?;
        let dir = parent.join(format!(
            ".{}.partial-{}",
            name.to_string_lossy(),
            std::process::id()
        ));
        fs::create_dir(&dir).map_err(io(&dir))?;
        Ok(Self { dir })
    }

    fn publish(self, out: &Path) -> Result<(), DemoError> {
        fs::rename(&self.dir, out).map_err(|source| DemoError::Io {
            path: out.to_owned(),
            source,
        })
    }
}

impl Drop for Staging {
    fn drop(&mut self) {
        // After publishing there is nothing left under this name; a leftover does no harm.
        drop(fs::remove_dir_all(&self.dir));
    }
}
