//! `report.html`: one self-contained page for a curator and for an engineer.
//!
//! The verdict comes first, then the pictures that justify it, then every figure. Nothing is loaded from elsewhere:
//! style and plots are inline, images are data URIs, so the page can be mailed, archived and opened in ten years. It
//! follows the reader's light or dark setting and fits a phone.

#![expect(
    clippy::format_collect,
    reason = "one page: clarity before allocations"
)]

use std::fmt::Display;

use image::RgbImage;

use crate::Metrics;
use crate::manifest::Manifest;
use crate::metrics::MethodMetrics;

mod collection;
mod pictures;
pub mod plot;
mod verdict;

pub use collection::{
    CollectionInput, CollectionObject, Need, Ranked, WithoutBundle, rank, render_collection,
};
use pictures::{ErrorScale, figure};
use plot::{Axis, Plot, Series};
use verdict::Verdict;

/// What the page is made of.
#[derive(Clone, Copy, Debug)]
pub struct ReportInput<'a> {
    /// Heading; the object's title, or its name.
    pub title: &'a str,
    /// Object, provenance, capture digest; `files` may still be empty.
    pub manifest: &'a Manifest,
    /// All figures.
    pub metrics: &'a Metrics,
    /// A few held-out views, the worst among them.
    pub views: &'a [ReportView],
    /// What the plan decided, a sentence each.
    pub plan: &'a [String],
    /// What was found out about the capture before it was baked, a line per subject.
    pub capture: &'a [CaptureLine],
    /// What to do better in the next capture, a sentence each.
    pub advice: &'a [String],
}

/// One finding about the capture.
#[derive(Clone, Debug)]
pub struct CaptureLine {
    /// What it is about.
    pub subject: String,
    /// What was found.
    pub text: String,
    /// Whether something is wrong with it.
    pub doubtful: bool,
}

/// The pictures of one held-out view, as scored.
#[derive(Clone, Debug)]
pub struct ReportView {
    /// The photograph's name.
    pub name: String,
    /// The photograph.
    pub target: RgbImage,
    /// Our rendering.
    pub ours: RgbImage,
    /// The best other method's name, as in `metrics.json`, and its rendering.
    pub baseline: Option<(String, RgbImage)>,
    /// Estimated diffuse image, where effects were learned.
    pub diffuse: Option<RgbImage>,
    /// Estimated view-dependent effects, where they were learned.
    pub effects: Option<RgbImage>,
}

/// The page.
pub fn render_report(input: &ReportInput<'_>) -> String {
    let verdict = Verdict::of(input.metrics);
    let title = escape(input.title);
    let body = [
        header(input, &verdict),
        pictures_section(input),
        methods_section(input.metrics),
        speed_section(input.metrics),
        views_section(input.metrics, &verdict),
        capture_section(input),
        plan_section(input),
        provenance_section(input),
    ]
    .concat();
    page(&format!("{title}: model report"), &body)
}

/// A whole page; `title` and `body` are HTML.
fn page(title: &str, body: &str) -> String {
    format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\
         <meta name=\"color-scheme\" content=\"light dark\"><title>{title}</title>\
         <style>{}</style></head><body><main>{body}</main></body></html>\n",
        include_str!("report/style.css")
    )
}

fn header(input: &ReportInput<'_>, verdict: &Verdict) -> String {
    let object = &input.manifest.object;
    let figures = input
        .metrics
        .method("ours")
        .map_or_else(String::new, |ours| {
            let against = input
                .metrics
                .best_baseline()
                .map_or_else(String::new, |baseline| {
                    let ratio = if baseline.mse > 0.0 {
                        ours.mse / baseline.mse
                    } else {
                        1.0
                    };
                    figure_card(
                        &format!("{:.0} %", 100.0 * ratio),
                        &format!(
                            "of the error of {} ({})",
                            method_label(&baseline.name),
                            significant(baseline.mse)
                        ),
                    )
                });
            [
                figure_card(
                    &significant(ours.mse),
                    "mean squared error, full frame, 0 to 255",
                ),
                against,
                figure_card(
                    &format!("{:.1} dB", ours.psnr),
                    "PSNR, mean over held-out views",
                ),
                figure_card(&duration(ours.train_secs), "training"),
                figure_card(
                    &format!("{} ms", significant(ours.render_ms)),
                    "to render a frame",
                ),
                figure_card(&bytes(ours.bundle_bytes), "downloaded by a viewer"),
            ]
            .concat()
        });
    format!(
        "<header><p class=\"kicker\">{} / {}</p><h1>{}</h1></header>\
         <section class=\"verdict {}\"><h2>{}</h2><p>{}</p></section><div class=\"cards\">{figures}</div>",
        escape(&object.collection),
        escape(&object.object),
        escape(input.title),
        verdict.class(),
        verdict.headline(),
        escape(verdict.explanation(input.metrics)),
    )
}

fn figure_card(value: &str, caption: &str) -> String {
    format!(
        "<div class=\"card\"><b>{value}</b><span>{}</span></div>",
        escape(caption)
    )
}

fn pictures_section(input: &ReportInput<'_>) -> String {
    if input.views.is_empty() {
        return String::new();
    }
    let scale = ErrorScale::over(input.views);
    let views: String = input
        .views
        .iter()
        .map(|view| {
            let mut methods = vec![("ours", "ours".to_owned(), &view.ours)];
            methods.extend(
                view.baseline
                    .as_ref()
                    .map(|(name, image)| (name.as_str(), method_label(name), image)),
            );
            let mut figures = vec![figure(&view.target, "photograph")];
            figures.extend(methods.iter().map(|(_, label, image)| figure(image, label)));
            figures.extend(methods.iter().map(|(_, label, image)| {
                figure(&scale.map(image, &view.target), &format!("error, {label}"))
            }));
            figures.extend(
                view.diffuse
                    .as_ref()
                    .map(|image| figure(image, "estimated diffuse")),
            );
            figures.extend(
                view.effects
                    .as_ref()
                    .map(|image| figure(image, "estimated effects")),
            );
            let worst = input
                .metrics
                .method("ours")
                .is_some_and(|ours| ours.worst_view.name == view.name);
            let per_method = methods
                .iter()
                .filter_map(|(name, label, _)| {
                    let row = input
                        .metrics
                        .method(name)?
                        .per_view
                        .iter()
                        .find(|v| v.name == view.name)?;
                    Some(format!("{label} {}", significant(row.mse)))
                })
                .collect::<Vec<_>>()
                .join(", ");
            format!(
                "<article><h3>{}{}</h3><p class=\"note\">mean squared error: {per_method}</p>\
                 <div class=\"pictures\">{}</div></article>",
                escape(&view.name),
                if worst { " <em>worst view</em>" } else { "" },
                figures.concat()
            )
        })
        .collect();
    format!(
        "<section><h2>Held-out views</h2><p class=\"note\">Photographs that the model has never seen, beside what it \
         renders for their cameras. All error maps share one scale.</p>{}{views}</section>",
        scale.legend()
    )
}

fn methods_section(metrics: &Metrics) -> String {
    let best = metrics
        .methods
        .iter()
        .map(|m| m.mse)
        .fold(f64::INFINITY, f64::min);
    let mut methods: Vec<&MethodMetrics> = metrics.methods.iter().collect();
    methods.sort_by(|a, b| a.mse.total_cmp(&b.mse));
    let rows: String = methods
        .iter()
        .map(|m| {
            format!(
                "<tr class=\"{}\"><th scope=\"row\">{}<code>{}</code></th><td>{}</td><td>{}</td><td>{:.2}</td><td>{:.2}</td>\
                 <td>{:.4}</td><td>{}</td><td>{} <small>{}</small></td><td>{}</td><td>{}</td><td>{}</td></tr>",
                if m.name == "ours" { "ours" } else { "" },
                escape(method_label(&m.name)),
                escape(&m.name),
                if m.mse <= best { format!("<b>{}</b>", significant(m.mse)) } else { significant(m.mse) },
                significant(m.mse_object),
                m.psnr,
                m.psnr_object,
                m.ssim,
                m.flip.map_or_else(|| "–".to_owned(), |flip| format!("{flip:.4}")),
                significant(m.worst_view.mse),
                escape(&m.worst_view.name),
                if m.train_secs > 0.0 { duration(m.train_secs) } else { "–".to_owned() },
                significant(m.render_ms),
                bytes(m.bundle_bytes),
            )
        })
        .collect();
    let [width, height] = metrics.resolution;
    format!(
        "<section><h2>Methods</h2><p class=\"note\">Means over {} held-out views of {width} × {height} pixels, 8-bit sRGB. \
         All methods share reference views, warping, coverage and compositing.</p><div class=\"scroll\"><table><thead><tr>\
         <th>method</th><th>MSE</th><th>MSE object</th><th>PSNR</th><th>PSNR object</th><th>SSIM</th><th>FLIP</th>\
         <th>worst view</th><th>training</th><th>ms / frame</th><th>download</th></tr></thead><tbody>{rows}</tbody></table></div>\
         </section>",
        metrics.views.held_out
    )
}

fn speed_section(metrics: &Metrics) -> String {
    let mut names: Vec<&str> = Vec::new();
    for name in metrics
        .speed_error
        .iter()
        .map(|p| p.method.as_str())
        .chain(metrics.methods.iter().map(|m| m.name.as_str()))
    {
        if !names.contains(&name) {
            names.push(name);
        }
    }
    let series = |points: &dyn Fn(&str) -> Vec<(f64, f64)>| -> Vec<Series> {
        names
            .iter()
            .map(|name| Series::new(name, &method_label(name), points(name)))
            .collect()
    };
    let training = series(&|name| {
        let curve: Vec<(f64, f64)> = metrics
            .speed_error
            .iter()
            .filter(|p| p.method == name)
            .map(|p| (p.secs, p.mse))
            .collect();
        match metrics.method(name) {
            Some(m) if curve.is_empty() => vec![(m.train_secs, m.mse)],
            _ => curve,
        }
    });
    let of_method = |pick: fn(&MethodMetrics) -> f64| {
        series(&|name| {
            metrics
                .method(name)
                .map(|m| (pick(m), m.mse))
                .into_iter()
                .collect()
        })
    };
    let error = Axis::log("mean squared error, 0 to 255", plot::Unit::Plain);
    let (wide, small) = ((plot::WIDTH, 330.0), (430.0, 280.0));
    let panel = |size, series, x: Axis| {
        Plot {
            size,
            series,
            x,
            y: error,
        }
        .svg()
    };
    format!(
        "<section><h2>Speed against error</h2><p class=\"note\">Lower and further left is better. Both axes are \
         logarithmic; a dashed line is a method that needs no training.</p><div class=\"wide\">{}</div><div class=\"pair\">{}{}</div></section>",
        panel(
            wide,
            training,
            Axis::log("training time", plot::Unit::Seconds)
        ),
        panel(
            small,
            of_method(|m| m.render_ms),
            Axis::log("milliseconds per frame", plot::Unit::Plain)
        ),
        panel(
            small,
            of_method(|m| m.bundle_bytes as f64),
            Axis::log("bytes a viewer downloads", plot::Unit::Bytes)
        ),
    )
}

fn views_section(metrics: &Metrics, verdict: &Verdict) -> String {
    let (Some(ours), Some(baseline)) = (metrics.method("ours"), metrics.best_baseline()) else {
        return String::new();
    };
    let rows: Vec<plot::ViewRow<'_>> = ours
        .per_view
        .iter()
        .map(|view| plot::ViewRow {
            name: &view.name,
            ours: view.mse,
            baseline: baseline
                .per_view
                .iter()
                .find(|v| v.name == view.name)
                .map(|v| v.mse),
            marked: verdict.views().contains(&view.name),
        })
        .collect();
    if rows.is_empty() {
        return String::new();
    }
    format!(
        "<section><h2>Error along the camera path</h2><p class=\"note\">Each held-out view in the capture's order: ours \
         (filled) and {} (ring). Views to look at are marked.</p><div class=\"wide\">{}</div></section>",
        method_label(&baseline.name),
        plot::views(&rows, "error of each held-out view")
    )
}

fn plan_section(input: &ReportInput<'_>) -> String {
    if input.plan.is_empty() {
        return String::new();
    }
    let sentences: String = input
        .plan
        .iter()
        .map(|s| format!("<li>{}</li>", escape(s)))
        .collect();
    format!("<section><h2>What the plan decided</h2><ol>{sentences}</ol></section>")
}

fn capture_section(input: &ReportInput<'_>) -> String {
    if input.capture.is_empty() {
        return String::new();
    }
    let lines: String = input
        .capture
        .iter()
        .map(|line| {
            format!(
                "<dt{}>{}</dt><dd>{}</dd>",
                if line.doubtful {
                    " class=\"doubtful\""
                } else {
                    ""
                },
                escape(&line.subject),
                escape(&line.text)
            )
        })
        .collect();
    let advice: String = input
        .advice
        .iter()
        .map(|s| format!("<li>{}</li>", escape(s)))
        .collect();
    let advice = if advice.is_empty() {
        advice
    } else {
        format!("<h3>What to do better</h3><ul>{advice}</ul>")
    };
    format!(
        "<section><h2>The capture</h2><p class=\"note\">Measured on the photographs, the reconstruction and the proxy \
         before anything was trained. Doubtful points are marked.</p><dl>{lines}</dl>{advice}</section>"
    )
}

fn provenance_section(input: &ReportInput<'_>) -> String {
    let provenance = &input.manifest.provenance;
    let total: f64 = input.metrics.stages.iter().map(|s| s.secs).sum();
    let stages: String = input
        .metrics
        .stages
        .iter()
        .map(|stage| {
            let share = if total > 0.0 { 100.0 * stage.secs / total } else { 0.0 };
            format!(
                "<tr><th scope=\"row\">{}</th><td class=\"bar\"><i style=\"width:{share:.1}%\"></i></td><td>{}</td></tr>",
                escape(&stage.name),
                duration(stage.secs)
            )
        })
        .collect();
    let views = &input.metrics.views;
    let seeds = provenance
        .seeds
        .iter()
        .map(ToString::to_string)
        .collect::<Vec<_>>()
        .join(", ");
    let entries: String = [
        ("software", provenance.software.clone()),
        (
            "commit",
            provenance
                .git
                .clone()
                .unwrap_or_else(|| "unknown".to_owned()),
        ),
        ("device", provenance.device.clone()),
        ("seeds", seeds),
        ("started", provenance.started_at.clone()),
        ("finished", provenance.finished_at.clone()),
        (
            "views",
            format!(
                "{} trained on, {} held out, {} references",
                views.train, views.held_out, views.references
            ),
        ),
        ("capture", input.manifest.capture.clone()),
        ("recipe", input.manifest.recipe.to_string()),
    ]
    .iter()
    .map(|(name, value)| format!("<dt>{name}</dt><dd>{}</dd>", escape(value)))
    .collect();
    format!(
        "<section><h2>Stages and provenance</h2><table class=\"stages\"><tbody>{stages}</tbody></table><dl>{entries}</dl></section>"
    )
}

/// A method's name for people.
pub fn method_label(name: &str) -> String {
    match name {
        "ours" => "ours",
        "ours_no_effects" => "ours without effects",
        "paper" => "paper's preset",
        "n_ibr" => "nearest-view IBR",
        "ibr" => "IBR (Debevec)",
        "texture" => "texture",
        "vertex_color" => "vertex colours",
        "pix2pix_position" => "pix2pix, position",
        "pix2pix_depth" => "pix2pix, depth",
        other => return other.replace('_', " "),
    }
    .to_owned()
}

/// Three significant digits without exponent.
fn significant(value: f64) -> String {
    let digits = match value.abs() {
        v if v >= 100.0 || v == 0.0 => 0,
        v if v >= 10.0 => 1,
        v if v >= 1.0 => 2,
        _ => 3,
    };
    format!("{value:.digits$}")
}

fn duration(secs: f64) -> String {
    let whole = secs.round() as u64;
    match whole {
        0..10 => format!("{secs:.1} s"),
        10..120 => format!("{whole} s"),
        120..7200 => format!("{} min {:02} s", whole / 60, whole % 60),
        _ => format!("{} h {:02} min", whole / 3600, whole % 3600 / 60),
    }
}

fn bytes(count: u64) -> String {
    match count {
        0..1000 => format!("{count} B"),
        1000..1_000_000 => format!("{} kB", significant(count as f64 / 1e3)),
        _ => format!("{} MB", significant(count as f64 / 1e6)),
    }
}

/// Text as HTML.
fn escape(text: impl Display) -> String {
    let mut out = String::new();
    for c in text.to_string().chars() {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\'' => out.push_str("&#39;"),
            c => out.push(c),
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::{bytes, duration, escape, significant};

    #[test]
    fn figures_are_short() {
        assert_eq!(
            [
                significant(0.1234),
                significant(4.567),
                significant(45.67),
                significant(456.7)
            ],
            ["0.123", "4.57", "45.7", "457"]
        );
        assert_eq!(
            [
                duration(1.23),
                duration(59.6),
                duration(250.0),
                duration(7260.0)
            ],
            ["1.2 s", "60 s", "4 min 10 s", "2 h 01 min"]
        );
        assert_eq!(
            [bytes(12), bytes(4096), bytes(12_345_678)],
            ["12 B", "4.10 kB", "12.3 MB"]
        );
    }

    #[test]
    fn text_cannot_become_markup() {
        assert_eq!(escape("<script>\"'&"), "&lt;script&gt;&quot;&#39;&amp;");
    }
}
