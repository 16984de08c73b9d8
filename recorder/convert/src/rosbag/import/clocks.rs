//! Times of devices on the clock of the host.

use super::Stream;
use super::scan::Frame;
use depthrig_bus::CameraName;
use std::collections::BTreeMap;

/// The device counts microseconds in 32 bits, which is 71 minutes.
const TURN_US: i64 = 1 << 32;

/// Facts about a device's clock, from its frames.
#[derive(Default)]
struct Device {
    /// The least and the most that a frame arrived after its device time, nanoseconds.
    delays: Option<(i64, i64)>,
    /// The first and the last device time, nanoseconds.
    span: Option<(i64, i64)>,
}

/// A frame of a stream by which its counter is compared with those of other streams.
struct Anchor {
    arrival_ns: i64,
    device_us: i64,
}

/// Places the device's times on the host's clock: what arrived fastest sets the offset, as in the live map.
/// Says of each camera what that rests on.
pub(super) fn place(streams: &mut [Stream]) -> Vec<String> {
    for s in &mut *streams {
        name_clocks(&mut s.frames);
        count_on(&mut s.frames);
    }
    align(streams);
    let mut devices: BTreeMap<CameraName, Device> = BTreeMap::new();
    for s in &*streams {
        let device = devices.entry(s.record.id.camera.clone()).or_default();
        s.frames.iter().for_each(|f| device.learn(f));
    }
    for s in streams {
        if let Some(device) = devices.get(&s.record.id.camera) {
            device.capture_times(&mut s.frames);
        }
    }
    devices.iter().map(|(camera, device)| device.basis(camera)).collect()
}

/// A frame that does not say whose clock its stamp is of has that of the frame before it; those at the begin
/// have that of the first one that says it.
fn name_clocks(frames: &mut [Frame]) {
    let mut near = frames.iter().find_map(|f| f.host_clock);
    for f in frames {
        near = f.host_clock.or(near);
        f.host_clock = near;
    }
}

/// The times of a stream's frames without the turns of their counter.
fn count_on(frames: &mut [Frame]) {
    let mut counted = None;
    let mut stamped = 0;
    for f in frames {
        f.device_us = after(counted.unwrap_or(stamped), f.raw_us());
        // A stamp may be of another clock: no counter goes on from it, and from one of many years nothing does.
        if f.counted_us().is_some() {
            counted = Some(f.device_us);
        } else if u32::try_from(f.raw_us()).is_ok() {
            stamped = f.device_us;
        }
    }
}

/// The time that a counter of 32 bits means with `raw`, at `last` or later.
fn after(last: u64, raw: u64) -> u64 {
    if u32::try_from(raw).is_err() {
        return raw;
    }
    let us = (last & !u64::from(u32::MAX)) | raw;
    // Near the end of 64 bits, where only a damaged file is, it stays as it is.
    if last.saturating_sub(us) > 1 << 31 { us.saturating_add(1 << 32) } else { us }
}

/// Aligns the streams of a device, which have one counter: a stream that begins after a turn that another one saw has
/// that turn added, judged by the arrival times.
fn align(streams: &mut [Stream]) {
    let mut devices: BTreeMap<CameraName, Vec<(usize, Anchor)>> = BTreeMap::new();
    for (i, s) in streams.iter().enumerate() {
        if let Some(anchor) = s.frames.iter().find_map(Anchor::of) {
            devices.entry(s.record.id.camera.clone()).or_default().push((i, anchor));
        }
    }
    for anchors in devices.values() {
        let Some((_, first)) = anchors.iter().min_by_key(|(_, a)| a.arrival_ns) else { continue };
        let turns: Vec<i64> = anchors.iter().map(|(_, a)| a.turns_since(first)).collect();
        // The first to arrive may be after the turn, and another one before it: no time is below 0.
        let least = turns.iter().copied().min().unwrap_or(0);
        for ((stream, _), turns) in anchors.iter().zip(turns) {
            add_turns(&mut streams[*stream].frames, turns.abs_diff(least));
        }
    }
}

fn add_turns(frames: &mut [Frame], turns: u64) {
    for f in frames.iter_mut().filter(|f| u32::try_from(f.raw_us()).is_ok()) {
        f.device_us = f.device_us.saturating_add(turns.saturating_mul(TURN_US.unsigned_abs()));
    }
}

impl Anchor {
    /// A frame that says when it arrived and what a counter of 32 bits was then.
    fn of(f: &Frame) -> Option<Self> {
        f.counted_us().filter(|us| u32::try_from(*us).is_ok())?;
        Some(Self { arrival_ns: f.arrival_ns?, device_us: i64::try_from(f.device_us).ok()? })
    }

    /// How many turns of the counter bring this frame nearest to where it must be after `first`.
    fn turns_since(&self, first: &Self) -> i64 {
        let later_us = self.arrival_ns.saturating_sub(first.arrival_ns) / 1000;
        let wanted = first.device_us.saturating_add(later_us);
        wanted.saturating_sub(self.device_us).saturating_add(TURN_US / 2).div_euclid(TURN_US)
    }
}

impl Device {
    fn learn(&mut self, f: &Frame) {
        let by_host = f.host_clock == Some(true);
        if let Some(arrival) = f.arrival_ns.filter(|_| !by_host) {
            widen(&mut self.delays, arrival.saturating_sub(f.device_ns()));
        }
        // A stamp of the host says nothing of the device.
        if f.counted_us().is_some() || !by_host {
            widen(&mut self.span, f.device_ns());
        }
    }

    fn capture_times(&self, frames: &mut [Frame]) {
        // Two readings of a delay cannot say less than how far they lie apart.
        let width = self.delays.map_or(0, |(least, most)| most.saturating_sub(least));
        let mut before = i64::MIN;
        for f in frames {
            let time = match (self.delays, f.host_clock == Some(true)) {
                (Some((least, _)), false) => f.device_ns().saturating_add(least),
                (_, true) if f.stamp_ns > 0 => f.stamp_ns,
                _ => f.bag_ns,
            };
            f.uncertainty_ns = width.unsigned_abs().max(1_000_000);
            // A set's frames are in order: one that went back in time is at least not before the last one.
            f.capture_ns = time.max(before);
            before = f.capture_ns;
        }
    }

    fn basis(&self, camera: &CameraName) -> String {
        let Some((least, most)) = self.delays else {
            return format!("{camera}: no frame says when it arrived; times are those of the bag");
        };
        let (first, end) = self.span.unwrap_or_default();
        format!(
            "{camera}: capture times are device times plus the least delay seen, over {:.3} s; delays vary \
             by {:.3} ms, and a constant one cannot be seen",
            end.saturating_sub(first) as f64 / 1e9,
            most.abs_diff(least) as f64 / 1e6
        )
    }
}

/// Widens the range by a value.
fn widen(range: &mut Option<(i64, i64)>, value: i64) {
    let (low, high) = range.unwrap_or((value, value));
    *range = Some((low.min(value), high.max(value)));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counters_turn_and_stamps_do_not_turn_them() {
        let counter = |us: u64| Frame { sensor_us: Some(us), ..Frame::default() };
        let stamp = |us: i64| Frame { stamp_ns: 1000 * us, ..Frame::default() };
        let turn = TURN_US.unsigned_abs();
        let year_2018: i64 = 1_534_232_519_000_000;
        let mut frames =
            [counter(turn - 9), stamp(year_2018), counter(turn - 5), counter(3), stamp(7), counter(8)];
        count_on(&mut frames);
        let counted = frames.map(|f| f.device_us);
        assert_eq!(counted, [turn - 9, year_2018.unsigned_abs(), turn - 5, turn + 3, turn + 7, turn + 8]);
    }

    #[test]
    fn turns_are_those_that_bring_a_counter_nearest() {
        let at = |ms: i64, device_us: i64| Anchor { arrival_ns: ms * 1_000_000, device_us };
        let first = at(0, TURN_US - 1_000_000);
        assert_eq!(at(3_000, 2_000_000).turns_since(&first), 1);
        assert_eq!(at(500, TURN_US - 500_000).turns_since(&first), 0);
        assert_eq!(at(10, TURN_US - 500_000).turns_since(&at(0, 5)), -1);
        // Three hours after the end of the first turn.
        assert_eq!(at(10_800_000, 2_209_065_408).turns_since(&first), 3);
        for far in [i64::MIN, i64::MAX] {
            let odd = Anchor { arrival_ns: far, device_us: i64::MAX };
            odd.turns_since(&first);
            first.turns_since(&odd);
        }
    }
}
