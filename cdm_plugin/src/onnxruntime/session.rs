//! A session: the graph with its weights on a device, and its options for threads and memory.

use super::device::Device;
use super::runtime::Runtime;
use super::weights::BoundWeights;
use super::{describe, failed};
use crate::onnx::Graph;
use crate::{Error, Precision, Result};
use ort::ep::{self, ArbitrarilyConfigurableExecutionProvider, ExecutionProviderDispatch};
use ort::session::Session;
use ort::session::builder::{GraphOptimizationLevel, SessionBuilder};
use std::path::Path;

/// The setting that names the folder of files with weights (onnxruntime_session_options_config_keys.h).
const WEIGHTS_FOLDER: &str = "session.model_external_initializers_file_folder_path";

/// Loads `graph` onto `device`. The session must not outlive `weights`.
///
/// # Errors
/// [`crate::ErrorKind::OutOfMemory`] and [`crate::ErrorKind::Engine`].
pub fn open(
    runtime: &Runtime,
    graph: &Graph,
    weights: &BoundWeights,
    device: &Device,
    precision: Precision,
    threads: usize,
) -> Result<Session> {
    let name = describe(&runtime.version, device, precision);
    let error = |e: ort::Error| -> Error { failed(&name, "loading the model", &e) };
    let mut builder = builder(runtime, threads).map_err(error)?;
    if let Some(provider) = provider(device, precision, threads) {
        builder = builder.with_execution_providers([provider]).map_err(plain).map_err(error)?;
    }
    if matches!(device, Device::OpenVino(_)) {
        // OpenVINO copies weights in memory into one message of at most 2 GB, but maps a file.
        let file = weights.in_file()?;
        tracing::debug!(
            folder = file.folder(),
            temporary = file.is_temporary(),
            "the engine opens the weights in a file"
        );
        let model = graph.in_file(file.name(), file.places());
        builder = builder.with_config_entry(WEIGHTS_FOLDER, file.folder()).map_err(plain).map_err(error)?;
        return builder.commit_from_memory(&model).map_err(error);
    }
    weights.bind(&mut builder)?.map_err(error)?;
    builder.commit_from_memory(&graph.model).map_err(error)
}

/// Loads the network in `file` onto `device`.
///
/// # Errors
/// As [`open`].
pub fn open_file(runtime: &Runtime, file: &Path, device: &Device, threads: usize) -> Result<Session> {
    let name = describe(&runtime.version, device, Precision::Fp32);
    let error = |e: ort::Error| -> Error { failed(&name, &format!("loading {}", file.display()), &e) };
    let mut builder = builder(runtime, threads).map_err(error)?;
    if let Some(provider) = provider(device, Precision::Fp32, threads) {
        builder = builder.with_execution_providers([provider]).map_err(plain).map_err(error)?;
    }
    builder.commit_from_file(file).map_err(error)
}

/// Loads the network of these bytes onto the CPU, for an engine of this name.
///
/// # Errors
/// As [`open`].
pub fn open_bytes(runtime: &Runtime, bytes: &[u8], name: &str, threads: usize) -> Result<Session> {
    let mut builder = builder(runtime, threads).map_err(|e| failed(name, "loading the model", &e))?;
    builder.commit_from_memory(bytes).map_err(|e| failed(name, "loading the model", &e))
}

fn builder(runtime: &Runtime, threads: usize) -> ort::Result<SessionBuilder> {
    Session::builder(&runtime.environment)?
        .with_optimization_level(GraphOptimizationLevel::All)
        .map_err(plain)?
        .with_intra_threads(threads)
        .map_err(plain)?
        .with_inter_threads(1)
        .map_err(plain)?
        // Threads that spin while they wait would take the cores from capture.
        .with_intra_op_spinning(false)
        .map_err(plain)?
        .with_inter_op_spinning(false)
        .map_err(plain)
}

/// The error without the builder that it carries.
#[allow(clippy::needless_pass_by_value)] // for `map_err`
fn plain(error: ort::Error<SessionBuilder>) -> ort::Error {
    ort::Error::new_with_code(error.code(), error.message())
}

/// Nothing for the CPU, which every session falls back to.
fn provider(device: &Device, precision: Precision, threads: usize) -> Option<ExecutionProviderDispatch> {
    Some(match device {
        Device::Cpu => return None,
        Device::Cuda(n) => ep::CUDA::default()
            .with_device_id(*n as i32)
            // The arena grows by what is asked for, not to the next power of two: models share the device.
            .with_arena_extend_strategy(ep::ArenaExtendStrategy::SameAsRequested)
            .with_conv_algorithm_search(ep::cuda::ConvAlgorithmSearch::Heuristic)
            // Products of 19-bit floats would not be what `fp32` says.
            .with_tf32(false)
            .build()
            .error_on_failure(),
        Device::TensorRt(n) => ep::TensorRT::default()
            .with_device_id(*n as i32)
            .with_fp16(precision == Precision::Fp16)
            .with_bf16(precision == Precision::Bf16)
            // Weights beside the message with the graph, which cannot have more than 2 GB.
            .with_arbitrary_config("trt_load_user_initializer", "1")
            .build()
            .error_on_failure(),
        Device::OpenVino(name) => {
            let hint = match precision {
                Precision::Fp32 => "f32",
                Precision::Fp16 => "f16",
                Precision::Bf16 => "bf16",
            };
            let plugin = name.split('.').next().unwrap_or(name);
            let settings = if plugin == "CPU" {
                // Pinned threads would all sit on the first cores, of every model.
                serde_json::json!({ plugin: {
                    "INFERENCE_PRECISION_HINT": hint,
                    "INFERENCE_NUM_THREADS": threads,
                    "NUM_STREAMS": "1",
                    "ENABLE_CPU_PINNING": false,
                }})
            } else {
                serde_json::json!({ plugin: { "INFERENCE_PRECISION_HINT": hint } })
            };
            ep::OpenVINO::default()
                .with_device_type(name)
                .with_num_threads(threads)
                .with_arbitrary_config("load_config", settings.to_string())
                .build()
                .error_on_failure()
        }
    })
}
