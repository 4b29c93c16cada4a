//! The recipe: what to train, as the command line says it and as the worker reads it.
//!
//! The worker owns the schema; ignctl checks only what it names itself, and hands `--set` through.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::problem::Problem;

/// Methods that the worker can score beside ours.
const METHODS: [&str; 9] = [
    "vertex_color",
    "texture",
    "n_ibr",
    "ibr",
    "pix2pix_position",
    "pix2pix_depth",
    "ours_no_effects",
    "paper",
    "none",
];

/// How to bake.
#[derive(Clone, Debug, clap::Args)]
#[command(next_help_heading = "Recipe")]
pub(crate) struct RecipeArgs {
    /// What to train: `auto` only what the scene needs, `standard` everything for a fixed time, `paper` the published method
    #[arg(long, value_parser = ["auto", "standard", "paper"], default_value = "standard")]
    pub(crate) preset: String,
    /// Longer side of the rendered images, in pixels
    #[arg(long, value_name = "PX", default_value_t = 256, value_parser = clap::value_parser!(u32).range(16..=8192))]
    pub(crate) size: u32,
    /// Methods to score beside ours [default: those that need no training: `vertex_color,texture,n_ibr,ibr`]; the others each
    /// train for as long as ours
    #[arg(long, value_name = "NAMES", value_delimiter = ',', value_parser = METHODS)]
    pub(crate) methods: Vec<String>,
    /// A setting of the preset, or `crop=none` to keep the whole frame; may be given again
    #[arg(long, value_name = "KEY=VALUE", value_parser = key_value)]
    pub(crate) set: Vec<(String, String)>,
    /// Stop training after about so many seconds and keep the best so far
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub(crate) budget_secs: Option<u64>,
    /// Seed of everything random
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub(crate) seed: u64,
    #[command(flatten)]
    pub(crate) limits: Limits,
}

/// What preset `auto` is held to; settings of the recipe by the same names.
#[derive(Clone, Debug, Default, clap::Args)]
#[command(next_help_heading = "Limits of preset auto")]
pub(crate) struct Limits {
    /// How much error may be left to save time
    #[arg(long, value_parser = ["draft", "standard", "best"])]
    pub(crate) quality: Option<String>,
    /// Seconds that the whole bake may take
    #[arg(long, value_name = "N")]
    pub(crate) max_secs: Option<f64>,
    /// Megabytes that a viewer has to load
    #[arg(long, value_name = "MB")]
    pub(crate) max_bundle_mb: Option<f64>,
    /// Frames a second that rendering must reach on the machine that bakes
    #[arg(long, value_name = "N")]
    pub(crate) min_render_fps: Option<f64>,
    /// PSNR on validation views, in dB, at which training may end
    #[arg(long, value_name = "DB")]
    pub(crate) target_psnr: Option<f64>,
}

impl Limits {
    /// Those that are given, as settings.
    fn settings(&self) -> impl Iterator<Item = (&'static str, String)> {
        let number = |value: Option<f64>| value.map(|value| value.to_string());
        [
            ("quality", self.quality.clone()),
            ("max_secs", number(self.max_secs)),
            ("max_bundle_mb", number(self.max_bundle_mb)),
            ("min_render_fps", number(self.min_render_fps)),
            ("target_psnr", number(self.target_psnr)),
        ]
        .into_iter()
        .filter_map(|(key, value)| Some((key, value?)))
    }
}

/// The recipe on the wire.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Recipe {
    pub(crate) preset: String,
    pub(crate) size: u32,
    pub(crate) crop: String,
    pub(crate) seed: u64,
    pub(crate) budget_secs: Option<u64>,
    pub(crate) proxy: Option<String>,
    pub(crate) settings: BTreeMap<String, String>,
}

/// `KEY=VALUE` with a key.
pub(crate) fn key_value(text: &str) -> Result<(String, String), String> {
    match text.split_once('=') {
        Some((key, value)) if !key.trim().is_empty() => {
            Ok((key.trim().to_string(), value.trim().to_string()))
        }
        _ => Err("expected KEY=VALUE".to_string()),
    }
}

impl RecipeArgs {
    /// The recipe, with the proxy's path within the capture.
    pub(crate) fn recipe(&self, proxy: Option<String>) -> Result<Recipe, Problem> {
        let mut recipe = Recipe {
            preset: self.preset.clone(),
            size: self.size,
            crop: "object".to_string(),
            seed: self.seed,
            budget_secs: self.budget_secs,
            proxy,
            settings: BTreeMap::new(),
        };
        if !self.methods.is_empty() {
            let methods = self.methods.join(",");
            recipe.settings.insert("methods".to_string(), methods);
        }
        for (key, value) in self.limits.settings() {
            if self.preset != "auto" {
                let flag = key.replace('_', "-");
                return Err(
                    Problem::usage(format!("--{flag} needs --preset auto")).hint(
                        "the other presets have a fixed length and size; --budget-secs ends any",
                    ),
                );
            }
            recipe.settings.insert(key.to_string(), value);
        }
        for (key, value) in &self.set {
            match key.as_str() {
                "crop" if matches!(value.as_str(), "object" | "none") => {
                    recipe.crop.clone_from(value);
                }
                "crop" => {
                    return Err(Problem::usage(format!("crop is {value:?}"))
                        .hint("--set crop=object (default) or --set crop=none"));
                }
                "preset" | "size" | "seed" | "budget_secs" | "proxy" | "methods" => {
                    return Err(Problem::usage(format!("{key} is not a setting"))
                        .hint(format!("use --{} instead", key.replace('_', "-"))));
                }
                _ => {
                    recipe.settings.insert(key.clone(), value.clone());
                }
            }
        }
        Ok(recipe)
    }
}

impl Recipe {
    /// Canonical JSON: fields in a fixed order, settings sorted.
    pub(crate) fn json(&self) -> Result<String, Problem> {
        serde_json::to_string(self)
            .map_err(|error| Problem::failed(format!("cannot write the recipe: {error}")))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::problem::Exit;

    fn args(set: &[&str]) -> RecipeArgs {
        RecipeArgs {
            preset: "standard".into(),
            size: 128,
            methods: vec!["ibr".into(), "paper".into()],
            set: set.iter().map(|text| key_value(text).unwrap()).collect(),
            budget_secs: Some(60),
            seed: 7,
            limits: Limits::default(),
        }
    }

    #[test]
    fn crop_has_its_own_field_and_the_rest_are_settings() {
        let recipe = args(&["lr=1e-3", "crop=none", "epochs=3"]).recipe(Some("proxy/p.ply".into()));
        insta::assert_snapshot!(
            recipe.unwrap().json().unwrap(),
            @r#"{"preset":"standard","size":128,"crop":"none","seed":7,"budget_secs":60,"proxy":"proxy/p.ply","settings":{"epochs":"3","lr":"1e-3","methods":"ibr,paper"}}"#
        );
    }

    #[test]
    fn limits_are_settings_of_preset_auto() {
        let mut args = args(&[]);
        args.limits.quality = Some("draft".into());
        args.limits.max_secs = Some(90.0);
        let problem = args.recipe(None).unwrap_err();
        assert!(problem.to_string().contains("--quality"), "{problem}");
        args.preset = "auto".into();
        let settings = args.recipe(None).unwrap().settings;
        assert_eq!(settings["quality"], "draft");
        assert_eq!(settings["max_secs"], "90");
    }

    #[test]
    fn what_has_a_flag_is_not_a_setting() {
        for wrong in ["crop=middle", "size=3", "budget_secs=3", "methods=ibr"] {
            assert_eq!(
                args(&[wrong]).recipe(None).unwrap_err().exit,
                Exit::Usage,
                "{wrong}"
            );
        }
        assert!(key_value("epochs").is_err());
        assert!(key_value("=3").is_err());
    }
}
