//! Muon (Jordan et al. 2024, "Muon: An optimizer for hidden layers in neural networks"): a step along the momentum of a matrix
//! with all its singular values brought near to one.
//!
//! The kernel of a convolution counts as the matrix [outputs, inputs times taps]. The published iteration
//! X <- (aI + bA + cA^2) X with A = X X^T changes X by factors of one symmetric matrix, which are multiplied first, so that the
//! wide X is read twice and not ten times; matrices of as many outputs go through it together.

use std::collections::BTreeMap;

use tch::{Kind, Tensor, no_grad};

/// Of Nesterov's momentum.
const MOMENTUM: f64 = 0.95;
/// Of the quintic iteration.
const FACTORS: [f64; 3] = [3.4445, -4.7750, 2.0315];
const ITERATIONS: usize = 5;
/// Root of the mean square of a step's values, as a share of the learning rate.
const SIZE: f64 = 0.8;
/// Square of a matrix's norm below which it counts as zero.
const LEAST_SQUARE: f64 = 1e-30;

/// Where a matrix lies in the flat buffer.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Matrix {
    pub(crate) offset: i64,
    /// [outputs, the rest], not more rows than columns.
    pub(crate) shape: [i64; 2],
}

impl Matrix {
    pub(crate) fn len(&self) -> i64 {
        self.shape[0] * self.shape[1]
    }

    fn of(&self, buffer: &Tensor) -> Tensor {
        buffer.narrow(0, self.offset, self.len()).view(self.shape)
    }
}

/// Takes the gradient, times `shrink`, into each matrix's momentum; each matrix's step, flat, for a learning rate of 1.
pub(crate) fn steps(
    matrices: &[Matrix],
    gradient: &Tensor,
    momentum: &Tensor,
    shrink: Option<f64>,
) -> Vec<Tensor> {
    no_grad(|| {
        let directions: Vec<Tensor> = matrices
            .iter()
            .map(|matrix| {
                let gradient = matrix.of(gradient) * shrink.unwrap_or(1.0);
                let mut momentum = matrix.of(momentum);
                drop(momentum.lerp_(&gradient, 1.0 - MOMENTUM));
                gradient.lerp(&momentum, MOMENTUM)
            })
            .collect();
        let mut steps = orthogonal(&directions);
        for (step, matrix) in steps.iter_mut().zip(matrices) {
            // An orthogonal matrix has values of 1 / sqrt(columns) in the mean square.
            *step = (&*step * (SIZE * (matrix.shape[1] as f64).sqrt())).view([-1]);
        }
        steps
    })
}

/// The matrices, none with more rows than columns, each with singular values near 1; those far smaller than its largest stay
/// smaller, and zero stays zero.
fn orthogonal(matrices: &[Tensor]) -> Vec<Tensor> {
    let mut by_rows: BTreeMap<i64, Vec<usize>> = BTreeMap::new();
    for (at, matrix) in matrices.iter().enumerate() {
        by_rows.entry(matrix.size()[0]).or_default().push(at);
    }
    let mut factors: Vec<Option<Tensor>> = matrices.iter().map(|_| None).collect();
    for (rows, group) in by_rows {
        let squares: Vec<Tensor> = group
            .iter()
            .map(|&at| matrices[at].matmul(&matrices[at].tr()))
            .collect();
        let squares = Tensor::stack(&squares, 0);
        let norms = squares
            .diagonal(0, 1, 2)
            .sum_dim_intlist([1i64].as_slice(), false, None::<Kind>)
            .clamp_min(LEAST_SQUARE)
            .view([-1, 1, 1]);
        let one = Tensor::eye(rows, (squares.kind(), squares.device()));
        let mut factor = &one / norms.sqrt();
        let mut square = squares / norms;
        for _ in 0..ITERATIONS {
            let [a, b, c] = FACTORS;
            let change = &one * a + &square * b + square.matmul(&square) * c;
            factor = change.matmul(&factor);
            square = change.matmul(&square).matmul(&change);
        }
        for (at, factor) in group.into_iter().zip(factor.unbind(0)) {
            factors[at] = Some(factor);
        }
    }
    let factors = factors.into_iter().flatten();
    matrices
        .iter()
        .zip(factors)
        .map(|(matrix, factor)| factor.matmul(matrix))
        .collect()
}

#[cfg(test)]
mod tests {
    use tch::Device;

    use super::*;
    use crate::params::{Builder, Init};

    const FLOAT: (Kind, Device) = (Kind::Float, Device::Cpu);

    fn singular_values(matrix: &Tensor) -> Vec<f64> {
        let (_, values, _) = matrix.svd(true, false);
        Vec::try_from(values.to_kind(Kind::Double)).expect("numbers")
    }

    #[test]
    fn singular_values_come_near_to_one_and_directions_stay() {
        tch::manual_seed(3);
        let sizes = [[8, 40], [8, 8], [16, 90]];
        let matrices: Vec<Tensor> = sizes
            .iter()
            .map(|shape| Tensor::randn(shape, FLOAT) * 1e-4)
            .collect();
        for (matrix, turned) in matrices.iter().zip(orthogonal(&matrices)) {
            assert_eq!(turned.size(), matrix.size());
            let (before, after) = (singular_values(matrix), singular_values(&turned));
            for (before_one, one) in before.iter().zip(&after) {
                // Where the published iteration takes every value above a hundredth of the norm.
                let norm = before.iter().map(|v| v * v).sum::<f64>().sqrt();
                if *before_one > 0.01 * norm {
                    assert!((0.6..1.3).contains(one), "{before_one} of {norm}: {one}");
                }
            }
            // Of the same singular vectors: the product with the transposed one is symmetric, and positive.
            let product = turned.matmul(&matrix.tr());
            let skew = (&product - product.tr()).abs().max().double_value(&[]);
            assert!(
                skew < 1e-4 * product.abs().max().double_value(&[]),
                "{skew}"
            );
            assert!(product.trace().double_value(&[]) > 0.0);
        }
    }

    /// Against the iteration as it was published, on the matrix itself.
    #[test]
    fn the_shorter_way_gives_what_the_published_one_gives() {
        tch::manual_seed(4);
        let matrix = Tensor::randn([12, 50], FLOAT);
        let mut published = &matrix / matrix.norm();
        for _ in 0..ITERATIONS {
            let [a, b, c] = FACTORS;
            let square = published.matmul(&published.tr());
            let change = &square * b + square.matmul(&square) * c;
            published = &published * a + change.matmul(&published);
        }
        let ours = orthogonal(&[matrix]).remove(0);
        let apart = (ours - published).abs().max().double_value(&[]);
        assert!(apart < 1e-5, "{apart}");
    }

    #[test]
    fn nothing_to_learn_is_no_step_and_tiny_gradients_are_finite() {
        let mut builder = Builder::new();
        builder.param("kernel", &[4, 3, 3, 3], Init::Constant(0.0));
        builder.exact(|b| b.param("head", &[4, 4, 3, 3], Init::Constant(0.0)));
        builder.param("bias", &[4], Init::Constant(0.0));
        builder.param("tall", &[4, 3], Init::Constant(0.0));
        let params = builder.build(Device::Cpu, 0);
        let matrices = params.matrices();
        assert_eq!(matrices.len(), 1, "the others are Adam's");
        for size in [0.0, 1e-30, 1e-12, 1e12] {
            tch::manual_seed(5);
            let gradient = params.flat().randn_like() * size;
            let momentum = params.flat().zeros_like();
            let step = steps(&matrices, &gradient, &momentum, None).remove(0);
            let largest = step.abs().max().double_value(&[]);
            let most = if size == 0.0 { 0.0 } else { 4.0 };
            assert!(largest <= most, "{size}: {largest}");
        }
    }
}
