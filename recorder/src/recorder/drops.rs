//! Logs sets that are not recorded: the first one of a reason at once, further ones as a count once a minute.
//!
//! A full disk or an encoder that is behind refuses every set; a line for each would bury the rest of the log.

use crate::SetDrop;
use depthrig_bus::HostTime;

/// Interval between two lines about a reason.
const EVERY_NS: i64 = 60_000_000_000;

/// When each reason was logged last.
#[derive(Debug, Default)]
pub(super) struct DropLog {
    reasons: [Option<Logged>; SetDrop::ALL.len()],
}

#[derive(Debug, Clone, Copy)]
struct Logged {
    at: HostTime,
    /// Sets since then.
    more: u64,
}

/// A count to be logged.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Counted {
    pub(super) reason: SetDrop,
    pub(super) sets: u64,
}

impl DropLog {
    /// Counts a set; returns whether to log it by itself.
    pub(super) fn add(&mut self, reason: SetDrop, now: HostTime) -> bool {
        let place = &mut self.reasons[reason as usize];
        if let Some(logged) = place {
            logged.more += 1;
            return false;
        }
        *place = Some(Logged { at: now, more: 0 });
        true
    }

    /// The counts that are due. A reason without drops for a minute starts again.
    pub(super) fn due(&mut self, now: HostTime) -> Vec<Counted> {
        let mut counts = Vec::new();
        for reason in SetDrop::ALL {
            let place = &mut self.reasons[reason as usize];
            let Some(logged) = place.filter(|l| now.since_ns(l.at) >= EVERY_NS) else { continue };
            if logged.more == 0 {
                *place = None;
                continue;
            }
            counts.push(Counted { reason, sets: logged.more });
            *place = Some(Logged { at: now, more: 0 });
        }
        counts
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Five minutes of a reason at 5 Hz, and two after which it is new again.
    #[test]
    fn a_reason_is_logged_once_and_then_counted_once_a_minute() {
        let mut log = DropLog::default();
        let at = |tenth: i64| HostTime::from_ns(tenth * 100_000_000);
        let mut lines = 0;
        let mut counted = 0;
        for tenth in 0..3000 {
            if tenth % 2 == 0 {
                lines += u64::from(log.add(SetDrop::EncoderBusy, at(tenth)));
            }
            counted += log.due(at(tenth)).iter().map(|c| c.sets).sum::<u64>();
        }
        assert_eq!(lines, 1);
        let rest = log.due(at(3000));
        assert_eq!(rest.len(), 1);
        assert_eq!(counted + rest[0].sets + lines, 1500, "every set is in a line or in a count");
        assert!(log.add(SetDrop::DiskSlow, at(3001)), "another reason is news");
        assert!(log.due(at(3601)).is_empty() && log.add(SetDrop::EncoderBusy, at(3602)));
    }
}
