//! The recipe: what a job asks for. Submitted as JSON, stored in the bundle as submitted.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

use crate::BakeError;

/// Of a capture.
const MOST_VIEWS: usize = 1_000_000;

/// Named starting points of a recipe.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Preset {
    /// What measured best; the default.
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

/// When `EffectsNet` is trained.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum EffectsChoice {
    /// Kept when it lowers the error of plain blending on the validation views.
    Auto,
    On,
    Off,
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
pub(crate) struct Settings {
    pub(crate) preset: Preset,
    pub(crate) k: usize,
    /// Training views that are used at most, evenly spread; the others are left out.
    pub(crate) train_views: usize,
    pub(crate) references: usize,
    pub(crate) supersample: u32,
    pub(crate) effects: EffectsChoice,
    pub(crate) effects_steps: u64,
    /// Observations per step of the point effects.
    pub(crate) effects_batch: i64,
    pub(crate) composition_steps: u64,
    /// Windows per step and their side in pixels.
    pub(crate) batch: usize,
    pub(crate) patch: i64,
    /// Scored beside ours, in the order of [`Method::ALL`].
    pub(crate) methods: Vec<Method>,
    pub(crate) half_weights: bool,
    pub(crate) checkpoint_secs: f64,
    pub(crate) margin: f64,
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
            k: 4,
            train_views: MOST_VIEWS,
            references: 20,
            supersample: if paper { 1 } else { 2 },
            effects: if paper {
                EffectsChoice::On
            } else {
                EffectsChoice::Auto
            },
            effects_steps: if paper { epochs(64) } else { 2000 },
            effects_batch: 8192,
            composition_steps: if paper { epochs(64) } else { 1000 },
            batch: 4,
            patch: 64,
            methods: Method::CHEAP.to_vec(),
            half_weights: false,
            checkpoint_secs: 20.0,
            margin: 0.05,
            simplify: true,
            gains: GainsChoice::Auto,
            preview_frames: 36,
        };
        for (key, value) in &self.settings {
            settings.set(key, value)?;
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
            "k" => self.k = number(key, value, 1, 16)?,
            "train_views" => self.train_views = train_views_setting(value)?,
            "references" => self.references = number(key, value, 1, 64)?,
            "supersample" => self.supersample = number(key, value, 1, 4)?,
            "effects" => {
                self.effects = match value {
                    "auto" => EffectsChoice::Auto,
                    "on" => EffectsChoice::On,
                    "off" => EffectsChoice::Off,
                    _ => {
                        return Err(invalid(
                            format!("effects={value} is unknown"),
                            "use auto, on or off",
                        ));
                    }
                }
            }
            "gains" => {
                self.gains = match value {
                    "auto" => GainsChoice::Auto,
                    "off" => GainsChoice::Off,
                    _ => {
                        return Err(invalid(
                            format!("gains={value} is unknown"),
                            "use auto or off",
                        ));
                    }
                }
            }
            "effects_steps" => self.effects_steps = number(key, value, 1, 10_000_000)?,
            "effects_batch" => self.effects_batch = number(key, value, 64, 1 << 20)?,
            "composition_steps" => self.composition_steps = number(key, value, 1, 10_000_000)?,
            "batch" => self.batch = number(key, value, 1, 256)?,
            "patch" => self.patch = number(key, value, 16, 4096)?,
            "methods" => self.methods = methods(value)?,
            "half_weights" => self.half_weights = switch(key, value)?,
            "checkpoint_secs" => self.checkpoint_secs = number(key, value, 0.0, 86_400.0)?,
            "margin" => self.margin = number(key, value, 0.0, 2.0)?,
            "simplify" => self.simplify = switch(key, value)?,
            "preview_frames" => self.preview_frames = number(key, value, 1, 360)?,
            _ => {
                return Err(invalid(
                    format!("setting {key} is unknown"),
                    "known: k, train_views, references, supersample, effects, effects_steps, effects_batch, composition_steps, \
                     batch, patch, methods, half_weights, checkpoint_secs, margin, gains, simplify, preview_frames",
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
