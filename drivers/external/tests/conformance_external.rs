//! The external backend keeps every promise of the suite that a camera behind another process can be held to. The
//! process is a thread here, so that the test knows exactly what it did; real ones are in `external.rs`.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use depthrig_bus::external::{
    About, ExternalCamera, ExternalFrame, ExternalFrameFlags, ExternalReason, Mode, Place, Session,
};
use depthrig_bus::{DropReason, HostTime, Name, PixelFormat, RuntimeDir};
use depthrig_driver::{
    Backend, Device, DeviceInfo, FrameSink, Poll, Result, Stream, StreamProfile, StreamRequest,
};
use depthrig_external::{ExternalBackend, ExternalConfig};
use depthrig_sim::conformance::{self, Bench, Cannot, Rig, Sent, Subject, Trouble};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;

const SIZE: (u32, u32) = (16, 12);
const RATE_HZ: f64 = 100.0;
const PERIOD_NS: i64 = 10_000_000;
/// Frames that wait unread at most: what is sent beyond is lost, and that the process knows here.
const UNREAD: u64 = 4;
/// From the true mid-exposure to the arrival.
const LATENCY_NS: i64 = 3_000_000;

/// State shared with the process: its record of frames, and the faults to cause.
#[derive(Default)]
struct Script {
    sent: [Sent; 2],
    truth: Vec<(HostTime, HostTime)>,
    /// Frames of each stream that are yet to be spoiled in this way.
    spoil: Option<(Trouble, u32)>,
    quiet_until: Option<HostTime>,
    gone_until: Option<(HostTime, ExternalReason)>,
    /// Of the device: its counter, and by how much its clock is off.
    counter: u64,
    clock_ns: i64,
    skip: u64,
    /// The counter has begun anew, and nothing was sent since.
    reset: bool,
}

#[derive(Clone)]
struct Shared(Arc<Mutex<Script>>, Arc<Mutex<SyncSender<SyncSender<()>>>>);

impl Shared {
    fn script(&self) -> MutexGuard<'_, Script> {
        self.0.lock().unwrap()
    }

    /// Has the process send what is due, and waits until it has.
    fn produce(&self) {
        let (done, wait) = sync_channel(1024);
        if self.1.lock().unwrap().send(done).is_ok() {
            let _ = wait.recv_timeout(Duration::from_secs(5));
        }
    }
}

fn modes() -> [Mode; 2] {
    let mode = |name: &str, format| {
        Mode::new(Name::new(name).unwrap(), format, SIZE.0, SIZE.1, RATE_HZ)
            .with_device_clock(32, 1_000_000, 32)
    };
    [mode("color", PixelFormat::Rgb8), mode("depth", PixelFormat::Z16)]
}

fn image(stream: usize, number: u64) -> Vec<u8> {
    let bytes = modes()[stream].frame_bytes();
    (0..bytes).map(|i| (i as u64 * 7 + number * 31 + stream as u64) as u8).collect()
}

/// The process: serves until the test's end is gone.
fn process(place: &Place, shared: &Shared, orders: &Receiver<SyncSender<()>>) {
    let about = About { model: "Bench".into(), serial: "bench".into(), ..About::default() };
    let mut camera = ExternalCamera::offer(place, &about, &modes()).unwrap();
    let mut gone = false;
    loop {
        let until = shared.script().gone_until;
        match until {
            Some((until, reason)) if !until.from_now().is_zero() => {
                if !gone {
                    camera.unavailable(reason, "the test says so").unwrap();
                }
                gone = true;
            }
            _ if gone => {
                camera.available().unwrap();
                shared.script().gone_until = None;
                gone = false;
            }
            _ => {}
        }
        if !gone && let Some(mut session) = camera.next_session(Duration::from_millis(5)).unwrap() {
            serve(&mut session, shared, orders);
        }
        match orders.try_recv() {
            Ok(done) => drop(done),
            Err(std::sync::mpsc::TryRecvError::Disconnected) => return,
            Err(std::sync::mpsc::TryRecvError::Empty) => {}
        }
        if gone {
            std::thread::sleep(Duration::from_millis(5));
        }
    }
}

fn serve(session: &mut Session<'_>, shared: &Shared, orders: &Receiver<SyncSender<()>>) {
    let running: Vec<usize> = session.modes().map(|(i, _)| i).collect();
    {
        let mut script = shared.script();
        script.sent = [Sent::default(); 2];
        script.truth.clear();
    }
    let mut next = HostTime::now();
    session.started();
    round(session, &running, shared, next); // the driver waits for one
    while session.is_wanted() {
        let Ok(done) = orders.recv_timeout(Duration::from_millis(20)) else { continue };
        let now = HostTime::now();
        if shared.script().gone_until.is_some() {
            return;
        }
        if shared.script().quiet_until.is_some_and(|t| now < t) {
            next = now;
        }
        // Nobody can know of new numbers that were replaced before the first of them was read.
        if core::mem::take(&mut shared.script().reset) {
            next = now.plus_ns(-PERIOD_NS);
        }
        // What the script spoils must be read before it is replaced, however long this computer paused.
        let most = if shared.script().spoil.is_some() { 1 } else { 40 };
        let due = (now.since_ns(next) / PERIOD_NS).clamp(0, most) as u64;
        for i in 1..=due {
            next = next.plus_ns(PERIOD_NS);
            round(session, &running, shared, next);
            if due - i >= UNREAD {
                lose(shared, &running);
            }
        }
        drop(done);
    }
}

/// A frame that was sent will be replaced before it is read.
fn lose(shared: &Shared, running: &[usize]) {
    for (stream, _) in running.iter().enumerate() {
        let mut script = shared.script();
        script.sent[stream].good -= 1;
        script.sent[stream].drops.add(DropReason::QueueFull, 1);
    }
}

/// One frame of every stream, as the script says.
fn round(session: &mut Session<'_>, running: &[usize], shared: &Shared, at: HostTime) {
    let (trouble, number, clock_ns, skip) = {
        let mut script = shared.script();
        let skip = core::mem::take(&mut script.skip);
        script.counter += 1 + skip;
        let trouble = script.spoil;
        script.spoil = trouble.and_then(|(t, n)| (n > 1).then_some((t, n - 1)));
        (trouble.map(|(t, _)| t), script.counter, script.clock_ns, skip)
    };
    let arrival = at.min(HostTime::now());
    for (stream, mode) in running.iter().enumerate() {
        let truth = arrival.plus_ns(-LATENCY_NS);
        let mut facts = ExternalFrame {
            device_sequence: number & 0xFFFF_FFFF,
            device_time: ((truth.ns() + clock_ns) / 1000).cast_unsigned() & 0xFFFF_FFFF,
            arrival_time_ns: arrival.ns(),
            ..ExternalFrame::default()
        };
        let pixels = image(*mode, number);
        let mut script = shared.script();
        script.truth.push((arrival, truth));
        let sent = &mut script.sent[stream];
        sent.captured += 1 + skip;
        sent.drops.add(DropReason::DeviceGap, skip);
        let spoiled = |sent: &mut Sent, reason| sent.drops.add(reason, 1);
        match trouble {
            None => sent.good += 1,
            Some(Trouble::HalfFrame(_)) => {
                spoiled(sent, DropReason::Incomplete);
                session.send_copy(*mode, &facts, &pixels[..pixels.len() / 2]).unwrap();
                continue;
            }
            Some(Trouble::WrongSize(_)) => {
                spoiled(sent, DropReason::WrongSize);
                let mut slot = session.frame(*mode, pixels.len()).unwrap().unwrap();
                slot.set_facts(&facts);
                slot.header_mut().payload_len += 1;
                session.send(slot).unwrap();
                continue;
            }
            Some(Trouble::Damaged(_)) => {
                spoiled(sent, DropReason::DeviceError);
                facts.flags = ExternalFrameFlags::DAMAGED.0;
            }
            Some(_) => {
                sent.good += 1;
                sent.captured += 1;
                spoiled(sent, DropReason::OutOfOrder);
                session.send_copy(*mode, &facts, &pixels).unwrap();
            }
        }
        drop(script);
        session.send_copy(*mode, &facts, &pixels).unwrap();
    }
}

/// The backend with the process beside it, which sends when it is polled: so that nothing is under way when the suite
/// compares accounts.
struct Lockstep(ExternalBackend, Shared, #[allow(dead_code)] Arc<tempfile::TempDir>);

impl Backend for Lockstep {
    fn name(&self) -> &'static str {
        self.0.name()
    }
    fn discover(&self) -> Result<Vec<DeviceInfo>> {
        self.0.discover()
    }
    fn open(&self, serial: Option<&str>) -> Result<Box<dyn Device>> {
        Ok(Box::new(LockstepDevice(self.0.open(serial)?, self.1.clone())))
    }
}

struct LockstepDevice(Box<dyn Device>, Shared);

impl Device for LockstepDevice {
    fn info(&self) -> &DeviceInfo {
        self.0.info()
    }
    fn profiles(&self) -> &[StreamProfile] {
        self.0.profiles()
    }
    fn start(self: Box<Self>, requests: &[StreamRequest]) -> Result<Box<dyn Stream>> {
        Ok(Box::new(LockstepStream(self.0.start(requests)?, self.1)))
    }
}

struct LockstepStream(Box<dyn Stream>, Shared);

impl Stream for LockstepStream {
    fn profiles(&self) -> &[StreamProfile] {
        self.0.profiles()
    }
    fn poll(&mut self, timeout: Duration, sink: &mut dyn FrameSink) -> Result<Poll> {
        self.1.produce();
        let mut polled = self.0.poll(timeout.min(Duration::from_millis(10)), sink)?;
        while polled == Poll::Frame && self.0.poll(Duration::ZERO, sink)? == Poll::Frame {
            polled = Poll::Frame;
        }
        Ok(polled)
    }
}

struct External;

impl Subject for External {
    fn name(&self) -> String {
        "external".into()
    }

    fn make(&self) -> Bench {
        let dir = Arc::new(tempfile::tempdir().unwrap());
        let runtime = RuntimeDir::at(dir.path()).unwrap();
        let place = Place { runtime, rig: Name::new("rig").unwrap(), camera: Name::new("cam").unwrap() };
        let (orders, theirs) = sync_channel(1024);
        let shared = Shared(Arc::default(), Arc::new(Mutex::new(orders)));
        let at = place.clone();
        let of = shared.clone();
        // The thread ends when the last sender is gone; it must not keep one itself.
        let script = Shared(of.0, Arc::new(Mutex::new(sync_channel(1).0)));
        std::thread::spawn(move || process(&at, &script, &theirs));
        let backend = ExternalBackend::new(ExternalConfig::default(), place);
        while backend.discover().is_ok_and(|d| d.is_empty()) {
            std::thread::sleep(Duration::from_millis(2));
        }
        Bench {
            backend: Box::new(Lockstep(backend, shared.clone(), dir)),
            serial: "bench".into(),
            requests: vec![],
            rig: Box::new(TestRig(shared)),
        }
    }
}

struct TestRig(Shared);

impl Rig for TestRig {
    fn cause(&self, trouble: Trouble) -> std::result::Result<(), Cannot> {
        let mut script = self.0.script();
        let until = |d| HostTime::now().plus(d);
        match trouble {
            Trouble::Unplug(d) => script.gone_until = Some((until(d), ExternalReason::Disconnected)),
            Trouble::Busy(d) => {
                script.gone_until = Some((until(d), ExternalReason::Busy));
                drop(script);
                // The process says so at its next heart-beat at the latest.
                std::thread::sleep(Duration::from_millis(50));
            }
            Trouble::Stall(d) => script.quiet_until = Some(until(d)),
            Trouble::HalfFrame(n) | Trouble::WrongSize(n) | Trouble::Damaged(n) | Trouble::Repeated(n) => {
                script.spoil = Some((trouble, n));
            }
            Trouble::Skip(n) => script.skip = n.into(),
            Trouble::TimeBackwards(d) => script.clock_ns -= d.as_nanos() as i64,
            Trouble::ClockReset => {
                script.clock_ns = -HostTime::now().ns();
                script.counter = 0;
                script.reset = true;
            }
            Trouble::Hang(_) => {
                return Err(Cannot("the driver never waits for the process, which is what it is for"));
            }
        }
        Ok(())
    }

    fn sent(&self, stream: usize) -> Option<Sent> {
        Some(self.0.script().sent[stream])
    }

    fn true_capture(&self, _: usize, arrival: HostTime) -> Option<(HostTime, u64)> {
        let script = self.0.script();
        let known = script.truth.iter().find(|(a, _)| *a == arrival)?;
        // Its least latency is constant, which no map can know.
        Some((known.1, LATENCY_NS.cast_unsigned() + 2_000_000))
    }

    fn is_genuine(&self, stream: usize, pixels: &[u8]) -> Option<bool> {
        let newest = self.0.script().counter;
        Some((newest.saturating_sub(200)..=newest).any(|n| image(stream, n) == pixels))
    }
}

#[test]
fn external_passes_every_case_that_a_process_can_be_put_to() {
    let names = std::env::var("DEPTHRIG_CASES").unwrap_or_default();
    let names: Vec<&str> = names.split(',').filter(|n| !n.is_empty()).collect();
    let report =
        if names.is_empty() { conformance::run(&External) } else { conformance::run_some(&External, &names) };
    println!("{report}");
    assert!(report.is_good(), "{report}");
    if names.is_empty() {
        assert_eq!(report.not_applicable(), ["hang", "motion"]);
    }
}
