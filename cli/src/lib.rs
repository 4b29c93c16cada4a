//! ignctl: submits bakes, watches them, fetches their bundles, and runs the whole service on one machine.
//!
//! One file per group of commands under `commands`; the rest is what they share. Data goes to stdout and everything else
//! to stderr, both only through `output`. The exit code is 0 when all was done, 1 when something failed, 2 for a wrong
//! command line, 3 when the coordinator cannot be reached, 4 when a timeout passed.
//! Invariant: nothing here links libtorch; what needs it runs in `ign-worker`.
//!
//! A library with one entry, [`main`], so that the fuzz targets reach what reads files of others.

mod bag;
mod commands;
mod connection;
mod data_plane;
mod embedded;
#[doc(hidden)]
pub mod fuzz;
mod memory;
mod output;
mod pack;
mod problem;
mod recipe;
mod results;
mod supervise;
mod upload;
mod views;
mod watch;

use std::process::ExitCode;

use clap::{CommandFactory as _, Parser};
use ign_trace::{Exporter, Span, TraceParent};

use crate::commands::{
    admin, bake, bundle, collections, completions, doctor, jobs, preflight, report, status, submit,
    token, up, webhook, worker,
};
use crate::connection::ConnectionArgs;
use crate::output::Format;
use crate::problem::{Exit, Problem, chain};

/// Bakes captures of objects into model bundles, and keeps an eye on it
#[derive(Debug, Parser)]
#[command(name = "ignctl", version, max_term_width = 100, after_help = AFTER_HELP)]
struct Cli {
    #[command(flatten)]
    connection: ConnectionArgs,
    /// Form of the data on stdout; json and yaml have stable field names
    #[arg(
        short,
        long,
        global = true,
        value_enum,
        default_value_t,
        value_name = "FORMAT",
        help_heading = "Connection"
    )]
    output: Format,
    #[command(subcommand)]
    command: Command,
}

const AFTER_HELP: &str = "\
Start with: ignctl bake CAPTURE --object museum/vase
Exit codes: 0 ok, 1 something failed, 2 usage, 3 coordinator unreachable, 4 timeout";

#[derive(Debug, clap::Subcommand)]
enum Command {
    /// Run the service on this machine: coordinator, workers, a data folder
    Up(up::Args),
    /// Bake one capture: submit, wait, fetch the bundle and its report
    Bake(bake::Args),
    /// Report on captures before anything is queued: coverage, blur, exposure, light, cost
    Preflight(preflight::Args),
    /// Queue captures: one, a folder of them, or a CSV list
    Submit(submit::Args),
    /// Show the queue, the workers, running jobs and failures on one screen
    Status(status::Args),
    /// Look at jobs
    #[command(subcommand)]
    Jobs(jobs::Command),
    /// Print a job's log
    Logs(jobs::LogsArgs),
    /// Stop jobs
    Cancel(jobs::JobArgs),
    /// Queue failed or cancelled jobs again
    Retry(jobs::JobArgs),
    /// Bake the captures of jobs once more, with another recipe
    Rebake(jobs::RebakeArgs),
    /// Wait until jobs have ended
    Wait(jobs::WaitArgs),
    /// Set shares and limits of collections, pause and resume them
    #[command(subcommand)]
    Collections(collections::Command),
    /// Have the ends of a collection's jobs sent to a URL, and see what became of it
    #[command(subcommand)]
    Webhook(webhook::Command),
    /// List workers, drain them before maintenance, and take that back
    #[command(subcommand)]
    Worker(worker::Command),
    /// Look at model bundles, fetch and verify them
    #[command(subcommand)]
    Bundle(bundle::Command),
    /// Write one page on a collection: what is good, what stands out, what to photograph again
    Report(report::Args),
    /// Make, list, rotate and revoke bearer tokens
    #[command(subcommand)]
    Token(token::Command),
    /// Care for the registry as a whole: rebuild, collect garbage, audit
    #[command(subcommand)]
    Admin(admin::Command),
    /// Check that everything needed is there and works
    Doctor(doctor::Args),
    /// Print completions for a shell
    Completions(completions::Args),
}

impl Command {
    /// Its name, as spans have it.
    fn name(&self) -> &'static str {
        match self {
            Self::Up(_) => "ignctl up",
            Self::Bake(_) => "ignctl bake",
            Self::Preflight(_) => "ignctl preflight",
            Self::Report(_) => "ignctl report",
            Self::Submit(_) => "ignctl submit",
            Self::Status(_) => "ignctl status",
            Self::Jobs(_) => "ignctl jobs",
            Self::Logs(_) => "ignctl logs",
            Self::Cancel(_) => "ignctl cancel",
            Self::Retry(_) => "ignctl retry",
            Self::Rebake(_) => "ignctl rebake",
            Self::Wait(_) => "ignctl wait",
            Self::Collections(_) => "ignctl collections",
            Self::Webhook(_) => "ignctl webhook",
            Self::Worker(_) => "ignctl worker",
            Self::Bundle(_) => "ignctl bundle",
            Self::Token(_) => "ignctl token",
            Self::Admin(_) => "ignctl admin",
            Self::Doctor(_) => "ignctl doctor",
            Self::Completions(_) => "ignctl completions",
        }
    }
}

/// What every command gets.
struct Context {
    connection: ConnectionArgs,
    format: Format,
}

/// Runs the command line of this process.
pub fn main() -> ExitCode {
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(error) => {
            output::clap(&error);
            return exit_code(if error.use_stderr() {
                Exit::Usage
            } else {
                Exit::Ok
            });
        }
    };
    match start(cli) {
        Ok(()) => exit_code(Exit::Ok),
        Err(problem) => {
            output::problem(&problem);
            exit_code(problem.exit)
        }
    }
}

fn exit_code(exit: Exit) -> ExitCode {
    ExitCode::from(exit as u8)
}

fn start(cli: Cli) -> Result<(), Problem> {
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .map_err(|error| Problem::failed(format!("cannot start: {error}")))?;
    let exporter = Exporter::from_env("ignctl").map_err(|error| Problem::usage(chain(&error)))?;
    let mut span = exporter
        .as_ref()
        .map(|exporter| exporter.span(cli.command.name(), None));
    // Jobs are found by it later, also where nobody exports anything.
    let trace = span
        .as_ref()
        .and_then(Span::traceparent)
        .unwrap_or_else(TraceParent::random);
    let work = ign_trace::within(tracing::Span::none(), Some(trace), run(cli));
    let outcome = runtime.block_on(Box::pin(work));
    if let (Some(span), Err(problem)) = (&mut span, &outcome) {
        span.failed(problem.what.clone());
    }
    drop(span);
    drop(exporter);
    // Reads of a terminal or hashing must not hold the exit.
    runtime.shutdown_background();
    outcome
}

async fn run(cli: Cli) -> Result<(), Problem> {
    let context = Context {
        connection: cli.connection,
        format: cli.output,
    };
    match cli.command {
        Command::Up(args) => up::run(&context, &args).await,
        Command::Bake(args) => bake::run(&context, &args).await,
        Command::Preflight(args) => preflight::run(&context, &args).await,
        Command::Submit(args) => submit::run(&context, &args).await,
        Command::Status(args) => status::run(&context, &args).await,
        Command::Jobs(command) => jobs::run(&context, &command).await,
        Command::Logs(args) => jobs::logs(&context, &args).await,
        Command::Cancel(args) => jobs::cancel(&context, &args).await,
        Command::Retry(args) => jobs::retry(&context, &args).await,
        Command::Rebake(args) => jobs::rebake(&context, &args).await,
        Command::Wait(args) => jobs::wait(&context, &args).await,
        Command::Collections(command) => collections::run(&context, &command).await,
        Command::Webhook(command) => webhook::run(&context, &command).await,
        Command::Worker(command) => worker::run(&context, &command).await,
        Command::Bundle(command) => bundle::run(&context, &command).await,
        Command::Report(args) => report::run(&context, &args).await,
        Command::Token(command) => token::run(&context, &command).await,
        Command::Admin(command) => admin::run(&context, &command).await,
        Command::Doctor(args) => doctor::run(&context, &args).await,
        Command::Completions(args) => completions::run(&args, &mut Cli::command()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        Cli::command().debug_assert();
    }
}
