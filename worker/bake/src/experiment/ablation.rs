//! What each difference between preset `standard` and the paper's recipe is worth: taken out of `standard`, and put alone
//! into the paper's, at equal seconds of training, over captures and seeds.

use ign_bundle::report::plot::{Axis, Series, Unit};

use super::table::{Row, Table};
use super::{Lab, Subject};
use crate::BakeError;
use crate::recipe::Preset;

/// Seconds of training per bake where the recipe names none.
const BUDGET_SECS: f64 = 20.0;

/// A difference: the setting's value in the paper's recipe, and in `standard`.
struct Change {
    name: &'static str,
    key: &'static str,
    paper: &'static str,
    standard: &'static str,
}

const fn change(
    name: &'static str,
    key: &'static str,
    paper: &'static str,
    standard: &'static str,
) -> Change {
    Change {
        name,
        key,
        paper,
        standard,
    }
}

const CHANGES: [Change; 15] = [
    change("effects per surface point", "effects_net", "unet", "points"),
    change("effects only where they pay", "effects", "on", "auto"),
    change("blending head", "head", "paint", "blend"),
    change("squared term in the loss", "loss", "l1", "mixed"),
    change(
        "references left out of themselves",
        "leave_out",
        "off",
        "on",
    ),
    change("views in random order", "shuffle", "off", "on"),
    change(
        "weights learned on other objects",
        "start",
        "plain",
        "pretrained",
    ),
    change("falling learning rate", "rate", "constant", "falling"),
    change("Muon for matrices", "optimizer", "adam", "muon"),
    change("average of weights", "average_decay", "0", "0.995"),
    change("2 x 2 samples a pixel", "supersample", "1", "2"),
    change(
        "smooth normals, views by angle too",
        "drawing",
        "paper",
        "standard",
    ),
    change("exposure gains", "gains", "off", "auto"),
    change("proxy fitted to masks", "fit", "off", "on"),
    change("simplified proxy", "simplify", "off", "on"),
];

/// Both ends of a comparison: the bake's name, and its settings.
struct Variant {
    name: String,
    preset: Preset,
    settings: Vec<(&'static str, String)>,
}

fn variant(preset: Preset, changed: Option<&Change>) -> Variant {
    let name = match preset {
        Preset::Paper => "paper",
        Preset::Auto | Preset::Standard => "standard",
    };
    let mut settings = vec![
        ("methods", "none".to_owned()),
        ("preview_frames", "1".to_owned()),
    ];
    for each in &CHANGES {
        let taken = changed.is_some_and(|changed| changed.key == each.key);
        let value = if (preset == Preset::Paper) == taken {
            each.standard
        } else {
            each.paper
        };
        settings.push((each.key, value.to_owned()));
    }
    let name = changed.map_or(name.to_owned(), |changed| format!("{name}-{}", changed.key));
    Variant {
        name,
        preset,
        settings,
    }
}

/// Ratios of errors, and what they come to.
#[derive(Clone, Default)]
struct Ratios(Vec<f64>);

impl Ratios {
    /// Median, lowest, highest.
    fn figures(&self) -> [f64; 3] {
        let mut sorted: Vec<f64> = self.0.iter().copied().filter(|r| r.is_finite()).collect();
        sorted.sort_by(f64::total_cmp);
        match sorted.as_slice() {
            [] => [f64::NAN; 3],
            [.., last] => {
                let middle = sorted.len() / 2;
                let median = if sorted.len().is_multiple_of(2) {
                    f64::midpoint(sorted[middle - 1], sorted[middle])
                } else {
                    sorted[middle]
                };
                [median, sorted[0], *last]
            }
        }
    }
}

impl Lab<'_> {
    /// Bakes everything, seed by seed, so that what disturbs the machine disturbs all alike; the table is written after each.
    pub(super) fn ablation(&self) -> Result<Table, BakeError> {
        let subjects = self.subjects()?;
        let changes = self.changes()?;
        // Per change and capture: without it in `standard`, with it in the paper's.
        let mut ratios =
            vec![vec![[Ratios::default(), Ratios::default()]; subjects.len()]; changes.len()];
        let mut table = None;
        for seed in 0..self.job.seeds.max(1) {
            for (at, subject) in subjects.iter().enumerate() {
                let standard = self.error_of(subject, seed, &variant(Preset::Standard, None))?;
                let paper = self.error_of(subject, seed, &variant(Preset::Paper, None))?;
                for (change, ratios) in changes.iter().zip(&mut ratios) {
                    let without = variant(Preset::Standard, Some(change));
                    let with = variant(Preset::Paper, Some(change));
                    let [removed, alone] = &mut ratios[at];
                    removed
                        .0
                        .push(self.error_of(subject, seed, &without)? / standard);
                    alone.0.push(self.error_of(subject, seed, &with)? / paper);
                }
            }
            let so_far = tabulated(&subjects, &changes, &ratios);
            so_far.write(&self.job.out, self.job.experiment.name())?;
            table = Some(so_far);
        }
        table.ok_or_else(|| BakeError::Unusable {
            message: "there is no seed to bake with".into(),
            hint: "use one seed or more".into(),
        })
    }

    /// Those that the job names, or all.
    fn changes(&self) -> Result<Vec<&'static Change>, BakeError> {
        let only = &self.job.only;
        let known = |key: &String| CHANGES.iter().any(|change| change.key == key);
        if let Some(key) = only.iter().find(|key| !known(key)) {
            let keys: Vec<&str> = CHANGES.iter().map(|change| change.key).collect();
            return Err(BakeError::Recipe {
                message: format!("ablation knows no change of {key}"),
                hint: format!("known: {}", keys.join(", ")),
            });
        }
        let wanted = |change: &&Change| only.is_empty() || only.iter().any(|k| k == change.key);
        Ok(CHANGES.iter().filter(wanted).collect())
    }

    fn error_of(
        &self,
        subject: &Subject<'_>,
        seed: u64,
        variant: &Variant,
    ) -> Result<f64, BakeError> {
        let mut recipe = self.job.recipe.clone();
        recipe.preset = variant.preset;
        recipe.seed += seed;
        recipe.budget_secs.get_or_insert(BUDGET_SECS);
        let name = format!("ablation-{}-{seed}", variant.name);
        Ok(self
            .baked_as(recipe, subject, &name, &variant.settings)?
            .error("ours"))
    }
}

fn tabulated(subjects: &[Subject<'_>], changes: &[&Change], ratios: &[Vec<[Ratios; 2]>]) -> Table {
    let mut rows = Vec::new();
    let mut dots: [Vec<(f64, f64)>; 2] = Default::default();
    for (index, (change, per_capture)) in changes.iter().zip(ratios).enumerate() {
        let mut all = [Ratios::default(), Ratios::default()];
        for (subject, sides) in subjects.iter().zip(per_capture) {
            rows.push(Row::new(
                &[change.name, &subject.name],
                &[sides[0].figures(), sides[1].figures()].concat(),
            ));
            for (all, side) in all.iter_mut().zip(sides) {
                all.0.extend(&side.0);
            }
        }
        let figures = [all[0].figures(), all[1].figures()];
        for (dots, figures) in dots.iter_mut().zip(&figures) {
            dots.push((index as f64 + 1.0, figures[0]));
        }
        rows.push(Row::new(&[change.name, "all"], &figures.concat()));
    }
    let [removed, alone] = dots;
    Table {
        caption: "Held-out error at equal seconds of training, as a ratio: standard without the change to standard (above 1: the \
                  change helps there), and the paper's recipe with the change to the paper's (below 1: it helps alone). Median, \
                  lowest and highest over seeds. In the plot the changes are numbered from above.",
        labels: &["change", "capture"],
        columns: &[
            "removed",
            "removed_low",
            "removed_high",
            "alone",
            "alone_low",
            "alone_high",
        ],
        rows,
        series: vec![
            Series::dots("ours", "standard without it", removed),
            Series::dots("paper", "the paper's with it", alone),
        ],
        x: Axis::even("change"),
        y: Axis::log("error, as a ratio", Unit::Plain),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn variants_differ_from_their_preset_in_the_change_alone() {
        for preset in [Preset::Standard, Preset::Paper] {
            let whole = variant(preset, None);
            for change in &CHANGES {
                let changed = variant(preset, Some(change));
                let differing: Vec<&str> = whole
                    .settings
                    .iter()
                    .zip(&changed.settings)
                    .filter(|(a, b)| a != b)
                    .map(|((key, _), _)| *key)
                    .collect();
                assert_eq!(differing, [change.key]);
                assert_ne!(whole.name, changed.name);
            }
        }
        // Named values are the presets' own.
        for preset in [Preset::Standard, Preset::Paper] {
            let mut recipe = crate::Recipe {
                preset,
                ..crate::Recipe::default()
            };
            let plain = format!("{:?}", recipe.resolve(50).expect("settings"));
            for change in CHANGES
                .iter()
                .filter(|c| !matches!(c.key, "gains" | "fit" | "simplify"))
            {
                let value = if preset == Preset::Paper {
                    change.paper
                } else {
                    change.standard
                };
                recipe.settings.insert(change.key.into(), value.into());
            }
            assert_eq!(
                plain,
                format!("{:?}", recipe.resolve(50).expect("settings"))
            );
        }
    }

    #[test]
    fn ratios_come_to_their_median_and_ends() {
        let figures = Ratios(vec![1.2, f64::NAN, 0.9, 1.0, 1.1]).figures();
        assert_eq!(figures.map(|f| (f * 100.0).round() as i64), [105, 90, 120]);
        assert!(Ratios::default().figures()[0].is_nan());
    }
}
