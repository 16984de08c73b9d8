//! A network far smaller than any that is published, with one input and the official code's output for it: what engines are
//! tested on in milliseconds. `tests/data/tiny_swiglu.py` made it.

use crate::arch::{Architecture, FeedForward};
use crate::prep::Positions;
use crate::{NetShape, Network, Weights};
use std::path::Path;

/// The file, mapped.
pub(crate) fn weights() -> Weights {
    Weights::open(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/tiny_swiglu.safetensors")).unwrap()
}

/// Two encoders of four blocks with the feed-forward part of the largest network; 5x5 places were learnt.
pub(crate) const ARCHITECTURE: Architecture = Architecture {
    width: 16,
    blocks: 4,
    heads: 2,
    feed_forward: FeedForward::SwiGlu { hidden: 48 },
    taps: [0, 1, 2, 3],
    features: 8,
    levels: [4, 6, 8, 10],
    grid: 5,
};

/// The size of the input: 3x5 patches, an odd number of rows.
pub(crate) const SHAPE: NetShape = NetShape { batch: 1, height: 42, width: 70 };

/// The largest difference of what `network` makes of the input from the official output (0 to 2.7).
pub(crate) fn difference(network: &mut dyn Network) -> f32 {
    let weights = weights();
    let x = weights.floats("x", &[1, 4, SHAPE.height, SHAPE.width]).unwrap();
    let expected = weights.floats("y", &[1, SHAPE.height, SHAPE.width]).unwrap();
    let positions = Positions::read(&ARCHITECTURE, &weights).unwrap();
    network.prepare(SHAPE, &positions.at(SHAPE)).unwrap();
    let mut y = vec![f32::NAN; SHAPE.output_len()];
    network.run(&x, &mut y).unwrap();
    y.iter()
        .zip(&expected)
        .map(|(a, b)| (a - b).abs())
        .fold(0.0, |m, d| if d.is_nan() { f32::INFINITY } else { d.max(m) })
}
