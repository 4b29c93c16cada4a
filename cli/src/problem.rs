//! What can go wrong for the user, as three lines (what, where, how to fix it) and an exit code.
//!
//! Commands return a [`Problem`]; `main` prints it once and exits with its code. Causes are folded into the first
//! line, so nothing is printed twice.

use std::error::Error;
use std::fmt;

use ign_proto::Cause;
use tonic::Code;

/// Exit codes of ignctl; scripts rely on them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Exit {
    /// Everything asked for was done.
    Ok = 0,
    /// Some job, file or check failed.
    Failed = 1,
    /// The command line is wrong.
    Usage = 2,
    /// The coordinator cannot be reached.
    Unreachable = 3,
    /// `--timeout` passed.
    Timeout = 4,
}

/// An error as the user sees it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Problem {
    /// Decides how ignctl ends.
    pub(crate) exit: Exit,
    /// Lowercase, no full stop.
    pub(crate) what: String,
    /// File, line, object or job; may be empty.
    pub(crate) at: String,
    /// How to fix it; may be empty.
    pub(crate) hint: String,
    /// The reader of our output went away: end without a word.
    pub(crate) silent: bool,
}

impl Problem {
    fn with_exit(exit: Exit, what: impl Into<String>) -> Self {
        Self {
            exit,
            what: what.into(),
            at: String::new(),
            hint: String::new(),
            silent: false,
        }
    }

    /// Something asked for was not done.
    pub(crate) fn failed(what: impl Into<String>) -> Self {
        Self::with_exit(Exit::Failed, what)
    }

    /// The command line is wrong.
    pub(crate) fn usage(what: impl Into<String>) -> Self {
        Self::with_exit(Exit::Usage, what)
    }

    /// The coordinator cannot be reached.
    pub(crate) fn unreachable(what: impl Into<String>) -> Self {
        Self::with_exit(Exit::Unreachable, what)
    }

    /// The time allowed passed.
    pub(crate) fn timeout(what: impl Into<String>) -> Self {
        Self::with_exit(Exit::Timeout, what)
    }

    /// Ends with `exit` and without an error message: what there is to say is already in the output.
    pub(crate) fn said(exit: Exit) -> Self {
        Self {
            silent: true,
            ..Self::with_exit(exit, "")
        }
    }

    /// Adds where.
    pub(crate) fn at(mut self, at: impl fmt::Display) -> Self {
        self.at = at.to_string();
        self
    }

    /// Adds how to fix it.
    pub(crate) fn hint(mut self, hint: impl Into<String>) -> Self {
        self.hint = hint.into();
        self
    }

    /// Puts `doing` before the message.
    pub(crate) fn context(mut self, doing: impl fmt::Display) -> Self {
        self.what = format!("{doing}: {}", self.what);
        self
    }
}

impl fmt::Display for Problem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "error: {}", self.what)?;
        if !self.at.is_empty() {
            write!(f, "\n   at: {}", self.at)?;
        }
        if !self.hint.is_empty() {
            write!(f, "\n hint: {}", self.hint)?;
        }
        Ok(())
    }
}

/// The whole chain of causes on one line, without links that only repeat the one before.
pub(crate) fn chain(error: &dyn Error) -> String {
    let mut text = error.to_string();
    let mut source = error.source();
    while let Some(cause) = source {
        let cause_text = cause.to_string();
        if !text.contains(&cause_text) {
            text.push_str(": ");
            text.push_str(&cause_text);
        }
        source = cause.source();
    }
    text
}

impl From<std::io::Error> for Problem {
    fn from(error: std::io::Error) -> Self {
        if error.kind() == std::io::ErrorKind::BrokenPipe {
            return Self::said(Exit::Ok);
        }
        Self::failed(chain(&error))
    }
}

impl From<reqwest::Error> for Problem {
    fn from(error: reqwest::Error) -> Self {
        let at = error.url().map(ToString::to_string).unwrap_or_default();
        let unreachable = error.is_connect() || error.is_timeout();
        let what = chain(&error.without_url());
        if unreachable {
            Self::unreachable(what).at(at)
        } else {
            Self::failed(what).at(at)
        }
    }
}

impl From<tonic::Status> for Problem {
    fn from(status: tonic::Status) -> Self {
        match Cause::from_status(&status) {
            Cause::Transport {
                code: Code::Unavailable | Code::Cancelled,
                message,
            } => {
                let cause = status.source().map_or(message, chain);
                Self::unreachable(format!("the coordinator does not answer: {cause}"))
                    .hint("ignctl doctor")
            }
            Cause::Transport {
                code: Code::DeadlineExceeded,
                message,
            } => Self::timeout(message),
            Cause::Unavailable { message, .. } => {
                Self::unreachable(format!("the coordinator cannot work now: {message}"))
                    .hint("ignctl doctor")
            }
            cause @ Cause::Forbidden { .. } => Self::failed(cause.to_string())
                .hint("ask the service's operator for a token with this scope"),
            cause @ Cause::TooMany { .. } => Self::unreachable(cause.to_string()),
            cause @ Cause::Unauthenticated => {
                Self::failed(cause.to_string()).hint("check --token-file (IGN_TOKEN_FILE)")
            }
            cause => Self::failed(cause.to_string()),
        }
    }
}

/// Says what was being done when an I/O error came up.
pub(crate) trait Doing<T> {
    /// Turns the error into a [`Problem`] that starts with `doing` and lies at `at`.
    fn doing(self, doing: &str, at: impl fmt::Display) -> Result<T, Problem>;
}

impl<T, E: Into<Problem>> Doing<T> for Result<T, E> {
    fn doing(self, doing: &str, at: impl fmt::Display) -> Result<T, Problem> {
        self.map_err(|error| error.into().context(doing).at(at))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn prints_what_where_fix() {
        let problem = Problem::failed("camera 3 has zero focal length")
            .at("sparse/0/cameras.txt:7")
            .hint("re-export with PINHOLE");
        insta::assert_snapshot!(problem, @r"
        error: camera 3 has zero focal length
           at: sparse/0/cameras.txt:7
         hint: re-export with PINHOLE
        ");
    }

    #[test]
    fn status_codes_decide_the_exit_code() {
        let exit = |status: tonic::Status| Problem::from(status).exit;
        assert_eq!(exit(tonic::Status::unavailable("down")), Exit::Unreachable);
        assert_eq!(exit(Cause::absent("job", "0192").status()), Exit::Failed);
        assert_eq!(exit(tonic::Status::deadline_exceeded("")), Exit::Timeout);
        assert_eq!(exit(Cause::Unauthenticated.status()), Exit::Failed);
    }

    #[test]
    fn a_closed_pipe_is_no_error() {
        let closed = std::io::Error::from(std::io::ErrorKind::BrokenPipe);
        assert_eq!(Problem::from(closed), Problem::said(Exit::Ok));
    }
}
