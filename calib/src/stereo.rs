//! Stereo: computes the disparity of the left image of a rectified pair, and depth from disparity.
//!
//! Both images are grey, of one size, and rectified: what is seen at `(x, y)` in the left one is seen at `(x - d, y)`
//! in the right one, with a disparity `d >= 0` in pixels. [`SgmMatcher`] finds `d` by semi-global matching over a census
//! (Hirschmueller 2008, with the census of Zabih and Woodfill 1994); [`Matcher`] is the interface that it shares with a
//! network. Presets, their cost and their limits: docs/stereo.md.
//!
//! # Example
//! ```
//! use depthrig_calib::stereo::{DisparityMap, Gray, Matcher, Parameters, Preset, SgmMatcher, StereoPair};
//!
//! // A wall of noise, 5 pixels away in disparity.
//! let noise = |x: usize, y: usize| ((x * 7919 + y * 104_729) * 2_654_435_761 >> 7) as u8;
//! let image = |shift: usize| (0..96 * 32).map(|i| noise(i % 96 + shift, i / 96)).collect::<Vec<u8>>();
//! let (left, right) = (image(0), image(5));
//! let pair = StereoPair::new(Gray::packed(&left, 96, 32), Gray::packed(&right, 96, 32));
//! let mut matcher = SgmMatcher::new(96, 32, &Parameters::preset(Preset::Quality, 32), 1)?;
//! let mut map = DisparityMap::default();
//! matcher.run(&pair, &mut map)?;
//! assert!((map.disparity[16 * 96 + 48] - 5.0).abs() < 0.1);
//! # Ok::<(), depthrig_calib::Error>(())
//! ```

use crate::{Error, ErrorKind, Result};

mod depth;
mod order;
mod parameters;
mod pyramid;
mod rows;
mod sgm;

pub use depth::{depth_from_disparity, metres_from_disparity};
pub use order::{Order, OrderCheck};
pub use parameters::{MAX_DISPARITIES, Parameters, Preset, Resolution};
pub use rows::{RowCheck, RowOffset};
pub use sgm::{SgmMatcher, SgmPresets};

/// A grey image, one byte a pixel.
#[derive(Debug, Clone, Copy)]
pub struct Gray<'a> {
    /// Rows from the top, each `stride` bytes from the one before; the last may end after `width`.
    pub pixels: &'a [u8],
    /// Pixels per row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Bytes from a row to the next, at least `width`.
    pub stride: usize,
}

impl<'a> Gray<'a> {
    /// An image whose rows lie without padding.
    pub const fn packed(pixels: &'a [u8], width: usize, height: usize) -> Self {
        Self { pixels, width, height, stride: width }
    }

    /// Row `y`, `width` bytes. Only for an image that [`Gray::check`] accepted.
    pub(crate) fn row(&self, y: usize) -> &'a [u8] {
        &self.pixels[y * self.stride..][..self.width]
    }

    /// Refuses an image of another size than `width` x `height`, or one whose bytes do not reach.
    ///
    /// # Errors
    /// [`ErrorKind::SizeMismatch`], naming which of them.
    pub(crate) fn check(&self, what: &str, width: usize, height: usize) -> Result<()> {
        if (self.width, self.height) != (width, height) {
            return Err(Error::new(
                ErrorKind::SizeMismatch,
                format!(
                    "the {what} image is {}x{} where {width}x{height} was agreed on; left and right images must both have that size",
                    self.width, self.height
                ),
            ));
        }
        let reach = self.stride.checked_mul(height.saturating_sub(1)).and_then(|n| n.checked_add(width));
        if self.stride < width || reach.is_none_or(|n| self.pixels.len() < n) {
            return Err(Error::new(
                ErrorKind::SizeMismatch,
                format!(
                    "the {what} image of {width}x{height} with rows {} bytes apart cannot have {} bytes",
                    self.stride,
                    self.pixels.len()
                ),
            ));
        }
        Ok(())
    }
}

/// The left and right image of one moment, rectified.
#[derive(Debug, Clone, Copy)]
pub struct StereoPair<'a> {
    /// The left image.
    pub left: Gray<'a>,
    /// The right image, of the same size.
    pub right: Gray<'a>,
    /// The left image in colour where there is one, for networks: RGB, 3 bytes a pixel, rows without padding.
    pub left_rgb: Option<&'a [u8]>,
    /// The right image in colour, likewise.
    pub right_rgb: Option<&'a [u8]>,
}

impl<'a> StereoPair<'a> {
    /// A pair without colour.
    pub const fn new(left: Gray<'a>, right: Gray<'a>) -> Self {
        Self { left, right, left_rgb: None, right_rgb: None }
    }
}

/// Disparity and confidence in the left view. Kept by the caller and filled again for each pair, so that nothing is
/// allocated after the first.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct DisparityMap {
    /// Pixels per row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Disparity in pixels, `width * height`, rows without padding; NaN where none was found. Never negative.
    pub disparity: Vec<f32>,
    /// Confidence of each, `width * height`: 0 for no disparity, else 1 (a guess) to 255.
    pub confidence: Vec<u8>,
}

impl DisparityMap {
    /// Gives it the size of a pair; allocates when it has grown.
    pub fn resize(&mut self, width: usize, height: usize) {
        (self.width, self.height) = (width, height);
        self.disparity.resize(width * height, f32::NAN);
        self.confidence.resize(width * height, 0);
    }

    /// Share of pixels that have a disparity, 0 to 1.
    pub fn fill(&self) -> f64 {
        let valid = self.disparity.iter().filter(|d| !d.is_nan()).count();
        valid as f64 / self.disparity.len().max(1) as f64
    }
}

/// Description of a matcher, for logs and for the origin of depth in a recording.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Description {
    /// Name and version of the method, such as `depthrig-sgm 0.1.0`.
    pub producer: String,
    /// Its variant, such as `quality`.
    pub name: String,
    /// Every parameter of the result, as `key=value` words.
    pub parameters: String,
    /// Bytes that it allocates when created; it takes no more while it runs.
    pub memory_bytes: u64,
}

/// Finds the disparity of the left image of rectified pairs of one size.
pub trait Matcher: Send {
    /// Describes the matcher.
    fn describe(&self) -> Description;

    /// Fills `out` (which it resizes) from a pair of the agreed size.
    ///
    /// # Errors
    /// [`ErrorKind::SizeMismatch`] for images of another size or with too few bytes; what else can fail is the
    /// matcher's own.
    fn run(&mut self, pair: &StereoPair<'_>, out: &mut DisparityMap) -> Result<()>;
}
