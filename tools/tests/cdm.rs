//! Camera depth models as a person meets them: install, list, refine a pair of images, remove; and what goes wrong.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

#[allow(dead_code)] // the tests of the library use all of it
#[path = "../../cdm_plugin/tests/it/support.rs"]
mod parity;
#[path = "support/home.rs"]
mod support;

use depthrig_cdm::Encoder;
use depthrig_cdm::weights::write_seeded;
use parity::{Tensors, data, max_abs, seeded_weights};
use std::path::{Path, PathBuf};
use support::{Home, depthrig};

fn json(text: &str) -> serde_json::Value {
    serde_json::from_str(text).unwrap_or_else(|e| panic!("{e}: {text}"))
}

/// A 32-bit NPY file: its shape, and its numbers.
fn npy(path: &Path) -> (String, Vec<f32>) {
    let bytes = std::fs::read(path).unwrap();
    assert_eq!(&bytes[..8], b"\x93NUMPY\x01\x00");
    let head = 10 + usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
    let text = String::from_utf8_lossy(&bytes[10..head]).into_owned();
    assert!(text.contains("'<f4'") && head % 64 == 0, "{text}");
    let shape = text.split_once('(').unwrap().1.split_once(')').unwrap().0.to_owned();
    (shape, bytes[head..].as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect())
}

#[test]
fn a_pair_of_images_gives_the_official_numbers() {
    let home = Home::new();
    let weights = seeded_weights(Encoder::Vits);
    for (rgb, depth, unit, size, shape, numbers, limit) in [
        (
            "cdm_d405/color_26.png",
            "cdm_d405/depth_26.png",
            "0.0001",
            "252",
            "720, 1280",
            "vits_252_d405.safetensors",
            2e-5,
        ),
        (
            "lingbot_depth/0/rgb.png",
            "lingbot_depth/0/raw_depth.png",
            "0.001",
            "308",
            "480, 640",
            "vits_308_lingbot0.safetensors",
            5e-5,
        ),
    ] {
        let out = home.path().join("out.npy");
        let [rgb, depth] = [rgb, depth].map(|name| data().join(name).display().to_string());
        let ran = home.run(&[
            "cdm",
            "run",
            "--rgb",
            &rgb,
            "--depth",
            &depth,
            "--depth-unit",
            unit,
            "--model",
            weights.to_str().unwrap(),
            "--input-size",
            size,
            "--engine",
            "onnxruntime",
            "--inverse",
            "--overwrite",
            "--out",
            out.to_str().unwrap(),
        ]);
        let required = std::env::var_os("DEPTHRIG_REQUIRE_ONNXRUNTIME").is_some();
        if ran.err.contains("ONNX Runtime was not found") && !required {
            println!("skipped: {}", ran.err);
            return;
        }
        ran.good();
        let (has, y) = npy(&out);
        assert_eq!(has, shape);
        let off = max_abs(&y, &Tensors::open(numbers).get("inv_full").1);
        println!("{numbers}: off by {off:e}");
        assert!(off <= limit, "{numbers}: off by {off}");
    }
}

#[test]
fn a_model_is_made_installed_listed_and_removed() {
    let home = Home::new();
    let models = home.path().join("models").display().to_string();
    let file = home.path().join("made up.safetensors").display().to_string();
    write_seeded(Encoder::Vits, 1, Path::new(&file)).unwrap();
    let with = |args: &[&str]| home.run(&[&["cdm"], args, &["--models", &models]].concat());
    assert!(with(&["list"]).good().contains("no model is installed"));
    let ran = with(&["import", &file, "--name", "demo", "--camera", "D405", "--input-size", "252", "--json"]);
    let report = json(&ran.good());
    assert_eq!((&report["encoder"], &report["trained"]), (&"vits".into(), &false.into()));
    assert_eq!((&report["source"]["kind"], &report["input_size"]), (&"file".into(), &252.into()));
    assert!(report["id"].as_str().unwrap().starts_with("untrained-demo@"), "{report}");
    // Without a name it is that of the file.
    with(&["import", &file]).good();
    let listed = json(&with(&["list", "--json"]).good());
    let names: Vec<_> = listed["models"].as_array().unwrap().iter().map(|m| &m["name"]).collect();
    assert_eq!(names, ["demo", "made-up"]);
    let table = with(&["list"]).good();
    assert!(table.contains("D405") && table.contains("NO"), "{table}");
    let info = with(&["info", "demo", "--check"]).good();
    assert!(info.contains("NOT TRAINED") && info.contains("every number is finite"), "{info}");
    let ran = with(&["import", &file, "--name", "demo"]);
    assert!(ran.code == 2 && ran.err.contains("installed already"), "{}", ran.err);
    with(&["import", &file, "--name", "demo", "--replace"]).good();
    with(&["remove", "demo"]).good();
    let ran = with(&["info", "demo"]);
    assert!(ran.code == 1 && ran.err.contains("there are made-up"), "{}", ran.err);
    assert!(home.run(&["cdm", "list", "--published"]).good().contains("camera-depth-model-d435"));
}

/// Weights of random numbers.
fn made_up(home: &Home) -> PathBuf {
    let path = home.path().join("made-up.safetensors");
    write_seeded(Encoder::Vits, 1, &path).unwrap();
    path
}

#[test]
fn a_bad_checkpoint_is_refused_with_all_that_is_wrong() {
    let home = Home::new();
    let models = home.path().join("models").display().to_string();
    let torch = Path::new(env!("CARGO_MANIFEST_DIR")).join("../cdm_plugin/tests/data/torch");
    let file = |name: &str| torch.join(name).display().to_string();
    let with = |args: &[&str]| home.run(&[&["cdm", "import"], args, &["--models", &models]].concat());
    let ran = with(&[&file("plain.pth")]);
    assert!(ran.code == 1 && ran.err.contains("the weights of another network"), "{}", ran.err);
    let ran = with(&[&file("legacy.pth"), "--json"]);
    let report = json(&ran.out);
    assert_eq!((ran.code, &report["installed"]), (1, &false.into()));
    assert!(report["error"].as_str().unwrap().contains("torch.save(torch.load"), "{report}");
    // Cut short, with its sizes.
    let good = made_up(&home);
    let whole = std::fs::read(&good).unwrap();
    let cut = home.path().join("cut.safetensors");
    std::fs::write(&cut, &whole[..whole.len() / 2]).unwrap();
    let ran = with(&[cut.to_str().unwrap()]);
    let sizes = format!("it has {} bytes, and the whole takes {}", whole.len() / 2, whole.len());
    assert!(ran.code == 1 && ran.err.contains(&sizes), "{}", ran.err);
    // Of another encoder, and with NaN among its weights: every one of these is in the JSON.
    let ran = with(&[good.to_str().unwrap(), "--name", "a", "--encoder", "vitl"]);
    assert!(ran.code == 1 && ran.err.contains("has the weights of the encoder vits"), "{}", ran.err);
    let mut bad = whole;
    let end = bad.len() - 4;
    bad[end..].copy_from_slice(&f32::NAN.to_le_bytes());
    let nan = home.path().join("nan.safetensors");
    std::fs::write(&nan, &bad).unwrap();
    let ran = with(&[nan.to_str().unwrap(), "--json"]);
    let report = json(&ran.out);
    assert_eq!((ran.code, &report["report"]["not_finite"][0]["nan"]), (1, &1.into()), "{report}");
    assert!(with(&[&file("nothing.pth"), "--name", "a"]).err.contains("there is no such file"));
    assert_eq!(with(&["x.pth", "--name", "a b"]).code, 1, "the file comes first");
    assert!(!Path::new(&models).join("a").exists());
}

/// However an import is killed, a model is complete or absent.
#[test]
fn a_killed_import_leaves_nothing_that_counts() {
    let home = Home::new();
    let models = home.path().join("models");
    let weights = made_up(&home);
    let mut left_behind = 0;
    for ms in [0, 5, 20, 60, 150, 400] {
        let name = format!("killed-{ms}");
        let mut import = depthrig()
            .args(["cdm", "import", "--quiet", "--name", &name, "--models"])
            .args([&models, &weights])
            .stdout(std::process::Stdio::null())
            .spawn()
            .unwrap();
        // From when it begins to write, or has ended.
        let part = models.join(format!(".import-{name}"));
        while !part.exists() && import.try_wait().unwrap().is_none() {
            std::thread::sleep(std::time::Duration::from_millis(1));
        }
        std::thread::sleep(std::time::Duration::from_millis(ms));
        import.kill().unwrap();
        import.wait().unwrap();
        left_behind += usize::from(part.exists());
        let args = ["cdm", "list", "--json", "--models", models.to_str().unwrap()];
        let listed = json(&home.run(&args).good());
        assert_eq!(listed["damaged"].as_array().unwrap().len(), 0);
        for model in listed["models"].as_array().unwrap() {
            let name = model["name"].as_str().unwrap();
            home.run(&["cdm", "info", "--check", name, "--models", models.to_str().unwrap()]).good();
        }
    }
    assert!(left_behind > 0, "none was killed while it wrote");
    let args =
        ["cdm", "import", "--name", "last", "--models", models.to_str().unwrap(), weights.to_str().unwrap()];
    home.run(&args).good();
    let hidden = std::fs::read_dir(&models).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap());
    let hidden: Vec<_> = hidden.filter(|n| n.starts_with(".import")).collect();
    assert!(hidden.is_empty(), "swept up by the next import: {hidden:?}");
}

#[test]
fn images_that_do_not_fit_are_wrong_usage() {
    let home = Home::new();
    let [rgb, depth] = ["cdm_d405/color_26.png", "lingbot_depth/0/raw_depth.png"].map(|n| data().join(n));
    let [rgb, other] = [&rgb, &depth].map(|p| p.to_str().unwrap());
    let depth = data().join("cdm_d405/depth_26.png");
    let out = home.path().join("out.png");
    let run = |depth: &str, out: &Path, more: &[&str]| {
        let start = ["cdm", "run", "--rgb", rgb, "--depth", depth, "--depth-unit", "0.0001", "--out"];
        home.run(&[&start[..], &[out.to_str().unwrap()], more].concat())
    };
    let depth = depth.to_str().unwrap();
    let ran = run(other, &out, &["--engine", "fill"]);
    assert!(ran.code == 2 && ran.err.contains("Depth must be registered to colour first"), "{}", ran.err);
    let ran = run(rgb, &out, &["--engine", "fill"]);
    assert!(ran.code == 2 && ran.err.contains("16-bit PNG with one channel"), "{}", ran.err);
    let ran = run(depth, &out, &["--engine", "fill", "--inverse"]);
    assert!(ran.code == 2 && ran.err.contains("use .npy"), "{}", ran.err);
    let ran = run(depth, Path::new("out.tiff"), &["--engine", "fill"]);
    assert!(ran.code == 2 && ran.err.contains("use .npy or .png"), "{}", ran.err);
    assert_eq!(run(depth, &out, &[]).code, 2, "neither model nor engine");
    let ran = run(depth, &out, &["--model", "no-such"]);
    assert!(ran.code == 1 && ran.err.contains("no model no-such is installed"), "{}", ran.err);
    assert!(!out.exists());
    // Fill needs no model, and is called what it is.
    let report = json(&run(depth, &out, &["--engine", "fill", "--out-unit", "0.0001", "--json"]).good());
    assert!(
        report["engine"].as_str().unwrap().starts_with("fill") && report["trained"].is_null(),
        "{report}"
    );
    assert!(report["refined_percent"].as_f64() > report["raw_percent"].as_f64(), "{report}");
    let [raw, filled] = [Path::new(depth), &out].map(|p| image::open(p).unwrap().into_luma16());
    assert_eq!(raw.dimensions(), filled.dimensions());
    let same = raw.iter().zip(filled.iter()).filter(|(a, b)| **a > 0 && a.abs_diff(**b) < **a / 10).count();
    assert!(same * 2 > raw.len(), "the unit is the one that was asked for: {same} of {}", raw.len());
}

#[test]
fn an_input_without_use_is_said_and_never_overwritten() {
    let home = Home::new();
    let file = |name: &str| home.path().join(name).to_str().unwrap().to_owned();
    let rgb = file("c.png");
    let depth = file("z.png");
    let out = file("out.png");
    image::RgbImage::from_pixel(32, 24, image::Rgb([90, 120, 60])).save(&rgb).unwrap();
    image::ImageBuffer::from_pixel(32, 24, image::Luma([0u16])).save(&depth).unwrap();
    let run = |depth: &str, out: &str| {
        let common =
            ["cdm", "run", "--rgb", &rgb, "--depth", depth, "--depth-unit", "0.001", "--engine", "fill"];
        home.run(&[&common[..], &["--overwrite", "--out", out]].concat())
    };
    let ran = run(&depth, &out);
    assert!(
        ran.code == 3 && ran.err.contains("none of its 768 pixels has depth"),
        "{}: {}",
        ran.code,
        ran.err
    );
    for name in [&depth, &rgb] {
        let before = std::fs::read(name).unwrap();
        let ran = run(&depth, name);
        assert!(ran.code == 2 && ran.err.contains("is the input"), "{}", ran.err);
        assert_eq!(std::fs::read(name).unwrap(), before);
    }
    let shallow = file("z8.png");
    image::GrayImage::from_pixel(32, 24, image::Luma([80])).save(&shallow).unwrap();
    let ran = run(&shallow, &out);
    assert!(ran.code == 2 && ran.err.contains("has 8 bits per pixel"), "{}", ran.err);
}

/// A checkpoint of random numbers whose last layer is `louder` times what it was, as damage or another training leaves it:
/// every number is finite.
fn louder(home: &Home, louder: f32) -> PathBuf {
    let mut bytes = std::fs::read(made_up(home)).unwrap();
    let head = 8 + u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
    let tensors = json(std::str::from_utf8(&bytes[8..head]).unwrap());
    let tensors = tensors.as_object().unwrap();
    let last = tensors.iter().find(|(name, _)| name.ends_with("output_conv2.2.weight")).unwrap().1;
    let at = |i: usize| head + last["data_offsets"][i].as_u64().unwrap() as usize;
    for weight in bytes[at(0)..at(1)].as_chunks_mut::<4>().0 {
        *weight = (f32::from_le_bytes(*weight) * louder).to_le_bytes();
    }
    let path = home.path().join(format!("louder-{louder}.safetensors"));
    std::fs::write(&path, bytes).unwrap();
    path
}

#[test]
fn weights_that_give_numbers_and_no_depth_are_a_warning_with_its_cure() {
    let home = Home::new();
    let file = |name: &str| home.path().join(name).to_str().unwrap().to_owned();
    let rgb = file("c.png");
    let depth = file("z.png");
    let out = file("out.npy");
    image::RgbImage::from_fn(112, 84, |x, y| image::Rgb([(x * 2) as u8, (y * 3) as u8, (x * y % 251) as u8]))
        .save(&rgb)
        .unwrap();
    // The undamaged network outputs about 0.8 m.
    image::ImageBuffer::from_fn(112, 84, |x, y| image::Luma([(800 + x + y) as u16])).save(&depth).unwrap();
    let run = |weights: &Path| {
        let weights = weights.to_str().unwrap();
        let common =
            ["cdm", "run", "--rgb", &rgb, "--depth", &depth, "--depth-unit", "0.001", "--input-size", "84"];
        home.run(&[&common[..], &["--model", weights, "--overwrite", "--json", "--out", &out]].concat())
    };
    let ran = run(&made_up(&home));
    let required = std::env::var_os("DEPTHRIG_REQUIRE_ONNXRUNTIME").is_some();
    if ran.err.contains("ONNX Runtime was not found") && !required {
        println!("skipped: {}", ran.err);
        return;
    }
    let report = json(&ran.good());
    assert_eq!(report["warnings"].as_array().map(Vec::len), Some(0), "{report}");
    for (by, warned) in [(4.0, "differs from the result"), (6.0, "of the result is missing or beyond 20 m")] {
        let ran = run(&louder(&home, by));
        let code = ran.code;
        let err = ran.err.clone();
        let report = json(&ran.good());
        let warnings = report["warnings"].to_string();
        println!("{by}: {warnings}");
        assert!(warnings.contains(warned), "{by}: {warnings}");
        assert!(warnings.contains("cdm info NAME --check"), "{by}: {warnings}");
        assert!(code == 0 && err.contains("warning: ") && err.contains(warned), "{by}: {err}");
    }
}
