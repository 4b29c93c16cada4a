//! What must hold whatever was drawn: nothing that is not finite, everything in its range, masks that agree.

use glam::DVec3;
use ign_geometry::{GBuffer, NO_TRIANGLE, Raster, Warped};

/// Says what `holds` refutes.
fn require(holds: bool, what: impl FnOnce() -> String) -> Result<(), String> {
    if holds { Ok(()) } else { Err(what()) }
}

/// A depth is finite and positive where there is a triangle, and 0 elsewhere.
pub fn raster(raster: &Raster) -> Result<(), String> {
    for (at, (depth, triangle)) in raster.depth.iter().zip(&raster.triangle).enumerate() {
        let holds = if *triangle == NO_TRIANGLE {
            *depth == 0.0
        } else {
            depth.is_finite() && *depth > 0.0
        };
        require(holds, || {
            format!("raster, pixel {at}: depth {depth}, triangle {triangle}")
        })?;
    }
    Ok(())
}

/// Everything is finite, coverage is in [0, 1], directions are unit vectors, and outside the mask all is zero.
pub fn g_buffer(buffer: &GBuffer) -> Result<(), String> {
    for at in 0..buffer.mask.len() {
        let (coverage, depth) = (buffer.coverage[at], buffer.depth[at]);
        let [position, normal, normal_fd, reflection] = [
            &buffer.position,
            &buffer.normal,
            &buffer.normal_fd,
            &buffer.reflection,
        ]
        .map(|map| DVec3::from_array(map[at].map(f64::from)));
        let describe = || {
            format!(
                "G-buffer, pixel {at}: coverage {coverage}, depth {depth}, position {position}, normal {normal}, \
                 by differences {normal_fd}, reflection {reflection}, triangle {}",
                buffer.triangle[at]
            )
        };
        require((0.0..=1.0).contains(&coverage), describe)?;
        require(buffer.mask[at] == (coverage > 0.0), describe)?;
        if buffer.mask[at] {
            require(depth.is_finite() && depth > 0.0, describe)?;
            require(position.is_finite(), describe)?;
            for unit in [normal, normal_fd, reflection] {
                require((unit.length() - 1.0).abs() < 1e-5, describe)?;
            }
            require(buffer.triangle[at] != NO_TRIANGLE, describe)?;
        } else {
            let zero = depth == 0.0
                && [position, normal, normal_fd, reflection] == [DVec3::ZERO; 4]
                && buffer.triangle[at] == NO_TRIANGLE;
            require(zero, describe)?;
        }
    }
    Ok(())
}

/// Shares are in [0, 1].
pub fn shares(shares: &[f32]) -> Result<(), String> {
    let wrong = shares.iter().find(|share| !(0.0..=1.0).contains(*share));
    wrong.map_or(Ok(()), |share| Err(format!("a share of {share}")))
}

/// Colours lie within those of the source, visibility is 0 or 1, places are finite.
pub fn warped(warped: &Warped, source_rgb: &[f32]) -> Result<(), String> {
    let (low, high) = source_rgb
        .iter()
        .fold((0.0_f32, 0.0_f32), |(low, high), value| {
            (low.min(*value), high.max(*value))
        });
    for (at, visible) in warped.visibility.iter().enumerate() {
        let rgb = &warped.rgb[3 * at..][..3];
        let px = warped.source_px[at];
        let describe = || format!("warp, pixel {at}: {rgb:?} from {px:?}, visibility {visible}");
        // A mean of four pixels, rounded.
        let inside = |value: &f32| (low - 1e-6..=high + 1e-6).contains(value);
        require(rgb.iter().all(inside), describe)?;
        require([0.0, 1.0].contains(visible), describe)?;
        require(px.iter().all(|value| value.is_finite()), describe)?;
    }
    Ok(())
}
