//! Names and errors; what it computes is tested from outside (`tests/it/onnxruntime.rs`).

use super::*;

#[test]
fn names_fit_into_headers() {
    let of = |version: &str, device: &str, precision| describe(version, &device.parse().unwrap(), precision);
    assert_eq!(of("1.31.1", "cpu", Precision::Fp32), "onnxruntime 1.31.1 cpu fp32");
    assert_eq!(of("1.31.1", "cuda:0", Precision::Fp16), "onnxruntime 1.31.1 cuda:0 fp16");
    assert_eq!(of("1.24.1", "openvino", Precision::Bf16), "onnxruntime 1.24 openvino bf16");
    assert_eq!(of("1.31.1", "tensorrt:7", Precision::Fp16), "onnxruntime 1.31 tensorrt fp16");
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
