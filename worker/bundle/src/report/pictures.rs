//! Images as figures, and error maps with one scale.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use image::{Rgb, RgbImage};

use super::{ReportView, escape};
use crate::pack::encode_png;

/// Images narrower than this are shown with hard pixels: blurring them would hide what was scored.
const HARD_PIXELS_BELOW: u32 = 200;

/// Colours of the error map, from none to the scale's end; equal steps, lightness rises throughout.
const RAMP: [[u8; 3]; 7] = [
    [9, 9, 20],
    [46, 26, 78],
    [110, 37, 106],
    [175, 55, 90],
    [228, 98, 58],
    [250, 164, 60],
    [252, 248, 190],
];

/// One scale for all error maps of a page: the largest channel difference of a pixel, on [0, 255].
pub(super) struct ErrorScale {
    /// Where the ramp ends.
    end: f64,
}

impl ErrorScale {
    /// Ends at the 99.5th percentile of all errors shown, at least 8.
    pub(super) fn over(views: &[ReportView]) -> Self {
        let mut histogram = [0_u64; 256];
        for view in views {
            let baseline = view.baseline.as_ref().map(|(_, image)| image);
            for image in [Some(&view.ours), baseline].into_iter().flatten() {
                for error in errors(image, &view.target) {
                    histogram[error as usize] += 1;
                }
            }
        }
        let total: u64 = histogram.iter().sum();
        let mut seen = 0;
        let end = histogram.iter().position(|count| {
            seen += count;
            seen * 1000 >= total * 995
        });
        Self {
            end: end.unwrap_or(255).max(8) as f64,
        }
    }

    pub(super) fn map(&self, image: &RgbImage, target: &RgbImage) -> RgbImage {
        let mut map = RgbImage::new(target.width(), target.height());
        for (pixel, error) in map.pixels_mut().zip(errors(image, target)) {
            *pixel = Rgb(ramp(f64::from(error) / self.end));
        }
        map
    }

    pub(super) fn legend(&self) -> String {
        let stops: Vec<String> = RAMP
            .iter()
            .map(|[r, g, b]| format!("rgb({r} {g} {b})"))
            .collect();
        format!(
            "<p class=\"legend\"><span>0</span><i style=\"background:linear-gradient(90deg,{})\"></i><span>{:.0} of 255 and \
             more</span></p>",
            stops.join(","),
            self.end
        )
    }
}

/// Largest channel difference of each pixel; empty when the sizes differ.
fn errors<'a>(image: &'a RgbImage, target: &'a RgbImage) -> impl Iterator<Item = u8> + 'a {
    let comparable = image.dimensions() == target.dimensions();
    image
        .pixels()
        .zip(target.pixels())
        .filter(move |_| comparable)
        .map(|(a, b)| {
            a.0.iter()
                .zip(b.0)
                .map(|(&a, b)| a.abs_diff(b))
                .max()
                .unwrap_or(0)
        })
}

fn ramp(position: f64) -> [u8; 3] {
    let scaled = position.clamp(0.0, 1.0) * (RAMP.len() - 1) as f64;
    let from = (scaled as usize).min(RAMP.len() - 2);
    let share = scaled - from as f64;
    std::array::from_fn(|c| {
        let (a, b) = (f64::from(RAMP[from][c]), f64::from(RAMP[from + 1][c]));
        (a + (b - a) * share).round() as u8
    })
}

/// A captioned image.
pub(super) fn figure(image: &RgbImage, caption: &str) -> String {
    let Ok(png) = encode_png("report.html", image) else {
        return format!(
            "<figure><div class=\"absent\">no picture</div><figcaption>{}</figcaption></figure>",
            escape(caption)
        );
    };
    let class = if image.width() < HARD_PIXELS_BELOW {
        " class=\"hard\""
    } else {
        ""
    };
    format!(
        "<figure><img{class} src=\"data:image/png;base64,{}\" width=\"{}\" height=\"{}\" alt=\"{caption}\">\
         <figcaption>{caption}</figcaption></figure>",
        STANDARD.encode(png),
        image.width(),
        image.height(),
        caption = escape(caption)
    )
}
