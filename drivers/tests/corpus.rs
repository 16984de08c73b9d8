//! The corpus of the fuzz targets of what devices send, as tests: what a fuzzer once found interesting or broken stays
//! mended.
#![allow(clippy::unwrap_used)]

use depthrig_corpus::inputs;
use depthrig_drivers::fuzzing::{external, kinect, realsense};
use depthrig_drivers::zed;

/// Changes an input by up to four bytes, by cutting it, or by repeating a part of it.
fn mutated(bytes: &[u8], mut seed: u64) -> Vec<u8> {
    let mut next = |below: usize| {
        seed ^= seed << 13;
        seed ^= seed >> 7;
        seed ^= seed << 17;
        (seed >> 11) as usize % below.max(1)
    };
    let mut out = bytes.to_vec();
    for _ in 0..=next(4) {
        let at = next(out.len());
        let value = [0, 0xFF, 0x80, 0x7F, next(256) as u8][next(5)];
        match next(8) {
            0 => out.truncate(at),
            1 => {
                let part = out.get(at..(at + next(40)).min(out.len())).unwrap_or_default().to_vec();
                out.splice(at.min(out.len())..at.min(out.len()), part);
            }
            _ => out.iter_mut().skip(at).take(1 + next(4)).for_each(|b| *b = value),
        }
    }
    out
}

/// Changed inputs for each that is kept: 300, and with `DEPTHRIG_LONG=1` so many that it takes minutes.
fn mutations() -> u64 {
    if std::env::var_os("DEPTHRIG_LONG").is_some() { 100_000 } else { 300 }
}

/// Runs each input that is kept for `target`, and sees that the seeds still reach what they were made for.
fn run(target: &str, reached: impl Fn(&[u8]) -> u64) {
    let mut seeds = 0;
    for input in inputs(target) {
        println!("{target}/{}", input.name);
        let far = reached(&input.bytes);
        for n in 1..=mutations() {
            reached(&mutated(&input.bytes, n.wrapping_mul(0x9E37_79B9_7F4A_7C15)));
        }
        if input.is_seed() {
            seeds += 1;
            assert!(far > 0, "{target}/{} reaches nothing: write the seeds again", input.name);
        }
    }
    assert!(seeds > 0, "{target} has no seeds");
}

#[test]
fn messages_of_a_process_that_serves_a_camera() {
    run("external", external::handshake);
}

#[test]
fn kinect_mkv() {
    run("kinect_mkv", kinect::recording);
}

#[test]
fn kinect_calibration() {
    run("kinect_calibration", kinect::calibration);
}

#[test]
fn realsense_hwm() {
    run("realsense_hwm", realsense::hwm);
}

#[test]
fn realsense_gvd() {
    run("realsense_gvd", realsense::gvd);
}

#[test]
fn realsense_tables() {
    run("realsense_tables", realsense::tables);
}

#[test]
fn realsense_metadata() {
    run("realsense_metadata", realsense::metadata);
}

#[test]
fn realsense_l515() {
    run("realsense_l515", realsense::l515);
}

#[test]
fn realsense_imu() {
    run("realsense_imu", realsense::imu);
}

#[test]
fn realsense_preset() {
    run("realsense_preset", realsense::preset);
}

#[test]
fn svo2_files_of_a_zed() {
    run("zed_svo2", zed::replay::svo2::fuzz);
}
