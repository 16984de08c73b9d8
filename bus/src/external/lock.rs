//! Who serves a camera: a lock that the kernel frees with the process, however that ends.

use super::LOCK_SUFFIX;
use crate::{CameraName, ErrorKind, Result, RigName, RuntimeDir};
use std::path::PathBuf;

/// The right to serve a camera; dropping it frees the camera.
#[derive(Debug)]
pub struct ExternalLock {
    _file: std::fs::File,
}

fn path(runtime: &RuntimeDir, rig: &RigName, camera: &CameraName) -> PathBuf {
    runtime.path().join(format!("{rig}.{camera}{LOCK_SUFFIX}"))
}

/// Takes the right to serve `camera` of `rig`. `who` is shown to others that want it.
///
/// # Errors
/// [`ErrorKind::InUse`] naming the process that serves it, [`ErrorKind::PermissionDenied`] when the file cannot be
/// opened.
pub fn lock(runtime: &RuntimeDir, rig: &RigName, camera: &CameraName, who: &str) -> Result<ExternalLock> {
    let path = path(runtime, rig, camera);
    let Some(file) = crate::runtime::take(&path, who)? else {
        let holder = crate::runtime::holder_of(&path).unwrap_or_else(|| "another process".to_owned());
        return Err(crate::Error::new(
            ErrorKind::InUse,
            format!(
                "camera \"{camera}\" of rig \"{rig}\" is served already, by {holder}; end that first, or serve another camera"
            ),
        ));
    };
    Ok(ExternalLock { _file: file })
}

/// Who serves `camera` of `rig` now, as that process described itself; `None` when nobody does.
pub fn holder(runtime: &RuntimeDir, rig: &RigName, camera: &CameraName) -> Option<String> {
    crate::runtime::holder_of(&path(runtime, rig, camera))
}
