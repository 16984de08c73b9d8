//! A session: the graph with its weights on a device, and its options for threads and memory.

use super::device::Device;
use super::runtime::Runtime;
use super::weights::BoundWeights;
use super::{describe, failed, nvidia, providers};
use crate::onnx::Graph;
use crate::{Error, Precision, Result};
use ort::session::Session;
use ort::session::builder::{GraphOptimizationLevel, SessionBuilder};
use std::path::Path;

/// The setting that names the folder of files with weights (onnxruntime_session_options_config_keys.h).
const WEIGHTS_FOLDER: &str = "session.model_external_initializers_file_folder_path";

/// Loads `graph` onto `device`. The session must not outlive `weights`, which are of the model of this id.
///
/// # Errors
/// [`crate::ErrorKind::NoEngine`] for a library of the device that is missing, [`crate::ErrorKind::OutOfMemory`] and [`crate::ErrorKind::Engine`].
pub fn open(
    runtime: &Runtime,
    graph: &Graph,
    (weights, id): (&BoundWeights, &str),
    device: &Device,
    precision: Precision,
    threads: usize,
) -> Result<Session> {
    let name = describe(&runtime.version, device, precision);
    let error = |e: ort::Error| -> Error { failed(&name, "loading the model", &e) };
    let mut builder = builder(runtime, threads).map_err(error)?;
    let cache = if let Device::TensorRt(_) = device { providers::cache_folder(id) } else { None };
    builder = with_device(builder, runtime, device, precision, threads, cache.as_deref()).map_err(error)?;
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
    builder = with_device(builder, runtime, device, Precision::Fp32, threads, None).map_err(error)?;
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

/// The builder with the providers of `device`.
fn with_device(
    builder: SessionBuilder,
    runtime: &Runtime,
    device: &Device,
    precision: Precision,
    threads: usize,
    cache: Option<&Path>,
) -> ort::Result<SessionBuilder> {
    if let Device::Cuda(_) | Device::TensorRt(_) = device {
        let loaded = nvidia::preload(&runtime.path, matches!(device, Device::TensorRt(_)));
        tracing::debug!(libraries = loaded.len(), "loaded from NVIDIA's wheels");
    }
    let all = providers::providers(device, precision, threads, cache);
    if all.is_empty() {
        return Ok(builder);
    }
    let dispatches: Vec<_> = all.iter().enumerate().map(|(i, p)| p.dispatch(i == 0)).collect();
    builder.with_execution_providers(dispatches).map_err(plain)
}

/// The error without the builder that it carries.
#[allow(clippy::needless_pass_by_value)] // for `map_err`
fn plain(error: ort::Error<SessionBuilder>) -> ort::Error {
    ort::Error::new_with_code(error.code(), error.message())
}
