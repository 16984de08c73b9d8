//! One of the two DINOv2 encoders: a picture to tokens, tapped at four blocks.

use super::layers::{Conv, LayerNorm, Linear, Params};
use crate::Result;
use crate::arch::{Architecture, FeedForward, PATCH};
use candle_core::{D, Result as Candle, Tensor};

pub(super) struct Encoder {
    patches: Conv,
    class: Tensor,
    blocks: Vec<Block>,
    norm: LayerNorm,
}

impl Encoder {
    pub(super) fn read(arch: &Architecture, params: &Params<'_>, name: &str) -> Result<Self> {
        let d = arch.width;
        let blocks = (0..arch.blocks).map(|i| Block::read(arch, params, &format!("{name}.blocks.{i}")));
        let class = params.get(&format!("{name}.cls_token"), &[1, 1, d])?;
        Ok(Self {
            patches: Conv::read(params, &format!("{name}.patch_embed.proj"), (d, 3, PATCH), (PATCH, 0))?,
            class: class.reshape((1, d)).map_err(super::engine)?,
            blocks: blocks.collect::<Result<_>>()?,
            norm: LayerNorm::read(params, &format!("{name}.norm"), d)?,
        })
    }

    /// Tokens `[patches, width]` at each of `taps`, normalised, for a picture `[1, 3, rows, columns]`.
    pub(super) fn forward(
        &self,
        picture: &Tensor,
        positions: &Tensor,
        taps: &[usize],
    ) -> Candle<Vec<Tensor>> {
        let tokens = self.patches.forward(picture)?.flatten_from(2)?.squeeze(0)?.t()?;
        let mut x = (Tensor::cat(&[&self.class, &tokens], 0)? + positions)?;
        let mut tapped = Vec::with_capacity(taps.len());
        for (i, block) in self.blocks.iter().enumerate() {
            x = block.forward(&x)?;
            if taps.contains(&i) {
                tapped.push(self.norm.forward(&x.narrow(0, 1, x.dim(0)? - 1)?.contiguous()?)?);
            }
        }
        Ok(tapped)
    }
}

/// Attention, then a feed-forward part, each on normalised tokens and each added with a weight of its own per channel.
struct Block {
    norm1: LayerNorm,
    attention: Attention,
    scale1: Tensor,
    norm2: LayerNorm,
    forward: Forward,
    scale2: Tensor,
}

impl Block {
    fn read(arch: &Architecture, params: &Params<'_>, name: &str) -> Result<Self> {
        let d = arch.width;
        Ok(Self {
            norm1: LayerNorm::read(params, &format!("{name}.norm1"), d)?,
            attention: Attention {
                heads: arch.heads,
                qkv: Linear::read(params, &format!("{name}.attn.qkv"), 3 * d, d)?,
                out: Linear::read(params, &format!("{name}.attn.proj"), d, d)?,
            },
            scale1: params.get(&format!("{name}.ls1.gamma"), &[d])?,
            norm2: LayerNorm::read(params, &format!("{name}.norm2"), d)?,
            forward: Forward::read(arch, params, &format!("{name}.mlp"))?,
            scale2: params.get(&format!("{name}.ls2.gamma"), &[d])?,
        })
    }

    fn forward(&self, x: &Tensor) -> Candle<Tensor> {
        let attended = self.attention.forward(&self.norm1.forward(x)?)?;
        let x = (x + attended.broadcast_mul(&self.scale1)?)?;
        let fed = self.forward.forward(&self.norm2.forward(&x)?)?;
        x + fed.broadcast_mul(&self.scale2)?
    }
}

struct Attention {
    heads: usize,
    qkv: Linear,
    out: Linear,
}

impl Attention {
    /// One head after the other, so that one matrix of scores is in memory at a time.
    fn forward(&self, x: &Tensor) -> Candle<Tensor> {
        let (_, width) = x.dims2()?;
        let head = width / self.heads;
        let scale = 1.0 / (head as f64).sqrt();
        let qkv = self.qkv.forward(x)?;
        let mut heads = Vec::with_capacity(self.heads);
        for i in 0..self.heads {
            let part = |k: usize| qkv.narrow(1, k * width + i * head, head)?.contiguous();
            let scores = (part(0)? * scale)?.matmul(&part(1)?.t()?)?;
            heads.push(softmax(&scores)?.matmul(&part(2)?)?);
        }
        self.out.forward(&Tensor::cat(&heads, 1)?)
    }
}

/// Of each row.
fn softmax(x: &Tensor) -> Candle<Tensor> {
    let powers = x.broadcast_sub(&x.max_keepdim(D::Minus1)?)?.exp()?;
    powers.broadcast_div(&powers.sum_keepdim(D::Minus1)?)
}

enum Forward {
    Gelu(Linear, Linear),
    SwiGlu(Linear, Linear),
}

impl Forward {
    fn read(arch: &Architecture, params: &Params<'_>, name: &str) -> Result<Self> {
        let d = arch.width;
        let layer = |layer, out, input| Linear::read(params, &format!("{name}.{layer}"), out, input);
        Ok(match arch.feed_forward {
            FeedForward::Gelu { hidden } => Self::Gelu(layer("fc1", hidden, d)?, layer("fc2", d, hidden)?),
            FeedForward::SwiGlu { hidden } => {
                Self::SwiGlu(layer("w12", 2 * hidden, d)?, layer("w3", d, hidden)?)
            }
        })
    }

    fn forward(&self, x: &Tensor) -> Candle<Tensor> {
        match self {
            Self::Gelu(fc1, fc2) => fc2.forward(&fc1.forward(x)?.gelu_erf()?),
            Self::SwiGlu(w12, w3) => {
                let halves = w12.forward(x)?.chunk(2, 1)?;
                let [gate, value] = halves.as_slice() else { candle_core::bail!("two halves") };
                w3.forward(&(gate.silu()? * value)?)
            }
        }
    }
}
