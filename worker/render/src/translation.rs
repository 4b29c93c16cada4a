//! Image-to-image translation: a map of the proxy in, the image out (paper, Appendix "Comparison to Learned Image
//! Synthesis"). The network sees no photograph when it renders; it must remember the object.

use ign_nets::Params;
use ign_nets::composition::PaperComposition;
use tch::{Kind, Tensor, no_grad};

use crate::model::composite;
use crate::target::Target;

/// Which map is translated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TranslationInput {
    /// Position of the surface in the normalised frame; it says where on the object a pixel lies.
    Position,
    /// Camera z of the surface, which does not say from where one looks.
    Depth,
}

impl TranslationInput {
    /// Channels of the map.
    pub fn channels(self) -> i64 {
        match self {
            Self::Position => 3,
            Self::Depth => 1,
        }
    }

    /// [1, C, H, W]: the map of a target, in units of the object's radius; 0 where there is no surface.
    pub fn of(self, target: &Target) -> Tensor {
        let position = target.geometry.narrow(1, 0, 3);
        match self {
            Self::Position => position,
            Self::Depth => {
                let pose = target.camera.camera_from_world;
                let forward = pose.matrix3.row(2).as_vec3().to_array();
                let forward = Tensor::from_slice(&forward)
                    .view([1, 3, 1, 1])
                    .to_device(position.device());
                let z = (position * forward).sum_dim_intlist([1i64].as_slice(), true, Kind::Float)
                    + pose.translation.z;
                let (h, w) = target.size();
                let surface = target.total.gt(0.0).view([1, 1, h, w]);
                z * surface.to_kind(Kind::Float)
            }
        }
    }
}

/// A trained translator: the paper's generator.
#[derive(Debug)]
pub struct Translation {
    /// What it translates.
    pub input: TranslationInput,
    /// The network.
    pub net: PaperComposition,
    /// Its weights.
    pub params: Params,
}

impl Translation {
    /// [1, 3, H, W] in [0, 1]: the image over black, encoded sRGB.
    pub fn image(&self, target: &Target) -> Tensor {
        no_grad(|| {
            let color = self
                .net
                .forward(&self.params, &self.input.of(target), false);
            composite(&color, target)
        })
    }
}
