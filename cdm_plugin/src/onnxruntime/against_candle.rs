//! ONNX Runtime against the network in pure Rust, on networks small enough to be tried in every form: both kinds of
//! feed-forward layer, widths that are not alike, many sizes, batches, and weights stored in every way.
//!
//! The two engines share no code beyond the names of the tensors, so that a mistake would have to be made twice.

use super::*;
use crate::CandleNetwork;
use crate::arch::FeedForward;
use crate::prep::Positions;
use safetensors::tensor::{Dtype as StoredAs, TensorView};
use std::path::Path;

fn tiny(feed_forward: FeedForward) -> Architecture {
    Architecture {
        width: 24,
        blocks: 5,
        heads: 3,
        feed_forward,
        taps: [0, 2, 3, 4],
        features: 8,
        levels: [4, 6, 10, 12],
        grid: 5,
    }
}

/// Numbers of one sign and another that add up to about 1 in a layer.
fn weights(arch: &Architecture, stored: StoredAs, path: &Path) -> Arc<Weights> {
    let mut state = 1u64;
    let mut next = move || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) as f32 / (1u64 << 30) as f32 - 1.0
    };
    let mut all = Vec::new();
    for spec in arch.tensors() {
        let count: usize = spec.shape.iter().product();
        let fan = spec.shape.iter().skip(1).product::<usize>().max(1) as f32;
        let (middle, spread) = match &*spec.name {
            n if n.contains("norm") && n.ends_with("weight") => (1.0, 0.3),
            n if n.ends_with("output_conv2.2.bias") => (1.0, 0.1),
            n if n.ends_with("bias") => (0.0, 0.3),
            _ => (0.0, 1.7 / fan.sqrt()),
        };
        let numbers = (0..count).map(|_| middle + spread * next());
        let bytes: Vec<u8> = match stored {
            StoredAs::F32 => numbers.flat_map(f32::to_le_bytes).collect(),
            StoredAs::F16 => numbers.flat_map(|n| half::f16::from_f32(n).to_le_bytes()).collect(),
            _ => numbers.flat_map(|n| half::bf16::from_f32(n).to_le_bytes()).collect(),
        };
        all.push((spec.name, spec.shape, bytes));
    }
    let views: Vec<_> = all
        .iter()
        .map(|(name, shape, bytes)| (name.clone(), TensorView::new(stored, shape.clone(), bytes).unwrap()))
        .collect();
    safetensors::serialize_to_file(views, None, path).unwrap();
    Arc::new(Weights::open(path).unwrap())
}

/// The largest difference and the largest value.
fn compare(a: &mut OnnxNetwork, b: &mut CandleNetwork, positions: &Positions, shape: NetShape) -> (f32, f32) {
    let wave = |i: usize| ((i * 7919) % 1013) as f32 / 506.0 - 1.0;
    let x: Vec<f32> = (0..shape.input_len()).map(wave).collect();
    let run = |network: &mut dyn Network| {
        let mut y = vec![f32::NAN; shape.output_len()];
        network.prepare(shape, &positions.at(shape)).unwrap();
        network.run(&x, &mut y).unwrap();
        y
    };
    let (ya, yb) = (run(a), run(b));
    let largest = |values: &mut dyn Iterator<Item = f32>| {
        values.fold(0f32, |m, v| if v.is_nan() { f32::NAN } else { m.max(v) })
    };
    (largest(&mut ya.iter().zip(&yb).map(|(a, b)| (a - b).abs())), largest(&mut yb.iter().copied()))
}

#[test]
fn every_form_at_many_sizes() {
    let options = RefinerOptions { threads: 1, ..RefinerOptions::default() };
    let dir = tempfile::tempdir().unwrap();
    for (i, (feed_forward, stored)) in [
        (FeedForward::Gelu { hidden: 40 }, StoredAs::F32),
        (FeedForward::SwiGlu { hidden: 20 }, StoredAs::F32),
        (FeedForward::Gelu { hidden: 40 }, StoredAs::F16),
        (FeedForward::SwiGlu { hidden: 20 }, StoredAs::BF16),
    ]
    .into_iter()
    .enumerate()
    {
        let arch = tiny(feed_forward);
        let weights = weights(&arch, stored, &dir.path().join(format!("{i}.safetensors")));
        let mut onnx = match OnnxNetwork::with_architecture(arch, &weights, &options) {
            Err(e)
                if e.kind() == ErrorKind::NoEngine
                    && std::env::var_os("DEPTHRIG_REQUIRE_ONNXRUNTIME").is_none() =>
            {
                println!("skipped: {e}");
                return;
            }
            other => other.unwrap(),
        };
        let mut candle = CandleNetwork::of(arch, &weights, 1).unwrap();
        let positions = Positions::read(&arch, &weights).unwrap();
        for (batch, height, width) in
            [(1, 14, 14), (1, 14, 84), (1, 112, 14), (2, 42, 70), (1, 70, 70), (3, 28, 56), (1, 126, 182)]
        {
            let shape = NetShape { batch, height, width };
            let (difference, largest) = compare(&mut onnx, &mut candle, &positions, shape);
            assert!(largest > 0.1, "{shape:?}: there is something to compare");
            assert!(
                difference <= 1e-5 * largest.max(1.0),
                "{feed_forward:?} {stored:?} {shape:?}: {difference:e}"
            );
        }
    }
}
