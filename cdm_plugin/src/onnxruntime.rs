//! The network in ONNX Runtime: a native library that is loaded when a model runs, on CPU, CUDA, TensorRT or OpenVINO.

use crate::arch::Architecture;
use crate::onnx::{Attention, Graph, Numbers, Style};
use crate::{
    Error, ErrorKind, Model, NetShape, Network, PositionEmbeddings, Precision, RefinerOptions, Result,
    Weights,
};
use device::Device;
use kept::Kept;
use ort::memory::{AllocationDevice, Allocator, AllocatorType, MemoryInfo, MemoryType};
use ort::session::{IoBinding, Session};
use ort::value::Tensor;
use runtime::Runtime;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use weights::BoundWeights;

pub mod device;
mod kept;
mod library;
mod nvidia;
mod providers;
pub mod runtime;
pub mod session;
mod tiny;
mod weights;

pub use tiny::TinyNetwork;

/// As many bytes as the name of an engine may have.
const NAME_BYTES: usize = 31;

/// Where the library is that `device` would run on, without a look into it; arguments and errors as [`find_library`].
///
/// # Errors
/// [`ErrorKind::NoEngine`] when it is missing, [`ErrorKind::BadInput`] for an unknown device.
pub fn library_file(wanted: Option<&Path>, device: &str) -> Result<PathBuf> {
    library::find(wanted, std::env::var_os(library::VARIABLE).as_deref(), &device.parse()?)
}

/// The version of the library that `device` would run on and where it is, without binding this process to it. `wanted` is
/// the library or its folder; it is looked for without.
///
/// # Errors
/// [`ErrorKind::NoEngine`] when no usable library is found, [`ErrorKind::BadInput`] for an unknown device,
/// [`ErrorKind::Unsupported`] for a precision that the device has not.
pub fn find_library(wanted: Option<&Path>, device: &str, precision: Precision) -> Result<(PathBuf, String)> {
    let device: Device = device.parse()?;
    device.check(precision)?;
    let variable = std::env::var_os(library::VARIABLE);
    let path = library::find(wanted, variable.as_deref(), &device)?;
    let version = library::version(&path)?;
    Ok((path, version))
}

/// The network of one model in ONNX Runtime.
///
/// Weights in 32-bit floats are read where they lie in the mapped file; the library keeps what it rearranged for its
/// kernels beside them.
#[derive(Debug)]
pub struct OnnxNetwork {
    description: String,
    device: Device,
    bound: Kept<NetShape, Bound>,
    /// The last of them is what was prepared last.
    is_prepared: bool,
    session: Session,
    /// After the session, which reads them.
    _weights: BoundWeights,
}

/// Input and output at one size.
#[derive(Debug)]
struct Bound {
    x: Tensor<f32>,
    binding: IoBinding,
}

impl OnnxNetwork {
    /// Loads the library if that was not done yet, and the model into it. `options` give device, precision, threads
    /// and library.
    ///
    /// # Errors
    /// [`ErrorKind::NoEngine`] when no usable library is found, [`ErrorKind::Unsupported`] when it lacks the
    /// device or the precision, [`ErrorKind::BadInput`] for an unknown device, [`ErrorKind::BadModel`] when a tensor
    /// is missing, [`ErrorKind::OutOfMemory`] and [`ErrorKind::Engine`].
    pub fn open(model: &Model, options: &RefinerOptions) -> Result<Self> {
        Self::with_architecture(model.encoder.architecture(), &model.weights, &model.id, options)
    }

    fn with_architecture(
        arch: Architecture,
        weights: &Arc<Weights>,
        id: &str,
        options: &RefinerOptions,
    ) -> Result<Self> {
        let device: Device = options.device.parse()?;
        device.check(options.precision)?;
        let runtime = Runtime::get(options.library.as_deref(), &device)?;
        let graph = Graph::of_architecture(arch, style(&device, options.precision));
        let weights = BoundWeights::new(weights, &graph.weights)?;
        let threads = options.thread_count();
        let session = session::open(&runtime, &graph, (&weights, id), &device, options.precision, threads)?;
        let description = describe(&runtime.version, &device, options.precision);
        Ok(Self { description, device, bound: Kept::new(), is_prepared: false, session, _weights: weights })
    }

    fn bind(&mut self, shape: NetShape, positions: &PositionEmbeddings) -> ort::Result<Bound> {
        let NetShape { batch, height, width } = shape;
        let for_input = match self.device {
            // Pinned memory reaches the device sooner.
            Device::Cuda(n) | Device::TensorRt(n) => {
                let pinned = AllocationDevice::CUDA_PINNED;
                let info = MemoryInfo::new(pinned, n as i32, AllocatorType::Device, MemoryType::CPUInput)?;
                Allocator::new(&self.session, info)?
            }
            Device::Cpu | Device::OpenVino(_) => Allocator::default(),
        };
        let x = Tensor::<f32>::new(&for_input, [batch, 4, height, width])?;
        // Not pinned: with an output there ONNX Runtime 1.31.1 refuses to run ("dst_data != src_data was false").
        let y = Tensor::<f32>::new(&Allocator::default(), [batch, height, width])?;
        let mut binding = self.session.create_binding()?;
        let tokens = 1 + shape.patches();
        for (name, numbers) in [("pos_rgb", &positions.rgb), ("pos_depth", &positions.depth)] {
            let width = numbers.len() / tokens;
            let value = Tensor::from_array(([tokens, width], numbers.clone()))?;
            binding.bind_input(name, &value)?;
        }
        binding.bind_input("x", &x)?;
        binding.bind_output("y", y)?;
        Ok(Bound { x, binding })
    }
}

impl Network for OnnxNetwork {
    fn describe(&self) -> &str {
        &self.description
    }

    fn best_batch(&self) -> usize {
        match self.device {
            // One image keeps a CPU busy; waiting for others would make each later.
            Device::Cpu | Device::OpenVino(_) => 1,
            // Of 1, 2, 4 and 7 images of `vitl` at 518 on an H200, four were quickest an image (docs/performance.md).
            Device::Cuda(_) | Device::TensorRt(_) => 4,
        }
    }

    fn warms_up(&self) -> bool {
        // They compile for each shape. ONNX Runtime itself only makes room, and one image may take seconds.
        self.device != Device::Cpu
    }

    fn prepare(&mut self, shape: NetShape, positions: &PositionEmbeddings) -> Result<()> {
        self.is_prepared = false;
        let patches =
            shape.height.is_multiple_of(crate::arch::PATCH) && shape.width.is_multiple_of(crate::arch::PATCH);
        let tokens = 1 + shape.patches();
        let fits = |numbers: &[f32]| !numbers.is_empty() && numbers.len().is_multiple_of(tokens);
        if shape.input_len() == 0 || !patches || !fits(&positions.rgb) || !fits(&positions.depth) {
            let message = format!(
                "{} images of {}x{} with {} position embeddings do not fit the network, whose sides are \
                 multiples of 14",
                shape.batch,
                shape.width,
                shape.height,
                positions.rgb.len()
            );
            return Err(Error::new(ErrorKind::BadInput, message));
        }
        // The position embeddings of a size are always the same, and stay on the device.
        if !self.bound.turn_to(&shape) {
            let bound =
                self.bind(shape, positions).map_err(|e| failed(&self.description, "making room", &e))?;
            self.bound.push(shape, bound);
        }
        self.is_prepared = true;
        Ok(())
    }

    fn run(&mut self, x: &[f32], y: &mut [f32]) -> Result<()> {
        let Self { description, device, bound, is_prepared, session, .. } = self;
        let not_prepared =
            |what: String| Err(Error::new(ErrorKind::BadInput, format!("{description}: {what}")));
        let Some((shape, Bound { x: input, binding })) = bound.last_mut().filter(|_| *is_prepared) else {
            return not_prepared("run before it was prepared for a size".into());
        };
        if x.len() != shape.input_len() || y.len() != shape.output_len() {
            let height = shape.height;
            let width = shape.width;
            return not_prepared(format!(
                "{} numbers in and {} out do not fit {} images of {width}x{height}",
                x.len(),
                y.len(),
                shape.batch
            ));
        }
        let mut infer = || -> ort::Result<()> {
            input.extract_tensor_mut().1.copy_from_slice(x);
            // Where the device has memory of its own, binding is what copies.
            if matches!(device, Device::Cuda(_) | Device::TensorRt(_)) {
                binding.bind_input("x", input)?;
            }
            let outputs = session.run_binding(binding)?;
            binding.synchronize_outputs()?;
            let (_, numbers) = outputs["y"].try_extract_tensor::<f32>()?;
            if numbers.len() != y.len() {
                return Err(ort::Error::new(format!(
                    "{} numbers came out instead of {}",
                    numbers.len(),
                    y.len()
                )));
            }
            y.copy_from_slice(numbers);
            Ok(())
        };
        infer().map_err(|e| failed(description, "running", &e))
    }
}

/// How the graph is written for a device.
const fn style(device: &Device, precision: Precision) -> Style {
    match (device, precision) {
        (Device::Cuda(_), Precision::Fp16) => Style { attention: Attention::Fused, numbers: Numbers::Fp16 },
        (Device::Cpu | Device::Cuda(_), _) => Style { attention: Attention::Fused, numbers: Numbers::Fp32 },
        // These two take a graph in 32-bit floats and choose the precision themselves, by their options.
        (Device::TensorRt(_) | Device::OpenVino(_), _) => {
            Style { attention: Attention::Standard, numbers: Numbers::Fp32 }
        }
    }
}

/// `onnxruntime 1.31.1 cpu fp32`; with less of the version and of the device when that is too long for a header.
pub fn describe(version: &str, device: &Device, precision: Precision) -> String {
    describe_as("onnxruntime", version, device, precision)
}

/// As [`describe`], for another name of the engine.
fn describe_as(engine: &str, version: &str, device: &Device, precision: Precision) -> String {
    let full = format!("{engine} {version} {device} {precision}");
    if full.len() <= NAME_BYTES {
        return full;
    }
    let version: Vec<&str> = version.split('.').take(2).collect();
    let mut device = device.to_string();
    device.truncate(device.find(':').unwrap_or(device.len()));
    let room = NAME_BYTES.saturating_sub(engine.len() + 3 + device.len() + precision.name().len());
    let mut version = version.join(".");
    version.truncate(room);
    format!("{engine} {version} {device} {precision}")
}

/// Maps an error of the library.
pub fn failed(engine: &str, what: &str, error: &ort::Error) -> Error {
    let text = error.message();
    if let Some((library, cure)) = nvidia::missing(text) {
        let message =
            format!("{engine}: {what} failed, because the library {library} is not there: {cure} ({text})");
        return Error::new(ErrorKind::NoEngine, message);
    }
    if is_memory(text) {
        let message = format!(
            "{engine}: {what} needs more memory than the device has left ({text}); use a smaller input_size, a smaller \
             model or a 16-bit precision, or run fewer models on this device"
        );
        return Error::new(ErrorKind::OutOfMemory, message);
    }
    Error::new(ErrorKind::Engine, format!("{engine}: {what} failed: {text}"))
}

/// Returns whether the text of an error reports too little memory. No error code does; the texts are those of ONNX
/// Runtime's arena (`bfc_arena.cc`), of the C++ library, and of CUDA and cuBLAS.
fn is_memory(text: &str) -> bool {
    const TEXTS: [&str; 7] = [
        "Failed to allocate memory",
        "bad_alloc",
        "bad allocation",
        "out of memory",
        "Available memory of",
        "OUT_OF_MEMORY",
        "ALLOC_FAILED",
    ];
    TEXTS.iter().any(|t| text.contains(t))
}

#[cfg(test)]
mod forms;
#[cfg(test)]
mod tests;
