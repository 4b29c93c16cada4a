//! What each view sees of the proxy: views that see nothing of it are left out.

use std::collections::BTreeSet;
use std::f64::consts::TAU;
use std::path::Path;

use glam::{DAffine3, DMat3, DVec2, DVec3};
use ign_geometry::{Camera, CameraIntrinsics, Mesh, NO_TRIANGLE, rasterize};
use rayon::prelude::*;

use crate::fault::Faults;
use crate::frame::Bounds;
use crate::photographs::Candidate;
use crate::scene::View;

/// A vertex this far outside the picture, as a share of its size, still counts for the object's bounds.
const BOUNDS_SLACK: f64 = 0.02;

/// Long side of the picture in which a view without a vertex inside is looked at again.
const SIGHT_RASTER_PX: u32 = 64;

/// Widest half angle, in radians, of the pinhole camera that a panorama is worked with: 70 degrees.
const WIDEST_AIM: f64 = 1.22;

/// What a view sees of the proxy.
enum Sight {
    Seen(Bounds),
    Behind,
    OutsidePicture,
    FromInside,
}

/// A view with its id in the model and the proxy's bounds in its picture.
pub(crate) type SeeingView = (View, u32, Bounds);

pub(crate) fn keep_those_that_see(
    candidates: Vec<Candidate>,
    mesh: &Mesh,
    proxy: Option<&Path>,
    faults: &mut Faults,
) -> Vec<SeeingView> {
    let total = candidates.len();
    let used: BTreeSet<u32> = mesh.triangles.iter().flatten().copied().collect();
    let vertices: Vec<DVec3> = used
        .iter()
        .map(|&index| mesh.positions[index as usize])
        .collect();
    let (center, radius) = bounding_sphere(&vertices);
    let (candidates, sights): (Vec<Candidate>, Vec<Sight>) = candidates
        .into_par_iter()
        .map(|(mut view, id)| {
            if view.source.is_panorama() {
                aim(&mut view, center, radius);
            }
            let sight = sight(&view, mesh, &vertices);
            ((view, id), sight)
        })
        .unzip();
    let mut kept = Vec::with_capacity(total);
    let mut blind = Faults::default();
    for ((view, id), sight) in candidates.into_iter().zip(sights) {
        let (message, hint) = match sight {
            Sight::Seen(bounds) => {
                kept.push((view, id, bounds));
                continue;
            }
            Sight::Behind => ("the proxy lies behind the camera", "check the view's pose"),
            Sight::OutsidePicture => (
                "the proxy lies outside the picture",
                "check the view's pose",
            ),
            Sight::FromInside => (
                "the camera stands inside the proxy",
                "check the view's pose, or trim the mesh",
            ),
        };
        blind.warning(
            format!("{message}; the view is left out"),
            format!("view {}", view.name),
            hint,
        );
    }
    if kept.is_empty() && total > 0 {
        faults.error(
            format!("none of the {total} views sees the proxy"),
            proxy
                .map(|path| path.display().to_string())
                .unwrap_or_default(),
            "the mesh must be in the frame of the reconstruction: same origin, axes and scale",
        );
    } else {
        faults.extend(blind.into_list());
    }
    kept
}

/// Centre of the bounding box and largest distance from it.
fn bounding_sphere(vertices: &[DVec3]) -> (DVec3, f64) {
    let corner = |pick: fn(DVec3, DVec3) -> DVec3| vertices.iter().copied().reduce(pick);
    let center = match (corner(DVec3::min), corner(DVec3::max)) {
        (Some(min), Some(max)) => min.midpoint(max),
        _ => DVec3::ZERO,
    };
    let radius = vertices
        .iter()
        .map(|vertex| vertex.distance(center))
        .fold(0.0, f64::max);
    (center, radius)
}

/// Gives a panorama a pinhole camera that looks at the object's bounding sphere, upright as the panorama is, with the
/// panorama's own resolution in its middle.
fn aim(view: &mut View, center: DVec3, radius: f64) {
    let pose = view.camera.camera_from_world;
    let to_center = pose.transform_point3(center);
    let Some(forward) = to_center.try_normalize() else {
        return;
    };
    let right = DVec3::Y.cross(forward).try_normalize().unwrap_or(DVec3::X);
    let axes = DMat3::from_cols(right, forward.cross(right), forward);
    let half_angle = (radius / to_center.length()).min(1.0).asin();
    let focal = view.source.fx;
    let half_side = focal * half_angle.min(WIDEST_AIM).tan();
    let side = ((2.0 * half_side).ceil() as u32).max(1);
    view.camera = Camera {
        intrinsics: CameraIntrinsics {
            fx: focal,
            fy: focal,
            cx: f64::from(side) / 2.0,
            cy: f64::from(side) / 2.0,
            width: side,
            height: side,
        },
        camera_from_world: DAffine3::from_mat3(axes.transpose()) * pose,
    };
    // Whole columns, so that rolling resamples nothing.
    let width = f64::from(view.source.width);
    let turns = forward.x.atan2(forward.z) / TAU;
    let columns = (turns * width).round();
    view.rolled_columns = columns.rem_euclid(width) as usize;
    view.source_from_camera = DMat3::from_rotation_y(-columns / width * TAU) * axes;
}

/// `vertices` are those of the mesh that some triangle uses.
fn sight(view: &View, mesh: &Mesh, vertices: &[DVec3]) -> Sight {
    if encloses(mesh, vertices, view.camera.center()) {
        return Sight::FromInside;
    }
    let size = DVec2::new(f64::from(view.source.width), f64::from(view.source.height));
    let i = &view.camera.intrinsics;
    let picture = Bounds {
        min: DVec2::ZERO,
        max: DVec2::new(f64::from(i.width), f64::from(i.height)),
    };
    let slack = size * BOUNDS_SLACK;
    let mut bounds = Bounds {
        min: DVec2::INFINITY,
        max: DVec2::NEG_INFINITY,
    };
    let (mut some_in_front, mut some_behind, mut some_inside) = (false, false, false);
    for &position in vertices {
        let in_camera = view.camera.camera_from_world.transform_point3(position);
        if in_camera.z <= 0.0 {
            some_behind = true;
            continue;
        }
        some_in_front = true;
        let Some(px) = view.source.project(view.source_from_camera * in_camera) else {
            continue;
        };
        if px.cmpge(-slack).all() && px.cmple(size + slack).all() {
            some_inside = true;
            let ray = in_camera.truncate() / in_camera.z;
            let undistorted = DVec2::new(i.fx * ray.x + i.cx, i.fy * ray.y + i.cy);
            bounds.min = bounds.min.min(undistorted);
            bounds.max = bounds.max.max(undistorted);
        }
    }
    match (some_in_front, some_inside) {
        (false, _) => Sight::Behind,
        // Triangles that reach behind the camera may cover more than their other vertices show.
        (true, true) => Sight::Seen(if some_behind { picture } else { bounds }),
        (true, false) => {
            // Large triangles may cross the picture with all vertices outside.
            let size = picture.max;
            let shrink = f64::from(SIGHT_RASTER_PX) / size.max_element();
            let small = |side: f64| ((side * shrink).ceil() as u32).max(1);
            let camera = Camera {
                intrinsics: i.resized(small(size.x), small(size.y)),
                camera_from_world: view.camera.camera_from_world,
            };
            let raster = rasterize(mesh, &camera);
            if raster
                .triangle
                .iter()
                .any(|&triangle| triangle != NO_TRIANGLE)
            {
                Sight::Seen(picture)
            } else {
                Sight::OutsidePicture
            }
        }
    }
}

/// Whether the surface closes around `point`: its solid angle seen from there, more than half of the full sphere.
fn encloses(mesh: &Mesh, vertices: &[DVec3], point: DVec3) -> bool {
    let corner = |pick: fn(DVec3, DVec3) -> DVec3| vertices.iter().copied().reduce(pick);
    let (Some(min), Some(max)) = (corner(DVec3::min), corner(DVec3::max)) else {
        return false;
    };
    if !(point.cmpge(min).all() && point.cmple(max).all()) {
        return false;
    }
    let vertex = |index: u32| mesh.positions[index as usize] - point;
    let solid_angle: f64 = mesh
        .triangles
        .iter()
        .map(|&[a, b, c]| {
            // Van Oosterom and Strackee, 1983.
            let (a, b, c) = (vertex(a), vertex(b), vertex(c));
            let (la, lb, lc) = (a.length(), b.length(), c.length());
            let volume = a.dot(b.cross(c));
            2.0 * volume.atan2(la * lb * lc + a.dot(b) * lc + b.dot(c) * la + c.dot(a) * lb)
        })
        .sum();
    solid_angle.abs() > 2.0 * std::f64::consts::PI
}
