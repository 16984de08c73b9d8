//! Lock of a served camera, which the kernel frees when the process ends, however it ends.

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
/// [`ErrorKind::InUse`] naming the process that serves it, [`ErrorKind::PermissionDenied`] when the file
/// cannot be opened.
pub fn lock_camera(
    runtime: &RuntimeDir,
    rig: &RigName,
    camera: &CameraName,
    who: &str,
) -> Result<ExternalLock> {
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

/// The process that serves `camera` of `rig` now, in its own words; `None` without one.
pub fn holder(runtime: &RuntimeDir, rig: &RigName, camera: &CameraName) -> Option<String> {
    crate::runtime::holder_of(&path(runtime, rig, camera))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Name;
    use crate::external::served;

    #[test]
    fn a_camera_is_served_once_and_by_whom_is_known() {
        let tmp = tempfile::tempdir().unwrap();
        let runtime = RuntimeDir::at(tmp.path()).unwrap();
        let name = |n: &str| Name::new(n).unwrap();
        let rig = name("mount");
        let front = name("front");
        let back = name("back");
        assert_eq!(holder(&runtime, &rig, &front), None);
        let first = lock_camera(&runtime, &rig, &front, "process 42 (cam)").unwrap();
        let e = lock_camera(&runtime, &rig, &front, "process 43 (cam)").unwrap_err();
        assert_eq!(e.kind(), ErrorKind::InUse);
        assert!(e.to_string().contains("process 42 (cam)"), "{e}");
        let _other = lock_camera(&runtime, &rig, &back, "process 43 (cam)").unwrap();
        let _other_rig = lock_camera(&runtime, &name("a"), &front, "process 44 (cam)").unwrap();
        let all: Vec<_> =
            served(&runtime).into_iter().map(|(p, who)| format!("{}/{} {who}", p.rig, p.camera)).collect();
        assert_eq!(
            all,
            ["a/front process 44 (cam)", "mount/back process 43 (cam)", "mount/front process 42 (cam)"]
        );
        assert!(runtime.running_rigs().is_empty(), "a camera's lock is not a rig's");
        drop(first);
        assert_eq!(holder(&runtime, &rig, &front), None);
        lock_camera(&runtime, &rig, &front, "process 43 (cam)").unwrap();
    }
}
