//! Readers that hold every slot of a stream and are killed: the stream is back each time, and as fast as before.
//!
//! Run with `DEPTHRIG_LONG=1` for a thousand kills and the bars of docs/reliability.md.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use depthrig_bus::{Bus, ErrorKind, Frame, HostTime, PixelFormat, Publisher, RigName, RuntimeDir, StreamId};
use std::io::{BufRead, BufReader};
use std::process::{Child, ChildStdout, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

const LEN: usize = 64 * 48 * 2;
const WAIT: Duration = Duration::from_secs(20);
/// As often as the daemon looks, and at least once a second.
const LOOK: Duration = Duration::from_millis(50);
const CLEAN_AGAIN: Duration = Duration::from_millis(200);
const CLEAN: Duration = Duration::from_secs(1);
/// Publishes that are timed before and after the kills of a round.
const TIMED: usize = 200;

fn rig() -> RigName {
    RigName::new("test").unwrap()
}

fn stream() -> StreamId {
    StreamId::new("cam", "depth").unwrap()
}

/// Not a test by itself: a process that holds all the frames that it gets.
#[test]
fn helper_process() {
    let Ok(dir) = std::env::var("DEPTHRIG_BUS_TEST_DIR") else { return };
    let bus = Bus::open(&RuntimeDir::at(dir.as_ref()).unwrap(), &rig()).unwrap();
    let mut subscriber = bus.subscriber_within(&stream(), WAIT).unwrap();
    let mut held = Vec::new();
    let mut said = false;
    loop {
        match subscriber.next_timeout(WAIT) {
            Ok(frame) => held.extend(frame),
            Err(e) if e.kind() == ErrorKind::LimitReached => {
                if !std::mem::replace(&mut said, true) {
                    println!("holding");
                }
                std::thread::sleep(LOOK);
            }
            Err(e) => panic!("{e}"),
        }
    }
}

struct Reader(Child);

impl Reader {
    /// Starts one and publishes until it holds all that it may, or no slot is free.
    fn start(dir: &std::path::Path, source: &mut Source) -> Self {
        let mut child = Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "helper_process", "--nocapture"])
            .env("DEPTHRIG_BUS_TEST_DIR", dir)
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let out = child.stdout.take().unwrap();
        let reader = Self(child);
        // Readers that read at once hold the same frames, and so the same slots: one after the other.
        let holding = std::thread::spawn(move || Self::holds(out));
        while !holding.is_finished() && source.publish().is_some() {
            std::thread::sleep(Duration::from_millis(2));
        }
        reader
    }

    /// Returns when the reader holds all that it may, or has ended.
    fn holds(out: ChildStdout) {
        drop(BufReader::new(out).lines().find(|line| line.as_ref().is_ok_and(|l| l.contains("holding"))));
    }
}

impl Drop for Reader {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// The publishing end, with what was measured.
struct Source {
    publisher: Publisher,
    sequence: u64,
}

impl Source {
    /// Publishes one frame; how long that took, or `None` without a free slot.
    fn publish(&mut self) -> Option<i64> {
        let began = HostTime::now();
        let mut frame = match self.publisher.loan(LEN) {
            Ok(frame) => frame,
            Err(e) => {
                assert_eq!(e.kind(), ErrorKind::NoSpace, "{e}");
                return None;
            }
        };
        self.sequence += 1;
        frame.pixels_mut().fill(self.sequence as u8);
        frame.header_mut().set_image(PixelFormat::Z16, 64, 48);
        frame.header_mut().sequence = self.sequence;
        self.publisher.send(frame).unwrap();
        Some(HostTime::now().since_ns(began))
    }

    fn timed(&mut self, into: &mut Vec<i64>) {
        for _ in 0..TIMED {
            into.extend(self.publish());
            std::thread::sleep(Duration::from_micros(200));
        }
    }

    /// Publishes until the readers hold every slot.
    fn starve(&mut self) {
        let deadline = HostTime::now().plus(WAIT);
        while self.publish().is_some() {
            assert!(!deadline.from_now().is_zero(), "the readers never held every slot");
            std::thread::sleep(Duration::from_millis(2));
        }
    }

    /// How long it takes until a frame can be published again.
    fn recover(&mut self) -> Duration {
        let began = HostTime::now();
        while self.publish().is_none() {
            assert!(began.elapsed() < WAIT, "the stream never came back");
            std::thread::sleep(Duration::from_millis(2));
        }
        began.elapsed()
    }
}

fn whole(frame: &Frame) -> bool {
    frame.pixels().iter().all(|b| *b == frame.header().sequence as u8)
}

fn quantile(times: &mut [i64], q: f64) -> i64 {
    times.sort_unstable();
    times[((times.len() - 1) as f64 * q) as usize]
}

const ORDERS: [[usize; 3]; 6] = [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]];

#[test]
fn killed_readers_that_held_every_slot_give_them_back() {
    let long = std::env::var_os("DEPTHRIG_LONG").is_some();
    let kills_wanted = if long { 1000 } else { 24 };
    let tmp = tempfile::tempdir().unwrap();
    let bus = Bus::open(&RuntimeDir::at(tmp.path()).unwrap(), &rig()).unwrap();
    let over = AtomicBool::new(false);
    let mut kills = 0;
    let mut starved = 0;
    let mut worst = Duration::ZERO;
    let mut before = Vec::new();
    let mut after = Vec::new();
    std::thread::scope(|scope| {
        scope.spawn(|| {
            let mut last = HostTime::now();
            while !over.load(Ordering::Relaxed) {
                std::thread::sleep(LOOK);
                if last.elapsed() >= CLEAN || last.elapsed() >= CLEAN_AGAIN && bus.starved() {
                    bus.clean_dead();
                    last = HostTime::now();
                }
            }
        });
        let _over = Over(&over);
        for round in 0.. {
            if kills >= kills_wanted {
                break;
            }
            // One reader holds all of 16 slots; of 48 slots three readers and this process hold all.
            let single = round % 3 == 2;
            let slots = if single { 16 } else { 48 };
            let mut source = Source { publisher: bus.publisher(&stream(), LEN, slots).unwrap(), sequence: 0 };
            let mut own = bus.subscriber(&stream()).unwrap();
            let mut held = Vec::new();
            while held.len() < if single { 3 } else { 8 } {
                source.publish();
                held.extend(own.try_next().unwrap());
            }
            source.timed(&mut before);
            let count = if single { 1 } else { 3 };
            let mut readers: Vec<_> =
                (0..count).map(|_| Some(Reader::start(tmp.path(), &mut source))).collect();
            // After the first kill those that are left may not hold enough any more.
            source.starve();
            starved += 1;
            for at in ORDERS[round % ORDERS.len()] {
                if at >= readers.len() {
                    continue;
                }
                drop(readers[at].take());
                kills += 1;
                worst = worst.max(source.recover());
            }
            source.timed(&mut after);
            assert!(held.iter().all(whole), "a frame that was held all the time was overwritten");
        }
    });
    let slower = quantile(&mut after, 0.99) as f64 / quantile(&mut before, 0.99) as f64;
    println!(
        "{kills} kills in {starved} rounds, each with every slot held at first; back after at most {worst:?}; p99 of publishing {} us before and \
         {} us after ({slower:.2})",
        quantile(&mut before, 0.99) / 1000,
        quantile(&mut after, 0.99) / 1000
    );
    if long {
        assert!(worst < Duration::from_secs(1), "{worst:?}");
        assert!(slower < 1.1, "{slower}");
    }
    bus.clean_dead();
    let nodes = std::fs::read_dir(tmp.path().join("iox2/nodes")).unwrap().count();
    assert!(nodes <= 4, "{nodes} entries are left of killed processes");
}

/// Ends the thread that cleans up, also when the test fails.
struct Over<'a>(&'a AtomicBool);

impl Drop for Over<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}
