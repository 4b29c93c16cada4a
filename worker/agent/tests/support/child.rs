//! Stands in for `ign-worker exec`: plays the script in the job's recipe. And for `ign-worker agent`, with itself as the
//! child: `agent URL DIR NAME`.
//!
//! The recipe is `{"script": [step, ...]}`; see `main` for the steps. Like the real child it exits when its stdin
//! reaches its end.

#![expect(
    clippy::unwrap_used,
    clippy::print_stdout,
    clippy::print_stderr,
    reason = "a test program: panicking and printing are what it is for"
)]

use std::io::{Read, Write};
use std::path::Path;

use ign_events::{Event, Failure, FailureKind, JobFile, Level, Progress};

fn emit(event: &Event) {
    let mut stdout = std::io::stdout().lock();
    writeln!(stdout, "{}", event.to_line().unwrap()).unwrap();
    stdout.flush().unwrap();
}

fn log(message: String) {
    emit(&Event::Log {
        level: Level::Info,
        message,
    });
}

fn write_file(root: &Path, name: &str, content: &[u8]) {
    let path = root.join(name);
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    std::fs::write(path, content).unwrap();
}

/// An agent whose child is this program; ends when its stdin does.
fn agent(url: &str, dir: &str, name: &str) {
    tracing_subscriber::fmt()
        .with_writer(std::io::stderr)
        .with_ansi(false)
        .init();
    let token = std::env::var("IGN_TEST_TOKEN").unwrap();
    let config = ign_agent::AgentConfig {
        name: Some(name.to_owned()),
        threads: 1,
        child: ign_agent::ChildCommand {
            program: std::env::current_exe().unwrap(),
            args: vec!["exec".into(), "--job".into()],
            envs: Vec::new(),
        },
        lease_wait: std::time::Duration::from_secs(5),
        ..ign_agent::AgentConfig::new(url, &token, Path::new(dir)).unwrap()
    };
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()
        .unwrap();
    let never = tokio_util::sync::CancellationToken::new();
    let ended = runtime.block_on(ign_agent::run(config, never));
    println!("agent ended: {ended:?}");
}

fn main() {
    let args: Vec<String> = std::env::args().collect();
    if let [_, role, url, dir, name] = args.as_slice()
        && role == "agent"
    {
        return agent(url, dir, name);
    }
    std::thread::Builder::new()
        .spawn(|| {
            std::io::stdin().read_to_end(&mut Vec::new()).ok();
            std::process::abort();
        })
        .unwrap();
    let job = JobFile::read(Path::new(&std::env::args().next_back().unwrap())).unwrap();
    log(format!("pid {}", std::process::id()));
    log(format!("threads {}", job.threads));
    if let Some(path) = &job.checkpoint {
        log(format!(
            "resumed from {}",
            std::fs::read_to_string(path).unwrap()
        ));
    }
    let mut checkpoints = 0;
    for step in job.recipe["script"].as_array().unwrap() {
        let (name, value) = step.as_object().unwrap().iter().next().unwrap();
        let text = value.as_str().unwrap_or_default();
        match name.as_str() {
            "progress" => emit(&Event::Progress(Progress {
                stage: "effects".into(),
                percent: value.as_f64().unwrap(),
                eta_secs: Some(1.0),
                error: Some(20.5),
                message: "training".into(),
            })),
            "print" => println!("{text}"),
            "eprint" => eprintln!("{text}"),
            "read" => {
                let path = job.capture_dir.join(text);
                log(format!(
                    "{text}: {}",
                    std::fs::read_to_string(path).unwrap()
                ));
            }
            "env" => log(format!(
                "{text}={}",
                std::env::var(text).unwrap_or_default()
            )),
            "checkpoint" => {
                checkpoints += 1;
                let path = job.work_dir.join(format!("checkpoint-{checkpoints}"));
                std::fs::write(&path, text).unwrap();
                emit(&Event::Checkpoint { path: path.clone() });
                // The child may delete what it has announced a little later.
                std::thread::sleep(std::time::Duration::from_millis(200));
                std::fs::remove_file(path).unwrap();
            }
            "sleep_ms" => {
                std::thread::sleep(std::time::Duration::from_millis(value.as_u64().unwrap()));
            }
            "abort" => std::process::abort(),
            "abort_unless_resumed" => {
                if job.checkpoint.is_none() {
                    std::process::abort();
                }
            }
            "exit" => std::process::exit(value.as_i64().unwrap() as i32),
            "fail" => emit(&Event::Failed(Failure {
                kind: FailureKind::InvalidInput,
                message: text.to_owned(),
                at: format!("{}/sparse/cameras.txt:7", job.capture_dir.display()),
                hint: "re-export with PINHOLE".into(),
            })),
            "done" => {
                let bundle = job.work_dir.join("bundle");
                // No two attempts bake the same bytes.
                let attempt = format!("{{\"attempt\":{}}}", job.attempt);
                write_file(&bundle, "bundle.json", attempt.as_bytes());
                write_file(
                    &bundle,
                    "metrics.json",
                    br#"{"schema":"ign.metrics/1","methods":[{"name":"ours","mse":4.5,"per_view":[]}]}"#,
                );
                // A file of this many bytes, so that its upload takes several requests.
                let large: Vec<u8> = (0..value.as_u64().unwrap())
                    .map(|i| (i % 251) as u8)
                    .collect();
                write_file(&bundle, "references/0007.png", &large);
                emit(&Event::Done { bundle });
            }
            other => panic!("unknown step {other}"),
        }
    }
}
