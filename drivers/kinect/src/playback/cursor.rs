//! Position in a recording that is played, round after round.

use crate::recording::{Pending, Recording, TrackKind};
use depthrig_driver::Result;

/// A place in a recording that is played once or without end.
pub(super) struct Cursor {
    pub(super) recording: Recording,
    looped: bool,
    /// Time from frame to frame, microseconds.
    period_us: u64,
    /// Time of the first image of the file.
    first_us: Option<u64>,
    /// Time of its last one so far.
    last_us: u64,
    /// Shift of this round against the first.
    shift_us: u64,
    /// Whether this round had anything that was wanted.
    is_fruitful: bool,
    ended: bool,
}

/// A block that is to be played.
#[derive(Debug, Clone, Copy)]
pub(super) struct Next {
    pub(super) block: Pending,
    /// Its time, this round's shift included: microseconds of the device's clock.
    pub(super) at_us: u64,
}

impl Cursor {
    pub(super) fn new(recording: Recording, looped: bool) -> Self {
        let of_images = |k| matches!(k, TrackKind::Color | TrackKind::Depth | TrackKind::Infrared);
        let periods = recording.tracks().iter().filter(|t| of_images(t.kind)).filter_map(|t| t.period_ns);
        let period_us = periods.max().unwrap_or(super::PERIOD_NS) / 1000;
        Self {
            recording,
            looped,
            period_us,
            first_us: None,
            last_us: 0,
            shift_us: 0,
            is_fruitful: false,
            ended: false,
        }
    }

    /// The next block of a track that `wanted` says yes to; `None` at the end.
    ///
    /// # Errors
    /// Those of reading the file.
    pub(super) fn next(&mut self, wanted: impl Fn(usize) -> bool) -> Result<Option<Next>> {
        while !self.ended {
            let Some(block) = self.recording.advance()? else {
                self.ended = !self.looped || !self.is_fruitful;
                // Blocks that only another reader of the file wants count too, so that both agree on the length.
                let length_us = self.last_us.saturating_sub(self.first_us.unwrap_or(0)) + self.period_us;
                self.shift_us = self.shift_us.saturating_add(length_us);
                self.recording.seek(0)?;
                self.is_fruitful = false;
                continue;
            };
            let at_us = block.device_us.saturating_add(self.shift_us);
            if self.recording.tracks().get(block.track).is_none_or(|t| t.pixels.is_none()) {
                // IMU samples, if they are wanted; how long a round is follows from images alone.
                if wanted(block.track) {
                    self.is_fruitful = true;
                    return Ok(Some(Next { block, at_us }));
                }
                continue;
            }
            self.first_us.get_or_insert(block.device_us);
            self.last_us = self.last_us.max(block.device_us);
            if wanted(block.track) {
                self.is_fruitful = true;
                return Ok(Some(Next { block, at_us }));
            }
        }
        Ok(None)
    }
}
