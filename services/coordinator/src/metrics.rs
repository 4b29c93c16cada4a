//! Counters of this process, and gauges of the queue, in Prometheus' text format.

use std::fmt::Write as _;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use ign_queue::Status;

/// Counters since start.
#[derive(Debug, Default)]
pub(crate) struct Metrics {
    requests: [Requests; 2],
    pub(crate) bytes_received: AtomicU64,
    pub(crate) bytes_sent: AtomicU64,
    pub(crate) published: AtomicU64,
    pub(crate) reaped: AtomicU64,
    pub(crate) registry_faults: AtomicU64,
    pub(crate) webhooks_delivered: AtomicU64,
    pub(crate) webhooks_failed: AtomicU64,
}

#[derive(Debug, Default)]
struct Requests {
    /// By the status' first digit; index 0 holds the odd ones.
    by_class: [AtomicU64; 6],
    micros: AtomicU64,
}

impl Metrics {
    /// Counts a request by what it spoke.
    pub(crate) fn request(&self, grpc: bool, status: u16, elapsed: Duration) {
        let requests = &self.requests[usize::from(grpc)];
        let class = usize::from(status / 100);
        requests.by_class[if class < 6 { class } else { 0 }].fetch_add(1, Ordering::Relaxed);
        requests
            .micros
            .fetch_add(elapsed.as_micros() as u64, Ordering::Relaxed);
    }

    /// Everything as text; gauges of the queue are left out when the database does not answer.
    pub(crate) fn render(&self, status: Option<&Status>) -> String {
        let mut text = String::new();
        let mut metric = |name: &str, kind: &str, help: &str, samples: &[(String, f64)]| {
            // Writing to a String cannot fail.
            let _infallible = writeln!(text, "# HELP {name} {help}\n# TYPE {name} {kind}");
            for (labels, value) in samples {
                let _infallible = writeln!(text, "{name}{labels} {value}");
            }
        };
        let load = |counter: &AtomicU64| counter.load(Ordering::Relaxed) as f64;
        let plain = |value: f64| [(String::new(), value)];
        let protocols = ["http", "grpc"].into_iter().zip(&self.requests);
        let counts: Vec<(String, f64)> = protocols
            .clone()
            .flat_map(|(protocol, requests)| {
                requests
                    .by_class
                    .iter()
                    .enumerate()
                    .skip(1)
                    .map(move |(class, count)| {
                        (
                            format!("{{protocol=\"{protocol}\",status=\"{class}xx\"}}"),
                            load(count),
                        )
                    })
            })
            .collect();
        metric(
            "ign_requests_total",
            "counter",
            "requests answered",
            &counts,
        );
        let seconds: Vec<(String, f64)> = protocols
            .map(|(protocol, requests)| {
                (
                    format!("{{protocol=\"{protocol}\"}}"),
                    load(&requests.micros) / 1e6,
                )
            })
            .collect();
        metric(
            "ign_request_seconds_total",
            "counter",
            "time until the answer began",
            &seconds,
        );
        metric(
            "ign_blob_bytes_received_total",
            "counter",
            "bytes of uploads",
            &plain(load(&self.bytes_received)),
        );
        metric(
            "ign_blob_bytes_sent_total",
            "counter",
            "bytes of downloads begun",
            &plain(load(&self.bytes_sent)),
        );
        metric(
            "ign_versions_published_total",
            "counter",
            "bundles published",
            &plain(load(&self.published)),
        );
        metric(
            "ign_leases_reaped_total",
            "counter",
            "jobs taken back from silent workers",
            &plain(load(&self.reaped)),
        );
        metric(
            "ign_registry_faults_total",
            "counter",
            "damaged or absent content that audits found",
            &plain(load(&self.registry_faults)),
        );
        metric(
            "ign_webhook_tries_total",
            "counter",
            "webhooks sent, by whether the receiver took them",
            &[
                (
                    "{outcome=\"delivered\"}".to_owned(),
                    load(&self.webhooks_delivered),
                ),
                (
                    "{outcome=\"failed\"}".to_owned(),
                    load(&self.webhooks_failed),
                ),
            ],
        );
        if let Some(bytes) = resident_bytes() {
            metric(
                "process_resident_memory_bytes",
                "gauge",
                "memory of the coordinator",
                &plain(bytes as f64),
            );
        }
        if let Some(status) = status {
            let jobs: Vec<(String, f64)> = status
                .counts
                .iter()
                .map(|(state, count)| (format!("{{state=\"{}\"}}", state.as_str()), *count as f64))
                .collect();
            metric("ign_jobs", "gauge", "jobs by state", &jobs);
            let busy = status
                .workers
                .iter()
                .filter(|worker| !worker.jobs.is_empty())
                .count();
            let workers = [
                ("{state=\"busy\"}".to_owned(), busy as f64),
                (
                    "{state=\"idle\"}".to_owned(),
                    (status.workers.len() - busy) as f64,
                ),
            ];
            metric(
                "ign_workers",
                "gauge",
                "workers seen within the last hour",
                &workers,
            );
        }
        text
    }
}

/// Resident memory of this process where the system tells.
fn resident_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status
        .lines()
        .find_map(|line| line.strip_prefix("VmRSS:"))?;
    Some(
        line.trim()
            .strip_suffix(" kB")?
            .trim()
            .parse::<u64>()
            .ok()?
            * 1024,
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_has_a_help_and_a_type_for_every_metric() {
        let metrics = Metrics::default();
        metrics.request(true, 200, Duration::from_millis(1500));
        metrics.request(false, 404, Duration::ZERO);
        metrics.request(false, 999, Duration::ZERO);
        let text = metrics.render(None);
        assert!(
            text.contains("ign_requests_total{protocol=\"grpc\",status=\"2xx\"} 1\n"),
            "{text}"
        );
        assert!(
            text.contains("ign_requests_total{protocol=\"http\",status=\"4xx\"} 1\n"),
            "{text}"
        );
        assert!(
            text.contains("ign_request_seconds_total{protocol=\"grpc\"} 1.5\n"),
            "{text}"
        );
        let count = |prefix: &str| text.lines().filter(|line| line.starts_with(prefix)).count();
        assert_eq!(count("# HELP"), count("# TYPE"));
    }
}
