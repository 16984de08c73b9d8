//! A model without training: random numbers of the right names and shapes, for demonstrations and tests.
//!
//! Its output is not depth. It exists because real weights cannot be shipped, so that everything around a model can be
//! demonstrated; its file, its name in headers and every report say so.

use super::write::{Planned, write};
use super::{Dtype, Weights};
use crate::{Encoder, Result, durable};
use std::collections::BTreeMap;
use std::io::{self, Write};
use std::path::Path;

/// The key in a file's metadata that says how it was trained.
pub(crate) const TRAINING: &str = "depthrig.training";
/// Value for an untrained model.
const NONE: &str = "none";

impl Weights {
    /// Whether the file says of itself that its numbers are random ([`write_seeded`]).
    pub fn is_untrained(&self) -> bool {
        self.metadata.get(TRAINING).is_some_and(|t| t == NONE)
    }
}

/// Writes random weights of `encoder` to `path`, a `.safetensors` file: the same numbers on every computer for the same
/// `seed`.
///
/// Their spread is such that every layer keeps the size of what goes through it, and the network gives inverse depths
/// of about 1/m.
///
/// # Errors
/// [`crate::ErrorKind::Io`] when the file cannot be written.
pub fn write_seeded(encoder: Encoder, seed: u64, path: impl AsRef<Path>) -> Result<()> {
    let metadata = [
        (TRAINING, NONE.to_owned()),
        (
            "depthrig.note",
            "random numbers, never trained: for demonstrations and tests; what it gives is no depth".into(),
        ),
        ("depthrig.encoder", encoder.name().to_owned()),
        ("depthrig.seed", seed.to_string()),
        ("format", "pt".to_owned()),
    ];
    let metadata: BTreeMap<_, _> = metadata.into_iter().map(|(k, v)| (k.to_owned(), v)).collect();
    let tensors = encoder.architecture().tensors().into_iter();
    let mut tensors: Vec<_> =
        tensors.map(|t| Planned { name: t.name, dtype: Dtype::F32, shape: t.shape }).collect();
    durable::create(path.as_ref(), |out| {
        write(out, &mut tensors, &metadata, &mut |t, out| numbers(t, seed, out))
    })?;
    Ok(())
}

/// Writes the numbers of one tensor: a mean and a spread that follow from what it is.
fn numbers(tensor: &Planned, seed: u64, out: &mut dyn Write) -> io::Result<()> {
    let name = tensor.name.as_str();
    let (mean, spread) = if name.ends_with("output_conv2.2.bias") {
        (1.2, 0.0)
    } else if name.ends_with("output_conv2.2.weight") {
        (0.0, 0.15 / (tensor.shape.iter().skip(1).product::<usize>() as f32).sqrt())
    } else if name.ends_with("gamma") {
        (0.3, 0.05)
    } else if name.contains(".norm") && name.ends_with("weight") {
        (1.0, 0.1)
    } else if name.ends_with("pos_embed") || name.ends_with("cls_token") {
        (0.0, 0.2)
    } else if name.ends_with("bias") || name.ends_with("mask_token") {
        (0.0, 0.05)
    } else {
        // By the numbers that are summed for one of the output. A transposed convolution whose steps are as long as its
        // kernel sums over its first dimension.
        let transposed = name.contains("resize_layers.0") || name.contains("resize_layers.1");
        let summed: usize = if transposed {
            tensor.shape.iter().take(1).product()
        } else {
            tensor.shape.iter().skip(1).product()
        };
        (0.0, 1.0 / (summed.max(1) as f32).sqrt())
    };
    let mut random = Random::new(name, seed);
    let mut left: usize = tensor.shape.iter().product();
    let mut part = Vec::with_capacity(4 << 14);
    while left > 0 {
        part.clear();
        let n = left.min(1 << 14);
        for _ in 0..n {
            part.extend_from_slice(&(mean + spread * random.normal()).to_le_bytes());
        }
        out.write_all(&part)?;
        left -= n;
    }
    Ok(())
}

/// Random numbers: SplitMix64 (Steele, Lea, Flood 2014), begun by the seed and the tensor's name.
struct Random(u64);

impl Random {
    fn new(name: &str, seed: u64) -> Self {
        // FNV-1a of the name.
        let name = name
            .bytes()
            .fold(0xcbf2_9ce4_8422_2325_u64, |h, b| (h ^ u64::from(b)).wrapping_mul(0x0100_0000_01b3));
        Self(name ^ seed.wrapping_mul(0x9e37_79b9_7f4a_7c15))
    }

    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// About normal, with mean 0 and deviation 1: the sum of four even numbers, which has variance 1/3. Exact in 32-bit
    /// floats, so that it is the same everywhere.
    fn normal(&mut self) -> f32 {
        let bits = self.next();
        let sum: u64 = (0..4).map(|i| (bits >> (16 * i)) & 0xffff).sum();
        (sum as f32 - 131_070.0) * (1.732_050_8 / 65_535.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::weights::verify;

    #[test]
    fn a_seeded_model_is_whole_and_says_what_it_is() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("seeded.safetensors");
        write_seeded(Encoder::Vits, 7, &path).unwrap();
        let w = Weights::open(&path).unwrap();
        assert_eq!(verify(&w).unwrap(), Encoder::Vits);
        assert!(w.is_untrained() && w.metadata()["depthrig.note"].contains("never trained"));
        let qkv = w.to_f32("pretrained.blocks.3.attn.qkv.weight").unwrap();
        let mean = qkv.iter().sum::<f32>() / qkv.len() as f32;
        let variance = qkv.iter().map(|x| x * x).sum::<f32>() / qkv.len() as f32;
        assert!(mean.abs() < 1e-3 && (variance * 384.0 - 1.0).abs() < 0.01, "{mean} {variance}");
        // The same on every computer: known numbers, not only the same twice.
        assert_eq!(w.to_f32("pretrained.norm.bias").unwrap()[..2], [-0.041_584_022, 0.050_917_566]);
        let [first, second] = [0, 1].map(|i| w.to_f32(&format!("crossAtts.{i}.in_proj_bias")).unwrap());
        assert_ne!(first, second);
    }
}
