//! The IMU of a D435i where something is in its way: another program, silence, no images beside it. Values are compared in the
//! scenario `librealsense`.

use crate::checks::Checks;
use crate::daemon::{Daemon, datasets};
use crate::subject::{plug, small, wait_for_imu};
use crate::{Scenario, system};
use anyhow::Context;
use core::time::Duration;
use depthrig_bus::{FrameFlags, HostTime, MotionSample, Name};
use depthrig_driver::{Backend, ErrorKind, MemorySink, Stream, StreamRequest};
use depthrig_emulator::{Camera, Fault, ImuSensor, Options};
use depthrig_realsense::RealsenseBackend;
use depthrig_realsense::config::{RealsenseConfig, TransportChoice};
use depthrig_realsense::iio;
use depthrig_recorder::Dataset;
use depthrig_usb::SysRoot;
use std::process::{Command, Stdio};

/// See the module.
pub const SCENARIO: Scenario = Scenario {
    name: "realsense-imu",
    about: "the IMU of a D435i: held by another program, silent and back, without images; what a dataset says of it",
    cost: 16,
    limit_s: 150,
    needs: "",
    run,
};

/// Microseconds from sample to sample.
const PERIOD_US: u64 = 2500;

fn run(checks: &mut Checks) -> anyhow::Result<()> {
    for module in
        ["vhci-hcd", "uvcvideo", "usbhid", "hid-sensor-hub", "hid-sensor-accel-3d", "hid-sensor-gyro-3d"]
    {
        system::modprobe(module, &[])?;
    }
    let camera = plug("d435i", Options { drift_ppm: 20.0, ..Options::default() })?;
    wait_for_imu(checks, "d435i");
    held(checks, &camera)?;
    silent(checks, &camera)?;
    for transport in [TransportChoice::Kernel, TransportChoice::Libusb] {
        alone(checks, &camera, transport)?;
    }
    recorded(checks, &camera)?;
    watched_alone(checks, &camera)
}

fn imu() -> anyhow::Result<StreamRequest> {
    Ok(StreamRequest::any(Name::new("imu")?))
}

fn start(
    camera: &Camera,
    transport: TransportChoice,
    requests: &[StreamRequest],
) -> depthrig_driver::Result<Box<dyn Stream>> {
    let port = camera.port_path();
    let config = RealsenseConfig { port, transport, ..RealsenseConfig::default() };
    RealsenseBackend::new(config).open(Some(camera.serial()))?.start(requests)
}

/// Another program reads the gyroscope.
fn held(checks: &mut Checks, camera: &Camera) -> anyhow::Result<()> {
    let port = camera.port_path().context("no port")?;
    let gyroscope = iio::on_port(&SysRoot::default(), &port).into_iter().find(|s| s.name == "gyro_3d");
    let node = std::fs::File::open(gyroscope.context("no gyroscope")?.node)?;
    let mut other = Command::new("sleep").arg("60").stdin(Stdio::from(node)).spawn()?;
    let requests = [small("depth").context("depth")?, imu()?];
    let refused = start(camera, TransportChoice::Kernel, &requests).err();
    other.kill()?;
    other.wait()?;
    let text = refused.as_ref().map(ToString::to_string).unwrap_or_default();
    let named = format!("(process {})", other.id());
    checks.that(
        "an IMU that another program reads is busy, and the program is named",
        refused.is_some_and(|e| e.kind() == ErrorKind::Busy)
            && text.contains(&named)
            && text.contains("End that"),
        &text,
    );
    let begun = start(camera, TransportChoice::Kernel, &requests);
    checks.done("it starts when that program has ended", begun.map(drop));
    Ok(())
}

/// The samples of stream number `stream`.
fn samples(sink: &MemorySink, stream: usize) -> Vec<MotionSample> {
    let batches = sink.frames.iter().filter(|(s, ..)| *s == stream);
    batches.flat_map(|(_, _, bytes)| MotionSample::all_in(bytes).collect::<Vec<_>>()).collect()
}

/// The sensors fall silent until they have lost their power once.
fn silent(checks: &mut Checks, camera: &Camera) -> anyhow::Result<()> {
    let requests = [small("depth").context("depth")?, imu()?];
    let mut stream = start(camera, TransportChoice::Kernel, &requests)?;
    let mut sink = MemorySink::default();
    let mut is_silent = false;
    let end = HostTime::now().plus(Duration::from_secs(14));
    while HostTime::now() < end {
        stream.poll(Duration::from_millis(100), &mut sink)?;
        if !is_silent && sink.delivered(1) > 40 {
            is_silent = true;
            camera.fault(Fault::ImuSilence(1))?;
        }
    }
    drop(stream);
    let samples = samples(&sink, 1);
    let gaps: Vec<_> = samples.windows(2).filter(|w| w[1].sequence > w[0].sequence + 1).collect();
    let gap_us = |w: &[MotionSample]| w[1].device_time - w[0].device_time;
    let lengths = gaps.iter().map(|w| gap_us(w)).collect::<Vec<_>>();
    let [gap] = gaps[..] else {
        checks.that("a silent IMU is switched off and on again", false, format!("gaps of {lengths:?} us"));
        return Ok(());
    };
    // Two seconds of silence, three to five until the kernel has taken their power away, and what it takes to switch them on.
    let measured_after = samples.iter().filter(|s| s.sequence >= gap[1].sequence).count();
    checks.that(
        "a silent IMU is switched off and on again",
        (5_000_000..9_000_000).contains(&gap_us(gap)) && measured_after > 400,
        format!("silent for {} us, {measured_after} samples after that", gap_us(gap)),
    );
    let missing = gap[1].sequence - gap[0].sequence;
    let by_clock = (gap_us(gap) + PERIOD_US / 2) / PERIOD_US;
    checks.equal("the silence is a gap of as many samples in the numbers", missing, by_clock);
    let depth: Vec<u64> =
        sink.frames.iter().filter(|(s, ..)| *s == 0).map(|(_, meta, _)| meta.device_sequence).collect();
    let whole = depth.windows(2).all(|w| w[1] == w[0] + 1);
    checks.that("no image was lost meanwhile", whole && depth.len() > 350, depth.len());
    Ok(())
}

/// No images are asked for.
fn alone(checks: &mut Checks, camera: &Camera, transport: TransportChoice) -> anyhow::Result<()> {
    let way = format!("{transport:?}").to_lowercase();
    let mut stream = start(camera, transport, &[imu()?])?;
    let names: Vec<_> = stream.profiles().iter().map(|p| p.stream.as_str().to_owned()).collect();
    checks.equal(&format!("{way}: the IMU is delivered alone"), names, ["imu"]);
    let mut sink = MemorySink::default();
    let before = camera.accounts("depth")?.sent;
    let end = HostTime::now().plus(Duration::from_secs(6));
    while HostTime::now() < end {
        stream.poll(Duration::from_millis(100), &mut sink)?;
    }
    drop(stream);
    let truth = camera.imu_samples();
    let mut certain = 0;
    let mut beyond = 0;
    for (_, meta, bytes) in &sink.frames {
        for sample in MotionSample::all_in(bytes).filter(|_| !meta.flags.has(FrameFlags::TIME_UNCERTAIN)) {
            let is_it = |s: &&depthrig_emulator::ImuSample| {
                s.sensor == ImuSensor::Gyroscope && s.ticks == sample.device_time as u32
            };
            certain += 1;
            let off =
                truth.iter().rev().find(is_it).map(|s| sample.time().since_ns(s.captured).unsigned_abs());
            beyond += u32::from(off.is_none_or(|off| off > u64::from(sample.uncertainty_ns) + 50_000));
        }
    }
    checks.that(
        &format!("{way}: its times are within what is stated"),
        beyond == 0 && certain > 1000,
        format!("{beyond} of {certain} are beyond"),
    );
    checks.equal(&format!("{way}: no image was sent"), camera.accounts("depth")?.sent - before, 0);
    Ok(())
}

fn rig(camera: &Camera, streams: &str) -> anyhow::Result<String> {
    let port = camera.port_path().context("no port")?;
    Ok(format!("[[camera]]\nname = \"front\"\nbackend = \"realsense\"\nport = \"{port}\"\n{streams}"))
}

const DEPTH: &str = "[[camera.stream]]\nname = \"depth\"\nwidth = 424\nheight = 240\nrate_hz = 30.0\n";
const IMU: &str = "[[camera.stream]]\nname = \"imu\"\n";

/// The status reports a silent IMU, and a dataset describes its samples.
fn recorded(checks: &mut Checks, camera: &Camera) -> anyhow::Result<()> {
    let daemon = Daemon::start(&rig(camera, &format!("{DEPTH}{IMU}"))?)?;
    daemon.wait_until_streaming()?;
    let path = daemon.record("imu")?;
    std::thread::sleep(Duration::from_secs(2));
    camera.fault(Fault::ImuSilence(1))?;
    let limit = Duration::from_secs(20);
    let warns = |s: &depthrig_daemon::status::RigStatus| {
        s.cameras.iter().flat_map(|c| &c.warnings).any(|w| w.contains("no motion samples of imu"))
    };
    let warned = daemon.wait_for(limit, "a warning of the silence", warns);
    checks.done("the status warns of a silent IMU", warned.map(drop));
    let back = daemon.wait_for(limit, "samples again", |s| !warns(s));
    let reconnects = back.as_ref().map_or(0, |s| s.cameras.iter().map(|c| c.reconnects).sum());
    checks.done("and no longer when it measures again", back.map(drop));
    checks.equal("the camera was not opened again for it", reconnects, 0);
    std::thread::sleep(Duration::from_secs(1));
    daemon.record_stop()?;
    daemon.stop()?;
    let dataset = Dataset::open(&path)?;
    let session = dataset.session();
    let [unit] = &session.motion[..] else {
        checks.that("the dataset has one IMU", false, session.motion.len());
        return Ok(());
    };
    let given = camera.calibration().imu.context("no calibration")?;
    let [x, y, z] = given.accelerometer.bias;
    let said = &unit.calibration;
    checks.that(
        "the dataset says that samples are corrected, and with which numbers",
        said.contains("do not correct them again")
            && said.contains(&format!("b = [{x:?}, {y:?}, {z:?}] m/s^2")),
        said,
    );
    let of_depth = session.streams.first().map(|s| s.calibration.as_str());
    checks.equal("which is said of the IMU alone", of_depth, Some("factory"));
    std::fs::remove_dir_all(datasets())?;
    Ok(())
}

/// A rig of the IMU alone, which falls silent.
fn watched_alone(checks: &mut Checks, camera: &Camera) -> anyhow::Result<()> {
    let daemon = Daemon::start(&rig(camera, IMU)?)?;
    let begun = daemon.wait_until_streaming();
    checks.done("a rig of an IMU alone streams", begun.map(drop));
    camera.fault(Fault::ImuSilence(1))?;
    let limit = Duration::from_secs(20);
    let state = depthrig_daemon::status::CameraState::Streaming;
    let lost = daemon.wait_for(limit, "it is lost", |s| s.cameras.iter().any(|c| c.state != state));
    checks.done("its silence is noticed", lost.map(drop));
    let since = HostTime::now();
    let back = daemon
        .wait_for(limit, "it is back", |s| s.cameras.iter().all(|c| c.state == state && c.reconnects > 0));
    let reconnects = back.as_ref().map_or(0, |s| s.cameras.iter().map(|c| c.reconnects).sum::<u64>());
    checks.done("and it comes back", back.map(drop));
    checks.that("at once", reconnects == 1, format!("{reconnects} times lost, {:?}", since.elapsed()));
    daemon.stop()?;
    Ok(())
}
