//! Adam (Kingma & Ba 2015) with an exponential moving average of the weights, on one flat buffer.
//!
//! The paper uses Adam with a learning rate of 1e-3, beta1 = 0.9, beta2 = 0.999, epsilon = 1e-8 (Sec. "Training");
//! those are the defaults here. A step whose gradient is not finite changes nothing and is counted.

use crate::params::{NetError, Params, flat_values};
use tch::{Kind, Tensor, no_grad};

/// Optimiser state for one [`Params`].
#[derive(Debug)]
pub struct Adam {
    first: Tensor,
    second: Tensor,
    average: Tensor,
    steps: u64,
    skipped: u64,
    average_decay: f64,
}

/// What a checkpoint keeps of an [`Adam`].
#[derive(Clone, Debug)]
pub struct AdamState {
    /// First moments, [N].
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
    pub adam: Adam,
}

impl Trainee {
    /// A network at the start of its training; see [`Adam::new`].
    pub fn new(params: Params, average_decay: f64) -> Self {
        let adam = Adam::new(&params, average_decay);
        Self { params, adam }
    }

    /// See [`Adam::step`].
    pub fn step(&mut self, rate: f64, max_norm: f64) -> bool {
        self.adam.step(&mut self.params, rate, max_norm)
    }
}

const BETA1: f64 = 0.9;
const BETA2: f64 = 0.999;
const EPSILON: f64 = 1e-8;

impl Adam {
    /// Zero moments; the average starts at the present weights. `average_decay` of 0 switches averaging off.
    pub fn new(params: &Params, average_decay: f64) -> Self {
        Self {
            first: params.flat().zeros_like(),
            second: params.flat().zeros_like(),
            average: params.flat().copy(),
            steps: 0,
            skipped: 0,
            average_decay,
        }
    }

    /// Applies the gradients of the last backward pass. Returns whether they were finite; if not, nothing changes.
    ///
    /// `max_norm` bounds the gradient's Euclidean norm (infinity: no bound).
    pub fn step(&mut self, params: &mut Params, rate: f64, max_norm: f64) -> bool {
        no_grad(|| {
            let mut grad = params.take_grad();
            let norm = grad.square().sum(Kind::Float).sqrt().double_value(&[]);
            if !norm.is_finite() {
                self.skipped += 1;
                return false;
            }
            if norm > max_norm {
                grad *= max_norm / norm;
            }
            self.steps += 1;
            self.first *= BETA1;
            self.first += &grad * (1.0 - BETA1);
            self.second *= BETA2;
            self.second += grad.square() * (1.0 - BETA2);
            let correction1 = 1.0 - BETA1.powf(self.steps as f64);
            let correction2 = 1.0 - BETA2.powf(self.steps as f64);
            let denominator = (&self.second / correction2).sqrt() + EPSILON;
            let mut flat = params.flat().shallow_clone();
            flat -= &self.first / denominator * (rate / correction1);
            // The average forgets its start fast and its recent past slowly.
            let decay = self
                .average_decay
                .min((1.0 + self.steps as f64) / (10.0 + self.steps as f64));
            self.average *= decay;
            self.average += &flat * (1.0 - decay);
            true
        })
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
    pub fn state(&self) -> AdamState {
        AdamState {
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
    pub fn restore(&mut self, state: &AdamState) -> Result<(), NetError> {
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::params::{Builder, Init};
    use tch::Device;

    /// Against `torch.optim.Adam` semantics worked by hand for a scalar.
    #[test]
    fn first_steps_follow_the_published_update() {
        let mut builder = Builder::new();
        let id = builder.param("x", &[1], Init::Constant(1.0));
        let mut params = builder.build(Device::Cpu, 0);
        let mut adam = Adam::new(&params, 0.0);
        let (mut x, mut m, mut v) = (1.0f64, 0.0, 0.0);
        for t in 1..=5 {
            params.get(id).square().sum(Kind::Float).backward();
            assert!(adam.step(&mut params, 0.1, f64::INFINITY));
            let g = 2.0 * x;
            m = 0.9 * m + 0.1 * g;
            v = 0.999 * v + 0.001 * g * g;
            let step =
                (m / (1.0 - 0.9f64.powi(t))) / ((v / (1.0 - 0.999f64.powi(t))).sqrt() + 1e-8);
            x -= 0.1 * step;
            assert!((params.get(id).double_value(&[0]) - x).abs() < 1e-5);
        }
    }

    #[test]
    fn a_gradient_that_is_not_finite_changes_nothing() {
        let mut builder = Builder::new();
        let id = builder.param("x", &[1], Init::Constant(0.0));
        let mut params = builder.build(Device::Cpu, 0);
        let mut adam = Adam::new(&params, 0.9);
        params.get(id).sqrt().sum(Kind::Float).backward();
        assert!(!adam.step(&mut params, 0.1, 1.0));
        assert_eq!(adam.skipped(), 1);
        assert!(params.get(id).double_value(&[0]).abs() < 1e-12);
    }
}
