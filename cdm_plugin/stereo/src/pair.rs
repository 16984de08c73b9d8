//! The images of one stereo pair on their way between threads: raw, then rectified.

use super::newest::ForSet;
use depthrig_driver::moments::Due;

/// The raw images of a pair.
#[derive(Debug, Default)]
pub(super) struct Raw {
    pub(super) ticket: u64,
    /// The frame set that it is for.
    pub(super) due: Option<Due>,
    /// Whether it is to be matched, and not merely rectified.
    pub(super) matched: bool,
    pub(super) left: Vec<u8>,
    pub(super) right: Vec<u8>,
}

/// The rectified images of a pair.
#[derive(Debug, Default)]
pub(super) struct Views {
    pub(super) ticket: u64,
    pub(super) due: Option<Due>,
    /// How many corrections of the rows went before.
    pub(super) corrections: u64,
    pub(super) left: Vec<u8>,
    pub(super) right: Vec<u8>,
    /// Empty without colour images.
    pub(super) left_rgb: Vec<u8>,
    /// Filled when a mode wants colour.
    pub(super) right_rgb: Vec<u8>,
}

impl ForSet for Raw {
    fn due(&self) -> Option<&Due> {
        self.due.as_ref()
    }
}

impl ForSet for Views {
    fn due(&self) -> Option<&Due> {
        self.due.as_ref()
    }
}
