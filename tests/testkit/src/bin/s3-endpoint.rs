//! An S3 endpoint over a folder as a process of its own, for end-to-end tests and for trying things by hand.
//!
//! Prints its URL as the first line on stdout once it listens.

use std::io::Write;
use std::path::PathBuf;

use anyhow::{Context, Result};
use clap::Parser;
use ign_testkit::{Credentials, serve};
use tokio::io::AsyncReadExt;

#[derive(Debug, Parser)]
#[command(version, about)]
struct Args {
    /// Folder that holds the buckets; made where it is missing.
    #[arg(long)]
    root: PathBuf,
    /// Address to listen on.
    #[arg(long, default_value = "127.0.0.1:0")]
    listen: String,
    /// Bucket to make at the start.
    #[arg(long)]
    bucket: Option<String>,
    /// Access key that clients sign with.
    #[arg(long, env = "AWS_ACCESS_KEY_ID", default_value_t = Credentials::default().access_key)]
    access_key: String,
    /// Secret key that clients sign with.
    #[arg(long, env = "AWS_SECRET_ACCESS_KEY", default_value_t = Credentials::default().secret_key, hide_env_values = true)]
    secret_key: String,
    /// End when stdin reaches its end, so that no endpoint outlives the test that started it.
    #[arg(long)]
    exit_when_stdin_closes: bool,
}

#[tokio::main(flavor = "current_thread")]
async fn main() -> Result<()> {
    let args = Args::parse();
    std::fs::create_dir_all(&args.root)
        .with_context(|| format!("cannot make {}", args.root.display()))?;
    if let Some(bucket) = &args.bucket {
        std::fs::create_dir_all(args.root.join(bucket))
            .with_context(|| format!("cannot make bucket {bucket}"))?;
    }
    let listener = tokio::net::TcpListener::bind(&args.listen)
        .await
        .with_context(|| format!("cannot listen on {}", args.listen))?;
    let mut stdout = std::io::stdout();
    writeln!(stdout, "http://{}", listener.local_addr()?)?;
    stdout.flush()?;
    let credentials = Credentials {
        access_key: args.access_key,
        secret_key: args.secret_key,
    };
    let stop = async {
        if args.exit_when_stdin_closes {
            let mut rest = [0; 64];
            while matches!(tokio::io::stdin().read(&mut rest).await, Ok(n) if n > 0) {}
        } else {
            tokio::signal::ctrl_c().await.ok();
        }
    };
    serve(&args.root, listener, &credentials, stop).await
}
