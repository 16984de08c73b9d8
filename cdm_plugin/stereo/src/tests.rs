//! A fake stereo camera, and matchers that are slow, hang and fail. Long because all cases share both.

use super::*;
use core::time::Duration;
use depthrig_bus::{ClockDomain, DropReason, FrameFlags, HostTime, MetadataLevel};
use depthrig_calib::stereo::{Description, DisparityMap, StereoPair};
use depthrig_driver::clock::ClockQuality;
use depthrig_driver::{DeviceClock, FrameMeta, FrameSink, Gate, MemorySink, Poll, RawFrame};
use std::sync::Mutex;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};

mod choice;

const W: u32 = 160;
const H: u32 = 96;
/// Pixels, metres: 20 pixels of disparity are 1.2 m.
const FOCAL: f64 = 200.0;
const BASELINE: f64 = 0.12;

/// Output of the fake camera at one poll.
#[derive(Debug, Clone, Copy)]
enum Shot {
    /// Both cameras see a wall at this disparity.
    Wall(usize),
    /// The same, and the right camera sees it so many rows lower.
    LowWall(usize, usize),
    /// Only the image of this side comes.
    Only(usize),
    /// The left image comes damaged, the right one is complete.
    LeftDamaged,
    /// So many images of both sides are skipped.
    Gap(u64),
    /// One side's image of this number alone, so much later than others of its number, complete or damaged; its pixels
    /// are its number.
    One(usize, u64, i64, bool),
}

struct FakeCamera {
    info: DeviceInfo,
    profiles: Vec<StreamProfile>,
    shots: Vec<Shot>,
    pause: Duration,
    swapped: bool,
}

impl FakeCamera {
    fn new(format: PixelFormat, shots: &[Shot]) -> Self {
        let profile = |name: &str, x: f64| StreamProfile {
            stream: Name::new(name).unwrap(),
            format,
            width: W,
            height: H,
            rate_hz: 30.0,
            depth_unit_m: 0.0,
            intrinsics: Intrinsics::pinhole(FOCAL, FOCAL, 79.5, 47.5),
            pose_in_device: Pose { translation_m: [x, 0.0, 0.0], ..Pose::IDENTITY },
            clock: DeviceClock { counter_bits: 64, tick_ps: 1000, domain: ClockDomain::Kernel },
            sequence_bits: 64,
            metadata: MetadataLevel::Kernel,
        };
        let info = DeviceInfo { backend: "fake", model: "Fake".into(), ..DeviceInfo::default() };
        let profiles = vec![profile("left", 0.0), profile("right", BASELINE)];
        Self { info, profiles, shots: shots.to_vec(), pause: Duration::ZERO, swapped: false }
    }
}

impl Device for FakeCamera {
    fn info(&self) -> &DeviceInfo {
        &self.info
    }

    fn profiles(&self) -> &[StreamProfile] {
        &self.profiles
    }

    fn start(self: Box<Self>, requests: &[StreamRequest]) -> Result<Box<dyn Stream>> {
        let profiles = choose_profiles("fake", &self.profiles, requests)?;
        let gates = profiles.iter().enumerate().map(|(i, p)| Gate::new(i, p)).collect();
        Ok(Box::new(FakeStream {
            profiles,
            gates,
            shots: self.shots,
            at: 0,
            sequence: 0,
            pause: self.pause,
            swapped: self.swapped,
        }))
    }
}

struct FakeStream {
    profiles: Vec<StreamProfile>,
    gates: Vec<Gate>,
    shots: Vec<Shot>,
    at: usize,
    sequence: u64,
    pause: Duration,
    swapped: bool,
}

/// An image of noise, `shift` pixels to the left.
fn noise(format: PixelFormat, shift: usize) -> Vec<u8> {
    // Not a sum, which would repeat along a row.
    let grey = |x: usize, y: usize| ((((x * 7919) ^ (y * 104_729)) * 2_654_435_761) >> 13) as u8;
    let pixels = (0..W as usize * H as usize).map(|i| (i % W as usize + shift, i / W as usize));
    pixels
        .flat_map(|(x, y)| match format {
            PixelFormat::Yuyv => vec![grey(x, y), 128],
            PixelFormat::Rgb8 => vec![grey(x, y); 3],
            _ => vec![grey(x, y)],
        })
        .collect()
}

impl Stream for FakeStream {
    fn profiles(&self) -> &[StreamProfile] {
        &self.profiles
    }

    fn poll(&mut self, timeout: Duration, sink: &mut dyn FrameSink) -> Result<Poll> {
        let Some(shot) = self.shots.get(self.at).copied() else { return Ok(Poll::End) };
        std::thread::sleep(self.pause.min(timeout));
        self.at += 1;
        if let Shot::One(side, number, late_ns, is_whole) = shot {
            let ticks = (1_000_000_000 + number * 33_333_333).saturating_add_signed(late_ns);
            let image = vec![number as u8; self.profiles[side].frame_bytes()];
            let arrival = HostTime::from_ns(ticks as i64 + 1000);
            let mut raw = RawFrame::new(number, ticks, arrival, image.len());
            raw.damaged = !is_whole;
            self.gates[side].deliver(&raw, sink, |memory| {
                memory.copy_from_slice(&image);
                Ok(())
            });
            return Ok(Poll::Frame);
        }
        self.sequence += if let Shot::Gap(n) = shot { n } else { 1 };
        // Stamps of a camera at 30 Hz, all of them in the past.
        let ticks = 1_000_000_000 + self.sequence * 33_333_333;
        for (i, gate) in self.gates.iter_mut().enumerate() {
            let format = self.profiles[i].format;
            let image = match shot {
                Shot::Gap(_) | Shot::One(..) => continue,
                Shot::Only(side) if side != i => continue,
                Shot::Wall(d) if (i == 1) != self.swapped => noise(format, d),
                Shot::LowWall(d, rows) if i == 1 => {
                    let mut image = noise(format, d);
                    let row = image.len() / H as usize;
                    image.rotate_right(rows * row);
                    image
                }
                _ => noise(format, 0),
            };
            let arrival = HostTime::from_ns(ticks as i64 + 1000);
            let mut raw = RawFrame::new(self.sequence, ticks, arrival, image.len());
            raw.damaged = i == 0 && matches!(shot, Shot::LeftDamaged);
            raw.exposure_ns = 5000;
            gate.deliver(&raw, sink, |memory| {
                memory.copy_from_slice(&image);
                Ok(())
            });
        }
        Ok(Poll::Frame)
    }
}

/// A sink that holds the accounts of every frame to the rule, and counts superseded frames.
#[derive(Default)]
struct Strict(MemorySink, u64);

impl FrameSink for Strict {
    fn loan(&mut self, stream: usize, len: usize) -> Option<&mut [u8]> {
        self.0.loan(stream, len)
    }
    fn commit(&mut self, stream: usize, meta: &FrameMeta) {
        let captured = self.0.captured[stream];
        let decided = self.0.delivered(stream) + 1 + self.0.drops_of(stream).total();
        assert_eq!(captured, decided, "stream {stream} in the header of a frame");
        assert_eq!(meta.captured, captured, "stream {stream}");
        self.0.commit(stream, meta);
    }
    fn discard(&mut self, stream: usize) {
        self.0.discard(stream);
    }
    fn dropped(&mut self, stream: usize, reason: DropReason, n: u64) {
        self.0.dropped(stream, reason, n);
    }
    fn superseded(&mut self, stream: usize, n: u64) {
        self.1 += n;
        self.0.dropped(stream, DropReason::QueueFull, n);
    }
    fn captured(&mut self, stream: usize, n: u64) {
        self.0.captured(stream, n);
    }
    fn clock_quality(&mut self, _: usize, _: &ClockQuality) {}
}

/// Runs to the end and returns what came, with the delivered profiles.
fn play(device: FakeCamera, options: StereoOptions, requests: &[&str]) -> (MemorySink, Vec<StreamProfile>) {
    let requests: Vec<_> = requests.iter().map(|r| StreamRequest::any(Name::new(*r).unwrap())).collect();
    let mut stream = wrap(Box::new(device), options).unwrap().start(&requests).unwrap();
    let mut sink = Strict::default();
    let limit = HostTime::now().plus(Duration::from_mins(1));
    while stream.poll(Duration::from_millis(20), &mut sink).unwrap() != Poll::End {
        assert!(!limit.from_now().is_zero(), "it does not come to an end");
    }
    let profiles = stream.profiles().to_vec();
    for (i, profile) in profiles.iter().enumerate() {
        let of = |list: &[u64]| list.get(i).copied().unwrap_or(0);
        let decided = sink.0.delivered(i) + sink.0.drops_of(i).total();
        assert_eq!(of(&sink.0.captured), decided, "{}", profile.stream);
    }
    (sink.0, profiles)
}

fn options(modes: Vec<StereoMode>) -> StereoOptions {
    StereoOptions { modes, disparity: true, every_pair: true, ..StereoOptions::default() }
}

fn presets() -> Vec<StereoMode> {
    Preset::ALL.map(|p| StereoMode::preset(p, 0.5, 1)).into()
}

/// A matcher that follows a script.
struct ScriptedMatcher {
    work: Box<dyn FnMut() -> depthrig_calib::Result<()> + Send>,
}

impl Matcher for ScriptedMatcher {
    fn describe(&self) -> Description {
        let text = String::new;
        Description { producer: text(), name: text(), parameters: text(), memory_bytes: 0 }
    }

    fn run(&mut self, pair: &StereoPair<'_>, out: &mut DisparityMap) -> depthrig_calib::Result<()> {
        (self.work)()?;
        out.resize(pair.left.width, pair.left.height);
        out.disparity.fill(20.0);
        out.confidence.fill(200);
        Ok(())
    }
}

fn scripted<W: FnMut() -> depthrig_calib::Result<()> + Send + 'static>(
    name: &str,
    make: impl Fn() -> W + Send + Sync + 'static,
) -> StereoMode {
    let make = move |_: &Geometry| -> depthrig_calib::Result<Box<dyn Matcher>> {
        Ok(Box::new(ScriptedMatcher { work: Box::new(make()) }))
    };
    StereoMode { name: name.to_owned(), wants_color: false, make: Arc::new(make) }
}

fn index(profiles: &[StreamProfile], name: &str) -> usize {
    profiles.iter().position(|p| p.stream.as_str() == name).unwrap_or_else(|| panic!("no {name}"))
}

#[test]
fn a_wall_has_its_depth_in_every_preset_and_format() {
    for format in [PixelFormat::Yuyv, PixelFormat::Rgb8, PixelFormat::Mono8] {
        let shots = [Shot::Wall(20), Shot::Wall(24), Shot::Wall(16)];
        let (sink, profiles) = play(FakeCamera::new(format, &shots), options(presets()), &[]);
        let expected = if format == PixelFormat::Mono8 { 11 } else { 12 };
        assert_eq!(profiles.len(), expected, "{format:?}: left, right, colour, three times three");
        for mode in ["performance", "quality", "ultra"] {
            let i = index(&profiles, &format!("depth_{mode}"));
            assert_eq!((profiles[i].format, profiles[i].depth_unit_m), (PixelFormat::Z16, 0.001));
            assert!((profiles[i].intrinsics.fx - FOCAL).abs() < 1e-6, "nothing is bent, so nothing changes");
            let walls: Vec<_> = sink.frames.iter().filter(|f| f.0 == i).collect();
            assert_eq!(walls.len(), 3);
            for ((_, meta, pixels), d) in walls.iter().zip([20.0, 24.0, 16.0]) {
                let mut depth: Vec<_> = pixels.chunks(2).map(|z| u16::from_le_bytes([z[0], z[1]])).collect();
                depth.retain(|z| *z > 0);
                let seen = depth.len() as f64 / f64::from(W * H);
                depth.sort_unstable();
                let middle = f64::from(depth[depth.len() / 2]);
                let want = FOCAL * BASELINE / d * 1000.0;
                assert!(seen > 0.6, "{mode}: {seen} of the wall is seen");
                assert!(
                    (middle - want).abs() < 0.02 * want,
                    "{format:?} {mode}: {middle} mm is not {want} mm"
                );
                assert!(meta.flags.has(FrameFlags::DERIVED) && meta.exposure_ns == 5000);
            }
            let c = index(&profiles, &format!("confidence_{mode}"));
            let d = index(&profiles, &format!("disparity_{mode}"));
            let of = |i: usize| sink.frames.iter().find(|f| f.0 == i).map(|f| &f.2).unwrap();
            for ((z, c), d) in walls[0].2.chunks(2).zip(of(c)).zip(of(d).chunks(4)) {
                let d = f32::from_le_bytes(d.try_into().unwrap());
                assert!((z != [0, 0]) == (*c > 0), "confidence is that of depth");
                assert!(z == [0, 0] || d > 0.0);
            }
        }
        // Each frame has the time and the number of its pair.
        let pairs: Vec<_> = sink.frames.iter().filter(|f| f.0 == 0).map(|f| f.1).collect();
        for i in 2..profiles.len() {
            let times =
                sink.frames.iter().filter(|f| f.0 == i).map(|f| (f.1.capture_time, f.1.device_sequence));
            assert!(times.eq(pairs.iter().map(|m| (m.capture_time, m.device_sequence))));
        }
        if format != PixelFormat::Mono8 {
            let color = index(&profiles, "color");
            let first = &sink.frames.iter().find(|f| f.0 == color).unwrap().2;
            assert_eq!(first.len(), (W * H * 3) as usize);
            let raw = noise(PixelFormat::Rgb8, 0);
            if format == PixelFormat::Rgb8 {
                assert_eq!(*first, raw, "nothing is bent, so nothing changes");
            }
        }
    }
}

#[test]
fn each_modes_matcher_is_described() {
    let options = options(presets());
    let computed = Arc::clone(&options.computed);
    let _ = play(FakeCamera::new(PixelFormat::Yuyv, &[Shot::Wall(20)]), options, &["depth_quality"]);
    let computed = computed.lock().unwrap();
    let names: Vec<_> = computed.iter().map(|(mode, d)| (mode.as_str(), d.name.as_str())).collect();
    assert_eq!(names, [("performance", "performance"), ("quality", "quality"), ("ultra", "ultra")]);
    assert!(computed["ultra"].parameters.contains("max_disparity=64"), "{}", computed["ultra"].parameters);
}

#[test]
fn only_requested_streams_come_and_left_and_right_are_read_all_the_same() {
    let camera = FakeCamera::new(PixelFormat::Yuyv, &[Shot::Wall(20); 2]);
    let (sink, profiles) = play(camera, options(presets()), &["depth_quality", "left"]);
    let names: Vec<_> = profiles.iter().map(|p| p.stream.as_str()).collect();
    assert_eq!(names, ["depth_quality", "left"], "in the order in which they were asked for");
    assert_eq!((sink.delivered(0), sink.delivered(1), sink.frames.len()), (2, 2, 4));
}

/// A mode whose matcher waits until the sender is dropped.
fn waits(name: &str) -> (StereoMode, SyncSender<()>) {
    let (release, gate): (SyncSender<()>, Receiver<()>) = sync_channel(1024);
    let gate = Arc::new(Mutex::new(gate));
    let mode = scripted(name, move || {
        let gate = Arc::clone(&gate);
        move || {
            let _ = gate.lock().unwrap().recv();
            Ok(())
        }
    });
    (mode, release)
}

#[test]
fn a_slow_mode_skips_pairs_counts_them_and_holds_up_nobody() {
    let (slow, release) = waits("slow");
    let mut camera = FakeCamera::new(PixelFormat::Yuyv, &[Shot::Wall(3); 60]);
    camera.pause = Duration::from_millis(2);
    let options = StereoOptions { every_pair: false, ..options(vec![slow, scripted("quick", || || Ok(()))]) };
    let mut stream = wrap(Box::new(camera), options).unwrap().start(&[]).unwrap();
    let profiles = stream.profiles().to_vec();
    let i = |name| index(&profiles, name);
    let mut sink = Strict::default();
    // Until the quick mode has had its last pair; the slow one is still at its first.
    let limit = HostTime::now().plus(Duration::from_mins(1));
    while sink.0.captured.get(i("depth_quick")).is_none_or(|n| *n < 60) {
        let _ = stream.poll(Duration::from_millis(5), &mut sink).unwrap();
        assert!(!limit.from_now().is_zero());
    }
    assert_eq!(sink.0.delivered(i("left")), 60, "capture goes on");
    assert_eq!(sink.0.delivered(i("depth_slow")), 0);
    let quick = sink.0.delivered(i("depth_quick"));
    drop(release);
    while stream.poll(Duration::from_millis(5), &mut sink).unwrap() != Poll::End {}
    let Strict(sink, by_design) = sink;
    let queue_full: u64 = sink.drops.iter().map(|d| d.get(DropReason::QueueFull)).sum();
    assert!(by_design > 0 && by_design == queue_full, "{by_design} of {queue_full} are said to be no fault");
    // The first that came through, and the newest that waited for it.
    assert_eq!(sink.delivered(i("depth_slow")), if quick > 1 { 2 } else { 1 }, "of {quick}");
    let skipped = sink.drops_of(i("depth_slow"));
    assert_eq!(skipped.total(), skipped.get(DropReason::QueueFull));
    for name in ["color", "depth_slow", "confidence_slow", "disparity_quick"] {
        assert_eq!(sink.captured[i(name)], 60, "{name} counts every pair");
    }
}

#[test]
fn with_every_pair_nothing_gives_way() {
    let slow = scripted("slow", || {
        || {
            std::thread::sleep(Duration::from_millis(5));
            Ok(())
        }
    });
    let (sink, profiles) = play(
        FakeCamera::new(PixelFormat::Yuyv, &[Shot::Wall(3); 30]),
        options(vec![slow, scripted("quick", || || Ok(()))]),
        &[],
    );
    for (i, profile) in profiles.iter().enumerate() {
        assert_eq!((sink.delivered(i), sink.drops_of(i).total()), (30, 0), "{}", profile.stream);
    }
}

#[test]
fn pairs_that_lack_an_image_are_counted() {
    let shots = [
        Shot::Wall(3),
        Shot::Only(0),
        Shot::Wall(3),
        Shot::Only(1),
        Shot::LeftDamaged,
        Shot::Wall(3),
        Shot::Gap(4),
        Shot::Wall(3),
        Shot::Only(0),
    ];
    let (sink, profiles) =
        play(FakeCamera::new(PixelFormat::Yuyv, &shots), options(vec![scripted("quick", || || Ok(()))]), &[]);
    let left = index(&profiles, "left");
    let depth = index(&profiles, "depth_quick");
    assert_eq!(sink.delivered(depth), 4);
    let drops = sink.drops_of(depth);
    assert_eq!(drops.get(DropReason::Incomplete), 2, "the two that have no right image");
    assert_eq!(drops.get(DropReason::DeviceError), 1);
    assert_eq!(drops.get(DropReason::DeviceGap), 5, "four, and the one of which only the right image came");
    assert_eq!(sink.captured[depth], sink.captured[left], "one for every left image");
}

/// A matcher that fails unless both images have the same number.
struct SameNumber;

impl Matcher for SameNumber {
    fn describe(&self) -> Description {
        let text = String::new;
        Description { producer: text(), name: text(), parameters: text(), memory_bytes: 0 }
    }

    fn run(&mut self, pair: &StereoPair<'_>, out: &mut DisparityMap) -> depthrig_calib::Result<()> {
        let middle = pair.left.pixels.len() / 2 + 80;
        if pair.left.pixels[middle] != pair.right.pixels[middle] {
            let e = depthrig_calib::ErrorKind::BadInput;
            return Err(depthrig_calib::Error::new(e, "images of two pairs"));
        }
        out.resize(pair.left.width, pair.left.height);
        Ok(())
    }
}

/// Plays `shots`; returns the numbers of the pairs with depth, each with its time after the left image's, and the
/// drops.
fn pairs(shots: &[Shot]) -> (Vec<(u64, i64)>, depthrig_bus::DropCounts) {
    let make: Maker = Arc::new(|_| Ok(Box::new(SameNumber)));
    let mode = StereoMode { name: "same".into(), wants_color: false, make };
    let (sink, profiles) = play(FakeCamera::new(PixelFormat::Mono8, shots), options(vec![mode]), &[]);
    let depth = index(&profiles, "depth_same");
    let drops = sink.drops_of(depth);
    assert_eq!(drops.get(DropReason::DeviceError), shots.iter().filter(|s| is_bad_left(s)).count() as u64);
    assert_eq!(sink.captured[depth], sink.captured[index(&profiles, "left")], "one for every left image");
    let made = sink.frames.iter().filter(|f| f.0 == depth).map(|(_, meta, _)| {
        let n = meta.device_sequence;
        (n, meta.capture_time.ns() - (1_000_000_000 + n as i64 * 33_333_333))
    });
    (made.collect(), drops)
}

fn is_bad_left(shot: &Shot) -> bool {
    matches!(shot, Shot::One(0, _, _, false))
}

const L: usize = 0;
const R: usize = 1;

/// The image `n` of a side.
fn one(side: usize, n: u64) -> Shot {
    Shot::One(side, n, 0, true)
}

#[test]
fn either_side_may_come_first() {
    let left_first = (1..6).flat_map(|n| [one(L, n), one(R, n)]).collect::<Vec<_>>();
    let right_first = (1..6).flat_map(|n| [one(R, n), one(L, n)]).collect::<Vec<_>>();
    let in_turn =
        (1..6).flat_map(|n| if n % 2 == 0 { [one(R, n), one(L, n)] } else { [one(L, n), one(R, n)] });
    for shots in [left_first, right_first, in_turn.collect()] {
        let (made, drops) = pairs(&shots);
        assert_eq!(made, [(1, 0), (2, 0), (3, 0), (4, 0), (5, 0)], "{shots:?}");
        assert_eq!(drops.total(), 0);
    }
}

#[test]
fn a_lost_image_costs_its_own_pair_alone() {
    // The right one of the second, then the left one of the fourth, in either order of arrival.
    for order in [[L, R], [R, L]] {
        let shots: Vec<_> = (1..7)
            .flat_map(|n| order.map(|side| one(side, n)))
            .filter(|s| !matches!(s, Shot::One(R, 2, ..) | Shot::One(L, 4, ..)))
            .collect();
        let (made, drops) = pairs(&shots);
        assert_eq!(made, [(1, 0), (3, 0), (5, 0), (6, 0)], "{order:?}");
        let counts = [DropReason::Incomplete, DropReason::DeviceGap].map(|r| drops.get(r));
        assert_eq!(counts, [1, 1], "{order:?}");
    }
    // A left image whose partner is still to come is superseded by the next one.
    let late = [one(L, 1), Shot::One(L, 2, 0, false), one(R, 1), one(R, 2), one(L, 3), one(R, 3)];
    let (made, drops) = pairs(&late);
    assert_eq!((made.as_slice(), drops.get(DropReason::Incomplete)), (&[(3, 0)][..], 1));
    // At the end nobody waits any longer.
    let (made, drops) = pairs(&[one(R, 1), one(L, 1), one(L, 2)]);
    assert_eq!((made.len(), drops.get(DropReason::Incomplete)), (1, 1));
}

#[test]
fn a_pair_is_two_images_within_a_quarter_of_a_period() {
    for order in [[L, R], [R, L]] {
        for late_ns in [-8_300_000, -1, 1, 8_300_000, -8_400_000, 8_400_000, 16_000_000] {
            let at = |side, n| Shot::One(side, n, if side == R { late_ns } else { 0 }, true);
            let shots: Vec<_> = (1..5).flat_map(|n| order.map(|side| at(side, n))).collect();
            let (made, drops) = pairs(&shots);
            // Its time is the left one's, and its number.
            let whole = [(1, 0), (2, 0), (3, 0), (4, 0)];
            let near = i64::abs(late_ns) < 8_333_333;
            assert_eq!(made, if near { &whole[..] } else { &[] }, "{order:?}, {late_ns} ns apart");
            assert_eq!(
                drops.get(DropReason::Incomplete),
                if near { 0 } else { 4 },
                "{order:?}, {late_ns} ns apart"
            );
        }
    }
}

#[test]
fn a_mode_that_fails_loses_its_frames_alone() {
    let flaky = scripted("flaky", || {
        let mut n = 0;
        move || {
            n += 1;
            if n % 3 == 0 {
                let e = depthrig_calib::ErrorKind::BadInput;
                return Err(depthrig_calib::Error::new(e, "it does not want to"));
            }
            Ok(())
        }
    });
    let (sink, profiles) = play(
        FakeCamera::new(PixelFormat::Yuyv, &[Shot::Wall(3); 9]),
        options(vec![flaky, scripted("quick", || || Ok(()))]),
        &[],
    );
    let i = |name| index(&profiles, name);
    assert_eq!(sink.delivered(i("depth_flaky")), 6);
    assert_eq!(sink.drops_of(i("depth_flaky")).get(DropReason::DeviceError), 3);
    assert_eq!(sink.delivered(i("depth_quick")), 9);
}

/// A matcher that does not come back stops its own streams, neither capture nor the end of the camera.
#[test]
fn a_mode_that_hangs_is_left_behind() {
    let (hangs, release) = waits("hangs");
    let camera = FakeCamera::new(PixelFormat::Yuyv, &[Shot::Wall(3); 40]);
    let options = StereoOptions { every_pair: false, ..options(vec![hangs]) };
    let mut stream = wrap(Box::new(camera), options).unwrap().start(&[]).unwrap();
    let mut sink = Strict::default();
    let limit = HostTime::now().plus(Duration::from_mins(1));
    while sink.0.delivered(0) < 40 || sink.0.delivered(2) < 1 {
        let _ = stream.poll(Duration::from_millis(2), &mut sink).unwrap();
        assert!(!limit.from_now().is_zero());
    }
    let i = |name| index(stream.profiles(), name);
    assert_eq!((i("left"), i("color")), (0, 2), "colour is made without it");
    let depth = i("depth_hangs");
    assert_eq!(sink.0.delivered(depth), 0);
    assert!(sink.0.captured.get(depth).copied().unwrap_or(0) < 40, "what came after it is not decided");
    drop(stream);
    drop(release);
}

#[test]
fn swapped_sides_are_found_in_the_images() {
    let mut camera = FakeCamera::new(PixelFormat::Yuyv, &[Shot::Wall(12); 200]);
    // The images of a wall, but each under the other's name: the pose is that of the right order.
    camera.swapped = true;
    let mut stream = wrap(Box::new(camera), options(presets())).unwrap().start(&[]).unwrap();
    let mut sink = Strict::default();
    let said = loop {
        match stream.poll(Duration::from_millis(20), &mut sink) {
            Ok(Poll::End) => panic!("nobody noticed"),
            Ok(_) => {}
            Err(e) => break e,
        }
    };
    assert!(
        said.kind() == ErrorKind::BadInput && said.to_string().contains("left and right are swapped"),
        "{said}"
    );
    // In their order nothing is said, as the other tests show; there the walls are the same.
}

#[test]
fn rows_that_differ_are_reported_once_there_are_enough_pairs() {
    let reported = |shots: &[Shot]| {
        let options = options(vec![StereoMode::preset(Preset::Performance, 0.5, 1)]);
        let notice = Arc::clone(&options.notice);
        let computed = Arc::clone(&options.computed);
        // Of an earlier start, and no longer true.
        *notice.lock().unwrap() = Some("old".to_owned());
        let mut stream =
            wrap(Box::new(FakeCamera::new(PixelFormat::Yuyv, shots)), options).unwrap().start(&[]).unwrap();
        let mut sink = Strict::default();
        while stream.poll(Duration::from_millis(20), &mut sink).unwrap() != Poll::End {}
        // The last look may still be under way.
        let limit = HostTime::now().plus(Duration::from_secs(10));
        let text = || notice.lock().unwrap().clone();
        while matches!(shots, [Shot::LowWall(..), ..])
            && shots.len() >= 40
            && text().is_none_or(|t| t == "old")
        {
            assert!(!limit.from_now().is_zero(), "nothing was reported");
            std::thread::sleep(Duration::from_millis(5));
        }
        // Datasets say that rows were moved, and by how much.
        let all = computed.lock().unwrap();
        let moved =
            |d: &depthrig_calib::stereo::Description| d.parameters.matches("rows_moved_px=").count() == 1;
        assert_eq!(all.values().all(moved), text().is_some(), "{all:?}");
        text()
    };
    let text = reported(&[Shot::LowWall(12, 2); 60]).unwrap();
    assert!(text.contains("2.00 ± 0.05 px lower"), "{text}");
    assert!(text.contains("calibrate it anew"), "{text}");
    assert_eq!(reported(&[Shot::LowWall(12, 2); 29]), None, "two looks are too few");
    assert_eq!(reported(&[Shot::Wall(12); 60]), None);
}

#[test]
fn what_cannot_be_is_said() {
    let refused = |device: FakeCamera, options: StereoOptions| match wrap(Box::new(device), options) {
        Err(e) => e.to_string(),
        Ok(d) => d.start(&[]).err().map(|e| e.to_string()).unwrap_or_default(),
    };
    let camera = || FakeCamera::new(PixelFormat::Yuyv, &[]);
    let said = |text: String, wanted: &str| assert!(text.contains(wanted), "{text}");
    let mut uncalibrated = camera();
    uncalibrated.profiles.iter_mut().for_each(|p| p.intrinsics = Intrinsics::default());
    said(refused(uncalibrated, options(presets())), "no calibration of left and right at 160x96");
    let mut swapped = camera();
    swapped.profiles[1].pose_in_device.translation_m[0] = -BASELINE;
    said(refused(swapped, options(presets())), "left and right are swapped");
    let mut one_sided = camera();
    one_sided.profiles.truncate(1);
    said(refused(one_sided, options(presets())), "no streams \"left\" and \"right\"");
    let mut odd = camera();
    odd.profiles.iter_mut().for_each(|p| p.width = 161);
    said(refused(odd, options(presets())), "161 is odd");
    let mut colored = camera();
    let color = StreamProfile { stream: Name::new("color").unwrap(), ..colored.profiles[0].clone() };
    colored.profiles.push(color);
    said(refused(colored, options(presets())), "has a stream \"color\" itself");
    said(
        refused(FakeCamera::new(PixelFormat::Nv12, &[]), options(presets())),
        "unsupported format nv12 of left and right",
    );
    let quick = || scripted("quick", || || Ok(()));
    said(refused(camera(), options(vec![quick(), quick()])), "\"quick\" is listed twice");
    said(refused(camera(), options(vec![scripted("No!", || || Ok(()))])), "cannot be called \"No!\"");
    said(
        refused(camera(), StereoOptions { range_m: (2.0, 1.0), ..options(presets()) }),
        "invalid depth range 2 m to 1 m",
    );
    let broken = StereoMode {
        make: Arc::new(|_| {
            Err(depthrig_calib::Error::new(depthrig_calib::ErrorKind::BadInput, "no such file"))
        }),
        ..quick()
    };
    said(refused(camera(), options(vec![broken])), "\"quick\" cannot be made: no such file");
}

#[test]
fn near_things_need_more_disparities() {
    let g = Geometry { width: 1280, height: 720, focal_px: 540.0, baseline_m: 0.12 };
    assert_eq!(g.disparities(0.5), 144, "129.6 pixels at half a metre");
    assert_eq!((g.disparities(20.0), g.disparities(0.01)), (16, 256));
}
