//! The Kinect driver keeps every promise of the suite, against a fake libk4a.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

#[path = "support/kinect.rs"]
mod kinect;

use depthrig_bus::{Name, PixelFormat};
use depthrig_driver::{StreamRequest, unpack};
use depthrig_kinect::live::LiveBackend;
use depthrig_sim::conformance::{self, Bench, Subject};
use fake_k4a::{abi, images};
use kinect::{Fake, TestRig};
use std::sync::Mutex;

const SERIAL: &str = "000123456789";
const COLOR: (u32, u32) = (1280, 720);
const DEPTH: (u32, u32) = (320, 288);

/// A Kinect whose colour comes in a format.
struct Live(PixelFormat);

impl Subject for Live {
    fn name(&self) -> String {
        format!("kinect, colour as {}", self.0.name())
    }

    fn make(&self) -> Bench {
        let fake = Fake::new(&[SERIAL]);
        let request = |name, size, format| StreamRequest {
            stream: Name::new(name).unwrap(),
            size: Some(size),
            rate_hz: Some(30.0),
            format: Some(format),
        };
        let requests = vec![
            request("color", COLOR, self.0),
            request("depth", DEPTH, PixelFormat::Z16),
            request("ir", DEPTH, PixelFormat::Mono16),
        ];
        let backend = Box::new(LiveBackend::new(fake.config()));
        let is_genuine = match self.0 {
            PixelFormat::Mjpeg => |s: usize, p: &[u8]| judge(abi::MJPG, s, p),
            PixelFormat::Nv12 => |s: usize, p: &[u8]| judge(abi::NV12, s, p),
            PixelFormat::Yuyv => |s: usize, p: &[u8]| judge(abi::YUY2, s, p),
            PixelFormat::Bgr8 => {
                |s: usize, p: &[u8]| if s == 0 { is_without_alpha(p) } else { judge(0, s, p) }
            }
            _ => |s: usize, p: &[u8]| if s == 0 { is_decoded(p) } else { judge(0, s, p) },
        };
        let rig = Box::new(TestRig { fake, serial: SERIAL, streams: vec![0, 1, 2], is_genuine });
        Bench { backend, serial: SERIAL.into(), requests, rig }
    }
}

fn judge(color: u32, stream: usize, pixels: &[u8]) -> bool {
    let (format, (width, height)) = match stream {
        0 => (color, COLOR),
        1 => (abi::DEPTH16, DEPTH),
        _ => (abi::IR16, DEPTH),
    };
    images::is_genuine(format, width, height, pixels)
}

/// Whether `pixels` are one of the camera's JPEG images, decoded.
fn is_decoded(pixels: &[u8]) -> bool {
    static DECODED: Mutex<Vec<Vec<u8>>> = Mutex::new(Vec::new());
    let mut decoded = DECODED.lock().unwrap();
    if decoded.is_empty() {
        for n in 0..images::JPEGS {
            let mut rgb = vec![0; PixelFormat::Rgb8.frame_bytes(COLOR.0, COLOR.1)];
            let jpeg = images::image(abi::MJPG, COLOR.0, COLOR.1, n);
            unpack::decode_jpeg(&jpeg, COLOR.0, COLOR.1, &mut rgb).unwrap();
            decoded.push(rgb);
        }
    }
    decoded.iter().any(|d| d == pixels)
}

fn is_without_alpha(pixels: &[u8]) -> bool {
    (0..256).any(|n| {
        (n * 17) as u8 == pixels[0] && {
            let image = images::image(abi::BGRA32, COLOR.0, COLOR.1, n);
            image.chunks(4).flat_map(|p| &p[..3]).eq(pixels)
        }
    })
}

fn passes(color: PixelFormat, cases: &[&str]) {
    let report = conformance::run_some(&Live(color), cases);
    println!("{report}");
    assert!(report.is_good(), "{report}");
    assert_eq!(report.verdicts.len(), cases.len());
    assert_eq!(report.not_applicable(), Vec::<&str>::new());
}

#[test]
fn with_colour_as_it_comes_every_case_passes() {
    passes(PixelFormat::Mjpeg, &conformance::cases());
}

/// Cases that the format can affect.
const CASES: [&str; 7] =
    ["frames", "every_byte", "half_frame", "wrong_size", "damaged", "repeated", "unplug"];

#[test]
fn with_colour_decoded_every_byte_is_right() {
    passes(PixelFormat::Rgb8, &CASES);
}

#[test]
fn with_packed_colour_every_byte_is_right() {
    passes(PixelFormat::Yuyv, &CASES);
}

#[test]
fn with_planar_colour_every_byte_is_right() {
    passes(PixelFormat::Nv12, &CASES);
}

#[test]
fn with_colour_that_libk4a_decodes_every_byte_is_right() {
    passes(PixelFormat::Bgr8, &CASES);
}
