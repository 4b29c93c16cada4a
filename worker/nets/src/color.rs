//! sRGB transfer curve (IEC 61966-2-1) on tensors.
//!
//! Reflected light adds up in linear light, so effects are removed and re-inserted there; losses and blending use
//! the encoded values that are scored.

use tch::Tensor;

/// Encoded sRGB in [0, 1] to linear light in [0, 1]; any shape.
pub fn linear_from_srgb(srgb: &Tensor) -> Tensor {
    let low = srgb / 12.92;
    let high = ((srgb + 0.055) / 1.055)
        .clamp_min(0.0)
        .pow_tensor_scalar(2.4);
    low.where_self(&srgb.le(0.040_45), &high)
}

/// Linear light to encoded sRGB in [0, 1]; any shape. Input is clamped to [0, 1].
///
/// The clamp lets a small slope through outside [0, 1] (1 %), so that a prediction that left the range can come back
/// in training; the returned value itself never leaves [0, 1] by more than that slope.
pub fn srgb_from_linear(linear: &Tensor) -> Tensor {
    let inside = linear.clamp(0.0, 1.0);
    let low = &inside * 12.92;
    // The clamp keeps the derivative of the power finite at 0.
    let high = inside.clamp_min(0.003_130_8).pow_tensor_scalar(1.0 / 2.4) * 1.055 - 0.055;
    let encoded = low.where_self(&inside.le(0.003_130_8), &high);
    encoded + (linear - &inside) * 0.01
}

/// Rounds to what an 8-bit file would hold; any shape, range [0, 1].
pub fn quantised(srgb: &Tensor) -> Tensor {
    (srgb.clamp(0.0, 1.0) * 255.0).round() / 255.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use tch::Kind;

    #[test]
    fn curve_round_trips_and_matches_the_standard() {
        let x = Tensor::linspace(0.0, 1.0, 257, (Kind::Double, tch::Device::Cpu));
        let back = srgb_from_linear(&linear_from_srgb(&x));
        assert!((back - &x).abs().max().double_value(&[]) < 1e-6);
        let half = linear_from_srgb(&Tensor::from(0.5f64)).double_value(&[]);
        assert!((half - 0.214_041_140_482).abs() < 1e-9);
    }

    #[test]
    fn gradient_is_finite_everywhere() {
        let x = Tensor::from_slice(&[-1.0f64, 0.0, 1e-9, 0.5, 1.0, 3.0]).set_requires_grad(true);
        srgb_from_linear(&x).sum(Kind::Double).backward();
        assert!(x.grad().isfinite().all().int64_value(&[]) == 1);
        assert!(x.grad().gt(0.0).all().int64_value(&[]) == 1);
    }
}
