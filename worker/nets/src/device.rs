//! Chooses where tensors live.
//!
//! The binary links only the CPU library. When the full wheel's CUDA library lies beside it and the machine has a
//! GPU, the worker opens it at start (that needs `dlopen`, so it is the binary's business); this module then sees
//! CUDA through torch's own registry.

use tch::Device;

/// The first CUDA device when torch can use one, else the CPU.
pub fn select() -> Device {
    Device::cuda_if_available()
}

/// Sizes torch's thread pools to the cores that this job was given.
///
/// Oversubscribed OpenMP threads spin: two threads on a busy two-core machine were measured 6 times slower than one.
pub fn limit_threads(threads: usize) {
    let threads = i32::try_from(threads.max(1)).unwrap_or(i32::MAX);
    tch::set_num_threads(threads);
}

/// A short name for reports: `cpu` or `cuda:0`.
pub fn name(device: Device) -> String {
    match device {
        Device::Cpu => "cpu".into(),
        Device::Cuda(index) => format!("cuda:{index}"),
        Device::Mps => "mps".into(),
        Device::Vulkan => "vulkan".into(),
    }
}
