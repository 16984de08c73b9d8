//! `depthrig demo` from the command line, with a rig of one small camera.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

#[path = "support/home.rs"]
mod support;

use support::{Home, Ran, depthrig};

/// Runs the demo on one simulated camera with these lines more; ONNX Runtime is not to be found.
fn demo(home: &Home, more: &str) -> Ran {
    let rig = format!(
        "rig = \"small\"\n[[camera]]\nname = \"cam\"\nbackend = \"synthetic\"\nmodel = \"d435\"\ncheap = true\n\
         [[camera.stream]]\nname = \"color\"\nwidth = 64\nheight = 48\nrate_hz = 15.0\n\
         [[camera.stream]]\nname = \"depth\"\nwidth = 64\nheight = 48\nrate_hz = 15.0\n{more}"
    );
    let rig = home.write("rig.toml", &rig);
    let out = home.path().join("demo");
    let mut command = depthrig();
    command.args(["demo", "--seconds", "3", "-q", "--config", &rig, "--out", out.to_str().unwrap()]);
    command.env("ORT_DYLIB_PATH", "/no/such/library");
    Ran::of(&command.output().unwrap())
}

fn lines<'a>(text: &'a str, start: &str) -> Vec<&'a str> {
    text.lines().filter(|line| line.starts_with(start)).collect()
}

#[test]
fn a_loss_is_one_line_a_missing_library_is_named_and_both_are_no_failure() {
    let home = Home::new();
    let ran = demo(&home, "[[camera.fault]]\nkind = \"skip\"\nat_s = 1.0\ncount = 3\n");
    let text = ran.good();
    let lost = lines(&text, "note lost");
    assert!(lost.len() == 1 && lost[0].contains("frames of cam"), "{text}");
    let model = lines(&text, "--   model");
    assert!(model.len() == 1 && model[0].contains("is not shown: ONNX Runtime was not found"), "{text}");
    assert_eq!(lines(&text, "LOOK wrong").len(), 0, "{text}");
    for name in ["dataset/session.toml", "dataset/report.html", "contact-sheet.png", "report.json"] {
        assert!(home.path().join("demo").join(name).exists(), "{name}");
    }
    // Existing files are kept.
    let again = demo(&home, "");
    assert!(again.code == 1 && again.err.contains("name another folder with --out"), "{}", again.err);
}
