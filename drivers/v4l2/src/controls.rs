//! A node's controls, as the kernel lists them.

use super::ioctl::{self, text};
use depthrig_usb::controls::{Control, ControlKind, plain_name};
use std::io;
use std::os::fd::RawFd;
use v4l::v4l_sys as sys;

/// Every control of the node that can be written or read one by one.
pub(super) fn enumerate(fd: RawFd) -> io::Result<Vec<Control>> {
    let mut controls = Vec::new();
    let mut id = 0;
    // Bounded, should a driver not end its list.
    while controls.len() < 1024 {
        let next = match ioctl::next_control(fd, id) {
            Ok(Some(next)) => next,
            Ok(None) => break,
            // A node without any controls (metadata).
            Err(e) if e.raw_os_error() == Some(rustix::io::Errno::NOTTY.raw_os_error()) => break,
            Err(e) => return Err(e),
        };
        if next.id <= id {
            break;
        }
        id = next.id;
        if next.type_ == sys::v4l2_ctrl_type_V4L2_CTRL_TYPE_CTRL_CLASS
            || next.flags & sys::V4L2_CTRL_FLAG_DISABLED != 0
        {
            continue;
        }
        let kind = kind_of(next.type_);
        let items = match kind {
            ControlKind::Menu | ControlKind::IntegerMenu => menu(fd, &next, kind)?,
            _ => Vec::new(),
        };
        controls.push(Control {
            id,
            name: plain_name(&text(&next.name.map(|c| c as u8))),
            kind,
            minimum: next.minimum,
            maximum: next.maximum,
            step: next.step,
            default: next.default_value,
            read_only: next.flags & sys::V4L2_CTRL_FLAG_READ_ONLY != 0,
            write_only: next.flags & sys::V4L2_CTRL_FLAG_WRITE_ONLY != 0,
            inactive: next.flags & sys::V4L2_CTRL_FLAG_INACTIVE != 0,
            items,
        });
    }
    Ok(controls)
}

fn menu(fd: RawFd, c: &sys::v4l2_query_ext_ctrl, kind: ControlKind) -> io::Result<Vec<(i64, String)>> {
    let mut items = Vec::new();
    // A device that claims millions of items is not believed.
    for value in c.minimum.max(0)..=c.maximum.min(255) {
        if let Some(name) = ioctl::menu_item(fd, c.id, value as u32, kind == ControlKind::IntegerMenu)? {
            items.push((value, name));
        }
    }
    Ok(items)
}

const fn kind_of(kind: u32) -> ControlKind {
    match kind {
        sys::v4l2_ctrl_type_V4L2_CTRL_TYPE_INTEGER => ControlKind::Integer,
        sys::v4l2_ctrl_type_V4L2_CTRL_TYPE_INTEGER64 => ControlKind::Integer64,
        sys::v4l2_ctrl_type_V4L2_CTRL_TYPE_BOOLEAN => ControlKind::Boolean,
        sys::v4l2_ctrl_type_V4L2_CTRL_TYPE_MENU => ControlKind::Menu,
        sys::v4l2_ctrl_type_V4L2_CTRL_TYPE_INTEGER_MENU => ControlKind::IntegerMenu,
        sys::v4l2_ctrl_type_V4L2_CTRL_TYPE_BITMASK => ControlKind::Bitmask,
        sys::v4l2_ctrl_type_V4L2_CTRL_TYPE_BUTTON => ControlKind::Button,
        _ => ControlKind::Other,
    }
}
