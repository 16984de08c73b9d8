//! Expected contents of a dataset for third-party readers: bare pixels, and a list of images and IMU samples.
//!
//! `index.json` lists each image: topic, log time, size, encoding, the file with its pixels, how they are to be
//! compared (`exact` or `jpeg`) and the intrinsics; each sample of an IMU; and the poses of the IMUs. The files
//! hold bare pixels, row by row.

use depthrig_bus::PixelFormat;
use depthrig_recorder::{Dataset, DatasetSet, Session, SetRange, StreamRecord};
use serde_json::{Value, json};
use std::path::Path;

/// ROS's encoding of a format, and the last part of the topic of images stored as they came.
fn encoding(format: PixelFormat) -> &'static str {
    match format {
        PixelFormat::Z16 => "16UC1",
        PixelFormat::DisparityF32 => "32FC1",
        PixelFormat::Rgb8 => "rgb8",
        PixelFormat::Yuyv => "yuv422_yuy2",
        _ => "mono8",
    }
}

/// Each sample that came with a set, in the order of the file.
fn motion(session: &Session, set: &DatasetSet) -> Vec<Value> {
    let mut samples = Vec::new();
    for batch in &set.motion {
        let id = &session.motion[batch.unit].id;
        samples.extend(batch.samples.iter().map(|s| {
            json!({
                "base": format!("/{}/{}/{}", session.rig, id.camera, id.stream), "log_time": set.utc_ns.to_string(),
                "stamp": (s.time_ns + set.utc_offset_ns).to_string(), "time_ns": s.time_ns.to_string(),
                "device_time": s.device_time, "sequence": s.sequence, "batch": batch.header.sequence,
                "uncertainty_ns": s.uncertainty_ns, "accel_offset_ns": s.accel_offset_ns, "flags": s.flags,
                // Exact in 64 bits; null is no number.
                "gyro": s.gyro_rad_s.map(f64::from), "accel": s.accel_m_s2.map(f64::from),
                "temperature_c": s.temperature_c,
            })
        }));
    }
    samples
}

/// Writes what our own reader finds in `dataset` to `expected`.
///
/// `check` is given each image that is stored losslessly: its stream, its set's id and its pixels. `note` is the
/// note of the session, where it has one.
///
/// # Panics
/// When the dataset cannot be read or `expected` cannot be written.
pub fn write(
    dataset: &Path,
    expected: &Path,
    note: Option<&str>,
    check: &mut dyn FnMut(&StreamRecord, u64, &[u8]),
) {
    std::fs::create_dir_all(expected).unwrap();
    let made = Dataset::open(dataset).unwrap();
    let session = made.session();
    let mut images = Vec::new();
    let mut samples = Vec::new();
    let mut sets = 0;
    let mut first_set = None;
    for set in made.sets(SetRange::ALL) {
        let set = set.unwrap();
        sets += 1;
        first_set.get_or_insert(set.id);
        samples.extend(motion(session, &set));
        for f in set.frames {
            let s = &session.streams[f.stream];
            let exact = f.codec != "jpeg";
            if exact {
                check(s, set.id, &f.pixels);
            }
            let file = format!("{}_{}_{}.bin", set.id, s.id.camera, s.id.stream);
            std::fs::write(expected.join(&file), &f.pixels).unwrap();
            let last = match f.codec {
                "raw" => "image_raw",
                "rank" => "depth_compressed",
                _ => "image_compressed",
            };
            let base = format!("/{}/{}/{}", session.rig, s.id.camera, s.id.stream);
            let i = &f.header.intrinsics;
            images.push(json!({
                "topic": format!("{base}/{last}"), "base": base, "set": set.id, "file": file,
                // As text: 64-bit times do not survive JavaScript's numbers.
                "log_time": set.utc_ns.to_string(),
                "stamp": (f.header.capture_time_ns + set.utc_offset_ns).to_string(),
                "width": s.width, "height": s.height, "encoding": encoding(s.format),
                "codec": f.codec, "compare": if exact { "exact" } else { "jpeg" },
                "sequence": f.header.sequence, "depth_unit_m": f.header.depth_unit_m,
                "k": [i.fx, 0.0, i.cx, 0.0, i.fy, i.cy, 0.0, 0.0, 1.0], "d": i.coeffs[..5],
                "translation": s.pose.translation_m, "rotation": s.pose.rotation_xyzw,
            }));
        }
    }
    let units: Vec<_> = session
        .motion
        .iter()
        .map(|u| {
            json!({
                "frame_id": format!("{}_{}_frame", u.id.camera, u.id.stream),
                "translation": u.pose.translation_m, "rotation": u.pose.rotation_xyzw,
            })
        })
        .collect();
    let index = json!({
        "rig": session.rig, "sets": sets, "first_set": first_set, "note": note,
        "images": images, "motion": samples, "units": units,
    });
    std::fs::write(expected.join("index.json"), serde_json::to_vec_pretty(&index).unwrap()).unwrap();
}
