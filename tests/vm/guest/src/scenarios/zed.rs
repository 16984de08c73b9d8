//! A ZED 2i under the kernel's drivers: serial, calibration, both images byte by byte, settings, IMU, replug.

use crate::checks::Checks;
use crate::{Scenario, system};
use anyhow::Context;
use depthrig_bus::{ClockDomain, HostTime, Name};
use depthrig_calib::PoseExt;
use depthrig_driver::{Backend, ErrorKind, MemorySink, StreamProfile, StreamRequest};
use depthrig_emulator::{Camera, Options, Stamp};
use depthrig_usb::controls::ControlValue;
use depthrig_usb::{SysRoot, scan};
use depthrig_v4l2::Node;
use depthrig_zed::command::Vendor;
use depthrig_zed::hid::HidNode;
use depthrig_zed::imu::NO_POSE;
use depthrig_zed::mode::Side;
use depthrig_zed::motion::Motion;
use depthrig_zed::{CalibrationFile, ZedBackend, ZedConfig, find};
use glam::{DMat3, DVec3};
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Duration;

/// See the module.
pub const SCENARIO: Scenario = Scenario {
    name: "zed",
    about: "a ZED 2i: serial, calibration, both images byte by byte, exposure and gain, IMU, replug",
    cost: 7,
    limit_s: 90,
    needs: "",
    run,
};

const TIMEOUT: Duration = Duration::from_secs(5);
const SERIAL: &str = "31234567";

fn run(checks: &mut Checks) -> anyhow::Result<()> {
    for module in ["vhci-hcd", "uvcvideo", "usbhid", "hid-generic"] {
        system::modprobe(module, &[])?;
    }
    let camera = Camera::plug("zed2i", Options { serial: Some(SERIAL.into()), ..Options::default() })?;
    let there = || {
        let found = scan(&SysRoot::default()).map(|devices| find::cameras(&SysRoot::default(), &devices));
        found.is_ok_and(|f| {
            let hidraw = |f: &find::FoundCamera| {
                f.motion.as_ref().is_some_and(|m| m.interfaces.iter().any(|i| !i.hidraw_nodes.is_empty()))
            };
            matches!(f.as_slice(), [f] if f.video.video_nodes().count() == 2 && hidraw(f))
        })
    };
    checks.that("both halves are there and belong together", system::wait_until(TIMEOUT, there), "");

    let conf = PathBuf::from(format!("/tmp/SN{SERIAL}.conf"));
    std::fs::write(&conf, camera.calibration().zed_conf())?;
    identity(checks, &camera, &conf)?;
    for (size, frames) in [((672, 376), 12), ((1280, 720), 6)] {
        both_streams(checks, &camera, &conf, size, frames)?;
    }
    motion(checks)?;
    replug(checks, &camera, &conf, there)?;
    wrong_files(checks)
}

fn backend(config: ZedConfig) -> ZedBackend {
    ZedBackend::new(config)
}

fn with_conf(conf: &std::path::Path) -> ZedConfig {
    ZedConfig { calibration: CalibrationFile::At(conf.to_owned()), ..ZedConfig::default() }
}

/// Who the camera is, and that its calibration is the one that it was given.
fn identity(checks: &mut Checks, camera: &Camera, conf: &std::path::Path) -> anyhow::Result<()> {
    let found = backend(with_conf(conf)).discover()?;
    checks.equal("one ZED is found", found.len(), 1);
    let info = found.first().context("no ZED")?;
    checks.equal("its serial", info.serial.as_str(), SERIAL);
    checks.equal("its model", info.model.as_str(), "ZED 2i");
    checks.equal("its port", Some(info.port.clone()), camera.port_path());
    checks.equal("its calibration", info.calibration.clone(), format!("factory {}{NO_POSE}", conf.display()));

    let device = backend(with_conf(conf)).open(Some(SERIAL))?;
    checks.equal("the serial in its flash", device.info().serial.as_str(), SERIAL);
    let mut modes: Vec<_> = device.profiles().iter().map(StreamProfile::describe).collect();
    modes.sort();
    let unit = modes.iter().any(|m| m == "imu motion 400 Hz in batches of up to 16");
    checks.that(
        "it lists its modes for left and right, and its IMU",
        unit && modes.len() == 21,
        modes.join(", "),
    );
    let mut pixels: f64 = 0.0;
    let mut poses: f64 = 0.0;
    for mode in camera.calibration().zed {
        let width = match mode.name {
            "2K" => 2208,
            "FHD" => 1920,
            "HD" => 1280,
            _ => 672,
        };
        for (name, truth) in [("left", mode.left), ("right", mode.right)] {
            let of = |p: &&StreamProfile| p.stream.as_str() == name && p.width == width;
            let profile = device.profiles().iter().find(of).context("no such mode")?;
            let i = profile.intrinsics;
            let read = [i.fx, i.fy, i.cx, i.cy].into_iter().chain(i.coeffs);
            let given = truth.pinhole.into_iter().chain(truth.distortion).chain([0.0; 3]);
            pixels = read.zip(given).map(|(a, b)| (a - b).abs()).fold(pixels, f64::max);
            if name == "right" {
                // p_right = R p_left − t, with R written out by Rodrigues' formula.
                let r = rodrigues(mode.rotation);
                let t = DVec3::from_array(mode.translation_mm) / 1000.0;
                for p in [DVec3::ZERO, DVec3::X, DVec3::new(0.3, -0.2, 2.0)] {
                    let in_right = r * p - t;
                    poses = poses.max((profile.pose_in_device.transform_point(in_right) - p).length());
                }
            }
        }
    }
    checks.that("intrinsics and distortion are those that it was given", pixels < 1e-6, pixels);
    checks.that("and so is the right camera's pose", poses < 1e-9, poses);
    Ok(())
}

fn rodrigues(r: [f64; 3]) -> DMat3 {
    let r = DVec3::from_array(r);
    let angle = r.length();
    let k = r.normalize_or_zero();
    let cross =
        DMat3::from_cols(DVec3::new(0.0, k.z, -k.y), DVec3::new(-k.z, 0.0, k.x), DVec3::new(k.y, -k.x, 0.0));
    DMat3::IDENTITY + cross * angle.sin() + cross * cross * (1.0 - angle.cos())
}

/// Streams left and right with settings, and compares every frame with the one that was sent.
fn both_streams(
    checks: &mut Checks,
    camera: &Camera,
    conf: &std::path::Path,
    size: (u32, u32),
    frames: usize,
) -> anyhow::Result<()> {
    let name = format!("{}x{}", size.0, size.1);
    let config = ZedConfig {
        exposure_percent: Some(37),
        gain_percent: Some(80),
        led: Some(true),
        controls: BTreeMap::from([("brightness".to_owned(), ControlValue::Integer(6))]),
        ..with_conf(conf)
    };
    let backend = backend(config);
    let device = backend.open(None)?;
    let wanted = ["left", "right"].map(|side| -> anyhow::Result<_> {
        Ok(StreamRequest { size: Some(size), rate_hz: Some(30.0), ..StreamRequest::any(Name::new(side)?) })
    });
    let wanted = wanted.into_iter().collect::<anyhow::Result<Vec<_>>>()?;
    let mut stream = device.start(&wanted)?;
    let copied = depthrig_driver::unpack::copied_bytes();
    let mut sink = MemorySink::default();
    let end = HostTime::now().plus(TIMEOUT);
    while sink.frames.len() < 2 * frames && HostTime::now() < end {
        stream.poll(Duration::from_millis(200), &mut sink)?;
    }
    let copied = depthrig_driver::unpack::copied_bytes() - copied;
    let delivered = sink.frames.iter().map(|f| f.2.len() as u64).sum::<u64>();
    let busy = backend.open(None)?.start(&wanted).err();
    checks.that(
        &format!("{name}: a second one gets an error that names the holder"),
        busy.as_ref()
            .is_some_and(|e| e.kind() == ErrorKind::Busy && e.to_string().contains("this process itself")),
        busy.map(|e| e.to_string()).unwrap_or_default(),
    );
    // The settings are written on a thread of their own, 2 ms a command.
    let node = node_of_camera()?;
    let mut vendor = Vendor::new(Node::open(&node)?, "ZED")?;
    let set = system::wait_until(TIMEOUT, || vendor.gain(Side::Right).ok() == Some(Some(80)));
    checks.that(&format!("{name}: gain is read back"), set, "");
    for side in Side::BOTH {
        checks.equal(
            &format!("{name}: exposure of the {side:?} image sensor is read back"),
            vendor.exposure(side, 30.0)?,
            37,
        );
    }
    checks.that(&format!("{name}: the regulation is off"), !vendor.auto_exposure()?, "");
    let node = Node::open(&node)?;
    let controls = node.controls()?;
    let brightness = controls.iter().find(|c| c.name == "brightness").context("no brightness")?;
    checks.equal(&format!("{name}: brightness is read back"), node.read_control(brightness)?, 6);
    let polled = stream.poll(Duration::from_millis(200), &mut sink);
    checks.that(&format!("{name}: and the stream goes on"), polled.is_ok(), format!("{polled:?}"));
    drop(stream);

    let mut equal = 0;
    let mut halves = 0;
    let mut pairs = 0;
    for pair in sink.frames.chunks_exact(2) {
        let [(0, left, left_pixels), (1, right, right_pixels)] = pair else { continue };
        let stamp = Stamp::read(left_pixels).context("a frame without a stamp")?;
        let sent = camera.expected("stereo", stamp.index)?;
        let row = sent.len() / size.1 as usize;
        let half =
            |at: usize| sent.chunks_exact(row).flat_map(|r| r[at..at + row / 2].to_vec()).collect::<Vec<_>>();
        equal += usize::from(*left_pixels == half(0)) + usize::from(*right_pixels == half(row / 2));
        halves += 2;
        let times = (left.capture_time, left.device_sequence) == (right.capture_time, right.device_sequence);
        pairs += usize::from(times && left.clock_domain == ClockDomain::Kernel);
    }
    checks.that(&format!("{name}: enough frames"), halves >= 2 * frames, halves);
    checks.equal(&format!("{name}: images that are byte for byte those that were sent"), equal, halves);
    checks.equal(&format!("{name}: pairs of one time, the kernel's"), pairs, halves / 2);
    checks.equal(&format!("{name}: each byte was copied once"), copied, delivered);
    let lost = [0, 1].map(|i| sink.drops_of(i).total());
    checks.equal(&format!("{name}: nothing is lost"), lost, [0, 0]);
    let warm = |stream: usize, c: f32| {
        sink.frames
            .iter()
            .rev()
            .find(|f| f.0 == stream)
            .is_some_and(|f| (f.1.temperature_c - c).abs() < 0.001)
    };
    checks.that(
        &format!("{name}: frames have their sensor's temperature"),
        warm(0, 38.2) && warm(1, 38.15),
        "",
    );
    Ok(())
}

fn node_of_camera() -> anyhow::Result<PathBuf> {
    let found = find::cameras(&SysRoot::default(), &scan(&SysRoot::default())?);
    let nodes = found.iter().flat_map(|f| f.video.video_nodes());
    for n in nodes {
        if Node::open(&n.path)?.capability().is_capture() {
            return Ok(n.path.clone());
        }
    }
    anyhow::bail!("no capture node")
}

/// Records of the IMU for longer than it stays awake by itself.
fn motion(checks: &mut Checks) -> anyhow::Result<()> {
    let found = find::cameras(&SysRoot::default(), &scan(&SysRoot::default())?);
    let units = found.iter().filter_map(|f| f.motion.as_ref()).flat_map(|m| &m.interfaces);
    let node = units.flat_map(|i| &i.hidraw_nodes).next().context("no HID node")?;
    let began = HostTime::now();
    let motion = Motion::start(Box::new(HidNode::open(node)?), "ZED")?;
    std::thread::sleep(Duration::from_secs(5));
    let tally = motion.tally();
    let latest = motion.latest();
    let expected = began.elapsed().as_secs_f64() * 400.0;
    let enough = (tally.records as f64 - expected).abs() < 0.05 * expected;
    checks.that("400 records a second come for 5 s", enough, format!("{tally:?}, {expected:.0} expected"));
    checks.equal("and each is one", tally.rejected, 0);
    let sample = latest.context("no record")?;
    let g = sample.record.acceleration_m_s2()[1];
    checks.that("gravity is gravity", (g - 9.8189).abs() < 1e-9, g);
    let age = HostTime::now().since_ns(sample.time);
    checks.that(
        "a record's time is the host's",
        (-1_000_000..50_000_000).contains(&age),
        format!("{age} ns ago"),
    );
    checks.equal("nothing went wrong", motion.problem(), None);
    Ok(())
}

/// Pulled while it streams, and plugged in again.
fn replug(
    checks: &mut Checks,
    camera: &Camera,
    conf: &std::path::Path,
    there: impl Fn() -> bool,
) -> anyhow::Result<()> {
    let backend = backend(with_conf(conf));
    let small = [StreamRequest { size: Some((672, 376)), ..StreamRequest::any(Name::new("left")?) }];
    let port = camera.port_path();
    let mut stream = backend.open(Some(SERIAL))?.start(&small)?;
    let mut sink = MemorySink::default();
    let first = HostTime::now().plus(TIMEOUT);
    while sink.frames.is_empty() && HostTime::now() < first {
        stream.poll(Duration::from_millis(200), &mut sink)?;
    }
    camera.unplug()?;
    let pulled = HostTime::now();
    let error = loop {
        match stream.poll(Duration::from_millis(100), &mut sink) {
            Err(e) => break Some(e),
            Ok(_) if pulled.elapsed() > TIMEOUT => break None,
            Ok(_) => {}
        }
    };
    let took = pulled.elapsed();
    checks.that(
        "pulled, it says so at once",
        error.as_ref().is_some_and(|e| e.kind() == ErrorKind::Disconnected)
            && took < Duration::from_millis(500),
        format!("{error:?} after {took:?}"),
    );
    drop(stream);
    camera.replug()?;
    checks.that("plugged in again, both halves are back", system::wait_until(TIMEOUT, there), "");
    checks.equal("at the same port", camera.port_path(), port);
    let mut stream = backend.open(Some(SERIAL))?.start(&small)?;
    let mut sink = MemorySink::default();
    let end = HostTime::now().plus(TIMEOUT);
    while sink.frames.len() < 3 && HostTime::now() < end {
        stream.poll(Duration::from_millis(200), &mut sink)?;
    }
    checks.that("and it streams", sink.frames.len() >= 3, sink.frames.len());
    Ok(())
}

/// A calibration that cannot be used is refused with what to do.
fn wrong_files(checks: &mut Checks) -> anyhow::Result<()> {
    let refused = |path: &str| {
        let config = ZedConfig { calibration: CalibrationFile::At(path.into()), ..ZedConfig::default() };
        backend(config).open(None).err().map(|e| (e.kind(), e.to_string()))
    };
    std::fs::write("/tmp/SN4711.conf", "[LEFT_CAM_HD]\nfx = x\n")?;
    std::fs::write("/tmp/bench.conf", "[LEFT_CAM_HD]\nfx = x\n[RIGHT_CAM_HD]\n")?;
    for (path, wanted) in [
        ("/tmp/SN4711.conf", "is the calibration of the camera 4711, and this one is 31234567"),
        ("/tmp/bench.conf", "/tmp/bench.conf, line 2: [LEFT_CAM_HD] fx = \"x\" is not a number"),
        ("/tmp/none.conf", "https://calib.stereolabs.com/?SN=31234567"),
    ] {
        let got = refused(path);
        let holds =
            got.as_ref().is_some_and(|(kind, text)| *kind == ErrorKind::BadInput && text.contains(wanted));
        checks.that(&format!("{path} is refused"), holds, format!("{got:?}"));
    }
    let device = backend(ZedConfig::default()).open(None)?;
    checks.equal("without a file it is uncalibrated and says so", device.info().calibration.as_str(), "none");
    let known = device.profiles().iter().any(|p| p.intrinsics.is_known());
    checks.that("and has no intrinsics", !known, "");
    Ok(())
}
