//! The report in words: one line per subject, for terminals and pages alike.

use serde::{Deserialize, Serialize};

use super::{Findings, Preflight, Reprojection};

/// One subject of the report.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Line {
    /// What it is about.
    pub subject: String,
    /// What was found.
    pub text: String,
    /// Whether a fault of the report is about it.
    pub doubtful: bool,
}

impl Preflight {
    /// The findings, a line per subject; none where the capture could not be read.
    pub fn lines(&self) -> Vec<Line> {
        self.findings.as_ref().map(lines).unwrap_or_default()
    }
}

fn lines(findings: &Findings) -> Vec<Line> {
    let line = |subject: &str, text: String, doubtful: bool| Line {
        subject: subject.into(),
        text,
        doubtful,
    };
    let Findings {
        counts,
        coverage,
        baselines,
        reprojection,
        sharpness,
        exposure,
        light,
        scale,
        forecast,
    } = findings;
    let left_out = match counts.left_out {
        0 => String::new(),
        files => format!(", {files} files left out"),
    };
    let weak: Vec<String> = coverage
        .weak
        .iter()
        .map(|region| format!("{} ({})", region.name, percent(region.area)))
        .collect();
    let weak = if weak.is_empty() {
        String::new()
    } else {
        format!("; weak: {}", weak.join(", "))
    };
    let spread = format!("{:.1} stops apart", exposure.spread_stops);
    vec![
        line(
            "views",
            format!(
                "{}: {} to train on, {} held out{left_out}; {:.1} megapixels, object at about {:.0} px",
                counts.views, counts.train, counts.held_out, counts.megapixels, counts.object_px
            ),
            false,
        ),
        line(
            "geometry",
            format!(
                "proxy of {} triangles, {} points",
                counts.triangles, counts.points
            ),
            false,
        ),
        line(
            "coverage",
            format!(
                "{} of the surface seen by a view at a good angle, {} by two, {} by four{weak}",
                percent(coverage.by_one),
                percent(coverage.by_two),
                percent(coverage.by_four)
            ),
            !coverage.weak.is_empty(),
        ),
        line(
            "baselines",
            format!(
                "nearest view {:.1}° away (most {:.0}°), views span {:.0}°; distance {:.1} to {:.1} object radii",
                baselines.nearest_degrees_median,
                baselines.nearest_degrees_most,
                baselines.widest_degrees,
                baselines.distance_least,
                baselines.distance_most
            ),
            !baselines.duplicates.is_empty(),
        ),
        match reprojection {
            Some(found) => line(
                "registration",
                format!(
                    "reprojection error {:.2} px in the mean, {:.2} px in the median, {} of the points above {:.0} px",
                    found.mean_px,
                    found.median_px,
                    percent(found.high_share),
                    Reprojection::HIGH_PX
                ),
                found.is_doubtful(),
            ),
            None => line(
                "registration",
                "unknown: the reconstruction has no points".into(),
                false,
            ),
        },
        line(
            "sharpness",
            match sharpness.blurred.as_slice() {
                [] => format!(
                    "even; the least sharp view keeps {} of the usual detail",
                    percent(sharpness.least)
                ),
                views => {
                    let names: Vec<&str> = views.iter().map(|view| view.view.as_str()).collect();
                    format!(
                        "{} blurred: {} (from {} of the usual detail)",
                        names.len(),
                        some(&names),
                        percent(views[0].sharpness)
                    )
                }
            },
            !sharpness.blurred.is_empty(),
        ),
        line(
            "exposure",
            format!(
                "{}; white to the limit {} of the object, black {} (median)",
                if exposure.drifts {
                    format!(
                        "drifts: {spread}, gains take away {} of the differences",
                        percent(exposure.explained_by_gains)
                    )
                } else if light.moves_with_object {
                    "not to be told from the moving light".to_owned()
                } else {
                    "steady".to_owned()
                },
                percent(exposure.overexposed_median),
                percent(exposure.underexposed_median)
            ),
            exposure.drifts
                || !exposure.overexposed.is_empty()
                || !exposure.underexposed.is_empty(),
        ),
        line(
            "light",
            match light.explained_by_camera {
                _ if light.moves_with_object => {
                    "moves with the object, as on a turntable under fixed lamps".to_owned()
                }
                Some(share) => format!(
                    "constant ({} of the differences follow the camera)",
                    percent(share)
                ),
                None => "unknown: too little is seen by several views".to_owned(),
            },
            light.moves_with_object,
        ),
        line(
            "scale",
            format!(
                "{}{}",
                match scale.extent_metres {
                    Some(metres) => format!("{} across, {}", length(metres), scale.words),
                    None => format!("{:.3} units across; {}", scale.extent, scale.words),
                },
                if scale.georeferenced {
                    "; coordinates are those of a map"
                } else {
                    ""
                }
            ),
            false,
        ),
        line(
            "forecast",
            format!(
                "{} to upload; at {} px about {} of memory and a bundle of {}; {} of training, {}",
                bytes(forecast.capture_bytes),
                forecast.size,
                bytes(forecast.training_bytes),
                bytes(forecast.bundle_bytes),
                duration(forecast.training_secs),
                if forecast.ends_by_budget {
                    "the recipe's budget"
                } else {
                    "roughly, on two CPU cores"
                }
            ),
            false,
        ),
    ]
}

fn some(names: &[&str]) -> String {
    const SHOWN: usize = 3;
    let shown = names[..names.len().min(SHOWN)].join(", ");
    match names.len() {
        0..=SHOWN => shown,
        more => format!("{shown} and {} more", more - SHOWN),
    }
}

fn percent(share: f64) -> String {
    let percent = 100.0 * share;
    if percent > 0.0 && percent < 1.0 {
        format!("{percent:.1} %")
    } else {
        format!("{percent:.0} %")
    }
}

fn length(metres: f64) -> String {
    match metres {
        m if m >= 1.0 => format!("{m:.1} m"),
        m if m >= 0.01 => format!("{:.1} cm", 100.0 * m),
        m => format!("{:.2} mm", 1000.0 * m),
    }
}

fn bytes(count: u64) -> String {
    match count as f64 {
        n if n >= 1e9 => format!("{:.1} GB", n / 1e9),
        n if n >= 1e6 => format!("{:.0} MB", n / 1e6),
        n => format!("{:.0} kB", n / 1e3),
    }
}

fn duration(secs: f64) -> String {
    match secs {
        s if s >= 5400.0 => format!("{:.1} h", s / 3600.0),
        s if s >= 90.0 => format!("{:.0} min", s / 60.0),
        s => format!("{s:.0} s"),
    }
}
