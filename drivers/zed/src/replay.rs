//! Playback of ZED recordings: pairs of images from a folder of side-by-side images or an SVO2 file.
//!
//! A [`Source`] gives pairs in the order of the recording, as they were recorded: not rectified, not resized. [`open`]
//! detects what kind of recording a path is. Other recordings (a dataset with raw `left` and `right`) implement the
//! same trait.

use super::CalibrationFile;
use super::conf::{FactoryCalibration, StereoCalibration, how_to_get, known_paths};
use super::mode::{Mode, Side};
use depthrig_bus::PixelFormat;
use depthrig_driver::image_file::io_error;
use depthrig_driver::{Error, ErrorKind, Result};
use std::path::{Path, PathBuf};

mod backend;
#[cfg(any(test, feature = "testing"))]
pub mod fake;
mod folder;
pub mod svo2;

pub use backend::{ZedPlaybackBackend, ZedPlaybackConfig};

/// Rate of pairs whose recording says nothing of it.
const DEFAULT_RATE_HZ: f64 = 30.0;
/// The fastest rate that is believed.
const MAX_RATE_HZ: f64 = 1000.0;

/// Properties of an open recording.
#[derive(Debug, Clone, PartialEq)]
pub struct SourceInfo {
    /// The folder or file, for messages.
    pub path: PathBuf,
    /// Kind of recording: `folder`, `svo2`, `dataset`.
    pub kind: &'static str,
    /// Model, such as `ZED 2i`; empty when the recording does not say.
    pub model: String,
    /// Serial number of the camera; empty when nothing says it.
    pub serial: String,
    /// Pixels per row of the left or right image.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Format of both images: [`PixelFormat::Yuyv`], [`PixelFormat::Rgb8`] or [`PixelFormat::Mono8`].
    pub format: PixelFormat,
    /// Nominal rate of the pairs.
    pub rate_hz: f64,
    /// Whether the pairs' times are those of the recording; else they are `index / rate_hz`.
    pub timed: bool,
    /// Intrinsics of both cameras at this size and the right camera's pose; `None` without a calibration.
    pub calibration: Option<StereoCalibration>,
    /// Where the calibration comes from, as in [`depthrig_driver::DeviceInfo::calibration`].
    pub calibration_origin: String,
}

impl SourceInfo {
    /// Bytes of the left or right image.
    pub const fn image_bytes(&self) -> usize {
        self.format.frame_bytes(self.width, self.height)
    }
}

/// The left and right image of one moment. The caller reuses it for every pair, so that nothing is allocated.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Pair {
    /// Number of the pair in the recording, from 0.
    pub index: u64,
    /// When it was taken, nanoseconds on the recording's own clock (UTC for SVO2).
    pub capture_time_ns: i64,
    /// The left image in [`SourceInfo::format`], [`SourceInfo::image_bytes`] long.
    pub left: Vec<u8>,
    /// The right image, likewise.
    pub right: Vec<u8>,
}

impl Pair {
    /// The image of `side`.
    pub fn image(&self, side: Side) -> &[u8] {
        match side {
            Side::Left => &self.left,
            Side::Right => &self.right,
        }
    }
}

/// Result of [`Source::next`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Next {
    /// A pair.
    Pair,
    /// Pair [`Pair::index`] cannot be decoded, because of this; the ones after it may be complete.
    Damaged(String),
    /// There are no more.
    End,
}

/// Pairs of images in the order of a recording.
pub trait Source: Send {
    /// Properties of the recording.
    fn info(&self) -> &SourceInfo;

    /// How many pairs there are, when that is known without reading them all.
    fn len_hint(&self) -> Option<u64>;

    /// Fills `pair` with the next pair. After [`Next::Damaged`] its index and time are right and its images are not.
    ///
    /// # Errors
    /// [`ErrorKind::Io`](depthrig_driver::ErrorKind::Io) when the recording cannot be read, and
    /// [`ErrorKind::BadInput`](depthrig_driver::ErrorKind::BadInput) when it cannot be understood any more; both name its path.
    fn next(&mut self, pair: &mut Pair) -> Result<Next>;

    /// Goes to pair `index`, which [`Self::next`] then gives; beyond the last one, to the end.
    ///
    /// # Errors
    /// As [`Self::next`].
    fn seek(&mut self, index: u64) -> Result<()>;
}

/// Options for what the recording itself does not state.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct OpenOptions {
    /// Where the factory calibration is. With [`CalibrationFile::Known`], beside the recording as well.
    pub calibration: CalibrationFile,
    /// Serial number of the camera, when neither the recording nor the calibration's name says it.
    pub serial: Option<String>,
    /// Rate of pairs that have no times of their own; 30 Hz without it.
    pub rate_hz: Option<f64>,
}

/// Opens the recording at `path`: a folder of side-by-side images or an SVO2 file.
///
/// # Errors
/// [`ErrorKind::NotFound`], [`ErrorKind::PermissionDenied`], [`ErrorKind::Io`]; [`ErrorKind::Unsupported`] for a
/// recording whose images cannot be decoded here (H.265, encrypted); [`ErrorKind::BadInput`] for
/// anything that is not a recording, for images that are not side by side, and for a calibration of another camera or
/// another size.
pub fn open(path: &Path, options: &OpenOptions) -> Result<Box<dyn Source>> {
    let what = std::fs::metadata(path).map_err(|e| io_error(path, e))?;
    if let Some(rate) = options.rate_hz
        && !(rate > 0.0 && rate <= MAX_RATE_HZ)
    {
        let what = format!("invalid rate {rate} Hz; choose one above 0 and at most {MAX_RATE_HZ}");
        return Err(Error::new(ErrorKind::BadInput, what));
    }
    Ok(if what.is_dir() {
        Box::new(folder::Folder::open(path, options)?)
    } else {
        Box::new(svo2::Svo2::open(path, options)?)
    })
}

/// The calibration of the camera `serial` (empty when it is not known) for images of this size, where it comes from,
/// and the serial number that its name states.
fn calibration(
    path: &Path,
    options: &OpenOptions,
    serial: &str,
    width: u32,
    height: u32,
) -> Result<(Option<StereoCalibration>, String, Option<String>)> {
    let found = match &options.calibration {
        CalibrationFile::None => None,
        CalibrationFile::At(file) => Some(file.clone()),
        CalibrationFile::Known => beside(path, serial)?.or_else(|| {
            let home = std::env::var_os("HOME").map(PathBuf::from);
            let known = if serial.is_empty() { Vec::new() } else { known_paths(serial, home.as_deref()) };
            known.into_iter().find(|p| p.exists())
        }),
    };
    let Some(file) = found else { return Ok((None, "none".to_owned(), None)) };
    let of = serial_of(&file);
    if let Some(of) = &of
        && !serial.is_empty()
        && of.trim_start_matches('0') != serial.trim_start_matches('0')
    {
        let what = format!(
            "{} is the calibration of the camera {of}, and {} was taken with {serial}: {}",
            file.display(),
            path.display(),
            how_to_get(serial)
        );
        return Err(Error::new(ErrorKind::BadInput, what));
    }
    let all = FactoryCalibration::load(&file).map_err(|e| {
        let what = format!("{e}; {} needs it for rectification", path.display());
        Error::new(ErrorKind::BadInput, what).with_source(e)
    })?;
    let fitting = Mode::of_size(width, height).and_then(|m| all.at(m));
    let Some(fitting) = fitting else {
        let sizes: Vec<_> =
            Mode::ALL.into_iter().filter(|m| all.at(*m).is_some()).map(Mode::image_size).collect();
        let sizes: Vec<_> = sizes.into_iter().map(|(w, h)| format!("{w}x{h}")).collect();
        let what = format!(
            "{}: left and right have {width}x{height} pixels, and {} is for {}; images must not be resized, or give \
             calibration = \"none\" to play them as they are",
            path.display(),
            file.display(),
            sizes.join(", ")
        );
        return Err(Error::new(ErrorKind::BadInput, what));
    };
    Ok((Some(*fitting), format!("factory {}", file.display()), of))
}

/// The factory calibration that lies in the folder of the recording (or in the recording, when that is a folder).
fn beside(path: &Path, serial: &str) -> Result<Option<PathBuf>> {
    let folder = if path.is_dir() { Some(path) } else { path.parent() };
    let Some(folder) = folder.filter(|f| !f.as_os_str().is_empty()) else { return Ok(None) };
    let entries = std::fs::read_dir(folder).map_err(|e| io_error(folder, e))?;
    let mut found: Vec<_> = entries
        .filter_map(|e| Some(e.ok()?.path()))
        .filter(|p| p.extension().is_some_and(|e| e == "conf"))
        .filter(|p| serial.is_empty() || serial_of(p).is_none_or(|of| of == serial))
        .collect();
    found.sort();
    // One that is called after the camera comes before others.
    if let Some(i) =
        found.iter().position(|p| !serial.is_empty() && serial_of(p).is_some_and(|of| of == serial))
    {
        return Ok(Some(found.swap_remove(i)));
    }
    // A recording that is a file has neighbours that it has nothing to do with.
    if !path.is_dir() {
        return Ok(None);
    }
    match found.as_slice() {
        [] => Ok(None),
        [one] => Ok(Some(one.clone())),
        [a, b, ..] => {
            let what = format!(
                "{} has several calibrations, such as {} and {}; keep one, or name it with calibration = \"…\"",
                folder.display(),
                a.display(),
                b.display()
            );
            Err(Error::new(ErrorKind::BadInput, what))
        }
    }
}

/// The serial number in the name `SN<serial>.conf`.
fn serial_of(file: &Path) -> Option<String> {
    let stem = file.file_stem()?.to_str()?;
    let digits = stem.strip_prefix("SN")?;
    (!digits.is_empty() && digits.bytes().all(|c| c.is_ascii_digit())).then(|| digits.to_owned())
}

#[cfg(test)]
mod tests;
