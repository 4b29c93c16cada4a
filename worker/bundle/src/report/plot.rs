//! Plots as SVG: inline in the page, coloured by its style sheet, or as a document of their own.

use super::escape;

/// How tick values are written.
#[derive(Clone, Copy, Debug)]
pub enum Unit {
    /// As numbers.
    Plain,
    /// With s.
    Seconds,
    /// With B, kB or MB.
    Bytes,
}

/// One axis.
#[derive(Clone, Copy, Debug)]
pub struct Axis {
    label: &'static str,
    unit: Unit,
    spacing: Spacing,
}

impl Axis {
    /// A logarithmic one: what it measures, and in what.
    pub const fn log(label: &'static str, unit: Unit) -> Self {
        Self {
            label,
            unit,
            spacing: Spacing::Log,
        }
    }

    /// One on which numbers follow each other evenly: frames of a path, say.
    pub const fn even(label: &'static str) -> Self {
        Self {
            label,
            unit: Unit::Plain,
            spacing: Spacing::Even,
        }
    }
}

#[derive(Clone, Copy, Debug)]
enum Spacing {
    Log,
    Even,
}

/// One method: a curve, a point, or (no training) a level.
#[derive(Clone, Debug)]
pub struct Series {
    class: String,
    label: String,
    points: Vec<(f64, f64)>,
    /// Whether a line joins the points.
    joined: bool,
}

impl Series {
    /// `name` decides the colour (a method's name has its own), `label` stands beside it. Points that a logarithmic error
    /// axis cannot show are dropped.
    pub fn new(name: &str, label: &str, points: Vec<(f64, f64)>) -> Self {
        let class = if matches!(
            name,
            "ours" | "ours_no_effects" | "paper" | "n_ibr" | "ibr" | "texture"
        ) {
            name
        } else {
            "other"
        };
        let points = points
            .into_iter()
            .filter(|(x, y)| x.is_finite() && y.is_finite() && *y > 0.0)
            .collect();
        Self {
            class: class.to_owned(),
            label: label.to_owned(),
            points,
            joined: true,
        }
    }

    /// The same as dots without a line: points in no order.
    pub fn dots(name: &str, label: &str, points: Vec<(f64, f64)>) -> Self {
        Self {
            joined: false,
            ..Self::new(name, label, points)
        }
    }
}

/// Error over a cost.
#[derive(Clone, Debug)]
pub struct Plot {
    /// Width and height of the drawing; the page scales it to the column.
    pub size: (f64, f64),
    /// What is drawn.
    pub series: Vec<Series>,
    /// To the right.
    pub x: Axis,
    /// Upwards.
    pub y: Axis,
}

/// Of the wide plots.
pub const WIDTH: f64 = 560.0;
const LEFT: f64 = 46.0;
/// Room for the names beside a plot, also in the larger type of a phone.
const RIGHT: f64 = 152.0;
const TOP: f64 = 26.0;
const BOTTOM: f64 = 44.0;

/// Dots that a curve has at most.
const MOST_DOTS: usize = 60;

/// From values to pixels.
struct Scale {
    spacing: Spacing,
    /// Of the ends: values, or their decades.
    from: f64,
    to: f64,
    start: f64,
    end: f64,
}

impl Scale {
    /// Covers `values` with a margin of a twelfth, at least a tenth of a decade. A logarithmic one shows positive values alone.
    fn over(
        spacing: Spacing,
        values: impl Iterator<Item = f64>,
        start: f64,
        end: f64,
    ) -> Option<Self> {
        let (low, high) = values
            .filter(|v| matches!(spacing, Spacing::Even) || *v > 0.0)
            .map(|v| spacing.place(v))
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| {
                (low.min(v), high.max(v))
            });
        let margin = (0.08 * (high - low)).max(0.1);
        low.is_finite().then_some(Self {
            spacing,
            from: low - margin,
            to: high + margin,
            start,
            end,
        })
    }

    fn at(&self, value: f64) -> f64 {
        let share = (self.spacing.place(value) - self.from) / (self.to - self.from);
        self.start + share.clamp(0.0, 1.0) * (self.end - self.start)
    }

    /// Round numbers, as many as have room for their labels.
    fn ticks(&self) -> Vec<f64> {
        // Labels need more room beside each other than above each other.
        let room = if self.end > self.start { 130.0 } else { 60.0 };
        let length = (self.end - self.start).abs();
        match self.spacing {
            Spacing::Log => self.log_ticks(length / room),
            Spacing::Even => self.even_ticks(2.0 * length / room),
        }
    }

    /// 1, 2 and 5 times powers of ten; only 1 where the decades lie too close for labels between.
    fn log_ticks(&self, roomy_decades: f64) -> Vec<f64> {
        let decades = self.to - self.from;
        let steps: &[f64] = match decades {
            _ if roomy_decades < decades => &[1.0],
            _ if decades > 0.5 => &[1.0, 2.0, 5.0],
            _ => &[1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0],
        };
        (self.from.floor() as i32..=self.to.ceil() as i32)
            .flat_map(|exponent| steps.iter().map(move |step| step * 10_f64.powi(exponent)))
            .filter(|v| (self.from..=self.to).contains(&v.log10()))
            .collect()
    }

    /// Multiples of 1, 2 or 5 times a power of ten, at most so many.
    fn even_ticks(&self, most: f64) -> Vec<f64> {
        let least = (self.to - self.from) / most;
        let power = 10_f64.powf(least.log10().floor());
        let step = [1.0, 2.0, 5.0, 10.0]
            .map(|it| it * power)
            .into_iter()
            .find(|step| *step >= least)
            .unwrap_or(10.0 * power);
        ((self.from / step).ceil() as i64..=(self.to / step).floor() as i64)
            .map(|count| count as f64 * step)
            .collect()
    }
}

impl Spacing {
    fn place(self, value: f64) -> f64 {
        match self {
            Self::Log => value.log10(),
            Self::Even => value,
        }
    }
}

impl Plot {
    /// A file of its own, with its style; empty when there is nothing to draw.
    pub fn document(&self) -> String {
        let style = format!("<style>{}</style>", include_str!("style.css"));
        self.svg()
            .replacen("<svg ", "<svg xmlns=\"http://www.w3.org/2000/svg\" ", 1)
            .replacen('>', &format!(">{style}"), 1)
    }

    /// For the page; empty when there is nothing to draw.
    pub(super) fn svg(&self) -> String {
        let (width, height) = self.size;
        let points = || self.series.iter().flat_map(|s| &s.points);
        let Some(y) = Scale::over(self.y.spacing, points().map(|p| p.1), height - BOTTOM, TOP)
        else {
            return String::new();
        };
        let Some(x) = Scale::over(self.x.spacing, points().map(|p| p.0), LEFT, width - RIGHT)
        else {
            return String::new();
        };
        let (right, bottom) = (width - RIGHT, height - BOTTOM);
        let grid: String = x
            .ticks()
            .iter()
            .map(|&v| {
                let at = x.at(v);
                format!(
                    "<line class=\"grid\" x1=\"{at:.1}\" y1=\"{TOP}\" x2=\"{at:.1}\" y2=\"{bottom}\"/>\
                     <text class=\"tick\" x=\"{at:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>",
                    bottom + 16.0,
                    tick(v, self.x.unit)
                )
            })
            .chain(y.ticks().iter().map(|&v| {
                let at = y.at(v);
                format!(
                    "<line class=\"grid\" x1=\"{LEFT}\" y1=\"{at:.1}\" x2=\"{right}\" y2=\"{at:.1}\"/>\
                     <text class=\"tick\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>",
                    LEFT - 7.0,
                    at + 4.0,
                    tick(v, self.y.unit)
                )
            }))
            .collect();
        let marks: String = self
            .series
            .iter()
            .map(|series| mark(series, &x, &y))
            .collect();
        let ends: Vec<(f64, f64, &Series)> = self
            .series
            .iter()
            .filter_map(|s| {
                let (px, py) = *s.points.last()?;
                let from = if px > 0.0 { x.at(px) } else { right };
                Some((y.at(py), from, s))
            })
            .collect();
        format!(
            "<svg viewBox=\"0 0 {width} {height}\" role=\"img\" aria-label=\"{} against {}\">{grid}\
             <text class=\"axis\" x=\"{LEFT}\" y=\"14\">{}</text>\
             <text class=\"axis\" x=\"{right}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>{marks}{}</svg>",
            self.y.label,
            self.x.label,
            self.y.label,
            height - 8.0,
            self.x.label,
            labels(ends, right, bottom)
        )
    }
}

/// A curve with dots, or a dashed level for a method whose only cost is zero.
fn mark(series: &Series, x: &Scale, y: &Scale) -> String {
    match series.points.as_slice() {
        [] => String::new(),
        [(cost, error)] if *cost <= 0.0 => {
            let at = y.at(*error);
            format!(
                "<line class=\"level m-{}\" x1=\"{}\" y1=\"{at:.1}\" x2=\"{}\" y2=\"{at:.1}\"/>",
                series.class, x.start, x.end
            )
        }
        points => {
            // A curve that starts before any time has passed starts on the axis.
            let place = |(cost, error): &(f64, f64)| {
                (
                    if *cost > 0.0 { x.at(*cost) } else { x.start },
                    y.at(*error),
                )
            };
            let path: Vec<String> = points
                .iter()
                .map(place)
                .map(|(px, py)| format!("{px:.1},{py:.1}"))
                .collect();
            let dots: String = points
                .iter()
                .map(place)
                .map(|(px, py)| {
                    format!(
                        "<circle class=\"dot m-{}\" cx=\"{px:.1}\" cy=\"{py:.1}\" r=\"3.5\"/>",
                        series.class
                    )
                })
                .collect();
            if !series.joined {
                return dots;
            }
            let dots = if points.len() > MOST_DOTS { "" } else { &dots };
            format!(
                "<polyline class=\"curve m-{}\" points=\"{}\"/>{dots}",
                series.class,
                path.join(" ")
            )
        }
    }
}

/// Names at the right border, pushed apart where they would overlap, each with a line to its mark.
fn labels(mut ends: Vec<(f64, f64, &Series)>, right: f64, bottom: f64) -> String {
    const LINE: f64 = 16.0;
    ends.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut places: Vec<f64> = ends.iter().map(|(at, _, _)| *at).collect();
    for i in 1..places.len() {
        places[i] = places[i].max(places[i - 1] + LINE);
    }
    let mut limit = bottom;
    for place in places.iter_mut().rev() {
        *place = place.min(limit);
        limit = *place - LINE;
    }
    ends.iter()
        .zip(places)
        .map(|((at, from, series), place)| {
            format!(
                "<path class=\"leader m-{class}\" d=\"M{:.1} {at:.1}H{right}L{:.1} {place:.1}\"/>\
                 <text class=\"name m-{class}\" x=\"{:.1}\" y=\"{:.1}\">{}</text>",
                from + 5.0,
                right + 12.0,
                right + 16.0,
                place + 4.0,
                escape(&series.label),
                class = series.class,
            )
        })
        .collect()
}

fn tick(value: f64, unit: Unit) -> String {
    let plain = |v: f64| {
        if v >= 1.0 {
            format!("{}", (v * 10.0).round() / 10.0)
        } else {
            format!("{}", (v * 1e4).round() / 1e4)
        }
    };
    match unit {
        Unit::Plain => plain(value),
        Unit::Seconds => format!("{} s", plain(value)),
        Unit::Bytes if value >= 1e6 => format!("{} MB", plain(value / 1e6)),
        Unit::Bytes if value >= 1e3 => format!("{} kB", plain(value / 1e3)),
        Unit::Bytes => format!("{} B", plain(value)),
    }
}

/// One held-out view, or object, in [`views`].
pub(super) struct ViewRow<'a> {
    pub(super) name: &'a str,
    pub(super) ours: f64,
    pub(super) baseline: Option<f64>,
    pub(super) marked: bool,
}

/// Error of each view from left to right, logarithmic, ours and the baseline joined by a line; `label` says what it is.
pub(super) fn views(rows: &[ViewRow<'_>], label: &str) -> String {
    const HEIGHT: f64 = 220.0;
    const BOTTOM: f64 = 190.0;
    let errors = rows
        .iter()
        .flat_map(|r| [Some(r.ours), r.baseline])
        .flatten();
    let Some(y) = Scale::over(Spacing::Log, errors, BOTTOM, TOP) else {
        return String::new();
    };
    let (left, right) = (LEFT, WIDTH - 20.0);
    let step = (right - left) / rows.len() as f64;
    let grid: String = y
        .ticks()
        .iter()
        .map(|&v| {
            let at = y.at(v);
            format!(
                "<line class=\"grid\" x1=\"{left}\" y1=\"{at:.1}\" x2=\"{right}\" y2=\"{at:.1}\"/>\
                 <text class=\"tick\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>",
                left - 7.0,
                at + 4.0,
                tick(v, Unit::Plain)
            )
        })
        .collect();
    let marks: String = rows
        .iter()
        .enumerate()
        .map(|(index, row)| {
            let at = left + (index as f64 + 0.5) * step;
            let ours = y.at(row.ours.max(f64::MIN_POSITIVE));
            let other = row.baseline.map_or_else(String::new, |baseline| {
                let other = y.at(baseline.max(f64::MIN_POSITIVE));
                format!(
                    "<line class=\"join\" x1=\"{at:.1}\" y1=\"{ours:.1}\" x2=\"{at:.1}\" y2=\"{other:.1}\"/>\
                     <circle class=\"ring\" cx=\"{at:.1}\" cy=\"{other:.1}\" r=\"3.5\"/>"
                )
            });
            let mark = if row.marked {
                let near_end = at > right - 90.0;
                format!(
                    "<text class=\"name marked\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"{}\">{}</text>",
                    if near_end { at + 4.0 } else { at - 4.0 },
                    BOTTOM + 18.0,
                    if near_end { "end" } else { "start" },
                    escape(row.name)
                )
            } else {
                String::new()
            };
            format!(
                "<g><title>{}: {:.2}</title>{other}<circle class=\"dot m-ours{}\" cx=\"{at:.1}\" cy=\"{ours:.1}\" r=\"4\"/>{mark}</g>",
                escape(row.name),
                row.ours,
                if row.marked { " marked" } else { "" }
            )
        })
        .collect();
    format!(
        "<svg viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" aria-label=\"{label}\">{grid}\
         <text class=\"axis\" x=\"{left}\" y=\"14\">mean squared error, 0 to 255</text>{marks}</svg>"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scale(spacing: Spacing, values: &[f64]) -> Scale {
        Scale::over(spacing, values.iter().copied(), 0.0, 400.0).unwrap()
    }

    #[test]
    fn frames_follow_each_other_evenly_and_costs_by_their_decades() {
        let frames = scale(Spacing::Even, &[0.0, 119.0]);
        assert_eq!(frames.ticks(), [0.0, 50.0, 100.0]);
        let step = frames.at(1.0) - frames.at(0.0);
        assert!((frames.at(119.0) - frames.at(118.0) - step).abs() < 1e-9);
        let costs = scale(Spacing::Log, &[0.0, 1.0, 1000.0]);
        assert_eq!(costs.ticks(), [1.0, 10.0, 100.0, 1000.0]);
        let decade = costs.at(10.0) - costs.at(1.0);
        assert!((costs.at(1000.0) - costs.at(100.0) - decade).abs() < 1e-9);
    }

    #[test]
    fn one_value_has_a_scale_and_none_has_not() {
        for spacing in [Spacing::Even, Spacing::Log] {
            assert!((scale(spacing, &[7.0]).at(7.0) - 200.0).abs() < 1e-9);
            assert!(Scale::over(spacing, [].into_iter(), 0.0, 1.0).is_none());
        }
        assert!(Scale::over(Spacing::Log, [0.0].into_iter(), 0.0, 1.0).is_none());
    }
}
