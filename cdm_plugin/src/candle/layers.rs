//! The layers that the parts of the network have in common.

use crate::arch::NORM_EPS;
use crate::{Result, Weights};
use candle_core::{D, Device, Result as Candle, Tensor};

/// Where layers find their tensors.
pub(super) struct Params<'a>(&'a Weights);

impl<'a> Params<'a> {
    pub(super) const fn new(weights: &'a Weights) -> Self {
        Self(weights)
    }

    /// The tensor `name`, which must have the shape `shape`.
    pub(super) fn get(&self, name: &str, shape: &[usize]) -> Result<Tensor> {
        let numbers = self.0.floats(name, shape)?;
        Tensor::from_vec(numbers, shape, &Device::Cpu).map_err(super::engine)
    }
}

/// `x W^T + b` on rows.
pub(super) struct Linear {
    /// `[in, out]`, a view of what the file has.
    weight: Tensor,
    bias: Tensor,
}

impl Linear {
    pub(super) fn read(params: &Params<'_>, name: &str, out: usize, input: usize) -> Result<Self> {
        Self::named(params, &format!("{name}.weight"), &format!("{name}.bias"), out, input)
    }

    pub(super) fn named(
        params: &Params<'_>,
        weight: &str,
        bias: &str,
        out: usize,
        input: usize,
    ) -> Result<Self> {
        let weight = params.get(weight, &[out, input])?.t().map_err(super::engine)?;
        Ok(Self { weight, bias: params.get(bias, &[out])? })
    }

    pub(super) fn forward(&self, x: &Tensor) -> Candle<Tensor> {
        x.matmul(&self.weight)?.broadcast_add(&self.bias)
    }

    /// With the bias counted `times` over.
    pub(super) fn forward_with_bias(&self, x: &Tensor, times: f64) -> Candle<Tensor> {
        x.matmul(&self.weight)?.broadcast_add(&(&self.bias * times)?)
    }
}

/// Each row to mean 0 and variance 1, then scaled and moved.
pub(super) struct LayerNorm {
    weight: Tensor,
    bias: Tensor,
}

impl LayerNorm {
    pub(super) fn read(params: &Params<'_>, name: &str, width: usize) -> Result<Self> {
        Ok(Self {
            weight: params.get(&format!("{name}.weight"), &[width])?,
            bias: params.get(&format!("{name}.bias"), &[width])?,
        })
    }

    pub(super) fn forward(&self, x: &Tensor) -> Candle<Tensor> {
        let centred = x.broadcast_sub(&x.mean_keepdim(D::Minus1)?)?;
        let variance = centred.sqr()?.mean_keepdim(D::Minus1)?;
        let normal = centred.broadcast_div(&(variance + NORM_EPS)?.sqrt()?)?;
        normal.broadcast_mul(&self.weight)?.broadcast_add(&self.bias)
    }
}

/// A convolution over `[1, channels, rows, columns]`.
pub(super) struct Conv {
    weight: Tensor,
    bias: Option<Tensor>,
    stride: usize,
    padding: usize,
}

impl Conv {
    /// `kernel` by `kernel`, with a bias.
    pub(super) fn read(
        params: &Params<'_>,
        name: &str,
        (out, input, kernel): (usize, usize, usize),
        (stride, padding): (usize, usize),
    ) -> Result<Self> {
        let bias =
            params.get(&format!("{name}.bias"), &[out])?.reshape((1, out, 1, 1)).map_err(super::engine)?;
        let plain = Self::without_bias(params, name, (out, input, kernel), (stride, padding))?;
        Ok(Self { bias: Some(bias), ..plain })
    }

    pub(super) fn without_bias(
        params: &Params<'_>,
        name: &str,
        (out, input, kernel): (usize, usize, usize),
        (stride, padding): (usize, usize),
    ) -> Result<Self> {
        let weight = params.get(&format!("{name}.weight"), &[out, input, kernel, kernel])?;
        Ok(Self { weight, bias: None, stride, padding })
    }

    pub(super) fn forward(&self, x: &Tensor) -> Candle<Tensor> {
        let y = x.conv2d(&self.weight, self.padding, self.stride, 1, 1)?;
        match &self.bias {
            Some(bias) => y.broadcast_add(bias),
            None => Ok(y),
        }
    }
}

/// A transposed convolution whose patches do not overlap: the stride is the kernel.
pub(super) struct ConvTranspose {
    weight: Tensor,
    bias: Tensor,
    stride: usize,
}

impl ConvTranspose {
    pub(super) fn read(params: &Params<'_>, name: &str, channels: usize, stride: usize) -> Result<Self> {
        let weight = params.get(&format!("{name}.weight"), &[channels, channels, stride, stride])?;
        let bias = params.get(&format!("{name}.bias"), &[channels])?;
        let bias = bias.reshape((1, channels, 1, 1)).map_err(super::engine)?;
        Ok(Self { weight, bias, stride })
    }

    pub(super) fn forward(&self, x: &Tensor) -> Candle<Tensor> {
        x.conv_transpose2d(&self.weight, 0, 0, self.stride, 1)?.broadcast_add(&self.bias)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// With a variance as small as the epsilon it matters which one it is; tokens of a real network do not show it.
    #[test]
    fn the_epsilon_of_a_norm() {
        let row = |v: Vec<f32>| Tensor::from_vec(v, (1, 2), &Device::Cpu).unwrap();
        let norm = LayerNorm { weight: row(vec![2.0, 4.0]), bias: row(vec![0.5, 0.0]) };
        let y = norm.forward(&row(vec![0.001, -0.001])).unwrap().flatten_all().unwrap();
        let y = y.to_vec1::<f32>().unwrap();
        let half = 0.5f32.sqrt();
        assert!((y[0] - (2.0 * half + 0.5)).abs() < 1e-5 && (y[1] + 4.0 * half).abs() < 1e-5, "{y:?}");
    }
}
