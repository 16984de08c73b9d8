//! Fake stereo networks for tests: block matching as an ONNX graph, in the forms of real networks.

use crate::onnx::Numbers;
use crate::onnx::builder::{Attribute, Builder, Dimension, Value};
use std::collections::BTreeMap;

/// Builder of a fake network. Each flag is one form of real networks. The network computes the shift with the least sum
/// of absolute differences in 5x5 pixels.
#[allow(clippy::struct_excessive_bools)] // forms that are independent of each other
#[derive(Debug, Clone)]
pub struct FakeNetwork {
    /// Number of shifts to try, from 0.
    pub disparities: i64,
    /// Channels of an image.
    pub channels: usize,
    /// Both images in one input.
    pub stacked: bool,
    /// The channels come last.
    pub channels_last: bool,
    /// Width and height, if the size is fixed.
    pub size: Option<(usize, usize)>,
    /// Names of the inputs, the left image's first.
    pub names: [&'static str; 2],
    /// The right image's input is declared first.
    pub right_first: bool,
    /// It outputs negative shifts.
    pub negative: bool,
    /// It has an output with the confidence.
    pub confidence: bool,
    /// Keys and values of its metadata.
    pub metadata: Vec<(&'static str, &'static str)>,
}

impl Default for FakeNetwork {
    fn default() -> Self {
        Self {
            disparities: 16,
            channels: 3,
            stacked: false,
            channels_last: false,
            size: None,
            names: ["left", "right"],
            right_first: false,
            negative: false,
            confidence: false,
            metadata: Vec::new(),
        }
    }
}

impl FakeNetwork {
    /// The ONNX file.
    pub fn file(&self) -> Vec<u8> {
        let mut b = Builder::new(BTreeMap::new(), Numbers::Fp32);
        let all = self.channels * if self.stacked { 2 } else { 1 };
        let (width, height) = match self.size {
            Some((w, h)) => (Dimension::Fixed(w), Dimension::Fixed(h)),
            None => (Dimension::Named("width"), Dimension::Named("height")),
        };
        let one = Dimension::Fixed(1);
        let channels = Dimension::Fixed(all);
        let shape =
            if self.channels_last { [one, height, width, channels] } else { [one, channels, height, width] };
        let first = |b: &mut Builder, value: Value| {
            if self.channels_last {
                b.op("Transpose", &[&value], &[("perm", Attribute::Ints(&[0, 3, 1, 2]))])
            } else {
                value
            }
        };
        let (left, right) = if self.stacked {
            let both = b.input(self.names[0], &shape);
            let both = first(&mut b, both);
            let n = self.channels as i64;
            let slice = |b: &mut Builder, from: i64| {
                let begin = b.ints(&[from]);
                let end = b.ints(&[from + n]);
                let axis = b.ints(&[1]);
                b.op("Slice", &[&both, &begin, &end, &axis], &[])
            };
            (slice(&mut b, 0), slice(&mut b, n))
        } else {
            let mut names = self.names;
            if self.right_first {
                names.reverse();
            }
            let declared = names.map(|name| b.input(name, &shape));
            let [left, right] = if self.right_first {
                let [r, l] = declared;
                [l, r]
            } else {
                declared
            };
            (first(&mut b, left), first(&mut b, right))
        };
        let channels = b.ints(&[1]);
        let far = b.float(1e4);
        let costs = 0..self.disparities;
        let costs: Vec<Value> = costs
            .map(|d| {
                // Moves x - d to x.
                let pads = b.ints(&[0, 0, 0, d, 0, 0, 0, -d]);
                let shifted = b.op("Pad", &[&right, &pads, &far], &[]);
                let difference = b.op("Sub", &[&left, &shifted], &[]);
                let difference = b.op("Abs", &[&difference], &[]);
                let cost = b.op("ReduceMean", &[&difference, &channels], &[("keepdims", Attribute::Int(1))]);
                let window: [(&str, Attribute<'_>); 2] =
                    [("kernel_shape", Attribute::Ints(&[5, 5])), ("pads", Attribute::Ints(&[2, 2, 2, 2]))];
                b.op("AveragePool", &[&cost], &window)
            })
            .collect();
        let costs: Vec<&Value> = costs.iter().collect();
        let volume = b.op("Concat", &costs, &[("axis", Attribute::Int(1))]);
        let best =
            b.op("ArgMin", &[&volume], &[("axis", Attribute::Int(1)), ("keepdims", Attribute::Int(1))]);
        let mut disparity = b.op("Cast", &[&best], &[("to", Attribute::Int(1))]);
        if self.negative {
            disparity = b.op("Neg", &[&disparity], &[]);
        }
        let out = [one, one, height, width];
        b.output("disparity", &disparity, &out);
        if self.confidence {
            let least = b.op("ReduceMin", &[&volume, &channels], &[("keepdims", Attribute::Int(1))]);
            let least = b.op("Neg", &[&least], &[]);
            let sure = b.op("Exp", &[&least], &[]);
            b.output("confidence", &sure, &out);
        }
        let mut file = b.finish("block matching").model;
        for (key, value) in &self.metadata {
            // ModelProto.metadata_props, field 14, of two strings: a message may be appended to what is encoded.
            let mut entry = vec![0x0a, key.len() as u8];
            entry.extend(key.bytes().chain([0x12, value.len() as u8]).chain(value.bytes()));
            file.extend([0x72, entry.len() as u8]);
            file.extend(entry);
        }
        file
    }
}
