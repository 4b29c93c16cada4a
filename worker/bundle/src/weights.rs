//! Named tensors in safetensors files, stored as fp16 or fp32, always f32 in memory.
//!
//! A network that holds one NaN renders garbage everywhere, so non-finite values are refused on both sides; so is a
//! finite f32 that fp16 cannot hold.

use std::borrow::Cow;
use std::collections::BTreeMap;

use half::f16;
use safetensors::tensor::{Dtype, SafeTensors, View, serialize};
use serde::{Deserialize, Serialize};

use crate::BundleError;

/// How weights are stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// IEEE 754 binary16.
    Fp16,
    /// IEEE 754 binary32.
    Fp32,
}

/// A dense tensor, row-major.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Tensor {
    /// Sizes, outermost first; empty for a scalar.
    pub shape: Vec<usize>,
    /// As many as the product of `shape`.
    pub values: Vec<f32>,
}

/// Tensors by name.
pub type Tensors = BTreeMap<String, Tensor>;

struct Encoded {
    dtype: Dtype,
    shape: Vec<usize>,
    bytes: Vec<u8>,
}

impl View for &Encoded {
    fn dtype(&self) -> Dtype {
        self.dtype
    }
    fn shape(&self) -> &[usize] {
        &self.shape
    }
    fn data(&self) -> Cow<'_, [u8]> {
        Cow::Borrowed(&self.bytes)
    }
    fn data_len(&self) -> usize {
        self.bytes.len()
    }
}

/// Encodes `tensors`; `file` is only named in errors. The same tensors give the same bytes.
pub fn encode(file: &str, tensors: &Tensors, precision: Precision) -> Result<Vec<u8>, BundleError> {
    let mut encoded = BTreeMap::new();
    for (name, tensor) in tensors {
        if element_count(&tensor.shape) != Some(tensor.values.len()) {
            return Err(BundleError::malformed(
                file,
                format!(
                    "tensor {name:?} has shape {:?} but {} values",
                    tensor.shape,
                    tensor.values.len()
                ),
            ));
        }
        let non_finite = || BundleError::NonFinite {
            file: file.to_owned(),
            tensor: name.clone(),
        };
        let (dtype, bytes) = match precision {
            Precision::Fp32 => {
                if !tensor.values.iter().all(|v| v.is_finite()) {
                    return Err(non_finite());
                }
                (
                    Dtype::F32,
                    tensor.values.iter().flat_map(|v| v.to_le_bytes()).collect(),
                )
            }
            Precision::Fp16 => {
                let halves: Vec<f16> = tensor.values.iter().copied().map(f16::from_f32).collect();
                if !halves.iter().all(|v| v.is_finite()) {
                    return Err(non_finite());
                }
                (
                    Dtype::F16,
                    halves.iter().flat_map(|v| v.to_le_bytes()).collect(),
                )
            }
        };
        encoded.insert(
            name.as_str(),
            Encoded {
                dtype,
                shape: tensor.shape.clone(),
                bytes,
            },
        );
    }
    serialize(encoded.iter().map(|(name, tensor)| (*name, tensor)), None)
        .map_err(|source| BundleError::malformed(file, format!("cannot be encoded: {source}")))
}

/// Decodes a safetensors file of fp16 and fp32 tensors; `file` is only named in errors.
pub fn decode(file: &str, bytes: &[u8]) -> Result<Tensors, BundleError> {
    let archive = SafeTensors::deserialize(bytes).map_err(|source| {
        BundleError::malformed(file, format!("not a safetensors file: {source}"))
    })?;
    let mut tensors = Tensors::new();
    for (name, view) in archive.iter() {
        let values: Vec<f32> = match view.dtype() {
            Dtype::F32 => view
                .data()
                .as_chunks::<4>()
                .0
                .iter()
                .map(|&b| f32::from_le_bytes(b))
                .collect(),
            Dtype::F16 => view
                .data()
                .as_chunks::<2>()
                .0
                .iter()
                .map(|&b| f16::from_le_bytes(b).to_f32())
                .collect(),
            other => {
                return Err(BundleError::malformed(
                    file,
                    format!("tensor {name:?} is {other:?}, not F16 or F32"),
                ));
            }
        };
        if !values.iter().all(|v| v.is_finite()) {
            return Err(BundleError::NonFinite {
                file: file.to_owned(),
                tensor: name.to_owned(),
            });
        }
        tensors.insert(
            name.to_owned(),
            Tensor {
                shape: view.shape().to_vec(),
                values,
            },
        );
    }
    Ok(tensors)
}

fn element_count(shape: &[usize]) -> Option<usize> {
    shape
        .iter()
        .try_fold(1_usize, |product, &size| product.checked_mul(size))
}

#[cfg(test)]
mod tests {
    use super::{Precision, Tensor, Tensors, decode, encode};
    use crate::BundleError;

    fn one(values: Vec<f32>) -> Tensors {
        Tensors::from([(
            "stem.weight".to_owned(),
            Tensor {
                shape: vec![values.len()],
                values,
            },
        )])
    }

    #[test]
    fn non_finite_values_are_named() {
        for bad in [f32::NAN, f32::INFINITY] {
            let error = encode("w.safetensors", &one(vec![1.0, bad]), Precision::Fp32).unwrap_err();
            assert!(
                matches!(&error, BundleError::NonFinite { tensor, .. } if tensor == "stem.weight"),
                "{error}"
            );
        }
        // Finite as f32, infinite as fp16.
        assert!(encode("w", &one(vec![1e6]), Precision::Fp16).is_err());
        let mut bytes = encode("w", &one(vec![1.0]), Precision::Fp32).unwrap();
        let at = bytes.len() - 4;
        bytes[at..].copy_from_slice(&f32::NAN.to_le_bytes());
        assert!(matches!(
            decode("w", &bytes),
            Err(BundleError::NonFinite { .. })
        ));
    }

    #[test]
    fn damaged_files_are_errors() {
        let bytes = encode("w", &one(vec![1.0, 2.0, 3.0]), Precision::Fp32).unwrap();
        for length in 0..bytes.len() {
            assert!(decode("w", &bytes[..length]).is_err(), "{length}");
        }
        let wrong = Tensors::from([(
            "a".to_owned(),
            Tensor {
                shape: vec![2, 2],
                values: vec![0.0; 3],
            },
        )]);
        assert!(encode("w", &wrong, Precision::Fp32).is_err());
    }
}
