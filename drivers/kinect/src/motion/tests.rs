use super::*;
use crate::calibration::MotionCalibration;
use depthrig_bus::MOTION_SAMPLE_BYTES;
use depthrig_driver::MemorySink;
use glam::DVec3;

const TEXT: &[u8] = include_bytes!("../../../../tests/data/kinect_calibration.json");

fn calibration() -> Calibration {
    Calibration::parse(TEXT).unwrap()
}

fn measured(n: u64) -> Measured {
    Measured {
        gyroscope_ns: 400_000_000 + n * 625_000,
        accelerometer_ns: 400_000_000 + n * 625_000 + 12_000,
        rotation: [n as f32, 0.5, -0.25],
        acceleration: [1.0, n as f32, 9.75],
        temperature_c: 30.0,
    }
}

fn unit(speed: f64) -> (Unit, StreamProfile) {
    let p = profile(Some(&calibration()), speed, DeviceClock::microseconds(64), MetadataLevel::Full).unwrap();
    (Unit::new(0, &p, speed), p)
}

fn out(sink: &MemorySink) -> Vec<MotionSample> {
    sink.frames.iter().flat_map(|f| MotionSample::all_in(&f.2)).collect()
}

/// Bunches of samples, each of which is read some time after its newest one was measured: a device whose clock runs 30
/// ppm slow and whose fastest delivery takes 1 ms.
#[test]
fn times_are_right_within_what_they_claim() {
    let (mut u, p) = unit(1.0);
    assert_eq!((p.width, p.rate_hz), (64, 25.0));
    let mut sink = MemorySink::default();
    let t0 = HostTime::from_ns(7_000_000_000);
    let truth = |n: u64| t0.plus_ns((n as f64 * 625_000.0 * 1.000_03).round() as i64);
    let mut n = 0;
    let mut state = 1u64;
    while n < 48_000 {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
        let bunch = 1 + (state >> 59);
        let newest = n + bunch - 1;
        let jitter_ns = (state >> 40) as i64 % 625_000;
        let samples: Vec<_> = (n..=newest).map(measured).collect();
        u.take(&samples, truth(newest).plus_ns(1_000_000 + jitter_ns), |us| us, &mut sink);
        n += bunch;
    }
    u.end(&mut sink);
    let all = out(&sink);
    assert_eq!(all.len() as u64, n);
    let mut within = 0;
    for (i, s) in (0..).zip(&all) {
        let m = measured(i);
        assert_eq!((s.sequence, s.device_time), (i, m.gyroscope_ns / 1000));
        assert_eq!((s.gyro_rad_s, s.accel_m_s2, s.accel_offset_ns), (m.rotation, m.acceleration, 12_000));
        assert_eq!(s.temperature_c, 30.0);
        // The map cannot know the least latency.
        let off = s.time().since_ns(truth(i)) - 1_000_000;
        within += u64::from(off.unsigned_abs() <= u64::from(s.uncertainty_ns));
        if i > 16_000 {
            assert!(s.uncertainty_ns < 300_000, "sample {i} claims {} ns", s.uncertainty_ns);
        }
    }
    assert!(within * 100 >= n * 99, "{within} of {n} are right within what they claim");
    assert!(all.is_sorted_by(|a, b| a.time_ns < b.time_ns), "times rise");
    for (_, meta, payload) in &sink.frames {
        assert!(payload.len() <= 64 * MOTION_SAMPLE_BYTES && meta.capture_time <= meta.arrival);
    }
    assert_eq!(sink.captured[0], sink.delivered(0));
}

#[test]
fn what_comes_twice_is_one_and_what_never_came_is_a_gap() {
    let (mut u, _) = unit(1.0);
    let mut sink = MemorySink::default();
    let samples: Vec<_> = [0, 1, 1, 2, 7, 8].map(measured).into();
    u.take(&samples, HostTime::from_ns(1_000_000_000), |us| us, &mut sink);
    u.end(&mut sink);
    assert_eq!(out(&sink).iter().map(|s| s.sequence).collect::<Vec<_>>(), [0, 1, 2, 7, 8]);
}

/// Numbers go on and times never go back within an epoch when the device's clock does.
#[test]
fn a_clock_that_is_set_back_ends_nothing() {
    let (mut u, _) = unit(1.0);
    let mut sink = MemorySink::default();
    let mut now = HostTime::from_ns(1_000_000_000);
    for bunch in 0..40 {
        now = now.plus_ns(20_000_000);
        let from = if bunch < 20 { 10_000 + 32 * bunch } else { 32 * (bunch - 20) };
        let samples: Vec<_> = (from..from + 32).map(measured).collect();
        u.take(&samples, now, |us| us, &mut sink);
    }
    u.end(&mut sink);
    let all = out(&sink);
    assert_eq!(all.len(), 40 * 32);
    assert!(all.is_sorted_by(|a, b| a.sequence < b.sequence));
    for pair in sink.frames.windows(2) {
        let a = &pair[0].1;
        let b = &pair[1].1;
        assert!(a.clock_epoch < b.clock_epoch || a.capture_time <= b.capture_time);
        assert!(b.capture_time <= b.arrival);
    }
    assert!(sink.frames.last().unwrap().1.clock_epoch > 0, "the map began anew");
}

#[test]
fn the_frame_is_the_accelerometers_and_the_rotation_of_the_gyroscope_is_stated() {
    use depthrig_calib::PoseExt as _;
    let mut c = calibration();
    let a = c.accelerometer.unwrap();
    let g = c.gyroscope.unwrap();
    // A point of the device that the accelerometer sees at its own place.
    let at = pose(Some(&c)).transform_point(DVec3::ZERO);
    assert!(a.sensor_from_device.transform_point(at).length() < 1e-12 && at.length() > 0.01);
    assert_eq!(pose(None), Pose::IDENTITY);
    assert_eq!(gyroscope_in_unit(None), None);
    // The gyroscope is mounted a quarter turn about z from where it was.
    let quarter = Pose {
        rotation_xyzw: DQuat::from_rotation_z(core::f64::consts::FRAC_PI_2).to_array(),
        ..Pose::IDENTITY
    };
    c.gyroscope = Some(MotionCalibration { sensor_from_device: quarter.compose(&g.sensor_from_device) });
    let stated_rotation = gyroscope_in_unit(Some(&c)).unwrap();
    let found = DQuat::from_array(stated_rotation.xyzw) * DVec3::new(3.0, 0.5, -0.25);
    // A rotation about the gyroscope's axes, in those of the accelerometer: back by the quarter turn.
    let within = DQuat::from_array(a.sensor_from_device.rotation_xyzw)
        * DQuat::from_array(g.sensor_from_device.rotation_xyzw).inverse();
    assert!((found - within * DVec3::new(0.5, -3.0, -0.25)).length() < 1e-6, "{found:?}");
    let words = stated("factory", Some(&c));
    assert!(words.starts_with("factory; gyro_rad_s is along") && words.contains("90.0"), "{words}");
    assert_eq!(stated("factory", None), "factory");
    c.accelerometer = None;
    assert_eq!(pose(Some(&c)), c.gyroscope.unwrap().sensor_from_device.inverse());
}
