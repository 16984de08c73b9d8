//! Simulated cameras, seen from outside: one world, honest sensors, a cache that is used and
//! repaired, clocks and faults as scheduled.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use depthrig_bus::{DropReason, HostTime, MotionSample, Name, Pose};
use depthrig_calib::{CameraExt, PoseExt};
use depthrig_driver::{Backend, ErrorKind, MemorySink, Stream, StreamProfile, StreamRequest};
use depthrig_sim::synthetic::{
    FaultKind, ScheduledFault, StreamOverride, SyntheticBackend, SyntheticConfig, imu, overlay, prepare,
};
use glam::DVec2;
use std::path::Path;
use std::sync::Mutex;
use std::time::Duration;

fn camera(model: &str, width: u32, height: u32, cache: &Path) -> SyntheticConfig {
    let depth =
        StreamOverride { stream: Name::new("depth").unwrap(), size: Some((width, height)), rate_hz: None };
    let mut streams = vec![depth.clone()];
    if model == "generic" {
        streams.push(StreamOverride { stream: Name::new("color").unwrap(), ..depth });
    }
    SyntheticConfig {
        model: model.into(),
        truth: true,
        poses: 1,
        streams,
        cache_dir: cache.to_path_buf(),
        ..SyntheticConfig::default()
    }
}

/// One image of a stream.
struct Shot {
    profile: StreamProfile,
    on_mount: Pose,
    pixels: Vec<u8>,
}

impl Shot {
    fn counts(&self, x: usize, y: usize) -> u16 {
        let i = 2 * (y * self.profile.width as usize + x);
        u16::from_le_bytes([self.pixels[i], self.pixels[i + 1]])
    }

    fn depth_m(&self, x: usize, y: usize) -> f64 {
        f64::from(self.counts(x, y)) * self.profile.depth_unit_m
    }

    fn size(&self) -> (usize, usize) {
        (self.profile.width as usize, self.profile.height as usize)
    }

    fn every_pixel(&self) -> impl Iterator<Item = (usize, usize)> + use<> {
        let (w, h) = self.size();
        (0..h).flat_map(move |y| (0..w).map(move |x| (x, y)))
    }

    fn holes(&self) -> f64 {
        let holes = self.every_pixel().filter(|(x, y)| self.counts(*x, *y) == 0).count();
        holes as f64 / (self.pixels.len() / 2) as f64
    }
}

/// Takes one image of these streams.
fn shoot(config: &SyntheticConfig, streams: &[&str]) -> Vec<Shot> {
    let backend = SyntheticBackend::new(vec![config.clone()]).unwrap();
    let device = backend.open(None).unwrap();
    let requests: Vec<_> =
        streams.iter().map(|s| depthrig_driver::StreamRequest::any(Name::new(*s).unwrap())).collect();
    let mut stream = device.start(&requests).unwrap();
    let mut sink = MemorySink::default();
    while (0..streams.len()).any(|i| sink.delivered(i) == 0) {
        stream.poll(Duration::from_millis(50), &mut sink).unwrap();
    }
    let of = |i: usize| sink.frames.iter().find(|f| f.0 == i).unwrap().2.clone();
    let shots = stream.profiles().iter().enumerate().map(|(i, p)| Shot {
        profile: p.clone(),
        on_mount: config.pose_on_mount.compose(&p.pose_in_device),
        pixels: of(i),
    });
    shots.collect()
}

/// Projects the true depth of `a` into `b`: how many spots both place alike, how many something hides from
/// `b`, and how many are not there for `b`.
fn compare(a: &Shot, b: &Shot) -> [u32; 3] {
    let a_to_b = b.on_mount.inverse().compose(&a.on_mount);
    let (w, h) = b.size();
    let [mut agree, mut hidden, mut missing] = [0; 3];
    for (x, y) in a.every_pixel() {
        // The corners of a wide lens show nothing.
        let Some(ray) = a.profile.intrinsics.unproject(DVec2::new(x as f64, y as f64)) else { continue };
        let p = a_to_b.transform_point(ray * a.depth_m(x, y));
        let Some(px) = b.profile.intrinsics.project(p) else { continue };
        let u = px.x.round();
        let v = px.y.round();
        if u < 1.0 || v < 1.0 || u > w as f64 - 2.0 || v > h as f64 - 2.0 {
            continue;
        }
        let u = u as usize;
        let v = v as usize;
        // Half a pixel on a slanted surface is some millimetres: compare with the neighbourhood's range.
        let around = (0..9).map(|i| b.depth_m(u + i % 3 - 1, v + i / 3 - 1)).filter(|z| *z > 0.0);
        let (low, high) = around.fold((f64::INFINITY, 0.0f64), |(l, h), z| (l.min(z), h.max(z)));
        match p.z {
            z if z < low - 0.002 => missing += 1,
            z if z > high + 0.002 => hidden += 1,
            _ => agree += 1,
        }
    }
    [agree, hidden, missing]
}

#[test]
fn all_cameras_see_one_world() {
    let cache = tempfile::tempdir().unwrap();
    let mut a = camera("d415", 640, 480, cache.path());
    let mut b = camera("kinect", 512, 512, cache.path());
    a.pose_on_mount.translation_m = [-0.12, 0.03, 0.0];
    b.pose_on_mount = Pose { translation_m: [0.15, -0.05, 0.02], rotation_xyzw: [0.05, -0.08, 0.02, 0.99] };
    let a = shoot(&a, &["depth_true"]).remove(0);
    let mut b = shoot(&b, &["depth_true"]).remove(0);
    let [agree, hidden, missing] = compare(&a, &b);
    let total = agree + hidden + missing;
    assert!(total > 150_000, "the cameras share a view: {total}");
    assert!(agree * 100 > total * 85, "{agree} agree, {hidden} hidden, {missing} missing of {total}");
    assert!(
        missing * 1000 < total,
        "{missing} of {total} spots that one camera sees are not there for the other"
    );

    // The comparison is sharp: a pose that is wrong by 1 cm shows.
    b.on_mount.translation_m[1] += 0.01;
    let [_, _, missing] = compare(&a, &b);
    assert!(missing * 10 > total, "with a wrong pose {missing} of {total} would be missing");
}

#[test]
fn the_truth_in_colours_view_is_the_same_world_pixel_by_pixel_beside_colour() {
    let cache = tempfile::tempdir().unwrap();
    // Offsets to the side, and a lens that looks elsewhere.
    for (model, size) in [("d455", (640, 480)), ("kinect", (512, 512))] {
        let shots =
            shoot(&camera(model, size.0, size.1, cache.path()), &["color", "depth_true", "depth_true_color"]);
        let [color, truth, mut in_color] = shots.try_into().ok().unwrap();
        assert_eq!((in_color.size(), in_color.on_mount), (color.size(), color.on_mount));
        assert_eq!(in_color.profile.intrinsics, color.profile.intrinsics);
        assert_eq!(in_color.profile.rate_hz, color.profile.rate_hz);
        assert_eq!((in_color.holes(), in_color.profile.depth_unit_m), (0.0, truth.profile.depth_unit_m));
        let [agree, hidden, missing] = compare(&truth, &in_color);
        let total = agree + hidden + missing;
        assert!(total > 100_000 && agree * 100 > total * 90, "{model}: {agree} agree, {hidden} hidden");
        assert!(missing * 1000 < total, "{model}: {missing} of {total} are not there");
        // The comparison would see that it is not in colour's view.
        in_color.on_mount = truth.on_mount;
        let [_, _, missing] = compare(&truth, &in_color);
        assert!(missing * 20 > total, "{model}: with depth's pose {missing} of {total} would be missing");
    }
}

#[test]
fn a_stereo_camera_sees_steps_of_disparity_noise_and_holes() {
    let cache = tempfile::tempdir().unwrap();
    let [depth, truth] =
        shoot(&camera("d405", 848, 480, cache.path()), &["depth", "depth_true"]).try_into().ok().unwrap();
    assert_eq!(truth.holes(), 0.0, "the truth has no holes");
    let holes = depth.holes();
    assert!((0.02..0.6).contains(&holes), "{holes} of the image are holes");

    // Every depth is one of f b / (n / 32), rounded to the unit: equal steps in 1/z.
    let focal_baseline = depth.profile.intrinsics.fx * 0.018;
    let mut inliers = Vec::new();
    let mut levels = std::collections::BTreeSet::new();
    for (x, y) in depth.every_pixel().filter(|(x, y)| depth.counts(*x, *y) > 0) {
        let z = depth.depth_m(x, y);
        let n = (focal_baseline / z * 32.0).round();
        let nearest = (focal_baseline * 32.0 / n / 0.0001).round();
        let off = (nearest - f64::from(depth.counts(x, y))).abs();
        assert!(off <= 1.0, "({x}, {y}): {z} m is not a step of disparity");
        levels.insert(n as u64);
        let wanted = truth.depth_m(x, y);
        if (z / wanted - 1.0).abs() < 0.08 {
            inliers.push((wanted, z - wanted));
        }
    }
    assert!(levels.len() > 100, "{} levels", levels.len());

    // The error grows with z²: the same in disparity near and far.
    let spread = |near: f64, far: f64| {
        let of: Vec<f64> =
            inliers.iter().filter(|(z, _)| (near..far).contains(z)).map(|(_, e)| e * e).collect();
        assert!(of.len() > 2000, "{} pixels between {near} m and {far} m", of.len());
        (of.iter().sum::<f64>() / of.len() as f64).sqrt()
    };
    let near = spread(0.5, 0.65);
    let far = spread(0.95, 1.2);
    assert!(far > 2.0 * near && far < 6.0 * near, "rms {near} m near, {far} m far");
}

#[test]
fn a_time_of_flight_camera_loses_the_dark_and_the_shiny_and_mixes_edges() {
    let cache = tempfile::tempdir().unwrap();
    let [depth, truth] =
        shoot(&camera("kinect", 512, 512, cache.path()), &["depth", "depth_true"]).try_into().ok().unwrap();
    // Outside of the light's circle there is nothing, whatever the truth.
    assert_eq!(
        [depth.counts(3, 3), depth.counts(508, 3), depth.counts(3, 508), depth.counts(508, 508)],
        [0; 4]
    );
    let holes = depth.holes();
    assert!((0.1..0.4).contains(&holes), "{holes}: the corners are 21 % of a square, the rest are things");
    let mut flying = 0;
    let mut seen = 0;
    let mut sum = 0.0;
    for (x, y) in depth.every_pixel().filter(|(x, y)| (1..511).contains(x) && (1..511).contains(y)) {
        let z = depth.depth_m(x, y);
        if z == 0.0 {
            continue;
        }
        seen += 1;
        let around: Vec<f64> = (0..9).map(|i| truth.depth_m(x + i % 3 - 1, y + i / 3 - 1)).collect();
        let (low, high) = around.iter().fold((f64::INFINITY, 0.0f64), |(l, h), z| (l.min(*z), h.max(*z)));
        let is_edge = high - low > 0.1;
        flying += u32::from(is_edge && around.iter().all(|t| (t - z).abs() > 0.02));
        if !is_edge && (z - truth.depth_m(x, y)).abs() < 0.05 {
            sum += z - truth.depth_m(x, y);
        }
    }
    assert!(flying > 100 && flying * 50 < seen, "{flying} flying pixels of {seen}");
    let bias = sum / f64::from(seen);
    assert!((0.0002..0.01).contains(&bias), "light that takes a detour makes things farther: {bias} m");
}

#[test]
fn a_seed_gives_the_same_bytes_with_any_number_of_threads() {
    let one = tempfile::tempdir().unwrap();
    let two = tempfile::tempdir().unwrap();
    let with_threads = |n, config: &SyntheticConfig| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap();
        pool.install(|| prepare(config, &|_, _| ())).unwrap();
    };
    let config = |dir: &Path| SyntheticConfig { poses: 2, ..camera("generic", 160, 120, dir) };
    with_threads(1, &config(one.path()));
    with_threads(3, &config(two.path()));
    let files = |dir: &Path| {
        let mut all: Vec<_> = std::fs::read_dir(dir)
            .unwrap()
            .map(|f| (f.as_ref().unwrap().file_name(), std::fs::read(f.unwrap().path()).unwrap()))
            .collect();
        all.sort();
        all
    };
    assert_eq!(files(one.path()).len(), 3, "colour; depth with its truth; the truth in colour's view");
    assert!(files(one.path()) == files(two.path()));
    let seeded = SyntheticConfig { seed: 2, ..config(one.path()) };
    let a = shoot(&config(one.path()), &["depth"]);
    let b = shoot(&seeded, &["depth"]);
    assert_ne!(a[0].pixels, b[0].pixels, "another seed, other noise");
}

#[test]
fn the_cache_is_used_and_repaired() {
    let dir = tempfile::tempdir().unwrap();
    let config = SyntheticConfig { truth: false, ..camera("generic", 160, 120, dir.path()) };
    let steps = Mutex::new(Vec::new());
    prepare(&config, &|done, total| steps.lock().unwrap().push((done, total))).unwrap();
    let steps = steps.into_inner().unwrap();
    assert_eq!((steps[0], *steps.last().unwrap()), ((0, 2), (2, 2)));
    assert!(steps.windows(2).all(|w| w[0].0 <= w[1].0));

    let inode = |path: &Path| std::os::unix::fs::MetadataExt::ino(&std::fs::metadata(path).unwrap());
    let path = std::fs::read_dir(dir.path()).unwrap().next().unwrap().unwrap().path();
    let made = inode(&path);
    let good = std::fs::read(&path).unwrap();
    prepare(&config, &|_, _| ()).unwrap();
    assert_eq!(inode(&path), made, "a good file is used as it is");
    for bad in [
        good[..good.len() / 2].to_vec(),
        {
            let mut b = good.clone();
            b[20] ^= 1;
            b
        },
        Vec::new(),
    ] {
        std::fs::write(&path, bad).unwrap();
        prepare(&config, &|_, _| ()).unwrap();
        assert!(std::fs::read(&path).unwrap() == good, "a bad one is made anew, byte by byte the same");
    }
}

fn cheap(rate_hz: f64) -> SyntheticConfig {
    let stream = Name::new("depth").unwrap();
    let streams = vec![StreamOverride { stream, size: Some((64, 48)), rate_hz: Some(rate_hz) }];
    SyntheticConfig { cheap: true, streams, ..SyntheticConfig::default() }
}

fn depth_only(backend: &SyntheticBackend) -> Box<dyn Stream> {
    let request = depthrig_driver::StreamRequest::any(Name::new("depth").unwrap());
    backend.open(None).unwrap().start(&[request]).unwrap()
}

#[test]
fn a_wrapping_counter_and_a_fast_clock_still_give_true_times() {
    let mut config = cheap(100.0);
    config.clock.start_ticks = (1 << 32) - 500_000;
    config.clock.drift_ppm = 200.0;
    let backend = SyntheticBackend::new(vec![config]).unwrap();
    let truth = backend.truth("sim-generic").unwrap();
    let mut stream = depth_only(&backend);
    let mut sink = MemorySink::default();
    while sink.frames.len() < 150 {
        stream.poll(Duration::from_millis(50), &mut sink).unwrap();
    }
    let frames: Vec<_> = sink.frames.iter().map(|f| f.1).collect();
    assert!(
        frames[0].device_time < 1 << 32 && frames[149].device_time > 1 << 32,
        "the counter wrapped meanwhile"
    );
    assert!(frames.windows(2).all(|w| w[0].device_time < w[1].device_time));
    assert!(frames.iter().all(|f| f.clock_epoch == frames[0].clock_epoch), "a wrap does not begin an epoch");
    for f in &frames[20..] {
        let true_capture = truth.frame(0, f.arrival).unwrap().capture;
        let off_ns = f.capture_time.since_ns(true_capture);
        // Half the exposure and the least latency stay unknown to a one-way map: 6 ms; jitter on top at first.
        assert!((4_000_000..9_000_000).contains(&off_ns), "{off_ns} ns");
    }
}

#[test]
fn the_schedule_of_the_configuration_happens() {
    let mut config = cheap(200.0);
    let at = |at_s, kind, duration_s, count| ScheduledFault { at_s, kind, duration_s, count };
    config.faults = vec![
        at(0.9, FaultKind::Unplug, 2.0, 1),
        at(0.1, FaultKind::Damaged, 0.0, 3),
        at(0.2, FaultKind::Skip, 0.0, 4),
    ];
    config.clock.reset_at_s = vec![0.6];
    let backend = SyntheticBackend::new(vec![config]).unwrap();
    let mut stream = depth_only(&backend);
    let mut sink = MemorySink::default();
    let e = loop {
        if let Err(e) = stream.poll(Duration::from_millis(20), &mut sink) {
            break e;
        }
    };
    assert_eq!(e.kind(), ErrorKind::Disconnected);
    assert!(e.to_string().contains("sim-generic"), "{e}");
    // A busy computer may leave frames lying until they are lost, damaged ones too: 40 ms are enough.
    let [damaged, lost] = [DropReason::DeviceError, DropReason::DeviceGap].map(|r| sink.drops_of(0).get(r));
    assert!((1..=3).contains(&damaged) && lost >= 4 + (3 - damaged), "{damaged} damaged, {lost} lost");
    let counters: Vec<u64> = sink.frames.iter().map(|f| f.1.device_sequence).collect();
    assert!(counters.windows(2).any(|w| w[1] < w[0]), "the reset restarted the frame counter");
    drop(stream);
    let e = backend.open(None).err().expect("it is unplugged");
    assert_eq!(e.kind(), ErrorKind::NotFound);
    assert!(backend.discover().unwrap().is_empty());
    let deadline = HostTime::now().plus(Duration::from_secs(20));
    while backend.discover().unwrap().is_empty() {
        assert!(!deadline.from_now().is_zero(), "it is not plugged in again");
        std::thread::sleep(Duration::from_millis(20));
    }
    assert_eq!(backend.discover().unwrap().len(), 1);
    assert!(backend.open(None).is_ok());
}

#[test]
fn a_device_is_held_by_one_at_a_time_and_serials_must_differ() {
    let backend = SyntheticBackend::new(vec![cheap(30.0)]).unwrap();
    let held = backend.open(None).unwrap();
    assert_eq!(backend.open(None).err().unwrap().kind(), ErrorKind::Busy);
    drop(held);
    assert!(backend.open(None).is_ok());
    let e = SyntheticBackend::new(vec![cheap(30.0), cheap(60.0)]).unwrap_err();
    assert!(e.to_string().contains("sim-generic"), "{e}");
    let other = SyntheticConfig { serial: "b".into(), ..cheap(30.0) };
    let two = SyntheticBackend::new(vec![cheap(30.0), other]).unwrap();
    let e = two.open(None).err().unwrap();
    assert!(e.to_string().contains("sim-generic, b"), "ambiguous, so the candidates are named: {e}");
}

#[test]
fn a_colour_image_tells_its_number_and_the_mount_moves() {
    let dir = tempfile::tempdir().unwrap();
    let config = SyntheticConfig {
        poses: 3,
        pose_rate_hz: 30.0,
        truth: false,
        ..camera("generic", 192, 108, dir.path())
    };
    let backend = SyntheticBackend::new(vec![config]).unwrap();
    let truth = backend.truth("sim-generic").unwrap();
    let mut stream = backend.open(None).unwrap().start(&[]).unwrap();
    let mut sink = MemorySink::default();
    while sink.delivered(0) < 8 {
        stream.poll(Duration::from_millis(50), &mut sink).unwrap();
    }
    let mut shown = std::collections::BTreeMap::new();
    for (_, meta, pixels) in sink.frames.iter().filter(|f| f.0 == 0) {
        assert_eq!(overlay::read(pixels, 192), Some(meta.device_sequence as u32));
        let pose = truth.frame(0, meta.arrival).unwrap().pose;
        let below_strip = pixels[192 * 3 * 8..].to_vec();
        // The same pose always looks the same, and another one different.
        assert!(shown.entry(pose).or_insert_with(|| below_strip.clone()) == &below_strip);
    }
    assert_eq!(shown.len(), 3);
    let all: Vec<_> = shown.values().collect();
    assert!(all[0] != all[1] && all[1] != all[2]);
}

/// Samples as read against the truth at the time that they claim; the camera is reset and unplugged meanwhile.
#[test]
fn an_imu_measures_the_truth_of_the_moment_that_its_samples_claim() {
    let fault = |at_s, kind| ScheduledFault { at_s, kind, duration_s: 0.2, count: 2 };
    let mut config = SyntheticConfig {
        motion: true,
        faults: vec![
            fault(0.5, FaultKind::Skip),
            fault(1.0, FaultKind::ClockReset),
            fault(1.6, FaultKind::Unplug),
        ],
        ..cheap(30.0)
    };
    config.clock.drift_ppm = 80.0;
    let began = HostTime::now();
    let backend = SyntheticBackend::starting_at(vec![config], began).unwrap();
    let imu = StreamRequest::any(Name::new(imu::STREAM).unwrap());
    let mut sink = MemorySink::default();
    let deadline = began.plus(Duration::from_secs(20));
    for last in [false, true] {
        let device = loop {
            match backend.open(None) {
                Ok(device) => break device,
                Err(e) => assert!(!deadline.from_now().is_zero(), "{e}"),
            }
            std::thread::sleep(Duration::from_millis(20));
        };
        let mut stream = device.start(std::slice::from_ref(&imu)).unwrap();
        assert_eq!(stream.profiles().len(), 1, "asked for alone");
        let enough = if last { sink.delivered(0) + 10 } else { u64::MAX };
        while sink.delivered(0) < enough {
            assert!(!deadline.from_now().is_zero(), "{} batches", sink.delivered(0));
            if stream.poll(Duration::from_millis(50), &mut sink).is_err() {
                break;
            }
        }
    }
    let mut last: Option<(u32, MotionSample)> = None;
    let mut gaps = Vec::new();
    for (_, meta, payload) in &sink.frames {
        let samples: Vec<_> = MotionSample::all_in(payload).collect();
        let newest = samples.last().unwrap();
        assert_eq!((samples.len(), newest.sequence), (8, meta.device_sequence));
        assert_eq!(newest.time(), meta.capture_time);
        for s in samples {
            // The least latency is what a one-way map cannot know; jitter comes on top at first.
            let fits = |late_ns: i64| {
                let (gyro, accel) = imu::truth((s.time_ns - began.ns() - late_ns) as f64 * 1e-9);
                let near = |a: [f64; 3], b: [f32; 3], by| (0..3).all(|i| (a[i] - f64::from(b[i])).abs() < by);
                near(gyro, s.gyro_rad_s, 1e-3) && near(accel, s.accel_m_s2, 1e-2)
            };
            // A map that sees the device start afresh is unsure, and says so.
            let unsure = i64::from(s.uncertainty_ns) / 500_000;
            assert!((-unsure..=unsure + 12).any(|late| fits(late * 500_000)), "{s:?}");
            if let Some((epoch, before)) = last {
                assert!(before.sequence < s.sequence, "numbers rise: {before:?} {s:?}");
                assert!(epoch != meta.clock_epoch || before.time_ns < s.time_ns, "{before:?} {s:?}");
                gaps.extend((s.sequence > before.sequence + 1).then_some(s.sequence - before.sequence - 1));
            }
            last = Some((meta.clock_epoch, s));
        }
    }
    // A busy computer may be too late for more batches of eight.
    let skipped = gaps.iter().any(|gap| *gap >= 16 && gap.is_multiple_of(8));
    assert!(gaps.len() >= 3 && skipped, "two batches skipped, a reset, an unplug: {gaps:?}");
}
