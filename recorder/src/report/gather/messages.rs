//! The messages between the sets: accounts, and the two clocks of the host.

use super::super::series::{TimeBins, Values};
use super::super::{HostClock, LISTED_MAX};
use super::Pass;
use crate::clock::{offset_ns, step_ns};
use crate::dataset::{Dataset, image_chunks};
use crate::msgs::schemas::Schema;
use crate::msgs::{accounts, frame_set};
use crate::{ErrorKind, Result, SetCounts, StreamAccount};
use depthrig_bus::UtcPair;

/// Readings of the clocks lie within this around the sets, nanoseconds.
const AROUND_NS: i64 = 60_000_000_000;

/// Summary of the messages between the sets.
#[derive(Default)]
pub(super) struct MessageSummary {
    pub(super) bytes: u64,
    /// Segments that were not finished.
    pub(super) unfinished: Vec<String>,
    pub(super) counts: Option<SetCounts>,
    pub(super) accounts: Vec<StreamAccount>,
    pub(super) clock: Clock,
}

/// The two clocks of the host over time.
#[derive(Default)]
pub(super) struct Clock {
    first: Option<UtcPair>,
    last: Option<UtcPair>,
    pairs: u64,
    width_ns: i64,
    stepped_ns: i64,
    steps: Vec<(i64, i64)>,
    series: Option<Values>,
}

impl Clock {
    fn pair(&mut self, bins: TimeBins, t0_ns: i64, pair: UtcPair) {
        let first = *self.first.get_or_insert(pair);
        // Log times follow the first pair: a step of the wall clock does not move a reading on the axis.
        let t_ns = first.utc_ns.saturating_add(pair.mono.since_ns(first.mono)).saturating_sub(t0_ns);
        // A derived dataset has readings of the computer that derived it, of another time.
        if !(-AROUND_NS..=bins.span_ns.saturating_add(AROUND_NS)).contains(&t_ns) {
            return;
        }
        // Each segment begins with the first reading again.
        if self.last.is_some_and(|last| pair.mono <= last.mono) {
            return;
        }
        self.pairs += 1;
        self.width_ns = self.width_ns.max(pair.width_ns);
        if let Some(change) = self.last.replace(pair).and_then(|before| step_ns(&before, &pair)) {
            self.stepped_ns += change;
            if self.steps.len() < LISTED_MAX {
                self.steps.push((t_ns, change));
            }
        }
        let change = offset_ns(&pair).saturating_sub(offset_ns(&first));
        self.series.get_or_insert_with(|| Values::new(bins)).add(bins, t_ns, change as f64);
    }

    pub(super) fn report(self) -> HostClock {
        let (Some(first), Some(last)) = (self.first, self.last) else { return HostClock::default() };
        let over_ns = last.mono.since_ns(first.mono);
        let change_ns = (last.utc_ns - last.mono.ns()).saturating_sub(first.utc_ns - first.mono.ns());
        let drift = (change_ns - self.stepped_ns) as f64;
        HostClock {
            pairs: self.pairs,
            width_ns: self.width_ns,
            change_ns,
            drift_ppm: if over_ns > 0 { drift / over_ns as f64 * 1e6 } else { 0.0 },
            series: self.series.map(|v| v.ranges()).unwrap_or_default(),
            steps: self.steps,
        }
    }
}

/// Reads accounts and clock pairs of all segments, and the size of their image chunks.
pub(super) fn read_messages(dataset: &Dataset, pass: &mut Pass) -> Result<MessageSummary> {
    let mut summary = MessageSummary::default();
    for i in 0..dataset.segments().len() {
        // Segments that cannot be opened are among the problems already.
        let Some(Ok(reader)) = dataset.open_segment(i) else { continue };
        summary.bytes += reader.size;
        if !reader.finished {
            let name = reader.path.file_name().map(|n| n.to_string_lossy().into_owned());
            summary.unfinished.extend(name);
        }
        for (id, chunk) in image_chunks(&reader) {
            let streams = &dataset.session().streams;
            let Some(at) = streams.iter().position(|s| s.id.to_string() == id) else { continue };
            let stream = &mut pass.streams[at];
            stream.packed_bytes = stream.packed_bytes.saturating_add(chunk.length);
            stream.is_packed |= chunk.is_packed;
        }
        let channel = |schema: Schema| {
            reader.channels.iter().find(|(_, c)| c.schema == schema.name()).map(|(id, _)| *id)
        };
        let clock = channel(Schema::ClockPair);
        let account = channel(Schema::Accounts);
        let is = |id: u16, which: Option<u16>| which == Some(id);
        for entry in &reader.chunks {
            if !entry.channels.iter().any(|id| is(*id, clock) || is(*id, account)) {
                continue;
            }
            let read = reader.messages(entry, |m| {
                if is(m.channel, clock) {
                    let pair = frame_set::read_clock_pair(m.data)?;
                    summary.clock.pair(pass.bins, pass.t0_ns, pair);
                } else if is(m.channel, account) {
                    let (sets, streams) = accounts::read(m.data)?;
                    summary.counts = Some(sets);
                    summary.accounts = streams;
                }
                Ok(())
            });
            match read {
                Err(e) if e.kind() == ErrorKind::Io => return Err(e),
                Err(e) => pass.problem(e.to_string()),
                Ok(()) => {}
            }
        }
    }
    Ok(summary)
}

#[cfg(test)]
mod tests {
    use super::*;
    use depthrig_bus::HostTime;

    /// An hour of readings at 20 ppm, slewed faster for a while as NTP does, with one step of a second back.
    #[test]
    fn steps_are_distinguished_from_drift() {
        let bins = TimeBins::new(3600 * 1_000_000_000, 1_000_000_000);
        let mut clock = Clock::default();
        let mut offset = 1_700_000_000_000_000_000;
        for s in 0..=3600i64 {
            offset += if (1000..1100).contains(&s) { 400_000 } else { 20_000 };
            if s == 2000 {
                offset -= 1_000_000_000;
            }
            let mono = HostTime::from_ns(s * 1_000_000_000);
            clock.pair(
                bins,
                1_700_000_000_000_020_000,
                UtcPair { mono, utc_ns: mono.ns() + offset, width_ns: 200 },
            );
        }
        let r = clock.report();
        assert_eq!(r.steps.len(), 1, "{:?}", r.steps);
        let (at, by) = r.steps[0];
        assert_eq!((at / 1_000_000_000, by), (2000, -999_980_000));
        assert!((r.drift_ppm - (3500.0 * 20.0 + 100.0 * 400.0) / 3600.0).abs() < 0.1, "{}", r.drift_ppm);
        assert_eq!(r.pairs, 3601);
    }
}
