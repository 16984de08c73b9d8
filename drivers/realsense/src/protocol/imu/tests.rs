use super::*;
use crate::protocol::tables::Header;

/// A table of numbers 0.1, 0.2, 0.3, … with its flags.
fn table(version: [u8; 2], flags: [u8; 2]) -> Vec<u8> {
    let mut numbers = vec![flags[0], flags[1], 0, 0];
    let identity = [1.0f32, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
    let sensors = (0..24u8).map(|n| (f32::from(n) + 1.0) / 10.0);
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
    let three = |values: [f32; 3]| DVec3::from_array(values.map(f64::from));
    assert_eq!(d400.accelerometer.sensitivity.col(0), three([0.1, 0.2, 0.3]));
    assert_eq!(d400.accelerometer.bias, three([1.0, 1.1, 1.2]));
    assert_eq!(d400.gyroscope.bias.x, f64::from(2.2f32).to_radians());
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
    // The bytes behind the table in the memory are in no checksum.
    assert!(ImuCalibration::parse(&[&whole[..], &[0xFF; 200]].concat(), 0x0B3A).is_ok());
}

/// Puts one number of a table's 36 in place of what was there: 0 to 8 rotation, 9 to 11 translation, then the sensors.
fn with_number(at: usize, value: f32) -> Vec<u8> {
    let mut whole = table([5, 1], [1, 1]);
    let place = HEADER + 4 + 4 * at;
    whole[place..place + 4].copy_from_slice(&value.to_le_bytes());
    let sum = crc32fast::hash(&whole[HEADER..]).to_le_bytes();
    whole[12..16].copy_from_slice(&sum);
    whole
}

#[test]
fn numbers_that_no_sensor_has_are_refused_and_named() {
    for (at, value, part) in [
        (0, 0.0, "rotation"),
        (4, f32::NAN, "rotation"),
        (8, -1.0, "rotation"),
        (9, 2.0, "offset"),
        (11, f32::INFINITY, "offset"),
        (12, f32::NAN, "accelerometer"),
        (20, -11.0, "accelerometer"),
        (23, 1e30, "accelerometer"),
        (24, f32::NEG_INFINITY, "gyroscope"),
        (35, 101.0, "gyroscope"),
    ] {
        let refused = ImuCalibration::parse(&with_number(at, value), 0x0B64);
        let text = refused.expect_err(&format!("number {at}: {value}")).to_string();
        assert!(text.contains(part), "number {at}: {text}");
    }
    assert!(ImuCalibration::parse(&with_number(12, 1.02), 0x0B64).is_ok());
}

/// The statement holds enough to get the measured values back.
#[test]
fn what_is_stated_of_the_correction_undoes_it() {
    let identity = |at: usize| if (at - 12).is_multiple_of(4) { 1.0 } else { 0.01 * at as f32 };
    let mut whole = table([5, 1], [1, 1]);
    for at in (12..21).chain(24..33) {
        let value = identity(if at < 21 { at } else { at - 12 });
        let place = HEADER + 4 + 4 * at;
        whole[place..place + 4].copy_from_slice(&value.to_le_bytes());
    }
    let sum = crc32fast::hash(&whole[HEADER..]).to_le_bytes();
    whole[12..16].copy_from_slice(&sum);
    let calibration = ImuCalibration::parse(&whole, 0x0B64).unwrap();
    let stated = calibration.stated();
    assert!(stated.contains("corrected") && stated.contains("do not correct them again"), "{stated}");
    for (word, corrected, measured) in [
        (
            "of accel_m_s2",
            calibration.acceleration_m_s2([100, -1000, 30]),
            [-0.1 * GRAVITY, -GRAVITY, -0.03 * GRAVITY],
        ),
        (
            "of gyro_rad_s",
            calibration.rotation_rad_s([10_000, 20_000, -30_000], 32),
            [-1.0, 2.0, 3.0].map(f64::to_radians),
        ),
    ] {
        let (_, rest) = stated.split_once(word).unwrap();
        let numbers: Vec<f64> =
            rest.split(['[', ']', ',', ' ']).filter_map(|part| part.parse().ok()).take(12).collect();
        let rows: [f64; 9] = numbers[..9].try_into().unwrap();
        let sensitivity = DMat3::from_cols_array(&rows).transpose();
        let bias = DVec3::from_slice(&numbers[9..]);
        let undone = sensitivity.inverse() * (DVec3::from_array(corrected.map(f64::from)) + bias);
        let off = (undone - DVec3::from_array(measured)).length();
        assert!(off < 1e-5, "{word}: {undone} and not {measured:?}; {stated}");
    }
    assert!(ImuCalibration::drawn(0x0B64).stated().contains("not corrected"));
}
