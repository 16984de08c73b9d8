//! The network in pure Rust against the official code's output.

use crate::support::{Pair, Tensors, max_abs, seeded_model};
use depthrig_cdm::prep::Positions;
use depthrig_cdm::{
    CandleNetwork, Encoder, EngineKind, ErrorKind, Job, NetShape, Network, Output, Precision, RefinerOptions,
    StepTimes, refiner,
};

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

/// From pictures to the official code's result, through the factory, for two cameras that take turns.
#[test]
fn a_refiner_gives_the_official_depth() {
    let model = seeded_model(Encoder::Vits);
    let options = RefinerOptions {
        engine: Some(EngineKind::Candle),
        model: Some(model.clone()),
        input_size: Some(252),
        ..RefinerOptions::default()
    };
    let mut refiner = refiner(&options).unwrap();
    assert_eq!(refiner.describe().engine, "candle 0.11.1 cpu fp32");
    assert_eq!(refiner.describe().model, model.id);
    let pair = Pair::d405();
    let (_, expected) = Tensors::open("vits_252_d405.safetensors").get("inv_full");
    let mut inverse = vec![f32::NAN; expected.len()];
    let mut jobs = [Job {
        color: pair.color(),
        depth: pair.depth(),
        out: Output::Inverse(&mut inverse),
        steps: StepTimes::default(),
    }];
    refiner.refine(&mut jobs).unwrap();
    let steps = jobs[0].steps;
    assert!(steps.infer_ns > steps.prepare_ns && steps.infer_ns > steps.finish_ns, "{steps:?}");
    let difference = max_abs(&inverse, &expected);
    println!("from the pictures: differs by {difference:e} at most");
    assert!(difference <= 2e-5, "{difference:e}");

    for (precision, device) in [(Precision::Bf16, "cpu"), (Precision::Fp32, "cuda:0")] {
        let options = RefinerOptions { precision, device: device.into(), ..options.clone() };
        let error = depthrig_cdm::refiner(&options).err().unwrap();
        assert!(error.kind() == ErrorKind::Unsupported && error.to_string().contains(device), "{error}");
    }
}
