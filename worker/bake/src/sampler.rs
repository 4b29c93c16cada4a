//! Random choices that a resumed bake repeats: every step has a generator of its own, made from seed, stage and step.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64;
use tch::{Device, Tensor};

/// Random choices of one training step.
pub(crate) type StepRng = Pcg64;

/// The generator of one training step.
pub(crate) fn step_rng(seed: u64, stage: &str, step: u64) -> StepRng {
    // FNV-1a over the stage's name keeps stages apart without a table.
    let stage = stage.bytes().fold(0xcbf2_9ce4_8422_2325u64, |hash, byte| {
        (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3)
    });
    Pcg64::seed_from_u64(seed.rotate_left(32) ^ stage ^ step.wrapping_mul(0x9e37_79b9_7f4a_7c15))
}

/// [count] i64, uniform below `limit`.
pub(crate) fn indices(rng: &mut StepRng, count: i64, limit: i64, device: Device) -> Tensor {
    let values: Vec<i64> = (0..count)
        .map(|_| rng.random_range(0..limit.max(1)))
        .collect();
    Tensor::from_slice(&values).to_device(device)
}
