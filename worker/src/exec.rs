//! `ign-worker exec`: bakes one job in this process, events on stdout.
//!
//! The process is disposable. Its panics become a `failed` event with the place of the panic; what it cannot report
//! itself (abort, out of memory) its agent sees from outside. When stdin ends, the agent is gone and so is this
//! process.

use std::any::Any;
use std::panic::{self, AssertUnwindSafe};
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::{Arc, Mutex, PoisonError};

use ign_bake::{BakeJob, Recipe, bake};
use ign_events::{Event, Failure, FailureKind, JobFile};
use ign_trace::{Exporter, Span, TraceParent};

use crate::{agent, gpu, output};

#[derive(Debug, clap::Args)]
pub(crate) struct Options {
    /// The job file.
    #[arg(long, value_name = "FILE")]
    job: PathBuf,
}

/// The C++ stack that libtorch appends to its messages is of no use in a report.
const MAX_PANIC_LINES: usize = 6;

pub(crate) fn run(options: &Options) -> ExitCode {
    // Nothing has been printed and no thread was started yet: the process may start again with the GPU's library.
    if let Err(error) = gpu::enable() {
        output::say(&format!("going on with the CPU: {error:#}"));
    }
    let watcher = std::thread::Builder::new()
        .name("stdin".to_owned())
        .spawn(|| {
            agent::until_end(&mut std::io::stdin().lock());
            agent::die();
        });
    let exporter = Exporter::from_env("ign-worker exec").unwrap_or_else(|error| {
        output::say(&format!("going on without traces: {error}"));
        None
    });
    let stages = exporter
        .as_ref()
        .map(|exporter| Mutex::new(Stages::begin(exporter)));
    let told = |event: Event| {
        if let (Some(stages), Event::Progress(progress)) = (&stages, &event) {
            let mut stages = stages.lock().unwrap_or_else(PoisonError::into_inner);
            stages.enter(&progress.stage);
        }
        emit(&event);
    };
    let result = watcher
        .map_err(|error| crashed(format!("cannot start a thread: {error}"), String::new()))
        .and_then(|_detached| read_job(options))
        .and_then(|job| guarded(|| bake(&job, &told).map_err(|e| e.failure())));
    if let Some(stages) = stages {
        let stages = stages.into_inner().unwrap_or_else(PoisonError::into_inner);
        stages.end(result.as_ref().err());
    }
    // Before the last event: when the agent has read that, it waits no longer.
    drop(exporter);
    match result {
        Ok(bundle) => {
            emit(&Event::Done { bundle });
            ExitCode::SUCCESS
        }
        Err(failure) => {
            emit(&Event::Failed(failure));
            ExitCode::FAILURE
        }
    }
}

/// Spans of the bake and of the stage that it is in, under the agent's.
struct Stages<'a> {
    exporter: &'a Exporter,
    bake: Span,
    stage: Option<(String, Span)>,
}

impl<'a> Stages<'a> {
    fn begin(exporter: &'a Exporter) -> Self {
        let told = std::env::var(ign_trace::VARIABLE).ok();
        let parent: Option<TraceParent> = told.and_then(|text| text.parse().ok());
        Self {
            exporter,
            bake: exporter.span("bake", parent.as_ref()),
            stage: None,
        }
    }

    fn enter(&mut self, stage: &str) {
        if self.stage.as_ref().is_none_or(|(name, _)| name != stage) {
            // The last one ends before the next begins.
            self.stage = None;
            let bake = self.bake.traceparent();
            let span = self.exporter.span(stage.to_owned(), bake.as_ref());
            self.stage = Some((stage.to_owned(), span));
        }
    }

    fn end(mut self, failure: Option<&Failure>) {
        if let Some(failure) = failure {
            self.bake.failed(failure.message.clone());
        }
    }
}

fn emit(event: &Event) {
    match event.to_line() {
        Ok(line) => output::data(&line),
        Err(error) => output::say(&format!("an event cannot be written: {error}")),
    }
}

fn read_job(options: &Options) -> Result<BakeJob, Failure> {
    let job = JobFile::read(&options.job).map_err(|error| {
        let path = options.job.display();
        crashed(
            format!("cannot read the job file {path}: {error}"),
            String::new(),
        )
    })?;
    let recipe: Recipe = serde_json::from_value(job.recipe).map_err(|error| Failure {
        kind: FailureKind::InvalidInput,
        message: format!("the recipe cannot be read: {error}"),
        at: "recipe".to_owned(),
        hint: "see ignctl bake --help for presets and settings".to_owned(),
    })?;
    ign_nets::device::start_threads(job.threads)
        .map_err(|error| crashed(error.to_string(), String::new()))?;
    Ok(BakeJob {
        capture_dir: job.capture_dir,
        capture_digest: job.capture_digest,
        object: (job.object.collection, job.object.object),
        recipe,
        checkpoint: job.checkpoint,
        work_dir: job.work_dir,
        threads: job.threads,
    })
}

/// Runs `work`; a panic becomes a failure that says what and where.
fn guarded<T>(work: impl FnOnce() -> Result<T, Failure>) -> Result<T, Failure> {
    let place = Arc::new(Mutex::new(String::new()));
    let previous = panic::take_hook();
    panic::set_hook({
        let place = Arc::clone(&place);
        Box::new(move |info| {
            if let Some(location) = info.location() {
                let mut place = place.lock().unwrap_or_else(PoisonError::into_inner);
                // The first panic is the cause; a later one is a worker thread's echo.
                if place.is_empty() {
                    *place = format!("{}:{}", location.file(), location.line());
                }
            }
            // The backtrace goes to stderr, and so into the job's log.
            previous(info);
        })
    });
    let result = panic::catch_unwind(AssertUnwindSafe(work));
    drop(panic::take_hook());
    result.unwrap_or_else(|payload| {
        let at = place.lock().unwrap_or_else(PoisonError::into_inner).clone();
        Err(crashed(
            format!("the bake panicked: {}", panic_text(&*payload)),
            at,
        ))
    })
}

fn panic_text(payload: &(dyn Any + Send)) -> String {
    let text = payload
        .downcast_ref::<String>()
        .map(String::as_str)
        .or_else(|| payload.downcast_ref::<&str>().copied())
        .unwrap_or("no message");
    text.lines()
        .take_while(|line| !line.starts_with("Exception raised from"))
        .take(MAX_PANIC_LINES)
        .collect::<Vec<_>>()
        .join(" ")
}

fn crashed(message: String, at: String) -> Failure {
    let hint = if message.contains("allocate memory") || message.contains("out of memory") {
        "out of memory: bake a smaller size, or fewer jobs at once on the machine"
    } else {
        ""
    };
    Failure {
        kind: FailureKind::Crashed,
        message,
        at,
        hint: hint.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_panic_becomes_a_failure_with_its_place() {
        let failure = guarded(|| -> Result<(), Failure> { panic!("a tensor of the wrong shape") });
        let failure = failure.unwrap_err();
        assert_eq!(failure.kind, FailureKind::Crashed);
        assert_eq!(
            failure.message,
            "the bake panicked: a tensor of the wrong shape"
        );
        assert!(failure.at.starts_with("worker/src/exec.rs:") || failure.at.contains("exec.rs:"));
    }

    #[test]
    fn torch_messages_lose_their_native_stack() {
        let text = "shape mismatch\nException raised from check at /pytorch/x.cpp:5\nframe #0: c10"
            .to_owned();
        assert_eq!(panic_text(&text), "shape mismatch");
    }
}
