//! Random scenes: whatever comes, nothing panics, nothing is out of its range, and no image depends on the order of
//! triangles or views. `IGN_SCENES=1000000` makes a million of them.

use std::collections::BTreeSet;

use ign_geometry::select::{Nearest, select_nearest, select_references};
use ign_geometry::{Camera, GBuffer, Mesh, WarpOptions, coverage_map, cross_project, rasterize};
use ign_scenes::check;
use ign_scenes::oracle::{hits, pixels, ray};
use ign_scenes::random::{Scene, View, each};
use rand::RngExt;

/// How many scenes without `IGN_SCENES`.
const SCENES: u64 = 10_000;
/// Choosing views samples them 64 x 64 times; one scene in so many has its views chosen.
const CHOOSE: u32 = 10;

#[test]
fn random_scenes() {
    each(SCENES, |scene| {
        let mut rng = scene.rng.clone();
        let samples = rng.random_range(1..=3);
        let turned = reordered(scene);
        let mut buffers = Vec::new();
        for View {
            camera, ordinary, ..
        } in &scene.views
        {
            let raster = rasterize(&scene.mesh, camera);
            check::raster(&raster)?;
            let buffer = GBuffer::render(&scene.mesh, camera, samples);
            check::g_buffer(&buffer)?;
            check::shares(&coverage_map(&scene.mesh, camera, 2, 2))?;
            if scene.sound {
                same_in_any_order(&scene.mesh, &turned, camera, &buffer, samples)?;
            }
            if scene.sound && *ordinary {
                as_rays_meet_it(&scene.mesh, camera, &raster.depth)?;
            }
            buffers.push(buffer);
        }
        for (source, view) in buffers.iter().zip(&scene.views) {
            let options = WarpOptions::default();
            let warped = cross_project(source, &view.rgb, &buffers[0], &options);
            check::warped(&warped, &view.rgb)?;
        }
        if rng.random_ratio(1, CHOOSE) {
            choices(scene, &buffers)?;
        }
        Ok(())
    });
}

/// The mesh with its triangles in another order.
fn reordered(scene: &Scene) -> Mesh {
    let order = scene.order(scene.mesh.triangles.len());
    Mesh {
        triangles: order.iter().map(|old| scene.mesh.triangles[*old]).collect(),
        ..scene.mesh.clone()
    }
}

/// Bit for bit, and the same triangles; of exact copies either may be named.
fn same_in_any_order(
    mesh: &Mesh,
    turned: &Mesh,
    camera: &Camera,
    buffer: &GBuffer,
    samples: u32,
) -> Result<(), String> {
    let other = GBuffer::render(turned, camera, samples);
    if buffer.coverage != other.coverage || buffer.mask != other.mask {
        return Err("coverage depends on the order of triangles".to_owned());
    }
    let corners = |mesh: &Mesh, triangle: u32| {
        let corners = mesh.triangles[triangle as usize].map(|corner| corner as usize);
        (
            corners.map(|corner| mesh.positions[corner]),
            corners.map(|corner| mesh.normals.get(corner).copied()),
        )
    };
    for at in (0..buffer.mask.len()).filter(|at| buffer.mask[*at]) {
        let (here, there) = (buffer.triangle[at], other.triangle[at]);
        let same = corners(mesh, here) == corners(turned, there)
            && buffer.depth[at] == other.depth[at]
            && buffer.position[at] == other.position[at]
            && buffer.normal[at] == other.normal[at]
            && buffer.reflection[at] == other.reflection[at];
        if !same {
            return Err(format!(
                "pixel {at}: triangle {here} at {}, in another order {there} at {}",
                buffer.depth[at], other.depth[at]
            ));
        }
    }
    Ok(())
}

/// Depths at pixel centres against ray casting, where no rounding decides.
fn as_rays_meet_it(mesh: &Mesh, camera: &Camera, depths: &[f32]) -> Result<(), String> {
    for (index, column, row) in pixels(camera) {
        let (origin, direction) = ray(camera, f64::from(column) + 0.5, f64::from(row) + 0.5);
        let (mut nearest, mut doubtful) = (f64::INFINITY, false);
        for hit in hits(mesh, origin, direction) {
            nearest = nearest.min(hit.distance);
            doubtful |= hit.weights.iter().any(|weight| *weight < 1e-6);
        }
        // Needles and triangles seen along their plane are all rounding.
        let depth = f64::from(depths[index]);
        if doubtful || nearest == f64::INFINITY {
            continue;
        }
        if !(depth > 0.0 && depth <= nearest * (1.0 + 1e-6)) {
            return Err(format!(
                "pixel ({column}, {row}) at {depth}, a ray meets {nearest}"
            ));
        }
    }
    Ok(())
}

/// No view twice, as many as asked for, and the same nearest cameras whatever the order of the references.
fn choices(scene: &Scene, buffers: &[GBuffer]) -> Result<(), String> {
    let order = scene.order(buffers.len());
    let shuffled: Vec<GBuffer> = order.iter().map(|old| buffers[*old].clone()).collect();
    let n = 1 + buffers.len() / 2;
    let references = select_references(buffers, n);
    for mode in [Nearest::Coverage, Nearest::CoverageAngle] {
        let chosen = select_nearest(&buffers[0], buffers, n, mode);
        let again = select_nearest(&buffers[0], &shuffled, n, mode);
        for chosen in [&references, &chosen] {
            let distinct: BTreeSet<&usize> = chosen.iter().collect();
            if distinct.len() != n.min(buffers.len()) || chosen.len() != distinct.len() {
                return Err(format!("chose {chosen:?} of {} views", buffers.len()));
            }
        }
        let center = |views: &[GBuffer], view: &usize| views[*view].camera.center();
        let same = chosen
            .iter()
            .zip(&again)
            .all(|(old, new)| center(buffers, old) == center(&shuffled, new));
        if !same {
            return Err(format!(
                "chose {chosen:?}, in the order {order:?} {again:?}"
            ));
        }
    }
    Ok(())
}
