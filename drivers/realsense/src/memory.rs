//! Remembers facts about a camera from one opening to the next.
//!
//! A camera that sends no image is first opened again, which stops and starts its streams; the supervisor does that.
//! When that did not help and the rig allows it, the next opening restarts the camera (librealsense's own recipe for
//! "frames didn't arrive": streams off and on, then a hardware reset, then a new start).

use core::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use core::time::Duration;

/// A stream that ends after this long without an image ended because of it. Supervisors wait longer.
const SILENCE: Duration = Duration::from_secs(2);
/// Silent openings in a row after which a restart of the camera is due.
const SILENT_OPENINGS: u32 = 2;

/// The remembered facts, shared between the backend and its streams.
#[derive(Debug, Default)]
pub(super) struct Memory {
    silent: AtomicU32,
    mute: AtomicBool,
}

impl Memory {
    /// An image came.
    pub(super) fn note_image(&self) {
        self.silent.store(0, Ordering::Relaxed);
    }

    /// A stream was ended that had no image for `silence`.
    pub(super) fn note_end(&self, silence: Duration) {
        if silence >= SILENCE {
            self.silent.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// The camera sends images without the metadata that the kernel offers.
    pub(super) fn note_mute(&self) {
        self.mute.store(true, Ordering::Relaxed);
    }

    /// Whether metadata is not worth asking for.
    pub(super) fn is_mute(&self) -> bool {
        self.mute.load(Ordering::Relaxed)
    }

    /// Whether a restart of the camera is due; it is then taken for done.
    pub(super) fn take_reset(&self) -> bool {
        let due = self.silent.load(Ordering::Relaxed) >= SILENT_OPENINGS;
        if due {
            self.silent.store(0, Ordering::Relaxed);
        }
        due
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_restart_is_due_after_two_silent_openings_in_a_row() {
        let memory = Memory::default();
        memory.note_end(Duration::from_secs(4));
        assert!(!memory.take_reset(), "first the streams are started again");
        memory.note_image();
        memory.note_end(Duration::from_secs(4));
        assert!(!memory.take_reset(), "they helped in between");
        memory.note_end(Duration::from_secs(1));
        assert!(!memory.take_reset(), "an ordinary end");
        memory.note_end(Duration::from_secs(4));
        assert!(memory.take_reset());
        assert!(!memory.take_reset(), "once");
    }
}
