//! What a bundle records about how it is rendered; stored in bundle.json under `render`.

use ign_geometry::GBuffer;
use serde::{Deserialize, Serialize};

/// Which form of the networks a bundle carries.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Recipe {
    /// The paper's networks.
    Paper,
    /// Effects per surface point and the blending head.
    Standard,
}

impl Recipe {
    /// Which normals the networks see: the paper's from finite differences, ours interpolated.
    pub(crate) fn normals(self, gbuffer: &GBuffer) -> &[[f32; 3]] {
        match self {
            Self::Paper => &gbuffer.normal_fd,
            Self::Standard => &gbuffer.normal,
        }
    }
}

/// How a pixel's covered fraction turns into the factor of its encoded colour.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CoverageRule {
    /// The fraction itself: photographs, cut out by a mask.
    Fraction,
    /// The photograph mixed the object with black in linear light, then its pixels were encoded: the encoded
    /// fraction of the whole pixel.
    EncodedPixel,
    /// As before, but several photograph pixels make one of ours: the mean of their encoded fractions.
    EncodedCells,
}

/// Everything besides weights and references that decides an image.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RenderSettings {
    /// Reference views per target view (paper: 4).
    pub k: usize,
    /// Sub-samples per pixel side at which the proxy is looked up and references are sampled.
    pub supersample: u32,
    /// How coverage enters the image.
    pub coverage: CoverageRule,
    /// Which networks.
    pub recipe: Recipe,
}

impl Default for RenderSettings {
    fn default() -> Self {
        Self {
            k: 4,
            supersample: 2,
            coverage: CoverageRule::Fraction,
            recipe: Recipe::Standard,
        }
    }
}
