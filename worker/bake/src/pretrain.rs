//! Weights that a blending head starts from: what blending has in common on every object, learned once on several captures.
//!
//! Deviation: the paper trains `CompositionNet` on each object from random weights. Which of the warped views to trust, by how
//! they differ, how much of the pixel they see and how they stand to the surface, is much the same everywhere; what is left
//! to an object's own training is little. The weights are made by [`pretrain`] (`make pretrain`) on generated captures
//! alone, with seeds that nothing else uses. Training starts there if they blend better than plain blending on the object's
//! validation views; `start=plain` does without. The measured effect is in the README here.

use std::fs::Permissions;
use std::io::Write as _;
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};

use ign_bundle::weights::{self, Precision};
use ign_capture::{Gains, ImportOptions};
use ign_nets::composition::BlendComposition;
use ign_nets::{Builder, NetError, Params};
use ign_render::{Composition, NetworkFiles};
use rand::RngExt as _;

use crate::checkpoint::{Session, Stage};
use crate::composition::{examples, train_on_windows};
use crate::data::Dataset;
use crate::progress::Reporter;
use crate::sampler::step_rng;
use crate::schedule::Schedule;
use crate::training::{COMPOSITION_KNEE, Drawn, OURS, Trainer};
use crate::views::ViewStore;
use crate::{BakeError, Event, Recipe, io};

const FILE: &str = "pretrained/composition.safetensors";
const WEIGHTS: &[u8] = include_bytes!("../pretrained/composition.safetensors");

/// Puts the pretrained weights in; whether they fit the network, which else stays as it is.
pub(crate) fn fill(params: &mut Params) -> Result<bool, BakeError> {
    let tensors = weights::decode(FILE, WEIGHTS)?;
    match ign_render::import(params, &tensors) {
        Ok(()) => Ok(true),
        Err(NetError::WrongShape { .. }) => Ok(false),
        Err(error) => Err(error.into()),
    }
}

/// Name of the pretrained weights' error on validation views, where they fit the network of `stage`.
pub(crate) fn measure(stage: &str) -> String {
    format!("{stage}_pretrained_mse")
}

/// On what to pretrain, and where to.
#[derive(Clone, Debug)]
pub struct PretrainJob {
    /// Capture folders.
    pub captures: Vec<PathBuf>,
    /// As for a bake of each; its `composition_steps` are those of all together.
    pub recipe: Recipe,
    /// The weights, as safetensors in half precision.
    pub out: PathBuf,
    /// Cores to use.
    pub threads: usize,
}

/// Trains one blending head on several captures at once, each with an `EffectsNet` of its own where that pays.
///
/// # Errors
/// What a bake of one of the captures fails with, or a file that cannot be written.
pub fn pretrain(job: &PretrainJob, events: &dyn Fn(Event)) -> Result<(), BakeError> {
    let reporter = Reporter::new(events);
    ign_nets::device::limit_threads(job.threads);
    let device = ign_nets::select_device();
    let work = tempfile::tempdir().map_err(io(&std::env::temp_dir()))?;
    // Beside its place: a place that cannot be written shows before the training, and what is there stays until its end.
    let folder = job.out.parent().filter(|it| !it.as_os_str().is_empty());
    let mut file = tempfile::Builder::new()
        .permissions(Permissions::from_mode(0o666))
        .tempfile_in(folder.unwrap_or(Path::new(".")))
        .map_err(io(&job.out))?;
    let open = |name: &str| {
        let dir = work.path().join(name);
        Session::open(&reporter, &dir, f64::INFINITY, &job.recipe, name, None)
    };
    let mut captures: Vec<ViewStore> = Vec::new();
    for (at, dir) in job.captures.iter().enumerate() {
        reporter.stage("effects", &format!("what {} shows", dir.display()));
        let scene = ign_capture::import(dir, &ImportOptions::default())?;
        let settings = job.recipe.resolve(scene.train.len())?;
        let gains = Gains::none(scene.views.len());
        let mut data = Dataset::new(&scene, &gains, &job.recipe, &settings, device, work.path())?;
        data.fit_proxy(settings.fit)?;
        let chosen = data.choose_references(settings.references);
        data.settle_proxy(settings.simplify);
        let drawn = Drawn::new(&data, &chosen, data.settings.clone(), data.reference_scale)?;
        let trainer = Trainer {
            settings: &settings,
            data: &data,
            drawn: &drawn,
            seed: job.recipe.seed,
            budget_secs: None,
        };
        let mut session = open(&format!("capture-{at}"))?;
        let model = trainer.effects_model(&mut session, OURS)?;
        captures.push(examples(&data, &session, &model, &settings, &drawn.images)?);
    }
    let Some(most) = captures.len().checked_sub(1) else {
        return Err(BakeError::Unusable {
            message: "there is no capture to learn from".into(),
            hint: "name one capture folder or more; ign-worker demo-capture makes some".into(),
        });
    };

    reporter.stage("composition", "training CompositionNet on all captures");
    let settings = job.recipe.resolve(1)?;
    let mut builder = Builder::new();
    let net = BlendComposition::new(&mut builder, settings.k, settings.width);
    let trainee = settings.trainee(builder.build(device, job.recipe.seed));
    let stage = Stage {
        name: OURS.composition,
        schedule: Schedule {
            steps: settings.composition_steps,
            budget_secs: None,
            rate: settings.rate(COMPOSITION_KNEE, 0, None),
        },
        watch: None,
    };
    let mut session = open("all")?;
    session.train(&stage, vec![trainee], |trainees, step, rate| {
        let mut rng = step_rng(job.recipe.seed, stage.name, step);
        let capture = &captures[rng.random_range(0..=most)];
        train_on_windows(&net, &mut trainees[0], capture, &settings, &mut rng, rate)
    })?;
    let (net, params) = session.restore(stage.name, device, |b| {
        BlendComposition::new(b, settings.k, settings.width)
    })?;
    let composition = Composition::Blend(net, params);
    let files = NetworkFiles::of_composition(&composition, settings.k, Precision::Fp16);
    let bytes = weights::encode(FILE, &files.tensors, Precision::Fp16)?;
    file.write_all(&bytes).map_err(io(&job.out))?;
    let written = file.persist(&job.out);
    written.map(drop).map_err(|error| io(&job.out)(error.error))
}

#[cfg(test)]
mod tests {
    use tch::Device;

    use super::*;

    #[test]
    fn the_weights_fit_the_presets_network_and_no_other() {
        let settings = Recipe::default().resolve(20).expect("valid");
        let head = |k, width| {
            let mut builder = Builder::new();
            BlendComposition::new(&mut builder, k, width);
            builder.build(Device::Cpu, 1)
        };
        let mut fitting = head(settings.k, settings.width);
        let before = fitting.flat().copy();
        assert!(fill(&mut fitting).expect("readable"));
        assert_ne!(fitting.flat(), &before);
        for mut other in [
            head(settings.k + 1, settings.width),
            head(settings.k, 2 * settings.width),
        ] {
            let before = other.flat().copy();
            assert!(!fill(&mut other).expect("readable"));
            assert_eq!(other.flat(), &before);
        }
    }
}
