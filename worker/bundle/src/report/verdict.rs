//! The sentence a curator reads first.
//!
//! Rules, in order:
//! - *weak*: ours is not better than the best other method on average; the capture, not the model, is the likely cause;
//! - *look*: some views stand out: ours is worse than the best other method there, or its error is more than
//!   [`OUTLIER`] times the median of all views;
//! - *good*: everything else.

use crate::Metrics;

/// A view is an outlier when its error is this many times the median.
const OUTLIER: f64 = 3.0;

/// How good a bundle is.
#[derive(Debug)]
pub(super) enum Verdict {
    /// Ready.
    Good,
    /// Ready, after a look at these views.
    Look(Vec<String>),
    /// No gain over the best other method.
    Weak,
    /// Nothing was scored.
    Unknown,
}

impl Verdict {
    pub(super) fn of(metrics: &Metrics) -> Self {
        let Some(ours) = metrics.method("ours").filter(|m| !m.per_view.is_empty()) else {
            return Self::Unknown;
        };
        let baseline = metrics.best_baseline();
        if baseline.is_some_and(|b| ours.mse >= b.mse) {
            return Self::Weak;
        }
        let mut errors: Vec<f64> = ours.per_view.iter().map(|v| v.mse).collect();
        errors.sort_by(f64::total_cmp);
        let median = errors[errors.len() / 2];
        let views: Vec<String> = ours
            .per_view
            .iter()
            .filter(|view| {
                let worse = |b: &crate::metrics::MethodMetrics| {
                    b.per_view
                        .iter()
                        .any(|other| other.name == view.name && other.mse < view.mse)
                };
                view.mse > OUTLIER * median || baseline.is_some_and(worse)
            })
            .map(|view| view.name.clone())
            .collect();
        if views.is_empty() {
            Self::Good
        } else {
            Self::Look(views)
        }
    }

    /// Views to look at.
    pub(super) fn views(&self) -> &[String] {
        if let Self::Look(views) = self {
            views
        } else {
            &[]
        }
    }

    pub(super) fn class(&self) -> &'static str {
        match self {
            Self::Good => "good",
            Self::Look(_) => "look",
            Self::Weak | Self::Unknown => "weak",
        }
    }

    pub(super) fn headline(&self) -> String {
        match self {
            Self::Good => "Good".to_owned(),
            Self::Look(views) if views.len() == 1 => "Good, but look at one view".to_owned(),
            Self::Look(views) => format!("Good, but look at {} views", views.len()),
            Self::Weak => "No better than plain image-based rendering".to_owned(),
            Self::Unknown => "Not scored".to_owned(),
        }
    }

    pub(super) fn explanation(&self, metrics: &Metrics) -> String {
        let (Some(ours), Some(baseline)) = (metrics.method("ours"), metrics.best_baseline()) else {
            return "No held-out views were rendered, so nothing can be said about quality."
                .to_owned();
        };
        let label = super::method_label(&baseline.name);
        match self {
            Self::Good if ours.mse > 0.0 => format!(
                "Every held-out view is rendered better than by {label}, the best other method; on average the error is \
                 {:.1} times smaller.",
                baseline.mse / ours.mse
            ),
            Self::Good => "Every held-out view is rendered without error.".to_owned(),
            Self::Look(views) => format!(
                "On average the error is {:.1} times smaller than that of {label}, the best other method. These views stand \
                 out: {}. Check whether their photographs are sharp and well registered.",
                baseline.mse / ours.mse.max(f64::MIN_POSITIVE),
                shortened(views)
            ),
            Self::Weak => format!(
                "The best other method, {label}, has an error of {}; ours has {}. Likely causes are a proxy that does not \
                 fit, blurred or badly registered photographs, or too few views: retake the capture before training longer.",
                super::significant(baseline.mse),
                super::significant(ours.mse)
            ),
            Self::Unknown => {
                "No held-out views were rendered, so nothing can be said about quality.".to_owned()
            }
        }
    }
}

/// The first few names.
pub(super) fn shortened(views: &[String]) -> String {
    const SHOWN: usize = 5;
    let names = views
        .iter()
        .take(SHOWN)
        .cloned()
        .collect::<Vec<_>>()
        .join(", ");
    if views.len() > SHOWN {
        format!("{names} and {} more", views.len() - SHOWN)
    } else {
        names
    }
}
