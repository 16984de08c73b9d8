//! Raw stereo: a reader gets the left and the right image exactly as they were sent, whatever the colour codec, with
//! all that rectification needs.

use crate::support::*;
use depthrig_bus::{Distortion, Intrinsics, PixelFormat, Pose};
use depthrig_recorder::fs::MemFs;
use depthrig_recorder::{
    ColorCodec, DepthCodec, RecordFrame, Recorder, RecorderOptions, Session, Severity, VerifyOptions,
    verify_with,
};
use std::sync::Arc;

/// The left and the right stream of a camera with a lens, beside a colour stream.
fn stereo() -> Session {
    let mut s = session();
    let mut left = stream("zed/left", PixelFormat::Yuyv, 64, 36);
    left.intrinsics = Intrinsics {
        coeffs: [-0.063_451_8, 0.040_153_2, -0.000_375, 0.000_748, -0.0161, 0.0, 0.0, 0.0],
        model: Distortion::BrownConrady as u32,
        ..Intrinsics::pinhole(26.6, 26.7, 31.8, 18.1)
    };
    let mut right = stream("zed/right", PixelFormat::Yuyv, 64, 36);
    right.intrinsics = Intrinsics { cx: 32.1, cy: 18.8, ..left.intrinsics };
    right.intrinsics.coeffs[0] = -0.058_774_7;
    right.pose = Pose {
        translation_m: [0.22014, -0.2001, 0.3002],
        rotation_xyzw: [-0.0018, 0.0016, 0.0005, 0.999_996_974_995_2],
    };
    s.streams = vec![stream("front/color", PixelFormat::Rgb8, 64, 48), left, right];
    s
}

/// Noise in every bit, different in each stream and set: no lossy codec could reproduce it.
fn noise(stream: usize, n: u64) -> Vec<u8> {
    let mut x = 0x9E37_79B9_7F4A_7C15_u64.wrapping_mul(1 + n * 7 + stream as u64);
    let mut next = || {
        x ^= x << 13;
        x ^= x >> 7;
        x ^= x << 17;
        (x >> 24) as u8
    };
    (0..PixelFormat::Yuyv.frame_bytes(64, 36)).map(|_| next()).collect()
}

#[test]
fn left_and_right_images_come_back_bit_by_bit_under_every_colour_codec() {
    for color in [ColorCodec::Jpeg, ColorCodec::Png, ColorCodec::Raw] {
        for depth in [DepthCodec::Zstd, DepthCodec::Rank] {
            let fs = MemFs::new();
            let session = stereo();
            let options = RecorderOptions { color, depth, jpeg_quality: 10, ..options() };
            let r = Recorder::create(Arc::new(fs.clone()), &dir(), session.clone(), options).unwrap();
            for n in 0..4 {
                let mut set = set(&session, n);
                for f in set.frames.iter_mut().filter(|f| f.stream > 0) {
                    *f = RecordFrame {
                        pixels: Box::new(noise(f.stream, n)),
                        ..set_frame(&session, f.stream, n)
                    };
                }
                r.push(set).unwrap();
            }
            assert!(r.finish().unwrap().complete);
            let shared: Arc<dyn depthrig_recorder::fs::Fs> = Arc::new(fs.clone());
            let options = VerifyOptions { decode: true, ..VerifyOptions::default() };
            let report = verify_with(&shared, &dir(), &options).unwrap();
            assert!(report.worst() < Some(Severity::Lost), "{:?}", report.findings);
            let sets = read_all(&fs);
            assert_eq!(sets.len(), 4);
            for (n, got) in sets.iter().enumerate() {
                for f in got.frames.iter().filter(|f| f.stream > 0) {
                    assert_eq!(f.codec, "raw", "{color:?}");
                    assert_eq!(
                        f.pixels,
                        noise(f.stream, n as u64),
                        "{color:?}, set {n}, stream {}",
                        f.stream
                    );
                    let s = &session.streams[f.stream];
                    assert_eq!((f.header.intrinsics, f.header.pose), (s.intrinsics, s.pose));
                }
            }
        }
    }
}

fn set_frame(session: &Session, stream: usize, n: u64) -> RecordFrame {
    RecordFrame { stream, header: header(&session.streams[stream], n), pixels: Box::new(Vec::new()) }
}

/// `session.toml` alone has all that a stereo program needs: both lenses, and the baseline as the difference of the
/// left and right poses.
#[test]
fn the_session_has_both_lenses_and_the_baseline() {
    let session = stereo();
    let back: Session = toml::from_str(&session.to_toml().unwrap()).unwrap();
    assert_eq!(back.streams, session.streams);
    let [left, right] = [1, 2].map(|i| back.streams[i].pose.translation_m);
    assert!((right[0] - left[0] - 0.12014).abs() < 1e-12);
}
