//! `tests/it/candle.rs` compares with the official code's numbers; here is what needs none.

use super::*;
use crate::tiny;

#[test]
fn the_version_that_is_named_is_the_one_that_runs() {
    let lock = concat!(env!("CARGO_MANIFEST_DIR"), "/../Cargo.lock");
    let lock = std::fs::read_to_string(lock).unwrap();
    let (_, rest) = lock.split_once("name = \"candle-core\"\nversion = \"").unwrap();
    let version = rest.split('"').next().unwrap();
    assert_eq!(DESCRIPTION, format!("candle {version} cpu fp32"));
    assert!(DESCRIPTION.len() <= 31);
}

fn tiny() -> CandleNetwork {
    let pool = ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    CandleNetwork::with_architecture(tiny::ARCHITECTURE, &Params::new(&tiny::weights()), pool).unwrap()
}

#[test]
fn a_tiny_network_gives_the_official_output() {
    let difference = tiny::difference(&mut tiny());
    println!("differs by {difference:e} at most");
    assert!(difference <= 5e-6, "{difference:e}");
}

#[test]
fn every_picture_of_a_batch_gets_its_own() {
    let mut network = tiny();
    let weights = tiny::weights();
    let positions = crate::prep::Positions::read(&tiny::ARCHITECTURE, &weights).unwrap();
    let one = tiny::SHAPE;
    let x = weights.to_f32("x").unwrap();
    let other: Vec<f32> = x.iter().map(|v| v * 0.5).collect();
    let mut run = |batch: usize, x: &[f32]| {
        let shape = NetShape { batch, ..one };
        network.prepare(shape, &positions.at(shape)).unwrap();
        let mut y = vec![f32::NAN; shape.output_len()];
        network.run(x, &mut y).unwrap();
        y
    };
    let both = run(2, &[x.clone(), other.clone()].concat());
    assert_eq!(both, [run(1, &x), run(1, &other)].concat());
    assert_ne!(both[..one.output_len()], both[one.output_len()..]);
}

#[test]
fn what_was_not_prepared_is_refused() {
    let mut network = tiny();
    let (x, mut y) = (vec![0.0; tiny::SHAPE.input_len()], vec![0.0; tiny::SHAPE.output_len()]);
    assert_eq!(network.run(&x, &mut y).unwrap_err().kind(), ErrorKind::Engine);
    assert!(tiny::difference(&mut network) < 1.0);
    assert_eq!(network.run(&x[1..], &mut y).unwrap_err().kind(), ErrorKind::Engine);
}

#[test]
fn another_network_is_refused_by_the_name_of_a_tensor() {
    let arch = Architecture { width: 32, ..tiny::ARCHITECTURE };
    let pool = ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let error = CandleNetwork::with_architecture(arch, &Params::new(&tiny::weights()), pool).err().unwrap();
    assert_eq!(error.kind(), ErrorKind::BadModel);
    assert!(error.to_string().contains("pretrained.") && error.to_string().contains("[1, 1, 16]"), "{error}");
}
