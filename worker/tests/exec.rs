//! `ign-worker exec` as its agent sees it: job file in, events out, ends with stdin.

#![expect(clippy::unwrap_used, reason = "a panic is how a test fails")]

use std::io::Write;
use std::os::unix::process::ExitStatusExt;
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use ign_events::{Event, Failure, FailureKind, JobFile, ObjectName};
use serde_json::{Value, json};

fn worker() -> Command {
    Command::new(env!("CARGO_BIN_EXE_ign-worker"))
}

fn demo_capture(dir: &Path) {
    let output = worker()
        .arg("demo-capture")
        .arg(dir)
        .args(["--size", "32", "--views", "12"])
        .output()
        .unwrap();
    assert!(output.status.success(), "{output:?}");
    let printed = String::from_utf8(output.stdout).unwrap();
    assert_eq!(printed.trim_end(), dir.to_str().unwrap());
}

fn job(dir: &Path, capture: &Path, recipe: Value) -> JobFile {
    let work_dir = dir.join("work");
    std::fs::create_dir_all(&work_dir).unwrap();
    JobFile {
        job_id: "0192".into(),
        attempt: 1,
        object: ObjectName {
            collection: "museum".into(),
            object: "vase".into(),
        },
        capture_dir: capture.to_owned(),
        capture_digest: format!("sha256:{}", "0".repeat(64)),
        recipe,
        checkpoint: None,
        work_dir,
        threads: 1,
    }
}

/// Runs the job with an open stdin and returns what it said.
fn run(dir: &Path, job: &JobFile) -> (Output, Vec<Event>) {
    let path = dir.join("job.json");
    job.write(&path).unwrap();
    let mut child = worker()
        .args(["exec", "--job"])
        .arg(&path)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let stdin = child.stdin.take();
    let output = child.wait_with_output().unwrap();
    drop(stdin);
    let text = String::from_utf8(output.stdout.clone()).unwrap();
    let events = text
        .lines()
        .map(|line| Event::from_line(line).unwrap_or_else(|| panic!("no event: {line}")))
        .collect();
    (output, events)
}

fn last_failure(events: &[Event]) -> &Failure {
    match events.last() {
        Some(Event::Failed(failure)) => failure,
        other => panic!("{other:?}"),
    }
}

#[test]
fn bad_jobs_fail_at_once_with_a_clear_message() {
    let dir = tempfile::tempdir().unwrap();
    let empty = dir.path().join("empty");
    std::fs::create_dir(&empty).unwrap();
    let started = Instant::now();

    let (output, events) = run(dir.path(), &job(dir.path(), &empty, json!({})));
    assert_eq!(output.status.code(), Some(1));
    let failure = last_failure(&events);
    assert_eq!(failure.kind, FailureKind::InvalidInput, "{failure:?}");
    assert!(!failure.message.is_empty() && !failure.hint.is_empty());

    let (output, events) = run(dir.path(), &job(dir.path(), &empty, json!({"sise": 3})));
    assert_eq!(output.status.code(), Some(1));
    let failure = last_failure(&events);
    assert_eq!(failure.kind, FailureKind::InvalidInput);
    assert!(failure.message.contains("`sise`"), "{failure:?}");

    let (_, events) = run(dir.path(), &job(dir.path(), &empty, json!("not an object")));
    assert_eq!(last_failure(&events).kind, FailureKind::InvalidInput);
    assert!(started.elapsed() < Duration::from_mins(1));
}

#[test]
fn a_job_ends_with_its_agent() {
    let dir = tempfile::tempdir().unwrap();
    let capture = dir.path().join("capture");
    demo_capture(&capture);
    let path = dir.path().join("job.json");
    // Without a budget this bake takes minutes.
    job(dir.path(), &capture, json!({"size": 32, "crop": "none"}))
        .write(&path)
        .unwrap();
    let mut child = worker()
        .args(["exec", "--job"])
        .arg(&path)
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    // What arrives on stdin does not matter, only its end does.
    let mut stdin = child.stdin.take().unwrap();
    stdin.write_all(b"hello\n").unwrap();
    std::thread::sleep(Duration::from_secs(2));
    assert!(
        child.try_wait().unwrap().is_none(),
        "the job ended by itself"
    );
    drop(stdin);
    let closed = Instant::now();
    while child.try_wait().unwrap().is_none() {
        assert!(
            closed.elapsed() < Duration::from_secs(20),
            "outlived its agent"
        );
        std::thread::sleep(Duration::from_millis(20));
    }
    assert_eq!(child.wait().unwrap().signal(), Some(9));
}

#[test]
fn wrong_usage_and_failure_have_their_exit_codes() {
    let code = |arguments: &[&str]| worker().args(arguments).output().unwrap().status.code();
    assert_eq!(code(&["render", "bundle", "--out", "out"]), Some(2));
    assert_eq!(code(&["paint"]), Some(2));
    assert_eq!(
        code(&[
            "render",
            "/no/such/bundle",
            "--orbit",
            "1",
            "--out",
            "/tmp/x"
        ]),
        Some(1)
    );
    assert_eq!(
        code(&[
            "agent",
            "--server",
            "http://127.0.0.1:1",
            "--token-file",
            "/no/token",
            "--work-dir",
            "/tmp/x"
        ]),
        Some(1)
    );
    assert_eq!(code(&["completions", "bash"]), Some(0));
}
