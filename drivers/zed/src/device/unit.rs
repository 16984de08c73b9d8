//! Opens the IMU of a camera, or reports why it cannot be read.

use crate::find::{self, FoundCamera};
use crate::hid::HidNode;
use core::time::Duration;
use depthrig_bus::HostTime;
use depthrig_driver::{Error, ErrorKind, Result};
use depthrig_usb::{SysRoot, scan};

/// How long the IMU may come after the video half. Both are devices of their own, so that a camera that was just
/// plugged in may have images before it has an IMU, or before the system let this user open it.
const TIMEOUT: Duration = Duration::from_secs(1);
/// Period of the search for it.
const LOOK: Duration = Duration::from_millis(50);

/// Opens the IMU of the camera `found` and notes it there. The serial number takes precedence over the ports.
///
/// # Errors
/// [`ErrorKind::BadInput`] when the rig file excludes it, [`ErrorKind::Unsupported`] when the model has none,
/// [`ErrorKind::NotFound`] when it is not seen, [`ErrorKind::PermissionDenied`]; all with the cure.
pub(super) fn open(
    found: &mut FoundCamera,
    serial: &str,
    is_unwanted: bool,
    root: &SysRoot,
) -> Result<HidNode> {
    if is_unwanted {
        // The firmware versions of both halves are reported all the same.
        let _ = look(found, serial, root);
        let what = "`motion = false` in the rig file leaves the IMU alone; take it out";
        return Err(Error::new(ErrorKind::BadInput, what));
    }
    if found.model.motion.is_none() {
        let what = format!("a {} has no IMU", found.model.name);
        return Err(Error::new(ErrorKind::Unsupported, what));
    }
    let until = HostTime::now().plus(TIMEOUT);
    loop {
        match try_open(found, serial, root) {
            Err(_) if !until.from_now().is_zero() => std::thread::sleep(LOOK),
            done => return done,
        }
    }
}

/// Notes the IMU of the camera with this serial number.
fn look(found: &mut FoundCamera, serial: &str, root: &SysRoot) -> Result<()> {
    if let Some(unit) = find::imu(&scan(root)?, found.model, serial) {
        found.motion = Some(unit.clone());
    } else if found.serial() != Some(serial) {
        found.motion = None;
    }
    Ok(())
}

fn try_open(found: &mut FoundCamera, serial: &str, root: &SysRoot) -> Result<HidNode> {
    look(found, serial, root)?;
    let Some(unit) = &found.motion else {
        let what = "its IMU is not on the USB: plug the camera in anew, and not through a cable or hub that \
                    passes USB 3 alone, since the IMU speaks USB 2";
        return Err(Error::new(ErrorKind::NotFound, what));
    };
    let Some(node) = unit.interfaces.iter().flat_map(|i| &i.hidraw_nodes).next() else {
        let what = format!(
            "its IMU at USB port {} has no node /dev/hidraw…: load the kernel's module usbhid; the kernel needs \
             CONFIG_HIDRAW",
            unit.port
        );
        return Err(Error::new(ErrorKind::NotFound, what));
    };
    HidNode::open(node)
}

#[cfg(test)]
mod tests {
    use super::*;
    use depthrig_usb::fake::{FakeDevice, FakeTree};

    /// A camera of this product, with an IMU that has these nodes, or without one.
    fn tree(at: &std::path::Path, unit: Option<&[u32]>, product: u16) -> FakeTree {
        let tree = FakeTree::new(at);
        let video = FakeDevice {
            id: (0x2b03, product),
            interfaces: vec![(0, 0x0e, 1, "uvcvideo", vec![0, 1], vec![])],
            ..FakeDevice::new("1-2.1", 0)
        };
        let motion = FakeDevice {
            id: (0x2b03, 0xf881),
            strings: ["", "", "31234"],
            interfaces: vec![(0, 0x03, 0, "usbhid", vec![], unit.unwrap_or_default().to_vec())],
            ..FakeDevice::new("1-2.2", 0)
        };
        tree.plug(&video);
        if unit.is_some() {
            tree.plug(&motion);
        }
        tree
    }

    /// Why the IMU of the camera in `tree` cannot be opened, and for how long it was looked for.
    fn refused(unit: Option<&[u32]>, product: u16, unwanted: bool) -> (ErrorKind, String, Duration) {
        let dir = tempfile::tempdir().unwrap();
        let tree = tree(dir.path(), unit, product);
        let mut cameras = find::cameras(tree.root(), &scan(tree.root()).unwrap());
        let began = HostTime::now();
        let e = open(&mut cameras[0], "31234", unwanted, tree.root()).err().unwrap();
        (e.kind(), e.to_string(), began.elapsed())
    }

    #[test]
    fn a_missing_imu_is_reported_with_the_cure() {
        let (kind, text, took) = refused(Some(&[5]), 0xf880, true);
        assert_eq!(kind, ErrorKind::BadInput);
        assert!(text.contains("motion = false") && took < TIMEOUT, "{text} after {took:?}");
        let (kind, text, took) = refused(Some(&[5]), 0xf582, false);
        assert_eq!((kind, text.as_str()), (ErrorKind::Unsupported, "a ZED has no IMU"));
        assert!(took < TIMEOUT);
        let (kind, text, took) = refused(None, 0xf880, false);
        assert_eq!(kind, ErrorKind::NotFound);
        assert!(text.contains("plug the camera in anew") && took >= TIMEOUT, "{text} after {took:?}");
        let (kind, text, _) = refused(Some(&[]), 0xf880, false);
        assert_eq!(kind, ErrorKind::NotFound);
        assert!(text.contains("1-2.2 has no node /dev/hidraw") && text.contains("usbhid"), "{text}");
        let dir = tempfile::tempdir().unwrap();
        let tree = tree(dir.path(), Some(&[5]), 0xf880);
        let mut cameras = find::cameras(tree.root(), &scan(tree.root()).unwrap());
        assert!(open(&mut cameras[0], "31234", false, tree.root()).is_ok());
        assert_eq!(cameras[0].serial(), Some("31234"));
        std::fs::remove_file(dir.path().join("dev/hidraw5")).unwrap();
        let e = open(&mut cameras[0], "31234", false, tree.root()).err().unwrap();
        assert!(e.kind() == ErrorKind::NotFound && e.to_string().contains("hidraw5 cannot be opened"), "{e}");
    }
}
