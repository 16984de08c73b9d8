//! The synthetic backend keeps every promise of the suite.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use depthrig_bus::{HostTime, MotionSample, Name, PixelFormat};
use depthrig_sim::conformance::{self, Bench, Cannot, Rig, Sent, Subject, Trouble};
use depthrig_sim::synthetic::{
    FaultKind, Pattern, SimTruth, StreamOverride, SyntheticBackend, SyntheticConfig,
};
use std::time::Duration;

const SIZE: (u32, u32) = (160, 120);

/// A quick camera with two streams and an IMU, whose frames can be checked byte by byte.
struct Cheap;

impl Subject for Cheap {
    fn name(&self) -> String {
        "synthetic".into()
    }

    fn make(&self) -> Bench {
        let stream = |name, rate| StreamOverride {
            stream: Name::new(name).unwrap(),
            size: Some(SIZE),
            rate_hz: Some(rate),
        };
        let mut config = SyntheticConfig {
            serial: "bench".into(),
            cheap: true,
            motion: true,
            streams: vec![stream("color", 100.0), stream("depth", 200.0)],
            ..SyntheticConfig::default()
        };
        // A wrap of the counter after one second, in the middle of the longer cases.
        config.clock.start_ticks = (1 << 32) - 1_000_000;
        config.clock.drift_ppm = 40.0;
        config.clock.stall_probability = 0.01;
        config.clock.stall_ms = (5.0, 20.0);
        let patterns = [("color", PixelFormat::Rgb8), ("depth", PixelFormat::Z16)]
            .map(|(name, format)| Pattern::new(config.seed, name, format, SIZE.0, SIZE.1));
        let backend = SyntheticBackend::new(vec![config]).unwrap();
        let rig = Box::new(TestRig { truth: backend.truth("bench").unwrap(), patterns });
        Bench { backend: Box::new(backend), serial: "bench".into(), requests: vec![], rig }
    }
}

struct TestRig {
    truth: SimTruth,
    patterns: [Pattern; 2],
}

impl Rig for TestRig {
    fn cause(&self, trouble: Trouble) -> Result<(), Cannot> {
        let none = Duration::ZERO;
        let (kind, duration, count) = match trouble {
            Trouble::Unplug(d) => (FaultKind::Unplug, d, 1),
            Trouble::Stall(d) => (FaultKind::Stall, d, 1),
            Trouble::Hang(d) => (FaultKind::Hang, d, 1),
            Trouble::HalfFrame(n) => (FaultKind::HalfFrame, none, n),
            Trouble::WrongSize(n) => (FaultKind::WrongSize, none, n),
            Trouble::Damaged(n) => (FaultKind::Damaged, none, n),
            Trouble::Repeated(n) => (FaultKind::Repeated, none, n),
            Trouble::Skip(n) => (FaultKind::Skip, none, n),
            Trouble::TimeBackwards(d) => (FaultKind::TimeBackwards, d, 1),
            Trouble::ClockReset => (FaultKind::ClockReset, none, 1),
            Trouble::Busy(d) => (FaultKind::OpenBusy, d, 1),
        };
        self.truth.inject(kind, duration, count);
        Ok(())
    }

    fn sent(&self, stream: usize) -> Option<Sent> {
        let ledger = self.truth.ledger(stream);
        Some(Sent { captured: ledger.captured, good: ledger.good, drops: ledger.drops })
    }

    fn true_capture(&self, stream: usize, arrival: HostTime) -> Option<(HostTime, u64)> {
        // A map cannot know the least latency (3 ms, and half an exposure of 4 ms); jitter adds to it at first.
        self.truth.frame(stream, arrival).map(|f| (f.capture, 12_000_000))
    }

    fn is_genuine(&self, stream: usize, pixels: &[u8]) -> Option<bool> {
        let Some(pattern) = self.patterns.get(stream) else {
            return Some(is_batch(pixels));
        };
        Some(pattern.identify(pixels).is_some())
    }
}

/// Whether these are eight samples that follow each other in number and time.
fn is_batch(payload: &[u8]) -> bool {
    let all: Vec<_> = MotionSample::all_in(payload).collect();
    let follow = |w: &[MotionSample]| w[0].sequence + 1 == w[1].sequence && w[0].time_ns < w[1].time_ns;
    all.len() == 8 && payload.len() == 512 && all.windows(2).all(follow)
}

#[test]
fn synthetic_passes_every_case() {
    let report = conformance::run(&Cheap);
    println!("{report}");
    assert!(report.is_good(), "{report}");
    assert_eq!(report.not_applicable(), Vec::<&str>::new());
}
