//! The network in pure Rust against the official code's output.

use crate::support::{Tensors, max_abs, seeded_model};
use depthrig_cdm::prep::Positions;
use depthrig_cdm::{CandleNetwork, Encoder, NetShape, Network};

/// The largest difference of `y` from the official one, given the official `x`.
fn difference(network: &mut dyn Network, positions: &Positions, file: &str) -> f32 {
    let tensors = Tensors::open(file);
    let (shape, x) = tensors.get("x");
    let (_, expected) = tensors.get("y");
    let shape = NetShape { batch: 1, height: shape[2], width: shape[3] };
    network.prepare(shape, &positions.at(shape)).unwrap();
    let mut y = vec![f32::NAN; shape.output_len()];
    network.run(&x, &mut y).unwrap();
    let difference = max_abs(&y, &expected);
    println!("{} on {file}: differs by {difference:e} at most", network.describe());
    difference
}

#[test]
fn output_is_the_official_one() {
    let model = seeded_model(Encoder::Vits);
    let positions = Positions::read(&model.encoder.architecture(), &model.weights).unwrap();
    let mut network = CandleNetwork::open(&model, 0).unwrap();
    assert!(difference(&mut network, &positions, "vits_252_d405.safetensors") <= 2e-5);
    assert!(difference(&mut network, &positions, "vits_308_lingbot0.safetensors") <= 5e-5);
}
