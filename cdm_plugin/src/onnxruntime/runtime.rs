//! ONNX Runtime within this process: loaded once, from one library, for every model.

use super::device::Device;
use super::library;
use crate::{Error, ErrorKind, Result};
use depthrig_bus::sync::lock;
use ort::ep::ExecutionProvider;
use ort::logging::LogLevel;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

/// The library that this process runs.
#[derive(Debug, Clone)]
pub struct Runtime {
    /// The file.
    pub path: PathBuf,
    /// Its version, such as `1.31.1`.
    pub version: String,
    /// Environment of all sessions. `ort` allows one per process, and none after it is dropped: it is kept forever.
    pub environment: ort::environment::Environment,
}

/// The library that this process has loaded. It can neither be unloaded nor loaded twice.
static LOADED: Mutex<Option<Result<Runtime>>> = Mutex::new(None);

impl Runtime {
    /// The library for `device`, loaded now unless one is already.
    ///
    /// # Errors
    /// [`ErrorKind::NoEngine`] when no usable library is found, [`ErrorKind::Unsupported`] when the one that this
    /// process runs is another than `wanted` or does not have the device.
    pub fn get(wanted: Option<&Path>, device: &Device) -> Result<Self> {
        let mut loaded = lock(&LOADED);
        let runtime = if let Some(runtime) = &*loaded {
            let runtime = runtime.clone()?;
            if let Some(wanted) = wanted {
                runtime.is(&library::find(Some(wanted), None, device)?)?;
            }
            runtime
        } else {
            let variable = std::env::var_os(library::VARIABLE);
            let path = library::find(wanted, variable.as_deref(), device)?;
            let version = library::version(&path)?;
            // From here on the process is bound to this library, whatever comes of it.
            let runtime = start(path, version);
            *loaded = Some(runtime.clone());
            runtime?
        };
        drop(loaded);
        runtime.check(device)?;
        Ok(runtime)
    }

    fn is(&self, wanted: &Path) -> Result<()> {
        let same = |a: &Path, b: &Path| match (a.canonicalize(), b.canonicalize()) {
            (Ok(a), Ok(b)) => a == b,
            _ => a == b,
        };
        if same(&self.path, wanted) {
            return Ok(());
        }
        let message = format!(
            "{} cannot be used: this process runs ONNX Runtime from {} already, and one process runs one; use one \
             library for all cameras, or start again",
            wanted.display(),
            self.path.display()
        );
        Err(Error::new(ErrorKind::Unsupported, message))
    }

    fn check(&self, device: &Device) -> Result<()> {
        let there = match device {
            Device::Cpu => Ok(true),
            Device::Cuda(_) => ort::ep::CUDA::is_available(),
            Device::TensorRt(_) => ort::ep::TensorRT::is_available(),
            Device::OpenVino(_) => ort::ep::OpenVINO::is_available(),
        };
        if matches!(there, Ok(true)) {
            return Ok(());
        }
        let message = format!(
            "ONNX Runtime {} at {} does not have the device {device} ({}). Its package {} has: run \
             `tools/onnxruntime.sh {}` in a checkout, or install it with pip; then start again with {} or the setting \
             `library` set to its folder",
            self.version,
            self.path.display(),
            device.provider(),
            device.package(),
            device.variants()[0],
            library::VARIABLE,
        );
        Err(Error::new(ErrorKind::Unsupported, message))
    }
}

fn start(path: PathBuf, version: String) -> Result<Runtime> {
    let failed = |what: String| {
        let message = format!("ONNX Runtime {version} at {} did not start: {what}", path.display());
        Error::new(ErrorKind::NoEngine, message)
    };
    let environment = ort::init_from(&path)
        .map_err(|e| failed(e.to_string()))?
        .with_name("depthrig")
        .with_telemetry(false)
        .with_logger(Arc::new(log))
        .build()
        .map_err(|e| failed(e.to_string()))?;
    environment.set_log_level(LogLevel::Warning);
    tracing::info!(version, library = %path.display(), "ONNX Runtime is loaded");
    Ok(Runtime { path, version, environment })
}

/// Logs the library's messages one level lower than it does: important ones also come back as an error.
fn log(level: LogLevel, _category: &str, _id: &str, _place: &str, message: &str) {
    match level {
        // cuDNN, of each way to compute a convolution that it tries and lacks: two dozen lines for `vitl`, which runs.
        LogLevel::Error if message.starts_with("[cudnn_frontend]") => {
            tracing::debug!(target: "onnxruntime", "{message}");
        }
        LogLevel::Error | LogLevel::Fatal => tracing::warn!(target: "onnxruntime", "{message}"),
        LogLevel::Warning => tracing::debug!(target: "onnxruntime", "{message}"),
        _ => tracing::trace!(target: "onnxruntime", "{message}"),
    }
}
