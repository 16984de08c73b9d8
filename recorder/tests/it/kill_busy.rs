//! A live recording of four 720p cameras, killed beside two busy loops: a set that is neither in the file nor counted
//! as dropped is younger than a second.
//!
//! `DEPTHRIG_LONG=1 cargo test -p depthrig-recorder --test it kill_busy -- --nocapture` kills 200 times instead of 4
//! and prints how the losses are spread. `DEPTHRIG_BUSY_LOOPS` sets how many loops run beside it, `DEPTHRIG_KILLS` the
//! number of kills and `DEPTHRIG_FIRST_KILL` the number of the first (each has a moment of its own).

use crate::support::stream;
use core::ops::ControlFlow;
use core::time::Duration;
use depthrig_bus::{FrameHeader, HostTime, PixelFormat, UtcPair};
use depthrig_recorder::fs::RealFs;
use depthrig_recorder::{
    Dataset, LIVE_LATE_NS, PixelMode, RecordFrame, RecordSet, Recorder, RecorderOptions, RecoverOptions,
    Session, SetRange, recover,
};
use std::collections::BTreeSet;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// Where the child records; without it the child's test does nothing.
const DIR: &str = "DEPTHRIG_TEST_KILL_BUSY_DIR";
/// Records without a limit to the age of a set: how the test fails without one.
const NEVER_LATE: &str = "DEPTHRIG_TEST_NEVER_LATE";
const CAMERAS: usize = 4;
const WIDTH: u32 = 1280;
const HEIGHT: u32 = 720;
const PERIOD_NS: i64 = 200_000_000;
/// The guarantee: the most that a kill may lose without a trace.
const LOSS_MAX_NS: i64 = 1_000_000_000;

fn session() -> Session {
    let mut session = Session::new("killed", "rig");
    for camera in 0..CAMERAS {
        let color = format!("cam{camera}/color");
        let depth = format!("cam{camera}/depth");
        session.streams.push(stream(&color, PixelFormat::Rgb8, WIDTH, HEIGHT));
        session.streams.push(stream(&depth, PixelFormat::Z16, WIDTH, HEIGHT));
    }
    session
}

/// An image with gradients and noise, about as hard to pack as that of a camera.
fn image(format: PixelFormat, seed: u32) -> Arc<[u8]> {
    let mut state = seed | 1;
    let mut noise = move || {
        state ^= state << 13;
        state ^= state >> 17;
        state ^= state << 5;
        state
    };
    let mut bytes = Vec::with_capacity(format.frame_bytes(WIDTH, HEIGHT));
    for y in 0..HEIGHT {
        for x in 0..WIDTH {
            if format == PixelFormat::Z16 {
                let mm = if noise() % 23 == 0 { 0 } else { 600 + (x / 4 + y / 3 + noise() % 3) as u16 };
                bytes.extend(mm.to_le_bytes());
            } else {
                let grain = noise() % 8;
                bytes.extend([x / 5 + grain, y / 3 + grain, (x + y) / 8 + grain].map(|v| v as u8));
            }
        }
    }
    bytes.into()
}

/// Shared memory would want its slot back, so that the pixels may not wait.
struct Lent(Arc<[u8]>);

impl depthrig_recorder::Pixels for Lent {
    fn bytes(&self) -> &[u8] {
        &self.0
    }
}

/// Not a test of its own: the child that the test below starts and kills. It prints when the first set was due, and every
/// few milliseconds the time.
#[test]
fn child() {
    let Some(dir) = std::env::var_os(DIR).map(PathBuf::from) else { return };
    let session = session();
    let images: Vec<Arc<[u8]>> =
        session.streams.iter().enumerate().map(|(i, s)| image(s.format, 7 + i as u32)).collect();
    let options = RecorderOptions {
        workers: 2,
        min_free_bytes: 0,
        reserve_bytes: 0,
        late_after_ns: std::env::var_os(NEVER_LATE).is_none().then_some(LIVE_LATE_NS),
        ..RecorderOptions::default()
    };
    let recorder = Recorder::create(Arc::new(RealFs), &dir, session.clone(), options).unwrap();
    let begin = HostTime::now().plus_ns(PERIOD_NS);
    println!("\nbegin {}", begin.ns());
    std::thread::spawn(|| {
        loop {
            println!("tick {}", HostTime::now().ns());
            std::thread::sleep(Duration::from_millis(5));
        }
    });
    // Far more than it records before the kill, and an end if the kill never comes.
    for n in 0..300u64 {
        let tick = begin.plus_ns(n as i64 * PERIOD_NS);
        std::thread::sleep(tick.from_now());
        let frames = session.streams.iter().zip(&images).enumerate().map(|(stream, (record, image))| {
            let mut header = FrameHeader::default();
            header.set_names("rig", &record.id);
            header.set_image(record.format, WIDTH, HEIGHT);
            header.sequence = n + 1;
            header.captured = n + 1;
            header.capture_time_ns = tick.ns();
            header.depth_unit_m = record.depth_unit_m;
            RecordFrame { stream, header, pixels: Box::new(Lent(Arc::clone(image))) }
        });
        let set = RecordSet {
            id: n + 1,
            tick,
            utc: UtcPair::sample(),
            frames: frames.collect(),
            missing: Vec::new(),
            motion: Vec::new(),
            signals: Vec::new(),
            spread_ns: 0,
        };
        // A refused set is counted, and the count must be in the file.
        drop(recorder.push(set));
    }
}

/// A child that does not outlive the test.
struct Killed(Child);

impl Drop for Killed {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// The dataset that a kill left.
struct Left {
    /// How old the oldest set was that is neither there nor counted.
    lost_ns: i64,
    /// The longest pause between the times that the child printed in the two seconds before the kill.
    paused_ns: i64,
    recorded: u64,
    dropped: u64,
}

fn run(n: u64) -> Left {
    let parent = tempfile::tempdir().unwrap();
    let dir = parent.path().join("killed");
    let mut child = Killed(
        Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "kill_busy::child", "--nocapture"])
            .env(DIR, &dir)
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .unwrap(),
    );
    let stdout = child.0.stdout.take().unwrap();
    let mut lines = BufReader::new(stdout).lines().map_while(Result::ok);
    let ns = |line: String, what: &str| line.strip_prefix(what)?.parse::<i64>().ok();
    let begin = lines.find_map(|line| ns(line, "begin ")).expect("the child begins");
    // Knuth's multiplicative hash: the moments are spread evenly, and a run can be done again.
    let random = n.wrapping_mul(2_654_435_761) % (1 << 32);
    std::thread::sleep(Duration::from_millis(1_500 + random % 2_000));
    let killed = HostTime::now().ns();
    drop(child);
    let ticks: Vec<i64> = lines.filter_map(|line| ns(line, "tick ")).chain([killed]).collect();
    // A pause of the computer delays the account of a loss as well.
    let late = ticks.windows(2).filter(|w| w[1] > killed - 2_000_000_000).map(|w| w[1] - w[0]);
    Left { paused_ns: late.max().unwrap_or(0), ..account(n, &dir, begin, killed) }
}

/// Every set that was due before the kill is in the file, or one of those that were dropped and counted, or younger
/// than what is returned. Counted sets are taken to be the oldest of those that are not there.
fn account(n: u64, dir: &Path, begin: i64, killed: i64) -> Left {
    let recovered = recover(dir, &RecoverOptions::default(), &mut |_| ControlFlow::Continue(()));
    let report = recovered.unwrap_or_else(|e| panic!("run {n}: {e}"));
    let mut there = BTreeSet::new();
    let dataset = Dataset::open(dir).unwrap();
    for set in dataset.sets_with(SetRange::ALL, PixelMode::None) {
        there.insert(set.unwrap_or_else(|e| panic!("run {n}: {e}")).id);
    }
    assert_eq!(report.sets, there.len() as u64, "run {n}");
    let outcome = dataset.session().outcome.clone().unwrap();
    let dropped: u64 = outcome.sets_dropped.values().sum();
    assert_eq!(outcome.sets_offered, outcome.sets_recorded + dropped, "run {n}: {outcome:?}");
    let due = (killed - begin) / PERIOD_NS + 1;
    let missing = (1..=due as u64).filter(|id| !there.contains(id)).map(|id| (id as i64 - 1) * PERIOD_NS);
    let lost_ns = missing.skip(dropped as usize).map(|after| killed - (begin + after)).next();
    Left { lost_ns: lost_ns.unwrap_or(0), paused_ns: 0, recorded: report.sets, dropped }
}

/// Keeps the computer busy until dropped.
struct Busy {
    stop: Arc<AtomicBool>,
    loops: Vec<std::thread::JoinHandle<()>>,
}

impl Busy {
    fn new(loops: u64) -> Self {
        let stop = Arc::new(AtomicBool::new(false));
        let spin = |_| {
            let stop = Arc::clone(&stop);
            std::thread::spawn(move || {
                while !stop.load(Ordering::Relaxed) {
                    std::hint::spin_loop();
                }
            })
        };
        let loops = (0..loops).map(spin).collect();
        Self { stop, loops }
    }
}

impl Drop for Busy {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        for thread in self.loops.drain(..) {
            let _ = thread.join();
        }
    }
}

#[test]
fn what_a_kill_takes_unseen_on_a_busy_computer_is_younger_than_a_second() {
    let number = |name: &str| std::env::var(name).ok().and_then(|n| n.parse::<u64>().ok());
    let first = number("DEPTHRIG_FIRST_KILL").unwrap_or(0);
    let usual = if std::env::var_os("DEPTHRIG_LONG").is_some() { 200 } else { 4 };
    let runs = number("DEPTHRIG_KILLS").unwrap_or(usual);
    let loops = number("DEPTHRIG_BUSY_LOOPS").unwrap_or(2);
    let _busy = Busy::new(loops);
    let left: Vec<Left> = (first..first + runs).map(run).collect();
    let mut lost: Vec<i64> = left.iter().map(|l| l.lost_ns).collect();
    lost.sort_unstable();
    let at = |quantile: f64| lost[((lost.len() - 1) as f64 * quantile) as usize] as f64 * 1e-9;
    let recorded: u64 = left.iter().map(|l| l.recorded).sum();
    let dropped: u64 = left.iter().map(|l| l.dropped).sum();
    println!(
        "{runs} kills beside {loops} busy loops: lost beyond what is counted p50 {:.3} s, p95 {:.3} s, most {:.3} s; {recorded} \
         sets recorded, {dropped} dropped and counted",
        at(0.5),
        at(0.95),
        at(1.0)
    );
    assert!(recorded > 0, "no set is in any of the files");
    assert!(left.iter().all(|l| l.lost_ns <= LOSS_MAX_NS + l.paused_ns), "nanoseconds lost: {lost:?}");
}
