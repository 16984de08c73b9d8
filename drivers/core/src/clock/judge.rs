//! Decides whether a frame belongs on the line: clock steps, restarted devices, and the times of their frames
//! meanwhile.

use super::{ClockMap, DECIDING_FRAMES, Epoch, Mapped, PAUSE_DRIFT, STEP_NS, Seen, WARM_NS, arrival_y};
use depthrig_bus::FrameFlags;

/// [`STEP_NS`] before the line is settled, when the first frames may themselves have been late.
const WARM_UP_STEP_NS: i64 = 500_000_000;
/// Arrivals this far above the line, with a jump in device time, may be a device that restarted.
const RESET_NS: i64 = 500_000_000;

/// Verdict of [`ClockMap::judge`] on a frame.
pub(super) enum Verdict {
    /// On the line, with its ticks since the epoch's first frame.
    Follows(Seen),
    /// Impossible on the line.
    NewEpoch,
    /// Far above the line after a jump of device time or frame number.
    Doubtful(Seen),
}

impl ClockMap {
    /// Whether a frame follows the line, breaks it, or may belong to a device that restarted.
    pub(super) fn judge(&self, epoch: &Epoch, mut seen: Seen) -> Verdict {
        // The host's clock is monotonic; should it run backwards all the same, nothing that was published holds.
        if seen.arrival < self.last_capture {
            return Verdict::NewEpoch;
        }
        let gap_ns = seen.arrival.since_ns(epoch.last.arrival);
        let delta = self.counter.delta(epoch.last.raw, seen.raw, gap_ns);
        seen.ticks = epoch.last.ticks.saturating_add(delta);
        let x = self.counter.ns(seen.ticks);
        let above_ns = arrival_y(epoch, seen) as f64 - x as f64 - epoch.line.at(x);
        let slack_ns = PAUSE_DRIFT * gap_ns.max(0) as f64;
        let step_ns = if epoch.newest_x < WARM_NS { WARM_UP_STEP_NS } else { STEP_NS };
        if above_ns < -(step_ns as f64 + slack_ns) {
            Verdict::NewEpoch
        } else if above_ns > RESET_NS as f64 + slack_ns && self.jumped(epoch.last, seen) {
            Verdict::Doubtful(seen)
        } else {
            Verdict::Follows(seen)
        }
    }

    /// Whether device time or frame number went from `a` to `b` as no running device does it.
    pub(super) fn jumped(&self, a: Seen, b: Seen) -> bool {
        b.sequence < a.sequence || !self.in_step(a, b)
    }

    /// Whether device time advanced by as many frame periods as the frame number says, within 20 %.
    pub(super) fn in_step(&self, a: Seen, b: Seen) -> bool {
        let frames = b.sequence.saturating_sub(a.sequence).max(1) as f64;
        let dx = self.counter.ns(b.ticks.saturating_sub(a.ticks)) as f64;
        (dx - frames * self.period_ns).abs() < 0.2 * frames * self.period_ns
    }

    /// A frame that may be the first of a restarted device: five that agree decide it.
    pub(super) fn doubt(&mut self, epoch: Epoch, mut seen: Seen) -> Mapped {
        if let Some(&last) = self.pending.last() {
            let gap_ns = seen.arrival.since_ns(last.arrival);
            seen.ticks = last.ticks.saturating_add(self.counter.delta(last.raw, seen.raw, gap_ns));
            if self.jumped(last, seen) {
                self.pending.clear();
            }
        }
        if self.pending.len() + 1 >= DECIDING_FRAMES {
            let earlier = core::mem::take(&mut self.pending);
            return self.begin_epoch(&earlier, seen);
        }
        self.pending.push(seen);
        self.epoch = Some(epoch);
        self.hold(seen)
    }

    /// The time of a frame whose device time means nothing yet: a typical delivery before its arrival.
    pub(super) fn hold(&self, seen: Seen) -> Mapped {
        let typical_ns = self.residuals.quantile_ns(0.5).saturating_add(self.shown_latency as i64);
        let capture = seen.arrival.plus_ns(-typical_ns).max(self.last_capture).min(seen.arrival);
        let spread_ns = self.residuals.quantile_ns(0.99).max(self.config.period_ns as i64);
        Mapped {
            device_time: seen.raw,
            capture_time: capture,
            uncertainty_ns: spread_ns as u64,
            epoch: self.epochs.saturating_sub(1),
            flags: FrameFlags::TIME_UNCERTAIN,
            latency_ns: self.shown_latency.max(0.0).round() as u64,
        }
    }
}
