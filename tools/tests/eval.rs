//! `depthrig eval`: against NumPy, on folders, on HAMMER's layout, and on a recording with ground truth.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

#[path = "support/home.rs"]
mod support;

use serde_json::Value;
use std::path::Path;
use std::process::Command;
use support::{Home, Ran};

type Depth = image::ImageBuffer<image::Luma<u16>, Vec<u16>>;

/// Numbers that look random and are the same on every machine.
fn roll(a: u32, b: u32) -> u32 {
    let mut h = a.wrapping_mul(0x9E37_79B9) ^ b.wrapping_mul(0x85EB_CA6B);
    h = (h ^ (h >> 15)).wrapping_mul(0x2C1B_3C6D);
    h ^ (h >> 13)
}

fn save(path: &Path, of: impl Fn(u32) -> u16) {
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    Depth::from_fn(40, 30, |x, y| image::Luma([of(y * 40 + x)])).save(path).unwrap();
}

/// Millimetres, with holes; in image 3 all of it.
fn truth(i: u32, p: u32) -> u16 {
    if i == 3 || roll(i, p).is_multiple_of(17) { 0 } else { 300 + (roll(i + 9, p) % 4000) as u16 }
}

/// Some 10 % off in either direction, with holes and saturated pixels.
fn seen(i: u32, p: u32) -> u16 {
    match roll(i + 99, p) % 11 {
        0 => 0,
        1 => u16::MAX,
        r => (u32::from(truth(i, p)) * (85 + 3 * r) / 100).max(1) as u16,
    }
}

/// Writes an NPY of metres.
fn npy(path: &Path, of: impl Fn(u32) -> f32) {
    let head = "{'descr': '<f4', 'fortran_order': False, 'shape': (30, 40), }\n";
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((head.len() as u16).to_le_bytes());
    bytes.extend(head.as_bytes());
    bytes.extend((0..1200).flat_map(|p| of(p).to_le_bytes()));
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    std::fs::write(path, bytes).unwrap();
}

/// Folders `truth`, `raw` (16-bit units) and `model` (metres), five images each, the last in a folder below.
fn folders(home: &Home) {
    for i in 0..5 {
        let name = if i == 4 { "deeper/4".to_owned() } else { i.to_string() };
        save(&home.path().join(format!("truth/{name}.png")), |p| truth(i, p));
        save(&home.path().join(format!("raw/{name}.png")), |p| seen(i, p));
        npy(&home.path().join(format!("model/{name}.npy")), |p| match roll(i + 5, p) % 40 {
            0 => f32::NAN,
            1 => -1.0,
            r => f32::from(truth(i, p)) * 0.001 + r as f32 * 0.002 - 0.03,
        });
    }
}

fn evaluate(home: &Home, args: &[&str]) -> Value {
    serde_json::from_str(&evaluation(home, args).good()).unwrap()
}

fn evaluate_recorded(home: &Home, args: &[&str]) -> Value {
    serde_json::from_str(&evaluation(home, args).done()).unwrap()
}

fn evaluation(home: &Home, args: &[&str]) -> Ran {
    let at = |a: &&str| a.replace("@/", &format!("{}/", home.path().display()));
    let args: Vec<String> = args.iter().map(at).collect();
    let args: Vec<&str> =
        ["eval", "-q", "--json"].into_iter().chain(args.iter().map(String::as_str)).collect();
    home.run(&args)
}

/// The definitions once more, with arrays.
const NUMPY: &str = r#"
import json, math, sys
import numpy as np
def metrics(p, t, lo, hi):
    counts = np.isfinite(t) & (t > 0) & (t >= lo) & (t <= hi)
    t = t[counts]; p = p[counts]
    valid = np.isfinite(p) & (p > 0)
    a, b = p[valid], t[valid]
    zero = np.where(valid, p, 0.0)
    f = np.maximum(a / b, b / a)
    mean = lambda x: float(np.mean(x)) if x.size else float("nan")
    return dict(counted=int(t.size), valid=int(a.size), l1_m=mean(np.abs(a - b)), rmse_m=mean((a - b) ** 2) ** 0.5,
        abs_rel=mean(np.abs(a - b) / b), delta_05=mean(f < 1.25 ** 0.5), delta_1=mean(f < 1.25),
        delta_105=mean(f < 1.05), delta_110=mean(f < 1.10),
        strict_delta_105=float((f < 1.05).sum()) / t.size if t.size else float("nan"),
        strict_delta_110=float((f < 1.10).sum()) / t.size if t.size else float("nan"),
        strict_l1_m=mean(np.abs(zero - t)), strict_rmse_m=mean((zero - t) ** 2) ** 0.5,
        strict_abs_rel=mean(np.abs(zero - t) / t),
        strict_delta_05=float((f < 1.25 ** 0.5).sum()) / t.size if t.size else float("nan"),
        strict_delta_1=float((f < 1.25).sum()) / t.size if t.size else float("nan"),
        missing_percent=100.0 * (t.size - a.size) / t.size if t.size else float("nan"))
lo, hi = float(sys.argv[2]), float(sys.argv[3])
out = {}
for name in ("raw", "model"):
    ps, ts = [np.fromfile(f"{sys.argv[1]}/{name}{k}.f64").reshape(5, -1) for k in ("", "_truth")]
    each = [metrics(p, t, lo, hi) for p, t in zip(ps, ts)]
    mean = {k: float(np.nanmean([m[k] for m in each])) for k in each[0]}
    out[name] = dict(mean=mean, pooled=metrics(ps.ravel(), ts.ravel(), lo, hi))
print(json.dumps(out).replace("NaN", "null"))
"#;

#[test]
fn numbers_are_those_of_numpy() {
    let python = Path::new(env!("CARGO_MANIFEST_DIR")).join("../.venv/bin/python");
    let has_numpy =
        Command::new(&python).args(["-c", "import numpy"]).output().is_ok_and(|o| o.status.success());
    if !has_numpy {
        eprintln!("skipped: {} has no numpy; `make setup` makes it", python.display());
        return;
    }
    let home = Home::new();
    folders(&home);
    // NumPy gets its input from the functions above and not through any file format.
    let dump = |name: &str, of: &dyn Fn(u32, u32) -> f64| {
        let bytes: Vec<u8> = (0..5)
            .flat_map(|i| (0..1200).flat_map(move |p| [(i, p)]))
            .flat_map(|(i, p)| of(i, p).to_le_bytes())
            .collect();
        std::fs::write(home.path().join(name), bytes).unwrap();
    };
    let metres = |d: u16| if d == u16::MAX { 0.0 } else { f64::from((f64::from(d) * 0.001) as f32) };
    let model = |i: u32, p: u32| match roll(i + 5, p) % 40 {
        0 => f64::NAN,
        1 => -1.0,
        r => f64::from(f32::from(truth(i, p)) * 0.001 + r as f32 * 0.002 - 0.03),
    };
    dump("raw.f64", &|i, p| metres(seen(i, p)));
    dump("model.f64", &model);
    dump("raw_truth.f64", &|i, p| metres(truth(i, p)));
    dump("model_truth.f64", &|i, p| metres(truth(i, p)));
    let said =
        Command::new(&python).args(["-c", NUMPY]).arg(home.path()).args(["0.5", "3.5"]).output().unwrap();
    assert!(said.status.success(), "{}", String::from_utf8_lossy(&said.stderr));
    let wanted: Value = serde_json::from_slice(&said.stdout).unwrap();

    let args = [
        "--truth",
        "@/truth",
        "--pred",
        "raw=@/raw",
        "--pred",
        "@/model",
        "--min-m",
        "0.5",
        "--max-m",
        "3.5",
    ];
    for threads in ["1", "3"] {
        let got = evaluate(&home, &[&args[..], &["--threads", threads]].concat());
        for row in got["rows"].as_array().unwrap() {
            let name = row["name"].as_str().unwrap();
            for (ours, theirs) in [("mean_of_images", "mean"), ("pixel_pooled", "pooled")] {
                let theirs = &wanted[name][theirs];
                for (key, value) in theirs.as_object().unwrap() {
                    if ours == "mean_of_images" && (key == "counted" || key == "valid") {
                        continue; // sums there
                    }
                    let a = row[ours][key].as_f64().unwrap();
                    let b = value.as_f64().unwrap();
                    assert!(
                        (a - b).abs() <= 1e-9 * (1.0 + b.abs()),
                        "{name} {ours} {key}: {a}, NumPy has {b}"
                    );
                }
            }
            assert_eq!(row["images"], 5);
            assert_eq!(row["empty_images"], 1, "the image without a reference");
        }
    }
}

#[test]
fn folders_are_paired_and_the_page_stands_alone() {
    let home = Home::new();
    folders(&home);
    let page = home.path().join("page.html");
    let at = |name: &str| home.path().join(name).to_str().unwrap().to_owned();
    let truth = at("truth");
    let model = at("model");
    let page_text = page.to_str().unwrap().to_owned();
    let raw = format!("sensor <raw>={}", at("raw"));
    let inputs = ["eval", "-q", "--truth", &truth, "--pred", &raw, "--pred", &model];
    let args = [&inputs[..], &["--overwrite", "--out", &page_text]].concat();
    let said = home.run(&args).good();
    assert!(said.contains("strict L1") && said.contains("sensor <raw>") && said.contains("page "), "{said}");
    let html = std::fs::read_to_string(&page).unwrap();
    assert!(html.contains("sensor &lt;raw&gt;") && !html.contains("<raw>") && !html.contains(">NaN<"));
    assert!(!html.contains("http://") && !html.contains("https://") && !html.contains("<script"));
    assert_eq!(html.matches("<svg ").count(), 6, "bars of each, four curves and the sizes of errors");
    assert_eq!(
        html.matches("src=\"data:image/jpeg").count(),
        2 * 3 * 3,
        "the worst three of each, three images each"
    );

    // A prediction with a wrong unit is compared as it is, and doubted.
    assert!(!home.run(&args).err.contains("unit"));
    let said = home.run(&[&args[..], &["--unit", "0.01", "--truth-unit", "0.001"]].concat());
    assert_eq!(said.code, 0, "{}", said.err);
    let doubts: Vec<&str> = said.err.lines().filter(|line| line.contains("unit")).collect();
    assert!(doubts.len() == 1 && doubts[0].starts_with("warning: sensor <raw> is "), "{}", said.err);
    assert!(
        doubts[0].ends_with("one may have a wrong unit; a tenth of its unit would fit (--unit)"),
        "{doubts:?}"
    );

    // A missing prediction is reported, and the others are compared.
    std::fs::remove_file(home.path().join("raw/2.png")).unwrap();
    let said = home.run(&args);
    assert_eq!(said.code, 3, "{}", said.err);
    assert!(said.out.contains("sensor <raw>: 1 of 5 references have no prediction, 2 first"), "{}", said.out);
    // So is one of another size.
    Depth::new(41, 30).save(home.path().join("raw/1.png")).unwrap();
    let said = home.run(&args);
    assert_eq!(said.code, 3);
    assert!(said.err.contains("raw/1.png: it has 41x30 pixels and its reference 40x30"), "{}", said.err);
    // If nothing can be compared, the command fails.
    let said =
        home.run(&["eval", "-q", "--truth", &truth, "--pred", home.path().join("run").to_str().unwrap()]);
    assert_eq!(said.code, 1, "{}", said.err);
    for bad in [
        &["eval"][..],
        &["eval", "--truth", &truth],
        &["eval", "--truth", &truth, "--pred", &model, "--min-m", "2", "--max-m", "1"],
    ] {
        assert_eq!(home.run(bad).code, 2, "{bad:?}");
    }
}

#[test]
fn hammers_folders_are_known() {
    let home = Home::new();
    for (s, sequence) in ["scene1_traj1_1", "scene2_traj1_naked_1"].iter().enumerate() {
        let view = home.path().join("HAMMER/test").join(sequence).join("polarization");
        for i in 0..2 {
            let k = 10 * s as u32 + i;
            save(&view.join(format!("_gt/{i:06}.png")), |p| truth(k, p));
            save(&view.join(format!("depth_d435/{i:06}.png")), |p| seen(k, p));
            save(&view.join(format!("depth_l515/{i:06}.png")), |p| truth(k, p));
            npy(&home.path().join(format!("out/{sequence}/{i:06}.npy")), |p| f32::from(truth(k, p)) * 0.002);
        }
    }
    let args = ["@/HAMMER", "--pred", "twice=@/out", "--refine", "filled"];
    let got = evaluate(&home, &args);
    let row = |group: &str, name: &str| {
        let rows = got["rows"].as_array().unwrap();
        let is_it = |r: &&Value| r["name"] == name && r["group"] == group;
        rows.iter().find(is_it).unwrap_or_else(|| panic!("{group} {name} in {got}")).clone()
    };
    assert_eq!(got["rows"].as_array().unwrap().len(), 5, "no depth_tof was there");
    assert_eq!(row("depth_l515", "raw")["mean_of_images"]["strict_l1_m"], 0.0);
    let raw = &row("depth_d435", "raw")["mean_of_images"];
    assert!(raw["strict_l1_m"].as_f64().unwrap() > 0.1);
    let filled = &row("depth_d435", "filled")["mean_of_images"];
    assert!(raw["missing_percent"].as_f64().unwrap() > 5.0 && filled["missing_percent"] == 0.0);
    let twice = row("HAMMER", "twice")["pixel_pooled"]["abs_rel"].as_f64().unwrap();
    assert!((twice - 1.0).abs() < 1e-6, "{twice}");
    let scenes = row("depth_d435", "raw")["by_scene"].clone();
    assert_eq!((&scenes[0]["scene"], &scenes[1]["scene"]), (&"scene1".into(), &"scene2".into()));
    // The naked sequence alone; and the authors' test scenes, of which there are none.
    let one = evaluate(&home, &[&args[..], &["--scenes", "*_naked_*"]].concat());
    assert_eq!(one["rows"][0]["images"], 2);
    let none = evaluation(&home, &[&args[..], &["--like-cdm"]].concat());
    assert_eq!(none.code, 1);
    assert!(none.err.contains("no scene or sequence scene12; there are scene1, scene2"), "{}", none.err);
    let none = home.run(&["eval", home.path().join("out").to_str().unwrap()]);
    assert_eq!(none.code, 1);
    assert!(none.err.contains("nor in the layout of HAMMER"), "{}", none.err);
}

#[test]
fn a_recording_with_truth_is_compared_in_one_view() {
    let home = Home::new();
    let cache = home.path().join("cache").display().to_string();
    let text = |truth: bool| {
        let truths = "[[camera.stream]]\nname = \"depth_true\"\nwidth = 160\nheight = 120\n\
             [[camera.stream]]\nname = \"depth_true_color\"\nwidth = 160\nheight = 120\n";
        let more = if truth { truths } else { "" };
        format!(
            "rig = \"sim\"\n[recording]\nreserve_mb = 16\n\n[[camera]]\nname = \"cam\"\nbackend = \"synthetic\"\n\
             model = \"generic\"\ntruth = {truth}\nposes = 2\ncache_dir = \"{cache}\"\n\
             [[camera.stream]]\nname = \"color\"\nwidth = 160\nheight = 120\n\
             [[camera.stream]]\nname = \"depth\"\nwidth = 160\nheight = 120\n{more}"
        )
    };
    let record = |name: &str, truth: bool| -> String {
        let rig = home.write("rig.toml", &text(truth));
        let out = home.path().join(name);
        let said =
            home.run(&["run", &rig, "--record", out.to_str().unwrap(), "--seconds", "4", "--json", "-q"]);
        let summary: Value = serde_json::from_str(&said.done()).unwrap();
        summary["recording"]["path"].as_str().unwrap().to_owned()
    };
    let path = record("with", true);
    let got = evaluate_recorded(&home, &[&path, "--pred", "depth", "--pred", "depth_true"]);
    let row = |name: &str| {
        let rows = got["rows"].as_array().unwrap();
        rows.iter().find(|r| r["name"] == name).unwrap_or_else(|| panic!("{name} in {got}")).clone()
    };
    // The true depth, moved into colour's view, is the truth but for what only one of the two sees.
    let raw = row("depth");
    let moved = row("depth_true");
    assert_eq!((raw["group"].as_str(), raw["empty_images"].as_u64()), (Some("cam"), Some(0)));
    assert!(raw["images"].as_u64().unwrap() >= 3);
    let value = |r: &Value, key: &str| r["mean_of_images"][key].as_f64().unwrap();
    assert!(value(&moved, "delta_1") > 0.98 && value(&moved, "l1_m") < 0.02, "{}", moved["mean_of_images"]);
    assert!(value(&raw, "strict_l1_m") > 2.0 * value(&moved, "strict_l1_m"), "{got}");
    // Refined depth of the same recording has no holes but what fill leaves; differences are to raw depth.
    let refined = evaluate_recorded(&home, &[&path, "--refine", "fill", "--refine", "filled"]);
    let row = |name: &str| {
        let rows = refined["rows"].as_array().unwrap();
        rows.iter().find(|r| r["name"] == name).unwrap_or_else(|| panic!("{name} in {refined}")).clone()
    };
    assert_eq!(row("depth")["mean_of_images"], raw["mean_of_images"]);
    assert_eq!(row("filled")["mean_of_images"]["missing_percent"], 0.0);
    assert!(value(&row("fill"), "missing_percent") < value(&raw, "missing_percent"));
    assert_eq!(row("fill")["difference"]["to"], "depth");
    let said = home.run(&["eval", "-q", "--json", &path, "--refine", "fill", "--truth", "depth_true"]);
    assert!(said.err.contains("refiners need the truth in the view of colour"), "{}", said.err);
    // In depth's own view nothing moves, and the truth is perfect.
    let own = evaluate_recorded(&home, &[&path, "--pred", "depth_true", "--truth", "depth_true"]);
    assert_eq!(own["rows"][0]["mean_of_images"]["strict_l1_m"], 0.0);

    let without = record("without", false);
    let said = home.run(&["eval", "-q", &without]);
    assert_eq!(said.code, 1);
    assert!(said.err.contains("truth = true") && said.err.contains("cam/color"), "{}", said.err);
}

#[test]
fn each_camera_of_a_relabelled_dataset_counts_once() {
    let home = Home::new();
    let cache = home.path().join("cache").display().to_string();
    let stream = |name: &str| format!("[[camera.stream]]\nname = \"{name}\"\nwidth = 160\nheight = 120\n");
    let streams = ["color", "depth", "depth_true_color"].map(stream).concat();
    let camera = |name: &str| {
        format!(
            "[[camera]]\nname = \"{name}\"\nbackend = \"synthetic\"\nmodel = \"generic\"\ntruth = true\nposes = 2\n\
             cache_dir = \"{cache}\"\n{streams}"
        )
    };
    let rig = format!("rig = \"sim\"\n[recording]\nreserve_mb = 16\n{}{}", camera("left"), camera("right"));
    let rig = home.write("rig.toml", &rig);
    let at = |name: &str| home.path().join(name).to_str().unwrap().to_owned();
    let said = home.run(&["run", &rig, "--record", &at("data"), "--seconds", "4", "--json", "-q"]);
    let summary: Value = serde_json::from_str(&said.done()).unwrap();
    let path = summary["recording"]["path"].as_str().unwrap();
    home.run(&["cdm", "relabel", path, &at("again"), "--engine", "fill", "-q"]).done();
    let images = |path: &str| -> Vec<(String, u64)> {
        let got = evaluate_recorded(&home, &[path, "--pred", "depth"]);
        let rows = got["rows"].as_array().unwrap();
        let of = |r: &Value| (r["group"].as_str().unwrap().to_owned(), r["images"].as_u64().unwrap());
        rows.iter().map(of).collect()
    };
    let recorded = images(path);
    assert!(recorded.len() == 2 && recorded[0].1 >= 3, "{recorded:?}");
    assert_eq!(images(&at("again")), recorded);
}

#[test]
fn a_model_gives_the_depth_of_cdm_run() {
    let home = Home::new();
    let at = |name: &str| home.path().join(name).to_str().unwrap().to_owned();
    for folder in ["truth", "raw", "rgb", "pred"] {
        std::fs::create_dir(at(folder)).unwrap();
    }
    let model = at("made-up.safetensors");
    depthrig_cdm::weights::write_seeded(depthrig_cdm::Encoder::Vits, 1, Path::new(&model)).unwrap();
    for i in 0..2u32 {
        let raw = |x, y| if roll(i + x / 9, y / 9).is_multiple_of(5) { 0 } else { 800 + x + y + 20 * i };
        image::RgbImage::from_fn(112, 84, |x, y| {
            image::Rgb([(x * 2) as u8, (y * 3) as u8, (x * y % 251) as u8])
        })
        .save(at(&format!("rgb/{i}.png")))
        .unwrap();
        Depth::from_fn(112, 84, |x, y| image::Luma([raw(x, y) as u16]))
            .save(at(&format!("raw/{i}.png")))
            .unwrap();
        Depth::from_fn(112, 84, |x, y| image::Luma([(790 + x + y) as u16]))
            .save(at(&format!("truth/{i}.png")))
            .unwrap();
    }
    let inputs = ["--truth", &at("truth"), "--raw", &at("raw"), "--rgb", &at("rgb")].map(str::to_owned);
    let eval = |more: &[&str]| {
        let inputs: Vec<&str> = inputs.iter().map(String::as_str).collect();
        home.run(&[&["eval", "-q", "--json", "--input-size", "84"], &inputs[..], more].concat())
    };
    let refine = format!("net={model}");
    let missing = eval(&["--refine", &refine, "--library", "/nonexistent/libonnxruntime.so"]);
    assert_eq!(missing.code, 1, "{}", missing.err);
    assert!(missing.err.contains("--refine net: unusable"), "{}", missing.err);
    assert!(missing.err.contains("/nonexistent/libonnxruntime.so"), "{}", missing.err);
    for i in 0..2 {
        let files = [format!("rgb/{i}.png"), format!("raw/{i}.png"), format!("pred/{i}.npy")].map(|f| at(&f));
        let common = ["cdm", "run", "--depth-unit", "0.001", "--input-size", "84", "--model", &model];
        let ran = home
            .run(&[&common[..], &["--rgb", &files[0], "--depth", &files[1], "--out", &files[2]]].concat());
        let required = std::env::var_os("DEPTHRIG_REQUIRE_ONNXRUNTIME").is_some();
        if ran.err.contains("ONNX Runtime was not found") && !required {
            println!("skipped: {}", ran.err);
            return;
        }
        ran.good();
    }
    let got: Value =
        serde_json::from_str(&eval(&["--pred", &at("pred"), "--refine", &refine]).good()).unwrap();
    let [raw, written, net] = [0, 1, 2].map(|i| got["rows"][i].clone());
    assert_eq!(
        (&raw["name"], &written["name"], &net["name"]),
        (&"raw".into(), &"pred".into(), &"net".into())
    );
    assert_eq!(written["mean_of_images"], net["mean_of_images"]);
    assert!(net["mean_of_images"]["l1_m"].as_f64().unwrap() > 0.001, "{net}");
    assert!(net["engine"].as_str().unwrap().starts_with("onnxruntime"), "{net}");
    assert!(net["model"].as_str().unwrap().starts_with("untrained-"), "{net}");

    // A network of the form of `tiny` from a file: here the one of the program, whose numbers are the same.
    let own = at("my-tiny.onnx");
    let shipped = concat!(env!("CARGO_MANIFEST_DIR"), "/../cdm_plugin/models/tiny.onnx");
    std::fs::copy(shipped, &own).unwrap();
    let of_file = format!("mine={own}");
    let got: Value = serde_json::from_str(&eval(&["--refine", "tiny", "--refine", &of_file]).good()).unwrap();
    let [built_in, mine] = [1, 2].map(|i| got["rows"][i].clone());
    assert_eq!(built_in["mean_of_images"], mine["mean_of_images"]);
    assert!(built_in["model"].as_str().unwrap().starts_with("tiny@"), "{built_in}");
    assert!(mine["model"].as_str().unwrap().starts_with("my-tiny@"), "{mine}");
    std::fs::write(&own, "no network").unwrap();
    for (text, part) in [(of_file.as_str(), "my-tiny@"), ("gone=gone.onnx", "gone.onnx: cannot be read")] {
        let refused = eval(&["--refine", text]);
        assert!(refused.code != 0 && refused.err.contains(part), "{}", refused.err);
    }
}
