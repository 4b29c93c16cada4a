//! The worker binary.
//!
//! `agent` takes jobs from a coordinator; it never touches torch. `exec` bakes one job in a process of its own,
//! which may crash without harm. `render`, `demo-capture`, `experiment` and `pretrain` are for people.
//!
//! Streams: data on stdout (events of `exec`, paths of written files), the rest on stderr. Exit codes: 0 done,
//! 1 failed, 2 wrong usage.

mod agent;
mod demo;
mod exec;
mod experiment;
mod gpu;
mod output;
mod pretrain;
mod render;

use std::process::ExitCode;

use clap::{CommandFactory, Parser, Subcommand};

/// Bakes captures into model bundles, and renders bundles.
#[derive(Debug, Parser)]
#[command(name = "ign-worker", version, propagate_version = true)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Take jobs from a coordinator until stopped.
    Agent(agent::Options),
    /// Bake one job; events on stdout. Ends when stdin does.
    Exec(exec::Options),
    /// Render views of a bundle.
    Render(render::Options),
    /// Generate a capture of a painted, glossy object, with ground truth.
    DemoCapture(demo::Options),
    /// Repeat one of the paper's experiments: bakes, and a table and a plot of what they found.
    Experiment(experiment::Options),
    /// Train the weights that every CompositionNet starts from; `make pretrain` does it on generated captures.
    Pretrain(pretrain::Options),
    /// Print a shell's completion script.
    Completions {
        /// The shell.
        shell: clap_complete::Shell,
    },
    /// Print what bakes run on; fails when that does not work.
    #[command(hide = true)]
    Device,
    /// Print what bakes need of this machine, as JSON, for ignctl doctor.
    #[command(hide = true)]
    Doctor,
}

fn main() -> ExitCode {
    let result = match Cli::parse().command {
        Command::Agent(options) => agent::run(options),
        Command::Exec(options) => return exec::run(&options),
        Command::Render(options) => render::run(&options),
        Command::Experiment(options) => experiment::run(&options),
        Command::Pretrain(options) => pretrain::run(&options),
        Command::DemoCapture(options) => demo::run(&options),
        Command::Completions { shell } => {
            let mut command = Cli::command();
            clap_complete::generate(shell, &mut command, "ign-worker", &mut std::io::stdout());
            Ok(())
        }
        Command::Device => gpu::check().map(|device| output::data(&device)),
        Command::Doctor => {
            output::data(&gpu::report().to_string());
            Ok(())
        }
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            output::error(&error);
            ExitCode::FAILURE
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn render_wants_one_source_of_cameras() {
        for arguments in [
            &["ign-worker", "render", "b", "--out", "o"][..],
            &[
                "ign-worker",
                "render",
                "b",
                "--out",
                "o",
                "--orbit",
                "3",
                "--view",
                "a",
            ],
        ] {
            let error = Cli::try_parse_from(arguments).unwrap_err();
            assert_eq!(error.exit_code(), 2);
        }
    }
}
