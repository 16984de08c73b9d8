//! Where ONNX Runtime runs the network, by the names that configuration uses.

use crate::{Error, ErrorKind, Precision, Result};
use core::fmt;
use core::str::FromStr;

/// A device, and the execution provider of ONNX Runtime that stands for it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Device {
    /// ONNX Runtime's own code for the CPU.
    Cpu,
    /// An NVIDIA GPU by its number.
    Cuda(u32),
    /// An NVIDIA GPU by its number, through TensorRT.
    TensorRt(u32),
    /// OpenVINO and the name that it has for the device, such as `CPU` or `GPU.0`.
    OpenVino(String),
}

impl Device {
    /// The provider that a library must have.
    pub const fn provider(&self) -> &'static str {
        match self {
            Self::Cpu => "CPUExecutionProvider",
            Self::Cuda(_) => "CUDAExecutionProvider",
            Self::TensorRt(_) => "TensorrtExecutionProvider",
            Self::OpenVino(_) => "OpenVINOExecutionProvider",
        }
    }

    /// The package on PyPI whose library has it.
    pub const fn package(&self) -> &'static str {
        match self {
            Self::Cpu => "onnxruntime",
            Self::Cuda(_) | Self::TensorRt(_) => "onnxruntime-gpu",
            Self::OpenVino(_) => "onnxruntime-openvino",
        }
    }

    /// The folders of `tools/onnxruntime.sh` to look into, best first.
    pub const fn variants(&self) -> [&'static str; 3] {
        match self {
            Self::Cpu => ["cpu", "gpu", "openvino"],
            Self::Cuda(_) | Self::TensorRt(_) => ["gpu", "cpu", "openvino"],
            Self::OpenVino(_) => ["openvino", "cpu", "gpu"],
        }
    }

    /// Whether this device computes in `precision`.
    ///
    /// # Errors
    /// [`ErrorKind::Unsupported`] with what to use instead.
    pub fn check(&self, precision: Precision) -> Result<()> {
        let refuse = |why: &str| {
            let message = format!("{precision} on the device {self}: {why}");
            Err(Error::new(ErrorKind::Unsupported, message))
        };
        match (self, precision) {
            (Self::Cpu, Precision::Fp16 | Precision::Bf16) => refuse(
                "ONNX Runtime itself has only fp32 there; use the device openvino with precision bf16, on a CPU that \
                 has AVX512-BF16 or AMX",
            ),
            (Self::Cuda(_), Precision::Bf16) => {
                refuse("not every operation has a kernel for it there; use fp16, or the device tensorrt")
            }
            (Self::OpenVino(device), Precision::Fp16) if device == "CPU" => {
                refuse("OpenVINO would quietly compute in another precision; use bf16")
            }
            (Self::OpenVino(device), Precision::Bf16) if device == "CPU" && !cpu_has_bf16() => {
                refuse("this CPU has neither AVX512-BF16 nor AMX and would emulate it; use fp32")
            }
            _ => Ok(()),
        }
    }
}

/// Whether the CPU multiplies 16-bit floats of the bf16 kind.
fn cpu_has_bf16() -> bool {
    #[cfg(target_arch = "x86_64")]
    {
        // Every CPU with AMX has it as well.
        std::is_x86_feature_detected!("avx512bf16")
    }
    #[cfg(not(target_arch = "x86_64"))]
    {
        false
    }
}

impl fmt::Display for Device {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Cpu => f.write_str("cpu"),
            Self::Cuda(n) => write!(f, "cuda:{n}"),
            Self::TensorRt(n) => write!(f, "tensorrt:{n}"),
            Self::OpenVino(device) if device == "CPU" => f.write_str("openvino"),
            Self::OpenVino(device) => write!(f, "openvino:{device}"),
        }
    }
}

impl FromStr for Device {
    type Err = Error;

    fn from_str(s: &str) -> Result<Self> {
        let (name, number) = s.split_once(':').map_or((s, None), |(name, rest)| (name, Some(rest)));
        let index = || number.map_or(Some(0), |n| n.parse().ok());
        let device = match (name, number) {
            ("cpu", None) => Some(Self::Cpu),
            ("cuda", _) => index().map(Self::Cuda),
            ("tensorrt", _) => index().map(Self::TensorRt),
            ("openvino", None) => Some(Self::OpenVino("CPU".into())),
            // No other characters are in names of devices, and the name goes into a file of settings.
            ("openvino", Some(d))
                if !d.is_empty() && d.chars().all(|c| c.is_ascii_alphanumeric() || c == '.') =>
            {
                Some(Self::OpenVino(d.to_ascii_uppercase()))
            }
            _ => None,
        };
        device.ok_or_else(|| {
            let message = format!(
                "unknown device {s:?}; use cpu, cuda, cuda:1, tensorrt, tensorrt:1, openvino (on the CPU) or \
                 openvino:GPU"
            );
            Error::new(ErrorKind::BadInput, message)
        })
    }
}
