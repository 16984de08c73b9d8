//! Numbers of the frames of a stream that comes from another computer.

use depthrig_bus::{DropCounts, DropReason, FrameHeader};

/// Counts the frames as this computer publishes them: 1, 2, 3, ... without a gap, and what was lost before, as every header has it.
#[derive(Debug, Default)]
pub(super) struct Numbers {
    published: u64,
    dropped: DropCounts,
    /// The last frame, as it was numbered there.
    before: Option<FrameHeader>,
}

impl Numbers {
    /// Whether this frame is the one that came last.
    pub(super) fn is_last(&self, h: &FrameHeader) -> bool {
        self.before.is_some_and(|b| {
            let key = |h: &FrameHeader| (h.sequence, h.device_sequence, h.device_time);
            key(&b) == key(h)
        })
    }

    /// A frame came: counts what was lost before it. Returns the time from one frame to the next, nanoseconds, if it is known.
    pub(super) fn came(&mut self, h: &FrameHeader) -> Option<i64> {
        let before = self.before.replace(*h).filter(|b| b.sequence < h.sequence)?;
        let steps = h.sequence - before.sequence;
        self.dropped.add(DropReason::QueueFull, steps - 1);
        for (reason, now) in DropReason::ALL.into_iter().zip(h.dropped) {
            self.dropped.add(reason, now.saturating_sub(before.drops().get(reason)));
        }
        let between = h.capture_time_ns.saturating_sub(before.capture_time_ns);
        Some(between / i64::try_from(steps).unwrap_or(i64::MAX))
    }

    /// Nobody reads: what comes from now on until the next frame is not lost.
    pub(super) const fn rest(&mut self) {
        self.before = None;
    }

    /// It could not be published.
    pub(super) fn lost(&mut self, reason: DropReason) {
        self.dropped.add(reason, 1);
    }

    /// It is published: numbers it as one of this channel. Frames that it was computed from have their numbers on another
    /// computer; here they are known by their capture times.
    pub(super) fn number(&mut self, h: &mut FrameHeader) {
        self.published += 1;
        h.sequence = self.published;
        h.dropped = self.dropped.0;
        h.captured = self.published.saturating_add(self.dropped.total());
        (h.source_sequence, h.source_color_sequence) = (0, 0);
    }

    /// Frames that are published here.
    pub(super) const fn published(&self) -> u64 {
        self.published
    }

    /// Frames that were left out on the way.
    pub(super) const fn skipped(&self) -> u64 {
        self.dropped.get(DropReason::QueueFull)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        /// A source that captures, drops, and starts anew; a way that carries some of its frames; a reader's account.
        #[test]
        fn every_frame_is_published_or_counted(
            steps in proptest::collection::vec((0..10_u32, 0..3_u64, any::<bool>()), 1..60)
        ) {
            let mut numbers = Numbers::default();
            let mut source = FrameHeader::default();
            // Frames that the source published or lost since the first one that came.
            let mut captured = 0;
            let mut has_begun = false;
            let mut published = 0;
            let mut has_restarted = false;
            for (kind, drops, has_slot) in steps {
                if kind == 9 {
                    // Started anew: what it lost since the last frame that came is not known.
                    source = FrameHeader { device_time: source.device_time + 1, ..FrameHeader::default() };
                    (has_begun, has_restarted) = (false, true);
                }
                source.sequence += 1;
                source.device_sequence += 1 + drops;
                source.device_time += 1 + drops;
                source.capture_time_ns += 33 * (1 + drops as i64);
                source.dropped[DropReason::DeviceGap as usize] += drops;
                captured += if has_begun { 1 + drops } else { 0 };
                if kind < 4 {
                    continue; // left out on the way
                }
                prop_assert!(!numbers.is_last(&source));
                numbers.came(&source);
                prop_assert!(numbers.is_last(&source));
                captured += u64::from(!has_begun);
                has_begun = true;
                if !has_slot {
                    numbers.lost(DropReason::NoSlot);
                    continue;
                }
                let mut h = source;
                numbers.number(&mut h);
                published += 1;
                prop_assert_eq!(h.sequence, published);
                prop_assert_eq!(h.captured, h.sequence + h.drops().total());
                // What was left out right before a restart is not known.
                prop_assert!(has_restarted || h.captured == captured);
            }
        }
    }

    #[test]
    fn left_out_frames_are_counted_and_give_the_period() {
        let mut numbers = Numbers::default();
        let frame = |sequence: u64, capture_time_ns: i64| FrameHeader {
            sequence,
            capture_time_ns,
            ..FrameHeader::default()
        };
        assert_eq!(numbers.came(&frame(5, 100)), None);
        assert_eq!(numbers.came(&frame(8, 190)), Some(30));
        assert_eq!(numbers.skipped(), 2);
        assert_eq!(numbers.came(&frame(1, 300)), None, "it started anew");
        assert_eq!(numbers.skipped(), 2);
        numbers.rest();
        assert_eq!(numbers.came(&frame(90, 3000)), None, "nobody read the frames between");
        assert_eq!(numbers.skipped(), 2);
    }
}
