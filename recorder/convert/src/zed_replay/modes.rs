//! The modes that depth is computed in: presets of the repository's own matching, and a network that the user has.

use super::ZedReplayOptions;
use depthrig_calib::Rectifier;
use depthrig_calib::stereo::{
    Description, DisparityMap, Matcher, Parameters, Preset, SgmPresets, StereoPair,
};
use depthrig_cdm::{NetworkPixels, StereoNetwork, StereoNetworkOptions};
use depthrig_recorder::{Error, ErrorKind, Result};
use depthrig_stereo::{Geometry, Mode};
use std::path::PathBuf;

/// The network of the mode `neural`.
#[derive(Debug, Clone, PartialEq)]
pub struct NetworkChoice {
    /// The ONNX file.
    pub file: PathBuf,
    /// The library of ONNX Runtime or its folder; looked for without.
    pub library: Option<PathBuf>,
    /// Device that it runs on, such as `cpu` or `cuda:0`.
    pub device: String,
    /// Range of pixel values that it takes; without it the one of the file, or 0 to 255 when the file names none.
    pub pixels: Option<NetworkPixels>,
    /// It gives disparity as a negative number.
    pub negative: bool,
}

/// Computes depth of one pair at a time, in one mode or in several at once.
pub(super) enum Worker {
    /// One mode.
    One(Box<dyn Matcher>),
    /// Presets that share their matching.
    Presets(Box<SgmPresets>),
}

impl Worker {
    /// Fills a map for each of its modes.
    pub(super) fn run(
        &mut self,
        pair: &StereoPair<'_>,
        out: &mut [DisparityMap],
    ) -> depthrig_calib::Result<()> {
        match (self, out) {
            (Self::One(matcher), [out]) => matcher.run(pair, out),
            (Self::Presets(presets), out) => presets.run(pair, out),
            (Self::One(_), out) => {
                let what = format!("{} maps for one mode", out.len());
                Err(depthrig_calib::Error::new(depthrig_calib::ErrorKind::SizeMismatch, what))
            }
        }
    }

    fn describe(&self) -> Vec<Description> {
        match self {
            Self::One(matcher) => vec![matcher.describe()],
            Self::Presets(presets) => presets.describe(),
        }
    }
}

type Make = Box<dyn Fn() -> Result<Worker> + Send + Sync>;

/// Facts about a mode.
pub(super) struct ModeFacts {
    /// The end of its streams' names.
    pub(super) name: &'static str,
    /// Its name in recordings.
    pub(super) recorded: String,
    pub(super) description: Description,
}

/// Modes that one matching gives.
pub(super) struct Group {
    /// Numbers of its modes, rising.
    pub(super) modes: Vec<usize>,
    /// Their names, for messages.
    pub(super) name: String,
    /// Workers at once at most, whatever memory there is.
    pub(super) most: usize,
    /// Bytes that each takes.
    pub(super) memory_bytes: u64,
    make: Make,
}

impl Group {
    pub(super) fn make(&self) -> Result<Worker> {
        (self.make)()
    }
}

/// All modes that are available, and how to run them.
pub(super) struct Modes {
    /// In the order in which they were asked for.
    pub(super) facts: Vec<ModeFacts>,
    pub(super) groups: Vec<Group>,
    /// The first worker of each group.
    pub(super) first: Vec<Worker>,
    /// Modes that are unavailable, each with why.
    pub(super) unavailable: Vec<String>,
}

impl Modes {
    /// The modes that `options` ask for, for images of the rectifier's size. The first workers are created, so that
    /// unavailable modes are found before anything is written.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] when a mode is unavailable or none is left.
    pub(super) fn open(rectifier: &Rectifier, options: &ZedReplayOptions) -> Result<Self> {
        let network = options.network.as_ref();
        let (there, missing): (Vec<Mode>, Vec<Mode>) =
            options.modes.iter().partition(|m| **m != Mode::Neural || network.is_some());
        let unavailable: Vec<_> = missing.iter().map(|m| format!("{m}: {NO_NETWORK}")).collect();
        if there.is_empty() {
            return Err(Error::new(ErrorKind::BadInput, unavailable.join("; ")));
        }
        let numbers = |classical: bool| -> Vec<usize> {
            (0..there.len()).filter(|i| matches!(there[*i], Mode::Preset(_)) == classical).collect()
        };
        let mut groups = vec![presets(&there, numbers(true), rectifier, options)];
        groups.extend(network.map(|n| neural(n.clone(), numbers(false), rectifier, options)));
        groups.retain(|g| !g.modes.is_empty());
        let mut first = Vec::new();
        let mut descriptions = vec![None; there.len()];
        for group in &mut groups {
            let worker = group.make()?;
            for (i, description) in group.modes.iter().zip(worker.describe()) {
                group.memory_bytes = description.memory_bytes;
                descriptions[*i] = Some(description);
            }
            first.push(worker);
        }
        let facts = |(mode, description): (&Mode, Option<Description>)| {
            Some(ModeFacts { name: mode.name(), recorded: mode.recorded_name(), description: description? })
        };
        let facts = there.iter().zip(descriptions).filter_map(facts).collect();
        Ok(Self { facts, groups, first, unavailable })
    }
}

/// The facts about rectified pairs that matchers need.
pub(super) fn geometry(rectifier: &Rectifier) -> Geometry {
    let (width, height) = rectifier.size();
    let focal_px = rectifier.intrinsics().fx;
    Geometry { width: width as usize, height: height as usize, focal_px, baseline_m: rectifier.baseline_m() }
}

fn failed(modes: &str, e: impl std::error::Error + Send + Sync + 'static) -> Error {
    Error::new(ErrorKind::BadInput, format!("mode {modes}: {e}")).with_source(e)
}

/// Those of `all` that are presets, as one matching.
fn presets(all: &[Mode], modes: Vec<usize>, rectifier: &Rectifier, options: &ZedReplayOptions) -> Group {
    let g = geometry(rectifier);
    let disparities = g.disparities(options.range_m.0);
    let presets = all.iter().filter_map(|m| if let Mode::Preset(p) = m { Some(*p) } else { None });
    let name = presets.clone().map(Preset::name).collect::<Vec<_>>().join(", ");
    let wanted: Vec<_> = presets.map(|p| Parameters::preset(p, disparities)).collect();
    let threads = options.threads.max(1);
    let make: Make = {
        let name = name.clone();
        Box::new(move || {
            let opened = SgmPresets::new(g.width, g.height, &wanted, threads);
            opened.map(|m| Worker::Presets(Box::new(m))).map_err(|e| failed(&name, e))
        })
    };
    Group { modes, name, most: usize::MAX, memory_bytes: 0, make }
}

/// The user's network.
fn neural(
    choice: NetworkChoice,
    modes: Vec<usize>,
    rectifier: &Rectifier,
    options: &ZedReplayOptions,
) -> Group {
    let Geometry { width, height, .. } = geometry(rectifier);
    // A network keeps its threads busy with one image; a second one would take as much memory again.
    let most = 1;
    let threads = options.jobs.max(1) * options.threads.max(1);
    let make = move || {
        let options = StereoNetworkOptions {
            library: choice.library.clone(),
            device: choice.device.clone(),
            threads,
            pixels: choice.pixels,
            negative: choice.negative,
        };
        let opened = StereoNetwork::open(&choice.file, width, height, &options);
        opened.map(|m| Worker::One(Box::new(m))).map_err(|e| failed(Mode::Neural.name(), e))
    };
    Group { modes, name: Mode::Neural.name().to_owned(), most, memory_bytes: 0, make: Box::new(make) }
}

/// Why the mode `neural` is unavailable.
pub(super) const NO_NETWORK: &str = "unavailable, because no network was given: the vendor's is closed and is not \
    here. Give a stereo network of your own in ONNX form with --network FILE.onnx";
