//! The size of the network's input, and whether images are as large as they say.

use crate::arch::PATCH;
use crate::{Color, Error, ErrorKind, Output, RawDepth, Result};

/// The most patches of an input: 12 times as wide as high at 518. Attention grows with the square of it.
const MAX_PATCHES: usize = 16384;

/// The longest side of an image in multiples of the shorter one. The network sees the whole image with its shorter side at
/// the input size: of a strip of 640x3 that would be 24 million pixels for 1920.
const MAX_ASPECT: usize = 16;

/// Checks the shorter side of the network's input, pixels.
///
/// # Errors
/// [`ErrorKind::BadInput`] with the sizes that can be used.
pub fn check_input_size(input_size: u32) -> Result<()> {
    let most = MAX_PATCHES.isqrt() * PATCH;
    if (PATCH..=most).contains(&(input_size as usize)) {
        return Ok(());
    }
    let message =
        format!("input size {input_size} is out of range {PATCH}..={most}; the official script uses 518");
    Err(Error::new(ErrorKind::BadInput, message))
}

/// Width and height of the network's input for images of `image` (width, height): both scaled alike, so that the
/// shorter becomes `input_size`, then to the nearest multiple of 14 (halves to the even one), but not below `input_size`.
///
/// The official `Resize(…, keep_aspect_ratio=True, ensure_multiple_of=14, resize_method="lower_bound")`.
///
/// # Errors
/// [`ErrorKind::BadInput`] for an empty image, an input size that cannot be used, and an image so long and narrow that
/// the network's time and memory would not do.
pub fn net_size(width: usize, height: usize, input_size: u32) -> Result<(usize, usize)> {
    if width == 0 || height == 0 {
        return Err(Error::new(ErrorKind::BadInput, format!("an image of {width}x{height} has no pixels")));
    }
    check_input_size(input_size)?;
    if width.max(height) > MAX_ASPECT.saturating_mul(width.min(height)) {
        let message = format!(
            "an image of {width}x{height} is too narrow for the network, which takes at most {MAX_ASPECT}:1; crop it"
        );
        return Err(Error::new(ErrorKind::BadInput, message));
    }
    let least = f64::from(input_size);
    let scale = (least / height as f64).max(least / width as f64);
    let side = |length: usize| {
        let patch = PATCH as f64;
        let wanted = scale * length as f64;
        let nearest = (wanted / patch).round_ties_even() * patch;
        (if nearest < least { (wanted / patch).ceil() * patch } else { nearest }) as usize
    };
    let w = side(width);
    let h = side(height);
    if (w / PATCH).saturating_mul(h / PATCH) > MAX_PATCHES {
        let message = format!(
            "an image of {width}x{height} at input size {input_size} is {w}x{h} for the network, which is too large; \
             use a smaller input size, or cut the image"
        );
        return Err(Error::new(ErrorKind::BadInput, message));
    }
    Ok((w, h))
}

pub(super) fn check_len(what: &str, is: usize, should: usize) -> Result<()> {
    if is == should {
        return Ok(());
    }
    let message = format!("{what} has {is} numbers and needs {should}; prepare for the size that is used");
    Err(Error::new(ErrorKind::SizeMismatch, message))
}

pub(super) fn check_image(width: usize, height: usize, color: &Color<'_>) -> Result<()> {
    if (width, height) == (color.width, color.height) {
        return Ok(());
    }
    let message = format!(
        "the colour image is {}x{} and {width}x{height} was prepared for; prepare for the size that is used",
        color.width, color.height
    );
    Err(Error::new(ErrorKind::SizeMismatch, message))
}

fn check_unit(what: &str, unit_m: f64) -> Result<()> {
    if unit_m.is_finite() && unit_m > 0.0 {
        return Ok(());
    }
    let message = format!("{what}: invalid depth unit {unit_m} m; it must be above 0, such as 0.001");
    Err(Error::new(ErrorKind::BadInput, message))
}

impl Color<'_> {
    /// Whether the bytes are as many as the size says.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] for an image without pixels, a stride below the width, and bytes that are missing.
    pub fn check(&self) -> Result<()> {
        let Self { width, height, stride, .. } = *self;
        let line = width.saturating_mul(3);
        let needed = stride.checked_mul(height.saturating_sub(1)).and_then(|n| n.checked_add(line));
        let message = if width == 0 || height == 0 {
            format!("the colour image is {width}x{height}: it has no pixels")
        } else if stride < line {
            format!("the colour image's rows are {stride} bytes apart, but {width} pixels need {line}")
        } else if needed.is_none_or(|n| self.pixels.len() < n) {
            let is = self.pixels.len();
            format!(
                "the colour image of {width}x{height}, rows {stride} bytes apart, is cut short at {is} bytes"
            )
        } else {
            return Ok(());
        };
        Err(Error::new(ErrorKind::BadInput, message))
    }

    /// The bytes of row `y`, without padding; [`Self::check`] has proven that they are there.
    pub(crate) fn row(&self, y: usize) -> &[u8] {
        &self.pixels[y * self.stride..][..3 * self.width]
    }
}

impl RawDepth<'_> {
    /// Whether there are as many pixels as in `color`, and the unit is one.
    ///
    /// # Errors
    /// [`ErrorKind::SizeMismatch`] and [`ErrorKind::BadInput`].
    pub fn check(&self, color: &Color<'_>) -> Result<()> {
        let is = self.pixels.len();
        let should = color.width * color.height;
        if is != should {
            let message = format!(
                "raw depth has {is} pixels and colour {}x{}, {should}; register depth to the colour camera's view first",
                color.width, color.height
            );
            return Err(Error::new(ErrorKind::SizeMismatch, message));
        }
        check_unit("raw depth", self.unit_m)
    }
}

impl Output<'_> {
    /// Pixels of the output.
    pub const fn len(&self) -> usize {
        match self {
            Self::Units { pixels, .. } => pixels.len(),
            Self::Metres(pixels) | Self::Inverse(pixels) => pixels.len(),
        }
    }

    /// Returns whether the buffer is empty.
    pub const fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Checks that it has room for images of `width` and `height`, and that its unit is valid.
    ///
    /// # Errors
    /// [`ErrorKind::SizeMismatch`] and [`ErrorKind::BadInput`].
    pub fn check(&self, width: usize, height: usize) -> Result<()> {
        let is = self.len();
        let should = width * height;
        if is != should {
            let message = format!(
                "the output has room for {is} pixels, and the colour image is {width}x{height}, {should}"
            );
            return Err(Error::new(ErrorKind::SizeMismatch, message));
        }
        match self {
            Self::Units { unit_m, .. } => check_unit("refined depth", *unit_m),
            Self::Metres(_) | Self::Inverse(_) => Ok(()),
        }
    }

    /// Makes every pixel a hole.
    pub fn clear(&mut self) {
        match self {
            Self::Units { pixels, .. } => pixels.fill(0),
            Self::Metres(pixels) | Self::Inverse(pixels) => pixels.fill(0.0),
        }
    }
}
