//! A camera thread ends in time, whatever its device does.

use super::*;
use crate::StreamProfile;

/// A device that behaves as `act` says at every poll.
struct Act<F>(F, Vec<StreamProfile>);

impl<F: FnMut(Duration, &mut dyn FrameSink) -> Result<Poll> + Send> Stream for Act<F> {
    fn profiles(&self) -> &[StreamProfile] {
        &self.1
    }
    fn poll(&mut self, timeout: Duration, sink: &mut dyn FrameSink) -> Result<Poll> {
        (self.0)(timeout, sink)
    }
}

/// Counts commits and superseded frames, and remembers the reasons of drops.
#[derive(Clone, Default)]
struct Counting(Arc<Mutex<(u64, Vec<DropReason>, u64)>>);

impl FrameSink for Counting {
    fn loan(&mut self, _: usize, _: usize) -> Option<&mut [u8]> {
        Some(&mut [])
    }
    fn commit(&mut self, _: usize, _: &FrameMeta) {
        self.0.lock().unwrap().0 += 1;
    }
    fn discard(&mut self, _: usize) {}
    fn dropped(&mut self, _: usize, reason: DropReason, _: u64) {
        self.0.lock().unwrap().1.push(reason);
    }
    fn superseded(&mut self, _: usize, n: u64) {
        self.0.lock().unwrap().2 += n;
    }
    fn captured(&mut self, _: usize, _: u64) {}
    fn clock_quality(&mut self, _: usize, _: &ClockQuality) {}
}

fn start(
    sink: &Counting,
    act: impl FnMut(Duration, &mut dyn FrameSink) -> Result<Poll> + Send + 'static,
) -> Capture {
    start_with(Vec::new(), sink, act)
}

fn start_with(
    profiles: Vec<StreamProfile>,
    sink: &Counting,
    act: impl FnMut(Duration, &mut dyn FrameSink) -> Result<Poll> + Send + 'static,
) -> Capture {
    let sink = sink.clone();
    Capture::spawn("cam", move || {
        Ok(Session {
            info: DeviceInfo::default(),
            stream: Box::new(Act(act, profiles)),
            sink: Box::new(sink),
        })
    })
    .unwrap()
}

/// Samples of an IMU do not prove that images arrive, unless there are no image streams.
#[test]
fn motion_is_no_sign_of_images() {
    let clock = crate::DeviceClock::microseconds(64);
    let pose = depthrig_bus::Pose::IDENTITY;
    let unit = crate::motion::profile(100.0, 8, pose, clock, depthrig_bus::MetadataLevel::Simulated).unwrap();
    let image = StreamProfile { format: depthrig_bus::PixelFormat::Mono8, ..unit.clone() };
    for (profiles, is_seen) in [(vec![unit.clone()], true), (vec![image, unit], false)] {
        let sink = Counting::default();
        let motion = profiles.len() - 1;
        let go = Arc::new(AtomicBool::new(false));
        let shown = Arc::clone(&sink.0);
        let gone = Arc::clone(&go);
        let capture = start_with(profiles, &sink, move |_, sink| {
            let stream = if gone.load(Ordering::SeqCst) { 0 } else { motion };
            sink.commit(stream, &meta());
            std::thread::sleep(Duration::from_millis(1));
            Ok(Poll::Frame)
        });
        while shown.lock().unwrap().0 < 3 {
            std::thread::sleep(Duration::from_millis(1));
        }
        assert_eq!(capture.last_frame().is_some(), is_seen);
        go.store(true, Ordering::SeqCst);
        while capture.last_frame().is_none() {
            std::thread::sleep(Duration::from_millis(1));
        }
        assert!(matches!(capture.stop(Duration::from_secs(5)), StopOutcome::Ended(End::Stopped)));
    }
}

fn meta() -> FrameMeta {
    FrameMeta {
        device_sequence: 0,
        device_time: 0,
        capture_time: HostTime::now(),
        capture_uncertainty_ns: 0,
        clock_epoch: 0,
        clock_domain: depthrig_bus::ClockDomain::Arrival,
        arrival: HostTime::now(),
        flags: depthrig_bus::FrameFlags(0),
        captured: 1,
        exposure_ns: 0,
        gain: 0.0,
        temperature_c: f32::NAN,
        latency_ns: 0,
    }
}

#[test]
fn a_quiet_device_stops_at_once() {
    let capture = start(&Counting::default(), |timeout, _| {
        std::thread::sleep(timeout);
        Ok(Poll::Idle)
    });
    assert!(matches!(capture.stop(Duration::from_secs(5)), StopOutcome::Ended(End::Stopped)));
}

#[test]
fn what_gives_way_is_no_loss_while_somebody_listens() {
    let sink = Counting::default();
    let capture = start(&sink, |_, sink| {
        sink.superseded(0, 1);
        std::thread::sleep(Duration::from_millis(1));
        Ok(Poll::Idle)
    });
    while sink.0.lock().unwrap().2 < 3 {
        std::thread::sleep(Duration::from_millis(1));
    }
    assert!(matches!(capture.stop(Duration::from_secs(5)), StopOutcome::Ended(End::Stopped)));
    assert!(sink.0.lock().unwrap().1.is_empty());
}

#[test]
fn a_failing_and_a_panicking_driver_end_with_their_reason() {
    for panics in [false, true] {
        let capture = start(&Counting::default(), move |_, _| {
            assert!(!panics, "impossible header");
            Err(Error::new(ErrorKind::Disconnected, "cam: unplugged"))
        });
        while !capture.has_ended() {
            std::thread::sleep(Duration::from_millis(1));
        }
        let StopOutcome::Ended(End::Failed(e)) = capture.stop(Duration::from_secs(5)) else { panic!() };
        let wanted = if panics { "the driver panicked: impossible header" } else { "cam: unplugged" };
        assert!(e.to_string().contains(wanted), "{e}");
    }
}

#[test]
fn a_hung_device_is_abandoned_and_publishes_nothing_when_it_wakes() {
    let sink = Counting::default();
    let wake = Arc::new(AtomicBool::new(false));
    let hanging = Arc::new(AtomicBool::new(false));
    let woken = Arc::clone(&wake);
    let hangs = Arc::clone(&hanging);
    let capture = start(&sink, move |_, sink| {
        hangs.store(true, Ordering::SeqCst);
        while !woken.load(Ordering::SeqCst) {
            std::thread::sleep(Duration::from_millis(1)); // ignores its timeout, as a stuck ioctl does
        }
        sink.commit(0, &meta());
        Ok(Poll::Frame)
    });
    while !hanging.load(Ordering::SeqCst) {
        std::thread::sleep(Duration::from_millis(1));
    }
    let began = HostTime::now();
    assert!(matches!(capture.stop(Duration::from_millis(100)), StopOutcome::Abandoned));
    assert!(began.elapsed() < Duration::from_secs(2));
    wake.store(true, Ordering::SeqCst);
    while *sink.0.lock().unwrap() == (0, vec![], 0) {
        std::thread::sleep(Duration::from_millis(1));
    }
    assert_eq!(*sink.0.lock().unwrap(), (0, vec![DropReason::Abandoned], 0));
}

#[test]
fn opening_may_hang_too() {
    let capture = Capture::spawn("cam", || {
        std::thread::sleep(Duration::from_secs(2));
        Err(Error::new(ErrorKind::NotFound, "never seen"))
    })
    .unwrap();
    assert!(matches!(capture.stop(Duration::from_millis(50)), StopOutcome::Abandoned));
}
