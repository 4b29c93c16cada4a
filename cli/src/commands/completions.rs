//! `completions`: a script for a shell, generated from the command line's own definition.

use clap_complete::Shell;

use crate::output;
use crate::problem::Problem;

/// Arguments of `completions`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// For which shell
    #[arg(value_enum)]
    shell: Shell,
}

pub(crate) fn run(args: &Args, command: &mut clap::Command) -> Result<(), Problem> {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, command, "ignctl", &mut script);
    output::raw(&String::from_utf8_lossy(&script))
}
