//! Parameters as one flat buffer.
//!
//! A network registers named tensors with a [`Builder`]; [`Builder::build`] allocates one contiguous f32 buffer and
//! makes each tensor a leaf that shares its storage. The optimiser and the moving average then work on the buffer in
//! one pass, and a checkpoint or a bundle file is a list of names, shapes and slices.

use crate::muon::Matrix;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use tch::{Device, Kind, Tensor, no_grad};

/// What can go wrong with a network's parameters or inputs.
#[derive(Debug, thiserror::Error)]
pub enum NetError {
    /// A weights file lacks a tensor that the network has.
    #[error("the weights lack tensor {name}")]
    MissingTensor {
        /// The tensor's name.
        name: String,
    },
    /// A weights file holds a tensor of another shape.
    #[error("tensor {name} has shape {found:?}, expected {expected:?}")]
    WrongShape {
        /// The tensor's name.
        name: String,
        /// The network's shape.
        expected: Vec<i64>,
        /// The file's shape.
        found: Vec<i64>,
    },
    /// A tensor holds NaN or infinity.
    #[error("tensor {name} holds a value that is not finite")]
    NotFinite {
        /// The tensor's name.
        name: String,
    },
    /// torch reported an error.
    #[error("torch failed")]
    Torch(#[from] tch::TchError),
}

/// How a tensor starts.
#[derive(Clone, Copy, Debug)]
pub enum Init {
    /// Every value the same.
    Constant(f32),
    /// Uniform in plus or minus the bound.
    Uniform(f32),
}

impl Init {
    /// Kaiming's uniform bound for rectifiers with `fan_in` inputs per output.
    pub fn kaiming(fan_in: i64) -> Self {
        Self::Uniform((6.0 / fan_in.max(1) as f32).sqrt())
    }
}

/// Names one tensor of a [`Params`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ParamId(usize);

/// One tensor's place in the flat buffer.
#[derive(Clone, Debug)]
struct Slot {
    name: String,
    shape: Vec<i64>,
    init: Init,
    offset: i64,
    trainable: bool,
    /// Whether it stays in single precision whatever the layers compute in.
    exact: bool,
}

impl Slot {
    fn len(&self) -> i64 {
        self.shape.iter().product()
    }
}

/// Collects a network's tensors.
#[derive(Debug, Default)]
pub struct Builder {
    slots: Vec<Slot>,
    prefix: Vec<String>,
    next: i64,
    exact: bool,
}

impl Builder {
    /// Nothing registered yet.
    pub fn new() -> Self {
        Self::default()
    }

    /// Number of values registered so far.
    pub fn values(&self) -> i64 {
        self.next
    }

    /// Registers names below `name.` inside `body`.
    pub fn scope<T>(&mut self, name: &str, body: impl FnOnce(&mut Self) -> T) -> T {
        self.prefix.push(name.to_owned());
        let value = body(self);
        self.prefix.pop();
        value
    }

    /// Tensors registered inside `body` stay in single precision, also where [`Params::in_kind`] casts the others.
    pub fn exact<T>(&mut self, body: impl FnOnce(&mut Self) -> T) -> T {
        let outside = std::mem::replace(&mut self.exact, true);
        let value = body(self);
        self.exact = outside;
        value
    }

    /// Registers a trained tensor.
    pub fn param(&mut self, name: &str, shape: &[i64], init: Init) -> ParamId {
        self.register(name, shape, init, true)
    }

    /// Registers a tensor that is kept with the weights but not trained (running statistics).
    pub fn buffer(&mut self, name: &str, shape: &[i64], value: f32) -> ParamId {
        self.register(name, shape, Init::Constant(value), false)
    }

    fn register(&mut self, name: &str, shape: &[i64], init: Init, trainable: bool) -> ParamId {
        let mut path = self.prefix.join(".");
        if !path.is_empty() {
            path.push('.');
        }
        path.push_str(name);
        let slot = Slot {
            name: path,
            shape: shape.to_vec(),
            init,
            offset: self.next,
            trainable,
            exact: self.exact,
        };
        self.next += slot.len();
        self.slots.push(slot);
        ParamId(self.slots.len() - 1)
    }

    /// Allocates and initialises; the same seed gives the same values on every device.
    pub fn build(self, device: Device, seed: u64) -> Params {
        let mut rng = Pcg64::seed_from_u64(seed);
        let mut values = Vec::with_capacity(usize::try_from(self.next).unwrap_or(0));
        let mut trained = Vec::with_capacity(values.capacity());
        for slot in &self.slots {
            for _ in 0..slot.len() {
                values.push(match slot.init {
                    Init::Constant(value) => value,
                    Init::Uniform(bound) => rng.random_range(-1.0f32..=1.0) * bound,
                });
                trained.push(f32::from(u8::from(slot.trainable)));
            }
        }
        let flat = Tensor::from_slice(&values).to_device(device);
        let trained = Tensor::from_slice(&trained).to_device(device);
        Params::from_flat(self.slots, flat, trained)
    }
}

/// A network's tensors: leaves that share one flat buffer.
#[derive(Debug)]
pub struct Params {
    slots: Vec<Slot>,
    /// [N] f32: every tensor, in order of registration.
    flat: Tensor,
    /// [N] f32: 1 where the value is trained.
    trained: Tensor,
    leaves: Vec<Tensor>,
}

impl Params {
    fn from_flat(slots: Vec<Slot>, flat: Tensor, trained: Tensor) -> Self {
        let leaves = slots
            .iter()
            .map(|slot| {
                flat.narrow(0, slot.offset, slot.len())
                    .view(slot.shape.as_slice())
                    .detach()
                    .set_requires_grad(slot.trainable)
            })
            .collect();
        Self {
            slots,
            flat,
            trained,
            leaves,
        }
    }

    /// The tensor of `id`.
    pub fn get(&self, id: ParamId) -> &Tensor {
        &self.leaves[id.0]
    }

    /// The same network computing in `kind`: its tensors are casts of these, which gradients go back through, but for
    /// those that stay [exact](Builder::exact).
    #[must_use]
    pub fn in_kind(&self, kind: Kind) -> Self {
        let cast = |(slot, leaf): (&Slot, &Tensor)| {
            if slot.exact {
                leaf.shallow_clone()
            } else {
                leaf.to_kind(kind)
            }
        };
        Self {
            slots: self.slots.clone(),
            flat: self.flat.shallow_clone(),
            trained: self.trained.shallow_clone(),
            leaves: self.slots.iter().zip(&self.leaves).map(cast).collect(),
        }
    }

    /// What layers compute in.
    pub fn kind(&self) -> Kind {
        self.leaves.first().map_or(Kind::Float, Tensor::kind)
    }

    /// [N] f32: the buffer that all tensors share. Writing to it changes the network.
    pub fn flat(&self) -> &Tensor {
        &self.flat
    }

    /// [N] f32: 1 where trained, 0 for statistics.
    pub fn trained(&self) -> &Tensor {
        &self.trained
    }

    /// Where the tensors live.
    pub fn device(&self) -> Device {
        self.flat.device()
    }

    /// What layers multiply by, in order of offsets, but for what stays [exact](Builder::exact) and for matrices with more
    /// outputs than inputs.
    pub(crate) fn matrices(&self) -> Vec<Matrix> {
        let matrix = |slot: &Slot| {
            let rows = *slot.shape.first()?;
            let wide = slot.shape.len() >= 2 && rows * rows <= slot.len();
            (wide && slot.trainable && !slot.exact).then(|| Matrix {
                offset: slot.offset,
                shape: [rows, slot.len() / rows],
            })
        };
        self.slots.iter().filter_map(matrix).collect()
    }

    /// Number of trained values.
    pub fn count(&self) -> i64 {
        self.slots
            .iter()
            .filter(|slot| slot.trainable)
            .map(Slot::len)
            .sum()
    }

    /// Whether what is computed from the tensors just now can be differentiated.
    pub fn recorded(&self) -> bool {
        let trained = self.leaves.iter().filter(|leaf| leaf.requires_grad());
        // A view of a leaf claims it even where nothing is recorded; the smallest one is quick to compute with.
        trained
            .min_by_key(|leaf| leaf.numel())
            .is_some_and(|leaf| leaf.neg().requires_grad())
    }

    /// [N], of the weights' kind: how a scalar `loss` changes with each value; 0 where it does not depend on it. Frees the
    /// graph behind `loss`. Gradients of other networks in that graph are not computed.
    pub fn gradient(&self, loss: &Tensor) -> Tensor {
        let trained: Vec<&Tensor> = self
            .leaves
            .iter()
            .filter(|leaf| leaf.requires_grad())
            .collect();
        let mut gradients = Tensor::run_backward(&[loss], &trained, false, false).into_iter();
        let parts: Vec<Tensor> = self
            .slots
            .iter()
            .zip(&self.leaves)
            .map(|(slot, leaf)| {
                let gradient = slot.trainable.then(|| gradients.next()).flatten();
                match gradient.filter(Tensor::defined) {
                    Some(gradient) => gradient.reshape([-1]),
                    None => leaf.zeros_like().view([-1]),
                }
            })
            .collect();
        Tensor::cat(&parts, 0)
    }

    /// A copy whose flat buffer is `flat` (an average of weights, say); statistics come from `self`.
    #[must_use]
    pub fn with_flat(&self, flat: &Tensor) -> Self {
        let flat = no_grad(|| flat * &self.trained + &self.flat * (1.0f64 - &self.trained));
        Self::from_flat(
            self.slots.clone(),
            flat.detach(),
            self.trained.shallow_clone(),
        )
    }

    /// Overwrites all values from a checkpoint.
    ///
    /// # Errors
    /// A length that is not this network's.
    pub fn restore(&self, values: &[f32]) -> Result<(), NetError> {
        if values.len() != self.flat.numel() {
            return Err(NetError::WrongShape {
                name: "flat".to_owned(),
                expected: self.flat.size(),
                found: vec![values.len() as i64],
            });
        }
        let source = Tensor::from_slice(values).to_device(self.device());
        no_grad(|| self.flat.shallow_clone().f_copy_(&source))?;
        Ok(())
    }

    /// Name, shape and values of each tensor, for weights files.
    pub fn export(&self) -> Vec<(String, Vec<i64>, Vec<f32>)> {
        let flat = flat_values(&self.flat);
        self.slots
            .iter()
            .map(|slot| {
                let from = slot.offset as usize;
                let to = from + slot.len() as usize;
                (
                    slot.name.clone(),
                    slot.shape.clone(),
                    flat[from..to].to_vec(),
                )
            })
            .collect()
    }

    /// Overwrites every tensor from a weights file.
    ///
    /// # Errors
    /// A tensor that is missing, has another shape, or holds a value that is not finite; nothing is changed then.
    pub fn import<'a>(
        &mut self,
        mut find: impl FnMut(&str) -> Option<(&'a [i64], &'a [f32])>,
    ) -> Result<(), NetError> {
        let mut values = vec![0.0f32; self.flat.numel()];
        for slot in &self.slots {
            let Some((shape, data)) = find(&slot.name) else {
                return Err(NetError::MissingTensor {
                    name: slot.name.clone(),
                });
            };
            if shape != slot.shape || data.len() as i64 != slot.len() {
                return Err(NetError::WrongShape {
                    name: slot.name.clone(),
                    expected: slot.shape.clone(),
                    found: shape.to_vec(),
                });
            }
            if data.iter().any(|value| !value.is_finite()) {
                return Err(NetError::NotFinite {
                    name: slot.name.clone(),
                });
            }
            let from = slot.offset as usize;
            values[from..from + data.len()].copy_from_slice(data);
        }
        let source = Tensor::from_slice(&values).to_device(self.device());
        no_grad(|| self.flat.shallow_clone().f_copy_(&source))?;
        Ok(())
    }
}

/// The values of a flat tensor on the CPU.
pub fn flat_values(tensor: &Tensor) -> Vec<f32> {
    let tensor = tensor
        .detach()
        .to_device(Device::Cpu)
        .to_kind(Kind::Float)
        .contiguous();
    let mut values = vec![0.0f32; tensor.numel()];
    let count = values.len();
    tensor.copy_data(&mut values, count);
    values
}

#[cfg(test)]
mod tests {
    use super::*;

    fn two() -> (Params, ParamId, ParamId) {
        let mut builder = Builder::new();
        let a = builder.scope("a", |b| b.param("weight", &[2, 3], Init::kaiming(3)));
        let b = builder.buffer("mean", &[3], 0.5);
        (builder.build(Device::Cpu, 7), a, b)
    }

    #[test]
    fn leaves_share_the_flat_buffer() {
        let (params, a, b) = two();
        drop(no_grad(|| params.flat().shallow_clone().fill_(2.0)));
        assert!((params.get(a).sum(Kind::Float).double_value(&[]) - 12.0).abs() < 1e-6);
        assert!((params.get(b).sum(Kind::Float).double_value(&[]) - 6.0).abs() < 1e-6);
        assert_eq!(params.count(), 6);
    }

    #[test]
    fn nothing_is_recorded_without_gradients() {
        let (params, ..) = two();
        assert!(params.recorded());
        assert!(!no_grad(|| params.recorded()));
    }

    #[test]
    fn gradients_do_not_add_up() {
        let (params, a, _) = two();
        for _ in 0..2 {
            let gradient = params.gradient(&(params.get(a) * 3.0).sum(Kind::Float));
            assert_eq!(
                flat_values(&gradient),
                [3.0, 3.0, 3.0, 3.0, 3.0, 3.0, 0.0, 0.0, 0.0]
            );
        }
    }

    #[test]
    fn export_then_import_is_identity_and_checks() {
        let (params, ..) = two();
        let saved = params.export();
        let (mut other, ..) = two();
        drop(no_grad(|| other.flat().shallow_clone().zero_()));
        other
            .import(|name| {
                saved
                    .iter()
                    .find(|t| t.0 == name)
                    .map(|t| (t.1.as_slice(), t.2.as_slice()))
            })
            .expect("same network");
        assert_eq!(flat_values(other.flat()), flat_values(params.flat()));
        assert!(matches!(
            other.import(|_| None),
            Err(NetError::MissingTensor { .. })
        ));
        let bad = vec![f32::NAN; 6];
        let shape = [2i64, 3];
        assert!(matches!(
            other.import(|_| Some((&shape, &bad))),
            Err(NetError::NotFinite { .. })
        ));
    }

    #[test]
    fn same_seed_same_values() {
        assert_eq!(flat_values(two().0.flat()), flat_values(two().0.flat()));
    }
}
