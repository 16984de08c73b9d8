//! Depth from stereo: adds depth by our own matchers to any camera with streams `left` and `right`.
//!
//! Beside the streams of the camera there are `color` (the left image, rectified) and for each [`StereoMode`]
//! `depth_<mode>`, `confidence_<mode>` and, where [`StereoOptions::disparity`] asks for it, `disparity_<mode>`, all in
//! the rectified left view. Their frames have the time, the sequence number and the exposure of the pair that they are
//! made of, and the flag `derived`.
//!
//! **Threads.** One rectifies, and each mode has one of its own; the thread that captures only copies images. The
//! newest pair wins, but one of the moment of a frame set ([`StereoOptions::sets`]) waits for its turn: a mode that is
//! slower than the camera and faster than the sets has depth in each of them. A superseded pair counts as dropped
//! (`queue_full`) in each stream that it is missing from. With [`StereoOptions::rate_hz`] only so many pairs are
//! matched at all, those of sets where the rates divide each other. One more thread measures now and then whether the
//! rows of left and right agree, and reports it ([`StereoOptions::notice`]) when they do not. With
//! [`StereoOptions::every_pair`] no pair is superseded, and the camera, which must be a recording, is read as fast as
//! the slowest mode is done.
//!
//! **Accounts.** Each of these streams has captured as many frames as the left camera, or as many as were to be
//! matched, and `captured = delivered + Σ dropped` holds after every frame, in the order of the pairs: what a slow mode
//! is still to decide is not counted before.
#![cfg_attr(test, allow(clippy::unwrap_used, clippy::expect_used))]

use core::fmt;
use depthrig_bus::{Intrinsics, Name, PixelFormat, Pose, StreamName};
use depthrig_calib::stereo::{Description, Matcher, Parameters, Preset, SgmMatcher};
use depthrig_calib::{PoseExt, Rectifier};
use depthrig_driver::moments::SetTimes;
use depthrig_driver::{
    Backend, Device, DeviceInfo, Error, ErrorKind, Result, Stream, StreamProfile, StreamRequest,
    choose_profiles,
};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

mod ledger;
mod mode;
mod newest;
mod pair;
mod rows;
mod stream;
mod workers;

use stream::StereoStream;
use workers::Workers;

/// The streams that stereo computes from, left first.
pub const SIDES: [&str; 2] = ["left", "right"];
/// The rectified left image.
pub const COLOR: &str = "color";
/// Names of the streams of a mode begin with one of these.
pub const PREFIXES: [&str; 3] = ["depth_", "confidence_", "disparity_"];
/// Most disparities that the classical matcher can search.
const MAX_DISPARITY: usize = 256;

/// Geometry of the rectified pairs, for a maker of matchers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Geometry {
    /// Pixels per row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Focal length of both views, pixels.
    pub focal_px: f64,
    /// Distance between the cameras, metres.
    pub baseline_m: f64,
}

impl Geometry {
    /// How many disparities must be searched to see what is `near_m` away: a multiple of 16, at least 16 and at most
    /// what the classical matcher can.
    pub fn disparities(&self, near_m: f64) -> usize {
        let wanted = (self.focal_px * self.baseline_m / near_m).ceil().clamp(0.0, 1e6) as usize + 1;
        wanted.next_multiple_of(16).clamp(16, MAX_DISPARITY)
    }
}

/// Description of each mode's matcher, by the mode's name; filled when the camera is started.
pub type Descriptions = Arc<Mutex<BTreeMap<String, Description>>>;

/// A fault of the stereo pair that does not end the camera, in words; filled while it runs.
pub type Notice = Arc<Mutex<Option<String>>>;

/// Makes the matcher of a mode, once per start of the camera.
pub type Maker = Arc<dyn Fn(&Geometry) -> depthrig_calib::Result<Box<dyn Matcher>> + Send + Sync>;

/// One way to match, with the streams that it gives.
#[derive(Clone)]
pub struct StereoMode {
    /// Its name, part of the names of its streams: `depth_<name>`.
    pub name: String,
    /// Whether its matcher looks at the images in colour, as networks do.
    pub wants_color: bool,
    /// Makes its matcher.
    pub make: Maker,
}

impl fmt::Debug for StereoMode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("StereoMode").field("name", &self.name).finish_non_exhaustive()
    }
}

impl StereoMode {
    /// The mode of a preset of the classical matcher, called after it, that sees what is `near_m` away or farther, on
    /// `threads` threads (0: as many as it likes).
    pub fn preset(preset: Preset, near_m: f64, threads: usize) -> Self {
        let make = move |g: &Geometry| -> depthrig_calib::Result<Box<dyn Matcher>> {
            let parameters = Parameters::preset(preset, g.disparities(near_m));
            Ok(Box::new(SgmMatcher::new(g.width, g.height, &parameters, threads)?))
        };
        Self { name: preset.name().to_owned(), wants_color: false, make: Arc::new(make) }
    }

    fn stream(&self, kind: usize) -> Result<StreamName> {
        let name = format!("{}{}", PREFIXES[kind], self.name);
        Name::new(&name).map_err(|e| {
            let what = format!("a stereo mode cannot be called \"{}\": {e}", self.name);
            Error::new(ErrorKind::BadInput, what).with_source(e)
        })
    }
}

/// Options for stereo: the modes and their output.
#[derive(Debug, Clone)]
pub struct StereoOptions {
    /// The modes; each has streams and a thread of its own.
    pub modes: Vec<StereoMode>,
    /// Whether there are streams `disparity_<mode>`.
    pub disparity: bool,
    /// Metres per unit of depth.
    pub depth_unit_m: f64,
    /// Nearest and farthest depth, metres; pixels outside have no depth.
    pub range_m: (f64, f64),
    /// Pairs that are matched, a second at most; 0: every one. Colour is rectified of all.
    pub rate_hz: f64,
    /// Matches every pair, so that none is superseded: for recordings alone, since a camera does not wait.
    pub every_pair: bool,
    /// Receives the description of each mode's matcher.
    pub computed: Descriptions,
    /// Receives the notice that the rows of left and right differ.
    pub notice: Notice,
    /// The moments whose pairs are preferred.
    pub sets: Arc<SetTimes>,
}

impl Default for StereoOptions {
    /// Millimetres between 0.5 and 20 m, and no mode yet. What is nearer costs in proportion to its disparity.
    fn default() -> Self {
        Self {
            modes: Vec::new(),
            disparity: false,
            depth_unit_m: 0.001,
            range_m: (0.5, 20.0),
            rate_hz: 0.0,
            every_pair: false,
            computed: Descriptions::default(),
            notice: Notice::default(),
            sets: Arc::default(),
        }
    }
}

impl StereoOptions {
    /// The names of all computed streams, `color` first.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] when a mode's name cannot be part of a stream's.
    pub fn streams(&self) -> Result<Vec<StreamName>> {
        let color = Name::new(COLOR);
        let color = color.map_err(|e| Error::new(ErrorKind::BadInput, e.to_string()).with_source(e))?;
        let mut names = vec![color];
        for mode in &self.modes {
            for kind in 0..if self.disparity { 3 } else { 2 } {
                names.push(mode.stream(kind)?);
            }
        }
        Ok(names)
    }

    /// Whether a stream of this name comes later than its input, by the time that matching takes.
    pub fn is_late(name: &str) -> bool {
        PREFIXES.iter().any(|p| name.starts_with(p))
    }

    fn check(&self) -> Result<()> {
        let bad = |what: String| Err(Error::new(ErrorKind::BadInput, what));
        for (i, mode) in self.modes.iter().enumerate() {
            if self.modes[..i].iter().any(|m| m.name == mode.name) {
                return bad(format!("the stereo mode \"{}\" is listed twice; keep one", mode.name));
            }
        }
        let (near, far) = self.range_m;
        if !(near > 0.0 && near < far && far.is_finite()) {
            return bad(format!(
                "invalid depth range {near} m to {far} m; the nearest depth must be above 0 and below the farthest"
            ));
        }
        if !(self.rate_hz >= 0.0 && self.rate_hz.is_finite()) {
            return bad(format!("invalid stereo rate {} Hz; 0 matches every pair", self.rate_hz));
        }
        if !(1e-6..1.0).contains(&self.depth_unit_m) {
            return bad(format!("invalid depth unit {} m; most cameras use 0.001", self.depth_unit_m));
        }
        Ok(())
    }
}

/// A backend whose cameras all have stereo.
pub struct StereoBackend {
    inner: Box<dyn Backend>,
    options: StereoOptions,
}

impl StereoBackend {
    /// `inner` with what `options` ask for.
    pub fn new(inner: Box<dyn Backend>, options: StereoOptions) -> Self {
        Self { inner, options }
    }
}

impl Backend for StereoBackend {
    fn name(&self) -> &'static str {
        self.inner.name()
    }

    fn discover(&self) -> Result<Vec<DeviceInfo>> {
        self.inner.discover()
    }

    fn open(&self, serial: Option<&str>) -> Result<Box<dyn Device>> {
        wrap(self.inner.open(serial)?, self.options.clone())
    }
}

/// The camera `device` with the streams that `options` ask for, beside its own.
///
/// # Errors
/// [`ErrorKind::BadInput`] for invalid options, [`ErrorKind::Unsupported`] when the camera has no `left` and
/// `right` of one size, or a stream of a name that stereo gives.
pub fn wrap(device: Box<dyn Device>, options: StereoOptions) -> Result<Box<dyn Device>> {
    let name = describe(device.info());
    let profiles = offered(&name, device.profiles(), &options)?;
    Ok(Box::new(StereoDevice { name, inner: device, profiles, options }))
}

/// The streams `own` of the camera `name` and those that `options` ask for. The intrinsics of the computed streams are
/// known when the camera is started.
///
/// # Errors
/// As [`wrap`].
pub fn offered(name: &str, own: &[StreamProfile], options: &StereoOptions) -> Result<Vec<StreamProfile>> {
    options.check()?;
    let names = options.streams()?;
    if let Some(taken) = own.iter().find(|p| names.contains(&p.stream)) {
        let what =
            format!("{name} has a stream \"{}\" itself; take [camera.stereo] out of the rig", taken.stream);
        return Err(Error::new(ErrorKind::Unsupported, what));
    }
    let mut profiles = own.to_vec();
    for left in own.iter().filter(|p| p.stream.as_str() == SIDES[0]) {
        if own.iter().any(|p| p.stream.as_str() == SIDES[1] && same_mode(p, left)) {
            profiles.extend(made(left, options, &Intrinsics::default(), Pose::IDENTITY)?);
        }
    }
    if profiles.len() == own.len() {
        let what = format!(
            "{name} has no streams \"left\" and \"right\" of one size and format, which stereo needs"
        );
        return Err(Error::new(ErrorKind::Unsupported, what));
    }
    Ok(profiles)
}

fn same_mode(a: &StreamProfile, b: &StreamProfile) -> bool {
    (a.width, a.height, a.rate_hz, a.format) == (b.width, b.height, b.rate_hz, b.format)
}

fn describe(info: &DeviceInfo) -> String {
    format!("{} {} ({})", info.model, info.serial, info.port)
}

/// The profiles of the streams that are computed from `left`, `color` first if the images have colour.
fn made(
    left: &StreamProfile,
    options: &StereoOptions,
    view: &Intrinsics,
    pose_in_device: Pose,
) -> Result<Vec<StreamProfile>> {
    let profile = |stream: StreamName, format: PixelFormat| StreamProfile {
        stream,
        format,
        depth_unit_m: if format == PixelFormat::Z16 { options.depth_unit_m } else { 0.0 },
        intrinsics: *view,
        pose_in_device,
        ..left.clone()
    };
    let formats = [PixelFormat::Z16, PixelFormat::Confidence8, PixelFormat::DisparityF32];
    let mut names = options.streams()?.into_iter();
    let color = names.next().filter(|_| has_color(left.format));
    let mut all: Vec<_> = color.map(|name| profile(name, PixelFormat::Rgb8)).into_iter().collect();
    for name in names {
        let kind = PREFIXES.iter().position(|p| name.as_str().starts_with(p)).unwrap_or(0);
        all.push(profile(name, formats[kind]));
    }
    Ok(all)
}

const fn has_color(format: PixelFormat) -> bool {
    !matches!(format, PixelFormat::Mono8)
}

/// An open camera with stereo.
struct StereoDevice {
    name: String,
    inner: Box<dyn Device>,
    profiles: Vec<StreamProfile>,
    options: StereoOptions,
}

impl Device for StereoDevice {
    fn info(&self) -> &DeviceInfo {
        self.inner.info()
    }

    fn profiles(&self) -> &[StreamProfile] {
        &self.profiles
    }

    fn start(self: Box<Self>, requests: &[StreamRequest]) -> Result<Box<dyn Stream>> {
        let Self { name, inner, profiles, options } = *self;
        // All requested streams share one mode of the camera: what one leaves open, it takes from the others.
        let all: Vec<StreamRequest>;
        let requests = if requests.is_empty() {
            all = choose_profiles(&name, &profiles, &[])?
                .into_iter()
                .map(|p| StreamRequest::any(p.stream))
                .collect();
            &all
        } else {
            requests
        };
        // An IMU has a mode of its own.
        let is_image = |r: &&StreamRequest| r.stream.as_str() != depthrig_driver::motion::IMU;
        let images = || requests.iter().filter(is_image);
        let size = images().find_map(|r| r.size);
        let rate_hz = images().find_map(|r| r.rate_hz);
        let filled = |r: &StreamRequest| {
            let (size, rate_hz) = if is_image(&r) { (size, rate_hz) } else { (None, None) };
            StreamRequest { size: r.size.or(size), rate_hz: r.rate_hz.or(rate_hz), ..r.clone() }
        };
        let wanted = choose_profiles(&name, &profiles, &requests.iter().map(filled).collect::<Vec<_>>())?;
        let is_made = {
            let names = options.streams()?;
            move |p: &StreamProfile| names.contains(&p.stream)
        };
        // Left and right in any case, then whatever else of its own the camera is asked for.
        let mut own = Vec::new();
        for side in SIDES {
            let asked = requests.iter().find(|r| r.stream.as_str() == side).map(filled);
            let any = profiles.iter().find(|p| p.stream.as_str() == side);
            let any = any.map(|p| StreamRequest { size, rate_hz, ..StreamRequest::any(p.stream.clone()) });
            own.extend(asked.or(any));
        }
        let others = wanted.iter().filter(|p| !is_made(p) && !SIDES.contains(&p.stream.as_str()));
        own.extend(others.map(|p| StreamRequest::any(p.stream.clone())));
        let inner = inner.start(&own)?;
        let indices = SIDES.map(|side| inner.profiles().iter().position(|p| p.stream.as_str() == side));
        let [Some(left), Some(right)] = indices else {
            let what = format!("{name}: started without its left or right stream");
            return Err(Error::new(ErrorKind::Protocol, what));
        };
        let l = &inner.profiles()[left];
        let r = &inner.profiles()[right];
        let rectifier = rectifier(&name, l, r)?;
        let pose = l.pose_in_device.compose(&rectifier.left_view_in_left());
        let mut running = made(l, &options, rectifier.intrinsics(), pose)?;
        if options.rate_hz > 0.0 {
            let matched = running.iter_mut().filter(|p| StereoOptions::is_late(p.stream.as_str()));
            matched.for_each(|p| p.rate_hz = p.rate_hz.min(options.rate_hz));
        }
        let chosen = wanted
            .iter()
            .map(|p| {
                let of = if is_made(p) { &running[..] } else { inner.profiles() };
                of.iter().find(|q| q.stream == p.stream).cloned().ok_or_else(|| {
                    Error::new(ErrorKind::Protocol, format!("{name}: \"{}\" did not start", p.stream))
                })
            })
            .collect::<Result<Vec<_>>>()?;
        if let Some(other) =
            chosen.iter().zip(&wanted).find(|(c, w)| (c.width, c.height) != (w.width, w.height))
        {
            let what = format!(
                "{name}: left, right and the streams computed from them have one size; \"{}\" was requested in another one",
                other.1.stream
            );
            return Err(Error::new(ErrorKind::Unsupported, what));
        }
        let workers = Workers::start(&name, rectifier, l.format, &options)?;
        Ok(Box::new(StereoStream::new(name, inner, [left, right], chosen, workers, &options)))
    }
}

/// The rectifier of a running stereo pair.
fn rectifier(name: &str, left: &StreamProfile, right: &StreamProfile) -> Result<Rectifier> {
    let named = |what: String| format!("{name}: no stereo: {what}");
    if !same_mode(left, right) {
        let what =
            format!("left and right have different modes: {} and {}", left.describe(), right.describe());
        return Err(Error::new(ErrorKind::Unsupported, named(what)));
    }
    match left.format {
        PixelFormat::Yuyv if !left.width.is_multiple_of(2) => {
            let what = format!("YUYV has pairs of pixels, and {} is odd", left.width);
            return Err(Error::new(ErrorKind::BadInput, named(what)));
        }
        PixelFormat::Yuyv | PixelFormat::Rgb8 | PixelFormat::Mono8 => {}
        other => {
            let what = format!(
                "unsupported format {} of left and right; yuyv, rgb8 and mono8 can be rectified",
                other.name()
            );
            return Err(Error::new(ErrorKind::Unsupported, named(what)));
        }
    }
    if !left.intrinsics.is_known() || !right.intrinsics.is_known() {
        let what = format!(
            "no calibration of left and right at {}x{}; give it the factory calibration, calibration = \"…/SN….conf\"",
            left.width, left.height
        );
        return Err(Error::new(ErrorKind::BadInput, named(what)));
    }
    let right_in_left = left.pose_in_device.inverse().compose(&right.pose_in_device);
    Rectifier::new(&left.intrinsics, &right.intrinsics, &right_in_left, (left.width, left.height))
        .map_err(|e| Error::new(ErrorKind::BadInput, named(e.to_string())).with_source(e))
}

#[cfg(test)]
mod tests;

pub use mode::Mode;
