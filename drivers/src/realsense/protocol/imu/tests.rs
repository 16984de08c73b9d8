use super::*;
use crate::realsense::protocol::tables::Header;

/// A table of numbers 1, 2, 3, … with its flags.
fn table(version: [u8; 2], flags: [u8; 2]) -> Vec<u8> {
    let mut numbers = vec![flags[0], flags[1], 0, 0];
    let identity = [1.0f32, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
    let sensors = (0..24u8).map(|n| f32::from(n) + 1.0);
    let all = identity.into_iter().chain([0.01, 0.02, 0.03]).chain(sensors);
    numbers.extend(all.flat_map(f32::to_le_bytes));
    numbers.resize(numbers.len() + 96, 0);
    Header::close(0x20, version, 0, &numbers)
}

fn memory(flags: [u8; 2]) -> Vec<u8> {
    let module = Header::close(0x10, [1, 1], 0, &table([1, 1], flags));
    Header::close(0x09, [1, 1], 0, &module)
}

#[test]
fn both_families_have_the_same_numbers() {
    let d400 = ImuCalibration::parse(&memory([1, 1]), 0x0B3A).unwrap();
    assert_eq!(ImuCalibration::parse(&table([5, 1], [1, 1]), 0x0B64).unwrap(), d400);
    assert_eq!(d400.accelerometer.sensitivity.col(0), DVec3::new(1.0, 2.0, 3.0));
    assert_eq!(d400.accelerometer.bias, DVec3::new(10.0, 11.0, 12.0));
    assert_eq!(d400.gyroscope.bias.x, 22f64.to_radians());
    assert_eq!(d400.pose.translation_m.map(|v| (v * 100.0).round()), [-1.0, -2.0, -3.0]);
    assert!(d400.is_calibrated);
}

#[test]
fn what_a_table_leaves_out_comes_from_the_drawings() {
    let none = ImuCalibration::parse(&memory([0, 0]), 0x0B5C).unwrap();
    assert_eq!(none, ImuCalibration::drawn(0x0B5C));
    assert_eq!(none.pose.translation_m, [0.030_22, -0.007_4, -0.016_02]);
    // At rest and upright, with y down: the reaction to gravity points up. 1000 counts are 1 g.
    let rest = none.acceleration_m_s2([0, -1000, 0]);
    assert!((rest[1] + 9.806_65).abs() < 1e-5 && rest[0] == 0.0, "{rest:?}");
    let turning = none.rotation_rad_s([900_000, 0, 0], 32);
    assert!((f64::from(turning[0]) + core::f64::consts::FRAC_PI_2).abs() < 1e-6, "{turning:?}");
    assert_eq!(none.rotation_rad_s([900, 0, 0], 16), turning);
}

#[test]
fn a_damaged_table_is_refused_whichever_byte_it_is() {
    let whole = memory([1, 1]);
    for at in HEADER..whole.len() {
        let mut damaged = whole.clone();
        damaged[at] ^= 0x10;
        assert!(ImuCalibration::parse(&damaged, 0x0B3A).is_err(), "byte {at}");
    }
    for length in 0..whole.len() {
        assert!(ImuCalibration::parse(&whole[..length], 0x0B3A).is_err(), "{length} bytes");
    }
    // What lies behind the table in the memory is in no checksum.
    assert!(ImuCalibration::parse(&[&whole[..], &[0xFF; 200]].concat(), 0x0B3A).is_ok());
}
