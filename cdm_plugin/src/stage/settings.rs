//! Settings of refinement: those of a camera, and those that the cameras of a rig share.

use crate::{FillRefiner, Precision};
use depthrig_bus::PixelFormat;
use std::path::PathBuf;

/// Settings of depth refinement that the cameras of the rig share.
#[derive(Debug, Clone, PartialEq)]
pub struct CdmConfig {
    /// CPU threads of all refiners together; 0: all cores but one.
    pub threads: usize,
    /// The library of ONNX Runtime; `None`: looked for.
    pub library: Option<PathBuf>,
    /// Folder of the installed models; `None`: this user's.
    pub models: Option<PathBuf>,
    /// A refinement slower than this, and than ten times the slowest so far, counts as hung, seconds.
    pub hang_s: f64,
}

/// How a camera's depth is refined.
#[derive(Debug, Clone, PartialEq)]
#[allow(clippy::struct_excessive_bools)] // each is a choice of its own
pub struct RefineConfig {
    /// The engine that runs.
    pub engine: EngineChoice,
    /// The model; `None`: the one for this camera, if it is installed.
    pub model: Option<RefineModel>,
    /// Pairs of images a second at most; 0: every one.
    pub rate_hz: f64,
    /// Shorter side of the network's input, pixels; `None`: the one that the model was trained for.
    pub input_size: Option<u32>,
    /// Precision of the network.
    pub precision: Precision,
    /// Device that it runs on: `cpu`, `cuda:0`, `tensorrt:0`, `openvino`.
    pub device: String,
    /// `Z16` in the unit of the camera's depth, or `DepthF32`.
    pub format: PixelFormat,
    /// How far from measured depth the engines `fill` and `tiny` fill holes, as a part of the image's width, 0 to 1; 1 fills every hole.
    pub fill_reach: f64,
    /// Whether refined depth is recorded.
    pub record: bool,
    /// Whether depth in the view of colour is published as well, as it was before it was refined.
    pub align: bool,
    /// The camera gives depth in the view of colour, whatever calibration says or does not say.
    pub is_aligned: bool,
    /// Depth is corrected by the mount's calibration before it is refined, and before it is published in the view of colour.
    pub corrected: bool,
    /// The stream that is refined.
    pub depth: String,
}

/// Engine that refines depth.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum EngineChoice {
    /// A model for this camera if one is installed and the library is there, else [`Self::Tiny`] if it is a default and the
    /// library is there, else [`Self::Fill`].
    #[default]
    Auto,
    /// Hole filling guided by colour; needs no model.
    Fill,
    /// The small network of this program, after hole filling; needs no model, but ONNX Runtime.
    Tiny,
    /// ONNX Runtime.
    OnnxRuntime,
    /// Nothing: the stream is there and silent.
    Off,
}

/// Which model.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum RefineModel {
    /// An installed one, by name.
    Installed(String),
    /// A checkpoint; absolute.
    File(PathBuf),
}

impl Default for CdmConfig {
    fn default() -> Self {
        Self { threads: 0, library: None, models: None, hang_s: 10.0 }
    }
}

impl Default for RefineConfig {
    fn default() -> Self {
        Self {
            engine: EngineChoice::Auto,
            model: None,
            rate_hz: 5.0,
            input_size: None,
            precision: Precision::Fp32,
            device: "cpu".to_owned(),
            format: PixelFormat::Z16,
            fill_reach: FillRefiner::REACH,
            record: false,
            align: false,
            is_aligned: false,
            corrected: false,
            depth: "depth".to_owned(),
        }
    }
}
