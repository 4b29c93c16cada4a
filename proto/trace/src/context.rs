//! The W3C trace context, and the one that a task works under.

use std::fmt;
use std::str::FromStr;

use opentelemetry::Context;
use opentelemetry::trace::{
    SpanContext, SpanId, TraceContextExt as _, TraceFlags, TraceId, TraceState,
};
use tracing::Instrument as _;
use tracing_opentelemetry::OpenTelemetrySpanExt as _;

tokio::task_local! {
    static HERE: Option<TraceParent>;
}

/// `00-TRACE-SPAN-FLAGS`, in lower-case hexadecimal (W3C Trace Context, version 00).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TraceParent {
    trace: u128,
    span: u64,
    flags: u8,
}

impl TraceParent {
    /// The root of a new trace that is to be recorded.
    pub fn random() -> Self {
        Self {
            // Zero is no id.
            trace: rand::random::<u128>().max(1),
            span: rand::random::<u64>().max(1),
            flags: TraceFlags::SAMPLED.to_u8(),
        }
    }

    /// What all of the trace has in common: 32 hexadecimal digits.
    pub fn trace_id(&self) -> String {
        format!("{:032x}", self.trace)
    }

    pub(crate) fn of(context: &SpanContext) -> Option<Self> {
        context.is_valid().then(|| Self {
            trace: u128::from_be_bytes(context.trace_id().to_bytes()),
            span: u64::from_be_bytes(context.span_id().to_bytes()),
            flags: context.trace_flags().to_u8(),
        })
    }

    pub(crate) fn context(&self) -> Context {
        Context::new().with_remote_span_context(SpanContext::new(
            TraceId::from_bytes(self.trace.to_be_bytes()),
            SpanId::from_bytes(self.span.to_be_bytes()),
            TraceFlags::new(self.flags),
            true,
            TraceState::default(),
        ))
    }
}

impl fmt::Display for TraceParent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { trace, span, flags } = self;
        write!(f, "00-{trace:032x}-{span:016x}-{flags:02x}")
    }
}

/// The text is no trace context.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("not a W3C trace context")]
pub struct Malformed;

impl FromStr for TraceParent {
    type Err = Malformed;

    /// Of a later version, what is known of it.
    fn from_str(text: &str) -> Result<Self, Malformed> {
        let hex = |part: &str, digits: usize| {
            let plain = part
                .bytes()
                .all(|b| b.is_ascii_digit() || (b'a'..=b'f').contains(&b));
            (part.len() == digits && plain)
                .then(|| u128::from_str_radix(part, 16).ok())
                .flatten()
                .ok_or(Malformed)
        };
        let mut parts = text.split('-');
        let mut next = |digits| hex(parts.next().ok_or(Malformed)?, digits);
        let (version, trace, span, flags) = (next(2)?, next(32)?, next(16)?, next(2)?);
        let more = parts.next().is_some();
        if trace == 0 || span == 0 || version == 0xff || (version == 0 && more) {
            return Err(Malformed);
        }
        Ok(Self {
            trace,
            span: span as u64,
            flags: flags as u8,
        })
    }
}

/// What the calls of this task belong to: its span where spans are exported, otherwise what it was told.
pub fn current() -> Option<TraceParent> {
    let context = tracing::Span::current().context();
    TraceParent::of(context.span().span_context())
        .or_else(|| HERE.try_with(|here| *here).ok().flatten())
}

/// Does `work` in `span`, under `parent` where there is one.
pub async fn within<F: Future>(
    span: tracing::Span,
    parent: Option<TraceParent>,
    work: F,
) -> F::Output {
    if let Some(parent) = parent {
        // Fails where nothing is exported.
        span.set_parent(parent.context()).ok();
    }
    HERE.scope(parent, work).instrument(span).await
}

/// `work` for a task of its own, under what the task that begins it works under.
pub fn carry<F: Future>(work: F) -> impl Future<Output = F::Output> {
    let here = HERE.try_with(|here| *here).ok().flatten();
    HERE.scope(here, work).in_current_span()
}

#[cfg(test)]
mod tests {
    use super::*;

    const EXAMPLE: &str = "00-4bf92f3577b34da6a3ce929d0e0e4736-00f067aa0ba902b7-01";

    #[test]
    fn the_text_is_that_of_the_standard() {
        let parsed: TraceParent = EXAMPLE.parse().unwrap();
        assert_eq!(parsed.to_string(), EXAMPLE);
        assert_eq!(parsed.trace_id(), "4bf92f3577b34da6a3ce929d0e0e4736");
        let later = EXAMPLE.replacen("00", "cc", 1) + "-what-comes";
        assert_eq!(later.parse(), Ok(parsed));
        for bad in [
            "",
            "00",
            &EXAMPLE.to_uppercase(),
            &EXAMPLE[1..],
            &format!("{EXAMPLE}-00"),
            &EXAMPLE.replacen("00", "ff", 1),
            &EXAMPLE.replace("4bf92f3577b34da6a3ce929d0e0e4736", &"0".repeat(32)),
            &EXAMPLE.replace("00f067aa0ba902b7", &"0".repeat(16)),
            &EXAMPLE.replace("4bf9", "+bf9"),
        ] {
            assert_eq!(bad.parse::<TraceParent>(), Err(Malformed), "{bad}");
        }
        let random = TraceParent::random();
        assert_eq!(random.to_string().parse(), Ok(random));
    }

    #[tokio::test]
    async fn a_task_is_told_and_tells_its_own_tasks() {
        assert_eq!(current(), None);
        let parent: TraceParent = EXAMPLE.parse().unwrap();
        let told = within(tracing::Span::none(), Some(parent), async {
            let task = tokio::spawn(carry(async { current() }));
            (current(), task.await.unwrap())
        });
        assert_eq!(told.await, (Some(parent), Some(parent)));
    }
}
