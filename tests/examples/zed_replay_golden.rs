//! Depth of `zed replay` for readers that are not ours: a dataset, and the pixels that they must find in it.
//!
//! `cargo run -p depthrig-tests --example zed_replay_golden -- DATASET EXPECTED`; EXPECTED is as
//! `recorder/examples/golden.rs` writes it.
#![allow(missing_docs, clippy::unwrap_used, clippy::print_stdout)]

use core::ops::ControlFlow;
use depthrig_bus::PixelFormat;
use depthrig_daemon::zed_replay::{ZedReplayOptions, zed_replay};
use depthrig_recorder::{Dataset, SetRange};
use depthrig_tests::eyes::Eyes;
use serde_json::json;
use std::path::Path;

fn main() {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [dataset, expected] = args.as_slice() else {
        println!("usage: zed_replay_golden DATASET EXPECTED");
        std::process::exit(2);
    };
    let (dataset, expected) = (Path::new(dataset), Path::new(expected));
    let source = tempfile::tempdir().unwrap();
    let source = source.path().join("source");
    Eyes { size: (96, 54), focal: 75.0, sets: 3, ..Eyes::default() }.record(&source);
    let options = ZedReplayOptions { disparity: true, ..ZedReplayOptions::default() };
    let report = zed_replay(&source, dataset, &options, &mut |_, _, _| ControlFlow::Continue(())).unwrap();
    std::fs::create_dir_all(expected).unwrap();
    let made = Dataset::open(dataset).unwrap();
    let (mut pictures, mut first_set) = (Vec::new(), None);
    for set in made.sets(SetRange::ALL) {
        let set = set.unwrap();
        first_set.get_or_insert(set.id);
        for f in set.frames {
            let s = &made.session().streams[f.stream];
            let file = format!("{}_{}_{}.bin", set.id, s.id.camera, s.id.stream);
            std::fs::write(expected.join(&file), &f.pixels).unwrap();
            let (encoding, topic) = match s.format {
                PixelFormat::Z16 => ("16UC1", "image_raw"),
                PixelFormat::DisparityF32 => ("32FC1", "image_raw"),
                PixelFormat::Rgb8 => ("rgb8", "image_compressed"),
                _ => ("mono8", "image_raw"),
            };
            let base = format!("/bench/{}/{}", s.id.camera, s.id.stream);
            let i = &f.header.intrinsics;
            pictures.push(json!({
                "topic": format!("{base}/{topic}"), "base": base, "set": set.id, "file": file,
                "log_time": set.utc_ns.to_string(),
                "stamp": (f.header.capture_time_ns + set.utc_offset_ns).to_string(),
                "width": s.width, "height": s.height, "encoding": encoding,
                "codec": f.codec, "compare": if f.codec == "jpeg" { "jpeg" } else { "exact" },
                "sequence": f.header.sequence, "depth_unit_m": f.header.depth_unit_m,
                "k": [i.fx, 0.0, i.cx, 0.0, i.fy, i.cy, 0.0, 0.0, 1.0], "d": i.coeffs[..5],
                "translation": s.pose.translation_m, "rotation": s.pose.rotation_xyzw,
            }));
        }
    }
    let index = json!({ "rig": "bench", "sets": report.sets, "first_set": first_set, "pictures": pictures });
    std::fs::write(expected.join("index.json"), serde_json::to_vec_pretty(&index).unwrap()).unwrap();
}
