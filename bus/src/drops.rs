//! Why frames get lost, and how many: every drop in depthrig has one of these reasons.

use serde::{Deserialize, Serialize};

/// The reason for which a frame that a camera captured never reached its channel.
///
/// The discriminant is the index into [`DropCounts`] and into `FrameHeader::dropped`; it is part of the
/// wire format and never changes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u32)]
#[non_exhaustive]
pub enum DropReason {
    /// The device's frame counter jumped: the frame was lost before it reached this computer.
    DeviceGap = 0,
    /// Fewer bytes arrived than the frame has.
    Incomplete = 1,
    /// The bytes that arrived cannot be a frame of the agreed size or cannot be decoded.
    WrongSize = 2,
    /// The device or the transport flagged the frame as damaged.
    DeviceError = 3,
    /// The frame repeats or precedes one that was already delivered.
    OutOfOrder = 4,
    /// No free slot in shared memory: subscribers hold them all.
    NoSlot = 5,
    /// The frame came from a driver thread that had been given up for hung.
    Abandoned = 6,
    /// The stage downstream was busy and its bounded queue was full.
    QueueFull = 7,
}

impl DropReason {
    /// Every reason, in wire order.
    pub const ALL: [Self; 8] = [
        Self::DeviceGap,
        Self::Incomplete,
        Self::WrongSize,
        Self::DeviceError,
        Self::OutOfOrder,
        Self::NoSlot,
        Self::Abandoned,
        Self::QueueFull,
    ];

    /// The name used in reports, metrics and JSON.
    pub const fn name(self) -> &'static str {
        match self {
            Self::DeviceGap => "device_gap",
            Self::Incomplete => "incomplete",
            Self::WrongSize => "wrong_size",
            Self::DeviceError => "device_error",
            Self::OutOfOrder => "out_of_order",
            Self::NoSlot => "no_slot",
            Self::Abandoned => "abandoned",
            Self::QueueFull => "queue_full",
        }
    }
}

/// Frames dropped so far, by reason.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct DropCounts(pub [u64; DropReason::ALL.len()]);

impl DropCounts {
    /// Counts `n` more frames lost for `reason`.
    pub fn add(&mut self, reason: DropReason, n: u64) {
        self.0[reason as usize] += n;
    }

    /// Frames lost for `reason`.
    pub const fn get(&self, reason: DropReason) -> u64 {
        self.0[reason as usize]
    }

    /// Frames lost for any reason.
    pub fn total(&self) -> u64 {
        // Numbers of a damaged file may not fit.
        self.0.iter().fold(0, |sum, n| sum.saturating_add(*n))
    }

    /// The reasons that lost anything, with their counts.
    pub fn nonzero(&self) -> impl Iterator<Item = (DropReason, u64)> + '_ {
        DropReason::ALL.into_iter().map(|r| (r, self.get(r))).filter(|(_, n)| *n > 0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wire_order_is_the_discriminant() {
        for (i, r) in DropReason::ALL.into_iter().enumerate() {
            assert_eq!(i, r as usize, "{}", r.name());
        }
    }

    #[test]
    fn counts_add_up() {
        let mut c = DropCounts::default();
        c.add(DropReason::NoSlot, 2);
        c.add(DropReason::DeviceGap, 3);
        assert_eq!(c.total(), 5);
        assert_eq!(
            c.nonzero().collect::<Vec<_>>(),
            vec![(DropReason::DeviceGap, 3), (DropReason::NoSlot, 2)]
        );
    }
}
