//! The modes that depth is made in: presets of the repository's own matching, and a network that the user has.

use super::ZedReplayOptions;
use core::fmt;
use core::str::FromStr;
use depthrig_calib::Rectifier;
use depthrig_calib::stereo::{Description, Matcher, Preset};
use depthrig_cdm::{NetworkPixels, StereoNetwork, StereoNetworkOptions};
use depthrig_drivers::stereo::{Geometry, StereoMode};
use depthrig_recorder::{Error, ErrorKind, Result};
use std::path::PathBuf;

/// A way to make depth, named after the vendor's mode that it stands in for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Mode {
    /// A preset of the stereo engine: `performance`, `quality` or `ultra`.
    Preset(Preset),
    /// A stereo network that the user has.
    Neural,
}

impl Mode {
    /// All of them.
    pub const ALL: [Self; 4] = [
        Self::Preset(Preset::Performance),
        Self::Preset(Preset::Ultra),
        Self::Preset(Preset::Quality),
        Self::Neural,
    ];

    /// Its name, which ends the names of its streams.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Preset(preset) => preset.name(),
            Self::Neural => "neural",
        }
    }

    /// What recordings call it: it is nobody's closed algorithm.
    pub fn recorded_name(self) -> String {
        format!("mimic_{}", self.name())
    }
}

impl fmt::Display for Mode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

impl FromStr for Mode {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        Self::ALL.into_iter().find(|m| m.name() == text).ok_or_else(|| {
            let known: Vec<_> = Self::ALL.iter().map(|m| m.name()).collect();
            let what = format!("there is no mode {text:?}; it is one of: {}", known.join(", "));
            Error::new(ErrorKind::BadInput, what)
        })
    }
}

/// The network of the mode `neural`.
#[derive(Debug, Clone, PartialEq)]
pub struct NetworkChoice {
    /// The ONNX file.
    pub file: PathBuf,
    /// The library of ONNX Runtime or its folder; looked for without.
    pub library: Option<PathBuf>,
    /// What it runs on, such as `cpu` or `cuda:0`.
    pub device: String,
    /// The numbers that it takes pixels as; what the file says without, and 0 to 255 when it says nothing.
    pub pixels: Option<NetworkPixels>,
    /// It gives disparity as a negative number.
    pub negative: bool,
}

type Make = Box<dyn Fn() -> Result<Box<dyn Matcher>> + Send + Sync>;

/// Makes the matchers of a mode.
pub(super) struct ModeMaker {
    /// The end of its streams' names.
    pub(super) name: String,
    /// What recordings call it.
    pub(super) recorded: String,
    pub(super) description: Description,
    /// Matchers at once at most, whatever memory there is.
    pub(super) most: usize,
    make: Make,
}

impl ModeMaker {
    /// With its first matcher, which tells what they all are.
    pub(super) fn new(
        name: &str,
        recorded: String,
        most: usize,
        make: Make,
    ) -> Result<(Self, Box<dyn Matcher>)> {
        let first = make()?;
        let description = first.describe();
        Ok((Self { name: name.to_owned(), recorded, description, most, make }, first))
    }

    pub(super) fn make(&self) -> Result<Box<dyn Matcher>> {
        (self.make)()
    }
}

/// What matchers need to know of the rectified pairs.
pub(super) fn geometry(rectifier: &Rectifier) -> Geometry {
    let ((width, height), focal_px) = (rectifier.size(), rectifier.intrinsics().fx);
    Geometry { width: width as usize, height: height as usize, focal_px, baseline_m: rectifier.baseline_m() }
}

fn failed(mode: Mode, e: &dyn fmt::Display) -> Error {
    Error::new(ErrorKind::BadInput, format!("mode {mode}: {e}"))
}

/// The mode for pictures of the rectifier's size.
pub(super) fn open(
    mode: Mode,
    rectifier: &Rectifier,
    options: &ZedReplayOptions,
) -> Result<(ModeMaker, Box<dyn Matcher>)> {
    let (width, height) = rectifier.size();
    let (width, height, threads) = (width as usize, height as usize, options.threads.max(1));
    match mode {
        Mode::Preset(preset) => {
            let (made, geometry) =
                (StereoMode::preset(preset, options.range_m.0, threads), geometry(rectifier));
            let make = move || (made.make)(&geometry).map_err(|e| failed(mode, &e).with_source(e));
            ModeMaker::new(mode.name(), mode.recorded_name(), usize::MAX, Box::new(make))
        }
        Mode::Neural => {
            let Some(choice) = options.network.clone() else {
                return Err(failed(mode, &NO_NETWORK));
            };
            // A network keeps its threads busy with one picture; a second one would take as much memory again.
            let threads = options.jobs.max(1) * threads;
            let make = move || {
                let options = StereoNetworkOptions {
                    library: choice.library.clone(),
                    device: choice.device.clone(),
                    threads,
                    pixels: choice.pixels,
                    negative: choice.negative,
                };
                let opened = StereoNetwork::open(&choice.file, (width, height), &options);
                opened.map(|m| Box::new(m) as Box<dyn Matcher>).map_err(|e| failed(mode, &e).with_source(e))
            };
            ModeMaker::new(mode.name(), mode.recorded_name(), 1, Box::new(make))
        }
    }
}

/// Why there is no mode `neural`.
pub(super) const NO_NETWORK: &str = "unavailable, because no network was given: the vendor's is closed and is not \
    here. Give a stereo network of your own in ONNX form with --network FILE.onnx";
