//! The recipe: what a job asks for. Submitted as JSON, stored in the bundle as submitted.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

use crate::BakeError;

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
    /// Seconds of training at most; all stages together. `None`: as many steps as the settings say.
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
#[expect(
    clippy::struct_excessive_bools,
    reason = "each is a switch of the recipe"
)]
pub(crate) struct Settings {
    pub(crate) preset: Preset,
    pub(crate) k: usize,
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
    pub(crate) ablate_effects: bool,
    pub(crate) compare_paper: bool,
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
        let epochs = |count: u64| count * train_views as u64;
        let mut settings = Settings {
            preset: self.preset,
            k: 4,
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
            ablate_effects: true,
            compare_paper: false,
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
        Ok(settings)
    }
}

impl Settings {
    fn set(&mut self, key: &str, value: &str) -> Result<(), BakeError> {
        match key {
            "k" => self.k = number(key, value, 1, 16)?,
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
            "ablate_effects" => self.ablate_effects = switch(key, value)?,
            "compare_paper" => self.compare_paper = switch(key, value)?,
            "half_weights" => self.half_weights = switch(key, value)?,
            "checkpoint_secs" => self.checkpoint_secs = number(key, value, 0.0, 86_400.0)?,
            "margin" => self.margin = number(key, value, 0.0, 2.0)?,
            "simplify" => self.simplify = switch(key, value)?,
            "preview_frames" => self.preview_frames = number(key, value, 1, 360)?,
            _ => {
                return Err(invalid(
                    format!("setting {key} is unknown"),
                    "known: k, references, supersample, effects, effects_steps, effects_batch, composition_steps, \
                     batch, patch, ablate_effects, compare_paper, half_weights, checkpoint_secs, margin, gains, simplify, preview_frames",
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
    }

    #[test]
    fn unknown_fields_are_refused() {
        assert!(serde_json::from_str::<Recipe>(r#"{"presett":"paper"}"#).is_err());
    }
}
