//! `depthrig replay` from the command line: one process replays, another one controls it.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

#[path = "support/home.rs"]
mod support;

use support::Home;

/// A dataset of the `files` camera, about two seconds long.
fn dataset(home: &Home) -> String {
    home.images(4);
    let rig = home.rig_file("desk");
    let out = home.path().join("data");
    let said = home.run(&["run", &rig, "--record", out.to_str().unwrap(), "--seconds", "2", "--json", "-q"]);
    let summary: serde_json::Value = serde_json::from_str(&said.good()).unwrap();
    summary["recording"]["path"].as_str().unwrap().to_owned()
}

fn json(home: &Home, args: &[&str]) -> serde_json::Value {
    serde_json::from_str(&home.run(args).good()).unwrap()
}

#[test]
fn one_terminal_replays_and_another_one_steers() {
    let home = Home::new();
    let path = dataset(&home);
    let running = home.start(&["replay", &path, "--paused", "--hold", "-q", "--json"]);
    home.wait_for_rig("desk");

    let said = home.run(&["replay", "status"]).good();
    assert!(said.starts_with("paused at 0.000 of ") && said.contains("no set yet"), "{said}");
    let said = home.run(&["status"]).good();
    assert!(said.contains("replay  paused") && said.contains("desk/depth"), "{said}");
    let status = json(&home, &["replay", "seek", "0.5", "--json"]);
    let at = status["set"].as_u64().unwrap();
    assert!(status["position_s"].as_f64().unwrap() >= 0.5 && at > 0);
    assert_eq!(json(&home, &["replay", "step", "--json"])["set"], at + 1);
    assert_eq!(json(&home, &["replay", "step", "-1", "--json"])["set"], at);
    assert_eq!(json(&home, &["replay", "seek", "--set", "0", "--json"])["position_s"], 0.0);
    assert!(home.run(&["replay", "rate", "0.5"]).good().contains("0.5 x"));
    assert!(home.run(&["replay", "loop", "on"]).good().contains("round 1"));
    home.run(&["replay", "loop", "off"]).good();
    assert!(home.run(&["replay", "resume"]).good().starts_with("playing"));
    assert!(home.run(&["replay", "pause"]).good().starts_with("paused"));
    for (args, says) in [
        (&["replay", "rate", "11"][..], "out of range 0.1..=10"),
        (&["replay", "seek", "99"], "no set at 99 s"),
        (&["replay", "seek"], "required"),
        (&["replay", "seek", "1", "--set", "1"], "cannot be used"),
        (&["replay", "step", "0"], "0 sets"),
    ] {
        let ran = home.run(args);
        assert_eq!(ran.code, 2, "{args:?}: {}", ran.err);
        assert!(ran.err.contains(says), "{args:?}: {}", ran.err);
    }
    let tapped = home.run(&["tap", "desk/depth", "--count", "1"]).good();
    assert!(tapped.contains("replayed"), "who comes late gets the last frame: {tapped}");

    // A replay is recorded by a command, like cameras.
    let again = home.path().join("again");
    home.run(&["replay", "seek", "--set", "0"]).good();
    home.run(&["record", "start", "--out", again.to_str().unwrap(), "--name", "a"]).good();
    home.run(&["replay", "step"]).good();
    let back = home.run(&["replay", "step", "-1"]);
    assert_eq!(back.code, 1);
    assert!(back.err.contains("record stop"), "{}", back.err);
    home.run(&["record", "stop"]).good();
    home.run(&["verify", again.join("a").to_str().unwrap()]).good();

    support::wait(|| again.join("a/report.html").exists(), "a recording of a replay ends with its report");
    let ended = running.interrupt();
    assert_eq!(ended.code, 0, "{}", ended.err);
    let result: serde_json::Value = serde_json::from_str(&ended.out).unwrap();
    assert_eq!((result["paused"].as_bool(), result["recording"]["sets"].as_u64()), (Some(true), Some(1)));
    let none = home.run(&["replay", "status"]);
    assert_eq!(none.code, 1);
}

#[test]
fn a_recorded_replay_compares_equal() {
    let home = Home::new();
    let path = dataset(&home);
    let again = home.path().join("again");
    let out = again.to_str().unwrap();
    let said =
        home.run(&["replay", &path, "--as-fast-as-possible", "--record", out, "--name", "b", "-q"]).good();
    assert!(said.contains("recorded") && said.contains("lost 0"), "{said}");
    let copy = again.join("b");
    let page = std::fs::read_to_string(copy.join("report.html")).expect("a report, as a rig's recording has");
    assert!(page.contains("desk/depth"), "of this recording");
    let same = home.run(&["compare", &path, copy.to_str().unwrap()]);
    assert_eq!(same.code, 0, "{}{}", same.out, same.err);
    home.run(&["verify", "--decode", copy.to_str().unwrap()]).good();
    let looped = home.run(&["replay", &path, "--record", out, "--loop"]);
    assert_eq!(looped.code, 2, "{}", looped.err);
    let twice = home.run(&["replay", &path, &path]);
    assert_eq!(twice.code, 2, "{}", twice.err);
    assert!(twice.err.contains("both hold desk/"), "{}", twice.err);
}

#[test]
fn a_subscriber_that_is_killed_holds_nobody_up() {
    let home = Home::new();
    let path = dataset(&home);
    let running = home.start(&["replay", &path, "--as-fast-as-possible", "--paused", "-q", "--json"]);
    home.wait_for_rig("desk");
    let mut reader = home.start(&["tap", "desk/depth"]);
    // A step wakes the reader: its line is the sign that it has subscribed, and stopped it reads no further.
    home.run(&["replay", "step"]).good();
    reader.wait_for_line();
    reader.send("STOP");
    home.run(&["replay", "resume"]).good();
    let waiting = || json(&home, &["replay", "status", "--json"])["waiting_for"] == "desk/depth";
    support::wait(waiting, "nobody is waited for");
    reader.send("KILL");
    let ended = running.wait_for_end();
    assert_eq!(ended.code, 0, "{}", ended.err);
    let result: serde_json::Value = serde_json::from_str(&ended.out).unwrap();
    assert_eq!(result["sets"], result["length_sets"]);
}

/// `tests/data/golden` was recorded by 0.1.0 of 2026-11-23: JPEG colour, depth in ranks, refined depth and IMU samples. It
/// is never recorded anew.
#[test]
fn a_dataset_of_an_older_build_verifies_decodes_replays_and_compares_equal() {
    let home = Home::new();
    let golden = concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/data/golden");
    let verified = json(&home, &["verify", golden, "--decode", "--json"]);
    assert_eq!(
        (&verified["sets"], &verified["frames"], &verified["motion_samples"]),
        (&20.into(), &100.into(), &784.into())
    );
    assert_eq!(verified["findings"].as_array().map(Vec::len), Some(0), "{verified}");

    // The checksums are of the files that the build which recorded it wrote.
    let checksum = |args: &[&str], out: &std::path::Path| {
        home.run(&[&["cat", golden, "-q", "--out", out.to_str().unwrap()], args].concat()).good();
        let mut files = Vec::new();
        let mut folders = vec![out.to_owned()];
        while let Some(folder) = folders.pop() {
            for entry in std::fs::read_dir(folder).unwrap() {
                let path = entry.unwrap().path();
                if path.is_dir() {
                    folders.push(path);
                } else if path.extension().is_some_and(|e| e == "npy" || e == "csv")
                    && !path.ends_with("frames.csv")
                {
                    files.push(path);
                }
            }
        }
        files.sort();
        let mut sum = crc32fast::Hasher::new();
        for path in &files {
            sum.update(&std::fs::read(path).unwrap());
        }
        (files.len(), sum.finalize())
    };
    assert_eq!(checksum(&["--format", "npy"], &home.path().join("images")), (100, 0x937d_7c95));
    assert_eq!(checksum(&["--stream", "left/imu"], &home.path().join("imu")), (1, 0x2011_7181));

    let again = home.path().join("again");
    home.run(&[
        "replay",
        golden,
        "--as-fast-as-possible",
        "--record",
        again.to_str().unwrap(),
        "--name",
        "b",
        "-q",
    ])
    .good();
    let same = home.run(&["compare", golden, again.join("b").to_str().unwrap()]);
    assert_eq!(same.code, 0, "{}{}", same.out, same.err);
}
