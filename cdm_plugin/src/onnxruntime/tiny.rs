//! The network `tiny` in ONNX Runtime, on the CPU: input and output of each size stay bound.
// Runs a session with the library's own function: the wrapper would allocate for every image.
#![allow(unsafe_code)]

use super::device::Device;
use super::kept::Kept;
use super::runtime::Runtime;
use super::{describe_as, failed, session};
use crate::network::ImageNetwork;
use crate::{Error, ErrorKind, RefinerOptions, Result};
use ort::AsPointer;
use ort::memory::Allocator;
use ort::session::{IoBinding, Session};
use ort::value::Tensor;

/// Planes of the input.
const PLANES: usize = 6;

/// The network with its session.
#[derive(Debug)]
pub struct TinyNetwork {
    description: String,
    /// By width and height.
    bound: Kept<(usize, usize), Bound>,
    session: Session,
}

/// Input and output of one size.
#[derive(Debug)]
struct Bound {
    x: Tensor<f32>,
    filled: Tensor<f32>,
    refined: Tensor<f32>,
    binding: IoBinding,
}

impl TinyNetwork {
    /// Loads the library if that was not done yet, and the network of these bytes.
    ///
    /// # Errors
    /// [`ErrorKind::NoEngine`] when no usable library is found, [`ErrorKind::Unsupported`] for another device than
    /// `cpu` or another precision than `fp32`, [`ErrorKind::BadInput`] for an unknown device, and those of the library.
    pub fn open(bytes: &[u8], options: &RefinerOptions) -> Result<Self> {
        let device: Device = options.device.parse()?;
        if device != Device::Cpu {
            let message = format!(
                "the engine tiny runs on the CPU, not on {device}: leave the device out, or use engine = \"onnxruntime\" with a \
                 camera depth model"
            );
            return Err(Error::new(ErrorKind::Unsupported, message));
        }
        device.check(options.precision)?;
        let runtime = Runtime::get(options.library.as_deref(), &device)?;
        let description = describe_as("tiny onnxruntime", &runtime.version, &device, options.precision);
        let session = session::open_bytes(&runtime, bytes, &description, options.thread_count())?;
        Ok(Self { description, bound: Kept::new(), session })
    }

    /// The engine with version, device and precision, such as `tiny onnxruntime 1.31 cpu fp32`; at most 31 bytes.
    pub fn describe(&self) -> &str {
        &self.description
    }

    fn bind(&self, width: usize, height: usize) -> ort::Result<Bound> {
        let memory = Allocator::default();
        let x = Tensor::<f32>::new(&memory, [1, PLANES, height, width])?;
        let filled = Tensor::<f32>::new(&memory, [1, height, width])?;
        let mut refined = Tensor::<f32>::new(&memory, [1, height, width])?;
        let mut binding = self.session.create_binding()?;
        binding.bind_input("x", &x)?;
        binding.bind_input("filled", &filled)?;
        binding.bind_output("refined", &mut refined)?;
        Ok(Bound { x, filled, refined, binding })
    }
}

impl ImageNetwork for TinyNetwork {
    fn inputs(&mut self, width: usize, height: usize) -> Result<(&mut [f32], &mut [f32])> {
        if !self.bound.turn_to(&(width, height)) {
            let bound = self.bind(width, height).map_err(|e| failed(&self.description, "making room", &e))?;
            self.bound.push((width, height), bound);
        }
        let (_, bound) = self.bound.last_mut().ok_or_else(|| not_bound(&self.description))?;
        Ok((bound.x.extract_tensor_mut().1, bound.filled.extract_tensor_mut().1))
    }

    fn run(&mut self) -> Result<&[f32]> {
        let Self { description, bound, session } = self;
        let bound = bound.last().ok_or_else(|| not_bound(description))?;
        // SAFETY: the session and the binding are alive, and the binding is of this session; null stands for no options
        // (`RunWithBinding`, onnxruntime_c_api.h). `&mut self` keeps other threads out. The library writes to the bound output
        // alone, which no reference points to now.
        let ran = unsafe {
            ort::Error::result_from_status((ort::api().RunWithBinding)(
                session.ptr_mut(),
                core::ptr::null(),
                bound.binding.ptr(),
            ))
        };
        ran.map_err(|e| failed(description, "running", &e))?;
        Ok(bound.refined.extract_tensor().1)
    }
}

fn not_bound(description: &str) -> Error {
    Error::new(ErrorKind::BadInput, format!("{description}: run before it was given an image"))
}
