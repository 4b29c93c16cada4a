//! Spans to a collector, by OTLP over HTTP.

use std::borrow::Cow;

use opentelemetry::Context;
use opentelemetry::trace::{Span as _, SpanBuilder, Status, Tracer as _, TracerProvider as _};
use opentelemetry_otlp::SpanExporter;
use opentelemetry_sdk::Resource;
use opentelemetry_sdk::trace::{SdkTracer, SdkTracerProvider};
use tracing_subscriber::Layer;
use tracing_subscriber::filter::LevelFilter;
use tracing_subscriber::registry::LookupSpan;

use crate::TraceParent;

const ENDPOINT: &str = "OTEL_EXPORTER_OTLP_ENDPOINT";

/// The collector cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("cannot export traces to {ENDPOINT}")]
pub struct Error(#[from] opentelemetry_otlp::ExporterBuildError);

/// Collects spans and sends them from a thread of its own; what is left is sent when it is dropped.
#[derive(Debug)]
pub struct Exporter {
    provider: SdkTracerProvider,
    tracer: SdkTracer,
}

impl Exporter {
    /// For a program of this name; none where `OTEL_EXPORTER_OTLP_ENDPOINT` is not set.
    ///
    /// # Errors
    /// The endpoint is no URL, or no HTTP client can be made for it.
    pub fn from_env(service: &'static str) -> Result<Option<Self>, Error> {
        if std::env::var_os(ENDPOINT).is_none_or(|endpoint| endpoint.is_empty()) {
            return Ok(None);
        }
        let exporter = SpanExporter::builder().with_http().build()?;
        let provider = SdkTracerProvider::builder()
            .with_batch_exporter(exporter)
            .with_resource(Resource::builder().with_service_name(service).build())
            .build();
        let tracer = provider.tracer("ign");
        Ok(Some(Self { provider, tracer }))
    }

    /// Exports what `tracing` calls spans, of level info and above.
    pub fn layer<S>(&self) -> impl Layer<S> + Send + Sync + use<S>
    where
        S: tracing::Subscriber + for<'span> LookupSpan<'span> + Send + Sync,
    {
        tracing_opentelemetry::layer()
            .with_tracer(self.tracer.clone())
            .with_filter(LevelFilter::INFO)
    }

    /// A span that ends when it is dropped, for a program without `tracing`.
    pub fn span(&self, name: impl Into<Cow<'static, str>>, parent: Option<&TraceParent>) -> Span {
        let parent = parent.map_or_else(Context::new, TraceParent::context);
        let span = self
            .tracer
            .build_with_context(SpanBuilder::from_name(name), &parent);
        Span(span)
    }
}

impl Drop for Exporter {
    fn drop(&mut self) {
        // A collector that is away must not hold the end of a program; the library has said so.
        self.provider.shutdown().ok();
    }
}

/// Something that takes time.
#[derive(Debug)]
pub struct Span(opentelemetry_sdk::trace::Span);

impl Span {
    /// What goes on under it.
    pub fn traceparent(&self) -> Option<TraceParent> {
        TraceParent::of(self.0.span_context())
    }

    /// It did not go well.
    pub fn failed(&mut self, why: impl Into<Cow<'static, str>>) {
        self.0.set_status(Status::error(why));
    }
}
