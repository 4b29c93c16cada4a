//! One trace from `ignctl` through coordinator, queue and agent to the child process.
//!
//! - [`TraceParent`]: the W3C trace context, as it stands in a header, with a job, in the environment.
//! - [`current`], [`within`], [`carry`]: where a task finds the one that it works under.
//! - [`Exporter`]: spans by OTLP, where `OTEL_EXPORTER_OTLP_ENDPOINT` is set.
//!
//! Invariant: without that variable no span is kept, no thread is started and nothing is sent; the id still travels.

mod context;
mod export;

pub use context::{TraceParent, carry, current, within};
pub use export::{Error, Exporter, Span};

/// Header of HTTP requests and gRPC calls.
pub const HEADER: &str = "traceparent";
/// Variable of the environment by which a process is told.
pub const VARIABLE: &str = "TRACEPARENT";
