//! Which part of a photograph is worked with, and at what size.
//!
//! Sizes round to the nearest pixel, at least 1; the focal lengths and the principal point follow the exact ratio of
//! the rounded size to the original, per axis, so that no rounding moves the object.

use glam::DVec2;
use ign_geometry::{Camera, CameraIntrinsics};
use serde::{Deserialize, Serialize};

use crate::scene::Scene;

/// Part and size of the pictures that are worked with.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Frame {
    /// The whole photograph, scaled so that its longer side has this many pixels; the aspect is kept up to rounding.
    Whole {
        /// Pixels of the longer side.
        long_side: u32,
    },
    /// A square window around the part of the proxy that the photograph shows.
    Object {
        /// Pixels of each side.
        size: u32,
        /// Free space at each side, as a share of the proxy's larger extent.
        margin: f64,
    },
}

/// A rectangle in continuous pixels of the undistorted photograph.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Bounds {
    pub(crate) min: DVec2,
    pub(crate) max: DVec2,
}

impl Bounds {
    pub(crate) fn extent(&self) -> DVec2 {
        self.max - self.min
    }
}

/// Smallest side of an object window, in pixels of the photograph.
const SMALLEST_WINDOW_PX: f64 = 4.0;

/// A scale counts as within the photograph's resolution up to this much upsampling.
const NATIVE_SLACK: f64 = 1.02;

impl Scene {
    /// The camera, in the world frame, that `frame` asks for at this view: the view's pose with scaled or cropped
    /// intrinsics. Square windows may reach beyond the photograph.
    ///
    /// `scale` multiplies the resolution (2 for reference views kept at twice the target's resolution). It is lowered
    /// to the largest whole factor at which at least half of the training photographs still have a pixel of their own
    /// per pixel, so that all views of a capture get the same factor; a factor of 1 always stands.
    ///
    /// # Panics
    /// When `view` is not an index of `self.views`.
    pub fn frame_camera(&self, view: usize, frame: &Frame, scale: u32) -> Camera {
        let camera = &self.views[view].camera;
        let scale = self.useful_scale(frame, scale);
        let intrinsics = match *frame {
            Frame::Whole { long_side } => {
                let (width, height) =
                    whole_size(&camera.intrinsics, long_side.max(1).saturating_mul(scale));
                camera.intrinsics.resized(width, height)
            }
            Frame::Object { size, margin } => {
                let (corner, side) = self.window(view, margin);
                let size = size.max(1).saturating_mul(scale);
                let ratio = f64::from(size) / side;
                let i = &camera.intrinsics;
                CameraIntrinsics {
                    fx: i.fx * ratio,
                    fy: i.fy * ratio,
                    cx: (i.cx - corner.x) * ratio,
                    cy: (i.cy - corner.y) * ratio,
                    width: size,
                    height: size,
                }
            }
        };
        Camera {
            intrinsics,
            camera_from_world: camera.camera_from_world,
        }
    }

    /// The factor that [`Scene::frame_camera`] uses for `scale`.
    pub fn useful_scale(&self, frame: &Frame, scale: u32) -> u32 {
        if scale <= 1 {
            return 1;
        }
        let mut native: Vec<f64> = self
            .train
            .iter()
            .map(|&view| match *frame {
                Frame::Whole { long_side } => {
                    let i = &self.views[view].camera.intrinsics;
                    f64::from(i.width.max(i.height)) / f64::from(long_side.max(1))
                }
                Frame::Object { size, margin } => {
                    self.window(view, margin).1 / f64::from(size.max(1))
                }
            })
            .collect();
        native.sort_by(f64::total_cmp);
        let median = native.get(native.len() / 2).copied().unwrap_or(1.0);
        ((median * NATIVE_SLACK).floor() as u32).clamp(1, scale)
    }

    /// Top-left corner and side of the square window around the object, in pixels of the undistorted photograph.
    pub(crate) fn window(&self, view: usize, margin: f64) -> (DVec2, f64) {
        let bounds = &self.bounds[view];
        let extent = bounds.extent();
        let margin = if margin.is_finite() {
            margin.clamp(0.0, 10.0)
        } else {
            0.0
        };
        let side = (extent.max_element() * (1.0 + 2.0 * margin)).max(SMALLEST_WINDOW_PX);
        let center = (bounds.min + bounds.max) / 2.0;
        (center - DVec2::splat(side / 2.0), side)
    }
}

/// Size with the longer side at `long_side`, the other in proportion, rounded.
fn whole_size(intrinsics: &CameraIntrinsics, long_side: u32) -> (u32, u32) {
    let longest = f64::from(intrinsics.width.max(intrinsics.height));
    let scaled =
        |side: u32| ((f64::from(side) * f64::from(long_side) / longest).round() as u32).max(1);
    (scaled(intrinsics.width), scaled(intrinsics.height))
}
