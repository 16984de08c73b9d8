//! The driver of an attached Kinect beyond the suite: references, times, choices, messages. Long because the tests
//! share one fake library.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

#[path = "support/kinect.rs"]
mod kinect;

use depthrig_bus::{
    Distortion, DropReason, FrameFlags, HostTime, MetadataLevel, MotionSample, Name, PixelFormat,
};
use depthrig_driver::capture::{Capture, Session, StopOutcome};
use depthrig_driver::{
    Backend, DeviceInfo, Error, ErrorKind, MemorySink, Poll, Result, Stream, StreamRequest,
};
use depthrig_kinect::live::{LiveBackend, LiveConfig, Places};
use depthrig_kinect::{DepthMode, WiredSync};
use depthrig_usb::controls::ControlValue;
use depthrig_usb::fake::{FakeDevice, FakeTree};
use kinect::{Census, Fake};
use std::time::Duration;

const A: &str = "000111111111";
const B: &str = "000222222222";

fn wish(stream: &str, width: u32, height: u32, format: PixelFormat) -> StreamRequest {
    StreamRequest {
        stream: Name::new(stream).unwrap(),
        size: Some((width, height)),
        rate_hz: Some(30.0),
        format: Some(format),
    }
}

fn all_streams(color: PixelFormat) -> [StreamRequest; 3] {
    [
        wish("color", 1280, 720, color),
        wish("depth", 320, 288, PixelFormat::Z16),
        wish("ir", 320, 288, PixelFormat::Mono16),
    ]
}

fn start(config: LiveConfig, serial: &str, requests: &[StreamRequest]) -> Result<Box<dyn Stream>> {
    LiveBackend::new(config).open(Some(serial))?.start(requests)
}

fn error<T>(result: Result<T>) -> Error {
    match result {
        Ok(_) => panic!("it should have been refused"),
        Err(e) => e,
    }
}

/// Polls until stream 0 has `n` more frames, delivered or dropped.
fn poll_frames(stream: &mut dyn Stream, sink: &mut MemorySink, n: u64) {
    let seen = |sink: &MemorySink| sink.captured.first().copied().unwrap_or(0);
    let until = seen(sink) + n;
    let deadline = HostTime::now().plus(Duration::from_secs(20));
    while seen(sink) < until {
        assert!(!deadline.from_now().is_zero(), "no frames");
        stream.poll(Duration::from_millis(50), sink).unwrap();
    }
}

#[test]
fn every_capture_and_every_image_is_given_back() {
    let fake = Fake::new(&[A]);
    for color in [PixelFormat::Mjpeg, PixelFormat::Rgb8, PixelFormat::Yuyv] {
        let mut stream = start(fake.config(), A, &all_streams(color)).unwrap();
        let mut sink = MemorySink::default();
        for trouble in ["half", "wrong_size", "damaged", "repeated", "only_color", "only_depth"] {
            fake.command(A, trouble, 2);
            poll_frames(stream.as_mut(), &mut sink, 3);
        }
        sink.refuse = 4;
        poll_frames(stream.as_mut(), &mut sink, 2);
        let held = fake.census();
        assert_eq!((held.captures, held.images, held.misuse), (0, 0, 0), "{held:?}");
        fake.command(A, "unplug", 200_000_000);
        while stream.poll(Duration::from_millis(50), &mut sink).is_ok() {}
        drop(stream);
        std::thread::sleep(Duration::from_millis(250));
    }
    let Census { cameras, captures, images, all_captures, all_images, misuse } = fake.census();
    assert_eq!((cameras, captures, images, misuse), (0, 0, 0, 0));
    assert!(all_captures >= 60 && all_images >= 150, "{all_captures} {all_images}");
}

#[test]
fn frames_tell_what_the_device_told() {
    let fake = Fake::new(&[A]);
    fake.command(A, "sync_in", 1);
    let config = LiveConfig { sync: WiredSync::Subordinate, subordinate_delay_us: 160, ..fake.config() };
    let mut stream = start(config, A, &all_streams(PixelFormat::Yuyv)).unwrap();
    assert!(stream.profiles().iter().all(|p| p.metadata == MetadataLevel::Full));
    let mut sink = MemorySink::default();
    poll_frames(stream.as_mut(), &mut sink, 5);
    for (of, meta, _) in &sink.frames {
        assert!(meta.flags.has(FrameFlags::HARDWARE_TRIGGERED));
        assert_eq!(meta.exposure_ns, if *of == 0 { 8_330_000 } else { 12_800_000 });
        assert!((meta.temperature_c - 31.5).abs() < 1e-6);
        // The stamp of the end of the transfer, not of our reading it.
        let exposed = fake.exposed(A, meta.arrival).unwrap();
        assert_eq!(meta.arrival.since_ns(exposed), 20_000_000);
    }
    // All three have the device's time of one exposure, which began at 3 s and knows nothing of the host's clock.
    let times: Vec<u64> = sink.frames.iter().take(3).map(|(_, m, _)| m.device_time).collect();
    assert!(times.windows(2).all(|t| t[0] == t[1]), "{times:?}");
    for (_, meta, _) in &sink.frames {
        let exposures = (meta.device_time - 3_000_000) as f64 / 33_333.333;
        assert!((exposures - exposures.round()).abs() < 0.01 && exposures < 1000.0, "{}", meta.device_time);
    }
    fake.command(A, "no_host_stamp", 3);
    sink.frames.clear();
    poll_frames(stream.as_mut(), &mut sink, 5);
    let arrivals: Vec<_> = sink.frames.iter().filter(|f| f.0 == 0).map(|(_, m, _)| m.arrival).collect();
    assert!(arrivals.windows(2).all(|a| a[0] <= a[1]), "an arrival goes never back");
}

#[test]
fn padded_rows_and_captures_in_part_are_read() {
    let fake = Fake::new(&[A]);
    for color in [PixelFormat::Yuyv, PixelFormat::Nv12, PixelFormat::Bgr8] {
        let mut plain = MemorySink::default();
        let mut stream = start(fake.config(), A, &all_streams(color)).unwrap();
        poll_frames(stream.as_mut(), &mut plain, 2);
        drop(stream);
        fake.command(A, "padding", 48);
        let mut padded = MemorySink::default();
        let mut stream = start(fake.config(), A, &all_streams(color)).unwrap();
        poll_frames(stream.as_mut(), &mut padded, 2);
        for i in 0..3 {
            assert!(plain.frames[i].2 == padded.frames[i].2, "{color:?}, stream {i}");
        }
        fake.command(A, "padding", 0);
    }
    let mut stream = start(fake.config(), A, &all_streams(PixelFormat::Mjpeg)).unwrap();
    let mut sink = MemorySink::default();
    poll_frames(stream.as_mut(), &mut sink, 2);
    fake.command(A, "only_depth", 2);
    poll_frames(stream.as_mut(), &mut sink, 4);
    // A slow machine may leave images lying, beside the two that did not come.
    let [color, depth] = [0, 1].map(|of| fake.ledger(A, of).lost);
    assert!(color >= 2);
    assert_eq!((sink.drops_of(0).get(DropReason::DeviceGap), sink.drops_of(1).total()), (color, depth));
    drop(stream);
    // Images of another format than was asked for are dropped, whatever their size.
    for color in [PixelFormat::Yuyv, PixelFormat::Mjpeg, PixelFormat::Bgr8] {
        let mut stream = start(fake.config(), A, &all_streams(color)).unwrap();
        let mut sink = MemorySink::default();
        fake.command(A, "wrong_format", 3);
        poll_frames(stream.as_mut(), &mut sink, 5);
        for i in 0..3 {
            assert_eq!(sink.drops_of(i).get(DropReason::DeviceError), 3, "{color:?}, stream {i}");
        }
        drop(stream);
    }
}

#[test]
fn openings_at_the_same_time_do_not_find_each_other_busy() {
    let fake = Fake::new(&[A, B]);
    fake.command(A, "open_takes", 3_000_000);
    fake.command(B, "open_takes", 3_000_000);
    let open = |serial: &'static str| {
        let config = fake.config();
        move || (0..10).all(|_| LiveBackend::new(config.clone()).open(Some(serial)).is_ok())
    };
    // Whoever comes second must not stay: a camera that is open is busy for the other's request, too, which is not a
    // fault.
    let [a, b] = [open(A), open(B)].map(std::thread::spawn);
    assert!(a.join().unwrap() && b.join().unwrap());
    assert_eq!(fake.census().cameras, 0);
}

#[test]
fn what_is_started_is_what_was_asked_for() {
    let fake = Fake::new(&[A]);
    fake.command(A, "sync_in", 1);
    let config = LiveConfig {
        sync: WiredSync::Subordinate,
        subordinate_delay_us: 160,
        depth_delay_us: -80,
        dark: true,
        ..fake.config()
    };
    let stream = start(config, A, &all_streams(PixelFormat::Yuyv)).unwrap();
    let c = fake.configuration(A).unwrap();
    // 30 Hz, YUY2 at 720p, the narrow view binned; every capture, also one in part; the light stays dark.
    let modes = (c.camera_fps, c.color_format, c.color_resolution, c.depth_mode);
    assert_eq!(modes, (2, fake_k4a::abi::YUY2, 1, 1));
    assert_eq!((c.synchronized_images_only, c.disable_streaming_indicator), (0, 1));
    let wired = (c.wired_sync_mode, c.subordinate_delay_off_master_usec, c.depth_delay_off_color_usec);
    assert_eq!(wired, (2, 160, -80));
    drop(stream);
    let _stream = start(fake.config(), A, &all_streams(PixelFormat::Mjpeg)).unwrap();
    let c = fake.configuration(A).unwrap();
    assert_eq!(
        (c.color_format, c.disable_streaming_indicator, c.wired_sync_mode),
        (fake_k4a::abi::MJPG, 0, 0)
    );
}

#[test]
fn a_failure_is_not_explained_by_what_was_said_of_another_camera() {
    let fake = Fake::new(&[A, B]);
    fake.command(B, "busy", 60_000_000_000);
    fake.command(A, "engine", 2);
    let e = error(start(fake.config(), A, &[]));
    assert!(e.to_string().contains("DISPLAY") && !e.to_string().contains("another program"), "{e}");
}

#[test]
fn intrinsics_and_poses_are_those_of_the_calibration() {
    let fake = Fake::new(&[A]);
    let device = LiveBackend::new(fake.config()).open(None).unwrap();
    assert_eq!(device.info().calibration, "factory");
    assert_eq!(device.info().firmware, "color 1.6.110, depth 1.6.79");
    let find = |stream: &str, size: (u32, u32)| {
        let found =
            device.profiles().iter().find(|p| p.stream.as_str() == stream && (p.width, p.height) == size);
        found.unwrap().clone()
    };
    // By hand from the made numbers: cx 0.5125, cy 0.516, fx 0.4925, fy 0.493 of a sensor of 1024x1024, of which
    // 640x576 begins at 192, 180.
    let narrow = find("depth", (640, 576)).intrinsics;
    let by_hand = [0.5125 * 1024.0 - 192.5, 0.516 * 1024.0 - 180.5, 0.4925 * 1024.0, 0.493 * 1024.0];
    let got = [narrow.cx, narrow.cy, narrow.fx, narrow.fy];
    assert!(got.iter().zip(by_hand).all(|(a, b)| (a - b).abs() < 1e-9), "{got:?} {by_hand:?}");
    assert_eq!(narrow.model, Distortion::Rational as u32);
    // k1, k2, p1, p2, k3 to k6, as OpenCV has them; the calibration has p2 before p1.
    assert_eq!(narrow.coeffs, [0.9, 0.25, 0.000_09, -0.000_03, 0.012, 1.22, 0.4, 0.06]);
    assert_eq!(find("ir", (640, 576)).intrinsics, narrow);
    // Depth as colour sees it is t, and nothing is turned, so colour stands at -t.
    let color = find("color", (1920, 1080)).pose_in_device;
    let off: f64 = color.translation_m.iter().zip([0.032, 0.002, -0.004]).map(|(a, b)| (a - b).abs()).sum();
    assert!(off < 1e-9, "{color:?}");
    drop(device);
    // One that cannot be read is missing, and the camera streams all the same.
    fake.calibration(A, b"{}");
    let device = LiveBackend::new(fake.config()).open(None).unwrap();
    assert_eq!(device.info().calibration, "none");
    assert!(device.profiles().iter().all(|p| p.intrinsics.model == Distortion::Unknown as u32));
    let mut sink = MemorySink::default();
    poll_frames(device.start(&[]).unwrap().as_mut(), &mut sink, 1);
}

#[test]
fn colour_controls_are_checked_set_and_read_back() {
    use ControlValue::{Boolean, Integer, Item};
    let fake = Fake::new(&[A]);
    let with = |controls: &[(&str, ControlValue)]| {
        let color_controls = controls.iter().map(|(n, v)| ((*n).to_owned(), v.clone())).collect();
        start(LiveConfig { color_controls, ..fake.config() }, A, &[]).map(drop)
    };
    with(&[
        ("exposure_us", Integer(3000)),
        ("white_balance_k", Item("auto".into())),
        ("gain", Integer(255)),
        ("backlight_compensation", Boolean(true)),
        ("power_line_frequency", Item("50 Hz".into())),
    ])
    .unwrap();
    // 3000 us is not among the camera's exposures; it takes the next.
    let set = [0, 6, 8, 7, 9].map(|command| fake.control(A, command));
    assert_eq!(set, [8330, -1, 255, 1, 1]);
    let order = fake.set(A);
    assert!(order[0] == 6 && order.len() == 5, "what the camera regulates comes first: {order:?}");
    for (name, value, part) in [
        ("gain", Integer(256), "from 0 to 255"),
        ("white_balance_k", Integer(4505), "in steps of 10"),
        ("brightness", Item("auto".into()), "does not regulate"),
        ("exposure", Integer(1), "exposure_us"),
    ] {
        let e = error(with(&[(name, value)]));
        assert!(e.kind() == ErrorKind::BadInput && e.to_string().contains(part), "{e}");
        assert!(e.to_string().contains(A), "{e}");
    }
    assert_eq!(fake.control(A, 8), 255, "a wrong value changes nothing");
}

#[test]
fn cables_and_delays_are_checked_before_the_start() {
    let fake = Fake::new(&[A]);
    let with = |sync| start(LiveConfig { sync, ..fake.config() }, A, &[]).map(drop);
    let e = error(with(WiredSync::Master));
    assert!(e.to_string().contains("\"Sync out\"") && e.kind().is_transient(), "{e}");
    let e = error(with(WiredSync::Subordinate));
    assert!(e.to_string().contains("\"Sync in\""), "{e}");
    fake.command(A, "sync_out", 1);
    with(WiredSync::Master).unwrap();
    let passive = LiveConfig { depth_mode: Some(DepthMode::PassiveIr), ..fake.config() };
    let mut stream = start(passive, A, &[]).unwrap();
    let mut sink = MemorySink::default();
    poll_frames(stream.as_mut(), &mut sink, 2);
    assert!(sink.delivered(1) > 0 && stream.profiles()[1].describe().starts_with("ir 1024x1024"));
}

#[test]
fn the_one_that_is_meant_is_opened_and_the_others_are_let_go() {
    let fake = Fake::new(&[A, B]);
    let backend = LiveBackend::new(fake.config());
    let serials: Vec<_> = backend.discover().unwrap().into_iter().map(|i| i.serial).collect();
    assert_eq!(serials, [A, B]);
    assert_eq!(backend.open(Some(B)).unwrap().info().serial, B);
    let e = error(backend.open(None));
    assert!(e.kind() == ErrorKind::NotFound && e.to_string().contains(A) && e.to_string().contains(B), "{e}");
    // One that streams is not disturbed by looking for the other.
    let mut stream = start(fake.config(), A, &all_streams(PixelFormat::Yuyv)).unwrap();
    let mut sink = MemorySink::default();
    poll_frames(stream.as_mut(), &mut sink, 2);
    let other = backend.open(Some(B)).unwrap();
    let e = error(backend.open(Some(A)));
    assert_eq!(e.kind(), ErrorKind::Busy, "{e}");
    assert!(e.to_string().contains("libk4a says: "), "{e}");
    poll_frames(stream.as_mut(), &mut sink, 2);
    // A slow machine may leave images lying meanwhile; the camera sent them all, and none came damaged.
    for (i, of) in [(0, 0), (1, 1)] {
        let drops = sink.drops_of(i);
        let ledger = fake.ledger(A, of);
        assert_eq!((sink.delivered(i), drops.get(DropReason::DeviceGap)), (ledger.good, ledger.lost));
        assert_eq!(drops.total(), ledger.lost);
    }
    drop((other, stream));
    fake.command(A, "denied", 1);
    let e = error(backend.open(Some(A)));
    assert!(e.kind() == ErrorKind::PermissionDenied && e.to_string().contains("depthrig install"), "{e}");
    assert_eq!(fake.census().cameras, 0);
}

#[test]
fn a_port_is_looked_up_on_the_bus() {
    let fake = Fake::new(&[A, B]);
    let home = tempfile::tempdir().unwrap();
    let tree = FakeTree::new(home.path());
    for (port, product, serial) in
        [("2-1.1", 0x097c, A), ("2-1.2", 0x097d, A), ("2-3.1", 0x097c, B), ("2-3.2", 0x097d, B)]
    {
        let strings = ["", "", serial];
        let id = (0x045e, product);
        tree.plug(&FakeDevice { id, strings, interfaces: vec![], ..FakeDevice::new(port, 0) });
    }
    let at = |port: &str| {
        let config = LiveConfig { port: Some(port.into()), ..fake.config() };
        LiveBackend::new(config).with_root(tree.root().clone())
    };
    let device = at("2-3.1").open(None).unwrap();
    assert_eq!((device.info().serial.as_str(), device.info().port.as_str()), (B, "2-3.1"));
    let e = error(at("2-9.1").open(None));
    assert!(e.kind() == ErrorKind::NotFound && e.to_string().contains("2-3.1"), "{e}");
    // A serial number that the bus does not show is not there, whoever holds the others.
    let e = error(at("2-3.1").open(Some("000999999999")));
    assert_eq!(e.kind(), ErrorKind::NotFound, "{e}");
    let e = error(at("2-3.1").open(None));
    assert!(e.kind() == ErrorKind::Busy && e.to_string().contains("held by"), "{e}");
}

#[test]
fn without_its_libraries_it_says_what_to_install() {
    let home = tempfile::tempdir().unwrap();
    let nowhere = Places { library: Some(home.path().into()), engine: None };
    let e = error(LiveBackend::new(LiveConfig { places: nowhere, ..LiveConfig::default() }).open(None));
    assert!(e.kind() == ErrorKind::BadInput && e.to_string().contains("libk4a1.4"), "{e}");
    // A library of somebody else's.
    let libc = std::fs::read_dir("/lib/x86_64-linux-gnu").ok().and_then(|entries| {
        entries.flatten().map(|e| e.path()).find(|p| p.file_name().is_some_and(|n| n == "libm.so.6"))
    });
    if let Some(libm) = libc {
        let places = Places { library: Some(libm), engine: None };
        let e = error(LiveBackend::new(LiveConfig { places, ..LiveConfig::default() }).open(None));
        assert!(e.to_string().contains("has no k4a_device_get_installed_count"), "{e}");
    }
    // Depth needs the engine, colour does not. An engine may also lie elsewhere on this computer.
    let fake = Fake::without_engine(&[A]);
    let places = Places { engine: Some(home.path().into()), ..fake.places() };
    let config = LiveConfig { places, ..fake.config() };
    let e = error(start(config.clone(), A, &[]));
    assert!(e.kind() == ErrorKind::BadInput && e.to_string().contains("depth engine"), "{e}");
    start(config, A, &[wish("color", 1280, 720, PixelFormat::Yuyv)]).unwrap();
    // libk4a has its own opinion of the engine.
    let fake = Fake::new(&[A]);
    fake.command(A, "engine", 1);
    let e = error(start(fake.config(), A, &[]));
    assert!(e.kind() == ErrorKind::BadInput && e.to_string().contains("packages.microsoft.com"), "{e}");
    fake.command(A, "engine", 2);
    let e = error(start(fake.config(), A, &[]));
    assert!(e.kind().is_transient() && e.to_string().contains("DISPLAY"), "{e}");
    fake.command(A, "engine", 0);
    start(fake.config(), A, &[]).unwrap();
}

#[test]
fn a_camera_that_hangs_while_it_stops_is_left_behind_in_time() {
    for hang in ["stop_hang", "close_hang"] {
        let fake = Fake::new(&[A]);
        let config = fake.config();
        let capture = Capture::spawn("kinect", move || {
            let stream = start(config, A, &all_streams(PixelFormat::Yuyv))?;
            Ok(Session { info: DeviceInfo::default(), stream, sink: Box::new(MemorySink::default()) })
        })
        .unwrap();
        let deadline = HostTime::now().plus(Duration::from_secs(20));
        while capture.last_frame().is_none() {
            assert!(!deadline.from_now().is_zero());
            std::thread::sleep(Duration::from_millis(5));
        }
        fake.command(A, hang, 1_500_000_000);
        let began = HostTime::now();
        let outcome = capture.stop(Duration::from_millis(400));
        assert!(matches!(outcome, StopOutcome::Abandoned), "{hang}: {outcome:?}");
        assert!(began.elapsed() < Duration::from_millis(1200), "{hang}");
        // The thread ends when libk4a lets it, and gives everything back.
        while fake.census().cameras > 0 {
            assert!(!deadline.from_now().is_zero(), "{hang}");
            std::thread::sleep(Duration::from_millis(20));
        }
        assert_eq!((fake.census().captures, fake.census().images, fake.census().misuse), (0, 0, 0));
    }
}

#[test]
fn a_dead_camera_stays_dead_and_the_next_opening_works() {
    let fake = Fake::new(&[A]);
    let mut stream = start(fake.config(), A, &all_streams(PixelFormat::Yuyv)).unwrap();
    let mut sink = MemorySink::default();
    poll_frames(stream.as_mut(), &mut sink, 1);
    fake.command(A, "unplug", 300_000_000);
    let e = error(stream.poll(Duration::from_millis(100), &mut sink));
    assert!(e.kind() == ErrorKind::Disconnected && e.to_string().contains(A), "{e}");
    let e = error(LiveBackend::new(fake.config()).open(Some(A)));
    assert_eq!(e.kind(), ErrorKind::NotFound, "{e}");
    std::thread::sleep(Duration::from_millis(350));
    assert!(stream.poll(Duration::ZERO, &mut sink).is_err());
    drop(stream);
    let mut again = start(fake.config(), A, &[]).unwrap();
    poll_frames(again.as_mut(), &mut sink, 1);
    // A frame or none, as the machine is fast: it lives.
    assert_ne!(again.poll(Duration::ZERO, &mut sink).unwrap(), Poll::End);
}

/// Every sample that the fake library gave, with its values and its times, while images come too.
#[test]
fn imu_samples_are_those_of_the_device() {
    let fake = Fake::new(&[A]);
    let mut requests = all_streams(PixelFormat::Yuyv).to_vec();
    requests.insert(1, StreamRequest::any(Name::new("imu").unwrap()));
    let mut stream = start(fake.config(), A, &requests).unwrap();
    assert_eq!(stream.profiles()[1].describe(), "imu motion 1600 Hz in batches of up to 64");
    let began = HostTime::now();
    let mut sink = MemorySink::default();
    let batches = |sink: &MemorySink| sink.frames.iter().filter(|f| f.0 == 1).count();
    let mut poll_until = |sink: &mut MemorySink, n: usize| {
        let deadline = HostTime::now().plus(Duration::from_secs(20));
        while batches(sink) < n {
            assert!(!deadline.from_now().is_zero(), "no motion");
            stream.poll(Duration::from_millis(50), sink).unwrap();
        }
    };
    poll_until(&mut sink, 15);
    fake.command(A, "imu_skip", 10);
    poll_until(&mut sink, 30);
    let samples: Vec<_> =
        sink.frames.iter().filter(|f| f.0 == 1).flat_map(|f| MotionSample::all_in(&f.2)).collect();
    let mut lost = 0;
    for pair in samples.windows(2) {
        let a = pair[0];
        let b = pair[1];
        assert!(a.time_ns < b.time_ns && a.sequence < b.sequence);
        assert_eq!(
            b.sequence - a.sequence,
            (b.device_time - a.device_time) / 625,
            "numbers are those of the clock"
        );
        lost += b.sequence - a.sequence - 1;
    }
    // A busy machine may lose more, in the library's own queue.
    assert!(lost >= 10, "{lost} are missing");
    for s in &samples {
        let (rotation, acceleration) = fake_k4a::motion(s.device_time);
        assert_eq!((s.gyro_rad_s, s.accel_m_s2), (rotation, acceleration));
        assert_eq!((s.accel_offset_ns, s.temperature_c), (40_000, 33.5));
        // The unit's clock is that of the images, which began at 3 s.
        assert!((3_000_000..60_000_000).contains(&s.device_time));
        assert!(s.time() > began && s.time() < HostTime::now());
    }
    // The time of a sample is that of its measurement, late by what the transport takes at least: 4 ms.
    let truth = |s: &MotionSample| {
        let color = sink.frames.iter().find(|f| f.0 == 0).unwrap().1;
        let exposed = fake.exposed(A, color.arrival).unwrap();
        exposed.plus_ns((s.device_time as i64 - color.device_time as i64) * 1000)
    };
    let late = |s: &MotionSample| s.time().since_ns(truth(s));
    assert!(
        samples.iter().all(|s| (0..60_000_000).contains(&late(s))),
        "{:?}",
        samples.iter().map(late).max()
    );
    assert_eq!(sink.captured[1], sink.delivered(1));
    // A slow machine may leave images lying, which the camera sent.
    let [color, depth] = [0, 1].map(|of| fake.ledger(A, of).lost);
    assert_eq!((sink.drops_of(0).total(), sink.drops_of(2).total()), (color, depth));

    // It breaks off, and images go on.
    fake.command(A, "imu_ends", 1);
    poll_frames(stream.as_mut(), &mut sink, 5);
    let before = batches(&sink);
    poll_frames(stream.as_mut(), &mut sink, 5);
    assert!(batches(&sink) <= before + 1, "what was left");
    drop(stream);
    assert_eq!(fake.census().misuse, 0);
}

#[test]
fn the_imu_alone_is_refused_and_by_default_it_streams() {
    let fake = Fake::new(&[A]);
    let alone = [StreamRequest::any(Name::new("imu").unwrap())];
    let e = error(start(fake.config(), A, &alone));
    assert_eq!(e.kind(), ErrorKind::Unsupported);
    assert!(e.to_string().contains("runs only while a camera does: ask for color, depth or ir too"), "{e}");
    let stream = start(fake.config(), A, &[]).unwrap();
    let names: Vec<_> = stream.profiles().iter().map(|p| p.stream.as_str()).collect();
    assert_eq!(names, ["color", "depth", "imu"]);
}
