//! The photographs against each other: sharpness, exposure, light.

use serde::{Deserialize, Serialize};

use crate::fault::Faults;
use crate::scene::Scene;
use crate::survey::{self, Gains, Survey, median};

/// Share of white pixels on the object from which a photograph is overexposed.
const OVEREXPOSED: f64 = 0.02;
/// Share of black pixels on the object from which a photograph is underexposed.
const UNDEREXPOSED: f64 = 0.2;
/// White balance differences, as a share, that are worth a word.
const COLOURED: f64 = 0.02;

/// Sharpness of the photographs relative to each other, at the same surface points.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Sharpness {
    /// Share of the detail, in its worst direction, that the least sharp view keeps; the median view has 1.
    pub least: f64,
    /// Views that are blurred.
    pub blurred: Vec<BlurredView>,
}

/// A photograph that is less sharp than the others.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct BlurredView {
    /// The photograph.
    pub view: String,
    /// Share of the detail that it keeps.
    pub sharpness: f64,
}

/// Exposure and white balance of the photographs relative to each other, and what is clipped.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Exposure {
    /// Whether exposure or white balance differ between photographs, so that gains per view help. Not judged, and false,
    /// where the light moves with the object.
    pub drifts: bool,
    /// Share of the variance between photographs, at points that had no part in the estimate, which gains take away.
    pub explained_by_gains: f64,
    /// From the darkest to the brightest exposure, in stops; as estimated, also where gains do not help.
    pub spread_stops: f64,
    /// Largest deviation of a channel's gain from the mean of its view's gains, as a share.
    pub white_balance_spread: f64,
    /// Median over the views of the share of the object's pixels that are white to the limit in some channel.
    pub overexposed_median: f64,
    /// The same for black to the limit.
    pub underexposed_median: f64,
    /// Views with more than 2 % of white pixels on the object.
    pub overexposed: Vec<String>,
    /// Views with more than 20 % of black pixels on the object.
    pub underexposed: Vec<String>,
}

/// Whether the light moves with the object.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Light {
    /// It does: the object was turned, or a lamp went with the camera.
    pub moves_with_object: bool,
    /// Share of the variance between photographs that the normal's direction in camera axes explains, at points that had
    /// no part in the fit; absent where too little is seen by several views.
    pub explained_by_camera: Option<f64>,
}

fn list(views: &[String]) -> String {
    const SHOWN: usize = 3;
    let named = views[..views.len().min(SHOWN)].join(", ");
    match views.len() {
        0..=SHOWN => named,
        more => format!("{named} and {} more", more - SHOWN),
    }
}

fn at(views: &[String]) -> String {
    match views {
        [only] => format!("view {only}"),
        _ => format!("views {}", list(views)),
    }
}

pub(super) fn sharpness(scene: &Scene, survey: &Survey, faults: &mut Faults) -> Sharpness {
    let found = survey::Sharpness::of(survey);
    let mut blurred: Vec<BlurredView> = found
        .blurred
        .iter()
        .filter_map(|&view| {
            Some(BlurredView {
                view: scene.views[view].name.clone(),
                sharpness: found.per_view[view]?,
            })
        })
        .collect();
    blurred.sort_by(|a, b| a.sharpness.total_cmp(&b.sharpness));
    if let Some(worst) = blurred.first() {
        let names: Vec<String> = blurred.iter().map(|view| view.view.clone()).collect();
        faults.warning(
            format!(
                "{} blurred: the worst keeps {:.0} % of the detail that the others show of the same places",
                if names.len() == 1 {
                    "a photograph is".to_owned()
                } else {
                    format!("{} photographs are", names.len())
                },
                100.0 * worst.sharpness
            ),
            at(&names),
            "look at them; take them again, or leave them out of the model",
        );
    }
    Sharpness {
        least: found
            .per_view
            .iter()
            .copied()
            .flatten()
            .reduce(f64::min)
            .unwrap_or(1.0),
        blurred,
    }
}

pub(super) fn exposure(
    scene: &Scene,
    survey: &Survey,
    gains: &Gains,
    faults: &mut Faults,
) -> Exposure {
    let named = |choose: &dyn Fn(usize) -> bool| -> Vec<String> {
        (0..scene.views.len())
            .filter(|&view| choose(view))
            .map(|view| scene.views[view].name.clone())
            .collect()
    };
    let usual = |gain: &[f64; 3]| (gain[0] * gain[1] * gain[2]).cbrt();
    let exposures = gains.estimated.iter().map(usual);
    let (low, high) = exposures.fold((f64::INFINITY, 0.0_f64), |(low, high), gain| {
        (low.min(gain), high.max(gain))
    });
    let coloured = gains
        .estimated
        .iter()
        .flat_map(|gain| gain.map(|channel| (channel / usual(gain) - 1.0).abs()));
    let found = Exposure {
        drifts: gains.needed,
        explained_by_gains: gains.explained,
        spread_stops: if low.is_finite() {
            (high / low).log2()
        } else {
            0.0
        },
        white_balance_spread: coloured.fold(0.0, f64::max),
        overexposed_median: median(survey.views.iter().map(|view| view.overexposed).collect()),
        underexposed_median: median(survey.views.iter().map(|view| view.underexposed).collect()),
        overexposed: named(&|view| survey.views[view].overexposed > OVEREXPOSED),
        underexposed: named(&|view| survey.views[view].underexposed > UNDEREXPOSED),
    };
    if found.drifts {
        let balance = if found.white_balance_spread > COLOURED {
            format!(
                " and white balance by {:.0} %",
                100.0 * found.white_balance_spread
            )
        } else {
            String::new()
        };
        faults.warning(
            format!(
                "exposure differs by {:.1} stops{balance} between photographs; gains per view equalise it",
                found.spread_stops
            ),
            "images/",
            "fix exposure and white balance on the camera next time",
        );
    }
    if !found.overexposed.is_empty() {
        faults.warning(
            format!(
                "{} of {} photographs are white to the limit on more than {:.0} % of the object",
                found.overexposed.len(),
                scene.views.len(),
                100.0 * OVEREXPOSED
            ),
            at(&found.overexposed),
            "expose for the highlights: what is clipped cannot be learned",
        );
    }
    if !found.underexposed.is_empty() {
        faults.warning(
            format!(
                "{} of {} photographs are black to the limit on more than {:.0} % of the object",
                found.underexposed.len(),
                scene.views.len(),
                100.0 * UNDEREXPOSED
            ),
            at(&found.underexposed),
            "expose longer, or brighten the shadows with a reflector",
        );
    }
    found
}

pub(super) fn light(survey: &Survey, faults: &mut Faults) -> Light {
    let found = &survey.light;
    if found.detected {
        faults.warning(
            format!(
                "the light moves with the object: {:.0} % of the differences between photographs follow the surface's \
                 direction towards the camera, as on a turntable under fixed lamps",
                100.0 * found.explained.unwrap_or(0.0)
            ),
            "images/",
            "move the camera around the object instead, or light it evenly from all sides; shading will be blurred otherwise",
        );
    }
    Light {
        moves_with_object: found.detected,
        explained_by_camera: found.explained,
    }
}
