//! One trace from `ignctl` through coordinator and agent to the child process, as a collector of OpenTelemetry sees it.

use std::collections::BTreeMap;
use std::fs;
use std::net::TcpListener;
use std::process::Command;
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use anyhow::{Context as _, Result, bail, ensure};
use ign_e2e::{
    Client, Coordinator, Demo, Process, Received, Setup, demo_capture, path, program, receiver, run,
};
use opentelemetry_proto::tonic::collector::trace::v1::ExportTraceServiceRequest;
use opentelemetry_proto::tonic::common::v1::any_value::Value;
use opentelemetry_proto::tonic::trace::v1::Span;
use prost::Message as _;

const LIMIT: Duration = Duration::from_mins(3);
const TOKEN: &str = "ign-tracing-token-0123456789abcdef";

/// A span with the service that sent it.
type Sent = (String, Span);

/// Takes reports from now on; programs that end wait for it.
fn collector(address: &str) -> Result<Receiver<Sent>> {
    let reports = receiver(address)?;
    let (sender, spans) = channel();
    std::thread::Builder::new()
        .name("collector".to_owned())
        .spawn(move || {
            for report in reports {
                // Nobody reads any more, or the report is bad: the test misses its spans.
                let taken = read(&report).map(|spans| {
                    spans
                        .into_iter()
                        .try_for_each(|span| sender.send(span).map_err(anyhow::Error::from))
                });
                let status = if matches!(taken, Ok(Ok(()))) {
                    "200 OK"
                } else {
                    "400 Bad Request"
                };
                report.answer(status).ok();
            }
        })?;
    Ok(spans)
}

fn read(report: &Received) -> Result<Vec<Sent>> {
    ensure!(report.path == "/v1/traces", "{}", report.path);
    let request = ExportTraceServiceRequest::decode(report.body.as_slice())?;
    let mut spans = Vec::new();
    for resource in request.resource_spans {
        let attributes = resource.resource.unwrap_or_default().attributes;
        let name = attributes
            .into_iter()
            .find(|it| it.key == "service.name")
            .and_then(|it| it.value?.value);
        let Some(Value::StringValue(service)) = name else {
            bail!("a service without a name");
        };
        for scope in resource.scope_spans {
            spans.extend(scope.spans.into_iter().map(|span| (service.clone(), span)));
        }
    }
    Ok(spans)
}

#[test]
fn a_job_is_one_trace_from_ignctl_to_the_child() -> Result<()> {
    let dir = tempfile::Builder::new().prefix("ign-e2e-").tempdir()?;
    let token = dir.path().join("token");
    fs::write(&token, TOKEN)?;
    let address = TcpListener::bind("127.0.0.1:0")?.local_addr()?.to_string();
    let collector = collector(&address)?;
    let env = BTreeMap::from(
        [
            ("OTEL_EXPORTER_OTLP_ENDPOINT", format!("http://{address}")),
            ("OTEL_BSP_SCHEDULE_DELAY", "200".to_owned()),
        ]
        .map(|(name, value)| (name.to_owned(), value)),
    );
    let mut coordinator = Coordinator::start(Setup {
        name: "coordinator".to_owned(),
        dir: dir.path().to_owned(),
        database: format!("sqlite://{}/ign.db", path(dir.path())?),
        store: format!("file://{}/store", path(dir.path())?),
        token_file: token.clone(),
        args: Vec::new(),
        env: env.clone(),
    })?;
    coordinator.await_ready()?;
    let _worker = Process::start(
        "worker",
        &program("ign-worker")?,
        [
            "agent",
            "--server",
            &coordinator.url(),
            "--token-file",
            path(&token)?,
            "--work-dir",
            path(&dir.path().join("work"))?,
            "--threads",
            "1",
            "--exit-when-stdin-closes",
        ],
        env.clone(),
        &dir.path().join("worker.log"),
    )?;
    let capture = demo_capture(&dir.path().join("capture"), Demo::default())?;
    let ctl = Client::of_server(&coordinator.url(), path(&token)?);
    let submit = ["submit", path(&capture)?, "--object", "museum/vase"];
    let recipe = ["--size", "32", "--budget-secs", "3"];
    let mut command: Command = ctl.command(&[submit.as_slice(), &recipe].concat())?;
    let submitted = run(command.envs(&env), LIMIT)?;
    ensure!(submitted.status.success(), "{submitted:?}");

    // The id is with the job.
    let job = ctl.job("museum/vase")?;
    let trace = job.0["trace_id"].as_str().context("no trace")?.to_owned();
    let shown = ctl.text(&["jobs", "get", job.id()])?;
    ensure!(shown.contains(&trace), "{shown}");

    let mut spans: Vec<Sent> = Vec::new();
    // The agent's span ends last; the coordinator's that it waited for come within a moment.
    while !spans
        .iter()
        .any(|(of, span)| of == "ign-worker" && span.name == "job")
    {
        spans.push(collector.recv_timeout(LIMIT).context("no end of the job")?);
    }
    while let Ok(span) = collector.recv_timeout(Duration::from_secs(2)) {
        spans.push(span);
        ensure!(spans.len() < 10_000);
    }
    let id = u128::from_str_radix(&trace, 16)?.to_be_bytes();
    spans.retain(|(_, span)| span.trace_id == id);
    let of = |service: &str, name: &str| {
        let found = spans
            .iter()
            .find(|(of, span)| of == service && span.name == name);
        found
            .map(|(_, span)| span.clone())
            .with_context(|| format!("{service}: no span {name} in {trace}: {spans:#?}"))
    };
    let root = of("ignctl", "ignctl submit")?;
    let agent = of("ign-worker", "job")?;
    let child = of("ign-worker exec", "bake")?;
    ensure!(root.parent_span_id.is_empty());
    ensure!(child.parent_span_id == agent.span_id, "the child's parent");
    let stages = spans
        .iter()
        .filter(|(_, span)| span.parent_span_id == child.span_id);
    ensure!(stages.count() >= 3, "the stages of the bake");
    // The request that submitted it, and those that the agent made meanwhile.
    let request = |of: &Span| {
        spans.iter().any(|(service, span)| {
            service == "ign-coordinator"
                && span.name == "request"
                && span.parent_span_id == of.span_id
        })
    };
    ensure!(request(&root) && request(&agent), "the coordinator's spans");
    let submit = spans
        .iter()
        .find(|(_, span)| span.span_id == agent.parent_span_id)
        .context("the agent's parent")?;
    ensure!(submit.0 == "ign-coordinator" && submit.1.parent_span_id == root.span_id);
    ensure!(
        child.start_time_unix_nano >= agent.start_time_unix_nano
            && child.end_time_unix_nano <= agent.end_time_unix_nano
    );
    Ok(())
}
