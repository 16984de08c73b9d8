use super::*;
use depthrig_usb::uvc::payload::{Flags, PayloadHeader};
use std::collections::VecDeque;

const FRAME: usize = 64;
const MS: i64 = 1_000_000;

/// Transfers in memory; the test decides which completes next and how.
#[derive(Default)]
struct FakeTransfers {
    /// In order of submission.
    pending: Vec<usize>,
    /// Completed: how and with which bytes.
    done: VecDeque<(usize, Status, Vec<u8>)>,
    refuse: Option<rusb::Error>,
    submits: usize,
    last: Vec<u8>,
}

const SLOTS: usize = 3;

impl Transfers for FakeTransfers {
    fn slots(&self) -> usize {
        SLOTS
    }

    fn submit(&mut self, slot: usize) -> rusb::Result<()> {
        assert!(!self.pending.contains(&slot), "slot {slot} submitted twice");
        assert!(self.done.iter().all(|d| d.0 != slot), "slot {slot} submitted before it was read");
        if let Some(e) = self.refuse {
            return Err(e);
        }
        self.pending.push(slot);
        self.submits += 1;
        Ok(())
    }

    fn cancel(&mut self, slot: usize) {
        if let Some(at) = self.pending.iter().position(|s| *s == slot) {
            self.pending.remove(at);
            self.done.push_back((slot, Status::Cancelled, Vec::new()));
        }
    }

    fn take_completed(&mut self, slot: usize) -> Option<Completion<'_>> {
        let at = self.done.iter().position(|d| d.0 == slot)?;
        let (_, status, bytes) = self.done.remove(at)?;
        self.last = bytes;
        Some(Completion { status, bytes: &self.last, short: true })
    }
}

fn stream() -> Stream<FakeTransfers> {
    let layout = Layout { frame_bytes: FRAME, fixed: true, payload_bytes: 1000 };
    let transfers = FakeTransfers::default();
    let mut s = Stream::new(transfers, layout, Duration::from_millis(33), HostTime::from_ns(0));
    s.submit_all().unwrap();
    s
}

impl Stream<FakeTransfers> {
    /// Completes the oldest transfer; returns its frames by sequence, length, damaged.
    fn give(&mut self, status: Status, bytes: &[u8], ms: i64) -> rusb::Result<Vec<(u64, usize, bool)>> {
        let slot = self.transfers.pending.remove(0);
        self.transfers.done.push_back((slot, status, bytes.to_vec()));
        self.read_all(ms)
    }

    /// Reads everything that completed.
    fn read_all(&mut self, ms: i64) -> rusb::Result<Vec<(u64, usize, bool)>> {
        let mut seen = Vec::new();
        while let Some(&(slot, ..)) = self.transfers.done.front() {
            self.completed(slot, HostTime::from_ns(ms * MS), &mut |f| {
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
        assert_eq!((s.pending(), s.transfers.pending.len()), (SLOTS, SLOTS));
    }
    assert_eq!(s.transfers.submits, SLOTS + 20);
    assert_eq!(s.copied(), 0);
}

#[test]
fn an_overflow_or_an_error_costs_one_frame() {
    let mut s = stream();
    s.give(Status::Completed, &frame(0), 0).unwrap();
    assert_eq!(s.give(Status::Overflow, &[], 0).unwrap(), [(1, 0, true)]);
    assert_eq!(s.give(Status::Completed, &frame(2), 0).unwrap(), [(2, FRAME, false)]);
    assert_eq!(s.give(Status::Failed, &[], 0).unwrap(), [(3, 0, true)]);
    assert_eq!(s.pending(), SLOTS);
    assert_eq!((s.counts().overflows, s.counts().failures), (1, 1));
}

#[test]
fn a_stall_takes_all_transfers_back_and_clears_the_end_point() {
    let mut s = stream();
    s.give(Status::Completed, &frame(0), 0).unwrap();
    assert_eq!(s.give(Status::Stalled, &[], 10).unwrap(), []);
    assert_eq!((s.pending(), s.transfers.pending.len()), (0, 0));
    let submits = s.transfers.submits;
    assert_eq!(s.tick_at(10), Todo::Clear);
    assert_eq!(s.tick_at(10), Todo::Nothing, "once");
    assert_eq!(s.transfers.submits, submits, "nothing is sent while it is cleared");
    s.clear(Ok(()), 20).unwrap();
    assert_eq!(s.pending(), SLOTS);
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
    assert_eq!(s.pending(), SLOTS, "it listens all the same");
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
    assert_eq!(s.pending(), SLOTS);
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
    s.transfers.refuse = Some(rusb::Error::NoDevice);
    assert_eq!(s.give(Status::Completed, &frame(0), 0).unwrap_err(), rusb::Error::NoDevice);
}

#[test]
fn a_stopped_stream_sends_nothing_again() {
    let mut s = stream();
    // One had completed before the stop and is read after it.
    let slot = s.transfers.pending.remove(0);
    s.transfers.done.push_back((slot, Status::Completed, frame(0)));
    s.stop();
    assert_eq!(s.read_all(0).unwrap(), []);
    assert_eq!((s.pending(), s.transfers.pending.len(), s.transfers.submits), (0, 0, SLOTS));
    assert_eq!(s.tick_at(100_000), Todo::Nothing);
}
