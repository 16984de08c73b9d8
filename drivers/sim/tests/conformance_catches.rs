//! The conformance suite can fail: for each promise a backend that breaks just it, and the case that says so.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use depthrig_bus::{DropReason, HostTime, MOTION_SAMPLE_BYTES, MotionSample, Name};
use depthrig_driver::clock::ClockQuality;
use depthrig_driver::{
    Backend, Device, DeviceInfo, Error, ErrorKind, FrameMeta, FrameSink, Poll, Result, Stream, StreamProfile,
    StreamRequest,
};
use depthrig_sim::conformance::{self, Bench, Cannot, Rig, Sent, Subject, Trouble};
use depthrig_sim::synthetic::{
    FaultKind, Pattern, SimTruth, StreamOverride, SyntheticBackend, SyntheticConfig,
};
use std::time::Duration;

/// A violation of one promise.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Violation {
    None,
    LastByteUnwritten,
    FromTheFuture,
    TimeGoesBack,
    HidesDrops,
    PublishesTwice,
    StallIsAnError,
    SlowPoll,
    NotListed,
    AnyModeWillDo,
    KeepsTheDevice,
    LivesOnAfterUnplug,
    SamplesSwapped,
    SampleLost,
    HeaderOfTheOldest,
    NotANumber,
}

struct ViolatingBackend(Violation, Box<dyn Backend>);

impl Backend for ViolatingBackend {
    fn name(&self) -> &'static str {
        self.1.name()
    }
    fn discover(&self) -> Result<Vec<DeviceInfo>> {
        if self.0 == Violation::NotListed { Ok(vec![]) } else { self.1.discover() }
    }
    fn open(&self, serial: Option<&str>) -> Result<Box<dyn Device>> {
        Ok(Box::new(ViolatingDevice(self.0, self.1.open(serial)?)))
    }
}

struct ViolatingDevice(Violation, Box<dyn Device>);

impl Device for ViolatingDevice {
    fn info(&self) -> &DeviceInfo {
        self.1.info()
    }
    fn profiles(&self) -> &[StreamProfile] {
        self.1.profiles()
    }
    fn start(self: Box<Self>, requests: &[StreamRequest]) -> Result<Box<dyn Stream>> {
        let requests = if self.0 == Violation::AnyModeWillDo { &[] } else { requests };
        Ok(Box::new(ViolatingStream { violation: self.0, inner: Some(self.1.start(requests)?), idle: 0 }))
    }
}

struct ViolatingStream {
    violation: Violation,
    inner: Option<Box<dyn Stream>>,
    idle: u32,
}

impl Stream for ViolatingStream {
    fn profiles(&self) -> &[StreamProfile] {
        self.inner.as_ref().unwrap().profiles()
    }
    fn poll(&mut self, timeout: Duration, sink: &mut dyn FrameSink) -> Result<Poll> {
        if self.violation == Violation::SlowPoll {
            std::thread::sleep(Duration::from_millis(150));
        }
        let got =
            self.inner.as_mut().unwrap().poll(timeout, &mut ViolatingSink(self.violation, sink, Vec::new()));
        match (self.violation, &got) {
            (Violation::StallIsAnError, Ok(Poll::Idle)) => {
                self.idle += 1;
                if self.idle > 3 { Err(Error::new(ErrorKind::Stalled, "no frames")) } else { got }
            }
            (Violation::LivesOnAfterUnplug, Err(_)) => Ok(Poll::Idle),
            _ => got,
        }
    }
}

impl Drop for ViolatingStream {
    fn drop(&mut self) {
        if self.violation == Violation::KeepsTheDevice {
            std::mem::forget(self.inner.take());
        }
    }
}

/// Spoils a batch as a driver of an IMU might.
fn spoil(violation: Violation, batch: &mut [u8], meta: &mut FrameMeta) {
    let n = batch.len() / MOTION_SAMPLE_BYTES;
    let at = |i: usize| i * MOTION_SAMPLE_BYTES..(i + 1) * MOTION_SAMPLE_BYTES;
    match violation {
        Violation::SamplesSwapped => batch[at(0).start..at(1).end].rotate_left(MOTION_SAMPLE_BYTES),
        // A number is skipped without time: samples that were thrown away would look like the unit's own gaps.
        Violation::SampleLost => {
            for i in 0..n {
                let mut s = MotionSample::all_in(&batch[at(i)]).next().unwrap();
                s.sequence *= 2;
                batch[at(i)].copy_from_slice(&s.to_bytes());
            }
            meta.device_sequence *= 2;
        }
        Violation::HeaderOfTheOldest => {
            meta.capture_time = MotionSample::all_in(batch).next().unwrap().time();
        }
        Violation::NotANumber => {
            let mut s = MotionSample::all_in(batch).next().unwrap();
            s.gyro_rad_s[1] = f32::NAN;
            batch[at(0)].copy_from_slice(&s.to_bytes());
        }
        _ => {}
    }
}

/// Keeps a batch until it is committed, so that it can be spoilt.
struct ViolatingSink<'a>(Violation, &'a mut dyn FrameSink, Vec<u8>);

impl FrameSink for ViolatingSink<'_> {
    fn loan(&mut self, stream: usize, len: usize) -> Option<&mut [u8]> {
        if is_of_motion(self.0) {
            self.2.resize(len, 0);
            return Some(&mut self.2);
        }
        let memory = self.1.loan(stream, len)?;
        // The driver does not write bytes that it does not get.
        if self.0 == Violation::LastByteUnwritten {
            // A whole frame must be returned, so the driver writes elsewhere.
            return Some(Box::leak(vec![0; memory.len()].into_boxed_slice()));
        }
        Some(memory)
    }
    fn commit(&mut self, stream: usize, meta: &FrameMeta) {
        let mut meta = *meta;
        if is_of_motion(self.0) {
            spoil(self.0, &mut self.2, &mut meta);
            self.1.loan(stream, self.2.len()).unwrap().copy_from_slice(&self.2);
        }
        match self.0 {
            Violation::FromTheFuture => meta.capture_time = meta.arrival.plus_ns(1),
            Violation::TimeGoesBack if meta.device_sequence.is_multiple_of(3) => {
                meta.capture_time = meta.capture_time.plus_ns(-50_000_000);
            }
            _ => {}
        }
        self.1.commit(stream, &meta);
        if self.0 == Violation::PublishesTwice {
            self.1.commit(stream, &meta);
        }
    }
    fn discard(&mut self, stream: usize) {
        self.1.discard(stream);
    }
    fn dropped(&mut self, stream: usize, reason: DropReason, n: u64) {
        if self.0 != Violation::HidesDrops {
            self.1.dropped(stream, reason, n);
        }
    }
    fn captured(&mut self, stream: usize, n: u64) {
        self.1.captured(stream, n);
    }
    fn clock_quality(&mut self, stream: usize, quality: &ClockQuality) {
        self.1.clock_quality(stream, quality);
    }
}

const fn is_of_motion(violation: Violation) -> bool {
    matches!(
        violation,
        Violation::SamplesSwapped
            | Violation::SampleLost
            | Violation::HeaderOfTheOldest
            | Violation::NotANumber
    )
}

struct ViolatingSubject(Violation);

impl Subject for ViolatingSubject {
    fn name(&self) -> String {
        format!("{:?}", self.0)
    }
    fn make(&self) -> Bench {
        let depth = StreamOverride {
            stream: Name::new("depth").unwrap(),
            size: Some((64, 48)),
            rate_hz: Some(200.0),
        };
        let config = SyntheticConfig {
            serial: "s".into(),
            cheap: true,
            streams: vec![depth],
            motion: is_of_motion(self.0),
            ..SyntheticConfig::default()
        };
        let backend = SyntheticBackend::new(vec![config]).unwrap();
        let rig = Box::new(TestRig(backend.truth("s").unwrap()));
        let wanted = if is_of_motion(self.0) { "imu" } else { "depth" };
        let requests = vec![StreamRequest::any(Name::new(wanted).unwrap())];
        Bench {
            backend: Box::new(ViolatingBackend(self.0, Box::new(backend))),
            serial: "s".into(),
            requests,
            rig,
        }
    }
}

/// Knows only some tricks, so that the suite's "not applicable" shows too.
struct TestRig(SimTruth);

impl Rig for TestRig {
    fn cause(&self, trouble: Trouble) -> std::result::Result<(), Cannot> {
        let (kind, duration, count) = match trouble {
            Trouble::Unplug(d) => (FaultKind::Unplug, d, 1),
            Trouble::Stall(d) => (FaultKind::Stall, d, 1),
            Trouble::Damaged(n) => (FaultKind::Damaged, Duration::ZERO, n),
            _ => return Err(Cannot("not taught")),
        };
        self.0.inject(kind, duration, count);
        Ok(())
    }
    fn sent(&self, stream: usize) -> Option<Sent> {
        let l = self.0.ledger(stream);
        Some(Sent { captured: l.captured, good: l.good, drops: l.drops })
    }
    fn true_capture(&self, _: usize, _: HostTime) -> Option<(HostTime, u64)> {
        None
    }
    fn is_genuine(&self, _: usize, pixels: &[u8]) -> Option<bool> {
        let pattern = Pattern::new(1, "depth", depthrig_bus::PixelFormat::Z16, 64, 48);
        Some(pattern.identify(pixels).is_some())
    }
}

fn caught(violation: Violation, cases: &[&str]) {
    let report = conformance::run_some(&ViolatingSubject(violation), cases);
    assert_eq!(report.failed(), cases, "{report}");
}

#[test]
fn an_honest_back_end_passes_and_says_what_it_cannot() {
    let report = conformance::run(&ViolatingSubject(Violation::None));
    assert!(report.is_good(), "{report}");
    let cannot = [
        "clock",
        "half_frame",
        "wrong_size",
        "repeated",
        "skip",
        "time_backwards",
        "clock_reset",
        "busy",
        "hang",
        "motion",
    ];
    assert_eq!(report.not_applicable(), cannot);
    assert_eq!(report.verdicts.len(), conformance::cases().len());
}

#[test]
fn frames_that_lie_are_caught() {
    caught(Violation::LastByteUnwritten, &["every_byte"]);
    caught(Violation::FromTheFuture, &["frames"]);
    caught(Violation::TimeGoesBack, &["frames"]);
    caught(Violation::PublishesTwice, &["frames"]);
}

#[test]
fn books_that_are_wrong_are_caught() {
    caught(Violation::HidesDrops, &["no_slot"]);
}

#[test]
fn devices_that_are_not_what_they_say_are_caught() {
    caught(Violation::NotListed, &["discover"]);
    caught(Violation::AnyModeWillDo, &["profiles", "unsupported"]);
    caught(Violation::KeepsTheDevice, &["reopen"]);
}

#[test]
fn wrong_answers_to_trouble_are_caught() {
    caught(Violation::StallIsAnError, &["stall"]);
    caught(Violation::SlowPoll, &["poll_timeout"]);
    caught(Violation::LivesOnAfterUnplug, &["unplug"]);
}

#[test]
fn batches_of_motion_that_lie_are_caught() {
    for violation in [
        Violation::SamplesSwapped,
        Violation::SampleLost,
        Violation::HeaderOfTheOldest,
        Violation::NotANumber,
    ] {
        caught(violation, &["motion"]);
    }
}
