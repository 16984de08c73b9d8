//! A D400 through libusb, for computers whose kernel has no driver for it or gives no metadata.

use super::find::Found;
use super::transport::Transport;
use crate::{Error, ErrorKind, Result};

/// Opens the camera, taking it from the kernel's driver for as long as it is open.
///
/// # Errors
/// [`ErrorKind::Busy`], [`ErrorKind::PermissionDenied`], [`ErrorKind::Disconnected`], [`ErrorKind::Io`].
pub(super) fn open(found: &Found) -> Result<Box<dyn Transport>> {
    let text = format!("{}: this build reaches cameras through the kernel's driver alone", found.describe());
    Err(Error::new(ErrorKind::Unsupported, text))
}
