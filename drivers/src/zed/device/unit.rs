//! The motion unit of a camera that is opened, or why it cannot be read.

use crate::usb::{SysRoot, scan};
use crate::zed::find::{self, Found};
use crate::zed::hid::HidNode;
use crate::{Error, ErrorKind, Result};
use core::time::Duration;
use depthrig_bus::HostTime;

/// How long the unit may come after the video half. Both are devices of their own, so that a camera that was just plugged
/// in may have pictures before it has a unit, or before the system let this user open it.
const PATIENCE: Duration = Duration::from_secs(1);
/// How often it is looked for.
const LOOK: Duration = Duration::from_millis(50);

/// Opens the unit of the camera `found`, whose serial number decides over what the ports say, and notes it there.
///
/// # Errors
/// [`ErrorKind::BadInput`] when it is not wanted, [`ErrorKind::Unsupported`] when the model has none,
/// [`ErrorKind::NotFound`] when it is not seen, [`ErrorKind::PermissionDenied`]; all with the cure.
pub(super) fn open(found: &mut Found, serial: &str, is_unwanted: bool, root: &SysRoot) -> Result<HidNode> {
    if is_unwanted {
        // Which versions both halves have is said all the same.
        let _ = look(found, serial, root);
        let what = "`motion = false` in the rig file leaves the motion unit alone; take it out";
        return Err(Error::new(ErrorKind::BadInput, what));
    }
    if found.model.motion.is_none() {
        let what = format!("a {} has no motion unit", found.model.name);
        return Err(Error::new(ErrorKind::Unsupported, what));
    }
    let until = HostTime::now().plus(PATIENCE);
    loop {
        match try_open(found, serial, root) {
            Err(_) if !until.from_now().is_zero() => std::thread::sleep(LOOK),
            done => return done,
        }
    }
}

/// Notes the unit of the camera with this serial number.
fn look(found: &mut Found, serial: &str, root: &SysRoot) -> Result<()> {
    if let Some(unit) = find::motion_unit(&scan(root)?, found.model, serial) {
        found.motion = Some(unit.clone());
    } else if found.serial() != Some(serial) {
        found.motion = None;
    }
    Ok(())
}

fn try_open(found: &mut Found, serial: &str, root: &SysRoot) -> Result<HidNode> {
    look(found, serial, root)?;
    let Some(unit) = &found.motion else {
        let what = "its motion unit is not on the USB: plug the camera in anew, and not through a cable or hub that \
                    passes USB 3 alone, since the unit speaks USB 2";
        return Err(Error::new(ErrorKind::NotFound, what));
    };
    let Some(node) = unit.interfaces.iter().flat_map(|i| &i.hidraw_nodes).next() else {
        let what = format!(
            "its motion unit at USB port {} has no node /dev/hidraw…: load the kernel's module usbhid; the kernel needs \
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
    use crate::usb::made::{MadeDevice, MadeTree};

    /// A camera of this product, with a motion unit that has these nodes, or without one.
    fn tree(at: &std::path::Path, unit: Option<&[u32]>, product: u16) -> MadeTree {
        let tree = MadeTree::new(at);
        let video = MadeDevice {
            id: (0x2b03, product),
            interfaces: vec![(0, 0x0e, 1, "uvcvideo", vec![0, 1], vec![])],
            ..MadeDevice::new("1-2.1", 0)
        };
        let motion = MadeDevice {
            id: (0x2b03, 0xf881),
            strings: ["", "", "31234"],
            interfaces: vec![(0, 0x03, 0, "usbhid", vec![], unit.unwrap_or_default().to_vec())],
            ..MadeDevice::new("1-2.2", 0)
        };
        tree.plug(&video);
        if unit.is_some() {
            tree.plug(&motion);
        }
        tree
    }

    /// Why the unit of the camera in `tree` cannot be opened, and for how long it was looked for.
    fn refused(unit: Option<&[u32]>, product: u16, unwanted: bool) -> (ErrorKind, String, Duration) {
        let dir = tempfile::tempdir().unwrap();
        let tree = tree(dir.path(), unit, product);
        let mut cameras = find::cameras(tree.root(), &scan(tree.root()).unwrap());
        let began = HostTime::now();
        let e = open(&mut cameras[0], "31234", unwanted, tree.root()).err().unwrap();
        (e.kind(), e.to_string(), began.elapsed())
    }

    #[test]
    fn why_there_is_none_is_said_with_the_cure() {
        let (kind, text, took) = refused(Some(&[5]), 0xf880, true);
        assert_eq!(kind, ErrorKind::BadInput);
        assert!(text.contains("motion = false") && took < PATIENCE, "{text} after {took:?}");
        let (kind, text, took) = refused(Some(&[5]), 0xf582, false);
        assert_eq!((kind, text.as_str()), (ErrorKind::Unsupported, "a ZED has no motion unit"));
        assert!(took < PATIENCE);
        let (kind, text, took) = refused(None, 0xf880, false);
        assert_eq!(kind, ErrorKind::NotFound);
        assert!(text.contains("plug the camera in anew") && took >= PATIENCE, "{text} after {took:?}");
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
