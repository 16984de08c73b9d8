//! `[camera.stereo]`: depth that is computed from the left and right images of a camera.

use super::read::Section;
use super::value::{above_zero, not_empty, resolve, within};
use super::wanted::WantedStream;
use depthrig_calib::stereo::{Matcher, Preset};
use depthrig_cdm::{StereoNetwork, StereoNetworkOptions};
use depthrig_stereo::Mode;
use depthrig_stereo::{Geometry, Maker, StereoMode, StereoOptions};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The table.
const TABLE: &str = "[camera.stereo]";
/// Farther than a camera of this size sees anything.
const FARTHEST_M: f64 = 1000.0;

/// How depth is computed from the left and right images of a camera.
#[derive(Debug, Clone, PartialEq)]
pub struct StereoConfig {
    /// The modes, in the order of their streams.
    pub modes: Vec<Mode>,
    /// Threads of each mode.
    pub threads: usize,
    /// Nearest and farthest depth, metres.
    pub range_m: (f64, f64),
    /// Whether disparity is published as well.
    pub disparity: bool,
    /// Pairs that are matched, a second at most; 0: every one.
    pub rate_hz: f64,
    /// A recording waits for the slowest mode, and nothing is skipped.
    pub every_pair: bool,
    /// The network of the mode `neural`; absolute.
    pub network: Option<PathBuf>,
    /// The library of ONNX Runtime, as `[cdm]` has it.
    pub library: Option<PathBuf>,
}

/// Reads `[camera.stereo]`; `None` when there is no such table.
pub(crate) fn read(camera: &Section<'_, '_>, base: &Path) -> Option<StereoConfig> {
    let present = camera.has("stereo");
    let s = camera.table("stereo", TABLE);
    let d = StereoConfig::default();
    let modes = s.or("modes", None, |list: &Option<Vec<String>>| match list {
        None => Ok(()),
        Some(list) => parse(list).map(drop),
    });
    let network = s.or("network", None, |p: &Option<PathBuf>| p.as_deref().map_or(Ok(()), not_empty));
    let config = StereoConfig {
        modes: modes.and_then(|list: Vec<String>| parse(&list).ok()).unwrap_or_else(|| d.modes.clone()),
        threads: s.or("threads", d.threads, within(1..=64)),
        range_m: (
            s.or("min_depth_m", d.range_m.0, above_zero(FARTHEST_M)),
            s.or("max_depth_m", d.range_m.1, above_zero(FARTHEST_M)),
        ),
        disparity: s.or("disparity", d.disparity, |_| Ok(())),
        rate_hz: s.or("rate_hz", d.rate_hz, |hz| match hz {
            hz if (0.0..=1000.0).contains(hz) => Ok(()),
            _ => Err("is outside of 0 to 1000; 0 is every pair".to_owned()),
        }),
        every_pair: s.or("every_pair", d.every_pair, |_| Ok(())),
        network: network.map(|p| resolve(base, &p)),
        library: None,
    };
    if config.range_m.0 >= config.range_m.1 {
        let key = if s.has("max_depth_m") { "max_depth_m" } else { "min_depth_m" };
        let (near, far) = config.range_m;
        s.problem(s.at_key(key), format!("{} leaves nothing: from {near} m to {far} m", s.key_of(key)));
    }
    let neural = config.modes.contains(&Mode::Neural);
    if neural && config.network.is_none() {
        let why = "the mode \"neural\" needs network = \"FILE.onnx\", a stereo network of your own; the vendor's is closed";
        s.problem(s.at_key("modes"), why);
    }
    if !neural && config.network.is_some() {
        let why = "has no use without the mode \"neural\"; add it to modes, or remove this";
        s.problem(s.at_key("network"), format!("{} {why}", s.key_of("network")));
    }
    s.finish();
    present.then_some(config)
}

fn parse(list: &[String]) -> Result<Vec<Mode>, String> {
    let modes = list.iter().map(|m| m.parse::<Mode>()).collect::<Result<Vec<_>, _>>();
    let modes = modes.map_err(|e| format!("is not understood: {e}"))?;
    if modes.is_empty() {
        return Err("is empty; name at least one mode".to_owned());
    }
    match modes.iter().enumerate().find(|(i, m)| modes[..*i].contains(m)) {
        Some((_, twice)) => Err(format!("has \"{twice}\" twice; keep one")),
        None => Ok(modes),
    }
}

/// Says which of the streams that are asked for there are not. `own` are those of the camera itself.
pub(crate) fn check_streams(
    s: &Section<'_, '_>,
    what: &str,
    own: &[&str],
    stereo: Option<&StereoConfig>,
    wanted: &[WantedStream],
) {
    let mut names: Vec<String> = own.iter().map(|n| (*n).to_owned()).collect();
    names.extend(stereo.map(StereoConfig::streams).unwrap_or_default());
    for w in wanted {
        let name = w.request.stream.as_str();
        if !names.iter().any(|n| n == name) {
            let more = if stereo.is_none() && (name == "color" || StereoOptions::is_late(name)) {
                "; depth and rectified colour need [camera.stereo]"
            } else {
                ""
            };
            s.problem(w.at, format!("{what} has no stream \"{name}\"; it has: {}{more}", names.join(", ")));
        }
    }
}

impl StereoConfig {
    /// Names of the computed streams.
    pub fn streams(&self) -> Vec<String> {
        // The modes' names are good ones.
        let names = self.options().streams().unwrap_or_default();
        names.iter().map(ToString::to_string).collect()
    }

    /// The stream that is refined where nothing else is said: depth of the first mode.
    pub fn first_depth(&self) -> String {
        format!("{}{}", depthrig_stereo::PREFIXES[0], self.modes.first().map_or("quality", |m| m.name()))
    }

    /// The options for the driver.
    pub fn options(&self) -> StereoOptions {
        let mode = |m: &Mode| match m {
            Mode::Preset(preset) => StereoMode::preset(*preset, self.range_m.0, self.threads),
            Mode::Neural => self.neural(),
        };
        StereoOptions {
            modes: self.modes.iter().map(mode).collect(),
            disparity: self.disparity,
            range_m: self.range_m,
            rate_hz: self.rate_hz,
            every_pair: self.every_pair,
            ..StereoOptions::default()
        }
    }

    fn neural(&self) -> StereoMode {
        let file = self.network.clone();
        let library = self.library.clone();
        let threads = self.threads;
        let make: Maker = Arc::new(move |g: &Geometry| {
            let bad = |what: String| depthrig_calib::Error::new(depthrig_calib::ErrorKind::BadInput, what);
            let file = file.as_deref().ok_or_else(|| bad("no network was given".to_owned()))?;
            let options = StereoNetworkOptions {
                library: library.clone(),
                device: "cpu".to_owned(),
                threads,
                pixels: None,
                negative: false,
            };
            let network = StereoNetwork::open(file, g.width, g.height, &options);
            let network = network.map_err(|e| bad(format!("unavailable, because {e}")).with_source(e))?;
            Ok(Box::new(network) as Box<dyn Matcher>)
        });
        StereoMode { name: Mode::Neural.name().to_owned(), wants_color: true, make }
    }
}

impl Default for StereoConfig {
    /// The preset `quality` on one thread, from 0.5 to 20 m.
    fn default() -> Self {
        Self {
            modes: vec![Mode::Preset(Preset::Quality)],
            threads: 1,
            range_m: StereoOptions::default().range_m,
            disparity: false,
            rate_hz: 0.0,
            every_pair: false,
            network: None,
            library: None,
        }
    }
}
