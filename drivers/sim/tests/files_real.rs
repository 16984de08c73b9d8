//! Real images played by the `files` backend are, pixel for pixel, those of other decoders.
//!
//! The references are the tables in `tests/data`, made by Python: see the scripts beside them. The images
//! themselves are not in the repository; without them these tests fail and say where they look.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use core::time::Duration;
use depthrig_bus::{Distortion, PixelFormat};
use depthrig_driver::{Backend, DeviceInfo, MemorySink, Poll, StreamProfile};
use depthrig_sim::files::{FilesBackend, FilesConfig};
use std::path::{Path, PathBuf};

fn tables() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/data")
}

fn data() -> PathBuf {
    let default = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data");
    let root =
        std::env::var_os("DEPTHRIG_TEST_DATA").filter(|v| !v.is_empty()).map_or_else(default, PathBuf::from);
    assert!(
        root.join("lingbot_depth").is_dir() && root.is_absolute(),
        "the real test images are not in {}: set DEPTHRIG_TEST_DATA to the absolute path of a folder that holds \
         lingbot_depth and cdm_d405 (their sources are named in tests/data/*.toml)",
        root.display()
    );
    root
}

/// Plays a manifest of `tests/data` for two rounds.
fn play(manifest: &str) -> (DeviceInfo, Vec<StreamProfile>, Vec<Vec<u8>>) {
    data();
    let device = FilesBackend::new(FilesConfig::new(tables().join(manifest))).open(None).unwrap();
    let info = device.info().clone();
    let mut stream = device.start(&[]).unwrap();
    let mut sink = MemorySink::default();
    while sink.frames.len() < 4 {
        assert_ne!(stream.poll(Duration::from_secs(10), &mut sink).unwrap(), Poll::End);
    }
    let frames: Vec<_> = sink.frames.into_iter().map(|f| f.2).collect();
    assert_eq!(frames[0], frames[2], "{manifest}: color of the second round");
    assert_eq!(frames[1], frames[3], "{manifest}: depth of the second round");
    (info, stream.profiles().to_vec(), frames)
}

/// CRC-32 of ISO 3309, as zlib and PNG have it.
fn crc32(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(!0, |crc: u32, byte| {
        (0..8).fold(crc ^ u32::from(*byte), |c, _| if c & 1 == 1 { (c >> 1) ^ 0xEDB8_8320 } else { c >> 1 })
    })
}

fn rows(table: &str) -> Vec<Vec<String>> {
    let text = std::fs::read_to_string(tables().join(table)).unwrap();
    text.lines().skip(1).map(|l| l.split(',').map(str::to_owned).collect()).collect()
}

#[track_caller]
fn check(file: &str, profile: &StreamProfile, pixels: &[u8]) {
    let rows = rows("reference_pixels.csv");
    let row = rows.iter().find(|r| r[0] == file).expect(file);
    let bytes_per_pixel = if profile.format == PixelFormat::Rgb8 { 3 } else { 2 };
    let seen = [profile.width, profile.height, bytes_per_pixel].map(|n| n.to_string());
    assert_eq!(seen[..], row[1..4], "{file}");
    assert_eq!(pixels.len(), profile.frame_bytes());
    assert_eq!(format!("{:08x}", crc32(pixels)), row[4], "{file}");
}

fn lingbot(i: usize, color: &str, fx: f64, cy: f64) {
    let (info, profiles, frames) = play(&format!("lingbot_{i}.toml"));
    assert_eq!(info.serial, format!("lingbot-{i}"));
    check(&format!("lingbot_depth/{i}/{color}"), &profiles[0], &frames[0]);
    assert_eq!((profiles[1].format, profiles[1].depth_unit_m), (PixelFormat::Z16, 0.001));
    check(&format!("lingbot_depth/{i}/raw_depth.png"), &profiles[1], &frames[1]);
    for k in [&profiles[0].intrinsics, &profiles[1].intrinsics] {
        assert_eq!((k.fx, k.cy, k.distortion()), (fx, cy, Distortion::None));
    }
}

#[test]
fn lingbot_0() {
    lingbot(0, "rgb.png", 460.139_587, 237.396_271);
}

#[test]
fn lingbot_1() {
    lingbot(1, "rgb.jpg", 461.275_726_318_359_4, 241.524_337_768_554_7);
}

#[test]
fn lingbot_2() {
    lingbot(2, "rgb.png", 460.139_587, 237.396_271);
}

#[test]
fn lingbot_3() {
    lingbot(3, "rgb.jpg", 461.275_726_318_359_4, 241.524_337_768_554_7);
}

#[test]
fn cdm_d405() {
    let (info, profiles, frames) = play("cdm_d405.toml");
    assert_eq!((info.model.as_str(), info.serial.as_str()), ("D405", "cdm-26"));
    check("cdm_d405/color_26.png", &profiles[0], &frames[0]);
    assert_eq!((profiles[1].format, profiles[1].depth_unit_m), (PixelFormat::Z16, 0.0001));
    check("cdm_d405/depth_26.png", &profiles[1], &frames[1]);
    // Counted in the source when the data was taken in: 4314 saturated pixels.
    let saturated = frames[1].chunks_exact(2).filter(|p| *p == [0xFF, 0xFF]).count();
    assert_eq!(saturated, 4314);
}
