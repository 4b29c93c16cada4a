//! Checkpoints and the training loop that makes them.
//!
//! A checkpoint is one safetensors file: the finished networks, the network in training with its optimiser, and a
//! JSON header with everything else that decides the rest of the bake. Random choices are made per step from the seed
//! (see `sampler`), so training on from a checkpoint gives what training without a break would have given.
//! With a time budget the schedule follows the clock, and only then two runs differ.

use ign_bundle::metrics::SpeedError;
use ign_events::Event;
use ign_nets::optim::{OptimizerState, Trainee};
use ign_nets::params::{Builder, Params, flat_values};
use safetensors::{Dtype, SafeTensors, tensor::TensorView};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};
use std::time::Instant;
use tch::Device;

use crate::BakeError;
use crate::divergence::{Fallback, Watchdog};
use crate::progress::Reporter;
use crate::recipe::Recipe;
use crate::schedule::{Course, Schedule};

const SCHEMA: &str = "ign.checkpoint/2";
const META_KEY: &str = "ign";
/// Checkpoint files kept in the work folder: an upload may still read the one before the newest.
const KEPT_FILES: u64 = 3;
/// How often a stage may fall back to its last good state before it ends.
const MAX_FALLBACKS: u32 = 4;
/// Factor of the learning rate at every fallback.
const SLOWER: f64 = 0.25;
/// More steps than any stage trains; what a checkpoint counts stays below.
const MAX_COUNT: u64 = 1 << 40;

/// Weights by name: shape and values.
type Weights = BTreeMap<String, (Vec<i64>, Vec<f32>)>;

#[derive(Clone, Debug, Serialize, Deserialize)]
struct Meta {
    schema: String,
    recipe: Recipe,
    capture: String,
    current: Option<Current>,
    finished: Vec<String>,
    secs: BTreeMap<String, f64>,
    steps: BTreeMap<String, u64>,
    measured: BTreeMap<String, f64>,
    curve: Vec<SpeedError>,
    fallbacks: Vec<Fallback>,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
struct Current {
    stage: String,
    step: u64,
    elapsed_secs: f64,
    course: Course,
    rate_scale: f64,
    fallbacks: u32,
    watchdog: Watchdog,
    adam_steps: Vec<u64>,
}

/// One network's training.
pub(crate) struct Stage<'a> {
    /// In checkpoints.
    pub(crate) name: &'static str,
    pub(crate) schedule: Schedule,
    /// What is measured on the way.
    pub(crate) watch: Option<Watch<'a>>,
}

/// What is measured now and then while a network trains.
pub(crate) struct Watch<'a> {
    /// Whether the weights of the lowest validation error are kept, not those of the end. The curve is the error of what
    /// would be kept if training ended there.
    pub(crate) keep_best: bool,
    /// Error on the validation views; `None` when there are none.
    pub(crate) validation: &'a dyn Fn(&Params) -> Option<f64>,
    pub(crate) curve: Option<Curve<'a>>,
}

/// A speed-against-error curve.
pub(crate) struct Curve<'a> {
    /// Its row of metrics.json.
    pub(crate) method: &'static str,
    /// Training seconds spent before this stage on what the method needs.
    pub(crate) secs_before: f64,
    /// Errors on the held-out views, full frame and object; they decide nothing.
    pub(crate) held_out: &'a dyn Fn(&Params) -> (f64, f64),
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
    optimizers: Vec<OptimizerState>,
    best: Option<Vec<f32>>,
}

impl Snapshot {
    fn of(trainees: &[Trainee], best: Option<&Vec<f32>>) -> Self {
        Self {
            flat: trainees
                .iter()
                .map(|t| flat_values(t.params.flat()))
                .collect(),
            optimizers: trainees.iter().map(|t| t.optimizer.state()).collect(),
            best: best.cloned(),
        }
    }

    fn restore(&self, trainees: &mut [Trainee]) -> Result<(), BakeError> {
        for ((trainee, flat), state) in trainees.iter_mut().zip(&self.flat).zip(&self.optimizers) {
            trainee.params.restore(flat)?;
            trainee.optimizer.restore(state)?;
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
                steps: BTreeMap::new(),
                measured: BTreeMap::new(),
                curve: Vec::new(),
                fallbacks: Vec::new(),
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

    /// Whether a stage has ended.
    pub(crate) fn finished(&self, stage: &str) -> bool {
        self.meta.finished.iter().any(|name| name == stage)
    }

    /// A network for `stage`, which has ended, with its weights.
    ///
    /// # Errors
    /// A checkpoint without these weights, or with others.
    pub(crate) fn restore<N>(
        &self,
        stage: &str,
        device: Device,
        register: impl FnOnce(&mut Builder) -> N,
    ) -> Result<(N, Params), BakeError> {
        let mut builder = Builder::new();
        let net = register(&mut builder);
        let mut params = builder.build(device, 0);
        let weights = self
            .weights
            .get(stage)
            .ok_or_else(|| unusable(&self.dir, &format!("it lacks the weights of {stage}")))?;
        params.import(|name| {
            weights
                .get(name)
                .map(|(shape, values)| (shape.as_slice(), values.as_slice()))
        })?;
        Ok((net, params))
    }

    /// Training seconds of a stage so far.
    pub(crate) fn secs(&self, stage: &str) -> f64 {
        self.meta.secs.get(stage).copied().unwrap_or(0.0)
    }

    /// Training steps of a stage that has ended.
    pub(crate) fn steps(&self, stage: &str) -> u64 {
        self.meta.steps.get(stage).copied().unwrap_or(0)
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

    /// Whether the curve of a method has begun.
    pub(crate) fn has_curve(&self, method: &str) -> bool {
        self.meta.curve.iter().any(|point| point.method == method)
    }

    /// The speed-against-error curve so far.
    pub(crate) fn curve(&self) -> &[SpeedError] {
        &self.meta.curve
    }

    /// Trainings that diverged and went back.
    pub(crate) fn fallbacks(&self) -> &[Fallback] {
        &self.meta.fallbacks
    }

    /// Trains one stage to its end, from where a checkpoint left it, and keeps its first network's averaged weights.
    ///
    /// `step` trains once and returns the loss; it gets the step's number and its learning rate as a share of the peak.
    /// Time spent on watching or saving does not count. A training that diverges goes back to the last observation with a lower rate, and after
    /// [`MAX_FALLBACKS`] of these ends with its best weights.
    ///
    /// # Errors
    /// A checkpoint that cannot be written, or a divergence without weights to keep.
    pub(crate) fn train(
        &mut self,
        stage: &Stage<'_>,
        mut trainees: Vec<Trainee>,
        mut step: impl FnMut(&mut [Trainee], u64, f64) -> f64,
    ) -> Result<(), BakeError> {
        let (name, schedule) = (stage.name, &stage.schedule);
        let mut best = None;
        let mut current = match self.meta.current.take() {
            Some(current) if current.stage == name => {
                if let Some(snapshot) = self.resumed.take() {
                    snapshot.restore(&mut trainees)?;
                    best = snapshot.best;
                }
                self.reporter.info(format!(
                    "{name}: resumed at step {} from the checkpoint",
                    current.step
                ));
                current
            }
            _ => Current {
                stage: name.into(),
                step: 0,
                elapsed_secs: 0.0,
                course: Course::default(),
                rate_scale: 1.0,
                fallbacks: 0,
                watchdog: Watchdog::default(),
                adam_steps: Vec::new(),
            },
        };
        let mut good = (current.clone(), Snapshot::of(&trainees, best.as_ref()));
        let clock = Instant::now();
        let before = current.elapsed_secs;
        let mut elapsed = before;
        let mut paused = 0.0;
        let activity = self.reporter.activity("steps");
        loop {
            let progress = schedule.progress(current.step, elapsed);
            if schedule.is_due(&current.course, current.step, progress) {
                let pause = Instant::now();
                self.reporter.activity("watching");
                let averaged = trainees[0].optimizer.averaged(&trainees[0].params);
                let watch = stage.watch.as_ref();
                let error = watch.and_then(|watch| (watch.validation)(&averaged));
                if let Some(watch) = watch {
                    self.observe(watch, error, &averaged, &current, &mut best);
                }
                schedule.observed(&mut current.course, current.step, progress, error);
                good = (current.clone(), Snapshot::of(&trainees, best.as_ref()));
                self.reporter.activity("steps");
                paused += pause.elapsed().as_secs_f64();
            }
            let end = current.course.end();
            if progress >= end {
                break;
            }
            let skipped = skipped_steps(&trainees);
            let rate = schedule.rate(&current.course, current.step, progress) * current.rate_scale;
            let loss = step(&mut trainees, current.step, rate);
            let applied = skipped_steps(&trainees) == skipped;
            current.step += 1;
            if let Some(reason) = current.watchdog.diverged(loss, applied) {
                let ended = good.0.fallbacks >= MAX_FALLBACKS;
                if ended && best.is_none() {
                    return Err(BakeError::Diverged {
                        stage: name,
                        step: current.step,
                    });
                }
                good.0.fallbacks += 1;
                good.0.rate_scale *= SLOWER;
                let fallback = Fallback {
                    stage: name.into(),
                    step: current.step,
                    back_to: good.0.step,
                    rate_scale: if ended { 0.0 } else { good.0.rate_scale },
                    reason: reason.into(),
                };
                self.reporter.warn(fallback.words());
                self.meta.fallbacks.push(fallback);
                current = good.0.clone();
                good.1.restore(&mut trainees)?;
                if ended {
                    break;
                }
            }
            elapsed = before + clock.elapsed().as_secs_f64() - paused;
            current.elapsed_secs = elapsed;
            self.reporter.step(
                progress / end,
                &format!("step {} loss {loss:.4}", current.step),
            );
            if self.last_saved.elapsed().as_secs_f64() >= self.interval_secs {
                let pause = Instant::now();
                self.reporter.activity("saving");
                self.save(Some((&current, &Snapshot::of(&trainees, best.as_ref()))))?;
                self.reporter.activity("steps");
                paused += pause.elapsed().as_secs_f64();
            }
        }
        self.reporter.activity(activity);
        self.meta.secs.insert(name.into(), elapsed);
        self.meta.steps.insert(name.into(), current.step);
        if current.course.ended_early() {
            self.reporter.info(format!(
                "{name}: ended after {} steps: more did not pay",
                current.step
            ));
        }
        let skipped = skipped_steps(&trainees);
        if skipped > 0 {
            self.reporter.warn(format!(
                "{name}: {skipped} steps had gradients that were not finite and were left out"
            ));
        }
        let Trainee { params, optimizer } = &trainees[0];
        let averaged = optimizer.averaged(params);
        if let Some(best) = &best {
            averaged.restore(best)?;
        }
        self.finish(name, &averaged)
    }

    /// Keeps the weights of a network in training where its validation error is the lowest, and adds a point to its curve.
    fn observe(
        &mut self,
        watch: &Watch<'_>,
        error: Option<f64>,
        averaged: &Params,
        current: &Current,
        best: &mut Option<Vec<f32>>,
    ) {
        let better = match (error, current.course.lowest()) {
            (Some(error), Some(lowest)) => error <= lowest,
            _ => true,
        };
        if watch.keep_best && better {
            *best = Some(flat_values(averaged.flat()));
        }
        let Some(curve) = &watch.curve else {
            return;
        };
        if let Some(error) = error {
            self.reporter.error(error);
        }
        let before = self
            .meta
            .curve
            .iter()
            .rfind(|point| point.method == curve.method)
            .map(|point| (point.mse, point.mse_object));
        let (mse, mse_object) = match before {
            Some(errors) if watch.keep_best && !better => errors,
            _ => (curve.held_out)(averaged),
        };
        self.curve_point(SpeedError {
            method: curve.method.into(),
            secs: curve.secs_before + current.elapsed_secs,
            mse,
            mse_object,
        });
    }

    /// Keeps a stage's weights and writes a checkpoint.
    fn finish(&mut self, stage: &str, params: &Params) -> Result<(), BakeError> {
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
            current.adam_steps = snapshot
                .optimizers
                .iter()
                .map(|state| state.steps)
                .collect();
            meta.current = Some(current);
            if let Some(best) = &snapshot.best {
                tensors.push(("current/best".into(), vec![best.len()], bytes(best)));
            }
            for (index, (flat, state)) in snapshot.flat.iter().zip(&snapshot.optimizers).enumerate()
            {
                for (name, values) in [
                    ("flat", flat),
                    ("first", &state.first),
                    ("second", &state.second),
                    ("average", &state.average),
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
        let stored = parse(&data).map_err(|reason| unusable(path, &reason))?;
        if stored.meta.recipe != self.meta.recipe || stored.meta.capture != self.meta.capture {
            return Err(unusable(path, &"it belongs to another recipe or capture"));
        }
        (self.meta, self.weights, self.resumed) = (stored.meta, stored.weights, stored.resumed);
        Ok(())
    }
}

/// What a checkpoint file holds.
pub(crate) struct Stored {
    meta: Meta,
    weights: BTreeMap<String, Weights>,
    resumed: Option<Snapshot>,
}

/// Reads a checkpoint file, which another machine may have written.
///
/// # Errors
/// Why it is none: another schema, figures out of range, tensors that are absent, not f32 or not finite.
pub(crate) fn parse(data: &[u8]) -> Result<Stored, String> {
    let file = SafeTensors::deserialize(data).map_err(|error| error.to_string())?;
    let (_, header) = SafeTensors::read_metadata(data).map_err(|error| error.to_string())?;
    let json = header.metadata().as_ref().and_then(|map| map.get(META_KEY));
    let meta: Meta =
        serde_json::from_str(json.ok_or("it has no header")?).map_err(|error| error.to_string())?;
    if meta.schema != SCHEMA {
        return Err(format!("its schema is {:?}", meta.schema));
    }
    let mut secs = meta.secs.values();
    if !secs.all(|secs| secs.is_finite() && *secs >= 0.0)
        || meta
            .current
            .as_ref()
            .is_some_and(|current| !current.holds())
    {
        return Err("its times or counts are out of range".into());
    }
    let values = |name: &str| -> Result<(Vec<i64>, Vec<f32>), String> {
        let view = file.tensor(name).map_err(|error| error.to_string())?;
        if view.dtype() != Dtype::F32 {
            return Err(format!("tensor {name} is not f32"));
        }
        let values = floats(view.data());
        if !values.iter().all(|value| value.is_finite()) {
            return Err(format!("tensor {name} is not finite"));
        }
        Ok((view.shape().iter().map(|&n| n as i64).collect(), values))
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
    let resumed = match &meta.current {
        Some(current) => {
            let part = |index: usize, name: &str| {
                values(&format!("current/{index}/{name}")).map(|(_, values)| values)
            };
            let mut snapshot = Snapshot {
                flat: Vec::new(),
                optimizers: Vec::new(),
                best: None,
            };
            if file.names().contains(&"current/best") {
                snapshot.best = Some(values("current/best")?.1);
            }
            for (index, &steps) in current.adam_steps.iter().enumerate() {
                snapshot.flat.push(part(index, "flat")?);
                snapshot.optimizers.push(OptimizerState {
                    first: part(index, "first")?,
                    second: part(index, "second")?,
                    average: part(index, "average")?,
                    steps,
                });
            }
            Some(snapshot)
        }
        None => None,
    };
    Ok(Stored {
        meta,
        weights,
        resumed,
    })
}

impl Current {
    /// Whether training can go on from these figures.
    fn holds(&self) -> bool {
        let counts = [self.step, self.fallbacks.into()];
        counts
            .iter()
            .chain(&self.adam_steps)
            .all(|count| *count <= MAX_COUNT)
            && self.elapsed_secs.is_finite()
            && self.elapsed_secs >= 0.0
            && self.rate_scale > 0.0
            && self.rate_scale <= 1.0
            && self.course.holds()
    }
}

/// Steps whose gradient was not finite.
fn skipped_steps(trainees: &[Trainee]) -> u64 {
    trainees
        .iter()
        .map(|trainee| trainee.optimizer.skipped())
        .sum()
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::schedule::Rate;
    use ign_nets::params::Init;
    use tch::{Tensor, no_grad};

    /// One number, to be brought to 0 by plain gradient descent on its square.
    fn number(builder: &mut Builder) -> ign_nets::ParamId {
        builder.param("x", &[1], Init::Constant(1.0))
    }

    fn value(params: &Params) -> f64 {
        f64::from(flat_values(params.flat())[0])
    }

    /// Descends at `rate`: above 1 every step leads further away.
    fn descend(trainee: &Trainee, rate: f64) -> f64 {
        let x = value(&trainee.params);
        let moved = no_grad(|| {
            let mut flat = trainee.params.flat().shallow_clone();
            flat -= Tensor::from_slice(&[(2.0 * rate * x) as f32]);
            flat
        });
        drop(moved);
        x * x
    }

    /// Errors are the number's square.
    fn watch() -> Watch<'static> {
        Watch {
            keep_best: true,
            validation: &|params| Some(value(params).powi(2)),
            curve: Some(Curve {
                method: "ours",
                secs_before: 3.0,
                held_out: &|params| (value(params).powi(2), 0.0),
            }),
        }
    }

    /// Trains with `step`; returns the outcome, the weight that is kept and the fallbacks.
    fn trained(
        watched: bool,
        step: impl FnMut(&mut [Trainee], u64, f64) -> f64,
    ) -> (Result<(), BakeError>, f64, Vec<Fallback>, Vec<String>) {
        let dir = tempfile::tempdir().expect("a folder");
        let said = std::cell::RefCell::new(Vec::new());
        let sink = |event| {
            if let Event::Log { message, .. } = event {
                said.borrow_mut().push(message);
            }
        };
        let reporter = Reporter::new(&sink);
        let mut session = Session::open(
            &reporter,
            dir.path(),
            1e9,
            &Recipe::default(),
            "sha256:0",
            None,
        )
        .expect("a session");
        let mut builder = Builder::new();
        number(&mut builder);
        let trainee = Trainee::new(builder.build(Device::Cpu, 0), 0.0);
        let watch = watch();
        let stage = Stage {
            name: "test",
            schedule: Schedule {
                steps: 64,
                budget_secs: None,
                rate: Rate::Constant,
            },
            watch: watched.then_some(watch),
        };
        let outcome = session.train(&stage, vec![trainee], step);
        let kept = session
            .restore("test", Device::Cpu, number)
            .map_or(f64::NAN, |(_, params)| value(&params));
        let fallbacks = session.fallbacks().to_vec();
        drop(session);
        (outcome, kept, fallbacks, said.into_inner())
    }

    /// Steps move the weights past Adam, whose average follows by itself: one step of it with no gradient.
    fn step(trainees: &mut [Trainee], rate: f64) -> f64 {
        let loss = descend(&trainees[0], rate);
        let Trainee { params, optimizer } = &mut trainees[0];
        assert!(optimizer.step(params, &params.flat().zeros_like(), 0.0, 1.0));
        loss
    }

    #[test]
    fn a_rate_that_diverges_is_noticed_within_a_few_steps_and_lowered() {
        let (outcome, kept, fallbacks, said) =
            trained(true, |trainees, _, scale| step(trainees, 2.0 * scale));
        outcome.expect("it ends");
        assert_eq!(fallbacks.len(), 1, "{fallbacks:?}");
        let fallback = &fallbacks[0];
        assert!(fallback.step <= 6 && fallback.back_to == 0, "{fallback:?}");
        assert!((fallback.rate_scale - 0.25).abs() < 1e-12);
        assert!(said.contains(&fallback.words()), "{said:?}");
        assert!(kept.abs() < 1e-6, "{kept}");
    }

    #[test]
    fn a_poisoned_batch_costs_the_steps_since_the_last_observation() {
        let mut poisoned = false;
        let (outcome, kept, fallbacks, _) = trained(true, |trainees, at, scale| {
            if at == 20 && !poisoned {
                poisoned = true;
                drop(no_grad(|| {
                    trainees[0].params.flat().shallow_clone().fill_(f64::NAN)
                }));
                return f64::NAN;
            }
            step(trainees, 0.1 * scale)
        });
        outcome.expect("it ends");
        assert_eq!(
            (fallbacks.len(), fallbacks[0].step, fallbacks[0].back_to),
            (1, 21, 16)
        );
        assert!(kept.abs() < 0.05, "{kept}");
    }

    #[test]
    fn a_stage_that_cannot_go_on_ends_with_its_best_weights_or_says_so() {
        let poison = |trainees: &mut [Trainee], at: u64, scale: f64| {
            let loss = step(trainees, 0.1 * scale);
            if at < 20 { loss } else { f64::INFINITY }
        };
        let (outcome, kept, fallbacks, _) =
            trained(true, |trainees, at, scale| poison(trainees, at, scale));
        outcome.expect("it ends");
        assert_eq!(fallbacks.len(), MAX_FALLBACKS as usize + 1);
        assert!(
            fallbacks
                .last()
                .is_some_and(|last| last.words().contains("for good"))
        );
        assert!(kept > 0.0 && kept < 0.1, "{kept}");
        let (outcome, ..) = trained(false, |trainees, at, scale| poison(trainees, at, scale));
        assert!(matches!(
            outcome,
            Err(BakeError::Diverged {
                stage: "test",
                step: 21
            })
        ));
    }

    /// What is kept never gets worse, and the curve says what would be kept.
    #[test]
    fn the_curve_of_the_best_weights_never_rises() {
        let dir = tempfile::tempdir().expect("a folder");
        let reporter = Reporter::new(&|_| {});
        let recipe = Recipe::default();
        let mut session = Session::open(&reporter, dir.path(), 1e9, &recipe, "sha256:0", None)
            .expect("a session");
        let mut builder = Builder::new();
        number(&mut builder);
        let trainee = Trainee::new(builder.build(Device::Cpu, 0), 0.0);
        let stage = Stage {
            name: "test",
            schedule: Schedule {
                steps: 64,
                budget_secs: None,
                rate: Rate::Constant,
            },
            watch: Some(watch()),
        };
        // Down for half of the time, then slowly up again.
        let train = |trainees: &mut [Trainee], at: u64, _| {
            step(trainees, if at < 32 { 0.05 } else { -0.02 })
        };
        session
            .train(&stage, vec![trainee], train)
            .expect("it ends");
        let curve: Vec<f64> = session.curve().iter().map(|point| point.mse).collect();
        assert_eq!(curve.len(), 9);
        assert!(curve.windows(2).all(|pair| pair[1] <= pair[0]), "{curve:?}");
        assert!(session.curve().iter().all(|point| point.secs >= 3.0));
        let (_, kept) = session
            .restore("test", Device::Cpu, number)
            .expect("weights");
        assert!((value(&kept).powi(2) - curve[curve.len() - 1]).abs() < 1e-9);
    }
}
