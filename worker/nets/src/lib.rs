//! The networks of Image-guided Neural Object Rendering on torch: `EffectsNet`, `CompositionNet` and `PatchGAN` of
//! the paper, the networks of preset `standard`, the differentiable cross-projection, losses and the optimiser.
//!
//! Everything here is a function of explicit parameters: a network registers its tensors with a
//! [`params::Builder`], the resulting [`params::Params`] owns one flat buffer, and `forward` reads from it. That
//! keeps the optimiser one fused pass, checkpoints one file, and a bundle's weights plain data.

pub mod color;
pub mod composition;
pub mod device;
pub mod effects;
pub mod losses;
mod muon;
pub mod optim;
pub mod params;
pub mod patchgan;
pub mod steps;
pub mod unet;
pub mod warp;

pub use device::select as select_device;
pub use params::{Builder, NetError, ParamId, Params};
