//! Collects libk4a's log messages: its functions only report that they failed, its messages say why.
#![allow(unsafe_code)] // libk4a calls a function of this module

use super::ffi;
use core::ffi::{CStr, c_char, c_int, c_void};
use depthrig_bus::sync::lock;
use std::collections::VecDeque;
use std::sync::Mutex;

/// So many messages are kept; libk4a says a dozen about one failure.
const KEPT: usize = 48;
/// Characters of a message that are kept; libk4a's own limit is 1024.
const LONGEST: usize = 400;

/// The last messages of a library, whichever camera they are about: libk4a does not say.
#[derive(Debug, Default)]
pub struct Journal {
    lines: Mutex<VecDeque<String>>,
}

impl Journal {
    /// Forgets what was said so far.
    pub fn clear(&self) {
        lock(&self.lines).clear();
    }

    /// The messages, the oldest first.
    pub fn lines(&self) -> Vec<String> {
        lock(&self.lines).iter().cloned().collect()
    }

    fn note(&self, level: u32, message: &str) {
        let message: String =
            message.trim().chars().map(|c| if c.is_control() { ' ' } else { c }).take(LONGEST).collect();
        tracing::debug!(target: "libk4a", level, "{message}");
        let mut lines = lock(&self.lines);
        if lines.len() >= KEPT {
            lines.pop_front();
        }
        lines.push_back(message);
    }
}

/// The callback for libk4a's messages; `context` is the [`Journal`] that was registered with it.
///
/// # Safety
/// `context` must point to a [`Journal`] that lives for as long as the library, or be null, and `message` to text that
/// ends with a zero byte, or be null.
pub unsafe extern "C" fn on_message(
    context: *mut c_void,
    level: u32,
    _file: *const c_char,
    _line: c_int,
    message: *const c_char,
) {
    // SAFETY: as the caller promises.
    let Some(journal) = (unsafe { context.cast::<Journal>().as_ref() }) else { return };
    if message.is_null() || level > ffi::LOG_WARNING {
        return;
    }
    // SAFETY: it is not null, and the caller promises the rest.
    let text = unsafe { CStr::from_ptr(message) };
    journal.note(level, &text.to_string_lossy());
}

/// The cause of a failure, from libk4a's messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Cause {
    /// Another process has claimed the camera.
    Busy,
    /// This user may not open it.
    Denied,
    /// It is not there any more.
    Gone,
    /// The depth engine was not found.
    NoEngine,
    /// The depth engine got no OpenGL context, or the graphics card gave up.
    NoGraphics,
    /// The firmware is too old.
    OldFirmware,
    /// A cable for synchronisation is missing.
    NoSyncCable,
    /// The kernel has no memory for its USB transfers.
    NoUsbMemory,
    /// The messages do not say.
    Unknown,
}

/// The causes by a part of the message, as the sources of libk4a 1.4 have it (`usbcommand.c`, `usbstreaming.c`,
/// `deloader.cpp`, `dewrapper.c`, `depth.c`, `k4a.c`). The first match counts.
const CAUSES: [(&str, Cause); 14] = [
    ("LIBUSB_ERROR_BUSY", Cause::Busy),
    ("LIBUSB_ERROR_ACCESS", Cause::Denied),
    // Said when every camera refused this user, and spelt like this.
    ("device(s) are all unava", Cause::Denied),
    ("LIBUSB_ERROR_NO_MEM", Cause::NoUsbMemory),
    ("Failed to Load Depth Engine Plugin", Cause::NoEngine),
    ("Failed to load depth engine plugin", Cause::NoEngine),
    ("OpenGL 4.4 context creation failed", Cause::NoGraphics),
    // The engine's codes from 201 to 208 are the graphics card's (`k4aplugin.h`).
    ("initialize failed with error code: 20", Cause::NoGraphics),
    ("GPU has encountered an unrecoverable error", Cause::NoGraphics),
    ("is not current enough", Cause::OldFirmware),
    ("presence of sync in cable", Cause::NoSyncCable),
    ("presence of sync out cable", Cause::NoSyncCable),
    ("LIBUSB_ERROR_NO_DEVICE", Cause::Gone),
    ("LIBUSB_TRANSFER_NO_DEVICE", Cause::Gone),
];

/// The cause that `lines` show.
pub fn cause(lines: &[String]) -> Cause {
    let found = CAUSES.iter().find(|(part, _)| lines.iter().any(|l| l.contains(part)));
    found.map_or(Cause::Unknown, |(_, cause)| *cause)
}

/// `; libk4a says: …` with the message that the cause was read from, else the first; empty without messages.
pub fn quote(lines: &[String]) -> String {
    let cause_line = CAUSES.iter().find_map(|(part, _)| lines.iter().find(|l| l.contains(part)));
    cause_line.or(lines.first()).map_or_else(String::new, |line| format!("; libk4a says: {line}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn say(journal: &Journal, level: u32, text: &CStr) {
        let context = core::ptr::from_ref(journal).cast_mut().cast();
        // SAFETY: the journal outlives the call, the text ends with a zero byte.
        unsafe { on_message(context, level, core::ptr::null(), 1, text.as_ptr()) };
    }

    #[test]
    fn messages_are_kept_in_bounds_and_tell_the_cause() {
        let journal = Journal::default();
        for _ in 0..100 {
            say(&journal, 1, c"depthmcu_create(index) returned failure");
        }
        assert_eq!(journal.lines().len(), KEPT);
        assert_eq!(cause(&journal.lines()), Cause::Unknown);
        say(
            &journal,
            1,
            c"usbcommand.c (421): libusb_claim_interface returned LIBUSB_ERROR_BUSY in usb_cmd_create",
        );
        assert_eq!(cause(&journal.lines()), Cause::Busy);
        assert!(quote(&journal.lines()).ends_with("LIBUSB_ERROR_BUSY in usb_cmd_create"));
        journal.clear();
        assert_eq!(quote(&journal.lines()), "");
        say(&journal, 4, c"trace is not kept");
        say(&journal, ffi::LOG_WARNING, c"two\nlines\x1b[0m");
        assert_eq!(journal.lines(), ["two lines [0m"]);
    }

    #[test]
    fn null_is_nothing() {
        // SAFETY: null is allowed for both.
        unsafe {
            on_message(core::ptr::null_mut(), 0, core::ptr::null(), 0, c"x".as_ptr());
        }
        let journal = Journal::default();
        let context = core::ptr::from_ref(&journal).cast_mut().cast();
        // SAFETY: the journal outlives the call; no text is allowed.
        unsafe { on_message(context, 0, core::ptr::null(), 0, core::ptr::null()) };
        assert!(journal.lines().is_empty());
    }
}
