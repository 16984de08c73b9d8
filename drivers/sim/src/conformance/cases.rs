//! The cases of the suite.
//!
//! More than 500 lines, because all cases lie side by side in one table with what each does.

use super::probe::{Observed, Probe, Published, wait_for};
use super::{Bench, Cannot, Trouble};
use core::time::Duration;
use depthrig_bus::{DropReason, HostTime, MotionSample, Name};
use depthrig_driver::capture::{Capture, End, Session, StopOutcome};
use depthrig_driver::motion::LONGEST;
use depthrig_driver::{Error, ErrorKind, Poll, Stream, StreamProfile, StreamRequest};

/// Why a case did not pass.
pub(super) enum Stop {
    Failed(String),
    NotApplicable(String),
}

impl From<Cannot> for Stop {
    fn from(cannot: Cannot) -> Self {
        Self::NotApplicable(cannot.0.to_owned())
    }
}

type Outcome = Result<(), Stop>;
/// A case; the device is fresh.
pub(super) type Case = fn(&Bench) -> Outcome;

/// Every case.
pub(super) const ALL: &[(&str, Case)] = &[
    ("discover", discover),
    ("open_unknown", open_unknown),
    ("profiles", profiles),
    ("unsupported", unsupported),
    ("frames", frames),
    ("every_byte", every_byte),
    ("poll_timeout", poll_timeout),
    ("no_slot", no_slot),
    ("reopen", reopen),
    ("stop", stop),
    ("clock", clock),
    ("half_frame", half_frame),
    ("wrong_size", wrong_size),
    ("damaged", damaged),
    ("repeated", repeated),
    ("skip", skip),
    ("slow_reader", slow_reader),
    ("stall", stall),
    ("time_backwards", time_backwards),
    ("clock_reset", clock_reset),
    ("unplug", unplug),
    ("busy", busy),
    ("hang", hang),
    ("motion", motion),
];

/// How long a device may take for what takes it no time.
const TIMEOUT: Duration = Duration::from_secs(20);
const POLL: Duration = Duration::from_millis(50);
/// Longest time for a stop, whatever the device does.
const STOP: Duration = Duration::from_secs(1);

fn fail<T>(why: impl Into<String>) -> Result<T, Stop> {
    Err(Stop::Failed(why.into()))
}

fn check(is_so: bool, why: impl FnOnce() -> String) -> Outcome {
    if is_so { Ok(()) } else { fail(why()) }
}

fn failed(what: &'static str) -> impl Fn(Error) -> Stop {
    move |e| Stop::Failed(format!("{what}: {e}"))
}

/// A running device and the probe at its end.
struct Running {
    stream: Box<dyn Stream>,
    probe: Probe,
}

impl Running {
    fn start(bench: &Bench) -> Result<Self, Stop> {
        Self::start_with(bench, &bench.requests)
    }

    fn start_with(bench: &Bench, requests: &[StreamRequest]) -> Result<Self, Stop> {
        let device = bench.backend.open(Some(&bench.serial)).map_err(failed("open"))?;
        let stream = device.start(requests).map_err(failed("start"))?;
        let probe = Probe::new(stream.profiles());
        Ok(Self { stream, probe })
    }

    /// Polls until the observations satisfy `is_done`; the device must do that in time.
    fn poll_until(&mut self, what: &str, mut is_done: impl FnMut(&mut Observed) -> bool) -> Outcome {
        let deadline = HostTime::now().plus(TIMEOUT);
        while !self.probe.with(|b| is_done(b)) {
            let mut sink = self.probe.clone();
            if self.stream.poll(POLL, &mut sink).map_err(failed("poll"))? == Poll::End {
                return fail(format!("the source came to its end while waiting for {what}"));
            }
            check(!deadline.from_now().is_zero(), || format!("waited {TIMEOUT:?} in vain for {what}"))?;
        }
        Ok(())
    }

    /// Polls until every stream has `n` more frames.
    fn poll_frames(&mut self, n: u64) -> Outcome {
        let before = self.probe.with(|b| b.delivered.clone());
        self.poll_until("frames", |b| b.delivered.iter().zip(&before).all(|(now, then)| *now >= then + n))
    }

    /// No promise was broken, and the accounts are those of the device.
    fn check_books(&self, bench: &Bench) -> Outcome {
        self.probe.with(|b| {
            check(b.broken.is_empty(), || b.broken.join("; "))?;
            for i in 0..b.delivered.len() {
                let ours = b.delivered[i] + b.drops[i].total();
                check(b.captured[i] == ours, || {
                    format!(
                        "stream {i}: {} frames announced as captured, {ours} delivered or dropped",
                        b.captured[i]
                    )
                })?;
                let Some(sent) = bench.rig.sent(i) else { continue };
                let refused = b.drops[i].get(DropReason::NoSlot);
                let mut ours = b.drops[i];
                ours.0[DropReason::NoSlot as usize] = 0;
                check((b.delivered[i] + refused, ours) == (sent.good, sent.drops), || {
                    format!(
                        "stream {i}: delivered {} (+{refused} refused), drops {ours:?}; the device: {sent:?}",
                        b.delivered[i]
                    )
                })?;
                check(b.delivered[i] + b.drops[i].total() == sent.captured, || {
                    format!(
                        "stream {i}: delivered + dropped is not the {} frames that were captured",
                        sent.captured
                    )
                })?;
            }
            Ok(())
        })
    }
}

fn discover(bench: &Bench) -> Outcome {
    let found = bench.backend.discover().map_err(failed("discover"))?;
    let Some(info) = found.iter().find(|i| i.serial == bench.serial) else {
        return fail(format!("discover does not list {}: {found:?}", bench.serial));
    };
    check(info.backend == bench.backend.name(), || format!("it is listed for the backend {}", info.backend))?;
    let device = bench.backend.open(None).map_err(failed("open without a serial number"))?;
    check(device.info() == info, || format!("{:?} is not what discover said: {info:?}", device.info()))
}

fn open_unknown(bench: &Bench) -> Outcome {
    match bench.backend.open(Some("no such serial")) {
        Ok(_) => fail("a device that does not exist was opened"),
        Err(e) => {
            check(e.kind() == ErrorKind::NotFound, || format!("{:?}: {e}", e.kind()))?;
            check(e.to_string().contains("no such serial"), || format!("the message does not name it: {e}"))
        }
    }
}

fn profiles(bench: &Bench) -> Outcome {
    let device = bench.backend.open(Some(&bench.serial)).map_err(failed("open"))?;
    let all = device.profiles().to_vec();
    // An IMU may need a camera that runs.
    let images = || all.iter().filter(|p| !p.format.is_motion());
    let Some(wanted) = images().next_back().or(all.last()).cloned() else {
        return fail("the device has no mode");
    };
    let request = StreamRequest {
        stream: wanted.stream.clone(),
        size: Some((wanted.width, wanted.height)),
        rate_hz: Some(wanted.rate_hz),
        format: Some(wanted.format),
    };
    let stream = device.start(&[request]).map_err(failed("start"))?;
    let got: Vec<_> = stream.profiles().iter().map(StreamProfile::describe).collect();
    check(got == [wanted.describe()], || format!("asked for {}, got {got:?}", wanted.describe()))
}

fn unsupported(bench: &Bench) -> Outcome {
    let device = bench.backend.open(Some(&bench.serial)).map_err(failed("open"))?;
    let Some(mode) = device.profiles().first().cloned() else { return fail("the device has no mode") };
    let request = StreamRequest { size: Some((3, 1)), ..StreamRequest::any(mode.stream.clone()) };
    let of = |p: &StreamProfile| (p.stream.clone(), p.width, p.height, p.format);
    let named = StreamProfile::describe_all(device.profiles().iter().filter(|p| of(p) == of(&mode)));
    let nothing = Name::new("no_such_stream").map_err(|e| Stop::Failed(e.to_string()))?;
    let Err(e) = device.start(&[request]) else {
        return fail("a mode that does not exist was started");
    };
    check(e.kind() == ErrorKind::Unsupported, || format!("{:?}: {e}", e.kind()))?;
    check(e.to_string().contains(&named), || format!("the message does not name the modes: {e}"))?;
    let device = bench.backend.open(Some(&bench.serial)).map_err(failed("open after a refused start"))?;
    match device.start(&[StreamRequest::any(nothing)]) {
        Ok(_) => fail("a stream that does not exist was started"),
        Err(e) => check(e.kind() == ErrorKind::Unsupported, || format!("{:?}: {e}", e.kind())),
    }
}

fn frames(bench: &Bench) -> Outcome {
    let mut running = Running::start(bench)?;
    running.poll_frames(10)?;
    running.check_books(bench)
}

fn every_byte(bench: &Bench) -> Outcome {
    let mut running = Running::start(bench)?;
    running.poll_frames(4)?;
    running.probe.with(|b| {
        for i in 0..b.delivered.len() {
            // A run of untouched bytes at the same place under both fills is memory nobody wrote.
            let of_fill = |fill| b.published.iter().find(move |p| p.stream == i && p.fill == fill);
            if let (Some(one), Some(two)) = (of_fill(0xA5), of_fill(0x5A)) {
                let both = one.pixels.iter().zip(&two.pixels);
                let untouched = both.filter(|(a, b)| (**a, **b) == (0xA5, 0x5A)).count();
                // Both values at one place by chance: one pixel in 65536 of noise.
                check(untouched <= 2 + one.pixels.len() / 4096, || {
                    format!("stream {i}: {untouched} bytes were not written")
                })?;
            }
        }
        let judged: Vec<_> =
            b.published.iter().filter_map(|p| bench.rig.is_genuine(p.stream, &p.pixels)).collect();
        if judged.is_empty() {
            return Err(Stop::NotApplicable("the subject cannot recognise its own frames".to_owned()));
        }
        check(judged.iter().all(|g| *g), || "a published frame is not one that the device sent".to_owned())
    })
}

fn poll_timeout(bench: &Bench) -> Outcome {
    let mut running = Running::start(bench)?;
    running.poll_frames(1)?;
    // With no time at all, polling must come back at once, frame or not; the bound is that of a busy machine.
    let began = HostTime::now();
    for _ in 0..50 {
        let mut sink = running.probe.clone();
        running.stream.poll(Duration::ZERO, &mut sink).map_err(failed("poll"))?;
    }
    check(began.elapsed() < Duration::from_secs(5), || {
        format!("50 polls without a wait took {:?}", began.elapsed())
    })?;
    running.check_books(bench)
}

fn no_slot(bench: &Bench) -> Outcome {
    let mut running = Running::start(bench)?;
    running.poll_frames(2)?;
    running.probe.with(|b| b.refuse = 3);
    running.poll_frames(3)?;
    let refused: u64 = running.probe.with(|b| b.drops.iter().map(|d| d.get(DropReason::NoSlot)).sum());
    check(refused == 3, || format!("3 loans were refused, {refused} drops counted for it"))?;
    running.check_books(bench)
}

fn reopen(bench: &Bench) -> Outcome {
    for _ in 0..3 {
        let mut running = Running::start(bench)?;
        running.poll_frames(1)?;
    }
    drop(bench.backend.open(Some(&bench.serial)).map_err(failed("open"))?);
    bench.backend.open(Some(&bench.serial)).map_err(failed("open after the device was dropped")).map(drop)
}

/// A camera thread, and the observations of what it publishes.
fn spawn(bench: &Bench) -> Result<(Capture, Probe), Stop> {
    let Running { stream, probe } = Running::start(bench)?;
    let theirs = probe.clone();
    let open =
        move || Ok(Session { info: depthrig_driver::DeviceInfo::default(), stream, sink: Box::new(theirs) });
    let capture = Capture::spawn("conformance", open).map_err(failed("spawn"))?;
    Ok((capture, probe))
}

fn stop(bench: &Bench) -> Outcome {
    let (capture, probe) = spawn(bench)?;
    check(wait_for(TIMEOUT, || probe.with(|b| b.least_delivered() >= 2)), || "no frames came".to_owned())?;
    let began = HostTime::now();
    let outcome = capture.stop(STOP);
    check(matches!(outcome, StopOutcome::Ended(End::Stopped)), || format!("stopping came to {outcome:?}"))?;
    check(began.elapsed() < STOP * 2, || format!("stopping took {:?}", began.elapsed()))?;
    let seen = probe.with(|b| b.seen());
    std::thread::sleep(Duration::from_millis(150));
    check(probe.with(|b| b.seen()) == seen, || "frames came after the stop".to_owned())?;
    bench.backend.open(Some(&bench.serial)).map_err(failed("open after the stop")).map(drop)
}

fn clock(bench: &Bench) -> Outcome {
    let mut running = Running::start(bench)?;
    running.poll_frames(15)?;
    running.probe.with(|b| {
        let mut judged = 0;
        for p in &b.published {
            let Some((capture, within_ns)) = bench.rig.true_capture(p.stream, p.meta.arrival) else {
                continue;
            };
            let off = p.meta.capture_time.since_ns(capture);
            judged += 1;
            check(off.unsigned_abs() <= within_ns, || {
                format!("a capture time is {off} ns off, {within_ns} ns are allowed")
            })?;
        }
        if judged == 0 {
            Err(Stop::NotApplicable("the true capture times are not known".to_owned()))
        } else {
            Ok(())
        }
    })
}

/// A few good frames, trouble with some, a few good ones again: the accounts must be exact.
fn spoiled(bench: &Bench, trouble: Trouble, reason: DropReason, n: u64) -> Outcome {
    let mut running = Running::start(bench)?;
    running.poll_frames(2)?;
    let before = running.probe.with(|b| b.drops.clone());
    bench.rig.cause(trouble)?;
    // A slow machine may add gaps of its own, also in place of what is spoiled, which is counted exactly below.
    let gap = DropReason::DeviceGap;
    running.poll_until("the drops", |b| {
        let mut pairs = b.drops.iter().zip(&before);
        pairs.all(|(d, then)| d.get(reason) + (d.get(gap) - then.get(gap)) * u64::from(reason != gap) >= n)
    })?;
    running.poll_frames(3)?;
    running.probe.with(|b| {
        let counted = b.drops.iter().map(|d| d.get(reason)).collect::<Vec<_>>();
        let is_counted = |c: &u64| (1..=n).contains(c) || (reason == gap && *c >= n);
        check(counted.iter().all(is_counted), || format!("{n} per stream were expected, counted {counted:?}"))
    })?;
    running.check_books(bench)
}

fn half_frame(bench: &Bench) -> Outcome {
    spoiled(bench, Trouble::HalfFrame(2), DropReason::Incomplete, 2)
}

fn wrong_size(bench: &Bench) -> Outcome {
    spoiled(bench, Trouble::WrongSize(2), DropReason::WrongSize, 2)
}

fn damaged(bench: &Bench) -> Outcome {
    spoiled(bench, Trouble::Damaged(2), DropReason::DeviceError, 2)
}

fn repeated(bench: &Bench) -> Outcome {
    spoiled(bench, Trouble::Repeated(2), DropReason::OutOfOrder, 2)
}

fn skip(bench: &Bench) -> Outcome {
    spoiled(bench, Trouble::Skip(5), DropReason::DeviceGap, 5)
}

fn slow_reader(bench: &Bench) -> Outcome {
    let mut running = Running::start(bench)?;
    running.poll_frames(2)?;
    let rate = running.stream.profiles().iter().map(|p| p.rate_hz).fold(f64::INFINITY, f64::min);
    std::thread::sleep(Duration::from_secs_f64((20.0 / rate).min(2.0)));
    running.poll_frames(3)?;
    running.check_books(bench)
}

fn stall(bench: &Bench) -> Outcome {
    let mut running = Running::start(bench)?;
    running.poll_frames(2)?;
    bench.rig.cause(Trouble::Stall(Duration::from_secs(2)))?;
    let mut idle = 0;
    let deadline = HostTime::now().plus(TIMEOUT);
    while idle < 5 {
        let mut sink = running.probe.clone();
        idle += u32::from(
            running.stream.poll(POLL, &mut sink).map_err(failed("poll while stalled"))? == Poll::Idle,
        );
        check(!deadline.from_now().is_zero(), || "the stalled device never was idle".to_owned())?;
    }
    running.poll_frames(3)?;
    running.check_books(bench)
}

fn time_backwards(bench: &Bench) -> Outcome {
    let mut running = Running::start(bench)?;
    running.poll_frames(5)?;
    bench.rig.cause(Trouble::TimeBackwards(Duration::from_millis(300)))?;
    // The probe checks every frame: time may go back from one epoch to the next, never within one.
    running.poll_frames(15)?;
    running.check_books(bench)
}

fn clock_reset(bench: &Bench) -> Outcome {
    let mut running = Running::start(bench)?;
    // Past the window in which a low counter could be a late frame (see `Gate`).
    let start = running.probe.with(|b| b.seen());
    running.poll_until("a hundred frames", |b| b.seen() >= start + 100 * b.delivered.len() as u64)?;
    bench.rig.cause(Trouble::ClockReset)?;
    running.poll_frames(15)?;
    running.check_books(bench)
}

fn unplug(bench: &Bench) -> Outcome {
    let mut running = Running::start(bench)?;
    running.poll_frames(2)?;
    let absent = Duration::from_millis(600);
    bench.rig.cause(Trouble::Unplug(absent))?;
    let deadline = HostTime::now().plus(TIMEOUT);
    let e = loop {
        let mut sink = running.probe.clone();
        match running.stream.poll(POLL, &mut sink) {
            Err(e) => break e,
            Ok(_) => {
                check(!deadline.from_now().is_zero(), || "the unplugged device still answers".to_owned())?;
            }
        }
    };
    check(e.kind() == ErrorKind::Disconnected, || format!("{:?}: {e}", e.kind()))?;
    running.check_books(bench)?;
    let mut sink = running.probe.clone();
    check(running.stream.poll(POLL, &mut sink).is_err(), || "a dead stream came to life".to_owned())?;
    drop(running);
    if let Err(e) = bench.backend.open(Some(&bench.serial)) {
        check(matches!(e.kind(), ErrorKind::NotFound | ErrorKind::Disconnected), || {
            format!("open while absent: {:?}: {e}", e.kind())
        })?;
    }
    let is_back = wait_for(TIMEOUT, || bench.backend.open(Some(&bench.serial)).is_ok());
    check(is_back, || "it cannot be opened after it was plugged in again".to_owned())?;
    let mut again = Running::start(bench)?;
    again.poll_frames(3)?;
    again.check_books(bench)
}

fn busy(bench: &Bench) -> Outcome {
    bench.rig.cause(Trouble::Busy(Duration::from_secs(2)))?;
    match bench.backend.open(Some(&bench.serial)) {
        Ok(_) => return fail("a device that somebody else holds was opened"),
        Err(e) => check(e.kind() == ErrorKind::Busy, || format!("{:?}: {e}", e.kind()))?,
    }
    let is_free = wait_for(TIMEOUT, || bench.backend.open(Some(&bench.serial)).is_ok());
    check(is_free, || "it cannot be opened after the other let go".to_owned())
}

fn hang(bench: &Bench) -> Outcome {
    let (capture, probe) = spawn(bench)?;
    check(wait_for(TIMEOUT, || probe.with(|b| b.least_delivered() >= 2)), || "no frames came".to_owned())?;
    let hang = Duration::from_millis(2500);
    bench.rig.cause(Trouble::Hang(hang))?;
    // It hangs when its thread no longer comes back from the device.
    let is_stuck = wait_for(TIMEOUT, || capture.heartbeat().elapsed() > POLL * 6);
    check(is_stuck, || "the device never hung".to_owned())?;
    let began = HostTime::now();
    let outcome = capture.stop(STOP);
    check(began.elapsed() < STOP + Duration::from_millis(500), || {
        format!("stopping took {:?}", began.elapsed())
    })?;
    check(matches!(outcome, StopOutcome::Abandoned), || format!("stopping came to {outcome:?}"))?;
    let delivered = probe.with(|b| b.delivered.clone());
    std::thread::sleep(hang);
    check(probe.with(|b| b.delivered == delivered), || "the abandoned thread published a frame".to_owned())
}

/// Batches of an IMU: as many samples as its rate says, in order, with rising times that the header repeats.
fn motion(bench: &Bench) -> Outcome {
    const BATCHES: usize = 12;
    let device = bench.backend.open(Some(&bench.serial)).map_err(failed("open"))?;
    let Some(unit) = device.profiles().iter().find(|p| p.format.is_motion()).cloned() else {
        return Err(Stop::NotApplicable("the device has no IMU".to_owned()));
    };
    drop(device);
    check((1..=1024).contains(&unit.width) && unit.height == 1, || {
        format!("a batch of {}x{} samples", unit.width, unit.height)
    })?;
    let mut requests = bench.requests.clone();
    if !requests.is_empty() && requests.iter().all(|r| r.stream != unit.stream) {
        requests.push(StreamRequest::any(unit.stream.clone()));
    }
    let mut running = Running::start_with(bench, &requests)?;
    let Some(stream) = running.stream.profiles().iter().position(|p| p.format.is_motion()) else {
        return fail("the IMU was not started");
    };
    let mut batches: Vec<Published> = Vec::new();
    running.poll_until("batches of motion", |b| {
        let (ours, rest) = b.published.drain(..).partition(|p| p.stream == stream);
        b.published = rest;
        batches.extend::<Vec<_>>(ours);
        batches.len() >= BATCHES
    })?;
    running.check_books(bench)?;
    let mut last: Option<(u32, MotionSample)> = None;
    let mut count = 0u64;
    let mut first = None;
    for (n, batch) in batches.iter().enumerate() {
        let wrong = |what: String| Stop::Failed(format!("batch {n}: {what}"));
        let samples: Vec<_> = MotionSample::all_in(&batch.pixels).collect();
        let (Some(oldest), Some(newest)) = (samples.first(), samples.last()) else {
            return Err(wrong("it is empty".to_owned()));
        };
        for s in &samples {
            if let Some((epoch, before)) = &last {
                if s.sequence <= before.sequence {
                    return Err(wrong(format!("sample {} comes after {}", s.sequence, before.sequence)));
                }
                if *epoch == batch.meta.clock_epoch && s.time_ns <= before.time_ns {
                    return Err(wrong(format!("the time of sample {} does not rise", s.sequence)));
                }
            }
            let is_measured = |v: &[f32; 3]| v.iter().all(|v| v.is_finite()) || v.iter().all(|v| v.is_nan());
            if !is_measured(&s.gyro_rad_s) || !is_measured(&s.accel_m_s2) {
                return Err(wrong(format!("sample {} is not a measurement: {s:?}", s.sequence)));
            }
            last = Some((batch.meta.clock_epoch, *s));
            first.get_or_insert(s.sequence);
            count += 1;
        }
        let m = &batch.meta;
        let stated = (m.device_sequence, m.device_time, m.capture_time);
        if stated != (newest.sequence, newest.device_time, newest.time()) {
            return Err(wrong(format!("its header says {stated:?}, its newest sample is {newest:?}")));
        }
        if m.capture_uncertainty_ns < u64::from(newest.uncertainty_ns) {
            return Err(wrong("its header claims more than its newest sample".to_owned()));
        }
        // No sample waits for longer than a batch may, but for what a busy machine takes to poll.
        let span_ns = newest.time_ns - oldest.time_ns;
        if span_ns > LONGEST.as_nanos() as i64 + POLL.as_nanos() as i64 {
            return Err(wrong(format!("its oldest sample is {span_ns} ns older than its newest")));
        }
    }
    // By the samples' own clock, so that a busy machine changes nothing.
    let (Some(begin), Some((_, end))) =
        (batches.first().and_then(|b| MotionSample::all_in(&b.pixels).next()), last)
    else {
        return fail("no samples arrived");
    };
    let numbers = end.sequence - first.unwrap_or_default() + 1;
    check(count <= numbers, || format!("{count} samples with {numbers} numbers"))?;
    let passed_s = end.device_time.saturating_sub(begin.device_time) as f64 * unit.clock.tick_ns() / 1e9;
    let expected = passed_s * unit.samples_hz() + 1.0;
    check((numbers as f64 - expected).abs() <= 2.0 + expected * 0.05, || {
        format!(
            "{numbers} numbers in {passed_s:.3} s of the unit's clock; at its rate they are {expected:.0}"
        )
    })
}
