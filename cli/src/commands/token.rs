//! Commands about bearer tokens: `token create|list|rotate|revoke`.
//!
//! A secret is shown once, on stdout or in a file that others cannot read, and is never an argument. The place of the
//! file is made sure of before the token is made, so that no secret is lost for want of a place.

use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::time::Duration;

use chrono::{DateTime, Utc};
use ign_proto::{Grant, v1};
use serde::Serialize;
use tempfile::NamedTempFile;

use crate::Context;
use crate::connection::Connection;
use crate::output::{self, Format, Table, age};
use crate::problem::{Doing as _, Problem};
use crate::views::time;

/// `token create|list|rotate|revoke`.
#[derive(Debug, clap::Subcommand)]
pub(crate) enum Command {
    /// Make a token; its secret is printed once
    Create(CreateArgs),
    /// List tokens, without their secrets
    List,
    /// Give a token another secret; the old one is good for a while
    Rotate(RotateArgs),
    /// End a token, for ever
    Revoke {
        /// Name or id
        token: String,
    },
}

/// Arguments of `token create`.
#[derive(Debug, clap::Args)]
pub(crate) struct CreateArgs {
    /// What it is called in lists: who uses it, where
    name: String,
    /// Scope and collection: submit, read, publish (workers) or admin in one collection or in all (*); may be given again
    #[arg(long, required = true, value_name = "SCOPE:C")]
    allow: Vec<Grant>,
    /// Ends after so long, such as 90d or 12h, or never
    #[arg(long, value_name = "TIME", default_value = "365d", value_parser = validity)]
    expires: Validity,
    /// Write the secret to this new file, which others cannot read
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
}

/// Arguments of `token rotate`.
#[derive(Debug, clap::Args)]
pub(crate) struct RotateArgs {
    /// Name or id
    token: String,
    /// How long the old secret stays good
    #[arg(long, value_name = "TIME", default_value = "1h", value_parser = duration)]
    grace: Duration,
    /// Ends after so long from now [default: as before]
    #[arg(long, value_name = "TIME", value_parser = duration)]
    expires: Option<Duration>,
    /// Write the secret to this file, which others cannot read; what was there is replaced
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
}

/// How long a token is good; none for ever.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Validity(Option<Duration>);

fn validity(text: &str) -> Result<Validity, String> {
    if text == "never" {
        return Ok(Validity(None));
    }
    duration(text).map(|it| Validity(Some(it)))
}

/// `90s`, `10m`, `12h`, `365d`.
fn duration(text: &str) -> Result<Duration, String> {
    let wrong = || "expected a time such as 10m, 12h or 90d".to_owned();
    let unit = text.chars().next_back().ok_or_else(wrong)?;
    let secs = match unit {
        's' => 1,
        'm' => 60,
        'h' => 3600,
        'd' => 86_400,
        _ => return Err(wrong()),
    };
    let count: u64 = text[..text.len() - 1].parse().map_err(|_error| wrong())?;
    let secs = count.checked_mul(secs).filter(|secs| *secs < 1 << 40);
    secs.map(Duration::from_secs).ok_or_else(wrong)
}

/// A token, with stable field names.
#[derive(Clone, Debug, Serialize)]
struct TokenView {
    id: String,
    name: String,
    allows: Vec<String>,
    state: &'static str,
    created_at: Option<DateTime<Utc>>,
    expires_at: Option<DateTime<Utc>>,
    revoked_at: Option<DateTime<Utc>>,
    last_used_on: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    secret: Option<String>,
}

impl TokenView {
    fn new(token: v1::Token, now: DateTime<Utc>) -> Self {
        let expires_at = time(token.expires_at.as_ref());
        let revoked_at = time(token.revoked_at.as_ref());
        Self {
            id: token.id,
            name: token.name,
            allows: token.grants,
            state: match (revoked_at, expires_at) {
                (Some(_), _) => "revoked",
                (None, Some(end)) if end <= now => "expired",
                _ => "ok",
            },
            created_at: time(token.created_at.as_ref()),
            expires_at,
            revoked_at,
            last_used_on: Some(token.last_used_on).filter(|day| !day.is_empty()),
            secret: None,
        }
    }
}

pub(crate) async fn run(context: &Context, command: &Command) -> Result<(), Problem> {
    match command {
        Command::Create(args) => create(context, args).await,
        Command::List => list(context).await,
        Command::Rotate(args) => rotate(context, args).await,
        Command::Revoke { token } => {
            let connection = Connection::open(&context.connection).await?;
            let request = v1::RevokeTokenRequest {
                token: token.clone(),
            };
            let token = connection.tokens().revoke(request).await?.into_inner();
            let view = TokenView::new(token, Utc::now());
            output::data(context.format, &view, || table(std::slice::from_ref(&view)))
        }
    }
}

async fn create(context: &Context, args: &CreateArgs) -> Result<(), Problem> {
    let place = match &args.out {
        Some(file) if file.exists() => {
            return Err(Problem::usage("the file is there already").at(file.display()));
        }
        Some(file) => Some(Place::new(file)?),
        None => None,
    };
    let connection = Connection::open(&context.connection).await?;
    let request = v1::CreateTokenRequest {
        name: args.name.clone(),
        grants: args.allow.iter().map(Grant::to_string).collect(),
        valid_secs: args.expires.0.unwrap_or_default().as_secs_f64(),
    };
    let made = connection.tokens().create(request).await?.into_inner();
    hand_over(context, made, place)
}

async fn rotate(context: &Context, args: &RotateArgs) -> Result<(), Problem> {
    let place = args.out.as_deref().map(Place::new).transpose()?;
    let connection = Connection::open(&context.connection).await?;
    let request = v1::RotateTokenRequest {
        token: args.token.clone(),
        grace_secs: args.grace.as_secs_f64(),
        valid_secs: args.expires.unwrap_or_default().as_secs_f64(),
    };
    let made = connection.tokens().rotate(request).await?.into_inner();
    hand_over(context, made, place)
}

/// A file beside the one that a secret is to replace; nobody else can read it.
struct Place<'a> {
    file: &'a Path,
    temporary: NamedTempFile,
}

impl<'a> Place<'a> {
    fn new(file: &'a Path) -> Result<Self, Problem> {
        let folder = file
            .parent()
            .filter(|parent| !parent.as_os_str().is_empty())
            .unwrap_or(Path::new("."));
        let temporary = NamedTempFile::new_in(folder).doing("cannot write", file.display())?;
        Ok(Self { file, temporary })
    }

    fn keep(mut self, secret: &str) -> Result<(), Problem> {
        writeln!(self.temporary, "{secret}").doing("cannot write", self.file.display())?;
        let kept = self.temporary.persist(self.file);
        kept.map(drop)
            .map_err(|failed| failed.error)
            .doing("cannot write", self.file.display())
    }
}

/// Gives the secret to the user: to the file, or to stdout alone so that it can be piped.
fn hand_over(
    context: &Context,
    made: v1::TokenSecret,
    place: Option<Place<'_>>,
) -> Result<(), Problem> {
    let token = made
        .token
        .ok_or_else(|| Problem::failed("the coordinator answered no token"))?;
    let mut view = TokenView::new(token, Utc::now());
    if let Some(place) = place {
        place.keep(&made.secret)?;
        return output::data(context.format, &view, || table(std::slice::from_ref(&view)));
    }
    view.secret = Some(made.secret.clone());
    if context.format == Format::Table {
        output::note(&format!(
            "token {} ({}), shown this once:",
            view.name, view.id
        ));
    }
    output::data(context.format, &view, || format!("{}\n", made.secret))
}

async fn list(context: &Context) -> Result<(), Problem> {
    let connection = Connection::open(&context.connection).await?;
    let answer = connection.tokens().list(v1::ListTokensRequest {}).await?;
    let now = Utc::now();
    let tokens = answer.into_inner().tokens.into_iter();
    let views: Vec<TokenView> = tokens.map(|token| TokenView::new(token, now)).collect();
    if views.is_empty() {
        output::note("no token but the one of the coordinator's token file");
    }
    output::data(context.format, &views, || match views.len() {
        0 => String::new(),
        _ => table(&views),
    })
}

fn table(tokens: &[TokenView]) -> String {
    let now = Utc::now();
    let mut table = Table::new(&[
        "NAME",
        "ID",
        "STATE",
        "ALLOWS",
        ">AGE",
        "EXPIRES",
        "LAST USED",
    ]);
    for token in tokens {
        table.row([
            token.name.clone(),
            token.id.clone(),
            token.state.to_owned(),
            token.allows.join(" "),
            age(token.created_at, now),
            token
                .expires_at
                .map_or("never".to_owned(), |at| at.format("%Y-%m-%d").to_string()),
            token
                .last_used_on
                .clone()
                .unwrap_or_else(|| "never".to_owned()),
        ]);
    }
    table.to_string()
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt as _;

    use super::*;

    #[test]
    fn times_are_read() {
        assert_eq!(duration("90d"), Ok(Duration::from_hours(24 * 90)));
        assert_eq!(duration("0s"), Ok(Duration::ZERO));
        for bad in ["", "d", "90", "1.5h", "-1d", "99999999999999d", "1ä"] {
            assert!(duration(bad).is_err(), "{bad}");
        }
        assert!(matches!(validity("never"), Ok(Validity(None))));
    }

    #[test]
    fn a_secret_s_file_is_for_its_owner() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("token");
        std::fs::write(&file, "old").unwrap();
        Place::new(&file).unwrap().keep("new").unwrap();
        assert_eq!(std::fs::read_to_string(&file).unwrap(), "new\n");
        assert_eq!(
            std::fs::metadata(&file).unwrap().permissions().mode() & 0o777,
            0o600
        );
        assert!(Place::new(&dir.path().join("absent/token")).is_err());
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1);
    }
}
