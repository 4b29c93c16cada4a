//! Image-based rendering without learning, on the same warps and coverage as ours (paper, Appendix "Comparison to
//! Image-based Rendering").

use tch::{Kind, Tensor, no_grad};

use crate::model::composite;
use crate::references::References;
use crate::target::Target;
use ign_nets::warp::directions;

/// The paper's naive IBR: the mean of the K warped views per pixel. -> [1, 3, H, W], encoded sRGB over black.
pub fn naive_ibr(references: &References, target: &Target, chosen: &[usize]) -> Tensor {
    no_grad(|| {
        let warped = references.warp(target, chosen, &references.colors, &references.alpha);
        let seen = warped.visibility.gt(0.0).to_kind(Kind::Float);
        let count = seen
            .sum_dim_intlist([1i64].as_slice(), true, Kind::Float)
            .clamp_min(1.0);
        let mean = warped
            .color
            .sum_dim_intlist([1i64].as_slice(), false, Kind::Float)
            / count;
        composite(&mean, target)
    })
}

/// Debevec et al. 1998: for each triangle, over all references, the visible one whose viewing ray is nearest to the
/// target's. -> [1, 3, H, W], encoded sRGB over black.
///
/// The choice is made at the triangle's centroid; where the chosen view does not see a point of the triangle
/// (partial occlusion), the next best that does takes over.
pub fn debevec_ibr(references: &References, mesh: &ign_geometry::Mesh, target: &Target) -> Tensor {
    no_grad(|| {
        let device = references.colors.device();
        let points = target.points.size()[0];
        let centroids = triangle_centroids(mesh, target).to_device(device);
        let target_center = target.camera.center();
        let target_center = Tensor::from_slice(&[
            target_center.x as f32,
            target_center.y as f32,
            target_center.z as f32,
        ])
        .view([1, 3])
        .to_device(device);
        let to_target = directions(&target_center, &centroids);
        let mut best_score = Tensor::full([points], -1.0, (Kind::Float, device));
        let mut best_color = Tensor::zeros([points, 3], (Kind::Float, device));
        for view in 0..references.len() as i64 {
            let index = Tensor::full([points], view, (Kind::Int64, device));
            let taps = references
                .sources
                .taps(&target.points, &target.normals, &index)
                .weighted(&references.alpha);
            let center = references.sources.centers().narrow(0, view, 1);
            let cosine = (directions(&center, &centroids) * &to_target)
                .sum_dim_intlist([1i64].as_slice(), false, Kind::Float)
                .clamp(-1.0, 1.0);
            let usable = taps.visibility.gt(0.25).logical_and(&taps.facing.gt(0.0));
            // Any view that sees the point at all beats none.
            let score = (cosine + 1.0) * usable.to_kind(Kind::Float)
                - usable.logical_not().to_kind(Kind::Float);
            let color =
                taps.gather(&references.colors) / taps.visibility.clamp_min(1e-4).unsqueeze(1);
            let better = score.gt_tensor(&best_score);
            best_color = color.where_self(&better.unsqueeze(1), &best_color);
            best_score = score.maximum(&best_score);
        }
        let seen = best_score.ge(0.0).to_kind(Kind::Float).unsqueeze(1);
        let values = Tensor::cat(&[&best_color * &seen, seen], 1) * target.weight.unsqueeze(1);
        let (sums, _) = target.sums(&values);
        let (h, w) = target.size();
        let mean = sums.narrow(1, 0, 3) / sums.narrow(1, 3, 1).clamp_min(1e-4);
        composite(&mean.tr().contiguous().view([1, 3, h, w]), target)
    })
}

/// [P, 3]: centroid of the triangle under each of the target's points.
fn triangle_centroids(mesh: &ign_geometry::Mesh, target: &Target) -> Tensor {
    let centroids: Vec<f32> = target
        .triangles
        .iter()
        .flat_map(|&triangle| {
            let corners = mesh.triangles[triangle as usize];
            let sum: glam::DVec3 = corners.iter().map(|&v| mesh.positions[v as usize]).sum();
            (sum / 3.0).to_array().map(|x| x as f32)
        })
        .collect();
    Tensor::from_slice(&centroids).view([-1, 3])
}
