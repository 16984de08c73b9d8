//! The network in ONNX Runtime against the official code's numbers, and against itself.

use crate::support::{Tensors, max_abs, seeded_model};
use depthrig_cdm::prep::Positions;
use depthrig_cdm::{Encoder, ErrorKind, Model, NetShape, Network, OnnxNetwork, Precision, RefinerOptions};

fn options(device: &str, precision: Precision) -> RefinerOptions {
    RefinerOptions { device: device.into(), precision, threads: 2, ..RefinerOptions::default() }
}

/// The network on the CPU; `None`, with a line that says so, where the library is not installed. `make test` fetches it
/// and sets `DEPTHRIG_REQUIRE_ONNXRUNTIME`, which makes that a failure.
fn open(model: &Model) -> Option<OnnxNetwork> {
    match OnnxNetwork::open(model, &options("cpu", Precision::Fp32)) {
        Ok(network) => Some(network),
        Err(e)
            if e.kind() == ErrorKind::NoEngine
                && std::env::var_os("DEPTHRIG_REQUIRE_ONNXRUNTIME").is_none() =>
        {
            println!("skipped: {e}");
            None
        }
        Err(e) => panic!("{e}"),
    }
}

fn shape_of(shape: &[usize]) -> NetShape {
    NetShape { batch: shape[0], height: shape[2], width: shape[3] }
}

fn run(network: &mut dyn Network, positions: &Positions, shape: NetShape, x: &[f32]) -> Vec<f32> {
    network.prepare(shape, &positions.at(shape)).unwrap();
    let mut y = vec![f32::NAN; shape.output_len()];
    network.run(x, &mut y).unwrap();
    y
}

/// A picture whose patches all differ.
fn picture(shape: NetShape, seed: usize) -> Vec<f32> {
    let wave = |i: usize| ((i * 37 + seed * 101) % 1009) as f32 / 1009.0;
    let plane = shape.height * shape.width;
    (0..shape.input_len())
        .map(|i| if (i / plane) % 4 == 3 { 2.0 * wave(i) } else { 4.0 * wave(i) - 2.0 })
        .collect()
}

#[test]
fn the_official_numbers() {
    let model = seeded_model(Encoder::Vits);
    let Some(mut network) = open(&model) else { return };
    assert!(network.describe().starts_with("onnxruntime 1.") && network.describe().ends_with(" cpu fp32"));
    let positions = Positions::read(&model.encoder.architecture(), &model.weights).unwrap();
    for (file, bound) in [("vits_252_d405.safetensors", 2e-5), ("vits_308_lingbot0.safetensors", 5e-5)] {
        let tensors = Tensors::open(file);
        let (shape, x) = tensors.get("x");
        let (_, expected) = tensors.get("y");
        let y = run(&mut network, &positions, shape_of(&shape), &x);
        let difference = max_abs(&y, &expected);
        println!("{file}: {difference:e}");
        assert!(difference <= bound, "{file}: {difference:e}");
    }
}
