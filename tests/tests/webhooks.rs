//! Webhooks with real processes: the receiver checks the signature by itself and fetches the bundle before it answers; it
//! is away and comes back; the coordinator dies between sending and knowing that it has.

use std::fs;
use std::io::Write as _;
use std::net::TcpListener;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail, ensure};
use ign_e2e::{
    Api, Client, Coordinator, Received, Setup, path, receiver, scripted_agent, wait_until,
};
use ign_proto::Digest;
use reqwest::Method;
use serde_json::{Value, json};

const MINUTE: Duration = Duration::from_mins(1);
const TOKEN: &str = "ign-webhooks-token-0123456789abcdef";
/// base64 of 32 bytes.
const SECRET: &str = "Y2FuYXJ5LXNlY3JldC1vZi1hLXdlYmhvb2stMDEyMzQ=";

/// The signature as another implementation of HMAC makes it.
const SIGN: &str = "import base64, hashlib, hmac, os, sys
key = base64.b64decode(os.environ['KEY'])
mac = hmac.new(key, sys.stdin.buffer.read(), hashlib.sha256)
print('v1,' + base64.b64encode(mac.digest()).decode())";

fn signature(id: &str, timestamp: &str, body: &str) -> Result<String> {
    let mut python = Command::new("python3")
        .args(["-c", SIGN])
        .env("KEY", SECRET)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()?;
    let mut stdin = python.stdin.take().context("no stdin")?;
    stdin.write_all(format!("{id}.{timestamp}.{body}").as_bytes())?;
    drop(stdin);
    let output = python.wait_with_output()?;
    ensure!(output.status.success(), "{output:?}");
    Ok(String::from_utf8(output.stdout)?.trim().to_owned())
}

/// What a hook tells, once the signature has proven who says so.
fn verified(hook: &Received) -> Result<Value> {
    let (id, timestamp) = (hook.header("webhook-id"), hook.header("webhook-timestamp"));
    let expected = signature(id, timestamp, std::str::from_utf8(&hook.body)?)?;
    ensure!(
        hook.header("webhook-signature") == expected,
        "{hook:?} instead of {expected}"
    );
    Ok(serde_json::from_slice(&hook.body)?)
}

/// Fetches every file that the hook's bundle names.
async fn fetch(api: &Api, event: &Value) -> Result<usize> {
    let data = &event["data"];
    let text = |value: &Value| value.as_str().map(str::to_owned).context("no text");
    let object = format!("{}/{}", text(&data["collection"])?, text(&data["object"])?);
    let digest = text(&data["bundle"]["manifest_digest"])?;
    let get = async |path: String| -> Result<Vec<u8>> {
        let answer = api.send(api.request(Method::GET, &path)).await?;
        Ok(answer.bytes().await?.to_vec())
    };
    let bytes = get(format!("/v2/{object}/manifests/{digest}")).await?;
    ensure!(Digest::of(&bytes).as_str() == digest, "another manifest");
    let manifest: Value = serde_json::from_slice(&bytes)?;
    let layers = manifest["layers"].as_array().context("no layers")?;
    for layer in layers {
        let digest = text(&layer["digest"])?;
        let bytes = get(format!("/v2/{object}/blobs/{digest}")).await?;
        ensure!(Digest::of(&bytes).as_str() == digest, "another file");
    }
    Ok(layers.len())
}

#[test]
fn hooks_are_signed_come_after_the_bundle_and_survive_both_sides() -> Result<()> {
    let dir = tempfile::Builder::new().prefix("ign-e2e-").tempdir()?;
    let token = dir.path().join("token");
    let secret = dir.path().join("secret");
    fs::write(&token, TOKEN)?;
    fs::write(&secret, format!("whsec_{SECRET}\n"))?;
    // Nobody listens there yet.
    let address = TcpListener::bind("127.0.0.1:0")?.local_addr()?.to_string();
    let mut coordinator = Coordinator::start(Setup {
        name: "coordinator".to_owned(),
        dir: dir.path().to_owned(),
        database: format!("sqlite://{}/ign.db", path(dir.path())?),
        store: format!("file://{}/store", path(dir.path())?),
        token_file: token.clone(),
        args: vec!["--webhook-internal".to_owned(), address.clone()],
        env: [("IGN_LOG".to_owned(), "debug".to_owned())].into(),
    })?;
    coordinator.await_ready()?;
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()?;
    let api = {
        let _entered = runtime.enter();
        Api::new(&coordinator.url(), TOKEN)?
    };
    let ctl = Client::of_server(&coordinator.url(), path(&token)?);
    let _agent = scripted_agent(dir.path(), &coordinator.url(), TOKEN, "agent-1", None)?;

    // Closed but for the one that the operator named.
    let set = |url: &str| {
        let file = path(&secret)?;
        ctl.run(&[
            "webhook",
            "set",
            "museum",
            "--url",
            url,
            "--secret-file",
            file,
        ])
    };
    for inside in [
        "http://127.0.0.1:9/hook",
        "https://169.254.169.254/latest",
        "http://archive.example/hook",
    ] {
        let refused = set(inside)?;
        ensure!(refused.status.code() == Some(1), "{inside}: {refused:?}");
    }
    let set = set(&format!("http://{address}/hook"))?;
    ensure!(set.status.success(), "{set:?}");

    // The receiver is away when the job ends.
    let script = json!([{"done": 100_000}]);
    let job = runtime.block_on(api.submit("museum/vase", "1", &script))?;
    ctl.text(&["wait", &job.id])?;
    let deliveries = || ctl.json(&["webhook", "deliveries", "museum"]);
    let failed = wait_until("a try that fails", MINUTE, || {
        let first = deliveries()?[0].clone();
        Ok((first["last_error"] != Value::Null).then_some(first))
    })?;
    ensure!(
        failed["state"] == "pending" && failed["tries"] == 1,
        "{failed}"
    );

    // It comes up, and fetches the bundle before it says that it has heard.
    let hooks = receiver(&address)?;
    let hook = hooks.recv_timeout(MINUTE)?;
    ensure!(hook.path == "/hook");
    ensure!(hook.header("content-type") == "application/json");
    let event = verified(&hook)?;
    ensure!(
        event["type"] == "job.succeeded" && event["data"]["job"] == job.id,
        "{event}"
    );
    ensure!(hook.header("webhook-id") == failed["id"].as_str().unwrap_or_default());
    let sent: i64 = hook.header("webhook-timestamp").parse()?;
    let now = std::time::UNIX_EPOCH.elapsed()?.as_secs() as i64;
    ensure!((now - sent).abs() < 60, "sent at {sent}");
    ensure!(runtime.block_on(fetch(&api, &event))? == 3);
    hook.answer("204 No Content")?;
    let state = |id: &str, state: &str| {
        wait_until(state, MINUTE, || {
            let deliveries = deliveries()?;
            let all = deliveries.as_array().context("no list")?;
            let one = all
                .iter()
                .find(|it| it["id"] == id)
                .context("no delivery")?;
            Ok((one["state"] == state).then(|| one.clone()))
        })
    };
    let first = failed["id"].as_str().unwrap_or_default().to_owned();
    ensure!(state(&first, "delivered")?["tries"] == 2);

    // A redirect is an answer, and not followed. An answer without an end is not read.
    ctl.text(&["webhook", "redeliver", "museum", &first])?;
    let hook = hooks.recv_timeout(MINUTE)?;
    hook.answer(&format!(
        "307 Temporary Redirect\r\nLocation: http://{address}/elsewhere"
    ))?;
    let told = wait_until("the redirect's end", MINUTE, || {
        let one = state(&first, "pending")?;
        Ok(one["last_error"].as_str().map(str::to_owned))
    })?;
    ensure!(told.contains("307"), "{told}");
    ctl.text(&["webhook", "redeliver", "museum", &first])?;
    let hook = hooks.recv_timeout(MINUTE)?;
    ensure!(hook.path == "/hook", "followed to {}", hook.path);
    let hook = hook.begin_answer("200 OK\r\nContent-Length: 1000000000000\r\n\r\nand so on")?;
    let begun = Instant::now();
    state(&first, "delivered")?;
    ensure!(begun.elapsed() < Duration::from_secs(8));
    drop(hook);

    // The coordinator dies after it has sent and before it knows: the same comes again.
    let failing = json!([{"fail": "no mesh"}]);
    let job = runtime.block_on(api.submit("museum/urn", "2", &failing))?;
    let hook = hooks.recv_timeout(MINUTE)?;
    let event = verified(&hook)?;
    ensure!(
        event["type"] == "job.failed" && event["data"]["job"] == job.id,
        "{event}"
    );
    ensure!(event["data"]["failure"]["message"] == "no mesh", "{event}");
    let (id, body) = (hook.header("webhook-id").to_owned(), hook.body.clone());
    coordinator.kill()?;
    drop(hook);
    coordinator.replace(None)?;
    coordinator.await_ready()?;
    let api = {
        let _entered = runtime.enter();
        Api::new(&coordinator.url(), TOKEN)?
    };
    let hook = hooks.recv_timeout(MINUTE)?;
    ensure!(hook.header("webhook-id") == id && hook.body == body);
    verified(&hook)?;
    hook.answer("200 OK")?;
    state(&id, "delivered")?;

    // No more after that, and the secret is nowhere to be seen.
    ctl.text(&["webhook", "remove", "museum"])?;
    runtime.block_on(api.submit("museum/bust", "3", &json!([{"done": 10}])))?;
    ctl.text(&["wait", "museum/bust"])?;
    if let Ok(hook) = hooks.recv_timeout(Duration::from_secs(3)) {
        bail!("sent after the webhook was removed: {hook:?}");
    }
    let listed = ctl.text(&["webhook", "list", "-o", "json"])?;
    for (what, text) in [("log", coordinator.output()), ("list", listed)] {
        ensure!(!text.contains(SECRET), "the secret is in the {what}");
    }
    Ok(())
}
