//! Options of a refiner: engine, model, device and precision.

use crate::{Error, ErrorKind, Model, Result};
use core::fmt;
use core::str::FromStr;
use std::path::PathBuf;

/// Engine of a refiner.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum EngineKind {
    /// Holes filled along the edges of colour: needs no model.
    Fill,
    /// The small network of this program in ONNX Runtime, on the CPU.
    Tiny,
    /// The network in ONNX Runtime, a native library that is loaded when it is needed.
    OnnxRuntime,
}

impl EngineKind {
    /// Every engine.
    pub const ALL: [Self; 3] = [Self::Fill, Self::Tiny, Self::OnnxRuntime];

    /// The name used in configuration, on the command line and in headers.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Fill => "fill",
            Self::Tiny => "tiny",
            Self::OnnxRuntime => "onnxruntime",
        }
    }

    /// Whether it needs a model to be named.
    pub const fn needs_model(self) -> bool {
        matches!(self, Self::OnnxRuntime)
    }

    /// Whether it runs in ONNX Runtime.
    pub const fn needs_library(self) -> bool {
        matches!(self, Self::Tiny | Self::OnnxRuntime)
    }
}

impl fmt::Display for EngineKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for EngineKind {
    type Err = Error;

    fn from_str(s: &str) -> Result<Self> {
        Self::ALL.into_iter().find(|e| e.name() == s).ok_or_else(|| {
            let message = format!("unknown engine {s:?}: use fill, tiny or onnxruntime");
            Error::new(ErrorKind::BadInput, message)
        })
    }
}

/// The numbers that a network computes with; its input and output are 32-bit floats always.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// 32-bit floats, as the official code.
    #[default]
    Fp32,
    /// 16-bit floats of IEEE 754.
    Fp16,
    /// 16-bit floats with the exponent of 32-bit ones.
    Bf16,
}

impl Precision {
    /// Every precision.
    pub const ALL: [Self; 3] = [Self::Fp32, Self::Fp16, Self::Bf16];

    /// The name used in configuration, on the command line and in headers.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Fp32 => "fp32",
            Self::Fp16 => "fp16",
            Self::Bf16 => "bf16",
        }
    }
}

impl fmt::Display for Precision {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Precision {
    type Err = Error;

    fn from_str(s: &str) -> Result<Self> {
        Self::ALL.into_iter().find(|p| p.name() == s).ok_or_else(|| {
            let message = format!("unknown precision {s:?}; use fp32, fp16 or bf16");
            Error::new(ErrorKind::BadInput, message)
        })
    }
}

/// Options of a refiner; [`RefinerOptions::default`] is `fill` on the CPU.
#[derive(Debug, Clone)]
pub struct RefinerOptions {
    /// Engine; `None` selects ONNX Runtime if there is a model, else `fill`.
    pub engine: Option<EngineKind>,
    /// The model that `onnxruntime` runs.
    pub model: Option<Model>,
    /// The network that `tiny` runs in place of the one of this program.
    pub tiny: Option<crate::tiny::TinyFile>,
    /// The shorter side of the network's input, pixels, at least 14; `None` is [`Model::input_size`].
    pub input_size: Option<u32>,
    /// The numbers that the network computes with.
    pub precision: Precision,
    /// Where it runs: `cpu`, `cuda:0`, `tensorrt:0`, `openvino`. Only ONNX Runtime knows more than `cpu`.
    pub device: String,
    /// Threads on the CPU, the caller's among them; 0 is as many as this process may use.
    pub threads: usize,
    /// The engine's library, when it is not to be looked for.
    pub library: Option<PathBuf>,
    /// How far from measured depth `fill` and `tiny` fill holes, as a part of the image's width, 0 to 1; 1 fills every hole.
    pub fill_reach: f64,
}

impl Default for RefinerOptions {
    fn default() -> Self {
        Self {
            engine: None,
            model: None,
            tiny: None,
            input_size: None,
            precision: Precision::Fp32,
            device: "cpu".into(),
            threads: 0,
            library: None,
            fill_reach: crate::FillRefiner::REACH,
        }
    }
}

impl RefinerOptions {
    /// The engine that these options come to.
    pub const fn engine_kind(&self) -> EngineKind {
        match (self.engine, &self.model) {
            (Some(engine), _) => engine,
            (None, Some(_)) => EngineKind::OnnxRuntime,
            (None, None) => EngineKind::Fill,
        }
    }

    /// [`Self::threads`] with 0 resolved.
    pub fn thread_count(&self) -> usize {
        match self.threads {
            0 => std::thread::available_parallelism().map_or(1, core::num::NonZero::get),
            n => n,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_those_of_serde_and_of_messages() {
        for engine in EngineKind::ALL {
            assert_eq!(serde_json::to_string(&engine).unwrap(), format!("\"{engine}\""));
            assert_eq!(engine.name().parse::<EngineKind>().unwrap(), engine);
        }
        for precision in Precision::ALL {
            assert_eq!(serde_json::to_string(&precision).unwrap(), format!("\"{precision}\""));
            assert_eq!(precision.name().parse::<Precision>().unwrap(), precision);
        }
        let error = "tensorflow".parse::<EngineKind>().unwrap_err();
        assert!(
            error.to_string().contains("tensorflow") && error.to_string().contains("onnxruntime"),
            "{error}"
        );
        let error = "int8".parse::<Precision>().unwrap_err();
        assert!(error.to_string().contains("int8") && error.to_string().contains("bf16"), "{error}");
    }

    #[test]
    fn without_a_model_it_is_fill() {
        assert_eq!(RefinerOptions::default().engine_kind(), EngineKind::Fill);
        assert!(RefinerOptions::default().thread_count() >= 1);
        let options =
            RefinerOptions { engine: Some(EngineKind::OnnxRuntime), threads: 3, ..Default::default() };
        assert_eq!((options.engine_kind(), options.thread_count()), (EngineKind::OnnxRuntime, 3));
    }
}
