//! The network in pure Rust, on the crate `candle-core`: slow, in need of no native library, and what the other engines are
//! compared with.
//!
//! The layers are our own. Those of `candle-transformers` compute something else: another GELU, another epsilon, embeddings
//! resized by nearest neighbour.

mod encoder;
mod fusion;
mod head;
mod layers;

use crate::arch::{Architecture, ENCODERS};
use crate::{Error, ErrorKind, Model, NetShape, Network, PositionEmbeddings, Result, Weights};
use candle_core::{Device, Tensor};
use encoder::Encoder;
use fusion::Fusion;
use head::Head;
use layers::Params;
use rayon::{ThreadPool, ThreadPoolBuilder};

/// What headers call it; the version is the one that Cargo.toml fixes.
const DESCRIPTION: &str = "candle 0.11.1 cpu fp32";

/// The network, in 32-bit floats on the CPU.
pub struct CandleNetwork {
    arch: Architecture,
    encoders: [Encoder; 2],
    fusions: Vec<Fusion>,
    head: Head,
    threads: ThreadPool,
    prepared: Option<Prepared>,
}

/// One size of input with its embeddings.
struct Prepared {
    shape: NetShape,
    positions: [Tensor; 2],
}

/// An error of the crate below, which is about sizes that do not fit or memory.
fn engine(e: candle_core::Error) -> Error {
    let message =
        format!("candle failed: {e}; this is a defect of depthrig, please report it with the model's name");
    Error::new(ErrorKind::Engine, message).with_source(e)
}

impl CandleNetwork {
    /// Copies the weights of `model` and starts `threads` threads; 0 is as many as this process may use.
    ///
    /// # Errors
    /// [`ErrorKind::BadModel`] when a tensor is missing or of another shape, [`ErrorKind::Engine`] when threads cannot be
    /// started.
    pub fn open(model: &Model, threads: usize) -> Result<Self> {
        Self::of(model.encoder.architecture(), &model.weights, threads)
    }

    /// The same for a network of any sizes.
    pub(crate) fn of(arch: Architecture, weights: &Weights, threads: usize) -> Result<Self> {
        let pool = ThreadPoolBuilder::new()
            .num_threads(threads)
            .thread_name(|i| format!("cdm-candle-{i}"))
            .build()
            .map_err(|e| {
                let message = format!("the threads of candle could not be started: {e}; give it fewer");
                Error::new(ErrorKind::Engine, message).with_source(e)
            })?;
        Self::with_architecture(arch, &Params::new(weights), pool)
    }

    fn with_architecture(arch: Architecture, params: &Params<'_>, threads: ThreadPool) -> Result<Self> {
        let [rgb, depth] = ENCODERS.map(|name| Encoder::read(&arch, params, name));
        let fusions = (0..arch.taps.len()).map(|level| Fusion::read(&arch, params, level));
        Ok(Self {
            arch,
            encoders: [rgb?, depth?],
            fusions: fusions.collect::<Result<_>>()?,
            head: Head::read(&arch, params)?,
            threads,
            prepared: None,
        })
    }

    /// Inverse depth `[height, width]` of one picture `[4, height, width]`.
    fn one(&self, x: &[f32], prepared: &Prepared) -> candle_core::Result<Tensor> {
        let NetShape { height, width, .. } = prepared.shape;
        let x = Tensor::from_slice(x, (1, 4, height, width), &Device::Cpu)?;
        let depth = x.narrow(1, 3, 1)?;
        let pictures = [x.narrow(1, 0, 3)?, Tensor::cat(&[&depth, &depth, &depth], 1)?];
        let mut tokens = Vec::with_capacity(2);
        for ((encoder, picture), positions) in self.encoders.iter().zip(&pictures).zip(&prepared.positions) {
            tokens.push(encoder.forward(picture, positions, &self.arch.taps)?);
        }
        let [rgb, depth] = tokens.as_slice() else { candle_core::bail!("there are two encoders") };
        let mut levels = Vec::with_capacity(self.fusions.len());
        for ((fusion, rgb), depth) in self.fusions.iter().zip(rgb).zip(depth) {
            levels.push(Tensor::cat(&[rgb, &fusion.forward(rgb, depth)?], 1)?);
        }
        self.head.forward(&levels, prepared.shape)
    }
}

impl Network for CandleNetwork {
    fn describe(&self) -> &'static str {
        DESCRIPTION
    }

    fn prepare(&mut self, shape: NetShape, positions: &PositionEmbeddings) -> Result<()> {
        let tokens = (1 + shape.patches(), self.arch.width);
        let [rgb, depth] = [&positions.rgb, &positions.depth]
            .map(|p| Tensor::from_slice(p.as_slice(), tokens, &Device::Cpu).map_err(engine));
        self.prepared = Some(Prepared { shape, positions: [rgb?, depth?] });
        Ok(())
    }

    /// One picture after the other: a batch would gain nothing here and would need more memory.
    fn run(&mut self, x: &[f32], y: &mut [f32]) -> Result<()> {
        let Some(prepared) = self
            .prepared
            .as_ref()
            .filter(|p| x.len() == p.shape.input_len() && y.len() == p.shape.output_len())
        else {
            let message = format!("candle was not prepared for an input of {} numbers", x.len());
            return Err(Error::new(ErrorKind::Engine, message));
        };
        let one = NetShape { batch: 1, ..prepared.shape };
        for (x, y) in x.chunks_exact(one.input_len()).zip(y.chunks_exact_mut(one.output_len())) {
            let inverse = self.threads.install(|| self.one(x, prepared)?.flatten_all()?.to_vec1::<f32>());
            y.copy_from_slice(&inverse.map_err(engine)?);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
