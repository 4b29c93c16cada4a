//! Adam (Kingma & Ba 2015) and Muon (Jordan et al. 2024), with an exponential moving average of the weights, on one flat
//! buffer.
//!
//! The paper uses Adam with a learning rate of 1e-3, beta1 = 0.9, beta2 = 0.999, epsilon = 1e-8 (Sec. "Training");
//! those are the defaults here. A step whose gradient is not finite changes nothing and is counted.
//!
//! Deviation (presets `standard` and `auto`): matrices within both networks go along their [orthogonal] momentum, so that what
//! the gradient rarely asks for is learned as fast as what it always does; everything else by Adam. Figures in
//! worker/bake/README.md.
//!
//! On the CPU the buffer is updated piece by piece, so that each is in the caches for all of its operations: memory is read
//! and written once a step, not once an operation. Torch's own threads share a piece; other threads must not join in (see
//! [`crate::device::start_threads`]).
//!
//! [orthogonal]: crate::muon

use std::ops::Range;

use crate::muon::{self, Matrix};
use crate::params::{NetError, Params, flat_values};
use tch::{Device, Tensor, no_grad};

/// Optimiser state for one [`Params`].
#[derive(Debug)]
pub struct Optimizer {
    /// What goes along its orthogonal momentum, in order of offsets; Adam's is the rest.
    matrices: Vec<Matrix>,
    /// First moments, and momentum where [`Self::matrices`] are.
    first: Tensor,
    second: Tensor,
    /// The weights themselves where averaging is off.
    average: Tensor,
    steps: u64,
    skipped: u64,
    average_decay: f64,
}

/// What a checkpoint keeps of an [`Optimizer`].
#[derive(Clone, Debug)]
pub struct OptimizerState {
    /// First moments and momentum, [N].
    pub first: Vec<f32>,
    /// Second moments, [N].
    pub second: Vec<f32>,
    /// Averaged weights, [N].
    pub average: Vec<f32>,
    /// Steps taken.
    pub steps: u64,
}

/// A network in training: its tensors and their optimiser.
#[derive(Debug)]
pub struct Trainee {
    /// The network's tensors.
    pub params: Params,
    /// Their optimiser.
    pub optimizer: Optimizer,
}

impl Trainee {
    /// A network at the start of its training by Adam; `average_decay` of 0 switches averaging off.
    pub fn new(params: Params, average_decay: f64) -> Self {
        let optimizer = Optimizer::new(&params, average_decay, Vec::new());
        Self { params, optimizer }
    }

    /// The same, the matrices within the network by Muon.
    pub fn with_muon(params: Params, average_decay: f64) -> Self {
        let optimizer = Optimizer::new(&params, average_decay, params.matrices());
        Self { params, optimizer }
    }

    /// One step down `loss`, a scalar that depends on the network's tensors; see [`Optimizer::step`].
    pub fn descend(&mut self, loss: &Tensor, rate: f64, max_norm: f64) -> bool {
        let gradient = self.params.gradient(loss);
        self.optimizer.step(&self.params, &gradient, rate, max_norm)
    }
}

const BETA1: f64 = 0.9;
const BETA2: f64 = 0.999;
const EPSILON: f64 = 1e-8;
/// Values of a piece for each of torch's threads; two or more of these are as much as torch splits between them.
const PIECE: i64 = 24_576;

impl Optimizer {
    /// Zero moments; the average starts at the present weights.
    fn new(params: &Params, average_decay: f64, matrices: Vec<Matrix>) -> Self {
        Self {
            matrices,
            first: params.flat().zeros_like(),
            second: params.flat().zeros_like(),
            average: if average_decay > 0.0 {
                params.flat().copy()
            } else {
                params.flat().shallow_clone()
            },
            steps: 0,
            skipped: 0,
            average_decay,
        }
    }

    /// Applies `gradient` ([N], see [`Params::gradient`]) to `params`. Returns whether it was finite; if not, nothing
    /// changes.
    ///
    /// `max_norm` bounds the gradient's Euclidean norm (infinity: no bound).
    pub fn step(&mut self, params: &Params, gradient: &Tensor, rate: f64, max_norm: f64) -> bool {
        let norm = no_grad(|| gradient.norm().double_value(&[]));
        if !norm.is_finite() {
            self.skipped += 1;
            return false;
        }
        self.steps += 1;
        let steps = self.steps as f64;
        let update = Update {
            shrink: (norm > max_norm).then_some(max_norm / norm),
            rate: rate / (1.0 - BETA1.powf(steps)),
            root: (1.0 - BETA2.powf(steps)).sqrt().recip(),
            // The average forgets its start fast and its recent past slowly.
            forget: 1.0 - self.average_decay.min((1.0 + steps) / (10.0 + steps)),
            averages: self.average_decay > 0.0,
        };
        let moves = muon::steps(&self.matrices, gradient, &self.first, update.shrink);
        let mut from = 0;
        for (matrix, step) in self.matrices.iter().zip(moves) {
            self.by_adam(params, gradient, from..matrix.offset, update);
            from = matrix.offset + matrix.len();
            no_grad(|| {
                let cut = |buffer: &Tensor| buffer.narrow(0, matrix.offset, matrix.len());
                let mut weights = cut(params.flat());
                weights -= step * rate;
                update.average(&mut cut(&self.average), &weights);
            });
        }
        self.by_adam(params, gradient, from..gradient.size()[0], update);
        true
    }

    /// Updates a range by Adam.
    fn by_adam(&self, params: &Params, gradient: &Tensor, range: Range<i64>, update: Update) {
        let piece = match params.device() {
            Device::Cpu => PIECE * i64::from(tch::get_num_threads().max(1)),
            _ => i64::MAX,
        };
        let mut from = range.start;
        while from < range.end {
            let length = piece.min(range.end - from);
            let buffers = [
                gradient,
                &self.first,
                &self.second,
                params.flat(),
                &self.average,
            ];
            no_grad(|| update.apply(buffers.map(|buffer| buffer.narrow(0, from, length))));
            from += length;
        }
    }

    /// The network with averaged weights.
    pub fn averaged(&self, params: &Params) -> Params {
        params.with_flat(&self.average)
    }

    /// Steps whose gradient was not finite.
    pub fn skipped(&self) -> u64 {
        self.skipped
    }

    /// For a checkpoint.
    pub fn state(&self) -> OptimizerState {
        OptimizerState {
            first: flat_values(&self.first),
            second: flat_values(&self.second),
            average: flat_values(&self.average),
            steps: self.steps,
        }
    }

    /// From a checkpoint.
    ///
    /// # Errors
    /// A length that is not this network's.
    pub fn restore(&mut self, state: &OptimizerState) -> Result<(), NetError> {
        for (name, target, source) in [
            ("adam.first", &self.first, &state.first),
            ("adam.second", &self.second, &state.second),
            ("adam.average", &self.average, &state.average),
        ] {
            if source.len() != target.numel() {
                return Err(NetError::WrongShape {
                    name: name.to_owned(),
                    expected: target.size(),
                    found: vec![source.len() as i64],
                });
            }
            let source = Tensor::from_slice(source).to_device(target.device());
            no_grad(|| target.shallow_clone().f_copy_(&source))?;
        }
        self.steps = state.steps;
        Ok(())
    }
}

/// The factors of one step.
#[derive(Clone, Copy)]
struct Update {
    /// Of the gradient.
    shrink: Option<f64>,
    /// Of the first moment over the root of the second.
    rate: f64,
    /// Of the root of the second moment.
    root: f64,
    /// Of the weights in their average.
    forget: f64,
    averages: bool,
}

impl Update {
    fn apply(&self, [gradient, mut first, mut second, mut weights, mut average]: [Tensor; 5]) {
        let gradient = match self.shrink {
            Some(factor) => gradient * factor,
            None => gradient,
        };
        drop(first.lerp_(&gradient, 1.0 - BETA1));
        drop(second.lerp_(&gradient.square(), 1.0 - BETA2));
        let mut step = second.sqrt();
        step *= self.root;
        step += EPSILON;
        step = first / step;
        step *= self.rate;
        weights -= step;
        self.average(&mut average, &weights);
    }

    fn average(&self, average: &mut Tensor, weights: &Tensor) {
        if self.averages {
            drop(average.lerp_(weights, self.forget));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::params::{Builder, Init};
    use tch::Kind;

    /// Against `torch.optim.Adam` semantics worked by hand for a scalar.
    #[test]
    fn first_steps_follow_the_published_update() {
        let mut builder = Builder::new();
        let id = builder.param("x", &[1], Init::Constant(1.0));
        let params = builder.build(Device::Cpu, 0);
        let mut adam = Optimizer::new(&params, 0.0, Vec::new());
        let (mut x, mut m, mut v) = (1.0f64, 0.0, 0.0);
        for t in 1..=5 {
            let gradient = params.gradient(&params.get(id).square().sum(Kind::Float));
            assert!(adam.step(&params, &gradient, 0.1, f64::INFINITY));
            let g = 2.0 * x;
            m = 0.9 * m + 0.1 * g;
            v = 0.999 * v + 0.001 * g * g;
            let step =
                (m / (1.0 - 0.9f64.powi(t))) / ((v / (1.0 - 0.999f64.powi(t))).sqrt() + 1e-8);
            x -= 0.1 * step;
            assert!((params.get(id).double_value(&[0]) - x).abs() < 1e-5);
        }
    }

    /// A matrix between two vectors: each by its own rule, all of them in the average.
    #[test]
    fn matrices_learn_by_muon_and_what_lies_between_them_by_adam() {
        let parts = |trainee: &Trainee, buffer: &Tensor| {
            assert_eq!(trainee.params.matrices().len(), 1);
            buffer.split_with_sizes([3, 8, 3], 0)
        };
        let trained = |start: fn(Params, f64) -> Trainee| {
            let mut builder = Builder::new();
            builder.param("before", &[3], Init::Constant(1.0));
            builder.param("matrix", &[2, 4], Init::Uniform(1.0));
            builder.param("after", &[3], Init::Constant(1.0));
            let mut trainee = start(builder.build(Device::Cpu, 1), 0.5);
            for _ in 0..40 {
                let gradient = trainee.params.flat() * 2.0;
                let Trainee { params, optimizer } = &mut trainee;
                assert!(optimizer.step(params, &gradient, 0.01, f64::INFINITY));
            }
            let weights = parts(&trainee, trainee.params.flat());
            let average = parts(&trainee, &trainee.optimizer.average);
            for (weights, average) in weights.iter().zip(&average) {
                let apart = (weights - average).abs().max().double_value(&[]);
                assert!(apart > 0.0 && apart < 0.05, "{apart}");
            }
            weights
        };
        let (adam, muon) = (trained(Trainee::new), trained(Trainee::with_muon));
        assert_eq!(adam[0], muon[0]);
        assert_eq!(adam[2], muon[2]);
        assert_ne!(adam[1], muon[1]);
        // Both go down: the loss is the square.
        for weights in adam.iter().chain(&muon) {
            assert!(weights.square().mean(Kind::Float).double_value(&[]) < 0.5);
        }
    }

    #[test]
    fn a_gradient_that_is_not_finite_changes_nothing() {
        let mut builder = Builder::new();
        let id = builder.param("x", &[1], Init::Constant(0.0));
        let params = builder.build(Device::Cpu, 0);
        let mut adam = Optimizer::new(&params, 0.9, Vec::new());
        let gradient = params.gradient(&params.get(id).sqrt().sum(Kind::Float));
        assert!(!adam.step(&params, &gradient, 0.1, 1.0));
        assert_eq!(adam.skipped(), 1);
        assert!(params.get(id).double_value(&[0]).abs() < 1e-12);
    }
}
