//! `depthrig stereo` and `depthrig bench stereo` from the command line.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

#[path = "support/home.rs"]
mod support;

use std::path::{Path, PathBuf};
use support::Home;

/// Noise as seen `shift` pixels further to the right.
fn image(path: &Path, width: u32, height: u32, shift: u32) {
    let noise = |x: u32, y: u32| {
        let v = (x / 2).wrapping_mul(7919) ^ (y / 2).wrapping_mul(104_729);
        (v.wrapping_mul(2_654_435_761) >> 13) as u8
    };
    image::GrayImage::from_fn(width, height, |x, y| image::Luma([noise(x + shift, y)])).save(path).unwrap();
}

fn pair(folder: &Path) -> [String; 2] {
    let [left, right] = ["left.png", "right.png"].map(|f| folder.join(f));
    image(&left, 241, 90, 0);
    image(&right, 241, 90, 14);
    [left, right].map(|p: PathBuf| p.to_str().unwrap().to_owned())
}

#[test]
fn a_pair_becomes_floats_or_sixteen_bits() {
    let folder = tempfile::tempdir().unwrap();
    let [left, right] = pair(folder.path());
    let file = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let npy = file("d.npy");
    let png = file("d.png");
    let sure = file("sure.png");
    for preset in ["performance", "quality", "ultra"] {
        let common =
            ["stereo", &left, &right, "--preset", preset, "--max-disparity", "64", "--overwrite", "--out"];
        Home::new().run(&[&common[..], &[&npy]].concat()).good();
        let report =
            Home::new().run(&[&common[..], &[&png, "--confidence", &sure, "--json"]].concat()).good();
        let report: serde_json::Value = serde_json::from_str(&report).unwrap();
        assert!(
            report["parameters"].as_str().unwrap().contains(&format!("preset={preset} max_disparity=64"))
        );
        assert!(report["memory_bytes"].as_u64().unwrap() > 0);
        let bytes = std::fs::read(&npy).unwrap();
        let data = &bytes[bytes.len() - 4 * 241 * 90..];
        assert!(
            String::from_utf8_lossy(&bytes[..128])
                .contains("'<f4', 'fortran_order': False, 'shape': (90, 241)")
        );
        let floats: Vec<f32> = data.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
        let units = image::open(&png).unwrap().into_luma16().into_raw();
        let sure = image::open(&sure).unwrap().into_luma8().into_raw();
        for ((d, u), c) in floats.iter().zip(&units).zip(&sure) {
            assert_eq!((d.is_nan(), d.is_nan()), (*u == 0, *c == 0));
            assert!(d.is_nan() || (d * 256.0 - f32::from(*u)).abs() < 1.0, "{d} {u}");
        }
        // All of it lies at 14, except for areas that the right camera does not see.
        let right_ones = floats.iter().filter(|d| (**d - 14.0).abs() < 0.5).count();
        assert!(right_ones * 10 > 8 * floats.len(), "{preset}: {right_ones} of {}", floats.len());
    }
}

#[test]
fn rows_that_are_apart_are_said() {
    let folder = tempfile::tempdir().unwrap();
    let [left, right] = pair(folder.path());
    let low = folder.path().join("low.png").to_str().unwrap().to_owned();
    let image = image::open(&right).unwrap().into_luma8();
    image::GrayImage::from_fn(241, 90, |x, y| *image.get_pixel(x, y.saturating_sub(2))).save(&low).unwrap();
    let out = folder.path().join("d.npy").to_str().unwrap().to_owned();
    for (right, rows) in [(&right, 0.0), (&low, 2.0)] {
        let common =
            ["stereo", &left, right, "--max-disparity", "64", "--overwrite", "--out", &out, "--json"];
        let ran = Home::new().run(&common);
        let report: serde_json::Value = serde_json::from_str(&ran.out).unwrap();
        let middle = report["rows"]["middle_px"].as_f64().unwrap();
        assert!((middle - rows).abs() < 0.1, "{report}");
        let warnings = report["warnings"].as_array().unwrap();
        assert_eq!(warnings.len(), usize::from(rows > 0.0), "{report}");
        assert_eq!(ran.err.contains("not rectified to the same rows"), rows > 0.0, "{}", ran.err);
        assert_eq!(report["rows_corrected"], rows > 0.0, "{report}");
        assert_eq!(report["parameters"].as_str().unwrap().contains("rows_moved_px="), rows > 0.0, "{report}");
        ran.good();
        // All of it lies at 14, in rows that were moved too.
        let right_ones = || {
            let bytes = std::fs::read(&out).unwrap();
            let floats: &[[u8; 4]] = bytes[bytes.len() - 4 * 241 * 90..].as_chunks().0;
            floats.iter().filter(|b| (f32::from_le_bytes(**b) - 14.0).abs() < 0.5).count()
        };
        let moved = right_ones();
        assert!(moved * 10 > 8 * 241 * 90, "{moved}");
        let kept = [&common[..], &["--keep-rows"]].concat();
        let report: serde_json::Value = serde_json::from_str(&Home::new().run(&kept).good()).unwrap();
        assert_eq!(report["rows_corrected"], false, "{report}");
        if rows > 0.0 {
            assert!(
                right_ones() * 2 < moved,
                "{} where rows are kept, {moved} where they are moved",
                right_ones()
            );
        }
    }
}

#[test]
fn a_pair_is_the_same_in_every_lossless_form() {
    let folder = tempfile::tempdir().unwrap();
    let images = pair(folder.path()).map(|p| image::open(p).unwrap().into_luma8());
    let out = folder.path().join("d.npy");
    let matched = |name: &str, save: &dyn Fn(&image::GrayImage, &Path)| {
        let files = ["left", "right"].map(|side| folder.path().join(format!("{side}-{name}")));
        for (image, file) in images.iter().zip(&files) {
            save(image, file);
        }
        let [left, right] = files.each_ref().map(|f| f.to_str().unwrap());
        let common =
            ["stereo", left, right, "--overwrite", "--out", out.to_str().unwrap(), "--max-disparity", "77"];
        Home::new().run(&common).good();
        std::fs::read(&out).unwrap()
    };
    let want = matched("8.png", &|p, file| p.save(file).unwrap());
    let scaled = |p: &image::GrayImage, by: u16, file: &Path| {
        let wide = |x, y| image::Luma([u16::from(p.get_pixel(x, y).0[0]) * by]);
        image::ImageBuffer::from_fn(p.width(), p.height(), wide).save(file).unwrap();
    };
    assert_eq!(matched("8.pgm", &|p, file| p.save(file).unwrap()), want);
    assert_eq!(matched("16.png", &|p, file| scaled(p, 257, file)), want);
    // 12 bits in the lower ones of 16.
    assert_eq!(matched("12.png", &|p, file| scaled(p, 16, file)), want);
    let as_pgm = |p: &image::GrayImage, file: &Path| {
        let mut bytes = format!("P5\n{} {}\n65535\n", p.width(), p.height()).into_bytes();
        bytes.extend(p.as_raw().iter().flat_map(|v| (u16::from(*v) * 16).to_be_bytes()));
        std::fs::write(file, bytes).unwrap();
    };
    assert_eq!(matched("12.pgm", &as_pgm), want);
    let colour = |p: &image::GrayImage, file: &Path| {
        image::DynamicImage::ImageLuma8(p.clone()).to_rgb8().save(file).unwrap();
    };
    assert_eq!(matched("8.ppm", &colour), want);
}

#[test]
fn images_of_every_size_are_matched() {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let left = file("l.png");
    let right = file("r.png");
    let out = file("d.npy");
    // Narrower than the search is wide, and smaller than what describes a pixel.
    for (width, height) in [(1, 1), (5, 3), (1, 90), (99, 1), (67, 31)] {
        image(Path::new(&left), width, height, 0);
        image(Path::new(&right), width, height, 3);
        for preset in ["performance", "quality", "ultra"] {
            let common = ["stereo", &left, &right, "--max-disparity", "201", "--preset", preset];
            let args = [&common[..], &["--overwrite", "--out", &out]].concat();
            Home::new().run(&args).good();
            let bytes = std::fs::read(&out).unwrap();
            let shape = format!("'shape': ({height}, {width})");
            assert!(String::from_utf8_lossy(&bytes[..128]).contains(&shape), "{width}x{height}");
        }
    }
}

#[test]
fn what_is_no_pair_is_said() {
    let folder = tempfile::tempdir().unwrap();
    let [left, right] = pair(folder.path());
    let small = folder.path().join("small.png");
    image(&small, 120, 90, 0);
    let out = folder.path().join("d.npy").to_str().unwrap().to_owned();
    let small = small.to_str().unwrap();
    for (args, said) in [
        (vec!["stereo", &left, small, "--out", &out], "241x90"),
        (vec!["stereo", &right, &left, "--max-disparity", "64", "--out", &out], "swapped"),
        (vec!["stereo", &left, &right, "--out", "d.tiff"], "use .npy or .png"),
        (vec!["stereo", &left, &right, "--preset", "best", "--out", &out], "performance, quality or ultra"),
        (vec!["stereo", &left, &right, "--max-disparity", "300", "--out", &out], "256"),
        (vec!["bench", "stereo", "--left", &left], "--right"),
    ] {
        let ran = Home::new().run(&args);
        assert_eq!(ran.code, 2, "{args:?}: {}", ran.err);
        assert!(ran.err.contains(said), "{args:?}: {}", ran.err);
        assert!(!Path::new(&out).exists());
    }
    let forced = ["stereo", &right, &left, "--max-disparity", "64", "--even-if-swapped", "--out", &out];
    Home::new().run(&forced).good();
    let ran = Home::new().run(&["stereo", &left, "/nonexistent.png", "--overwrite", "--out", &out]);
    assert_eq!(ran.code, 1);
    assert!(ran.err.contains("/nonexistent.png"), "{}", ran.err);
}

#[test]
fn the_bench_says_what_each_preset_costs() {
    let folder = tempfile::tempdir().unwrap();
    let [left, right] = pair(folder.path());
    let args =
        ["bench", "stereo", "--left", &left, "--right", &right, "--rounds", "2", "--threads", "2", "--json"];
    let report: serde_json::Value = serde_json::from_str(&Home::new().run(&args).good()).unwrap();
    assert_eq!((report["width"].as_u64(), report["threads"].as_u64()), (Some(241), Some(2)));
    let costs = report["costs"].as_array().unwrap();
    assert_eq!(costs.len(), 3);
    assert!(costs.iter().all(|c| c["cpu_ms_best"].as_f64().unwrap() > 0.0 && c["filled_percent"].as_f64().unwrap() > 50.0));
}

#[test]
fn an_input_is_never_overwritten_and_nothing_else_unasked() {
    let folder = tempfile::tempdir().unwrap();
    let [left, right] = pair(folder.path());
    let before = std::fs::read(&left).unwrap();
    let link = folder.path().join("link.png");
    std::os::unix::fs::symlink(&left, &link).unwrap();
    let sure = folder.path().join("sure.png").to_str().unwrap().to_owned();
    for out in [left.as_str(), link.to_str().unwrap()] {
        let args = ["stereo", &left, &right, "--max-disparity", "64", "--overwrite", "--out", out];
        let ran = Home::new().run(&args);
        assert!(ran.code == 2 && ran.err.contains("is the input"), "{}", ran.err);
    }
    let ran = Home::new().run(&["stereo", &left, &right, "--out", &sure, "--confidence", &sure]);
    assert!(ran.code == 2 && ran.err.contains("are one file"), "{}", ran.err);
    std::fs::write(&sure, "somebody's").unwrap();
    let ran = Home::new().run(&["stereo", &left, &right, "--out", &sure]);
    assert!(ran.code == 2 && ran.err.contains("--overwrite"), "{}", ran.err);
    assert_eq!(std::fs::read(&sure).unwrap(), b"somebody's");
    assert_eq!(std::fs::read(&left).unwrap(), before);
}
