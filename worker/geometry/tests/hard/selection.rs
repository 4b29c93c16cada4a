//! Choice of reference and of nearest views.

use std::collections::BTreeSet;

use glam::DVec3;
use ign_geometry::select::{Nearest, select_nearest, select_references};
use ign_geometry::{Camera, GBuffer};
use ign_scenes::hard;

const MODES: [Nearest; 2] = [Nearest::Coverage, Nearest::CoverageAngle];

fn buffers(cameras: &[Camera]) -> Vec<GBuffer> {
    let mesh = hard::object(14, 20);
    cameras
        .iter()
        .map(|camera| GBuffer::render(&mesh, camera, 1))
        .collect()
}

/// `camera` moved by so much of the world.
fn moved(camera: &Camera, by: f64) -> Camera {
    let mut camera = *camera;
    camera.camera_from_world.translation += DVec3::new(0.6, -0.64, 0.48) * by;
    camera
}

#[test]
fn duplicates_do_not_take_all_slots() {
    // Each place five times: exactly, and moved by less and less of a hair, as bursts and videos have it.
    for hair in [0.0, 1e-6, 1e-4, 3e-3] {
        let cameras: Vec<Camera> = hard::ring()
            .iter()
            .flat_map(|camera| (0..5).map(|copy| moved(camera, f64::from(copy) * hair)))
            .collect();
        let views = buffers(&cameras);
        let places = |chosen: &[usize]| chosen.iter().map(|view| view / 5).collect::<BTreeSet<_>>();
        assert_eq!(
            places(&select_references(&views, 5)).len(),
            5,
            "copies moved by {hair}"
        );
        let target = &buffers(&[hard::ordinary()])[0];
        for mode in MODES {
            let chosen = select_nearest(target, &views, 4, mode);
            assert_eq!(
                places(&chosen).len(),
                4,
                "{mode:?}, copies moved by {hair}: {chosen:?}"
            );
        }
    }
}

#[test]
fn fewer_views_than_asked_for_are_all_taken() {
    let views = buffers(&hard::ring());
    for count in 0..=views.len() {
        let views = &views[..count];
        let all: BTreeSet<usize> = (0..count).collect();
        assert_eq!(
            select_references(views, 20)
                .into_iter()
                .collect::<BTreeSet<_>>(),
            all
        );
        let target = &buffers(&[hard::ordinary()])[0];
        for mode in MODES {
            let chosen = select_nearest(target, views, 20, mode);
            assert_eq!(chosen.len(), count);
            assert_eq!(chosen.into_iter().collect::<BTreeSet<_>>(), all);
        }
    }
}

#[test]
fn hard_cameras_are_chosen_among_without_harm() {
    let cameras: Vec<Camera> = hard::cameras()
        .into_iter()
        .map(|(_, camera)| camera)
        .chain([hard::blind()])
        .collect();
    let views = buffers(&cameras);
    let chosen = select_references(&views, 4);
    assert_eq!(chosen.len(), 4);
    assert!(
        !chosen.contains(&(views.len() - 1)),
        "the blind view is no reference"
    );
    for target in &views {
        for mode in MODES {
            let nearest = select_nearest(target, &views, 6, mode);
            assert_eq!(nearest.iter().collect::<BTreeSet<_>>().len(), 6);
        }
    }
}

#[test]
fn the_order_of_references_decides_nothing() {
    // Two pairs that mirror each other about the target, at one distance: their gains tie but for a rounding.
    let mut cameras = hard::ring();
    cameras.extend(
        [(0.0, 2.2, 0.3), (0.0, -2.2, 0.3), (-2.2, 0.0, 0.3)]
            .map(|(x, y, z)| hard::looking(DVec3::new(x, y, z))),
    );
    let views = buffers(&cameras);
    for target in [hard::looking(DVec3::new(2.2, 0.0, 0.3)), hard::blind()] {
        let target = &buffers(&[target])[0];
        for turn in 1..views.len() {
            let mut turned = views.clone();
            turned.rotate_left(turn);
            turned.swap(0, 2);
            let chosen = |views: &[GBuffer], n, mode| -> Vec<Camera> {
                let chosen = select_nearest(target, views, n, mode);
                chosen.into_iter().map(|view| views[view].camera).collect()
            };
            for (n, mode) in [1, 3, 6]
                .into_iter()
                .flat_map(|n| MODES.map(|mode| (n, mode)))
            {
                assert_eq!(
                    chosen(&views, n, mode),
                    chosen(&turned, n, mode),
                    "{n}, {mode:?}"
                );
            }
        }
    }
}
