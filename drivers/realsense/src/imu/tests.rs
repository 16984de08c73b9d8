use super::fake::{COLD, FakeImu};
use super::*;
use core::time::Duration;
use depthrig_driver::MemorySink;

fn wait_for(mut ready: impl FnMut() -> bool) {
    let until = HostTime::now().plus(Duration::from_secs(20));
    while !ready() {
        assert!(!until.from_now().is_zero(), "nothing happened");
        std::thread::sleep(Duration::from_millis(1));
    }
}

fn samples(sink: &MemorySink) -> Vec<MotionSample> {
    sink.frames.iter().flat_map(|(_, _, bytes)| MotionSample::all_in(bytes).collect::<Vec<_>>()).collect()
}

/// A driver that is on, with what it handed on.
fn on(fake: &mut FakeImu) -> (Imu, MemorySink) {
    let mut sink = MemorySink::default();
    let mut imu = fake.open(0);
    wait_for(|| {
        imu.drain(&mut sink);
        imu.running.as_ref().is_some_and(|r| r.was_on && !r.is_switching)
    });
    assert!(fake.is_on());
    (imu, sink)
}

#[test]
fn sensors_are_switched_on_with_their_rates_and_off_at_the_end() {
    let mut fake = FakeImu::new();
    let (mut imu, mut sink) = on(&mut fake);
    assert_eq!(fake.text("gyro_3d", "in_anglvel_sampling_frequency"), "4");
    (0..32).for_each(|_| fake.measure(2));
    wait_for(|| {
        imu.drain(&mut sink);
        samples(&sink).len() == 32
    });
    assert!(samples(&sink).iter().all(|s| !s.accel_m_s2[0].is_nan()));
    drop(imu);
    wait_for(|| fake.is_off());
}

#[test]
fn what_was_left_unread_by_somebody_else_is_of_no_stream() {
    let mut fake = FakeImu::new();
    let mut imu = fake.open(0);
    (0..16).for_each(|_| fake.measure(2));
    let mut sink = MemorySink::default();
    wait_for(|| {
        imu.drain(&mut sink);
        imu.running.as_ref().is_some_and(|r| r.was_on)
    });
    (0..16).for_each(|_| fake.measure(2));
    wait_for(|| {
        imu.drain(&mut sink);
        !samples(&sink).is_empty()
    });
    assert_eq!(samples(&sink)[0].device_time, 17 * 2500);
}

/// One sensor of `sensors` goes on, or none.
fn is_revived(still_measuring: usize) {
    let mut fake = FakeImu::new();
    let (mut imu, mut sink) = on(&mut fake);
    (0..16).for_each(|_| fake.measure(2));
    wait_for(|| {
        fake.measure(still_measuring);
        imu.drain(&mut sink);
        fake.is_off()
    });
    let off_since = HostTime::now();
    wait_for(|| {
        imu.drain(&mut sink);
        fake.is_on()
    });
    // It was seen to be off a moment after it was.
    assert!(off_since.elapsed() >= COLD / 4, "{:?}", off_since.elapsed());
    let before = samples(&sink).last().unwrap().sequence;
    fake.skip(100);
    wait_for(|| {
        fake.measure(2);
        imu.drain(&mut sink);
        samples(&sink).last().unwrap().sequence > before + 100
    });
    assert!(imu.running.is_some() && imu.take_end().is_none());
}

#[test]
fn sensors_that_fall_silent_are_switched_off_for_a_while_and_on_again() {
    is_revived(0);
}

#[test]
fn one_sensor_that_falls_silent_is_enough() {
    is_revived(1);
}

#[test]
fn silent_sensors_are_switched_on_as_soon_as_the_kernel_took_their_power() {
    let mut fake = FakeImu::new();
    // Longer than this test waits.
    fake.cold = Duration::from_mins(1);
    let (mut imu, mut sink) = on(&mut fake);
    wait_for(|| {
        imu.drain(&mut sink);
        fake.is_off()
    });
    let power = fake.path().join("power");
    std::fs::create_dir(&power).unwrap();
    std::fs::write(power.join("runtime_status"), "active\n").unwrap();
    std::thread::sleep(Duration::from_millis(200));
    assert!(fake.is_off());
    std::fs::write(power.join("runtime_status"), "suspended\n").unwrap();
    wait_for(|| {
        imu.drain(&mut sink);
        fake.is_on()
    });
}

#[test]
fn the_next_stream_too_leaves_silent_sensors_off_for_a_while() {
    let mut fake = FakeImu::new();
    let (mut imu, mut sink) = on(&mut fake);
    wait_for(|| {
        imu.drain(&mut sink);
        fake.is_off()
    });
    let off_since = HostTime::now();
    drop(imu);
    // Its nodes are free at once, whatever its thread still waits for.
    let mut next = fake.open(0);
    wait_for(|| {
        next.drain(&mut sink);
        fake.is_on()
    });
    assert!(off_since.elapsed() >= COLD / 4, "{:?}", off_since.elapsed());
}

#[test]
fn sensors_that_cannot_be_switched_on_end_with_the_reason() {
    let mut fake = FakeImu::new();
    std::fs::remove_dir(fake.path().join("gyro_3d/buffer")).unwrap();
    let mut imu = fake.open(0);
    let mut sink = MemorySink::default();
    let mut end = None;
    wait_for(|| {
        imu.drain(&mut sink);
        end = end.take().or_else(|| imu.take_end());
        end.is_some()
    });
    let end = end.unwrap();
    assert_eq!(end.kind(), ErrorKind::Disconnected);
    assert!(end.to_string().contains("buffer/enable cannot be set to 0"), "{end}");
}
