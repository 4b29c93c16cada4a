//! `ignctl` as a user runs it, with its JSON read.

use std::path::PathBuf;
use std::process::{Command, Output};
use std::time::Duration;

use anyhow::{Context as _, Result, ensure};
use serde_json::Value;

use crate::process::{program, run};

/// A command may wait for a coordinator that is being restarted.
const LIMIT: Duration = Duration::from_secs(90);

/// Runs `ignctl` against one service.
#[derive(Clone, Debug)]
pub struct Client {
    connection: Vec<String>,
}

/// A job as `ignctl -o json` shows it.
#[derive(Clone, Debug)]
pub struct Job(pub Value);

impl Job {
    /// Its id.
    pub fn id(&self) -> &str {
        self.text("id")
    }

    /// `queued`, `leased`, `succeeded`, `failed` or `cancelled`.
    pub fn state(&self) -> &str {
        self.text("state")
    }

    /// The object's name within its collection.
    pub fn object(&self) -> &str {
        self.text("object")
    }

    /// The worker that has it, or "".
    pub fn worker(&self) -> &str {
        self.text("worker")
    }

    /// Number of the current or last try, from 1.
    pub fn attempt(&self) -> u64 {
        self.0["attempt"].as_u64().unwrap_or(0)
    }

    /// Whether a checkpoint is stored.
    pub fn has_checkpoint(&self) -> bool {
        !self.text("checkpoint_digest").is_empty()
    }

    /// Whether it has ended.
    pub fn has_ended(&self) -> bool {
        matches!(self.state(), "succeeded" | "failed" | "cancelled")
    }

    fn text(&self, field: &str) -> &str {
        self.0[field].as_str().unwrap_or("")
    }
}

impl Client {
    /// Of a coordinator at `url`.
    pub fn of_server(url: &str, token_file: &str) -> Self {
        Self {
            connection: ["--server", url, "--token-file", token_file]
                .map(str::to_owned)
                .into(),
        }
    }

    /// Of the embedded service with data folder `data`.
    pub fn of_data(data: &str) -> Self {
        Self {
            connection: ["--data", data].map(str::to_owned).into(),
        }
    }

    /// The same with more options.
    #[must_use]
    pub fn with(mut self, options: &[&str]) -> Self {
        self.connection
            .extend(options.iter().map(ToString::to_string));
        self
    }

    /// The command `ignctl ARGS`, to be run by the caller.
    pub fn command(&self, args: &[&str]) -> Result<Command> {
        let mut command = Command::new(program("ignctl")?);
        command.args(&self.connection).args(args);
        command.env("IGN_WORKER", program("ign-worker")?);
        for name in ["IGN_SERVER", "IGN_TOKEN_FILE", "IGN_DATA"] {
            command.env_remove(name);
        }
        Ok(command)
    }

    /// Runs `ignctl ARGS`; its output, whatever the status.
    pub fn run(&self, args: &[&str]) -> Result<Output> {
        run(&mut self.command(args)?, LIMIT)
    }

    /// Runs `ignctl ARGS`, which must succeed; its stdout.
    pub fn text(&self, args: &[&str]) -> Result<String> {
        let output = self.run(args)?;
        ensure!(
            output.status.success(),
            "ignctl {args:?}: {}: {}",
            output.status,
            String::from_utf8_lossy(&output.stderr)
        );
        Ok(String::from_utf8(output.stdout)?)
    }

    /// Runs `ignctl ARGS -o json`, which must succeed.
    pub fn json(&self, args: &[&str]) -> Result<Value> {
        let text = self.text(&[args, &["-o", "json"]].concat())?;
        serde_json::from_str(&text)
            .with_context(|| format!("ignctl {args:?} printed no JSON: {text}"))
    }

    /// Queues one capture; the job.
    pub fn submit(&self, capture: &std::path::Path, object: &str, recipe: &[&str]) -> Result<Job> {
        let capture = capture.to_str().context("the path is no UTF-8")?;
        let rows = self.json(&[&["submit", capture, "--object", object], recipe].concat())?;
        Ok(Job(rows[0]["job"].clone()))
    }

    /// All jobs.
    pub fn jobs(&self) -> Result<Vec<Job>> {
        let jobs = self.json(&["jobs", "list"])?;
        Ok(jobs
            .as_array()
            .context("no list of jobs")?
            .iter()
            .cloned()
            .map(Job)
            .collect())
    }

    /// One job.
    pub fn job(&self, id: &str) -> Result<Job> {
        self.json(&["jobs", "get", id]).map(Job)
    }

    /// A job's log, all attempts.
    pub fn logs(&self, id: &str) -> Result<String> {
        self.text(&["logs", id])
    }

    /// Downloads `bundle` and has `ignctl` verify what came; the folder.
    pub fn fetch_verified(&self, bundle: &str, out: PathBuf) -> Result<PathBuf> {
        let dir = out.to_str().context("the path is no UTF-8")?;
        self.text(&["bundle", "fetch", bundle, "--out", dir])?;
        self.text(&["bundle", "verify", dir])?;
        Ok(out)
    }

    /// Each object of `collection` with its number of versions, sorted by object.
    pub fn versions(&self, collection: &str) -> Result<Vec<(String, usize)>> {
        let bundles = self.json(&["bundle", "list", collection, "--retired"])?;
        let mut count = std::collections::BTreeMap::new();
        for bundle in bundles.as_array().context("no list of bundles")? {
            *count
                .entry(bundle["object"].as_str().unwrap_or("").to_owned())
                .or_insert(0) += 1;
        }
        Ok(count.into_iter().collect())
    }
}
