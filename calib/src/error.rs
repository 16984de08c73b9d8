//! The error of the crate: a kind to match on, and what happened to what.

/// Kind of the error, for callers that match on it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum ErrorKind {
    /// A camera has no calibration.
    NoCalibration,
    /// An image differs from the agreed size.
    SizeMismatch,
    /// Invalid numbers for a camera, a pose or an image.
    BadInput,
    /// A file could not be written.
    Io,
}

depthrig_bus::error_type! {
    /// An error of camera geometry.
}

/// Refuses a slice that is not of the agreed length.
pub(crate) fn check_len(
    what: &str,
    have: usize,
    (width, height): (usize, usize),
    per_pixel: usize,
) -> Result<()> {
    let want = width * height * per_pixel;
    if have == want {
        return Ok(());
    }
    Err(Error::new(
        ErrorKind::SizeMismatch,
        format!(
            "{what} has {have} elements where {width}x{height} pixels have {want}; give it the size that was agreed on"
        ),
    ))
}
