//! `preflight`: what a bake can expect of captures, without a coordinator and without sending anything.

use std::path::{Path, PathBuf};

use ign_capture::{Fault, Preflight, PreflightOptions, Severity};
use serde::Serialize;

use crate::Context;
use crate::commands::submit::captures_in;
use crate::output;
use crate::problem::Problem;

/// Arguments of `preflight`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Capture folders, or folders that hold captures
    #[arg(value_name = "PATH", required = true)]
    paths: Vec<PathBuf>,
    /// Side of the images that are going to be baked, in pixels
    #[arg(long, value_name = "PX", default_value_t = 256, value_parser = clap::value_parser!(u32).range(16..=4096))]
    size: u32,
    /// Seconds of training that the recipe is going to allow
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    budget_secs: Option<u32>,
    /// Proxy mesh to use instead of the capture's own, by its path inside the capture
    #[arg(long, value_name = "FILE")]
    proxy: Option<PathBuf>,
}

/// The report on one capture.
#[derive(Debug, Serialize)]
struct ReportView {
    path: PathBuf,
    #[serde(flatten)]
    report: Preflight,
}

pub(crate) async fn run(context: &Context, args: &Args) -> Result<(), Problem> {
    let mut captures = Vec::new();
    for path in &args.paths {
        captures.extend(captures_in(path)?);
    }
    let total = captures.len();
    let mut reports = Vec::with_capacity(total);
    for (index, path) in captures.into_iter().enumerate() {
        output::note(&format!(
            "{}/{total}  looking at {}",
            index + 1,
            path.display()
        ));
        let options = PreflightOptions {
            proxy: args.proxy.clone(),
            size: args.size,
            budget_secs: args.budget_secs.map(f64::from),
        };
        let report = examine(path.clone(), options).await?;
        reports.push(ReportView { path, report });
    }
    output::data(context.format, &reports, || {
        let texts: Vec<String> = reports
            .iter()
            .map(|view| screen(&view.path, &view.report))
            .collect();
        texts.join("\n")
    })?;
    match reports.iter().filter(|view| !view.report.ok).count() {
        0 => Ok(()),
        bad => Err(Problem::failed(format!(
            "{bad} of {total} captures would fail"
        ))),
    }
}

/// Runs the preflight beside the runtime: it takes all cores for seconds.
pub(crate) async fn examine(
    capture: PathBuf,
    options: PreflightOptions,
) -> Result<Preflight, Problem> {
    tokio::task::spawn_blocking(move || ign_capture::preflight(&capture, &options))
        .await
        .map_err(|error| Problem::failed(format!("the preflight stopped: {error}")))
}

/// One capture on one screen.
fn screen(path: &Path, report: &Preflight) -> String {
    let count = |severity| {
        report
            .faults
            .iter()
            .filter(|fault| fault.severity == severity)
            .count()
    };
    let verdict = match (count(Severity::Error), count(Severity::Warning)) {
        (0, 0) => "nothing to complain of".to_owned(),
        (0, 1) => "ready, with one warning".to_owned(),
        (0, warnings) => format!("ready, with {warnings} warnings"),
        (1, _) => "cannot be baked: one error".to_owned(),
        (errors, _) => format!("cannot be baked: {errors} errors"),
    };
    let mut text = format!(
        "{}  {verdict}\n",
        output::heading(&output::printable(&path.display().to_string()))
    );
    for line in report.lines() {
        let mark = if line.doubtful { '!' } else { ' ' };
        text.push_str(&output::wrapped(
            &format!("{mark} {:<13}", line.subject),
            &line.text,
        ));
    }
    if !report.faults.is_empty() {
        text.push('\n');
        text.push_str(&faults(&report.faults));
    }
    text
}

/// Faults with place and hint, a block each.
pub(crate) fn faults(faults: &[Fault]) -> String {
    let lines = faults.iter().flat_map(|fault| {
        let label = match fault.severity {
            Severity::Error => "error",
            Severity::Warning => "warning",
        };
        [
            (label, &fault.message),
            ("at", &fault.at),
            ("hint", &fault.hint),
        ]
        .into_iter()
        .filter(|(_, line)| !line.is_empty())
        .map(|(label, line)| output::wrapped(&format!("  {label:>7}: "), line))
    });
    lines.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_capture_that_cannot_be_read_lists_its_faults() {
        let fault = |severity, message: &str| Fault {
            severity,
            message: message.into(),
            at: "sparse/0/cameras.txt:7".into(),
            hint: "re-export with PINHOLE".into(),
        };
        let report = Preflight {
            capture: "vase".into(),
            ok: false,
            faults: vec![
                fault(Severity::Error, "camera 3 has zero focal length"),
                fault(Severity::Warning, "view a.jpg has no mask"),
            ],
            findings: None,
        };
        insta::assert_snapshot!(screen(Path::new("captures/vase"), &report), @r"
        captures/vase  cannot be baked: one error

            error: camera 3 has zero focal length
               at: sparse/0/cameras.txt:7
             hint: re-export with PINHOLE
          warning: view a.jpg has no mask
               at: sparse/0/cameras.txt:7
             hint: re-export with PINHOLE
        ");
    }
}
