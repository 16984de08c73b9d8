//! Entry point of the fuzz target `external`: bytes that a process that serves a camera may write on the bus.

use crate::{device, facts};
use depthrig_bus::external::{ExternalFrame, MODE_BYTES, fuzzing};
use depthrig_bus::{DropCounts, DropReason, HostTime};
use depthrig_driver::{FrameMeta, FrameSink, Gate, choose_profiles};

/// Bytes of a frame's header.
const HEADER: usize = size_of::<ExternalFrame>();
/// Images that are larger find no memory here.
const MOST_BYTES: usize = 1 << 16;
/// When the first frame is read.
const BEGIN_NS: i64 = 1_000_000_000_000;

/// Bytes of the hand-shake: the first one says of what, an offer, an answer, or a mode and headers of its frames. How
/// far they came.
///
/// # Panics
/// When something invalid is accepted, or the account of the frames does not balance.
pub fn handshake(bytes: &[u8]) -> u64 {
    let Some((kind, rest)) = bytes.split_first() else { return 0 };
    match kind % 3 {
        0 => offer(rest),
        1 => fuzzing::answer(rest),
        _ => frames(rest),
    }
}

fn offer(bytes: &[u8]) -> u64 {
    let Some(offer) = fuzzing::offer(bytes) else { return 0 };
    let profiles: Vec<_> = offer.modes.iter().map(device::profile).collect();
    for profile in &profiles {
        let length = profile.pose_in_device.rotation_xyzw.iter().map(|c| c * c).sum::<f64>();
        assert!((length - 1.0).abs() < 1e-9 && profile.clock.tick_ns() > 0.0, "{profile:?}");
        let _ = Gate::new(0, profile);
    }
    let chosen = choose_profiles(&offer.about.model, &profiles, &[]);
    assert!(chosen.is_ok(), "each stream has a first mode: {chosen:?}");
    profiles.len() as u64
}

/// A sink with memory for small images, and the account that it receives.
#[derive(Default)]
struct Account {
    memory: Vec<u8>,
    captured: u64,
    committed: u64,
    drops: DropCounts,
    last: Option<FrameMeta>,
}

impl FrameSink for Account {
    fn loan(&mut self, _: usize, len: usize) -> Option<&mut [u8]> {
        if len > MOST_BYTES {
            return None;
        }
        self.memory.resize(len, 0);
        Some(&mut self.memory)
    }
    fn commit(&mut self, _: usize, meta: &FrameMeta) {
        assert!(meta.gain >= 0.0 && meta.gain.is_finite() && !meta.temperature_c.is_infinite(), "{meta:?}");
        assert!(meta.capture_time <= meta.arrival, "{meta:?}");
        if let Some(last) = self.last.filter(|l| l.clock_epoch == meta.clock_epoch) {
            assert!(
                last.arrival <= meta.arrival && last.capture_time <= meta.capture_time,
                "{last:?} {meta:?}"
            );
        }
        self.last = Some(*meta);
        self.committed += 1;
    }
    fn discard(&mut self, _: usize) {}
    fn dropped(&mut self, _: usize, reason: DropReason, n: u64) {
        self.drops.add(reason, n);
    }
    fn captured(&mut self, _: usize, n: u64) {
        self.captured += n;
    }
    fn clock_quality(&mut self, _: usize, _: &depthrig_driver::clock::ClockQuality) {}
}

/// A mode, and frames of it: 4 bytes for how many bytes came, 2 for how many milliseconds after the one before, the
/// header. Frames that were delivered, and 1.
fn frames(bytes: &[u8]) -> u64 {
    let Some((record, mut rest)) = bytes.split_first_chunk::<MODE_BYTES>() else { return 0 };
    let Some(mode) = fuzzing::mode(record) else { return 0 };
    let profile = device::profile(&mode);
    let mut gate = Gate::new(0, &profile);
    let mut facts = facts::Facts::new(&profile, mode.sequence_bits > 0);
    let mut account = Account::default();
    let mut now = HostTime::from_ns(BEGIN_NS);
    while let Some((step, after)) = rest.split_first_chunk::<6>()
        && let Some((header, after)) = after.split_first_chunk::<HEADER>()
    {
        rest = after;
        let [a, b, c, d, pause @ ..] = *step;
        let sent = u32::from_le_bytes([a, b, c, d]) as usize;
        now = now.plus_ns(i64::from(u16::from_le_bytes(pause)) * 1_000_000);
        let header = fuzzing::frame(header);
        let raw = facts.raw(&header, sent, now);
        gate.explain_gap(facts.lost_before(&header), DropReason::QueueFull);
        gate.deliver(&raw, &mut account, |memory| {
            assert!(memory.len() <= sent, "{} bytes would be read of {sent}", memory.len());
            Ok(())
        });
        assert_eq!(gate.captured(), gate.delivered() + gate.drops().total());
    }
    assert_eq!((account.captured, account.drops), (gate.captured(), gate.drops()));
    assert_eq!(account.committed, gate.delivered());
    1 + gate.delivered()
}

#[cfg(test)]
mod tests {
    use depthrig_corpus::run;

    #[test]
    fn messages_of_a_process_that_serves_a_camera() {
        run("external", super::handshake);
    }
}
