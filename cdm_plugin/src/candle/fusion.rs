//! The tokens of colour and of inverse depth at one place attend to each other, and the two results are added.

use super::layers::{Linear, Params};
use crate::Result;
use crate::arch::{Architecture, FUSION_HEADS};
use candle_core::{D, Result as Candle, Tensor};

pub(super) struct Fusion {
    qkv: Linear,
    out: Linear,
}

/// Queries, keys and values, each `[patches, heads, width of a head]`.
type Qkv = [Tensor; 3];

impl Fusion {
    pub(super) fn read(arch: &Architecture, params: &Params<'_>, level: usize) -> Result<Self> {
        let (d, name) = (arch.width, format!("crossAtts.{level}"));
        let (weight, bias) = (format!("{name}.in_proj_weight"), format!("{name}.in_proj_bias"));
        Ok(Self {
            qkv: Linear::named(params, &weight, &bias, 3 * d, d)?,
            out: Linear::read(params, &format!("{name}.out_proj"), d, d)?,
        })
    }

    /// Of two tokens, softmax is the logistic function of the difference of the scores. Both results go through one linear
    /// layer and are added, so they are added before it, and its bias counts twice.
    pub(super) fn forward(&self, rgb: &Tensor, depth: &Tensor) -> Candle<Tensor> {
        let (patches, width) = rgb.dims2()?;
        let (rgb, depth) = (self.project(rgb)?, self.project(depth)?);
        let scale = 1.0 / ((width / FUSION_HEADS) as f64).sqrt();
        let score = |query: &Tensor, key: &Tensor| (query * key)?.sum_keepdim(D::Minus1)? * scale;
        // How much each of the two looks at colour; at depth it is the rest.
        let at_rgb = |of: &Qkv| logistic(&(score(&of[0], &rgb[1])? - score(&of[0], &depth[1])?)?);
        let at_rgb = (at_rgb(&rgb)? + at_rgb(&depth)?)?;
        let at_depth = at_rgb.affine(-1.0, 2.0)?;
        let sum = (rgb[2].broadcast_mul(&at_rgb)? + depth[2].broadcast_mul(&at_depth)?)?;
        self.out.forward_with_bias(&sum.reshape((patches, width))?, 2.0)
    }

    fn project(&self, tokens: &Tensor) -> Candle<Qkv> {
        let (patches, width) = tokens.dims2()?;
        let qkv = self.qkv.forward(tokens)?;
        let part = |k: usize| {
            let part = qkv.narrow(1, k * width, width)?.contiguous()?;
            part.reshape((patches, FUSION_HEADS, width / FUSION_HEADS))
        };
        Ok([part(0)?, part(1)?, part(2)?])
    }
}

/// `1 / (1 + exp(-x))`.
fn logistic(x: &Tensor) -> Candle<Tensor> {
    x.neg()?.exp()?.affine(1.0, 1.0)?.recip()
}
