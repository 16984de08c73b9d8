//! A process killed while it records, on the real file system, at random moments.
//!
//! `DEPTHRIG_LONG=1 cargo test -p depthrig-recorder --test it kill` does it 2000 times instead of 50.

use crate::support::*;
use core::ops::ControlFlow;
use depthrig_bus::{FrameHeader, HostTime, MotionSample};
use depthrig_recorder::fs::RealFs;
use depthrig_recorder::{
    Dataset, DatasetSet, PixelMode, RecordFrame, RecordMotion, Recorder, RecorderOptions, RecoverOptions,
    SetRange, recover,
};
use std::collections::BTreeSet;
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

/// Where the child records; without it the child's test does nothing.
const DIR: &str = "DEPTHRIG_TEST_KILL_DIR";
/// Milliseconds from set to set; 0: as soon as the one before is written.
const EVERY_MS: &str = "DEPTHRIG_TEST_KILL_EVERY_MS";
/// The guarantee: the most that a kill may lose.
const LOSS_MAX_NS: i64 = 1_000_000_000;

/// Not a test of its own: the child that the test below starts and kills. It prints when each set was handed over, and
/// each that is written.
#[test]
fn child() {
    let Some(dir) = std::env::var_os(DIR).map(PathBuf::from) else { return };
    let every: u64 = std::env::var(EVERY_MS).unwrap().parse().unwrap();
    let limits = RecorderOptions {
        segment_max_ns: 20 * PERIOD,
        sync_interval_ns: 100_000_000,
        reserve_bytes: 10_000,
        ..options()
    };
    let r = Recorder::create(Arc::new(RealFs), &dir, session(), limits).unwrap();
    let mut out = std::io::stdout().lock();
    writeln!(out).unwrap();
    // Far more than it records before the kill, and an end if the kill never comes.
    for n in 0..3_000 {
        r.push(set(&session(), n)).unwrap();
        writeln!(out, "pushed {} {}", n + 1, HostTime::now().ns()).unwrap();
        if every == 0 {
            settle(&r);
            writeln!(out, "written {}", n + 1).unwrap();
        } else {
            std::thread::sleep(Duration::from_millis(every));
        }
        out.flush().unwrap();
    }
}

/// The output of a child until it was killed.
#[derive(Default)]
struct ChildOutput {
    pushed: Vec<(u64, i64)>,
    written: u64,
    killed_ns: i64,
}

fn record_and_kill(dir: &Path, every_ms: u64, after: Duration) -> ChildOutput {
    let mut child = Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "kill::child", "--nocapture"])
        .env(DIR, dir)
        .env(EVERY_MS, every_ms.to_string())
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let stdout = child.stdout.take().unwrap();
    let reader = std::thread::spawn(move || {
        let mut said = ChildOutput::default();
        for line in BufReader::new(stdout).lines() {
            let Ok(line) = line else { break };
            let mut words = line.split(' ');
            match (words.next(), words.next().and_then(|n| n.parse().ok()), words.next()) {
                (Some("pushed"), Some(n), Some(t)) => {
                    // The last line may be cut.
                    let Ok(t) = t.parse() else { continue };
                    said.pushed.push((n, t));
                }
                (Some("written"), Some(n), None) => said.written = n,
                _ => {}
            }
        }
        said
    });
    std::thread::sleep(after);
    let killed_ns = HostTime::now().ns();
    child.kill().unwrap();
    child.wait().unwrap();
    ChildOutput { killed_ns, ..reader.join().unwrap() }
}

/// Messages of the commit mark's topic, by the index and by the stream of the `mcap` crate.
fn sets_of_the_mcap_crate(dir: &Path) -> u64 {
    let mut sets = 0;
    for entry in std::fs::read_dir(dir).unwrap().map(Result::unwrap) {
        if !entry.file_name().to_string_lossy().starts_with("seg_") {
            continue;
        }
        let bytes = std::fs::read(entry.path()).unwrap();
        let summary = mcap::Summary::read(&bytes).unwrap().expect("a summary");
        let messages: Vec<_> = mcap::MessageStream::new(&bytes).unwrap().map(Result::unwrap).collect();
        assert_eq!(summary.stats.unwrap().message_count, messages.len() as u64);
        sets += messages.iter().filter(|m| m.channel.topic.ends_with("/frame_set")).count() as u64;
    }
    sets
}

/// The Python that is to read the files as well. The repository's `.venv` is made with `mcap`, so that one must be
/// able to; without it the system's does, where that has the package.
fn python_with_mcap() -> Option<PathBuf> {
    let venv = Path::new(env!("CARGO_MANIFEST_DIR")).join("../.venv");
    if venv.exists() {
        return Some(venv.join("bin/python"));
    }
    let python = PathBuf::from("python3");
    let has_mcap = Command::new(&python).args(["-c", "import mcap.reader"]).output();
    has_mcap.is_ok_and(|out| out.status.success()).then_some(python)
}

/// The same by Python's `mcap`. A file that it cannot read is a failure.
fn sets_of_python(python: &Path, dir: &Path) -> u64 {
    let program = "import sys, glob\nfrom mcap.reader import make_reader\nn = 0\n\
                   for name in sorted(glob.glob(sys.argv[1] + '/seg_*.mcap')):\n    \
                   with open(name, 'rb') as f:\n        \
                   n += sum(1 for _, c, _ in make_reader(f, validate_crcs=True).iter_messages() \
                   if c.topic.endswith('/frame_set'))\nprint(n)\n";
    let out = Command::new(python).args(["-c", program]).arg(dir).output();
    let out = out.unwrap_or_else(|e| panic!("{} does not run: {e}", python.display()));
    let errors = String::from_utf8_lossy(&out.stderr);
    assert!(out.status.success(), "Python's mcap cannot read {}: {errors}", dir.display());
    String::from_utf8_lossy(&out.stdout).trim().parse().unwrap()
}

/// Whether a header came back as it was handed over, with the number of its set filled in.
fn same_header(got: &FrameHeader, handed_over: &FrameHeader, set_id: u64) -> bool {
    // NaN where nothing was measured, which equals nothing.
    let clean = |h: &FrameHeader| FrameHeader { temperature_c: 0.0, ..*h };
    clean(got) == FrameHeader { set_id, ..clean(handed_over) }
        && got.temperature_c.to_bits() == handed_over.temperature_c.to_bits()
}

/// The JPEG that the recorder makes of a colour image: the same bytes each time.
fn jpeg(frame: &RecordFrame) -> Vec<u8> {
    let mut out = Vec::new();
    let mut encoder = jpeg_encoder::Encoder::new(&mut out, options().jpeg_quality);
    encoder.set_sampling_factor(jpeg_encoder::SamplingFactor::R_4_4_4);
    let width = frame.header.width as u16;
    let height = frame.header.height as u16;
    encoder.encode(frame.pixels.bytes(), width, height, jpeg_encoder::ColorType::Rgb).unwrap();
    out
}

/// Everything in a set must be what was handed over under its number.
fn check_set(n: u64, got: &DatasetSet) {
    let want = set(&session(), got.id - 1);
    assert_eq!(got.frames.len(), want.frames.len(), "run {n}: frames of set {}", got.id);
    for (frame, want) in got.frames.iter().zip(&want.frames) {
        let what = format!("run {n}: stream {} of set {}", want.stream, got.id);
        assert_eq!(frame.stream, want.stream, "{what}");
        assert!(same_header(&frame.header, &want.header, got.id), "{what} has another header");
        let pixels = want.pixels.bytes();
        match &frame.stored {
            Some(stored) if frame.codec == "jpeg" => {
                assert!(*stored == jpeg(want), "{what} is another image");
                assert_eq!(frame.pixels.len(), pixels.len(), "{what} is decoded to another size");
            }
            _ => assert!(frame.pixels == pixels, "{what} is another image"),
        }
    }
    // As bytes: samples have fields that are NaN.
    let bytes = |m: &RecordMotion| m.samples.iter().flat_map(MotionSample::to_bytes).collect::<Vec<_>>();
    let same = |(got_one, want): (&RecordMotion, &RecordMotion)| {
        got_one.unit == want.unit
            && same_header(&got_one.header, &want.header, got.id)
            && bytes(got_one) == bytes(want)
    };
    let all = got.motion.len() == want.motion.len() && got.motion.iter().zip(&want.motion).all(same);
    assert!(all, "run {n}: the motion of set {} is another one", got.id);
}

/// One run; how long before the kill the oldest set was handed over that is not there, seconds.
fn run(n: u64) -> f64 {
    let parent = tempfile::tempdir().unwrap();
    let dir = parent.path().join("killed");
    // Knuth's multiplicative hash: the moments are spread evenly, and a run can be done again.
    let random = n.wrapping_mul(2_654_435_761) % (1 << 32);
    // Every third lives longer than the guarantee; of the others each set printed as written must be there.
    let (every, after) = match n % 3 {
        0 => (10, 1_100 + random % 500),
        _ => (0, 30 + random % 400),
    };
    let said = record_and_kill(&dir, every, Duration::from_millis(after));
    if !dir.join("session.toml").exists() {
        assert!(said.pushed.is_empty(), "run {n}");
        return 0.0;
    }
    let report = match recover(&dir, &RecoverOptions::default(), &mut |_| ControlFlow::Continue(())) {
        Ok(report) => report,
        Err(e) => panic!("run {n}: {e}"),
    };
    let mut there = BTreeSet::new();
    for s in Dataset::open(&dir).unwrap().sets_with(SetRange::ALL, PixelMode::DecodedAndStored) {
        let s = s.unwrap_or_else(|e| panic!("run {n}: {e}"));
        check_set(n, &s);
        there.insert(s.id);
    }
    assert_eq!(report.sets, there.len() as u64, "run {n}");
    assert!(
        (1..=said.written).all(|id| there.contains(&id)),
        "run {n}: {there:?} of {} written",
        said.written
    );
    let lost =
        said.pushed.iter().filter(|(id, _)| !there.contains(id)).map(|(_, t)| said.killed_ns - t).max();
    let lost = lost.unwrap_or(0);
    assert!(lost <= LOSS_MAX_NS, "run {n}: a set that was handed over {lost} ns before the kill is lost");
    assert_eq!(sets_of_the_mcap_crate(&dir), report.sets, "run {n}");
    if n < 3
        && let Some(python) = python_with_mcap()
    {
        assert_eq!(sets_of_python(&python, &dir), report.sets, "run {n}");
    }
    let again = recover(&dir, &RecoverOptions::default(), &mut |_| ControlFlow::Continue(())).unwrap();
    assert!(!again.changed && again.lost.is_empty(), "run {n}: {again:?}");
    lost as f64 * 1e-9
}

#[test]
fn a_process_killed_at_any_moment_loses_a_second_at_most() {
    let runs = if std::env::var_os("DEPTHRIG_LONG").is_some() { 2000 } else { 50 };
    let next = AtomicU64::new(0);
    let worker = || {
        let mut most = 0f64;
        loop {
            let n = next.fetch_add(1, Ordering::Relaxed);
            if n >= runs {
                return most;
            }
            most = most.max(run(n));
        }
    };
    let most = std::thread::scope(|s| {
        let workers: Vec<_> = (0..6).map(|_| s.spawn(worker)).collect();
        workers.into_iter().map(|w| w.join().unwrap()).fold(0.0, f64::max)
    });
    println!("{runs} runs; the oldest set lost was handed over {most:.3} s before the kill");
}
