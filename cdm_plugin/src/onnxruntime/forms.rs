//! Networks small enough to try in every form: both kinds of feed-forward layer, many sizes, batches, and weights stored in
//! every type, against the official code's outputs. `tests/data/tiny.py` wrote these.

use super::*;
use crate::arch::FeedForward;
use crate::prep::Positions;
use safetensors::tensor::{Dtype, TensorView};
use std::path::PathBuf;

/// The sizes of `tests/data/tiny.py`, height and width.
const SIZES: [(usize, usize); 6] = [(42, 70), (14, 14), (14, 84), (84, 14), (70, 70), (98, 126)];
const FORMS: [(&str, FeedForward); 2] =
    [("tiny_gelu", FeedForward::Gelu { hidden: 64 }), ("tiny_swiglu", FeedForward::SwiGlu { hidden: 48 })];

fn architecture(feed_forward: FeedForward) -> Architecture {
    Architecture {
        width: 16,
        blocks: 4,
        heads: 2,
        feed_forward,
        taps: [0, 1, 2, 3],
        features: 8,
        levels: [4, 6, 8, 10],
        grid: 5,
    }
}

fn file(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("tests/data/{name}.safetensors"))
}

/// The network, or `None` where ONNX Runtime is not installed and not required.
fn open(arch: Architecture, weights: &Arc<Weights>) -> Option<OnnxNetwork> {
    let options = RefinerOptions { threads: 1, ..RefinerOptions::default() };
    let required = std::env::var_os("DEPTHRIG_REQUIRE_ONNXRUNTIME").is_some();
    match OnnxNetwork::with_architecture(arch, weights, "forms", &options) {
        Err(e) if e.kind() == ErrorKind::NoEngine && !required => {
            println!("skipped: {e}");
            None
        }
        other => Some(other.unwrap()),
    }
}

fn run(network: &mut OnnxNetwork, positions: &Positions, shape: NetShape, x: &[f32]) -> Vec<f32> {
    let mut y = vec![f32::NAN; shape.output_len()];
    network.prepare(shape, &positions.at(shape)).unwrap();
    network.run(x, &mut y).unwrap();
    y
}

/// The largest difference; infinite where a number is NaN.
fn difference(a: &[f32], b: &[f32]) -> f32 {
    assert_eq!(a.len(), b.len());
    let differences = a.iter().zip(b).map(|(a, b)| (a - b).abs());
    differences.fold(0.0, |most, d| if d.is_nan() { f32::INFINITY } else { most.max(d) })
}

#[test]
fn every_form_gives_the_official_output_at_every_size() {
    for (name, feed_forward) in FORMS {
        let arch = architecture(feed_forward);
        let weights = Arc::new(Weights::open(file(name)).unwrap());
        let Some(mut network) = open(arch, &weights) else { return };
        let positions = Positions::read(&arch, &weights).unwrap();
        for (height, width) in SIZES {
            let shape = NetShape { batch: 1, height, width };
            let x = weights.to_f32(&format!("x_{height}x{width}")).unwrap();
            let official = weights.to_f32(&format!("y_{height}x{width}")).unwrap();
            let y = run(&mut network, &positions, shape, &x);
            let off = difference(&y, &official);
            assert!(off <= 1e-5, "{name} {height}x{width}: {off:e}");

            let half: Vec<f32> = x.iter().map(|v| v * 0.5).collect();
            let pair = NetShape { batch: 2, ..shape };
            let both = run(&mut network, &positions, pair, &[x, half.clone()].concat());
            let alone = run(&mut network, &positions, shape, &half);
            let off = difference(&both, &[y, alone].concat());
            assert!(off <= 1e-5, "{name} {height}x{width}, a batch of two: {off:e}");
            assert!(difference(&both[..official.len()], &both[official.len()..]) > 0.01, "the inputs differ");
        }
    }
}

/// Writes the numbers of `weights`, rounded to `rounded`, as `stored`.
fn store(arch: &Architecture, weights: &Weights, rounded: Dtype, stored: Dtype, path: &Path) -> Arc<Weights> {
    let mut all = Vec::new();
    for spec in arch.tensors() {
        let numbers = weights.to_f32(&spec.name).unwrap();
        let numbers = numbers.iter().map(|n| match rounded {
            Dtype::BF16 => half::bf16::from_f32(*n).to_f32(),
            _ => half::f16::from_f32(*n).to_f32(),
        });
        let bytes: Vec<u8> = match stored {
            Dtype::F32 => numbers.flat_map(f32::to_le_bytes).collect(),
            Dtype::F16 => numbers.flat_map(|n| half::f16::from_f32(n).to_le_bytes()).collect(),
            _ => numbers.flat_map(|n| half::bf16::from_f32(n).to_le_bytes()).collect(),
        };
        all.push((spec.name, spec.shape, bytes));
    }
    let views = all
        .iter()
        .map(|(name, shape, bytes)| (name.clone(), TensorView::new(stored, shape.clone(), bytes).unwrap()));
    safetensors::serialize_to_file(views, None, path).unwrap();
    Arc::new(Weights::open(path).unwrap())
}

#[test]
fn the_type_in_which_weights_are_stored_changes_nothing() {
    let dir = tempfile::tempdir().unwrap();
    for (name, feed_forward) in FORMS {
        let arch = architecture(feed_forward);
        let weights = Weights::open(file(name)).unwrap();
        let shape = NetShape { batch: 1, height: 42, width: 70 };
        let x = weights.to_f32("x_42x70").unwrap();
        for narrow in [Dtype::F16, Dtype::BF16] {
            let mut outputs = Vec::new();
            for stored in [narrow, Dtype::F32] {
                let path = dir.path().join(format!("{name}-{narrow:?}-{stored:?}.safetensors"));
                let weights = store(&arch, &weights, narrow, stored, &path);
                let Some(mut network) = open(arch, &weights) else { return };
                let positions = Positions::read(&arch, &weights).unwrap();
                outputs.push(run(&mut network, &positions, shape, &x));
            }
            let off = difference(&outputs[0], &outputs[1]);
            assert!(off <= 1e-6, "{name}, {narrow:?} beside F32: {off:e}");
        }
    }
}
