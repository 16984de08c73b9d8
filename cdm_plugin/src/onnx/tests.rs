//! Graphs that hold together: every value made before it is used, every tensor of the checkpoint in its place.

use super::proto::{FLOAT, ModelProto};
use super::*;
use crate::arch::TensorSpec;
use prost::Message;
use std::collections::{BTreeMap, BTreeSet};

const STYLES: [Style; 3] = [
    Style { attention: Attention::Standard, numbers: Numbers::Fp32 },
    Style { attention: Attention::Fused, numbers: Numbers::Fp32 },
    Style { attention: Attention::Fused, numbers: Numbers::Fp16 },
];

#[test]
fn every_value_is_made_once_and_before_it_is_used() {
    for encoder in Encoder::ALL {
        for style in STYLES {
            let graph = Graph::of(encoder, style);
            let model = ModelProto::decode(graph.model.as_slice()).unwrap();
            let g = model.graph.unwrap();
            let mut known: BTreeSet<String> = g.initializer.iter().filter_map(|t| t.name.clone()).collect();
            assert_eq!(known.len(), g.initializer.len());
            known.extend(g.input.iter().filter_map(|i| i.name.clone()));
            let mut used = BTreeSet::new();
            for node in &g.node {
                for input in node.input.iter().filter(|i| !i.is_empty()) {
                    assert!(known.contains(input), "{encoder} {style:?}: {:?} uses {input}", node.name);
                    used.insert(input.clone());
                }
                for output in &node.output {
                    assert!(known.insert(output.clone()), "{encoder} {style:?}: {output} is made twice");
                }
            }
            let idle: Vec<_> = known.iter().filter(|v| !used.contains(*v)).collect();
            assert_eq!(idle, ["y"], "{encoder} {style:?}: made and not used");
            assert!(graph.model.len() < 2 << 20, "{encoder}: {} bytes", graph.model.len());
        }
    }
}

/// The graph holds all weights that the network computes with; unused ones are left out, as are the position
/// embeddings, which are inputs.
#[test]
fn every_row_of_every_tensor_that_counts() {
    for encoder in Encoder::ALL {
        let mut rows: BTreeMap<String, usize> = BTreeMap::new();
        for slice in Graph::of(encoder, Style::default()).weights {
            *rows.entry(slice.tensor).or_default() += slice.rows.len();
        }
        for TensorSpec { name, shape, used } in encoder.architecture().tensors() {
            let expected = match &*name {
                _ if !used || name.ends_with("pos_embed") => None,
                // The keys' bias adds the same to both scores and has no effect.
                n if n.ends_with("in_proj_bias") => Some(shape[0] / 3 * 2),
                _ => Some(shape[0]),
            };
            assert_eq!(rows.get(&name).copied(), expected, "{encoder}: {name}");
        }
    }
}

#[test]
fn what_goes_in_and_out_is_in_32_bit_floats() {
    for style in STYLES {
        let model = ModelProto::decode(Graph::of(Encoder::Vits, style).model.as_slice()).unwrap();
        let g = model.graph.unwrap();
        let of = |v: &super::proto::ValueInfoProto| {
            let tensor = v.r#type.clone().unwrap().tensor_type.unwrap();
            assert_eq!(tensor.elem_type, Some(FLOAT));
            let dims: Vec<String> = tensor
                .shape
                .unwrap()
                .dim
                .into_iter()
                .map(|d| d.dim_param.unwrap_or_else(|| d.dim_value.unwrap().to_string()))
                .collect();
            format!("{} [{}]", v.name.clone().unwrap(), dims.join(", "))
        };
        let inputs: Vec<_> = g.input.iter().map(of).collect();
        assert_eq!(
            inputs,
            ["x [batch, 4, height, width]", "pos_rgb [tokens, 384]", "pos_depth [tokens, 384]"]
        );
        let outputs: Vec<_> = g.output.iter().map(of).collect();
        assert_eq!(outputs, ["y [batch, height, width]"]);
        let fused = style.attention == Attention::Fused;
        assert_eq!(
            model.opset_import.len(),
            if fused { 2 } else { 1 },
            "standard graphs name no other operators"
        );
        // ONNX_GRAPHS=DIR writes the graphs, for ONNX's own checker and for viewers.
        if let Some(dir) = std::env::var_os("ONNX_GRAPHS") {
            for encoder in Encoder::ALL {
                let file = format!("{encoder}-{:?}-{:?}.onnx", style.attention, style.numbers);
                std::fs::write(std::path::Path::new(&dir).join(file), Graph::of(encoder, style).model)
                    .unwrap();
            }
        }
    }
}

/// Weights of 2.6 GB stay out of the message, which may have 2 GB.
#[test]
fn a_graph_with_its_weights_in_a_file_says_where_each_lies() {
    let graph = Graph::of(Encoder::Vitl, Style::default());
    let places: Vec<_> = (0..graph.weights.len()).map(|i| 1000 * i..1000 * i + 8).collect();
    let bytes = graph.in_file("model.safetensors", &places);
    assert!(bytes.len() < 2 << 20, "{} bytes", bytes.len());
    let model = ModelProto::decode(bytes.as_slice()).unwrap();
    let initializers = model.graph.unwrap().initializer;
    for (weight, place) in graph.weights.iter().zip(&places) {
        let found = initializers.iter().find(|t| t.name.as_deref() == Some(&weight.initializer)).unwrap();
        let said: Vec<_> = found.external_data.iter().filter_map(|e| e.value.clone()).collect();
        assert_eq!(said, ["model.safetensors".to_owned(), place.start.to_string(), "8".to_owned()]);
    }
}
