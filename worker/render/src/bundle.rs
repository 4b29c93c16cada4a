//! Rendering from a bundle's files alone.
//!
//! The networks are built from the bundle's manifest and weights; depth of the reference views is rasterised from the
//! proxy. What comes out is what evaluation scored: both run the same [`Model`].

use std::f64::consts::TAU;
use std::path::Path;

use glam::DVec3;
use ign_bundle::manifest::{Layer, NetworkInput};
use ign_bundle::{Bundle, BundleError, NetworkDescription, Precision, Tensors};
use ign_geometry::{Camera, CameraIntrinsics, Drawable, Similarity};
use ign_nets::composition::{BLEND_WIDTH, BLEND_WIDTHS, BlendComposition, PaperComposition};
use ign_nets::effects::{PaperEffects, PointEffects};
use ign_nets::{Builder, NetError, Params};
use image::RgbImage;
use tch::Device;

use crate::model::{Composition, Effects, Model};
use crate::references::{ReferenceImage, References};
use crate::settings::RenderSettings;
use crate::target::Target;

/// Why a bundle cannot be rendered.
#[derive(Debug, thiserror::Error)]
pub enum RenderError {
    /// The bundle does not verify.
    #[error("the bundle cannot be opened")]
    Bundle(#[from] BundleError),
    /// The weights do not fit the networks that the manifest names.
    #[error("the bundle's weights do not fit its networks")]
    Net(#[from] NetError),
    /// The manifest's `render` part is not understood.
    #[error("the bundle's render settings are not understood")]
    Settings(#[from] serde_json::Error),
    /// A network kind that this version does not know.
    #[error("network kind {kind} is not known to this version")]
    UnknownNetwork {
        /// The manifest's name for it.
        kind: String,
    },
    /// The bundle has no such view.
    #[error("the bundle has no view named {name}")]
    UnknownView {
        /// As asked for.
        name: String,
    },
}

const PAPER_EFFECTS: &str = "effects-unet";
const POINT_EFFECTS: &str = "effects-points";
const PAPER_COMPOSITION: &str = "composition-unet";
const BLEND_COMPOSITION: &str = "composition-blend";

/// A network as a bundle stores it.
#[derive(Debug)]
pub struct NetworkFiles {
    /// For the manifest.
    pub description: NetworkDescription,
    /// For the weights file.
    pub tensors: Tensors,
}

impl NetworkFiles {
    /// Describes an `EffectsNet` and exports its weights.
    pub fn of_effects(effects: &Effects, dtype: Precision) -> Self {
        let (kind, params, inputs, head) = match effects {
            Effects::Paper(_, params) => (
                PAPER_EFFECTS,
                params,
                vec![("position", 3), ("normal", 3), ("reflection", 3)],
                "sigmoid_encoded",
            ),
            Effects::Points(_, params) => (
                POINT_EFFECTS,
                params,
                vec![
                    ("position_code", 21),
                    ("normal", 3),
                    ("reflection_code", 27),
                    ("cosine", 1),
                ],
                "softplus_linear",
            ),
        };
        Self::new(kind, params, &inputs, head, ign_bundle::EFFECTS_FILE, dtype)
    }

    /// Describes a `CompositionNet` for `k` candidates and exports its weights.
    pub fn of_composition(composition: &Composition, k: usize, dtype: Precision) -> Self {
        let k = k as u32;
        let (kind, params, inputs, head) = match composition {
            Composition::Paper(_, params) => (
                PAPER_COMPOSITION,
                params,
                vec![("warped", 3 * k), ("warp_field", 2 * k), ("position", 3)],
                "sigmoid_rgb",
            ),
            Composition::Blend(_, params) => (
                BLEND_COMPOSITION,
                params,
                vec![
                    ("candidate_differences_x4", 3 * k),
                    ("prior_blend", 3),
                    ("prior", k),
                    ("visibility", k),
                    ("position", 3),
                    ("normal", 3),
                    ("effects", 3),
                    ("coverage", 1),
                ],
                "softmax_blend",
            ),
        };
        Self::new(
            kind,
            params,
            &inputs,
            head,
            ign_bundle::COMPOSITION_FILE,
            dtype,
        )
    }

    fn new(
        kind: &str,
        params: &Params,
        inputs: &[(&str, u32)],
        head: &str,
        file: &str,
        dtype: Precision,
    ) -> Self {
        let exported = params.export();
        let layers = exported
            .iter()
            .filter_map(|(name, shape, _)| layer(name, shape))
            .collect();
        let inputs = inputs
            .iter()
            .map(|&(name, channels)| NetworkInput {
                name: name.into(),
                channels,
            })
            .collect();
        let tensors = exported
            .into_iter()
            .map(|(name, shape, values)| {
                let shape = shape.into_iter().map(|n| n as usize).collect();
                (name, ign_bundle::Tensor { shape, values })
            })
            .collect();
        let description = NetworkDescription {
            kind: kind.into(),
            inputs,
            layers,
            head: head.into(),
            weights: file.into(),
            dtype,
        };
        Self {
            description,
            tensors,
        }
    }
}

/// A layer's description from the name and shape of its weight.
fn layer(name: &str, shape: &[i64]) -> Option<Layer> {
    let prefix = name.strip_suffix(".weight")?;
    let n = |at: usize| shape.get(at).map_or(0, |&v| v as u32);
    let last = prefix.rsplit('.').next().unwrap_or(prefix);
    let transposed =
        last.starts_with("up") && n(3) == 4 && !last.ends_with('a') && !last.ends_with('b');
    let (op, input, output) = match shape.len() {
        4 if transposed => ("conv_transpose", n(0), n(1)),
        4 => ("conv", n(1), n(0)),
        2 => ("linear", n(1), n(0)),
        _ => return None,
    };
    let strided = n(3) == 4 && (last.starts_with("down") || transposed);
    let blend = shape.len() == 4 && (last == "stem" || last.ends_with('a') || last.ends_with('b'));
    Some(Layer {
        name: prefix.into(),
        op: op.into(),
        from: Vec::new(),
        in_channels: input,
        out_channels: output,
        kernel: n(3),
        stride: if strided { 2 } else { 1 },
        padding: u32::from(shape.len() == 4 && (strided || n(3) == 3)),
        activation: if last == "head" {
            "none"
        } else if blend {
            "leaky_relu:0.1"
        } else {
            "relu"
        }
        .into(),
        norm: if shape.len() == 4 && !blend && last != "head" {
            "batch"
        } else {
            "none"
        }
        .into(),
    })
}

/// Renders views of one bundle.
#[derive(Debug)]
pub struct BundleRenderer {
    bundle: Bundle,
    proxy: Drawable,
    normalised_from_world: Similarity,
    model: Model,
    device: Device,
}

impl BundleRenderer {
    /// Verifies the bundle, builds its networks and removes the effects from its references once.
    ///
    /// # Errors
    /// Whatever does not verify or fit; see [`RenderError`].
    pub fn open(dir: &Path, device: Device) -> Result<Self, RenderError> {
        let bundle = Bundle::open(dir)?;
        let settings: RenderSettings = serde_json::from_value(bundle.manifest().render.clone())?;
        let (mesh, normalised_from_world) = bundle.proxy()?;
        let images: Vec<ReferenceImage> = bundle
            .references()?
            .into_iter()
            .map(|reference| ReferenceImage {
                name: reference.name,
                camera: reference.camera,
                rgba: reference.rgba,
            })
            .collect();
        let networks = &bundle.manifest().networks;
        let effects = networks
            .effects
            .as_ref()
            .map(|network| load_effects(&bundle, network, device))
            .transpose()?;
        let composition = networks
            .composition
            .as_ref()
            .map(|network| load_composition(&bundle, network, settings.k, device))
            .transpose()?;
        let proxy = Drawable::new(&mesh);
        let references = References::new(&proxy, &images, settings.recipe, device);
        let model = Model::new(references, settings, effects, composition);
        Ok(Self {
            bundle,
            proxy,
            normalised_from_world,
            model,
            device,
        })
    }

    /// The verified bundle.
    pub fn bundle(&self) -> &Bundle {
        &self.bundle
    }

    /// Renders one view; `camera` is in the capture's world. Black where the object is not.
    pub fn render(&self, camera: &Camera) -> RgbImage {
        self.render_normalised(&camera.transformed(self.normalised_from_world))
    }

    /// Renders one view; `camera` is in the normalised frame.
    pub fn render_normalised(&self, camera: &Camera) -> RgbImage {
        let target = Target::new(&self.proxy, camera, &self.model.settings, self.device);
        crate::to_image(&self.model.image(&target))
    }

    /// The estimated diffuse image of one view; `camera` is in the normalised frame.
    pub fn diffuse_normalised(&self, camera: &Camera) -> RgbImage {
        let target = Target::new(&self.proxy, camera, &self.model.settings, self.device);
        crate::to_image(&self.model.diffuse_image(&target))
    }

    /// The camera of a reference view or of a held-out view, normalised frame.
    ///
    /// # Errors
    /// No view of that name.
    pub fn view_camera(&self, name: &str) -> Result<Camera, RenderError> {
        let references = self.bundle.references()?;
        let held_out = self.bundle.held_out_views()?;
        references
            .into_iter()
            .map(|view| (view.name, view.camera))
            .chain(held_out.into_iter().map(|view| (view.name, view.camera)))
            .find(|(known, _)| known == name)
            .map(|(_, camera)| camera)
            .ok_or_else(|| RenderError::UnknownView { name: name.into() })
    }

    /// `count` cameras on a circle around the object, normalised frame; see [`orbit`].
    pub fn orbit(&self, count: usize, size: u32) -> Vec<Camera> {
        orbit(&self.model.references.cameras, count, size)
    }
}

/// A turntable in the normalised frame: the axis that the references' cameras circle, at their median height and
/// distance, wide enough that the unit sphere fills the frame.
pub fn orbit(references: &[Camera], count: usize, size: u32) -> Vec<Camera> {
    let centers: Vec<DVec3> = references.iter().map(Camera::center).collect();
    // Images have their y axis down; the mean of the cameras' up directions is the object's up for ordinary captures.
    let mean_up: DVec3 = references
        .iter()
        .map(|camera| camera.camera_from_world.matrix3.transpose() * DVec3::NEG_Y)
        .sum();
    let up = mean_up.try_normalize().unwrap_or(DVec3::Z);
    let side = up.any_orthonormal_vector();
    let forward = up.cross(side);
    let median = |mut values: Vec<f64>| {
        values.sort_by(f64::total_cmp);
        values.get(values.len() / 2).copied().unwrap_or(0.0)
    };
    let height = median(centers.iter().map(|c| c.dot(up)).collect());
    let radius = median(
        centers
            .iter()
            .map(|c| (*c - up * c.dot(up)).length())
            .collect(),
    )
    .max(0.5);
    let distance = height.hypot(radius).max(1.2);
    let half = f64::from(size) / 2.0;
    // The unit sphere's silhouette has the tangent 1 / sqrt(d^2 - 1).
    let focal = half * 0.95 * (distance * distance - 1.0).sqrt();
    let intrinsics = CameraIntrinsics {
        fx: focal,
        fy: focal,
        cx: half,
        cy: half,
        width: size,
        height: size,
    };
    (0..count)
        .filter_map(|index| {
            let angle = TAU * index as f64 / count.max(1) as f64;
            let eye = (side * angle.cos() + forward * angle.sin()) * radius + up * height;
            Camera::look_at(intrinsics, eye, DVec3::ZERO, up).ok()
        })
        .collect()
}

fn load_effects(
    bundle: &Bundle,
    network: &NetworkDescription,
    device: Device,
) -> Result<Effects, RenderError> {
    let mut builder = Builder::new();
    let filled = |builder| filled(builder, &bundle.weights(network)?, device);
    match network.kind.as_str() {
        PAPER_EFFECTS => {
            let net = PaperEffects::new(&mut builder);
            Ok(Effects::Paper(net, filled(builder)?))
        }
        POINT_EFFECTS => {
            let net = PointEffects::new(&mut builder);
            Ok(Effects::Points(net, filled(builder)?))
        }
        kind => Err(RenderError::UnknownNetwork { kind: kind.into() }),
    }
}

fn load_composition(
    bundle: &Bundle,
    network: &NetworkDescription,
    k: usize,
    device: Device,
) -> Result<Composition, RenderError> {
    let mut builder = Builder::new();
    match network.kind.as_str() {
        PAPER_COMPOSITION => {
            let net = PaperComposition::new(&mut builder, PaperComposition::input_channels(k));
            let tensors = bundle.weights(network)?;
            Ok(Composition::Paper(net, filled(builder, &tensors, device)?))
        }
        BLEND_COMPOSITION => {
            let tensors = bundle.weights(network)?;
            let net = BlendComposition::new(&mut builder, k, blend_width(&tensors));
            Ok(Composition::Blend(net, filled(builder, &tensors, device)?))
        }
        kind => Err(RenderError::UnknownNetwork { kind: kind.into() }),
    }
}

/// Where it cannot be told from the weights, they do not fit, which [`filled`] says.
fn blend_width(tensors: &Tensors) -> i64 {
    let stem = tensors.get(BlendComposition::STEM);
    stem.and_then(|stem| i64::try_from(*stem.shape.first()?).ok())
        .filter(|width| BLEND_WIDTHS.contains(width))
        .unwrap_or(BLEND_WIDTH)
}

fn filled(builder: Builder, tensors: &Tensors, device: Device) -> Result<Params, RenderError> {
    let mut params = builder.build(device, 0);
    import(&mut params, tensors)?;
    Ok(params)
}

/// Overwrites a network's tensors by those of a weights file.
///
/// # Errors
/// Those of [`Params::import`]; nothing is changed then.
pub fn import(params: &mut Params, tensors: &Tensors) -> Result<(), NetError> {
    let shapes: std::collections::BTreeMap<&str, Vec<i64>> = tensors
        .iter()
        .map(|(name, t)| (name.as_str(), t.shape.iter().map(|&n| n as i64).collect()))
        .collect();
    params.import(|name| {
        let shape = shapes.get(name)?;
        tensors
            .get(name)
            .map(|t| (shape.as_slice(), t.values.as_slice()))
    })
}
