//! Names and errors; what it computes is tested from outside (`tests/it/onnxruntime.rs`).

use super::*;

#[test]
fn names_fit_into_headers() {
    let of = |version: &str, device: &str, precision| describe(version, &device.parse().unwrap(), precision);
    assert_eq!(of("1.31.1", "cpu", Precision::Fp32), "onnxruntime 1.31.1 cpu fp32");
    assert_eq!(of("1.31.1", "cuda:0", Precision::Fp16), "onnxruntime 1.31.1 cuda:0 fp16");
    assert_eq!(of("1.24.1", "openvino", Precision::Bf16), "onnxruntime 1.24 openvino bf16");
    assert_eq!(of("1.31.1", "tensorrt:7", Precision::Fp16), "onnxruntime 1.31 tensorrt fp16");
    let tiny = |version| describe_as("tiny onnxruntime", version, &Device::Cpu, Precision::Fp32);
    assert_eq!(tiny("1.31.1"), "tiny onnxruntime 1.31 cpu fp32");
    assert!(tiny("1.123.45-dev+20261121").len() <= NAME_BYTES);
    for device in ["cpu", "cuda:12", "tensorrt:12", "openvino:GPU.1", "openvino"] {
        let name = of("1.123.45-dev+20261121", device, Precision::Bf16);
        assert!(name.len() <= NAME_BYTES && name.ends_with("bf16"), "{name}");
    }
}

#[test]
fn too_little_memory_is_told_from_other_failures() {
    for text in [
        "Non-zero status code returned while running Conv node: std::bad_alloc",
        "bfc_arena.cc:376 AllocateRawInternal Failed to allocate memory for requested buffer of size 1288490188800",
        "CUDA failure 2: out of memory ; GPU=0",
        "CUBLAS failure 3: CUBLAS_STATUS_ALLOC_FAILED",
    ] {
        assert!(is_memory(text), "{text}");
    }
    assert!(!is_memory("Got invalid dimensions for input: x"));
}

/// An engine that opens the file finds the numbers that one is given in memory.
#[test]
fn weights_in_a_file_are_those_in_memory() {
    let fixtures = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/torch");
    let slice = |tensor: &str, rows: core::ops::Range<usize>, shape: &[usize]| crate::onnx::WeightSlice {
        initializer: format!("{tensor}{rows:?}"),
        tensor: tensor.into(),
        rows,
        shape: shape.to_vec(),
    };
    for (file, slices, temporary) in [
        ("plain.pth", vec![slice("head.weight", 0..2, &[2, 3]), slice("head.weight", 1..2, &[1, 3])], false),
        ("halves.pth", vec![slice("half", 1..3, &[2]), slice("double", 0..2, &[2])], true),
        ("not_contiguous.pth", vec![slice("transposed", 1..3, &[2, 2])], true),
    ] {
        let weights = Arc::new(Weights::open(fixtures.join(file)).unwrap());
        let bound = BoundWeights::new(&weights, &slices).unwrap();
        let in_file = bound.in_file().unwrap();
        assert_eq!(in_file.is_temporary(), temporary, "{file}");
        let bytes = std::fs::read(std::path::Path::new(in_file.folder()).join(in_file.name())).unwrap();
        for (slice, place) in slices.iter().zip(in_file.places()) {
            let row = slice.shape.iter().skip(1).product::<usize>();
            let expected =
                &weights.to_f32(&slice.tensor).unwrap()[slice.rows.start * row..slice.rows.end * row];
            let numbers: Vec<f32> =
                bytes[place.clone()].as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
            assert_eq!(numbers, expected, "{file}: {}", slice.initializer);
        }
        let folder = in_file.folder().to_owned();
        drop(in_file);
        assert_eq!(std::path::Path::new(&folder).exists(), !temporary, "a temporary file is removed");
    }
}
