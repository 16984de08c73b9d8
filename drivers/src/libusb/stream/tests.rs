use super::*;
use crate::uvc::payload::{Flags, PayloadHeader};
use std::collections::VecDeque;

const FRAME: usize = 64;
const MS: i64 = 1_000_000;

/// Transfers in memory: what lands next is put there by the test.
#[derive(Default)]
struct Made {
    /// Under way, in order of submission.
    flying: Vec<usize>,
    /// Landed: how and with what.
    down: VecDeque<(usize, Status, Vec<u8>)>,
    refuse: Option<rusb::Error>,
    submits: usize,
    last: Vec<u8>,
}

const SLOTS: usize = 3;

impl Lane for Made {
    fn slots(&self) -> usize {
        SLOTS
    }

    fn submit(&mut self, slot: usize) -> rusb::Result<()> {
        assert!(!self.flying.contains(&slot), "slot {slot} submitted twice");
        assert!(self.down.iter().all(|d| d.0 != slot), "slot {slot} submitted before it was read");
        if let Some(e) = self.refuse {
            return Err(e);
        }
        self.flying.push(slot);
        self.submits += 1;
        Ok(())
    }

    fn cancel(&mut self, slot: usize) {
        if let Some(at) = self.flying.iter().position(|s| *s == slot) {
            self.flying.remove(at);
            self.down.push_back((slot, Status::Cancelled, Vec::new()));
        }
    }

    fn land(&mut self, slot: usize) -> Option<Landing<'_>> {
        let at = self.down.iter().position(|d| d.0 == slot)?;
        let (_, status, bytes) = self.down.remove(at)?;
        self.last = bytes;
        Some(Landing { status, bytes: &self.last, short: true })
    }
}

fn stream() -> Stream<Made> {
    let layout = Layout { frame_bytes: FRAME, fixed: true, payload_bytes: 1000 };
    let mut s = Stream::new(Made::default(), layout, Duration::from_millis(33), HostTime::from_ns(0));
    s.submit_all().unwrap();
    s
}

impl Stream<Made> {
    /// The transfer that was submitted first lands; the frames that came of it by sequence, length, damaged.
    fn give(&mut self, status: Status, bytes: &[u8], ms: i64) -> rusb::Result<Vec<(u64, usize, bool)>> {
        let slot = self.lane.flying.remove(0);
        self.lane.down.push_back((slot, status, bytes.to_vec()));
        self.read_all(ms)
    }

    /// Reads everything that landed.
    fn read_all(&mut self, ms: i64) -> rusb::Result<Vec<(u64, usize, bool)>> {
        let mut seen = Vec::new();
        while let Some(&(slot, ..)) = self.lane.down.front() {
            self.landed(slot, HostTime::from_ns(ms * MS), &mut |f| {
                seen.push((f.sequence, f.bytes.len(), f.damaged));
            })?;
        }
        Ok(seen)
    }

    fn clear(&mut self, result: rusb::Result<()>, ms: i64) -> rusb::Result<Vec<(u64, usize, bool)>> {
        let mut seen = Vec::new();
        self.cleared(result, HostTime::from_ns(ms * MS), &mut |f| {
            seen.push((f.sequence, f.bytes.len(), f.damaged));
        })?;
        Ok(seen)
    }

    fn tick_at(&mut self, ms: i64) -> Todo {
        self.tick(HostTime::from_ns(ms * MS))
    }
}

fn frame(n: u8) -> Vec<u8> {
    let mut bytes = PayloadHeader::build(Flags::END_OF_FRAME | (n & 1), None, None, &[]).unwrap();
    bytes.extend_from_slice(&[n; FRAME]);
    bytes
}

#[test]
fn every_transfer_that_comes_back_is_sent_again() {
    let mut s = stream();
    for n in 0..20 {
        assert_eq!(s.give(Status::Completed, &frame(n), 0).unwrap(), [(n.into(), FRAME, false)]);
        assert_eq!((s.flying(), s.lane.flying.len()), (SLOTS, SLOTS));
    }
    assert_eq!(s.lane.submits, SLOTS + 20);
    assert_eq!(s.copied(), 0);
}

#[test]
fn an_overflow_or_an_error_costs_one_frame() {
    let mut s = stream();
    s.give(Status::Completed, &frame(0), 0).unwrap();
    assert_eq!(s.give(Status::Overflow, &[], 0).unwrap(), [(1, 0, true)]);
    assert_eq!(s.give(Status::Completed, &frame(2), 0).unwrap(), [(2, FRAME, false)]);
    assert_eq!(s.give(Status::Failed, &[], 0).unwrap(), [(3, 0, true)]);
    assert_eq!(s.flying(), SLOTS);
    assert_eq!((s.counts().overflows, s.counts().failures), (1, 1));
}

#[test]
fn a_stall_takes_all_transfers_back_and_clears_the_end_point() {
    let mut s = stream();
    s.give(Status::Completed, &frame(0), 0).unwrap();
    assert_eq!(s.give(Status::Stalled, &[], 10).unwrap(), []);
    assert_eq!((s.flying(), s.lane.flying.len()), (0, 0));
    let submits = s.lane.submits;
    assert_eq!(s.tick_at(10), Todo::Clear);
    assert_eq!(s.tick_at(10), Todo::Nothing, "once");
    assert_eq!(s.lane.submits, submits, "nothing is sent while it is cleared");
    s.clear(Ok(()), 20).unwrap();
    assert_eq!(s.flying(), SLOTS);
    assert_eq!(s.give(Status::Completed, &frame(0), 30).unwrap(), [(1, FRAME, false)]);
    assert_eq!((s.counts().stalls, s.counts().clearings), (1, 1));
}

#[test]
fn errors_without_end_are_taken_for_a_halt() {
    let mut s = stream();
    for _ in 0..7 {
        s.give(Status::Failed, &[], 0).unwrap();
        assert_eq!(s.tick_at(0), Todo::Nothing);
    }
    s.give(Status::Failed, &[], 0).unwrap();
    s.read_all(0).unwrap();
    assert_eq!(s.tick_at(0), Todo::Clear);
}

#[test]
fn silence_clears_the_end_point_three_times_and_then_is_left_alone() {
    let mut s = stream();
    assert_eq!(s.tick_at(2000), Todo::Nothing, "a camera that starts has two seconds");
    s.give(Status::Completed, &frame(0), 2000).unwrap();
    assert_eq!(s.tick_at(2500), Todo::Nothing);
    let mut now = 2501;
    for _ in 0..3 {
        assert_eq!(s.tick_at(now), Todo::Nothing, "the transfers have not come back yet");
        s.read_all(now).unwrap();
        assert_eq!(s.tick_at(now), Todo::Clear);
        s.clear(Ok(()), now).unwrap();
        now += 501;
    }
    assert_eq!(s.tick_at(now + 100_000), Todo::Nothing);
    assert_eq!(s.flying(), SLOTS, "it listens all the same");
    // A frame makes it hopeful again.
    s.give(Status::Completed, &frame(1), now).unwrap();
    s.tick_at(now + 501);
    s.read_all(now + 501).unwrap();
    assert_eq!(s.tick_at(now + 501), Todo::Clear);
}

#[test]
fn a_clearing_that_fails_is_tried_again_and_a_gone_camera_is_gone() {
    let mut s = stream();
    s.give(Status::Stalled, &[], 0).unwrap();
    s.read_all(0).unwrap();
    assert_eq!(s.tick_at(0), Todo::Clear);
    s.clear(Err(rusb::Error::Timeout), 1000).unwrap();
    assert_eq!(s.flying(), SLOTS);
    s.give(Status::Stalled, &[], 1000).unwrap();
    s.read_all(1000).unwrap();
    assert_eq!(s.tick_at(1000), Todo::Clear);
    assert_eq!(s.clear(Err(rusb::Error::NoDevice), 1000).unwrap_err(), rusb::Error::NoDevice);
}

#[test]
fn an_unplugged_camera_is_an_error_at_once() {
    let mut s = stream();
    assert_eq!(s.give(Status::Gone, &[], 0).unwrap_err(), rusb::Error::NoDevice);
    let mut s = stream();
    s.lane.refuse = Some(rusb::Error::NoDevice);
    assert_eq!(s.give(Status::Completed, &frame(0), 0).unwrap_err(), rusb::Error::NoDevice);
}

#[test]
fn a_stopped_stream_sends_nothing_again() {
    let mut s = stream();
    // One had landed before the stop and is read after it.
    let slot = s.lane.flying.remove(0);
    s.lane.down.push_back((slot, Status::Completed, frame(0)));
    s.stop();
    assert_eq!(s.read_all(0).unwrap(), []);
    assert_eq!((s.flying(), s.lane.flying.len(), s.lane.submits), (0, 0, SLOTS));
    assert_eq!(s.tick_at(100_000), Todo::Nothing);
}
