//! Every parser of the workspace on damaged files: none panics, and none allocates more than its file justifies.
//!
//! [`targets`] are plain functions on bytes. `tests/replay.rs` drives them on the stable toolchain, in CI: the committed
//! corpus, then a bounded number of mutations of it. `fuzz/` hands them to libFuzzer.
//!
//! Linking this crate makes [`peak_alloc`] the allocator of the process, so that [`replay`] can measure.

mod captures;
mod mutate;
pub mod targets;

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use peak_alloc::PeakAlloc;
use rayon::{ThreadPool, ThreadPoolBuilder};

pub use mutate::Mutator;

#[global_allocator]
static MEMORY: PeakAlloc = PeakAlloc;
/// Peaks are the process's: one target at a time.
static MEASURING: Mutex<()> = Mutex::new(());

thread_local! {
    /// What parsers do in parallel stays on this thread: inputs are small, and waking others takes longer than they do.
    static ALONE: ThreadPool = ThreadPoolBuilder::new()
        .num_threads(1)
        .use_current_thread()
        .build()
        .expect("a pool of this thread alone");
}

/// Where the sequence of mutations starts when `IGN_SEED` does not say so.
const SEED: u64 = 20_180_711;
/// Mutations of a target when `IGN_FUZZ` does not say how many.
const MUTATIONS: u64 = 1500;

/// A parser, and what its input may cost.
#[derive(Clone, Copy)]
pub struct Target {
    /// Of the corpus folder.
    pub name: &'static str,
    /// Parses, and checks what came out.
    pub run: fn(&[u8]),
    /// Bytes that it may hold at once whatever the input: scratch, and what other files of the same capture cost.
    pub base_bytes: usize,
    /// Bytes that it may hold at once for each byte of input.
    pub bytes_per_byte: usize,
}

/// The target of this name.
///
/// # Panics
/// When there is none.
pub fn target(name: &str) -> &'static Target {
    let mut all = targets::ALL.iter();
    all.find(|target| target.name == name)
        .unwrap_or_else(|| panic!("no target {name}"))
}

/// Runs a target on `seeds` and on mutations of them: 1500, or as many as `IGN_FUZZ` says.
///
/// # Panics
/// When the target panics or holds more memory than it may. The input is left in the folder for temporary files, and
/// the message names it.
pub fn replay(target: &Target, seeds: &[Vec<u8>]) {
    let _one_at_a_time = MEASURING.lock().unwrap_or_else(PoisonError::into_inner);
    let number = |name: &str, default: u64| {
        std::env::var(name).map_or(default, |text| text.parse().expect("a number"))
    };
    assert!(!seeds.is_empty(), "{} has no corpus", target.name);
    // Pools and caches fill up on the first run.
    ALONE.with(|pool| pool.install(|| (target.run)(&seeds[0])));
    for seed in seeds {
        run(target, seed);
    }
    let mut mutator = Mutator::new(number("IGN_SEED", SEED));
    for _ in 0..number("IGN_FUZZ", MUTATIONS) {
        run(target, &mutator.mutated(seeds));
    }
}

/// Runs a target on one input.
///
/// # Panics
/// As [`replay`].
pub fn run(target: &Target, input: &[u8]) {
    MEMORY.reset_peak_usage();
    let before = MEMORY.current_usage();
    let outcome =
        ALONE.with(|pool| catch_unwind(AssertUnwindSafe(|| pool.install(|| (target.run)(input)))));
    let held = MEMORY.peak_usage().saturating_sub(before);
    let allowed = target.base_bytes + target.bytes_per_byte * input.len();
    let fault = match outcome {
        Err(_) => "panicked, see above".to_owned(),
        Ok(()) if held > allowed => format!("held {held} bytes, {allowed} are allowed"),
        Ok(()) => return,
    };
    let kept = std::env::temp_dir().join(format!("ign-fuzz-{}", target.name));
    let kept = match std::fs::write(&kept, input) {
        Ok(()) => kept.display().to_string(),
        Err(error) => format!("nowhere ({error})"),
    };
    panic!(
        "{}: {} bytes of input {fault}; kept in {kept}",
        target.name,
        input.len()
    );
}

/// The committed inputs of a target: seeds, and whatever once broke it.
///
/// # Panics
/// When the folder cannot be read.
pub fn corpus(target: &Target) -> Vec<Vec<u8>> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("corpus")
        .join(target.name);
    let mut files: Vec<PathBuf> = std::fs::read_dir(&folder)
        .unwrap_or_else(|error| panic!("{}: {error}", folder.display()))
        .map(|entry| entry.expect("an entry").path())
        .collect();
    files.sort();
    files
        .iter()
        .map(|file| std::fs::read(file).expect("a file"))
        .collect()
}
