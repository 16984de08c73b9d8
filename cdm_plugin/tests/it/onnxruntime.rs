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

/// An image whose patches all differ.
fn image(shape: NetShape, seed: usize) -> Vec<f32> {
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

/// Exports of the official code accept another size and compute something else. Here a size is only a size: the same
/// network object, one after the other, and back again to the first.
#[test]
fn sizes_and_aspects_one_after_the_other() {
    let model = seeded_model(Encoder::Vits);
    let Some(mut network) = open(&model) else { return };
    let positions = Positions::read(&model.encoder.architecture(), &model.weights).unwrap();
    let shapes = [(14, 14), (28, 14), (14, 70), (56, 98), (98, 56), (140, 42), (14, 14), (28, 14)];
    let mut first = Vec::new();
    for (i, (height, width)) in shapes.into_iter().enumerate() {
        let shape = NetShape { batch: 1, height, width };
        let y = run(&mut network, &positions, shape, &image(shape, 1));
        assert!(y.iter().all(|d| d.is_finite() && *d >= 0.0) && y.iter().any(|d| *d > 0.0));
        match i {
            0 | 1 => first.push(y),
            6 | 7 => assert!(y == first[i - 6], "coming back to a size gives the same to the bit"),
            _ => {}
        }
    }
}

#[test]
fn images_of_a_batch_do_not_meet() {
    let model = seeded_model(Encoder::Vits);
    let Some(mut network) = open(&model) else { return };
    let positions = Positions::read(&model.encoder.architecture(), &model.weights).unwrap();
    let one = NetShape { batch: 1, height: 42, width: 70 };
    let a = image(one, 1);
    let b = image(one, 2);
    let alone = [run(&mut network, &positions, one, &a), run(&mut network, &positions, one, &b)].concat();
    let y = run(&mut network, &positions, NetShape { batch: 2, ..one }, &[a, b].concat());
    assert!(max_abs(&alone[..one.output_len()], &alone[one.output_len()..]) > 1e-3, "the two images differ");
    let difference = max_abs(&y, &alone);
    assert!(difference <= 2e-6, "{difference:e}");
}

/// A model that is removed while it is in use goes on: the file stays mapped.
#[test]
fn a_model_removed_while_in_use() {
    let model = seeded_model(Encoder::Vits);
    let dir = tempfile::tempdir().unwrap();
    let copy = dir.path().join("copy.safetensors");
    std::fs::copy(model.weights.path(), &copy).unwrap();
    let model = Model { weights: std::sync::Arc::new(depthrig_cdm::Weights::open(&copy).unwrap()), ..model };
    let Some(mut network) = open(&model) else { return };
    let positions = Positions::read(&model.encoder.architecture(), &model.weights).unwrap();
    let shape = NetShape { batch: 1, height: 28, width: 28 };
    let x = image(shape, 3);
    let before = run(&mut network, &positions, shape, &x);
    std::fs::remove_file(&copy).unwrap();
    drop(model);
    assert!(run(&mut network, &positions, shape, &x) == before);
}

#[test]
fn what_does_not_fit_is_refused_and_the_network_goes_on() {
    let model = seeded_model(Encoder::Vits);
    let Some(mut network) = open(&model) else { return };
    let positions = Positions::read(&model.encoder.architecture(), &model.weights).unwrap();
    let shape = NetShape { batch: 1, height: 28, width: 28 };
    let x = image(shape, 4);
    let mut y = vec![0.0; shape.output_len()];
    let kind = |r: depthrig_cdm::Result<()>| r.unwrap_err().kind();
    assert_eq!(kind(network.run(&x, &mut y)), ErrorKind::BadInput, "not prepared");
    let embeddings = positions.at(shape);
    for wrong in [
        NetShape { height: 29, ..shape },
        NetShape { height: 0, ..shape },
        NetShape { batch: 0, ..shape },
        NetShape { width: 42, ..shape },
    ] {
        assert_eq!(kind(network.prepare(wrong, &embeddings)), ErrorKind::BadInput, "{wrong:?}");
    }
    // No computer has that much.
    let vast = NetShape { batch: 100_000_000_000, ..shape };
    let error = network.prepare(vast, &embeddings).unwrap_err();
    assert_eq!(error.kind(), ErrorKind::OutOfMemory, "{error}");
    assert!(error.to_string().contains("onnxruntime") && error.to_string().contains("input_size"), "{error}");

    network.prepare(shape, &embeddings).unwrap();
    assert_eq!(kind(network.run(&x[1..], &mut y)), ErrorKind::BadInput);
    assert_eq!(kind(network.run(&x, &mut y[1..])), ErrorKind::BadInput);
    network.run(&x, &mut y).unwrap();
    assert!(y.iter().all(|d| d.is_finite()));
}

/// A size that was prepared before is bound already.
#[test]
fn sizes_and_batches_take_turns() {
    let model = seeded_model(Encoder::Vits);
    let Some(mut network) = open(&model) else { return };
    let positions = Positions::read(&model.encoder.architecture(), &model.weights).unwrap();
    let shapes = [(1, 28, 28), (2, 28, 28), (1, 28, 42)].map(|(batch, height, width)| NetShape {
        batch,
        height,
        width,
    });
    let run = |network: &mut OnnxNetwork, shape: NetShape| {
        let mut y = vec![f32::NAN; shape.output_len()];
        network.prepare(shape, &positions.at(shape)).unwrap();
        network.run(&image(shape, 4), &mut y).unwrap();
        y
    };
    let alone = shapes.map(|shape| run(&mut open(&model).unwrap(), shape));
    for _ in 0..2 {
        for (shape, alone) in shapes.iter().zip(&alone) {
            assert!(run(&mut network, *shape) == *alone, "{shape:?}");
        }
    }
    // What failed to be prepared is not run as what was before.
    let wrong = NetShape { height: 29, ..shapes[0] };
    network.prepare(wrong, &positions.at(shapes[0])).unwrap_err();
    let mut y = vec![0.0; shapes[2].output_len()];
    let error = network.run(&image(shapes[2], 4), &mut y).unwrap_err();
    assert_eq!(error.kind(), ErrorKind::BadInput, "{error}");
}

#[test]
fn what_the_library_has_not_is_said() {
    let model = seeded_model(Encoder::Vits);
    let Some(network) = open(&model) else { return };
    if std::path::Path::new("/proc/driver/nvidia").exists() {
        println!("skipped: there is a GPU here");
        return;
    }
    for (device, package) in [("cuda:0", "onnxruntime-gpu"), ("tensorrt:0", "onnxruntime-gpu")] {
        let error = OnnxNetwork::open(&model, &options(device, Precision::Fp32)).unwrap_err();
        assert_eq!(error.kind(), ErrorKind::Unsupported, "{error}");
        assert!(error.to_string().contains(device) && error.to_string().contains(package), "{error}");
    }
    let other = RefinerOptions {
        library: Some("/nowhere/libonnxruntime.so".into()),
        ..options("cpu", Precision::Fp32)
    };
    let error = OnnxNetwork::open(&model, &other).unwrap_err();
    assert_eq!(error.kind(), ErrorKind::NoEngine, "{error}");
    let other = RefinerOptions { library: Some("/bin/sh".into()), ..options("cpu", Precision::Fp32) };
    let error = OnnxNetwork::open(&model, &other).unwrap_err();
    assert_eq!(error.kind(), ErrorKind::Unsupported, "a process runs one library: {error}");
    drop(network);
    assert!(open(&model).is_some(), "and it goes on with that one");
}

#[test]
fn a_tensor_of_another_shape_is_named() {
    let mut model = seeded_model(Encoder::Vits);
    let Some(_) = open(&model) else { return };
    model.encoder = Encoder::Vitb;
    let error = OnnxNetwork::open(&model, &options("cpu", Precision::Fp32)).unwrap_err();
    assert_eq!(error.kind(), ErrorKind::BadModel, "{error}");
    assert!(error.to_string().contains("pretrained."), "{error}");
}

/// Mean of `|a - b| / b`.
fn mean_relative(a: &[f32], b: &[f32]) -> f64 {
    let sum: f64 = a.iter().zip(b).map(|(a, b)| f64::from((a - b).abs() / b.max(1e-3))).sum();
    sum / b.len() as f64
}

/// OpenVINO resizes wrongly in some graphs, by 0.05 1/m. Needs the library of `onnxruntime-openvino`
/// (`tools/onnxruntime.sh openvino`, then `ORT_DYLIB_PATH=target/onnxruntime/openvino`).
#[test]
fn openvino_at_several_sizes_and_with_16_bits() {
    let model = seeded_model(Encoder::Vits);
    let Some(mut reference) = open(&model) else { return };
    let mut exact = match OnnxNetwork::open(&model, &options("openvino", Precision::Fp32)) {
        Ok(network) => network,
        Err(e) => {
            assert_eq!(e.kind(), ErrorKind::Unsupported, "{e}");
            assert!(e.to_string().contains("onnxruntime-openvino"), "{e}");
            println!("skipped: {e}");
            return;
        }
    };
    let positions = Positions::read(&model.encoder.architecture(), &model.weights).unwrap();
    for (height, width) in [(14, 14), (28, 98), (112, 70), (154, 196), (518, 126)] {
        let shape = NetShape { batch: 1, height, width };
        let x = image(shape, 7);
        let expected = run(&mut reference, &positions, shape, &x);
        let difference = max_abs(&run(&mut exact, &positions, shape, &x), &expected);
        println!("openvino fp32 {height}x{width}: {difference:e}");
        assert!(difference <= 2e-5, "{height}x{width}: {difference:e}");
    }
    let mut short = match OnnxNetwork::open(&model, &options("openvino", Precision::Bf16)) {
        Ok(network) => network,
        Err(e) => {
            assert!(e.to_string().contains("AVX512-BF16"), "{e}");
            println!("skipped: {e}");
            return;
        }
    };
    for file in ["vits_252_d405.safetensors", "vits_308_lingbot0.safetensors"] {
        let tensors = Tensors::open(file);
        let (shape, x) = tensors.get("x");
        let (_, expected) = tensors.get("y");
        let y = run(&mut short, &positions, shape_of(&shape), &x);
        let deviation = mean_relative(&y, &expected);
        println!("{}: {file}: {:.3} % on average", short.describe(), 100.0 * deviation);
        assert!(deviation <= 0.003, "{file}: {deviation}");
        assert!(deviation > 1e-5, "{file}: this was not computed in 16 bits");
    }
}
