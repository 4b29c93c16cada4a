//! The recipe: what a job asks for. Submitted as JSON, stored in the bundle as submitted.

use ign_nets::Params;
use ign_nets::composition::{BLEND_WIDTH, BLEND_WIDTHS};
use ign_nets::optim::Trainee;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use tch::Kind;

use crate::BakeError;
use crate::schedule::{Rate, Worth};

/// Of a capture.
const MOST_VIEWS: usize = 1_000_000;
/// Settings that say what preset `auto` is to decide.
const AUTO_ONLY: [&str; 5] = [
    "quality",
    "target_psnr",
    "max_secs",
    "max_bundle_mb",
    "min_render_fps",
];

/// Named starting points of a recipe.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Preset {
    /// What the scene needs: each part only if it pays, and only for as long as it does.
    Auto,
    /// Everything that measured best, with a fixed length; the default.
    #[default]
    Standard,
    /// The paper's networks, losses and schedule.
    Paper,
}

/// Which part of the photographs is baked.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Crop {
    /// The object's projected bounds with margin.
    #[default]
    Object,
    /// The whole frame.
    None,
}

/// What a job asks for.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Recipe {
    /// Starting point.
    pub preset: Preset,
    /// Pixels: the side of the object's window, or the long side of the whole frame.
    pub size: u32,
    /// Part of the photographs.
    pub crop: Crop,
    /// Of every random choice.
    pub seed: u64,
    /// Seconds of training at most, all stages of ours together; methods compared with it get as many again. `None`: as many
    /// steps as the settings say.
    pub budget_secs: Option<f64>,
    /// Proxy mesh inside the capture, when not the default one.
    pub proxy: Option<String>,
    /// Single settings, see [`Settings`].
    pub settings: BTreeMap<String, String>,
}

impl Default for Recipe {
    fn default() -> Self {
        Self {
            preset: Preset::Standard,
            size: 256,
            crop: Crop::Object,
            seed: 0,
            budget_secs: None,
            proxy: None,
            settings: BTreeMap::new(),
        }
    }
}

/// A method that is scored beside ours; its name is a row of metrics.json.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Method {
    /// One static colour per vertex.
    VertexColor,
    /// Static colours as dense as the references' pixels.
    Texture,
    /// The mean of the K nearest references.
    NaiveIbr,
    /// Debevec 1998: per triangle the best of all references.
    Ibr,
    /// Image-to-image translation of position maps.
    Pix2pixPosition,
    /// Image-to-image translation of depth maps.
    Pix2pixDepth,
    /// Ours without `EffectsNet`.
    OursNoEffects,
    /// The paper's networks, losses and schedule, trained for as long as ours.
    Paper,
}

impl Method {
    /// All methods.
    pub const ALL: [Self; 8] = [
        Self::VertexColor,
        Self::Texture,
        Self::NaiveIbr,
        Self::Ibr,
        Self::Pix2pixPosition,
        Self::Pix2pixDepth,
        Self::OursNoEffects,
        Self::Paper,
    ];
    /// Those that need no training.
    pub const CHEAP: [Self; 4] = [Self::VertexColor, Self::Texture, Self::NaiveIbr, Self::Ibr];

    /// Its row of metrics.json.
    pub fn name(self) -> &'static str {
        match self {
            Self::VertexColor => "vertex_color",
            Self::Texture => "texture",
            Self::NaiveIbr => "n_ibr",
            Self::Ibr => "ibr",
            Self::Pix2pixPosition => "pix2pix_position",
            Self::Pix2pixDepth => "pix2pix_depth",
            Self::OursNoEffects => "ours_no_effects",
            Self::Paper => "paper",
        }
    }
}

/// How much error preset `auto` leaves to save time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Quality {
    Draft,
    Standard,
    Best,
}

impl Quality {
    /// Share by which a doubling of a training must lower the error.
    fn least_gain(self) -> f64 {
        match self {
            Self::Draft => 0.12,
            Self::Standard => 0.05,
            Self::Best => 0.02,
        }
    }

    /// The longest training, as a multiple of preset `standard`'s.
    fn most(self) -> f64 {
        match self {
            Self::Draft => 0.5,
            Self::Standard => 2.0,
            Self::Best => 8.0,
        }
    }
}

/// When `EffectsNet` is trained.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum EffectsChoice {
    /// Kept when it lowers the error of plain blending on the validation views.
    Auto,
    On,
    Off,
}

/// Which form of `EffectsNet`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum EffectsNet {
    /// A perceptron per surface point.
    Points,
    /// The paper's.
    UNet,
}

/// Which form of `CompositionNet`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Head {
    /// Weights for the warped views and one generated layer.
    Blend,
    /// The paper's: paints colours.
    Paint,
}

/// What the blending head minimises.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Loss {
    /// Absolute differences.
    L1,
    /// Absolute plus squared differences.
    Mixed,
}

/// Whether photographs are brought to one exposure.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum GainsChoice {
    /// Where gains make the photographs agree on points that had no part in estimating them.
    Auto,
    Off,
}

/// The recipe resolved: every number a bake needs.
#[derive(Clone, Debug)]
#[expect(
    clippy::struct_excessive_bools,
    reason = "independent switches, each of them a setting's name"
)]
pub(crate) struct Settings {
    pub(crate) preset: Preset,
    pub(crate) quality: Quality,
    /// Validation PSNR, in dB, at which training ends.
    pub(crate) target_psnr: Option<f64>,
    /// Seconds that the whole bake may take.
    pub(crate) max_secs: Option<f64>,
    /// Megabytes (10^6) of what a viewer needs of the bundle.
    pub(crate) max_bundle_mb: Option<f64>,
    /// Frames a second that rendering must reach on the machine that bakes.
    pub(crate) min_render_fps: Option<f64>,
    /// Whether there is a `CompositionNet`.
    pub(crate) compose: bool,
    pub(crate) k: usize,
    /// Training views that are used at most, evenly spread; the others are left out.
    pub(crate) train_views: usize,
    pub(crate) references: usize,
    pub(crate) supersample: u32,
    /// Which normals networks see, and how the views of a pixel are chosen.
    pub(crate) drawing: ign_render::Recipe,
    pub(crate) effects: EffectsChoice,
    pub(crate) effects_net: EffectsNet,
    pub(crate) head: Head,
    pub(crate) loss: Loss,
    /// Whether the networks of preset `standard` train in bfloat16, with weights, sums and colours in single precision.
    pub(crate) bf16: bool,
    /// Whether a training view that is a reference is blended from the others alone.
    pub(crate) leave_out: bool,
    /// Whether the blending head sees the views of a pixel in random order while it trains.
    pub(crate) shuffle: bool,
    /// Whether the painting head is trained against a discriminator.
    pub(crate) adversarial: bool,
    /// Whether matrices within the networks of preset `standard` learn by Muon, not Adam.
    pub(crate) muon: bool,
    /// Decay of the average of weights that is kept; 0: the last weights are.
    pub(crate) average_decay: f64,
    /// Whether the learning rate stays the same to the end.
    pub(crate) constant_rate: bool,
    pub(crate) effects_steps: u64,
    /// Observations per step of the point effects.
    pub(crate) effects_batch: i64,
    pub(crate) composition_steps: u64,
    /// Whether the blending head starts from weights that learned on other captures.
    pub(crate) pretrained: bool,
    /// Channels of the blending head at full resolution.
    pub(crate) width: i64,
    /// Windows per step and their side in pixels.
    pub(crate) batch: usize,
    pub(crate) patch: i64,
    /// Scored beside ours, in the order of [`Method::ALL`].
    pub(crate) methods: Vec<Method>,
    pub(crate) half_weights: bool,
    /// Megabytes of memory for what training views show; beyond it they lie on disk.
    pub(crate) cache_mb: u64,
    pub(crate) checkpoint_secs: f64,
    pub(crate) margin: f64,
    /// Whether the proxy's outline is brought to the masks.
    pub(crate) fit: bool,
    /// Whether the proxy may be simplified where no view shows the difference.
    pub(crate) simplify: bool,
    pub(crate) gains: GainsChoice,
    /// Frames of the turntable preview.
    pub(crate) preview_frames: usize,
}

impl Recipe {
    /// Resolves presets and single settings.
    ///
    /// # Errors
    /// A setting that is unknown or out of range.
    pub(crate) fn resolve(&self, train_views: usize) -> Result<Settings, BakeError> {
        if !(16..=4096).contains(&self.size) {
            return Err(invalid(
                format!("size {} is out of range", self.size),
                "use 16 to 4096 pixels",
            ));
        }
        if self
            .budget_secs
            .is_some_and(|secs| !secs.is_finite() || secs <= 0.0)
        {
            return Err(invalid(
                "the budget is not a positive number of seconds".into(),
                "leave it out for the preset's own length",
            ));
        }
        let paper = self.preset == Preset::Paper;
        let most = self.settings.get("train_views");
        let most = most.map_or(Ok(MOST_VIEWS), |value| train_views_setting(value))?;
        let epochs = |count: u64| count * train_views.min(most) as u64;
        let mut settings = Settings {
            preset: self.preset,
            quality: Quality::Standard,
            target_psnr: None,
            max_secs: None,
            max_bundle_mb: None,
            min_render_fps: None,
            compose: true,
            k: 4,
            train_views: MOST_VIEWS,
            references: 20,
            supersample: if paper { 1 } else { 2 },
            drawing: if paper {
                ign_render::Recipe::Paper
            } else {
                ign_render::Recipe::Standard
            },
            effects: if paper {
                EffectsChoice::On
            } else {
                EffectsChoice::Auto
            },
            effects_net: if paper {
                EffectsNet::UNet
            } else {
                EffectsNet::Points
            },
            head: if paper { Head::Paint } else { Head::Blend },
            loss: if paper { Loss::L1 } else { Loss::Mixed },
            bf16: false,
            leave_out: !paper,
            shuffle: !paper,
            adversarial: true,
            muon: !paper,
            average_decay: if paper { 0.0 } else { 0.995 },
            constant_rate: paper,
            effects_steps: if paper { epochs(64) } else { 2000 },
            effects_batch: 8192,
            composition_steps: if paper { epochs(64) } else { 2000 },
            pretrained: !paper,
            width: BLEND_WIDTH,
            batch: 8,
            patch: 32,
            methods: Method::CHEAP.to_vec(),
            half_weights: false,
            cache_mb: 2048,
            checkpoint_secs: 20.0,
            margin: 0.05,
            fit: true,
            simplify: true,
            gains: GainsChoice::Auto,
            preview_frames: 36,
        };
        for (key, value) in &self.settings {
            settings.set(key, value)?;
        }
        if self.preset == Preset::Auto {
            let longest = |steps: u64| (steps as f64 * settings.quality.most()).ceil() as u64;
            settings.effects_steps = longest(settings.effects_steps);
            settings.composition_steps = longest(settings.composition_steps);
        } else if let Some(key) = self
            .settings
            .keys()
            .find(|key| AUTO_ONLY.contains(&key.as_str()))
        {
            return Err(invalid(
                format!("{key} needs preset auto"),
                "leave it out, or use preset auto: the others have a fixed length and size",
            ));
        }
        if paper && settings.compares(Method::Paper) {
            return Err(invalid(
                "preset paper cannot be compared with itself".into(),
                "leave paper out of methods: it is the row of ours",
            ));
        }
        Ok(settings)
    }
}

impl Settings {
    /// What layers compute in while they train.
    pub(crate) fn kind(&self) -> Kind {
        if self.bf16 {
            Kind::BFloat16
        } else {
            Kind::Float
        }
    }

    /// A network of preset `standard` at the start of its training.
    pub(crate) fn trainee(&self, params: Params) -> Trainee {
        if self.muon {
            Trainee::with_muon(params, self.average_decay)
        } else {
            Trainee::new(params, self.average_decay)
        }
    }

    /// How a network of `ours` learns: its rate falls from step `knee` on. Where it trains while it pays: for how
    /// long whatever it brings, and the error at which more is not wanted.
    pub(crate) fn rate(&self, knee: f64, least_steps: u64, enough: Option<f64>) -> Rate {
        match self.preset {
            Preset::Auto => Rate::WhileItPays {
                knee,
                worth: Worth {
                    least_gain: self.quality.least_gain(),
                    least_steps,
                    enough,
                },
            },
            _ if self.constant_rate => Rate::Constant,
            _ => Rate::Falling { knee },
        }
    }

    /// The mean squared error on [0, 255] of [`Self::target_psnr`].
    pub(crate) fn enough_mse(&self) -> Option<f64> {
        self.target_psnr
            .map(|decibels| 255.0 * 255.0 / 10f64.powf(decibels / 10.0))
    }

    /// Number of methods that train beside ours.
    pub(crate) fn trained_methods(&self) -> usize {
        let cheap = |method: &&Method| !Method::CHEAP.contains(method);
        self.methods.iter().filter(cheap).count()
    }

    /// Whether `method` is scored beside ours.
    pub(crate) fn compares(&self, method: Method) -> bool {
        self.methods.contains(&method)
    }

    fn set(&mut self, key: &str, value: &str) -> Result<(), BakeError> {
        match key {
            "quality" => {
                let choices = [
                    ("draft", Quality::Draft),
                    ("standard", Quality::Standard),
                    ("best", Quality::Best),
                ];
                self.quality = choice(key, value, &choices)?;
            }
            "target_psnr" => self.target_psnr = Some(number(key, value, 5.0, 100.0)?),
            "max_secs" => self.max_secs = Some(number(key, value, 1.0, 1e7)?),
            "max_bundle_mb" => self.max_bundle_mb = Some(number(key, value, 0.01, 1e5)?),
            "min_render_fps" => self.min_render_fps = Some(number(key, value, 1e-3, 1e4)?),
            "k" => self.k = number(key, value, 1, 16)?,
            "train_views" => self.train_views = train_views_setting(value)?,
            "references" => self.references = number(key, value, 1, 64)?,
            "supersample" => self.supersample = number(key, value, 1, 4)?,
            "drawing" => {
                let choices = [
                    ("paper", ign_render::Recipe::Paper),
                    ("standard", ign_render::Recipe::Standard),
                ];
                self.drawing = choice(key, value, &choices)?;
            }
            "effects" => {
                let choices = [
                    ("auto", EffectsChoice::Auto),
                    ("on", EffectsChoice::On),
                    ("off", EffectsChoice::Off),
                ];
                self.effects = choice(key, value, &choices)?;
            }
            "effects_net" => {
                let choices = [("points", EffectsNet::Points), ("unet", EffectsNet::UNet)];
                self.effects_net = choice(key, value, &choices)?;
            }
            "head" => {
                self.head = choice(
                    key,
                    value,
                    &[("blend", Head::Blend), ("paint", Head::Paint)],
                )?;
            }
            "loss" => self.loss = choice(key, value, &[("l1", Loss::L1), ("mixed", Loss::Mixed)])?,
            "precision" => {
                self.bf16 = choice(key, value, &[("fp32", false), ("bf16", true)])?;
            }
            "leave_out" => self.leave_out = switch(key, value)?,
            "shuffle" => self.shuffle = switch(key, value)?,
            "adversarial" => self.adversarial = switch(key, value)?,
            "optimizer" => {
                self.muon = choice(key, value, &[("muon", true), ("adam", false)])?;
            }
            "average_decay" => self.average_decay = number(key, value, 0.0, 0.999_999)?,
            "rate" => {
                self.constant_rate = choice(key, value, &[("constant", true), ("falling", false)])?;
            }
            "gains" => {
                let choices = [("auto", GainsChoice::Auto), ("off", GainsChoice::Off)];
                self.gains = choice(key, value, &choices)?;
            }
            "effects_steps" => self.effects_steps = number(key, value, 1, 10_000_000)?,
            "effects_batch" => self.effects_batch = number(key, value, 64, 1 << 20)?,
            "composition_steps" => self.composition_steps = number(key, value, 1, 10_000_000)?,
            "start" => {
                self.pretrained = choice(key, value, &[("pretrained", true), ("plain", false)])?;
            }
            "width" => {
                self.width = number(key, value, *BLEND_WIDTHS.start(), *BLEND_WIDTHS.end())?;
                if self.width % 2 != 0 {
                    return Err(invalid(
                        format!("setting width={value} is odd"),
                        "use an even number",
                    ));
                }
            }
            "batch" => self.batch = number(key, value, 1, 256)?,
            "patch" => self.patch = number(key, value, 16, 4096)?,
            "methods" => self.methods = methods(value)?,
            "half_weights" => self.half_weights = switch(key, value)?,
            "cache_mb" => self.cache_mb = number(key, value, 0, 1 << 20)?,
            "checkpoint_secs" => self.checkpoint_secs = number(key, value, 0.0, 86_400.0)?,
            "margin" => self.margin = number(key, value, 0.0, 2.0)?,
            "fit" => self.fit = switch(key, value)?,
            "simplify" => self.simplify = switch(key, value)?,
            "preview_frames" => self.preview_frames = number(key, value, 1, 360)?,
            _ => {
                return Err(invalid(
                    format!("setting {key} is unknown"),
                    "known: k, train_views, references, supersample, drawing, effects, effects_net, head, loss, leave_out, shuffle, precision, adversarial, optimizer, \
                     average_decay, rate, effects_steps, effects_batch, composition_steps, \
                     start, width, batch, patch, methods, half_weights, cache_mb, checkpoint_secs, margin, gains, fit, simplify, preview_frames, quality, \
                     target_psnr, max_secs, max_bundle_mb, min_render_fps",
                ));
            }
        }
        Ok(())
    }
}

fn invalid(message: String, hint: &str) -> BakeError {
    BakeError::Recipe {
        message,
        hint: hint.into(),
    }
}

fn choice<T: Copy>(key: &str, value: &str, choices: &[(&str, T)]) -> Result<T, BakeError> {
    let chosen = choices.iter().find(|(name, _)| *name == value);
    chosen.map(|(_, choice)| *choice).ok_or_else(|| {
        let names: Vec<&str> = choices.iter().map(|(name, _)| *name).collect();
        invalid(
            format!("{key}={value} is unknown"),
            &format!("use {}", names.join(" or ")),
        )
    })
}

fn train_views_setting(value: &str) -> Result<usize, BakeError> {
    number("train_views", value, 2, MOST_VIEWS)
}

/// Names separated by commas; `none` is no method.
fn methods(value: &str) -> Result<Vec<Method>, BakeError> {
    let mut chosen = Vec::new();
    for name in value
        .split(',')
        .map(str::trim)
        .filter(|name| *name != "none")
    {
        let method = Method::ALL.into_iter().find(|method| method.name() == name);
        chosen.push(method.ok_or_else(|| {
            let known: Vec<&str> = Method::ALL.into_iter().map(Method::name).collect();
            invalid(
                format!("method {name:?} is unknown"),
                &format!("known: {}; or none", known.join(", ")),
            )
        })?);
    }
    chosen.sort_unstable();
    chosen.dedup();
    Ok(chosen)
}

fn number<T: Copy + std::str::FromStr + PartialOrd + std::fmt::Display>(
    key: &str,
    value: &str,
    low: T,
    high: T,
) -> Result<T, BakeError> {
    match value.parse::<T>() {
        Ok(number) if number >= low && number <= high => Ok(number),
        _ => Err(invalid(
            format!("setting {key}={value} is out of range"),
            &format!("use a number from {low} to {high}"),
        )),
    }
}

fn switch(key: &str, value: &str) -> Result<bool, BakeError> {
    match value {
        "true" | "on" | "1" => Ok(true),
        "false" | "off" | "0" => Ok(false),
        _ => Err(invalid(
            format!("setting {key}={value} is no switch"),
            "use true or false",
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_are_checked() {
        let mut recipe = Recipe::default();
        recipe.settings.insert("k".into(), "5".into());
        assert_eq!(recipe.resolve(10).expect("valid").k, 5);
        for (key, value) in [
            ("k", "0"),
            ("k", "x"),
            ("colour", "1"),
            ("effects", "maybe"),
            ("gains", "on"),
            ("margin", "NaN"),
            ("width", "2"),
            ("width", "17"),
            ("methods", "ibr,texure"),
            ("methods", ""),
        ] {
            let mut recipe = Recipe::default();
            recipe.settings.insert(key.into(), value.into());
            assert!(
                matches!(recipe.resolve(10), Err(BakeError::Recipe { .. })),
                "{key}={value}"
            );
        }
        assert!(
            Recipe {
                size: 3,
                ..Recipe::default()
            }
            .resolve(10)
            .is_err()
        );
        assert!(
            Recipe {
                budget_secs: Some(f64::NAN),
                ..Recipe::default()
            }
            .resolve(10)
            .is_err()
        );
    }

    #[test]
    fn methods_are_chosen_by_name() {
        let with = |preset, value: &str| {
            let mut recipe = Recipe {
                preset,
                ..Recipe::default()
            };
            recipe.settings.insert("methods".into(), value.into());
            recipe.resolve(10)
        };
        let all: Vec<&str> = Method::ALL.into_iter().map(Method::name).collect();
        let all = with(Preset::Standard, &all.join(", ")).expect("valid");
        assert_eq!(all.methods, Method::ALL);
        let two = with(Preset::Paper, "ibr,n_ibr,ibr").expect("valid");
        assert_eq!(two.methods, [Method::NaiveIbr, Method::Ibr]);
        assert!(
            with(Preset::Standard, "none")
                .expect("valid")
                .methods
                .is_empty()
        );
        assert!(with(Preset::Paper, "paper").is_err());
        let Err(BakeError::Recipe { message, hint }) = with(Preset::Standard, "texure") else {
            panic!("an unknown method is taken");
        };
        assert!(message.contains("texure"), "{message}");
        assert!(
            Method::ALL.iter().all(|m| hint.contains(m.name())),
            "{hint}"
        );
    }

    #[test]
    fn the_paper_preset_is_the_papers() {
        let settings = Recipe {
            preset: Preset::Paper,
            ..Recipe::default()
        }
        .resolve(100)
        .expect("valid");
        assert_eq!((settings.k, settings.references), (4, 20));
        assert_eq!(settings.effects_steps, 6400);
        assert_eq!(settings.composition_steps, 6400);
        let mut halved = Recipe {
            preset: Preset::Paper,
            ..Recipe::default()
        };
        halved.settings.insert("train_views".into(), "50".into());
        assert_eq!(halved.resolve(100).expect("valid").effects_steps, 3200);
    }

    #[test]
    fn unknown_fields_are_refused() {
        assert!(serde_json::from_str::<Recipe>(r#"{"presett":"paper"}"#).is_err());
    }
}
