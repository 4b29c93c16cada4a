//! The report of a collection: which objects are good, which stand out, what to photograph again.
//!
//! An object needs attention for reasons that can be read, never for a number alone: what its own report says
//! ([`Verdict`]), what was found wrong with its capture before it was baked, and whether its error stands out among
//! the collection's. Objects that need it come first.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde::Serialize;

use super::plot::{self, ViewRow};
use super::verdict::Verdict;
use super::{bytes, duration, escape, figure_card, page, significant};
use crate::Metrics;
use crate::metrics::MethodMetrics;

/// An object's error stands out when the logarithm of it lies so many deviations above the collection's median. The
/// deviation is estimated from the median of absolute deviations, which outliers do not move.
const OUTLIER_DEVIATIONS: f64 = 3.5;
/// Of a normal distribution: standard deviation over median absolute deviation.
const DEVIATION_OF_MEDIAN: f64 = 1.4826;
/// Logarithms of errors closer together than this are not told apart: half as much again.
const LEAST_DEVIATION: f64 = 0.12;
/// Fewer objects have no outliers.
const LEAST_OBJECTS: usize = 4;
/// Objects in the plot of errors, at most.
const PLOTTED: usize = 120;

/// What the page is made of.
#[derive(Clone, Copy, Debug)]
pub struct CollectionInput<'a> {
    /// Its name.
    pub collection: &'a str,
    /// One bundle of each object.
    pub objects: &'a [CollectionObject],
    /// Objects that have none.
    pub without: &'a [WithoutBundle],
    /// When the page was made, for people.
    pub made_at: &'a str,
}

/// An object's bundle.
#[derive(Clone, Debug)]
pub struct CollectionObject {
    /// Name within the collection.
    pub object: String,
    /// Version of the bundle.
    pub version: u32,
    /// Of the whole bundle.
    pub size_bytes: u64,
    /// The bundle's figures.
    pub metrics: Metrics,
    /// A small JPEG.
    pub thumbnail: Option<Vec<u8>>,
}

/// An object without a bundle.
#[derive(Clone, Debug, Serialize)]
pub struct WithoutBundle {
    /// Name within the collection.
    pub object: String,
    /// State of its last job.
    pub state: String,
    /// Why there is none, and what to do.
    pub reason: String,
}

/// What an object needs, from most to least.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Need {
    /// New photographs, or a better reconstruction: training longer will not help.
    Retake,
    /// Somebody's eyes.
    Look,
    /// Nothing.
    Nothing,
}

/// An object's place in its collection.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Ranked {
    /// Name within the collection.
    pub object: String,
    /// Version of the bundle.
    pub version: u32,
    /// What to do.
    pub need: Need,
    /// Why, a sentence each.
    pub reasons: Vec<String>,
    /// Mean squared error of `ours` over the object, on [0, 255].
    pub mse_object: Option<f64>,
    /// Mean squared error of `ours` over the full frame, on [0, 255].
    pub mse: Option<f64>,
    /// `mse` as a share of the best other method's.
    pub of_baseline: Option<f64>,
    /// The error stands out among the collection's.
    pub outlier: bool,
}

/// Objects by what they need, then from the largest error over the object to the smallest.
pub fn rank(objects: &[CollectionObject]) -> Vec<Ranked> {
    let errors: Vec<f64> = objects.iter().filter_map(object_error).collect();
    let limit = outlier_limit(&errors);
    let middle = median(errors);
    let mut ranked: Vec<Ranked> = objects
        .iter()
        .map(|object| place(object, limit, middle))
        .collect();
    ranked.sort_by(|a, b| {
        let error = |ranked: &Ranked| ranked.mse_object.unwrap_or(f64::INFINITY);
        let order = a.need.cmp(&b.need);
        let order = order.then(error(b).total_cmp(&error(a)));
        order.then(a.object.cmp(&b.object))
    });
    ranked
}

fn object_error(object: &CollectionObject) -> Option<f64> {
    let error = object.metrics.method("ours")?.mse_object;
    (error.is_finite() && error > 0.0).then_some(error)
}

fn place(object: &CollectionObject, limit: Option<f64>, middle: Option<f64>) -> Ranked {
    let metrics = &object.metrics;
    let (ours, baseline) = (metrics.method("ours"), metrics.best_baseline());
    let verdict = Verdict::of(metrics);
    let error = object_error(object);
    let outlier = error.zip(limit).is_some_and(|(error, limit)| error > limit);
    let mut reasons = Vec::new();
    if !matches!(verdict, Verdict::Good) {
        let headline = verdict.headline();
        reasons.push(match verdict.views() {
            [] => format!("{headline}."),
            views => format!("{headline}: {}.", super::verdict::shortened(views)),
        });
    }
    if let (true, Some(error), Some(middle)) = (outlier, error, middle) {
        reasons.push(format!(
            "Its error is {:.1} times the collection's median.",
            error / middle
        ));
    }
    let faults = capture_faults(metrics);
    let need = match verdict {
        Verdict::Weak => Need::Retake,
        _ if outlier && !faults.is_empty() => Need::Retake,
        Verdict::Look(_) | Verdict::Unknown => Need::Look,
        Verdict::Good if outlier || !faults.is_empty() => Need::Look,
        Verdict::Good => Need::Nothing,
    };
    reasons.extend(faults);
    Ranked {
        object: object.object.clone(),
        version: object.version,
        need,
        reasons,
        mse_object: ours.map(|ours| ours.mse_object),
        mse: ours.map(|ours| ours.mse),
        of_baseline: ours
            .zip(baseline)
            .filter(|(_, baseline)| baseline.mse > 0.0)
            .map(|(ours, baseline)| ours.mse / baseline.mse),
        outlier,
    }
}

/// What preflight found wrong with the capture, and what to do: `plan.preflight.faults` of the metrics.
fn capture_faults(metrics: &Metrics) -> Vec<String> {
    let faults = metrics.plan["preflight"]["faults"].as_array();
    let text = |value: &serde_json::Value| value.as_str().unwrap_or_default().to_owned();
    faults
        .into_iter()
        .flatten()
        .map(|fault| {
            let (message, hint) = (text(&fault["message"]), text(&fault["hint"]));
            let ending = if hint.is_empty() {
                String::new()
            } else {
                format!(": {hint}")
            };
            format!("{}{ending}.", capitalised(&message))
        })
        .collect()
}

fn capitalised(text: &str) -> String {
    let mut letters = text.chars();
    letters.next().map_or_else(String::new, |first| {
        first.to_uppercase().chain(letters).collect()
    })
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}

/// Errors above this stand out.
fn outlier_limit(errors: &[f64]) -> Option<f64> {
    if errors.len() < LEAST_OBJECTS {
        return None;
    }
    let logarithms: Vec<f64> = errors.iter().map(|error| error.ln()).collect();
    let middle = median(logarithms.clone())?;
    let away = logarithms.iter().map(|value| (value - middle).abs());
    let deviation = (median(away.collect())? * DEVIATION_OF_MEDIAN).max(LEAST_DEVIATION);
    Some((middle + OUTLIER_DEVIATIONS * deviation).exp())
}

/// The page; `ranked` is what [`rank`] says of the objects.
pub fn render_collection(input: &CollectionInput<'_>, ranked: &[Ranked]) -> String {
    let body = [
        header(input, ranked),
        attention(input, ranked),
        without(input),
        errors(input, ranked),
        table(input, ranked),
    ]
    .concat();
    page(
        &format!("{}: collection report", escape(input.collection)),
        &body,
    )
}

fn counted(ranked: &[Ranked], need: Need) -> usize {
    ranked.iter().filter(|ranked| ranked.need == need).count()
}

fn objects(count: usize) -> String {
    match count {
        1 => "1 object".to_owned(),
        _ => format!("{count} objects"),
    }
}

fn header(input: &CollectionInput<'_>, ranked: &[Ranked]) -> String {
    let [retake, look, good] =
        [Need::Retake, Need::Look, Need::Nothing].map(|need| counted(ranked, need));
    let class = match (retake + input.without.len(), look) {
        (0, 0) => "good",
        (0, _) => "look",
        _ => "weak",
    };
    let headline = match (ranked.len(), retake, look) {
        (0, ..) => "No object has a bundle yet".to_owned(),
        (_, 0, 0) => format!("All {} are good", objects(good)),
        (_, 0, _) => format!("Look at {}", objects(look)),
        (_, _, 0) => format!("Retake {}", objects(retake)),
        _ => format!("Retake {}, look at {look} more", objects(retake)),
    };
    let missing = match input.without.len() {
        0 => String::new(),
        count => format!(" {} without a bundle.", objects(count)),
    };
    let ours: Vec<&MethodMetrics> = input
        .objects
        .iter()
        .filter_map(|object| object.metrics.method("ours"))
        .collect();
    let of = |pick: fn(&MethodMetrics) -> f64| median(ours.iter().map(|ours| pick(ours)).collect());
    let card = |value: Option<String>, caption: &str| {
        value.map_or_else(String::new, |value| figure_card(&value, caption))
    };
    let shares: Vec<f64> = ranked
        .iter()
        .filter_map(|ranked| ranked.of_baseline)
        .collect();
    let cards = [
        card(Some(good.to_string()), "good as they are"),
        card(Some(look.to_string()), "to look at"),
        card(Some(retake.to_string()), "to retake"),
        card(
            of(|m| m.mse_object).map(significant),
            "median error over the object, 0 to 255",
        ),
        card(
            median(shares).map(|share| format!("{:.0} %", 100.0 * share)),
            "of the error of the best other method, median",
        ),
        card(of(|m| m.train_secs).map(duration), "training, median"),
        card(
            Some(bytes(
                input.objects.iter().map(|object| object.size_bytes).sum(),
            )),
            "all bundles",
        ),
    ]
    .concat();
    format!(
        "<header><p class=\"kicker\">collection</p><h1>{}</h1></header>\
         <section class=\"verdict {class}\"><h2>{headline}</h2><p>{} baked, {good} good as they are.{missing} {}</p></section>\
         <div class=\"cards\">{cards}</div>",
        escape(input.collection),
        objects(ranked.len()),
        escape(input.made_at),
    )
}

fn thumbnail(input: &CollectionInput<'_>, name: &str) -> String {
    let picture = input
        .objects
        .iter()
        .find(|object| object.object == name)
        .and_then(|object| object.thumbnail.as_ref());
    picture.map_or_else(
        || "<div class=\"absent\">no picture</div>".to_owned(),
        |jpeg| {
            format!(
                "<img src=\"data:image/jpeg;base64,{}\" alt=\"{}\">",
                STANDARD.encode(jpeg),
                escape(name)
            )
        },
    )
}

/// What somebody has to do, with pictures.
fn attention(input: &CollectionInput<'_>, ranked: &[Ranked]) -> String {
    let section = |need: Need, heading: &str, note: &str| {
        let items: String = ranked
            .iter()
            .filter(|ranked| ranked.need == need)
            .map(|ranked| {
                let reasons: Vec<String> = ranked
                    .reasons
                    .iter()
                    .map(|reason| format!("<li>{}</li>", escape(reason)))
                    .collect();
                format!(
                    "<article class=\"object\"><figure>{}</figure><div><h3>{} <small>v{}</small></h3><ul>{}</ul></div></article>",
                    thumbnail(input, &ranked.object),
                    escape(&ranked.object),
                    ranked.version,
                    reasons.concat()
                )
            })
            .collect();
        if items.is_empty() {
            return items;
        }
        format!("<section><h2>{heading}</h2><p class=\"note\">{note}</p>{items}</section>")
    };
    [
        section(
            Need::Retake,
            "Retake",
            "Training longer will not help these: the photographs or the reconstruction are at fault.",
        ),
        section(
            Need::Look,
            "Look at",
            "Usable, but something stands out: compare the pictures in the object's own report.",
        ),
    ]
    .concat()
}

fn without(input: &CollectionInput<'_>) -> String {
    if input.without.is_empty() {
        return String::new();
    }
    let lines: Vec<String> = input
        .without
        .iter()
        .map(|object| {
            format!(
                "<dt>{}</dt><dd>{}{}</dd>",
                escape(&object.object),
                escape(&object.state),
                if object.reason.is_empty() {
                    String::new()
                } else {
                    format!(": {}", escape(&object.reason))
                }
            )
        })
        .collect();
    format!(
        "<section><h2>Without a bundle</h2><dl>{}</dl></section>",
        lines.concat()
    )
}

fn errors(input: &CollectionInput<'_>, ranked: &[Ranked]) -> String {
    let mut rows: Vec<(&Ranked, f64, Option<f64>)> = ranked
        .iter()
        .filter_map(|ranked| {
            let object = input.objects.iter().find(|o| o.object == ranked.object)?;
            let baseline = object.metrics.best_baseline().map(|b| b.mse_object);
            Some((ranked, ranked.mse_object?, baseline))
        })
        .collect();
    rows.sort_by(|a, b| b.1.total_cmp(&a.1));
    let left_out = rows.len().saturating_sub(PLOTTED);
    rows.truncate(PLOTTED);
    if rows.is_empty() {
        return String::new();
    }
    let rows: Vec<ViewRow<'_>> = rows
        .iter()
        .map(|(ranked, ours, baseline)| ViewRow {
            name: &ranked.object,
            ours: *ours,
            baseline: *baseline,
            marked: ranked.outlier,
        })
        .collect();
    let more = match left_out {
        0 => String::new(),
        count => format!(" The {count} with the smallest errors are left out."),
    };
    format!(
        "<section><h2>Errors</h2><p class=\"note\">Mean squared error over each object, from the largest to the smallest: ours \
         (filled) and the best other method (ring). Objects that stand out are marked.{more}</p><div class=\"wide\">{}</div></section>",
        plot::views(&rows, "error of each object")
    )
}

fn table(input: &CollectionInput<'_>, ranked: &[Ranked]) -> String {
    let rows: String = ranked
        .iter()
        .filter_map(|ranked| {
            let object = input.objects.iter().find(|o| o.object == ranked.object)?;
            let ours = object.metrics.method("ours");
            let figure = |pick: fn(&MethodMetrics) -> String| {
                ours.map_or_else(|| "–".to_owned(), pick)
            };
            let (class, need) = match ranked.need {
                Need::Retake => ("weak", "retake"),
                Need::Look => ("look", "look"),
                Need::Nothing => ("good", "good"),
            };
            Some(format!(
                "<tr><th scope=\"row\">{}<code>v{}</code></th><td class=\"need {class}\">{need}</td><td>{}</td><td>{}</td><td>{}</td>\
                 <td>{}</td><td>{} <small>{}</small></td><td>{}</td><td>{}</td><td>{}</td></tr>",
                escape(&ranked.object),
                ranked.version,
                figure(|m| significant(m.mse_object)),
                figure(|m| significant(m.mse)),
                ranked
                    .of_baseline
                    .map_or_else(|| "–".to_owned(), |share| format!("{:.0} %", 100.0 * share)),
                figure(|m| format!("{:.2}", m.psnr_object)),
                figure(|m| significant(m.worst_view.mse)),
                ours.map_or_else(String::new, |m| escape(&m.worst_view.name)),
                figure(|m| duration(m.train_secs)),
                figure(|m| significant(m.render_ms)),
                bytes(object.size_bytes),
            ))
        })
        .collect();
    if rows.is_empty() {
        return rows;
    }
    format!(
        "<section><h2>All objects</h2><p class=\"note\">Means over each object's held-out views, 8-bit sRGB; what needs attention \
         comes first.</p><div class=\"scroll\"><table><thead><tr><th>object</th><th>state</th><th>MSE object</th><th>MSE</th>\
         <th>of best other</th><th>PSNR object</th><th>worst view</th><th>training</th><th>ms / frame</th><th>size</th></tr></thead>\
         <tbody>{rows}</tbody></table></div></section>"
    )
}
