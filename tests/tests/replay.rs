//! Replay as a test bench for its readers: the same bytes each time, nothing missed, and working controls. Long because
//! all tests share the setup of a rig, its recording and two readers.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use core::ops::ControlFlow;
use depthrig_bus::{Bus, FrameFlags, FrameHeader, HostTime, RigName, SetSubscriber, StreamId, Subscriber};
use depthrig_calib::stereo::Preset;
use depthrig_convert::zed_replay::{ZedReplayOptions, zed_replay};
use depthrig_daemon::ErrorKind;
use depthrig_daemon::client::Client;
use depthrig_daemon::config::Port;
use depthrig_daemon::control::{Control, RecordRequest, ReplayControl, SeekRequest};
use depthrig_daemon::replay::{Replay, ReplayOptions};
use depthrig_daemon::status::CameraState;
use depthrig_recorder::{
    ColorCodec, CompareOptions, Dataset, DepthCodec, PixelCheck, PixelMode, SetRange, Severity,
    VerifyOptions, compare, verify,
};
use depthrig_stereo::Mode;
use depthrig_tests::Home;
use depthrig_tests::disk::Tmpfs;
use depthrig_tests::fixture::{Fixture, SECOND};
use depthrig_tests::synthetic_stereo::SyntheticStereo;
use std::fmt::Write;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

/// Nothing comes any more when nothing came for so long after the end.
const SILENCE: Duration = Duration::from_millis(150);
/// For what would otherwise hang.
const TIMEOUT: Duration = Duration::from_secs(20);
const FAST: ReplayOptions = ReplayOptions {
    by_utc: true,
    in_background: false,
    rate: 1.0,
    looped: false,
    from_s: None,
    to_s: None,
    as_fast_as_possible: true,
    paused: true,
    hold: false,
    refine: None,
    foxglove: Port::Off,
    serve_api: false,
};

/// A dataset at `home`/`name`.
fn write_dataset(home: &Home, name: &str, fixture: &Fixture) -> PathBuf {
    let path = home.path(name);
    fixture.record(&path);
    path
}

fn start(home: &Home, datasets: &[PathBuf], options: ReplayOptions) -> Replay {
    Replay::start(datasets, &home.runtime(), None, options).unwrap()
}

fn refused(home: &Home, datasets: &[PathBuf], options: ReplayOptions) -> depthrig_daemon::Error {
    match Replay::start(datasets, &home.runtime(), None, options) {
        Ok(_) => panic!("it started"),
        Err(e) => e,
    }
}

/// Everything that a subscriber can see of a header, with every field: one that is added must be added here.
fn whole(h: &FrameHeader) -> String {
    let FrameHeader {
        magic,
        version,
        size,
        sequence,
        device_sequence,
        set_id,
        device_time,
        device_tick_ns,
        capture_time_ns,
        capture_uncertainty_ns,
        arrival_time_ns,
        publish_time_ns,
        exposure_ns,
        captured,
        dropped,
        source_sequence,
        depth_unit_m,
        intrinsics,
        pose,
        clock_domain,
        clock_epoch,
        flags,
        format,
        width,
        height,
        stride,
        payload_len,
        gain,
        temperature_c,
        rig,
        camera,
        stream,
        model,
        serial,
        source_color_sequence,
        source_color_capture_time_ns,
        stage_ns,
        refiner,
        refiner_model,
        latency_ns,
        reserved,
    } = *h;
    let names = (rig, camera, stream, model, serial, refiner, refiner_model, reserved);
    let made = (source_color_sequence, source_color_capture_time_ns, stage_ns);
    let image = (flags, format, width, height, stride, payload_len, gain, temperature_c.to_bits());
    let times =
        (capture_time_ns, capture_uncertainty_ns, arrival_time_ns, publish_time_ns, exposure_ns, latency_ns);
    let device = (sequence, device_sequence, set_id, device_time, device_tick_ns, captured, dropped);
    let geometry = (depth_unit_m, intrinsics, pose, clock_domain, clock_epoch, source_sequence);
    format!("{magic:?}{version}{size}{names:?}{image:?}{times:?}{device:?}{geometry:?}{made:?}")
}

/// A reader of every channel of a rig.
struct Bench {
    streams: Vec<(StreamId, Subscriber)>,
    sets: SetSubscriber,
    /// Items read from each channel, in order; the sets last.
    seen: Vec<Vec<String>>,
    /// Capture times of the first stream.
    first: Vec<i64>,
    /// When each set came, with its tick, how many members it has, and its number.
    ticks: Vec<(HostTime, i64, u32, u64)>,
}

impl Bench {
    fn new(home: &Home, rig: &str, streams: Vec<StreamId>) -> Self {
        let bus = Bus::open(&home.runtime(), &RigName::new(rig).unwrap()).unwrap();
        let sets = bus.set_subscriber().unwrap();
        let streams: Vec<_> =
            streams.into_iter().map(|id| (id.clone(), bus.subscriber(&id).unwrap())).collect();
        Self {
            seen: vec![Vec::new(); streams.len() + 1],
            streams,
            sets,
            first: Vec::new(),
            ticks: Vec::new(),
        }
    }

    /// Reads all available items; `slow` sleeps for a while at every n-th frame.
    fn pump(&mut self, slow: Option<u64>) -> usize {
        let mut came = 0;
        for (i, (_, subscriber)) in self.streams.iter_mut().enumerate() {
            while let Some(frame) = subscriber.try_next().unwrap() {
                came += 1;
                if i == 0 {
                    self.first.push(frame.header().capture_time_ns);
                }
                self.seen[i].push(format!("{}{:?}", whole(frame.header()), frame.pixels()));
                if slow.is_some_and(|n| frame.header().sequence % n == 0) {
                    std::thread::sleep(Duration::from_millis(40));
                }
            }
        }
        while let Some(set) = self.sets.next_timeout(Duration::ZERO).unwrap() {
            came += 1;
            let h = set.header();
            self.ticks.push((HostTime::now(), h.tick_ns, h.present, h.set_id));
            self.seen[self.streams.len()].push(format!("{h:?}{:?}", set.members().unwrap()));
        }
        came
    }

    /// Reads until the replay is done and nothing comes any more.
    fn read_all(&mut self, replay: &Replay, slow: Option<u64>) {
        let deadline = HostTime::now().plus(TIMEOUT);
        let mut last = HostTime::now();
        loop {
            if self.pump(slow) > 0 || !replay.progress().done {
                last = HostTime::now();
            }
            if last.elapsed() > SILENCE {
                return;
            }
            assert!(
                !deadline.from_now().is_zero(),
                "the replay does not end: {:?}; read {:?}",
                replay.progress(),
                self.seen.iter().map(Vec::len).collect::<Vec<_>>()
            );
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    /// Reads until `n` sets were seen.
    fn read_sets(&mut self, n: usize) {
        let deadline = HostTime::now().plus(TIMEOUT);
        while self.ticks.len() < n {
            self.pump(None);
            assert!(!deadline.from_now().is_zero(), "{} of {n} sets came", self.ticks.len());
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    /// Reads what comes in a while in which nothing may come.
    fn read_nothing(&mut self) {
        std::thread::sleep(SILENCE);
        assert_eq!(self.pump(None), 0, "something came");
    }
}

fn steer<T>(replay: &Replay, what: impl FnOnce(&dyn ReplayControl) -> T) -> T {
    let control: Arc<dyn Control> = replay.control();
    what(control.replay().unwrap())
}

fn resume(replay: &Replay) {
    steer(replay, |r| r.resume()).unwrap();
}

#[test]
fn two_runs_give_a_subscriber_the_same_bytes_and_a_slow_one_misses_nothing() {
    let home = Home::default();
    let dataset = Fixture { sets: 40, ..Fixture::default() };
    let path = write_dataset(&home, "a", &dataset);
    let run = |slow| {
        let replay = start(&home, std::slice::from_ref(&path), FAST);
        let mut bench = Bench::new(&home, "bench", dataset.streams());
        bench.read_nothing();
        resume(&replay);
        bench.read_all(&replay, slow);
        let status = replay.stop().status;
        assert_eq!((status.sets, status.frames, status.lost.len()), (40, 160, 0));
        assert!(bench.streams.iter().all(|(_, s)| s.missed() == 0));
        // Without its subscribers: the next run would wait for them.
        (bench.seen, bench.first)
    };
    let (first, captured) = run(None);
    for channel in &first {
        assert_eq!(channel.len(), 40, "a frame or set was missed");
    }
    assert_eq!(captured, (0..40).map(|n| dataset.tick(n).ns()).collect::<Vec<_>>());
    let (second, _) = run(Some(7));
    assert!(first == second, "two runs differ");
}

#[test]
fn motion_comes_with_its_set_and_a_slow_reader_misses_none_of_it() {
    let home = Home::default();
    let dataset = Fixture { sets: 12, motion: true, ..Fixture::default() };
    let path = write_dataset(&home, "a", &dataset);
    let original = Dataset::open(&path).unwrap().sets(SetRange::ALL).map(|s| s.unwrap().motion);
    let original: Vec<_> = original.flatten().collect();
    assert_eq!(original.len(), 24);
    let mut channels = vec![dataset.unit()];
    channels.extend(dataset.streams());
    let replay = start(&home, std::slice::from_ref(&path), FAST);
    let status = replay.control().status();
    assert!(status.cameras[0].streams.iter().any(|s| s.id == "left/imu"), "{:?}", status.cameras);
    let mut bench = Bench::new(&home, "bench", channels);
    // A step publishes a set and the IMU batches before it.
    steer(&replay, |r| r.step(1)).unwrap();
    bench.read_sets(1);
    assert_eq!(bench.seen.iter().map(Vec::len).collect::<Vec<_>>(), [2, 1, 1, 1, 1, 1]);
    resume(&replay);
    bench.read_all(&replay, Some(5));
    assert_eq!(bench.streams[0].1.missed(), 0);
    assert!(replay.stop().status.lost.is_empty());
    let wanted = original.iter().zip(1..).map(|(batch, sequence)| {
        let h = FrameHeader {
            sequence,
            captured: sequence + batch.header.drops().total(),
            flags: batch.header.flags | FrameFlags::REPLAYED.0,
            ..batch.header
        };
        let bytes: Vec<u8> = batch.samples.iter().flat_map(depthrig_bus::MotionSample::to_bytes).collect();
        format!("{}{bytes:?}", whole(&h))
    });
    assert!(bench.seen[0] == wanted.collect::<Vec<_>>(), "bit by bit, but for what a replay counts anew");
}

#[test]
fn a_subscriber_that_does_not_read_is_waited_for_and_named() {
    let home = Home::default();
    let dataset = Fixture { sets: 9, ..Fixture::default() };
    let path = write_dataset(&home, "a", &dataset);
    let replay = start(&home, &[path], FAST);
    let mut bench = Bench::new(&home, "bench", dataset.streams());
    resume(&replay);
    let deadline = HostTime::now().plus(TIMEOUT);
    while replay.progress().waiting_for.as_deref() != Some("left/color") {
        assert!(!deadline.from_now().is_zero(), "{:?}", replay.progress());
        std::thread::sleep(Duration::from_millis(20));
    }
    assert_eq!(replay.progress().sets, 4, "as many as wait unread for a subscriber");
    bench.read_all(&replay, None);
    assert!(bench.seen.iter().all(|channel| channel.len() == 9));
    let status = replay.stop().status;
    assert_eq!((status.waiting_for, status.lost.len()), (None, 0));
}

/// Replays `path` and records that.
fn record_again(home: &Home, path: PathBuf, name: &str, options: ReplayOptions) -> PathBuf {
    let replay = start(home, &[path], ReplayOptions { paused: true, ..options });
    let request = RecordRequest {
        directory: Some(home.path("again")),
        name: Some(name.into()),
        ..RecordRequest::default()
    };
    replay.control().record_start(&request).unwrap();
    resume(&replay);
    let deadline = HostTime::now().plus(TIMEOUT);
    while !replay.wait(Duration::from_millis(20)) {
        assert!(!deadline.from_now().is_zero(), "{:?}", replay.progress());
    }
    let result = replay.stop();
    let recording = result.recording.unwrap();
    assert_eq!((recording.error, recording.dropped.len()), (None, 0));
    assert_eq!(recording.scene, "made up", "what nobody said is as in the original");
    recording.path.into()
}

#[test]
fn a_recorded_replay_is_the_dataset_that_was_replayed() {
    let home = Home::default();
    let by_clock = ReplayOptions { rate: 10.0, ..ReplayOptions::default() };
    for (name, color, depth, options) in [
        ("raw", ColorCodec::Raw, DepthCodec::default(), FAST),
        ("jpeg", ColorCodec::Jpeg, DepthCodec::Rank, FAST),
        ("png", ColorCodec::Png, DepthCodec::default(), FAST),
        ("by_clock", ColorCodec::Jpeg, DepthCodec::default(), by_clock),
    ] {
        let path = write_dataset(&home, name, &Fixture { color, depth, motion: true, ..Fixture::default() });
        let again = record_again(&home, path.clone(), name, options);
        let a = Dataset::open(&path).unwrap();
        let b = Dataset::open(&again).unwrap();
        // Stored images byte by byte: a JPEG is kept and not encoded a second time.
        let exact = CompareOptions { pixels: PixelCheck::Stored, ..CompareOptions::default() };
        let c = compare(&a, &b, &exact).unwrap();
        assert!(c.equal, "{name}: {:#?}", c.differences);
        assert_eq!((c.sets, c.frames, c.batches), (12, 48, 24));
        let info = b.info().unwrap();
        let unit = info.accounts.iter().find(|a| a.stream.to_string() == "left/imu").unwrap();
        assert_eq!((unit.captured, unit.delivered), (24, 24), "{name}");
        // Only fields that a channel assigns again.
        let c = compare(&a, &b, &CompareOptions { strict: true, ..exact }).unwrap();
        let mut fields: Vec<_> = c.counts.iter().map(|c| c.field.as_str()).collect();
        fields.sort_unstable();
        fields.dedup();
        assert_eq!(fields, ["captured", "flags", "id", "sequence", "set_id"], "{name}");
        let report = verify(&again, &VerifyOptions { decode: true, ..VerifyOptions::default() }).unwrap();
        let bad: Vec<_> = report.findings.iter().filter(|f| f.severity != Severity::Note).collect();
        assert!(bad.is_empty(), "{name}: {bad:#?}");
        assert_eq!(b.session().rig_config, a.session().rig_config);
        assert_eq!(b.session().started_utc_ns, a.session().started_utc_ns, "the time is the original's");
    }
}

#[test]
fn a_recorded_replay_says_what_computed_its_streams() {
    let home = Home::default();
    let path = write_dataset(&home, "computed", &Fixture::default());
    let session = path.join("session.toml");
    let mut text = std::fs::read_to_string(&session).unwrap();
    let id = Dataset::open(&path).unwrap().session().streams[1].id.to_string();
    write!(
        text,
        "\n[[computed]]\nstream = \"{id}\"\nname = \"mimic_quality\"\nproducer = \"a matcher 1.0\"\n\
         parameters = \"paths=8\"\nfrom = [\"left/color\"]\n"
    )
    .unwrap();
    std::fs::write(&session, text).unwrap();
    let was = Dataset::open(&path).unwrap().session().computed.clone();
    assert_eq!(was.len(), 1);
    let again = record_again(&home, path, "again", FAST);
    assert_eq!(Dataset::open(&again).unwrap().session().computed, was);
}

#[test]
fn a_recording_never_goes_back_in_time() {
    let home = Home::default();
    let path = write_dataset(&home, "a", &Fixture::default());
    let replay =
        start(&home, &[path], ReplayOptions { paused: true, looped: true, ..ReplayOptions::default() });
    let request = RecordRequest { directory: Some(home.path("again")), ..RecordRequest::default() };
    let e = replay.control().record_start(&request).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::WrongState);
    assert!(e.to_string().contains("loop off"), "{e}");
    steer(&replay, |r| r.set_loop(false)).unwrap();
    steer(&replay, |r| r.seek(&SeekRequest { set: Some(5), ..SeekRequest::default() })).unwrap();
    let recording = replay.control().record_start(&request).unwrap();
    assert!(recording.name.ends_with("_made_up"), "{}", recording.name);
    let back = SeekRequest { seconds: Some(0.0), ..SeekRequest::default() };
    for e in [
        steer(&replay, |r| r.seek(&back)),
        steer(&replay, |r| r.step(-1)),
        steer(&replay, |r| r.set_loop(true)),
    ] {
        let e = e.unwrap_err();
        assert_eq!(e.kind(), ErrorKind::WrongState);
        assert!(e.to_string().contains("record stop"), "{e}");
    }
    steer(&replay, |r| r.seek(&SeekRequest { set: Some(9), ..SeekRequest::default() })).unwrap();
    steer(&replay, |r| r.step(1)).unwrap();
    let recorded = replay.control().record_stop().unwrap();
    assert_eq!((recorded.sets, recorded.error), (2, None));
    steer(&replay, |r| r.seek(&back)).unwrap();
    let sets: Vec<_> = Dataset::open(recorded.path.as_ref())
        .unwrap()
        .sets(depthrig_recorder::SetRange::ALL)
        .map(|s| s.unwrap().tick)
        .collect();
    assert_eq!(sets, [Fixture::default().tick(9), Fixture::default().tick(10)]);
}

#[test]
fn a_recording_of_a_replay_ends_by_itself_and_begins_only_where_it_fits() {
    let home = Home::default();
    let path = write_dataset(&home, "a", &Fixture { sets: 300, ..Fixture::default() });
    let replay = start(&home, &[path], ReplayOptions { paused: true, ..ReplayOptions::default() });
    let control = replay.control();
    let asks = |directory, max_duration_s: f64| RecordRequest {
        directory: Some(directory),
        max_duration_s: Some(max_duration_s),
        ..RecordRequest::default()
    };
    let e = control.record_start(&asks(home.path("again"), -1.0)).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::BadInput);
    if let Some(small) = Tmpfs::mount(&home.path("small"), 8 << 20) {
        let e = control.record_start(&asks(small.path().to_owned(), 3600.0)).unwrap_err();
        assert_eq!(e.kind(), ErrorKind::NoSpace, "{e}");
        assert_eq!(std::fs::read_dir(small.path()).unwrap().count(), 0, "nothing was begun");
    }
    control.record_start(&asks(home.path("again"), 1.0)).unwrap();
    resume(&replay);
    let end = HostTime::now().plus(TIMEOUT);
    let recorded = loop {
        let recorded = control.status().recording.unwrap();
        if !recorded.active {
            break recorded;
        }
        assert!(!end.from_now().is_zero(), "it goes on: {recorded:?}");
        std::thread::sleep(Duration::from_millis(20));
    };
    assert!(recorded.error.is_none() && recorded.dropped.is_empty(), "{recorded:?}");
    assert_eq!(control.record_stop().unwrap_err().kind(), ErrorKind::WrongState);
    let progress = replay.progress();
    assert!(!progress.done && !progress.paused, "the replay goes on");
    let dataset = Dataset::open(recorded.path.as_ref()).unwrap();
    let sets = dataset.sets(depthrig_recorder::SetRange::ALL).map(Result::unwrap).count() as u64;
    // Of 60 s a second was asked for; a loaded machine may be late to end it.
    assert!(sets == recorded.sets && (1..150).contains(&sets), "{sets} sets of {}", recorded.sets);
    assert!(dataset.session().outcome.as_ref().unwrap().complete);
}

#[test]
fn a_client_finds_a_replay_and_steers_it_to_the_set() {
    let home = Home::default();
    let dataset = Fixture { sets: 30, ..Fixture::default() };
    let path = write_dataset(&home, "a", &dataset);
    let options = ReplayOptions { paused: true, serve_api: true, ..ReplayOptions::default() };
    let replay = start(&home, std::slice::from_ref(&path), options);
    let client = Client::connect(&home.runtime(), None).unwrap();
    let status = client.status().unwrap();
    assert_eq!(status.cameras.iter().map(|c| c.name.as_str()).collect::<Vec<_>>(), ["left", "right"]);
    assert!(status.cameras.iter().all(|c| c.state == CameraState::Streaming && c.backend == "replay"));
    let position = status.replay.unwrap();
    assert_eq!((position.paused, position.set, position.length_sets), (true, None, 30));
    assert_eq!((position.length_s, position.datasets), (5.8, vec![path.display().to_string()]));

    let mut bench = Bench::new(&home, "bench", dataset.streams());
    bench.read_nothing();
    let seconds = |s: f64| SeekRequest { seconds: Some(s), ..SeekRequest::default() };
    let mut expected = Vec::new();
    // Between two sets, on one, by number, by id, the last, the first; each is shown although it is paused.
    for (to, set) in [
        (seconds(1.01), 6),
        (seconds(1.2), 6),
        (SeekRequest { set: Some(17), ..SeekRequest::default() }, 17),
        (SeekRequest { id: Some(3 * 23 + 5), ..SeekRequest::default() }, 23),
        (seconds(5.8), 29),
        (seconds(0.0), 0),
    ] {
        let position = client.replay_seek(&to).unwrap();
        assert_eq!(
            (position.set, position.set_id, position.paused),
            (Some(set), Some(3 * set + 5), true),
            "{to:?}"
        );
        assert_eq!(position.position_s, (200 * set) as f64 / 1e3, "{to:?}");
        expected.push(dataset.tick(set).ns());
        bench.read_sets(expected.len());
    }
    for (by, set) in [(1, 1), (1, 2), (-1, 1), (-9, 0)] {
        assert_eq!(client.replay_step(by).unwrap().set, Some(set), "step {by}");
        expected.push(dataset.tick(set).ns());
        bench.read_sets(expected.len());
    }
    bench.read_nothing();
    assert_eq!(bench.first, expected);

    for (to, kind, says) in [
        (seconds(5.81), ErrorKind::BadInput, "0 to 5.8 s"),
        (seconds(-0.1), ErrorKind::BadInput, "no set at -0.1 s"),
        (SeekRequest { set: Some(30), ..SeekRequest::default() }, ErrorKind::BadInput, "0 to 29"),
        (SeekRequest { id: Some(6), ..SeekRequest::default() }, ErrorKind::NotFound, "id 6"),
        (SeekRequest::default(), ErrorKind::BadInput, "one of them"),
        (
            SeekRequest { set: Some(1), id: Some(5), ..SeekRequest::default() },
            ErrorKind::BadInput,
            "one of them",
        ),
    ] {
        let e = client.replay_seek(&to).unwrap_err();
        assert_eq!(e.kind(), kind, "{e}");
        assert!(e.to_string().contains(says), "{e}");
    }
    let e = client.replay_rate(10.5).unwrap_err();
    assert!(e.kind() == ErrorKind::BadInput && e.to_string().contains("0.1 to 10"), "{e}");
    assert_eq!(client.replay_step(0).unwrap_err().kind(), ErrorKind::BadInput);
    assert_eq!(client.replay().unwrap().set, Some(0), "what was refused changed nothing");

    client.stop().unwrap();
    assert!(replay.wait(Duration::ZERO), "it was asked to end");
}

#[test]
fn after_a_pause_or_a_new_rate_sets_come_at_their_pace() {
    let home = Home::default();
    let dataset = Fixture { sets: 40, ..Fixture::default() };
    let path = write_dataset(&home, "a", &dataset);
    let replay = start(&home, &[path], ReplayOptions { rate: 4.0, paused: true, ..ReplayOptions::default() });
    let mut bench = Bench::new(&home, "bench", dataset.streams());
    resume(&replay);
    bench.read_sets(4);
    steer(&replay, |r| r.pause()).unwrap();
    std::thread::sleep(Duration::from_millis(100));
    bench.pump(None);
    let before = bench.ticks.len();
    // In this time 16 more would have come.
    std::thread::sleep(Duration::from_millis(800));
    bench.pump(None);
    assert_eq!(bench.ticks.len(), before, "paused");
    // The gaps are at least the period, however busy the computer is: a late set delays the rest.
    let took = |bench: &mut Bench, n: usize| {
        let begin = bench.ticks.len();
        bench.read_sets(begin + n);
        bench.ticks[begin + n - 1].0.since_ns(bench.ticks[begin].0)
    };
    resume(&replay);
    let period = dataset.period_ns / 4;
    let paced = took(&mut bench, 6);
    assert!(paced > 5 * period - SECOND / 5, "six sets at 4 x in {paced} ns: they were bunched");
    steer(&replay, |r| r.set_rate(1.0)).unwrap();
    bench.pump(None);
    let slow = took(&mut bench, 4);
    assert!(slow > 3 * dataset.period_ns - SECOND / 5, "four sets at 1 x in {slow} ns");
    // A set that this reader is too late for has its number all the same.
    let ticks = &bench.ticks;
    assert!(ticks.is_sorted_by(|a, b| a.3 < b.3), "{ticks:?}");
    assert!(ticks.iter().all(|t| t.1 == dataset.tick(t.3 - 1).ns()), "one was left out: {ticks:?}");
    // A seek while it plays goes on from there.
    steer(&replay, |r| r.seek(&SeekRequest { set: Some(36), ..SeekRequest::default() })).unwrap();
    bench.pump(None);
    let at = bench.ticks.iter().position(|t| t.1 == dataset.tick(36).ns()).unwrap();
    bench.read_sets(at + 2);
    assert_eq!(bench.ticks[at + 1].1, dataset.tick(37).ns());
}

#[test]
fn rounds_go_on_until_they_are_ended() {
    let home = Home::default();
    let dataset = Fixture { sets: 3, ..Fixture::default() };
    let path = write_dataset(&home, "a", &dataset);
    let options = ReplayOptions { rate: 10.0, looped: true, paused: true, ..ReplayOptions::default() };
    let replay = start(&home, &[path], options);
    let mut bench = Bench::new(&home, "bench", dataset.streams());
    resume(&replay);
    // A round counts once its first set was sent: the third, when the set after that came.
    bench.read_sets(8);
    let status = replay.progress();
    assert!(status.looped && status.rounds >= 3 && !status.done);
    steer(&replay, |r| r.set_loop(false)).unwrap();
    bench.read_all(&replay, None);
    // A set that this reader is too late for has its number all the same.
    let ticks = &bench.ticks;
    assert!(ticks.is_sorted_by(|a, b| a.3 < b.3) && ticks.last().unwrap().3.is_multiple_of(3), "{ticks:?}");
    assert!(ticks.iter().all(|t| t.1 == dataset.tick((t.3 - 1) % 3).ns()), "{ticks:?}");
}

#[test]
fn datasets_of_different_cameras_are_one_rig() {
    let home = Home::default();
    let a = Fixture { cameras: vec!["left"], sets: 6, ..Fixture::default() };
    // Begins one set later, 30 ms beside the ticks of the other, on a computer with another clock.
    let later = SECOND / 5 + SECOND * 3 / 100;
    let b = Fixture {
        cameras: vec!["right"],
        sets: 6,
        at_ns: later,
        mono_ns: 9_000 * SECOND,
        ..Fixture::default()
    };
    let paths = [write_dataset(&home, "a", &a), write_dataset(&home, "b", &b)];
    let replay = start(&home, &paths, FAST);
    let streams: Vec<_> = a.streams().into_iter().chain(b.streams()).collect();
    let mut bench = Bench::new(&home, "bench", streams.clone());
    resume(&replay);
    bench.read_all(&replay, None);
    let status = replay.stop().status;
    assert_eq!((status.length_sets, status.sets, status.frames, status.lost.len()), (7, 7, 24, 0));
    let ticks: Vec<_> = bench.ticks.iter().map(|t| (t.1, t.2)).collect();
    let lone_end = a.tick(0).ns() + later + 5 * b.period_ns;
    let mut expected: Vec<_> = (0..6).map(|n| (a.tick(n).ns(), 4)).collect();
    expected[0].1 = 2;
    expected.push((lone_end, 2));
    assert_eq!(ticks, expected);
    // The other computer's frames are on the clock of the first dataset.
    let h = &bench.seen[2][0];
    let right = a.tick(0).ns() + later;
    assert!(h.contains(&format!("({right}, 15000,")), "{h}");
    let members = &bench.seen[4][1];
    assert!(streams.iter().all(|s| members.contains(&format!("{:?}", s.camera))), "{members}");
}

/// A recording beside the depth computed from it: both have the IMU's samples, which are published once.
#[test]
fn motion_that_two_datasets_have_comes_once() {
    let home = Home::default();
    let raw = home.path("raw");
    let depth = home.path("depth");
    let stereo = SyntheticStereo::default();
    stereo.record(&raw);
    let modes = vec![Mode::Preset(Preset::Performance)];
    let options = ZedReplayOptions { modes, ..ZedReplayOptions::default() };
    zed_replay(&raw, &depth, &options, &mut |_, _, _| ControlFlow::Continue(())).unwrap();
    let replay = start(&home, &[raw, depth], FAST);
    let id = |name| StreamId::new("zed2i", name).unwrap();
    let mut bench = Bench::new(&home, "bench", vec![id("imu"), id("left"), id("depth_performance")]);
    resume(&replay);
    bench.read_all(&replay, None);
    let status = replay.stop().status;
    assert_eq!((status.sets, status.lost.len()), (stereo.sets, 0), "{:?}", status.lost);
    assert_eq!(bench.seen.iter().map(Vec::len).collect::<Vec<_>>()[..3], [stereo.sets as usize; 3]);
}

#[test]
fn datasets_of_one_rig_are_replayed_one_after_the_other() {
    let home = Home::default();
    let a = Fixture { sets: 4, ..Fixture::default() };
    let b =
        Fixture { sets: 3, at_ns: 7200 * SECOND, mono_ns: 50 * SECOND + 7200 * SECOND, ..Fixture::default() };
    let one = write_dataset(&home, "a", &a);
    let two = write_dataset(&home, "b", &b);
    // The order in which they are named does not matter, and nobody waits two hours.
    let replay = start(&home, &[two.clone(), one.clone()], FAST);
    assert_eq!(replay.progress().length_s, 1.2);
    let mut bench = Bench::new(&home, "bench", a.streams());
    resume(&replay);
    bench.read_all(&replay, None);
    let expected: Vec<_> = (0..4).map(|n| a.tick(n).ns()).chain((0..3).map(|n| b.tick(n).ns())).collect();
    assert_eq!(bench.first, expected);
    let e = steer(&replay, |r| r.seek(&SeekRequest { id: Some(5), ..SeekRequest::default() })).unwrap_err();
    assert!(e.to_string().contains("seek by time"), "{e}");
    drop(replay);

    let e = refused(&home, &[one.clone(), one.clone()], FAST);
    assert!(e.kind() == ErrorKind::BadInput && e.to_string().contains("both hold left/color"), "{e}");
    let other =
        write_dataset(&home, "c", &Fixture { size: (32, 24), at_ns: 9000 * SECOND, ..Fixture::default() });
    let e = refused(&home, &[one.clone(), other], FAST);
    assert!(e.kind() == ErrorKind::BadInput && e.to_string().contains("32x24"), "{e}");
    let of_other = Fixture { rig: "other", at_ns: 9000 * SECOND, ..Fixture::default() };
    let e = refused(&home, &[one.clone(), write_dataset(&home, "d", &of_other)], FAST);
    assert!(e.to_string().contains("bench, other") && e.to_string().contains("--rig"), "{e}");
    let from = ReplayOptions { from_s: Some(0.61), ..FAST };
    let e = refused(&home, std::slice::from_ref(&one), from);
    assert!(e.to_string().contains("0.600 s long"), "{e}");
    let e = refused(&home, &[], FAST);
    assert!(e.to_string().contains("name a dataset"), "{e}");
}

#[test]
fn a_damaged_set_is_lost_and_named_and_the_others_come() {
    let home = Home::default();
    let dataset = Fixture { color: ColorCodec::Jpeg, ..Fixture::default() };
    let path = write_dataset(&home, "a", &dataset);
    let segment = path.join("seg_0001.mcap");
    let mut bytes = std::fs::read(&segment).unwrap();
    // The third JPEG: the first colour image of the segment's second set.
    let at = bytes.windows(3).enumerate().filter(|(_, w)| *w == [0xff, 0xd8, 0xff]).nth(2).unwrap().0;
    bytes[at + 200] ^= 0x20;
    std::fs::write(&segment, bytes).unwrap();
    let replay = start(&home, &[path], FAST);
    let mut bench = Bench::new(&home, "bench", dataset.streams());
    resume(&replay);
    bench.read_all(&replay, None);
    let status = replay.stop().status;
    assert_eq!((status.sets, status.lost.len()), (11, 1));
    assert!(status.lost[0].contains("seg_0001.mcap"), "{:?}", status.lost);
    assert!(!bench.first.contains(&dataset.tick(6).ns()) && bench.first.len() == 11);
}

/// Flips a bit of the first chunk of `dataset` without which its first set has no numbers.
fn damage_first_set(dataset: &std::path::Path) {
    let segment = dataset.join("seg_0000.mcap");
    let whole = std::fs::read(&segment).unwrap();
    let unreadable = || {
        let reader = Dataset::open(dataset).and_then(|d| d.set_reader());
        reader.is_ok_and(|mut r| r.read(0, PixelMode::None).is_err())
    };
    // After the magic there are records: opcode, length, and as many bytes.
    let mut at = 8;
    loop {
        let end = at + 9 + u64::from_le_bytes(whole[at + 1..at + 9].try_into().unwrap()) as usize;
        if whole[at] == 6 {
            let mut bytes = whole.clone();
            bytes[end - 1] ^= 1;
            std::fs::write(&segment, bytes).unwrap();
            if unreadable() {
                return;
            }
        }
        at = end;
    }
}

#[test]
fn times_stay_where_they_are_when_the_first_set_is_lost() {
    let home = Home::default();
    let dataset = Fixture::default();
    let path = write_dataset(&home, "a", &dataset);
    damage_first_set(&path);
    let replay = start(&home, &[path], FAST);
    let mut bench = Bench::new(&home, "bench", dataset.streams());
    resume(&replay);
    bench.read_all(&replay, None);
    let status = replay.stop().status;
    assert_eq!((status.sets, status.lost.len()), (11, 1), "{:?}", status.lost);
    assert_eq!(bench.first, (1..12).map(|n| dataset.tick(n).ns()).collect::<Vec<_>>());
}

#[test]
fn replayed_frames_say_so() {
    let home = Home::default();
    let dataset = Fixture { sets: 2, ..Fixture::default() };
    let path = write_dataset(&home, "a", &dataset);
    let replay = start(&home, &[path], FAST);
    let bus = Bus::open(&home.runtime(), &RigName::new("bench").unwrap()).unwrap();
    let mut subscriber = bus.subscriber(&dataset.streams()[1]).unwrap();
    resume(&replay);
    for n in 0..2 {
        let frame = subscriber.next_timeout(TIMEOUT).unwrap().unwrap();
        assert!(frame.header().has(FrameFlags::REPLAYED));
        assert_eq!((frame.header().sequence, frame.header().device_sequence), (n + 1, 6 * n + 100));
    }
}
