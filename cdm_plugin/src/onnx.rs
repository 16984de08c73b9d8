//! The network as an ONNX graph, made from its architecture: one graph for every size of input.
//!
//! Exporting the official code does not give that. Exporters take heights and widths as dynamic and bake them in all
//! the same, and the bicubic resize of the position embeddings that they leave in the graph is computed wrongly by
//! some runtimes. Here the embeddings are inputs, already of the right size, and every size in the graph comes from the
//! shape of the image.
//!
//! Inputs: `x` `[batch, 4, height, width]`, `pos_rgb` and `pos_depth` `[tokens, width of the encoder]`, all in 32-bit
//! floats. Output: `y` `[batch, height, width]`. The graph holds no weights: whoever runs it puts the tensors of a
//! checkpoint in their places ([`Graph::weights`]), as they lie in the file.

#[cfg(test)]
use crate::Encoder;
use crate::arch::Architecture;
use core::ops::Range;
use prost::Message;
use proto::{ModelProto, StringStringEntryProto};
use std::collections::BTreeMap;

pub(crate) mod builder;
mod network;
pub mod proto;

/// How attention within the encoders is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Attention {
    /// With ONNX's own operators, for engines that find and fuse the pattern themselves: OpenVINO, TensorRT.
    #[default]
    Standard,
    /// As ONNX Runtime's operator `MultiHeadAttention`, which never writes the matrix of scores to memory. For its own
    /// providers, CPU and CUDA.
    Fused,
}

/// The numbers that a graph computes with. Its inputs, its output and its weights are 32-bit floats always.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Numbers {
    /// 32-bit floats.
    #[default]
    Fp32,
    /// 16-bit floats; engines convert the weights once, while they load.
    Fp16,
}

/// How a graph is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Style {
    /// How attention is written.
    pub attention: Attention,
    /// The numbers that it computes with.
    pub numbers: Numbers,
}

/// A part of a tensor of the checkpoint that the graph computes with.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WeightSlice {
    /// The initializer of the graph that it takes the place of.
    pub initializer: String,
    /// The tensor's name in the checkpoint.
    pub tensor: String,
    /// Its rows (first dimension); they lie together in the file.
    pub rows: Range<usize>,
    /// The shape that the graph takes these numbers in.
    pub shape: Vec<usize>,
}

/// A graph without its weights.
#[derive(Debug, Clone, PartialEq)]
pub struct Graph {
    /// The encoded `ModelProto`.
    pub model: Vec<u8>,
    /// Weights of the initializers without data.
    pub weights: Vec<WeightSlice>,
}

impl Graph {
    /// The graph of a network.
    #[cfg(test)]
    pub fn of(encoder: Encoder, style: Style) -> Self {
        Self::of_architecture(encoder.architecture(), style)
    }

    /// The graph of a network of these sizes.
    pub fn of_architecture(arch: Architecture, style: Style) -> Self {
        network::build(arch, style)
    }

    /// The model with its weights at `places` of the file `name`, in the order of [`Self::weights`]. The engine gets
    /// the folder of the file.
    pub fn in_file(&self, name: &str, places: &[Range<usize>]) -> Vec<u8> {
        // It was encoded by `finish`, so it can be decoded.
        let Ok(mut model) = ModelProto::decode(self.model.as_slice()) else { return Vec::new() };
        let at: BTreeMap<&str, &Range<usize>> =
            self.weights.iter().map(|w| w.initializer.as_str()).zip(places).collect();
        let initializers = model.graph.iter_mut().flat_map(|g| &mut g.initializer);
        for initializer in initializers {
            let Some(place) = initializer.name.as_deref().and_then(|name| at.get(name)) else { continue };
            let entry = |key: &str, value: String| StringStringEntryProto {
                key: Some(key.into()),
                value: Some(value),
            };
            initializer.external_data = vec![
                entry("location", name.into()),
                entry("offset", place.start.to_string()),
                entry("length", place.len().to_string()),
            ];
        }
        model.encode_to_vec()
    }
}

#[cfg(test)]
mod tests;
