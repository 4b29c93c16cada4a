//! Scenes for the tests of every crate that draws or warps: hard cases by name, random ones by seed, and a plain f64
//! ray caster to judge them by.
//!
//! - [`hard`]: one object and the cameras, meshes and images of the hard-case table in `tests/README.md`. Tests of
//!   geometry, of the tensor warp and of rendering take the same ones, so that a case is written down once.
//! - [`random`]: endless scenes, damaged and extreme ones among them, each fully given by a seed and its number.
//! - [`oracle`]: every ray against every triangle, from the definitions, sharing nothing with `ign-geometry` but its
//!   data types.
//! - [`check`]: what must hold of any G-buffer and warp, whatever the scene.

pub mod check;
pub mod hard;
pub mod oracle;
pub mod random;
