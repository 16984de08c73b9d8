//! The IMU: samples of the library and of the driver against what the emulated sensors counted.
//!
//! Expected values are computed here from the counts and the calibration that the camera was given.

use super::Subject;
use super::vendor::{entries, numbers, text, whole};
use core::time::Duration;
use depthrig_bus::{FrameFlags, HostTime, MotionSample, Name};
use depthrig_driver::{Backend, MemorySink, StreamRequest};
use depthrig_emulator::model::ImuChip;
use depthrig_emulator::{Fault, ImuSample, ImuSensor};
use depthrig_realsense::RealsenseBackend;
use depthrig_realsense::config::{RealsenseConfig, TransportChoice};
use serde_json::{Value, json};

/// Standard gravity, m/s².
const GRAVITY: f64 = 9.806_65;
const SAMPLES: u64 = 60;
/// Numbers of 32 bits through two multiplications.
const CLOSE: f64 = 2e-5;

/// The true value of a sample, in m/s² or rad/s along the axes of the depth camera.
pub fn expected(subject: &Subject<'_>, sample: &ImuSample) -> Option<[f64; 3]> {
    let given = subject.camera.calibration().imu?;
    // Firmware of a D400 counts tenths of a thousandth of a degree per second, that of an L515 tenths.
    let degree: f64 = if subject.is_l515() { 0.1 } else { 0.0001 };
    let (axes, unit, bias) = match sample.sensor {
        ImuSensor::Accelerometer => (given.accelerometer, 0.001 * GRAVITY, 1.0),
        ImuSensor::Gyroscope => (given.gyroscope, degree.to_radians(), 1f64.to_radians()),
    };
    let [x, y, z] = sample.counts.map(f64::from);
    // The IMU sits turned about y by half a turn.
    let turned = [-x * unit, y * unit, -z * unit];
    Some(core::array::from_fn(|row| {
        let sum: f64 =
            (0..3).map(|column| f64::from(axes.sensitivity[3 * row + column]) * turned[column]).sum();
        sum - f64::from(axes.bias[row]) * bias
    }))
}

/// Whether a value is the expected one; the tolerance grows with what was added up.
pub fn is_close(got: &[f64], wanted: [f64; 3]) -> bool {
    let size = wanted.iter().map(|v| v.abs()).fold(1.0, f64::max);
    got.len() == 3 && got.iter().zip(wanted).all(|(a, b)| (a - b).abs() <= CLOSE * size)
}

pub fn compare(subject: &mut Subject<'_>, reported: &Value) -> anyhow::Result<()> {
    intrinsics(subject, reported);
    rates(subject, reported);
    // A BMI055 measures acceleration at a rate that is no part of that of rotation.
    let accel = if subject.camera.model().imu == Some(ImuChip::Bmi055) { 250 } else { 400 };
    library(subject, accel, 400)?;
    let backend = subject.backend();
    driver(subject, backend.as_ref(), "driver", accel)?;
    if subject.is_l515() {
        return Ok(());
    }
    // The sensors stay with the kernel when libusb takes the images.
    let transport = TransportChoice::Libusb;
    let config =
        RealsenseConfig { port: subject.camera.port_path(), transport, ..RealsenseConfig::default() };
    driver(subject, &RealsenseBackend::new(config), "driver by libusb", accel)
}

/// Rates follow from the chip (GVD of a D400).
fn rates(subject: &mut Subject<'_>, reported: &Value) {
    let profiles = entries(&reported["sensors"]).iter().flat_map(|s| entries(&s["profiles"]));
    let mut rates: Vec<(String, u64)> = profiles
        .filter(|p| matches!(text(p, "stream"), "accel" | "gyro"))
        .map(|p| (text(p, "stream").to_owned(), whole(p, "rate")))
        .collect();
    rates.sort();
    rates.dedup();
    let wanted: &[(&str, u64)] = if subject.camera.model().imu == Some(ImuChip::Bmi055) {
        &[("accel", 63), ("accel", 250), ("gyro", 200), ("gyro", 400)]
    } else if subject.is_l515() {
        &[("accel", 100), ("accel", 200), ("accel", 400), ("gyro", 100), ("gyro", 200), ("gyro", 400)]
    } else {
        &[("accel", 100), ("accel", 200), ("accel", 400), ("gyro", 200), ("gyro", 400)]
    };
    let same = rates.iter().map(|(s, r)| (s.as_str(), *r)).eq(wanted.iter().copied());
    subject.that("the IMU's rates", same, format!("{rates:?}"));
}

fn intrinsics(subject: &mut Subject<'_>, reported: &Value) {
    let Some(given) = subject.camera.calibration().imu else { return };
    for (name, axes, unit) in
        [("accel 0", &given.accelerometer, 1.0), ("gyro 0", &given.gyroscope, 1f64.to_radians())]
    {
        let mut off = 0.0f64;
        let mut compared = 0;
        for (row, said) in entries(&reported["motion"][name]).iter().enumerate() {
            let said = numbers(said);
            let bias = f64::from(axes.bias.get(row).copied().unwrap_or(f32::NAN)) * unit;
            let wanted = axes.sensitivity.iter().skip(3 * row).take(3).map(|v| f64::from(*v)).chain([bias]);
            for (a, b) in said.iter().zip(wanted) {
                off = off.max((a - b).abs());
                compared += 1;
            }
        }
        subject.that(
            &format!("the library reads the calibration of {name}"),
            compared == 12 && off < 1e-6,
            format!("{off:.1e}"),
        );
    }
}

/// The driver's samples: rotation and acceleration at the microseconds of the camera's clock, times on the host's clock within
/// what is stated, and a gap in the numbers where samples were lost.
fn driver(subject: &mut Subject<'_>, backend: &dyn Backend, what: &str, accel: u64) -> anyhow::Result<()> {
    const LOST: u64 = 5;
    let size = if subject.is_l515() { (320, 240) } else { (424, 240) };
    let depth =
        StreamRequest { size: Some(size), rate_hz: Some(30.0), ..StreamRequest::any(Name::new("depth")?) };
    let requests = [depth, StreamRequest::any(Name::new("imu")?)];
    let mut stream = backend.open(Some(subject.camera.serial()))?.start(&requests)?;
    let names: Vec<_> = stream.profiles().iter().map(|p| p.stream.as_str().to_owned()).collect();
    let mut sink = MemorySink::default();
    let end = HostTime::now().plus(Duration::from_secs(6));
    let mut is_cut = false;
    while HostTime::now() < end {
        stream.poll(Duration::from_millis(100), &mut sink)?;
        if !is_cut && sink.delivered(1) > 40 {
            is_cut = true;
            subject.camera.fault(Fault::ImuSkip(LOST as u32))?;
        }
    }
    drop(stream);
    subject.that(&format!("{what}: depth and imu stream"), names == ["depth", "imu"], format!("{names:?}"));
    let truth = subject.camera.imu_samples();
    let find =
        |sensor: ImuSensor, ticks: u32| truth.iter().rev().find(|s| s.sensor == sensor && s.ticks == ticks);
    let mut tally = [0u64; 4];
    let [samples, rotations, accelerations, with_acceleration] = &mut tally;
    let mut beyond = 0u64;
    let mut certain = 0u64;
    let mut gaps = Vec::new();
    let mut last: Option<u64> = None;
    for (_, meta, bytes) in sink.frames.iter().filter(|(s, ..)| *s == 1) {
        for sample in MotionSample::all_in(bytes) {
            *samples += 1;
            if let Some(missing) = last.map(|last| sample.sequence - last - 1).filter(|n| *n > 0) {
                gaps.push(missing);
            }
            last = Some(sample.sequence);
            let ticks = sample.device_time as u32;
            let close = |got: [f32; 3], s: &ImuSample| {
                expected(subject, s).is_some_and(|wanted| is_close(&got.map(f64::from), wanted))
            };
            let Some(measured) = find(ImuSensor::Gyroscope, ticks) else { continue };
            *rotations += u64::from(close(sample.gyro_rad_s, measured));
            if !meta.flags.has(FrameFlags::TIME_UNCERTAIN) {
                certain += 1;
                let off = sample.time().since_ns(measured.captured).unsigned_abs();
                beyond += u64::from(off > u64::from(sample.uncertainty_ns) + 50_000);
            }
            if sample.accel_m_s2[0].is_nan() {
                continue;
            }
            *with_acceleration += 1;
            let then = ticks.wrapping_add_signed(sample.accel_offset_ns / 1000);
            let measured = find(ImuSensor::Accelerometer, then);
            *accelerations += u64::from(measured.is_some_and(|s| close(sample.accel_m_s2, s)));
        }
    }
    let [samples, rotations, accelerations, with_acceleration] = tally;
    let detail = format!(
        "{rotations} rotations of {samples} samples, {accelerations} accelerations of {with_acceleration}"
    );
    let share = with_acceleration as f64 / samples as f64;
    let holds = samples > 1000
        && rotations == samples
        && accelerations == with_acceleration
        && (share - accel as f64 / 400.0).abs() < 0.03;
    subject.that(&format!("{what}: samples are what was measured, at their times"), holds, detail);
    let detail = format!("{beyond} of {certain} are beyond");
    subject.that(
        &format!("{what}: the host's times are within what is stated"),
        beyond == 0 && certain > 500,
        detail,
    );
    subject.that(
        &format!("{what}: lost samples are a gap in the numbers"),
        gaps == [LOST],
        format!("{gaps:?}"),
    );
    Ok(())
}

fn library(subject: &mut Subject<'_>, accel: u64, gyro: u64) -> anyhow::Result<()> {
    let wanted = |stream: &str, rate: u64| json!({ "stream": stream, "rate": rate });
    let sensors =
        json!([{ "sensor": "Motion Module", "profiles": [wanted("accel", accel), wanted("gyro", gyro)] }]);
    let request = json!({ "do": "stream", "sensors": sensors, "frames": SAMPLES, "seconds": 12.0, "file": "/tmp/librealsense-imu.bin" });
    let answer = subject.vendor.ask(&request)?;
    let truth = subject.camera.imu_samples();
    for (stream, sensor) in [("accel", ImuSensor::Accelerometer), ("gyro", ImuSensor::Gyroscope)] {
        let mut frames = 0;
        let mut same = 0;
        let mut first_wrong = String::new();
        for frame in entries(&answer["frames"]).iter().filter(|f| text(f, "stream") == stream) {
            frames += 1;
            let ticks = whole(&frame["metadata"], "frame_timestamp");
            let sample = truth.iter().find(|s| s.sensor == sensor && u64::from(s.ticks) == ticks);
            let wanted = sample.and_then(|s| expected(subject, s));
            if wanted.is_some_and(|wanted| is_close(&numbers(&frame["value"]), wanted)) {
                same += 1;
            } else if first_wrong.is_empty() {
                first_wrong = format!("; {frame} and not {wanted:?}");
            }
        }
        let holds = frames >= SAMPLES && same == frames;
        subject.that(
            &format!("library: samples of {stream} at their times"),
            holds,
            format!("{same} of {frames}{first_wrong}"),
        );
    }
    Ok(())
}
