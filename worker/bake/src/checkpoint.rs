//! Checkpoints and the training loop that makes them.
//!
//! A checkpoint is one safetensors file: the finished networks, the network in training with its optimiser, and a
//! JSON header with everything else that decides the rest of the bake. Random choices are made per step from the seed
//! (see `sampler`), so training on from a checkpoint gives what training without a break would have given.
//! With a time budget the schedule follows the clock, and only then two runs differ.

use ign_bundle::metrics::SpeedError;
use ign_events::Event;
use ign_nets::optim::{Adam, AdamState};
use ign_nets::params::{Params, flat_values};
use safetensors::{Dtype, SafeTensors, tensor::TensorView};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};
use std::time::Instant;

use crate::BakeError;
use crate::progress::Reporter;
use crate::recipe::Recipe;

const SCHEMA: &str = "ign.checkpoint/1";
const META_KEY: &str = "ign";
/// Checkpoint files kept in the work folder: an upload may still read the one before the newest.
const KEPT_FILES: u64 = 3;
/// Observations per stage: validation error, best weights, points of the speed-against-error curve.
const OBSERVATIONS: u64 = 8;
/// How often a stage may fall back to its last good state before the bake gives up.
const MAX_FALLBACKS: u32 = 4;

/// A network in training.
#[derive(Debug)]
pub(crate) struct Trainee {
    pub(crate) params: Params,
    pub(crate) adam: Adam,
}

/// Weights by name: shape and values.
pub(crate) type Weights = BTreeMap<String, (Vec<i64>, Vec<f32>)>;

#[derive(Clone, Debug, Serialize, Deserialize)]
struct Meta {
    schema: String,
    recipe: Recipe,
    capture: String,
    current: Option<Current>,
    finished: Vec<String>,
    secs: BTreeMap<String, f64>,
    measured: BTreeMap<String, f64>,
    curve: Vec<SpeedError>,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
struct Current {
    stage: String,
    step: u64,
    elapsed_secs: f64,
    observed: u64,
    rate_scale: f64,
    fallbacks: u32,
    adam_steps: Vec<u64>,
    /// Lowest observed error.
    best_error: Option<f64>,
}

/// What a stage's training leaves.
pub(crate) struct Outcome {
    pub(crate) trainees: Vec<Trainee>,
    /// Averaged weights of the first network at the observation with the lowest error.
    best: Option<Vec<f32>>,
}

impl Outcome {
    /// The first network with its averaged weights of the best observation; without observations, of the end.
    pub(crate) fn best(&self) -> Result<Params, BakeError> {
        let Trainee { params, adam } = &self.trainees[0];
        let averaged = adam.averaged(params);
        if let Some(best) = &self.best {
            averaged.restore(best)?;
        }
        Ok(averaged)
    }
}

/// How long a stage trains.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Schedule {
    pub(crate) steps: u64,
    pub(crate) budget_secs: Option<f64>,
}

/// State of a bake that survives its process.
pub(crate) struct Session<'a> {
    pub(crate) reporter: &'a Reporter<'a>,
    dir: PathBuf,
    interval_secs: f64,
    last_saved: Instant,
    files: u64,
    meta: Meta,
    weights: BTreeMap<String, Weights>,
    resumed: Option<Snapshot>,
}

#[derive(Clone)]
struct Snapshot {
    flat: Vec<Vec<f32>>,
    adam: Vec<AdamState>,
    best: Option<Vec<f32>>,
}

impl Snapshot {
    fn of(trainees: &[Trainee], best: Option<&Vec<f32>>) -> Self {
        Self {
            flat: trainees
                .iter()
                .map(|t| flat_values(t.params.flat()))
                .collect(),
            adam: trainees.iter().map(|t| t.adam.state()).collect(),
            best: best.cloned(),
        }
    }

    fn restore(&self, trainees: &mut [Trainee]) -> Result<(), BakeError> {
        for ((trainee, flat), adam) in trainees.iter_mut().zip(&self.flat).zip(&self.adam) {
            trainee.params.restore(flat)?;
            trainee.adam.restore(adam)?;
        }
        Ok(())
    }
}

impl<'a> Session<'a> {
    /// Starts from `checkpoint` where it can be read and is of the same recipe and capture, else afresh: training again
    /// costs time, but an error would come back at every further attempt.
    pub(crate) fn open(
        reporter: &'a Reporter<'a>,
        dir: &Path,
        interval_secs: f64,
        recipe: &Recipe,
        capture: &str,
        checkpoint: Option<&Path>,
    ) -> Result<Self, BakeError> {
        std::fs::create_dir_all(dir).map_err(|source| BakeError::Io {
            path: dir.to_owned(),
            source,
        })?;
        let mut session = Self {
            reporter,
            dir: dir.to_owned(),
            interval_secs,
            last_saved: Instant::now(),
            files: 0,
            meta: Meta {
                schema: SCHEMA.into(),
                recipe: recipe.clone(),
                capture: capture.into(),
                current: None,
                finished: Vec::new(),
                secs: BTreeMap::new(),
                measured: BTreeMap::new(),
                curve: Vec::new(),
            },
            weights: BTreeMap::new(),
            resumed: None,
        };
        if let Some(path) = checkpoint
            && let Err(error) = session.load(path)
        {
            reporter.warn(format!("{error}; training starts from the beginning"));
        }
        Ok(session)
    }

    /// Weights of a stage that ended, averaged.
    pub(crate) fn finished(&self, stage: &str) -> Option<&Weights> {
        self.meta
            .finished
            .iter()
            .any(|name| name == stage)
            .then(|| self.weights.get(stage))
            .flatten()
    }

    /// Training seconds of a stage so far.
    pub(crate) fn secs(&self, stage: &str) -> f64 {
        self.meta.secs.get(stage).copied().unwrap_or(0.0)
    }

    /// A figure that decided something; measured once, kept over a resume.
    pub(crate) fn measured(&mut self, name: &str, measure: impl FnOnce() -> f64) -> f64 {
        if let Some(value) = self.meta.measured.get(name) {
            return *value;
        }
        let value = measure();
        self.meta.measured.insert(name.to_owned(), value);
        value
    }

    /// Everything measured so far, by name.
    pub(crate) fn measurements(&self) -> &BTreeMap<String, f64> {
        &self.meta.measured
    }

    /// Adds a point of the speed-against-error curve.
    pub(crate) fn curve_point(&mut self, point: SpeedError) {
        self.meta.curve.push(point);
    }

    /// The speed-against-error curve so far.
    pub(crate) fn curve(&self) -> &[SpeedError] {
        &self.meta.curve
    }

    /// Trains one stage to its end, from where a checkpoint left it.
    ///
    /// `step` trains once and returns the loss; it gets the step's number, the fraction of the stage that is done and
    /// a factor for its learning rate. `observe` is called about [`OBSERVATIONS`] times with the training seconds so
    /// far. Time spent observing or saving does not count.
    pub(crate) fn train(
        &mut self,
        stage: &'static str,
        mut trainees: Vec<Trainee>,
        schedule: Schedule,
        mut step: impl FnMut(&mut [Trainee], u64, f64, f64) -> f64,
        mut observe: impl FnMut(&mut Self, &[Trainee], f64) -> Result<Option<f64>, BakeError>,
    ) -> Result<Outcome, BakeError> {
        let mut best = None;
        let mut current = match self.meta.current.take() {
            Some(current) if current.stage == stage => {
                if let Some(snapshot) = self.resumed.take() {
                    snapshot.restore(&mut trainees)?;
                    best = snapshot.best;
                }
                self.reporter.info(format!(
                    "{stage}: resumed at step {} from the checkpoint",
                    current.step
                ));
                current
            }
            _ => Current {
                stage: stage.into(),
                step: 0,
                elapsed_secs: 0.0,
                observed: 0,
                rate_scale: 1.0,
                fallbacks: 0,
                adam_steps: Vec::new(),
                best_error: None,
            },
        };
        let mut good = (current.clone(), Snapshot::of(&trainees, best.as_ref()));
        let clock = Instant::now();
        let before = current.elapsed_secs;
        let mut elapsed = before;
        let mut paused = 0.0;
        loop {
            let by_steps = current.step as f64 / schedule.steps.max(1) as f64;
            let by_time = schedule
                .budget_secs
                .map_or(0.0, |budget| elapsed / budget.max(1e-3));
            let fraction = by_steps.max(by_time).min(1.0);
            if fraction * OBSERVATIONS as f64 >= current.observed as f64 {
                let pause = Instant::now();
                current.observed += 1;
                let error = observe(self, &trainees, elapsed)?;
                if let Some(error) = error {
                    self.reporter.error(error);
                    if current.best_error.is_none_or(|lowest| error <= lowest) {
                        current.best_error = Some(error);
                        best = Some(flat_values(
                            trainees[0].adam.averaged(&trainees[0].params).flat(),
                        ));
                    }
                }
                good = (current.clone(), Snapshot::of(&trainees, best.as_ref()));
                paused += pause.elapsed().as_secs_f64();
            }
            if fraction >= 1.0 {
                break;
            }
            let loss = step(&mut trainees, current.step, fraction, current.rate_scale);
            current.step += 1;
            if !loss.is_finite() {
                if good.0.fallbacks >= MAX_FALLBACKS {
                    return Err(BakeError::Diverged {
                        stage,
                        step: current.step,
                    });
                }
                self.reporter.warn(format!(
                    "{stage}: the loss at step {} is not finite; back to step {} with half the learning rate",
                    current.step, good.0.step
                ));
                good.0.fallbacks += 1;
                good.0.rate_scale *= 0.5;
                current = good.0.clone();
                good.1.restore(&mut trainees)?;
            }
            elapsed = before + clock.elapsed().as_secs_f64() - paused;
            current.elapsed_secs = elapsed;
            self.reporter
                .step(fraction, &format!("step {} loss {loss:.4}", current.step));
            if self.last_saved.elapsed().as_secs_f64() >= self.interval_secs {
                let pause = Instant::now();
                self.save(Some((&current, &Snapshot::of(&trainees, best.as_ref()))))?;
                paused += pause.elapsed().as_secs_f64();
            }
        }
        self.meta.secs.insert(stage.into(), elapsed);
        let skipped: u64 = trainees.iter().map(|t| t.adam.skipped()).sum();
        if skipped > 0 {
            self.reporter.warn(format!(
                "{stage}: {skipped} steps had gradients that were not finite and were left out"
            ));
        }
        Ok(Outcome { trainees, best })
    }

    /// Keeps a stage's weights and writes a checkpoint.
    pub(crate) fn finish(&mut self, stage: &str, params: &Params) -> Result<(), BakeError> {
        let weights = params
            .export()
            .into_iter()
            .map(|(name, shape, values)| (name, (shape, values)))
            .collect();
        self.weights.insert(stage.into(), weights);
        self.meta.finished.push(stage.into());
        self.save(None)
    }

    fn save(&mut self, current: Option<(&Current, &Snapshot)>) -> Result<(), BakeError> {
        let mut meta = self.meta.clone();
        let mut tensors: Vec<(String, Vec<usize>, Vec<u8>)> = Vec::new();
        for (stage, weights) in &self.weights {
            for (name, (shape, values)) in weights {
                let shape = shape.iter().map(|&n| n as usize).collect();
                tensors.push((format!("finished/{stage}/{name}"), shape, bytes(values)));
            }
        }
        if let Some((current, snapshot)) = current {
            let mut current = current.clone();
            current.adam_steps = snapshot.adam.iter().map(|state| state.steps).collect();
            meta.current = Some(current);
            if let Some(best) = &snapshot.best {
                tensors.push(("current/best".into(), vec![best.len()], bytes(best)));
            }
            for (index, (flat, adam)) in snapshot.flat.iter().zip(&snapshot.adam).enumerate() {
                for (name, values) in [
                    ("flat", flat),
                    ("first", &adam.first),
                    ("second", &adam.second),
                    ("average", &adam.average),
                ] {
                    tensors.push((
                        format!("current/{index}/{name}"),
                        vec![values.len()],
                        bytes(values),
                    ));
                }
            }
        }
        let path = self
            .dir
            .join(format!("checkpoint-{:06}.safetensors", self.files));
        let partial = path.with_extension("partial");
        let json = serde_json::to_string(&meta).map_err(|e| unusable(&path, &e))?;
        let views: Vec<(String, TensorView<'_>)> = tensors
            .iter()
            .map(|(name, shape, data)| {
                TensorView::new(Dtype::F32, shape.clone(), data)
                    .map(|view| (name.clone(), view))
                    .map_err(|e| unusable(&path, &e))
            })
            .collect::<Result<_, _>>()?;
        let data =
            safetensors::serialize(views, Some(HashMap::from([(META_KEY.to_owned(), json)])))
                .map_err(|e| unusable(&path, &e))?;
        let io = |source| BakeError::Io {
            path: path.clone(),
            source,
        };
        std::fs::write(&partial, data).map_err(io)?;
        std::fs::rename(&partial, &path).map_err(io)?;
        if self.files >= KEPT_FILES {
            let old = self.dir.join(format!(
                "checkpoint-{:06}.safetensors",
                self.files - KEPT_FILES
            ));
            if let Err(error) = std::fs::remove_file(&old) {
                tracing::debug!(%error, file = %old.display(), "old checkpoint stays");
            }
        }
        self.files += 1;
        self.last_saved = Instant::now();
        self.reporter.emit(Event::Checkpoint { path });
        Ok(())
    }

    fn load(&mut self, path: &Path) -> Result<(), BakeError> {
        let data = std::fs::read(path).map_err(|source| BakeError::Io {
            path: path.to_owned(),
            source,
        })?;
        let (_, header) = SafeTensors::read_metadata(&data).map_err(|e| unusable(path, &e))?;
        let json = header.metadata().as_ref().and_then(|map| map.get(META_KEY));
        let meta: Meta =
            serde_json::from_str(json.ok_or_else(|| unusable(path, &"it has no header"))?)
                .map_err(|e| unusable(path, &e))?;
        if meta.schema != SCHEMA
            || meta.recipe != self.meta.recipe
            || meta.capture != self.meta.capture
        {
            return Err(unusable(
                path,
                &"it belongs to another recipe, capture or version",
            ));
        }
        let file = SafeTensors::deserialize(&data).map_err(|e| unusable(path, &e))?;
        let values = |name: &str| -> Result<(Vec<i64>, Vec<f32>), BakeError> {
            let view = file.tensor(name).map_err(|e| unusable(path, &e))?;
            let shape = view.shape().iter().map(|&n| n as i64).collect();
            Ok((shape, floats(view.data())))
        };
        let mut weights: BTreeMap<String, Weights> = BTreeMap::new();
        for name in file.names() {
            if let Some((stage, tensor)) = name
                .strip_prefix("finished/")
                .and_then(|rest| rest.split_once('/'))
            {
                weights
                    .entry(stage.into())
                    .or_default()
                    .insert(tensor.into(), values(name)?);
            }
        }
        let mut resumed = None;
        if let Some(current) = &meta.current {
            let mut snapshot = Snapshot {
                flat: Vec::new(),
                adam: Vec::new(),
                best: None,
            };
            if current.best_error.is_some() {
                snapshot.best = Some(values("current/best")?.1);
            }
            for (index, &steps) in current.adam_steps.iter().enumerate() {
                let part = |name: &str| {
                    values(&format!("current/{index}/{name}")).map(|(_, values)| values)
                };
                snapshot.flat.push(part("flat")?);
                snapshot.adam.push(AdamState {
                    first: part("first")?,
                    second: part("second")?,
                    average: part("average")?,
                    steps,
                });
            }
            resumed = Some(snapshot);
        }
        (self.meta, self.weights, self.resumed) = (meta, weights, resumed);
        Ok(())
    }
}

fn unusable(path: &Path, reason: &dyn std::fmt::Display) -> BakeError {
    BakeError::Checkpoint {
        path: path.to_owned(),
        reason: reason.to_string(),
    }
}

fn bytes(values: &[f32]) -> Vec<u8> {
    values
        .iter()
        .flat_map(|value| value.to_le_bytes())
        .collect()
}

fn floats(data: &[u8]) -> Vec<f32> {
    data.chunks_exact(4)
        .map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]))
        .collect()
}

/// Copies stored weights into a network.
pub(crate) fn load_weights(params: &mut Params, weights: &Weights) -> Result<(), BakeError> {
    params.import(|name| {
        weights
            .get(name)
            .map(|(shape, values)| (shape.as_slice(), values.as_slice()))
    })?;
    Ok(())
}
