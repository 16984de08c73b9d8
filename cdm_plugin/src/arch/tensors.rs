//! Every tensor of a checkpoint: its name and its shape, in the order in which PyTorch writes them.

use super::{Architecture, ENCODERS, FeedForward, HEAD, OUTPUT_CHANNELS, PATCH};

/// One tensor of a checkpoint.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TensorSpec {
    /// Its name, without the prefix of a wrapper.
    pub name: String,
    /// Its shape, row-major.
    pub shape: Vec<usize>,
    /// Whether the network computes with it. `mask_token` and `refinenet4.resConfUnit1` are in every checkpoint and
    /// have no effect.
    pub used: bool,
}

/// Collects specs under a prefix.
struct List(Vec<TensorSpec>);

impl List {
    fn push(&mut self, name: impl Into<String>, shape: &[usize]) {
        self.0.push(TensorSpec { name: name.into(), shape: shape.to_vec(), used: true });
    }

    /// A layer with a weight of `shape` and a bias of `out` numbers.
    fn layer(&mut self, name: &str, shape: &[usize], out: usize) {
        self.push(format!("{name}.weight"), shape);
        self.push(format!("{name}.bias"), &[out]);
    }

    fn linear(&mut self, name: &str, out: usize, input: usize) {
        self.layer(name, &[out, input], out);
    }

    fn conv(&mut self, name: &str, out: usize, input: usize, kernel: usize) {
        self.layer(name, &[out, input, kernel, kernel], out);
    }
}

impl Architecture {
    /// Every tensor of a checkpoint, in the order in which PyTorch writes them.
    pub fn tensors(&self) -> Vec<TensorSpec> {
        let mut list = List(Vec::new());
        for encoder in ENCODERS {
            self.encoder_tensors(&mut list, encoder);
        }
        self.head_tensors(&mut list);
        for level in 0..self.taps.len() {
            let fusion = format!("crossAtts.{level}");
            list.push(format!("{fusion}.in_proj_weight"), &[3 * self.width, self.width]);
            list.push(format!("{fusion}.in_proj_bias"), &[3 * self.width]);
            list.linear(&format!("{fusion}.out_proj"), self.width, self.width);
        }
        for spec in &mut list.0 {
            spec.used = !spec.name.ends_with("mask_token") && !spec.name.contains("refinenet4.resConfUnit1");
        }
        list.0
    }

    fn encoder_tensors(&self, list: &mut List, encoder: &str) {
        let d = self.width;
        list.push(format!("{encoder}.cls_token"), &[1, 1, d]);
        list.push(format!("{encoder}.pos_embed"), &[1, 1 + self.grid * self.grid, d]);
        list.push(format!("{encoder}.mask_token"), &[1, d]);
        list.conv(&format!("{encoder}.patch_embed.proj"), d, 3, PATCH);
        for i in 0..self.blocks {
            let block = format!("{encoder}.blocks.{i}");
            list.layer(&format!("{block}.norm1"), &[d], d);
            list.linear(&format!("{block}.attn.qkv"), 3 * d, d);
            list.linear(&format!("{block}.attn.proj"), d, d);
            list.push(format!("{block}.ls1.gamma"), &[d]);
            list.layer(&format!("{block}.norm2"), &[d], d);
            match self.feed_forward {
                FeedForward::Gelu { hidden } => {
                    list.linear(&format!("{block}.mlp.fc1"), hidden, d);
                    list.linear(&format!("{block}.mlp.fc2"), d, hidden);
                }
                FeedForward::SwiGlu { hidden } => {
                    list.linear(&format!("{block}.mlp.w12"), 2 * hidden, d);
                    list.linear(&format!("{block}.mlp.w3"), d, hidden);
                }
            }
            list.push(format!("{block}.ls2.gamma"), &[d]);
        }
        list.layer(&format!("{encoder}.norm"), &[d], d);
    }

    fn head_tensors(&self, list: &mut List) {
        let [l0, l1, _, l3] = self.levels;
        let f = self.features;
        for (i, level) in self.levels.into_iter().enumerate() {
            list.conv(&format!("{HEAD}.projects.{i}"), level, 2 * self.width, 1);
        }
        // The first two are transposed convolutions; the third level keeps its size and has none.
        list.conv(&format!("{HEAD}.resize_layers.0"), l0, l0, 4);
        list.conv(&format!("{HEAD}.resize_layers.1"), l1, l1, 2);
        list.conv(&format!("{HEAD}.resize_layers.3"), l3, l3, 3);
        for (i, level) in self.levels.into_iter().enumerate() {
            list.push(format!("{HEAD}.scratch.layer{}_rn.weight", i + 1), &[f, level, 3, 3]);
        }
        for i in 1..=4 {
            let refine = format!("{HEAD}.scratch.refinenet{i}");
            list.conv(&format!("{refine}.out_conv"), f, f, 1);
            for unit in 1..=2 {
                for conv in 1..=2 {
                    list.conv(&format!("{refine}.resConfUnit{unit}.conv{conv}"), f, f, 3);
                }
            }
        }
        list.conv(&format!("{HEAD}.scratch.output_conv1"), f / 2, f, 3);
        list.conv(&format!("{HEAD}.scratch.output_conv2.0"), OUTPUT_CHANNELS, f / 2, 3);
        list.conv(&format!("{HEAD}.scratch.output_conv2.2"), 1, OUTPUT_CHANNELS, 1);
    }
}
