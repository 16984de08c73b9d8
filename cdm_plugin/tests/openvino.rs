//! The network on OpenVINO: in a process of its own, because one process runs one ONNX Runtime.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used, clippy::print_stdout)]

use depthrig_cdm::prep::Positions;
use depthrig_cdm::weights::write_seeded;
use depthrig_cdm::{
    Encoder, ErrorKind, Model, NetShape, Network, OnnxNetwork, Precision, RefinerOptions, Weights,
};
use std::path::Path;

/// Output of the network on `device`; prints a line and returns `None` if the library is not installed.
fn result(model: &Model, device: &str, shape: NetShape) -> Option<Vec<f32>> {
    let library = Path::new(env!("CARGO_MANIFEST_DIR")).join("../target/onnxruntime/openvino");
    let options = RefinerOptions {
        device: device.into(),
        precision: Precision::Fp32,
        threads: 2,
        library: Some(library),
        ..RefinerOptions::default()
    };
    let mut network = match OnnxNetwork::open(model, &options) {
        Err(e) if e.kind() == ErrorKind::NoEngine => {
            println!("skipped: {e}");
            return None;
        }
        network => network.unwrap(),
    };
    let positions = Positions::read(&model.encoder.architecture(), &model.weights).unwrap();
    network.prepare(shape, &positions.at(shape)).unwrap();
    let x: Vec<f32> = (0..shape.input_len()).map(|i| ((i * 37) % 1009) as f32 / 505.0 - 1.0).collect();
    let mut y = vec![f32::NAN; shape.output_len()];
    network.run(&x, &mut y).unwrap();
    Some(y)
}

/// The encoder of every published model has more weights than fit into one message, which may have 2 GB. It takes 9 GB of
/// memory, so that `make test` tries the smallest, whose weights go the same way, and `make test-long` this one as well.
#[test]
fn weights_of_every_size_are_taken_from_their_file() {
    let long = std::env::var_os("DEPTHRIG_LONG").is_some_and(|v| v == "1");
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("seeded.safetensors");
    let shape = NetShape { batch: 1, height: 70, width: 112 };
    for encoder in [Some(Encoder::Vits), long.then_some(Encoder::Vitl)].into_iter().flatten() {
        write_seeded(encoder, 3, &path).unwrap();
        assert!(encoder != Encoder::Vitl || Weights::open(&path).unwrap().file_bytes() > 2 << 30);
        let model = Model::from_file(&path).unwrap();
        let Some(openvino) = result(&model, "openvino", shape) else { return };
        let cpu = result(&model, "cpu", shape).unwrap();
        let off = cpu.iter().zip(&openvino).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        println!("{encoder}: {off:e}");
        assert!(off < 1e-4 && cpu.iter().all(|d| d.is_finite()), "{encoder}: {off:e}");
    }
}
