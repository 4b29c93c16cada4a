//! The paper's experiments: each bakes what it compares and makes a table and a plot of the figures in the bundles.
//!
//! Bakes stay in `bakes/` below the output folder. One that is there already, of the same capture and recipe, is not made
//! again: an experiment of hours goes on where it was interrupted.

mod ablation;
mod diffuse;
mod table;
mod temporal;

use std::path::{Path, PathBuf};

use ign_bundle::metrics::Metrics;
use ign_bundle::report::method_label;
use ign_bundle::report::plot::{Axis, Series, Unit};
use ign_bundle::{Bundle, folder_digest};
use ign_events::Event;

use crate::recipe::{Method, Recipe};
use crate::run::{BakeJob, bake};
use crate::{BakeError, io};
use table::{Row, Table};

/// Fewest training views that the corpus is halved to.
const LEAST_VIEWS: usize = 8;
/// Numbers of references at the paper's K, and numbers K at the paper's 20 references.
const REFERENCES: [usize; 4] = [5, 10, 20, 40];
const NEAREST: [usize; 4] = [1, 2, 4, 8];
const PAPER_REFERENCES: usize = 20;
const PAPER_NEAREST: usize = 4;

/// One of the paper's experiments.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Experiment {
    /// Errors of every method over captures (Tab. "MSE of photometric re-rendering error").
    Methods,
    /// With and without `EffectsNet` (Fig. "Ablation study w.r.t. the EffectsNet").
    Effects,
    /// The estimated diffuse images against the truth of demo captures (Fig. "Comparison of the estimated diffuse images").
    Diffuse,
    /// The training corpus halved again and again, ours against pix2pix (Fig. "Evaluation of Training Corpus Size").
    Corpus,
    /// The number of references, and of nearest views K.
    References,
    /// What each departure from the paper's recipe is worth, over captures and seeds.
    Ablation,
    /// Coherence along the path of the held-out views: how much a frame differs from the one before, warped.
    Temporal,
}

impl Experiment {
    /// All experiments.
    pub const ALL: [Self; 7] = [
        Self::Methods,
        Self::Effects,
        Self::Diffuse,
        Self::Corpus,
        Self::References,
        Self::Ablation,
        Self::Temporal,
    ];

    /// Its name on the command line and of its files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Methods => "methods",
            Self::Effects => "effects",
            Self::Diffuse => "diffuse",
            Self::Corpus => "corpus",
            Self::References => "references",
            Self::Ablation => "ablation",
            Self::Temporal => "temporal",
        }
    }
}

/// What to compare, and where.
#[derive(Clone, Debug)]
pub struct ExperimentJob {
    /// Which.
    pub experiment: Experiment,
    /// Capture folders.
    pub captures: Vec<PathBuf>,
    /// What all bakes have in common.
    pub recipe: Recipe,
    /// Seeds that `ablation` goes through, from the recipe's on.
    pub seeds: u64,
    /// Settings that `ablation` changes; none: all that it knows.
    pub only: Vec<String>,
    /// Tables, plot and bakes go here.
    pub out: PathBuf,
    /// Cores to use.
    pub threads: usize,
}

/// Runs an experiment; returns the files it wrote: `NAME.md`, `NAME.json` and `NAME.svg`.
///
/// # Errors
/// What a bake fails with, captures without the truth that the experiment needs, or files that cannot be written.
pub fn run(job: &ExperimentJob, events: &dyn Fn(Event)) -> Result<Vec<PathBuf>, BakeError> {
    if job.captures.is_empty() {
        return Err(BakeError::Unusable {
            message: format!("experiment {} has no capture", job.experiment.name()),
            hint: "name one capture folder or more; ign-worker demo-capture makes some".into(),
        });
    }
    let lab = Lab { job, events };
    let table = match job.experiment {
        Experiment::Methods => lab.methods()?,
        Experiment::Effects => lab.effects()?,
        Experiment::Diffuse => lab.diffuse()?,
        Experiment::Corpus => lab.corpus()?,
        Experiment::References => lab.references()?,
        Experiment::Ablation => lab.ablation()?,
        Experiment::Temporal => lab.temporal()?,
    };
    table.write(&job.out, job.experiment.name())
}

struct Lab<'a> {
    job: &'a ExperimentJob,
    events: &'a dyn Fn(Event),
}

/// A capture with the name it has in tables.
struct Subject<'a> {
    name: String,
    dir: &'a Path,
    digest: String,
}

/// A bundle and its figures.
struct Baked {
    dir: PathBuf,
    bundle: Bundle,
    metrics: Metrics,
}

impl Baked {
    fn error(&self, method: &str) -> f64 {
        self.metrics.method(method).map_or(f64::NAN, |row| row.mse)
    }
}

impl Lab<'_> {
    fn subjects(&self) -> Result<Vec<Subject<'_>>, BakeError> {
        let subject = |dir| {
            let absolute = Path::canonicalize(dir).map_err(io(dir))?;
            let name = absolute.file_name().unwrap_or_default();
            Ok(Subject {
                name: name.to_string_lossy().into_owned(),
                digest: folder_digest(dir)?,
                dir,
            })
        };
        self.job
            .captures
            .iter()
            .map(|dir| subject(dir.as_path()))
            .collect()
    }

    /// Bakes a capture with these settings in place of the recipe's, unless that has been done.
    fn baked(
        &self,
        subject: &Subject<'_>,
        variant: &str,
        settings: &[(&str, String)],
    ) -> Result<Baked, BakeError> {
        self.baked_as(self.job.recipe.clone(), subject, variant, settings)
    }

    fn baked_as(
        &self,
        mut recipe: Recipe,
        subject: &Subject<'_>,
        variant: &str,
        settings: &[(&str, String)],
    ) -> Result<Baked, BakeError> {
        for (key, value) in settings {
            recipe.settings.insert((*key).to_owned(), value.clone());
        }
        let work_dir = self.job.out.join("bakes").join(format!(
            "{}-{}-{variant}",
            subject.name,
            subject
                .digest
                .trim_start_matches("sha256:")
                .get(..8)
                .unwrap_or_default()
        ));
        let wanted = serde_json::to_value(&recipe).unwrap_or_default();
        let dir = work_dir.join("bundle");
        let done = Bundle::open(&dir).ok().filter(|bundle| {
            bundle.manifest().recipe == wanted && bundle.manifest().capture == subject.digest
        });
        let bundle = if let Some(bundle) = done {
            bundle
        } else {
            let job = BakeJob {
                capture_dir: subject.dir.to_owned(),
                capture_digest: subject.digest.clone(),
                object: ("experiment".into(), subject.name.clone()),
                recipe,
                checkpoint: None,
                work_dir,
                threads: self.job.threads,
            };
            Bundle::open(&bake(&job, self.events)?)?
        };
        let metrics = bundle.metrics()?.ok_or_else(|| BakeError::Unusable {
            message: format!("the bundle of {} has no metrics", subject.name),
            hint: "remove its folder and run the experiment again".into(),
        })?;
        Ok(Baked {
            dir,
            bundle,
            metrics,
        })
    }

    fn methods(&self) -> Result<Table, BakeError> {
        let names: Vec<&str> = Method::ALL.into_iter().map(Method::name).collect();
        let wanted = self.job.recipe.settings.get("methods").cloned();
        let wanted = [("methods", wanted.unwrap_or_else(|| names.join(",")))];
        let mut rows = Vec::new();
        let mut points: Vec<(String, Vec<(f64, f64)>)> = Vec::new();
        for subject in self.subjects()? {
            let baked = self.baked(&subject, "methods", &wanted)?;
            for method in &baked.metrics.methods {
                rows.push(Row::new(
                    &[&subject.name, &method.name],
                    &[
                        method.mse,
                        method.mse_object,
                        method.psnr,
                        method.ssim,
                        method.mse / baked.error("n_ibr"),
                        method.train_secs,
                        method.render_ms,
                    ],
                ));
                let point = (method.train_secs, method.mse);
                match points.iter_mut().find(|(name, _)| *name == method.name) {
                    Some((_, points)) => points.push(point),
                    None => points.push((method.name.clone(), vec![point])),
                }
            }
        }
        let series = points
            .into_iter()
            .map(|(name, points)| Series::dots(&name, &method_label(&name), points));
        Ok(Table {
            caption: "Errors of every method over captures; a dot of the plot is a capture.",
            labels: &["capture", "method"],
            columns: &[
                "mse",
                "mse_object",
                "psnr",
                "ssim",
                "of_n_ibr",
                "train_secs",
                "render_ms",
            ],
            rows,
            series: series.collect(),
            x: Axis::log("training time", Unit::Seconds),
            y: table::ERROR,
        })
    }

    fn effects(&self) -> Result<Table, BakeError> {
        let settings = [
            ("effects", "on".to_owned()),
            ("methods", Method::OursNoEffects.name().to_owned()),
        ];
        let (mut rows, mut series) = (Vec::new(), Vec::new());
        for subject in self.subjects()? {
            let baked = self.baked(&subject, "effects", &settings)?;
            let (without, with) = (baked.error("ours_no_effects"), baked.error("ours"));
            rows.push(Row::new(&[&subject.name], &[without, with, with / without]));
            for name in ["ours_no_effects", "ours"] {
                let curve = baked
                    .metrics
                    .speed_error
                    .iter()
                    .filter(|p| p.method == name);
                let label = format!("{}, {}", subject.name, method_label(name));
                series.push(Series::new(
                    name,
                    &label,
                    curve.map(|p| (p.secs, p.mse)).collect(),
                ));
            }
        }
        Ok(Table {
            caption: "Mean squared error on held-out views without and with EffectsNet.",
            labels: &["capture"],
            columns: &["without_effects", "with_effects", "ratio"],
            rows,
            series,
            x: Axis::log("training time", Unit::Seconds),
            y: table::ERROR,
        })
    }

    fn diffuse(&self) -> Result<Table, BakeError> {
        let settings = [("effects", "on".to_owned()), ("methods", "none".to_owned())];
        let (mut rows, mut series) = (Vec::new(), Vec::new());
        for subject in self.subjects()? {
            let truth = diffuse::Truth::of(subject.dir)?;
            let baked = self.baked(&subject, "diffuse", &settings)?;
            let errors = truth.errors(&self.job.recipe, &baked.dir)?;
            let mean = |pick: fn(&diffuse::ViewErrors) -> f64| {
                errors.iter().map(pick).sum::<f64>() / errors.len().max(1) as f64
            };
            let (photograph, estimated) = (mean(|e| e.photograph), mean(|e| e.estimated));
            rows.push(Row::new(
                &[&subject.name],
                &[photograph, estimated, estimated / photograph],
            ));
            let points = errors.iter().map(|e| (e.photograph, e.estimated)).collect();
            series.push(Series::dots("ours", &subject.name, points));
        }
        Ok(Table {
            caption: "Mean squared error against the diffuse truth of held-out views: of the photograph itself, and of the \
                      estimated diffuse image.",
            labels: &["capture"],
            columns: &["photograph", "estimated", "ratio"],
            rows,
            series,
            x: Axis::log("error of the photograph", Unit::Plain),
            y: Axis::log("error of the estimated diffuse image", Unit::Plain),
        })
    }

    fn corpus(&self) -> Result<Table, BakeError> {
        let rival = Method::Pix2pixPosition.name();
        let (mut rows, mut series) = (Vec::new(), Vec::new());
        for subject in self.subjects()? {
            let mut views = usize::MAX;
            let (mut ours, mut theirs) = (Vec::new(), Vec::new());
            while views >= LEAST_VIEWS {
                let mut settings = vec![("methods", rival.to_owned())];
                let whole = views == usize::MAX;
                if !whole {
                    settings.push(("train_views", views.to_string()));
                }
                let variant = if whole {
                    "all".to_owned()
                } else {
                    views.to_string()
                };
                let baked = self.baked(&subject, &format!("corpus-{variant}"), &settings)?;
                let used = baked.metrics.views.train as usize;
                let errors = [baked.error("ours"), baked.error(rival)];
                rows.push(Row::new(
                    &[&subject.name],
                    &[used as f64, errors[0], errors[1]],
                ));
                ours.push((used as f64, errors[0]));
                theirs.push((used as f64, errors[1]));
                views = used / 2;
            }
            let label = |name| format!("{}, {}", subject.name, method_label(name));
            series.push(Series::new("ours", &label("ours"), reversed(ours)));
            series.push(Series::new(rival, &label(rival), reversed(theirs)));
        }
        Ok(Table {
            caption: "Mean squared error on held-out views as the training corpus is halved.",
            labels: &["capture"],
            columns: &["train_views", "ours", "pix2pix_position"],
            rows,
            series,
            x: Axis::log("training views", Unit::Plain),
            y: table::ERROR,
        })
    }

    fn references(&self) -> Result<Table, BakeError> {
        let (mut rows, mut series) = (Vec::new(), Vec::new());
        for subject in self.subjects()? {
            let mut errors_of = |n: usize, k: usize| -> Result<(f64, f64), BakeError> {
                let settings = [
                    ("references", n.to_string()),
                    ("k", k.to_string()),
                    ("methods", "n_ibr,ibr".to_owned()),
                ];
                let baked = self.baked(&subject, &format!("references-{n}-{k}"), &settings)?;
                let used = f64::from(baked.metrics.views.references);
                let [naive, debevec, ours] = ["n_ibr", "ibr", "ours"].map(|name| baked.error(name));
                let row = Row::new(&[&subject.name], &[used, k as f64, naive, debevec, ours]);
                if !rows.contains(&row) {
                    rows.push(row);
                }
                Ok((used, ours))
            };
            let by_count = REFERENCES
                .into_iter()
                .map(|n| errors_of(n, PAPER_NEAREST))
                .collect::<Result<_, _>>()?;
            let by_nearest = NEAREST
                .into_iter()
                .map(|k| Ok((k as f64, errors_of(PAPER_REFERENCES, k)?.1)))
                .collect::<Result<_, BakeError>>()?;
            let label = |what| format!("{}, {what}", subject.name);
            series.push(Series::new("ours", &label("references"), by_count));
            series.push(Series::new("ours_no_effects", &label("K"), by_nearest));
        }
        Ok(Table {
            caption: "Mean squared error on held-out views over the number of references (K = 4) and over K (20 references).",
            labels: &["capture"],
            columns: &["references", "k", "n_ibr", "ibr", "ours"],
            rows,
            series,
            x: Axis::log("references, or K", Unit::Plain),
            y: table::ERROR,
        })
    }

    fn temporal(&self) -> Result<Table, BakeError> {
        let settings = [("methods", "none".to_owned())];
        let (mut rows, mut series) = (Vec::new(), Vec::new());
        for subject in self.subjects()? {
            let baked = self.baked(&subject, "temporal", &settings)?;
            let steps = temporal::residuals(&baked.bundle)?;
            let mean = |pick: fn(&temporal::Step) -> f64| {
                steps.iter().map(pick).sum::<f64>() / steps.len() as f64
            };
            let (ours, truth) = (mean(|s| s.ours), mean(|s| s.truth));
            rows.push(Row::new(
                &[&subject.name],
                &[steps.len() as f64 + 1.0, ours, truth, ours / truth],
            ));
            let curve = |pick: fn(&temporal::Step) -> f64| {
                steps
                    .iter()
                    .zip(1..)
                    .map(|(s, frame)| (f64::from(frame), pick(s)))
                    .collect()
            };
            let label = |what| format!("{}, {what}", subject.name);
            series.push(Series::new("ours", &label("ours"), curve(|s| s.ours)));
            series.push(Series::new(
                "truth",
                &label("photographs"),
                curve(|s| s.truth),
            ));
        }
        Ok(Table {
            caption: "Mean squared difference of each frame from the one before, warped into it where both see the surface: \
                      what is above the photographs' own is flicker.",
            labels: &["capture"],
            columns: &["frames", "ours", "photographs", "ratio"],
            rows,
            series,
            x: Axis::even("frame"),
            y: Axis::log("warp residual, 0 to 255", Unit::Plain),
        })
    }
}

fn reversed<T>(mut values: Vec<T>) -> Vec<T> {
    values.reverse();
    values
}
