//! Chooses where tensors live, and how many threads work on them.
//!
//! The binary links only the CPU library. When the full wheel's CUDA library lies beside it and the machine has a
//! GPU, the worker opens it at start (that needs `dlopen`, so it is the binary's business); this module then sees
//! CUDA through torch's own registry.

use rayon::ThreadPoolBuildError;
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

/// Sizes rayon's pool and torch's to the cores that this process was given; once, before either is used.
///
/// An operation that one of rayon's threads asks of torch stays on that thread. Otherwise each of them brings up a team of
/// OpenMP threads of its own, and these no longer wait for their next work on the core but sleep and are woken at every
/// operation, also of the training that comes later: two threads were slower than one (0.9 steps for 1; now 1.6).
///
/// # Errors
/// When rayon's pool is already in use.
pub fn start_threads(threads: usize) -> Result<(), ThreadPoolBuildError> {
    rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .start_handler(|_| {
            // Torch gives each thread the number for all at its first question, and only then.
            tch::get_num_threads();
            tch::set_num_threads(1);
        })
        .build_global()?;
    // Each thread has set the number for all as well.
    rayon::broadcast(|_| ());
    limit_threads(threads);
    Ok(())
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
