//! Import of captures: a folder of photographs, a reconstruction and a proxy mesh becomes a [`Scene`].
//!
//! [`import`] is the preflight as well: it looks at everything once and returns every fault it found, each with the
//! file and line (or byte, or view) and a hint how to mend it. After it succeeded, [`Scene::frame_camera`] says which
//! camera a view is to be worked on with, and [`Scene::load_view`] decodes one photograph and resamples it into that
//! camera's pixels in one pass: undistorting, cropping and scaling together.
//!
//! Conventions: camera axes x right, y down, z forward; continuous pixel coordinates with the origin at the top-left
//! corner and centres at +0.5, which are COLMAP's own; colours are sRGB values in [0, 1] as decoded.
//!
//! The folder's layout is described in the README beside this crate.

mod distortion;
mod fault;
mod frame;
mod import;
mod photo;
mod photographs;
mod pixel_map;
mod preflight;
mod proxy;
mod reconstruction;
mod resample;
mod scene;
mod settings;
mod sight;
mod split;
mod survey;

pub use distortion::{CameraModel, SourceCamera};
pub use fault::{Fault, ImportError, Severity};
pub use frame::Frame;
pub use import::{ImportOptions, import};
pub use photo::PhotoError;
pub use preflight::{
    Baselines, BlurredView, Counts, Coverage, Exposure, Findings, Forecast, Light, Line, Preflight,
    PreflightOptions, Region, Reprojection, Scale, Sharpness, preflight,
};
pub use reconstruction::{Format, camera_files, check_cameras};
pub use resample::ViewImage;
pub use scene::{Background, CaptureInfo, Mask, MaskFile, Point, Scene, View};
pub use survey::{Gains, Survey};
