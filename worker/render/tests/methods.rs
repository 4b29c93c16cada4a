//! The methods without learning do what their papers say, and images do not depend on how they are framed.

use glam::DVec3;
use ign_geometry::{Camera, Drawable, Mesh};
use ign_nets::Builder;
use ign_nets::composition::{BLEND_WIDTH, BlendComposition, PaperComposition};
use ign_nets::effects::PointEffects;
use ign_nets::params::flat_values;
use ign_render::{
    ColorGrid, Composition, Effects, Model, Recipe, ReferenceImage, References, RenderSettings,
    SurfaceColors, Target, Translation, TranslationInput, debevec_ibr,
};
use ign_scenes::{hard, oracle};
use tch::{Device, Tensor, no_grad};

/// One colour per reference: which views made a pixel can be read off it.
const COLORS: [[u8; 3]; 5] = [
    [250, 10, 10],
    [10, 250, 10],
    [10, 10, 250],
    [250, 250, 10],
    [10, 250, 250],
];

/// The hard scenes' cameras have few pixels: the same ones, six times as fine.
fn fine(camera: Camera) -> Camera {
    let i = camera.intrinsics;
    camera.with_intrinsics(i.resized(i.width * 6, i.height * 6))
}

fn references(
    mesh: &Mesh,
    recipe: Recipe,
    value: impl Fn(usize, usize, usize) -> u8,
) -> References {
    let images: Vec<ReferenceImage> = hard::ring()
        .into_iter()
        .map(fine)
        .enumerate()
        .map(|(view, camera)| {
            let pixels = (camera.intrinsics.width * camera.intrinsics.height) as usize;
            ReferenceImage {
                name: format!("{view}"),
                camera,
                rgba: (0..pixels)
                    .flat_map(|at| {
                        [
                            value(view, at, 0),
                            value(view, at, 1),
                            value(view, at, 2),
                            255,
                        ]
                    })
                    .collect(),
            }
        })
        .collect();
    References::new(&Drawable::new(mesh), &images, recipe, Device::Cpu)
}

fn target(mesh: &Mesh, camera: &Camera, settings: &RenderSettings) -> Target {
    Target::new(&Drawable::new(mesh), camera, settings, Device::Cpu)
}

/// Colours of an image's wholly covered pixels, with their numbers.
fn covered(image: &Tensor, target: &Target) -> Vec<(usize, [f64; 3])> {
    let coverage = flat_values(&target.coverage);
    let values = flat_values(image);
    let pixels = coverage.len();
    (0..pixels)
        .filter(|&at| coverage[at] >= 1.0)
        .map(|at| {
            (
                at,
                [0, 1, 2].map(|c| f64::from(values[c * pixels + at]) * 255.0),
            )
        })
        .collect()
}

/// Whether a camera shows a surface point: within its picture, and the straight line between them meets nothing, decided in
/// f64 on the triangles.
fn sees(mesh: &Mesh, camera: &Camera, point: DVec3) -> bool {
    let i = camera.intrinsics;
    let inside = camera.project(point).is_some_and(|p| {
        let within = |x: f64, limit: u32| x > 2.0 && x < f64::from(limit) - 2.0;
        within(p.px.x, i.width) && within(p.px.y, i.height)
    });
    if !inside {
        return false;
    }
    let way = camera.center() - point;
    oracle::cast(mesh, point + way * 1e-3, way).is_none()
}

#[test]
fn debevec_takes_one_view_per_triangle_over_all_references() {
    let mesh = hard::object(14, 20);
    let references = references(&mesh, Recipe::Standard, |view, _, c| COLORS[view][c]);
    let settings = RenderSettings {
        supersample: 1,
        ..RenderSettings::default()
    };
    let (mut checked, mut used) = (0, [0; 5]);
    for eye in [(2.2, 0.8, 0.6), (1.9, -0.9, 0.7), (1.4, 1.5, 0.3)] {
        let eye = DVec3::from(eye);
        let target = target(&mesh, &fine(hard::looking(eye)), &settings);
        let image = debevec_ibr(&references, &mesh, &target);
        let pixels: Vec<i64> = Vec::try_from(&target.pixel).expect("pixels");
        let triangles: std::collections::BTreeMap<i64, u32> = pixels
            .into_iter()
            .zip(target.triangles.iter().copied())
            .collect();
        for (at, color) in covered(&image, &target) {
            let corners = mesh.triangles[triangles[&(at as i64)] as usize];
            let corners = corners.map(|vertex| mesh.positions[vertex as usize]);
            let center = corners.iter().sum::<DVec3>() / 3.0;
            // The views in order of the angle between their ray and the target's, at the centroid.
            let mut views: Vec<(f64, usize)> = references
                .cameras
                .iter()
                .map(|camera| {
                    (camera.center() - center)
                        .normalize_or_zero()
                        .dot((eye - center).normalize_or_zero())
                })
                .zip(0..)
                .collect();
            views.sort_by(|a, b| b.0.total_cmp(&a.0));
            // Only triangles which the best view sees wholly and not edge on: there it must be this view alone.
            let best = views[0].1;
            let camera = &references.cameras[best];
            let normal = (corners[1] - corners[0])
                .cross(corners[2] - corners[0])
                .normalize_or_zero();
            let facing = normal
                .dot((camera.center() - center).normalize_or_zero())
                .abs();
            let inset = |corner: &DVec3| center + (*corner - center) * 1.4;
            if facing < 0.4 || !corners.iter().all(|c| sees(&mesh, camera, inset(c))) {
                continue;
            }
            for (found, expected) in color.iter().zip(COLORS[best]) {
                assert!(
                    (found - f64::from(expected)).abs() < 1.0,
                    "pixel {at}: {color:?}, view {best}"
                );
            }
            checked += 1;
            used[best] += 1;
        }
    }
    assert!(checked > 300, "only {checked} pixels checked");
    assert!(used.iter().filter(|&&n| n > 0).count() >= 2, "{used:?}");
}

#[test]
fn colours_of_vertices_are_cosine_weighted_sums_of_the_four_most_frontal_views() {
    let mesh = hard::object(14, 20);
    let references = references(&mesh, Recipe::Standard, |view, _, c| COLORS[view][c]);
    let colors = SurfaceColors::new(&mesh, &references, ColorGrid::Vertices);
    assert_eq!(colors.len(), 3 * mesh.triangles.len());
    let settings = RenderSettings {
        supersample: 1,
        ..RenderSettings::default()
    };
    // So fine that a pixel lies at the vertex.
    let target = target(&mesh, &fine(fine(hard::ordinary())), &settings);
    let image = colors.image(&mesh, &target);
    let values = flat_values(&image);
    let (h, w) = target.size();
    let pixels = (h * w) as usize;
    let coverage = flat_values(&target.coverage);
    let (mut checked, mut mixed) = (0, 0);
    // Neither at the opening, where views see inside and outside, nor at the closed end.
    for (vertex, position) in mesh.positions.iter().enumerate().take(260).skip(60) {
        let towards = target.camera.center() - *position;
        let normal = mesh.normals[vertex] * mesh.normals[vertex].dot(towards).signum();
        let mut cosines: Vec<(f64, usize)> = Vec::new();
        let mut doubtful = false;
        for (view, camera) in references.cameras.iter().enumerate() {
            let way = (camera.center() - *position).normalize_or_zero();
            let cosine = way.dot(normal);
            let seen = cosine > 0.0 && sees(&mesh, camera, *position);
            // Near the horizon of a view its depth test decides by the slanted footprint of a pixel.
            doubtful |= cosine.abs() < 0.12 || (cosine > 0.0 && cosine < 0.5 && !seen);
            if seen {
                cosines.push((cosine, view));
            }
        }
        let seen_here = sees(&mesh, &target.camera, *position);
        if doubtful || cosines.is_empty() || !seen_here {
            continue;
        }
        let Some(px) = target.camera.project(*position).map(|p| p.px) else {
            continue;
        };
        let (x, y) = (px.x.floor() as i64, px.y.floor() as i64);
        let inside = (0..w).contains(&x) && (0..h).contains(&y);
        if !inside || coverage[(y * w + x) as usize] < 1.0 {
            continue;
        }
        cosines.sort_by(|a, b| b.0.total_cmp(&a.0));
        cosines.truncate(4);
        let total: f64 = cosines.iter().map(|c| c.0).sum();
        for channel in 0..3 {
            let expected: f64 = cosines
                .iter()
                .map(|(cosine, view)| cosine * f64::from(COLORS[*view][channel]))
                .sum::<f64>()
                / total;
            let found = f64::from(values[channel * pixels + (y * w + x) as usize]) * 255.0;
            // A pixel's centre lies beside the vertex, whose neighbours have other colours.
            assert!(
                (found - expected).abs() < 8.0,
                "vertex {vertex}: {found}, expected {expected} of {cosines:?}"
            );
        }
        checked += 1;
        mixed += usize::from(cosines.len() > 1);
    }
    assert!(
        checked > 8 && mixed > 4,
        "{checked} vertices, {mixed} mixed"
    );
}

/// A texture holds detail that vertices are too far apart for: closer to what all views agree on.
#[test]
fn a_texture_is_sharper_than_vertices_and_both_keep_what_is_constant() {
    let coarse = hard::object(6, 8);
    let settings = RenderSettings::default();
    let target = target(&coarse, &fine(hard::ordinary()), &settings);
    let constant = references(&coarse, Recipe::Standard, |_, _, c| [200, 120, 40][c]);
    for grid in [ColorGrid::Vertices, ColorGrid::Texels] {
        let image = SurfaceColors::new(&coarse, &constant, grid).image(&coarse, &target);
        let covered = covered(&image, &target);
        assert!(covered.len() > 500);
        let close = covered.iter().filter(|(_, color)| {
            color
                .iter()
                .zip([200.0, 120.0, 40.0])
                .all(|(a, b)| (a - b).abs() < 1.0)
        });
        // What no view sees stays black.
        assert!(close.count() * 10 > covered.len() * 9, "{grid:?}");
    }
    // Stripes that depend on the place alone.
    let stripe = |p: DVec3| ((p.x * 9.0).sin() * (p.z * 9.0).sin() * 100.0 + 128.0) as u8;
    let painted: Vec<Vec<u8>> = hard::ring()
        .iter()
        .map(|camera| {
            let buffer = Drawable::new(&coarse).g_buffer(&fine(*camera), 1);
            buffer
                .position
                .iter()
                .map(|p| stripe(DVec3::new(p[0].into(), p[1].into(), p[2].into())))
                .collect()
        })
        .collect();
    let references = references(&coarse, Recipe::Standard, |view, at, _| painted[view][at]);
    let truth: Vec<f32> = Drawable::new(&coarse)
        .g_buffer(&target.camera, 1)
        .position
        .iter()
        .map(|p| f32::from(stripe(DVec3::new(p[0].into(), p[1].into(), p[2].into()))))
        .collect();
    let error = |grid| {
        let image = SurfaceColors::new(&coarse, &references, grid).image(&coarse, &target);
        let covered = covered(&image, &target);
        let squared = covered.iter().filter(|(_, c)| c[0] > 0.0);
        let squared: Vec<f64> = squared
            .map(|(at, c)| (c[0] - f64::from(truth[*at])).powi(2))
            .collect();
        squared.iter().sum::<f64>() / squared.len() as f64
    };
    let (vertices, texels) = (error(ColorGrid::Vertices), error(ColorGrid::Texels));
    assert!(
        texels * 4.0 < vertices,
        "texels {texels}, vertices {vertices}"
    );
}

fn shaken(builder: Builder, seed: i64) -> ign_nets::Params {
    tch::manual_seed(seed);
    let params = builder.build(Device::Cpu, 2);
    no_grad(|| {
        let noise = params.flat().randn_like() * 0.03;
        drop(params.flat().shallow_clone().g_add_(&noise));
    });
    params
}

/// What a viewer sees does not change when it zooms the frame: no normalisation looks at the rest of the picture. Only
/// the choice of views does, which sees what the frame sees; here all of them are used.
#[test]
fn a_window_shows_what_the_full_frame_shows() {
    let mesh = hard::object(14, 20);
    let settings = RenderSettings {
        k: 5,
        ..RenderSettings::default()
    };
    let (mut first, mut second) = (Builder::new(), Builder::new());
    let effects = PointEffects::new(&mut first);
    let net = BlendComposition::new(&mut second, settings.k, BLEND_WIDTH);
    let model = Model::new(
        references(&mesh, Recipe::Standard, |_, at, c| hard::pattern(at, c)),
        settings.clone(),
        Some(Effects::Points(effects, shaken(first, 3))),
        Some(Composition::Blend(net, shaken(second, 4))),
    );
    let camera = hard::ordinary();
    let intrinsics = camera.intrinsics.resized(384, 384);
    let full = camera.with_intrinsics(intrinsics);
    // Offsets that the network's strides divide, sizes that hold its field of view around what is compared.
    let (x, y, side) = (64_u32, 48_u32, 256_u32);
    let part = camera.with_intrinsics(intrinsics.cropped(x.into(), y.into(), side, side));
    let image = |camera: &Camera| model.image(&target(&mesh, camera, &settings));
    let (full, part) = (image(&full), image(&part));
    let full = full
        .narrow(2, y.into(), side.into())
        .narrow(3, x.into(), side.into());
    let inner = |t: &Tensor| t.narrow(2, 80, 96).narrow(3, 80, 96);
    assert!(inner(&full).max().double_value(&[]) > 0.2, "nothing to see");
    let difference = (inner(&full) - inner(&part)).abs().max().double_value(&[]) * 255.0;
    assert!(difference < 1.0, "differs by {difference} of 255");
}

/// Effects are removed from a reference with what the network sees of it, and inserted with what it sees of a target:
/// the same maps for the same camera.
#[test]
fn a_reference_and_a_target_of_one_camera_have_one_geometry() {
    let mesh = hard::object(14, 20);
    for recipe in [Recipe::Paper, Recipe::Standard] {
        let references = references(&mesh, recipe, |_, at, c| hard::pattern(at, c));
        let settings = RenderSettings {
            supersample: 1,
            recipe,
            ..RenderSettings::default()
        };
        for (view, camera) in references.cameras.iter().enumerate() {
            let target = target(&mesh, camera, &settings);
            let difference = &target.geometry - references.geometry.get(view as i64).unsqueeze(0);
            let worst = difference.abs().max().double_value(&[]);
            assert!(worst < 1e-4, "{recipe:?}, view {view}: {worst}");
        }
    }
}

#[test]
fn translated_maps_are_positions_and_depths() {
    let mesh = hard::object(14, 20);
    let settings = RenderSettings {
        supersample: 1,
        ..RenderSettings::default()
    };
    let camera = fine(hard::ordinary());
    let target = target(&mesh, &camera, &settings);
    let buffer = Drawable::new(&mesh).g_buffer(&camera, 4);
    let depth = flat_values(&TranslationInput::Depth.of(&target));
    let position = flat_values(&TranslationInput::Position.of(&target));
    for at in 0..depth.len() {
        assert!((depth[at] - buffer.depth[at]).abs() < 1e-4, "pixel {at}");
        assert!(
            (position[at] - buffer.position[at][0]).abs() < 1e-4,
            "pixel {at}"
        );
    }
    for input in [TranslationInput::Position, TranslationInput::Depth] {
        let mut builder = Builder::new();
        let net = PaperComposition::new(&mut builder, input.channels());
        let params = builder.build(Device::Cpu, 7);
        let image = Translation { input, net, params }.image(&target);
        assert_eq!(image.isfinite().all().int64_value(&[]), 1);
        let outside = &image * target.coverage.le(0.0).to_kind(image.kind());
        assert!(outside.abs().max().double_value(&[]) < 1e-12);
        assert!(image.max().double_value(&[]) > 0.1);
    }
}
