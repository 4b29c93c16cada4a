//! Cameras, meshes, rasteriser, G-buffers, cross-projection and coverage, in f64.
//!
//! Everything here runs on the CPU and knows nothing of networks: it turns a proxy mesh and a camera into the maps
//! that the networks read ([`GBuffer`]), moves one view's image into another ([`cross_project`]), and chooses which
//! views to use ([`select`]). It is also the judge of the f32 tensor code.
//!
//! Conventions (DESIGN section 8): camera axes x right, y down, z forward; pixels are continuous with the origin at
//! the top-left corner and centres at +0.5; depth is camera z; validity is a mask, never a magic depth.

mod camera;
mod coverage;
mod drawable;
mod formats;
mod gbuffer;
mod mesh;
mod neighbours;
mod raster;
pub mod select;
pub mod silhouette;
pub mod simplify;
mod surface;
mod warp;

pub use camera::{Camera, CameraError, CameraIntrinsics, Projection, Similarity};
pub use coverage::coverage_map;
pub use drawable::Drawable;
pub use formats::{OpenBeside, parse_mesh, parse_points, read_mesh};
pub use gbuffer::GBuffer;
pub use mesh::{Mesh, MeshError};
pub use raster::{NO_TRIANGLE, Raster, barycentric, rasterize};
pub use surface::{PointSurface, PointView, SeenPoint, SurfaceError, surface_from_points};
pub use warp::{Seen, WarpOptions, Warped, cross_project};
