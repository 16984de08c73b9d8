//! Recordings of a ZED's two eyes: pairs of pictures out of a folder of side-by-side images or an SVO2 file.
//!
//! A [`Source`] gives pairs in the order of the recording, as they were recorded: not rectified, not resized. `open`
//! finds out what a path is. The same trait is what other recordings (a dataset with raw `left` and `right`) implement.

use super::CalibrationFile;
use super::conf::StereoCalibration;
use super::mode::Eye;
use crate::Result;
use depthrig_bus::PixelFormat;
use std::path::PathBuf;

/// What a recording is, known once it is open.
#[derive(Debug, Clone, PartialEq)]
pub struct SourceInfo {
    /// The folder or file, for messages.
    pub path: PathBuf,
    /// `folder`, `svo2`, `dataset`: which kind of recording it is.
    pub kind: &'static str,
    /// Model, such as `ZED 2i`; empty when the recording does not say.
    pub model: String,
    /// Serial number of the camera; empty when nothing says it.
    pub serial: String,
    /// Pixels per row of one eye.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Pixels of both eyes: [`PixelFormat::Yuyv`], [`PixelFormat::Rgb8`] or [`PixelFormat::Mono8`].
    pub format: PixelFormat,
    /// Nominal rate of the pairs.
    pub rate_hz: f64,
    /// Whether the pairs' times are those of the recording; else they are `index / rate_hz`.
    pub timed: bool,
    /// Intrinsics of both eyes at this size and the right eye's pose; `None` when there is no calibration.
    pub calibration: Option<StereoCalibration>,
    /// Where the calibration comes from, as in [`crate::DeviceInfo::calibration`].
    pub calibration_origin: String,
}

impl SourceInfo {
    /// Bytes of the picture of one eye.
    pub const fn eye_bytes(&self) -> usize {
        self.format.frame_bytes(self.width, self.height)
    }
}

/// Both eyes at one moment. The caller keeps one and has it filled again and again, so that nothing is allocated.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Pair {
    /// Number of the pair in the recording, from 0.
    pub index: u64,
    /// When it was taken, nanoseconds on the recording's own clock (UTC for SVO2).
    pub capture_time_ns: i64,
    /// The left eye's picture in [`SourceInfo::format`], [`SourceInfo::eye_bytes`] long.
    pub left: Vec<u8>,
    /// The right eye's.
    pub right: Vec<u8>,
}

impl Pair {
    /// The picture of `eye`.
    pub fn eye(&self, eye: Eye) -> &[u8] {
        match eye {
            Eye::Left => &self.left,
            Eye::Right => &self.right,
        }
    }
}

/// What [`Source::next`] found.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Next {
    /// A pair.
    Pair,
    /// Pair [`Pair::index`] cannot be decoded, because of this; the ones after it may be whole.
    Damaged(String),
    /// There are no more.
    End,
}

/// Pairs of pictures in the order of a recording.
pub trait Source: Send {
    /// What the recording is.
    fn info(&self) -> &SourceInfo;

    /// How many pairs there are, when that is known without reading them all.
    fn len_hint(&self) -> Option<u64>;

    /// Fills `pair` with the next pair. After [`Next::Damaged`] its index and time are right and its pictures are not.
    ///
    /// # Errors
    /// [`ErrorKind::Io`](crate::ErrorKind::Io) when the recording cannot be read, and
    /// [`ErrorKind::BadInput`](crate::ErrorKind::BadInput) when it cannot be understood any more; both name its path.
    fn next(&mut self, pair: &mut Pair) -> Result<Next>;

    /// Goes to pair `index`, which [`Self::next`] then gives; beyond the last one, to the end.
    ///
    /// # Errors
    /// As [`Self::next`].
    fn seek(&mut self, index: u64) -> Result<()>;
}

/// What is not in the recording itself.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct OpenOptions {
    /// Where the factory calibration is. With [`CalibrationFile::Known`], beside the recording as well.
    pub calibration: CalibrationFile,
    /// Serial number of the camera, when neither the recording nor the calibration's name says it.
    pub serial: Option<String>,
    /// Rate of pairs that have no times of their own; 30 Hz without it.
    pub rate_hz: Option<f64>,
}
