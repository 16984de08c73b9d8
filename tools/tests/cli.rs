//! The binary as a person meets it: exit codes, messages, and one rig from start to stop.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

#[path = "support/home.rs"]
mod support;

use std::path::Path;
use support::{Home, depthrig};

#[test]
fn wrong_usage_is_2_and_says_what_was_meant() {
    let ran = depthrig().args(["statsu"]).output().unwrap();
    assert_eq!(ran.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&ran.stderr).contains("status"));
    for bad in [
        &["run"][..],
        &["tap", "no-slash"],
        &["demo", "--seconds", "0"],
        &["tap", "a/b", "--count", "0"],
        &["status", "--rig", "Bad Name"],
    ] {
        let ran = Home::new().run(bad);
        assert_eq!(ran.code, 2, "{bad:?}: {}", ran.err);
    }
}

#[test]
fn every_command_has_help_that_fits_and_an_entry_in_the_manual() {
    let help = Home::new().run(&["--help"]).good();
    assert!(help.contains("Exit codes:"));
    let folder = tempfile::tempdir().unwrap();
    Home::new().run(&["man", "--out", folder.path().to_str().unwrap()]).good();
    let commands = [
        "demo",
        "run",
        "record",
        "status",
        "top",
        "replay",
        "episode",
        "collect",
        "info",
        "report",
        "sessions",
        "edit",
        "export",
        "verify",
        "cat",
        "compare",
        "trim",
        "merge",
        "prune",
        "open",
        "config",
        "install",
        "calibrate",
        "cameras",
        "cloud",
        "doctor",
        "tap",
        "import",
        "stereo",
        "zed",
        "cdm",
        "eval",
        "scenes",
        "recover",
        "bench",
        "completions",
        "man",
    ];
    // A command is one word behind two spaces, and what it does behind more of them.
    let listed = help.lines().skip_while(|l| *l != "Commands:").skip(1).take_while(|l| !l.is_empty());
    let mut listed: Vec<_> = listed.filter_map(|l| l.strip_prefix("  ")?.split(' ').next()).collect();
    listed.retain(|name| !name.is_empty() && *name != "help");
    listed.sort_unstable();
    let mut known = commands.to_vec();
    known.sort_unstable();
    assert_eq!(listed, known, "the commands of --help and those that are looked at here");
    for command in commands {
        let text = Home::new().run(&[command, "--help"]).good();
        assert!(text.lines().all(|l| l.chars().count() <= 120), "{command} --help has a long line");
        assert!(folder.path().join(format!("depthrig-{command}.1")).exists(), "{command} has no manual page");
    }
    let text = Home::new().run(&["zed", "replay", "--help"]).good();
    assert!(text.contains("Exit codes:") && text.lines().all(|l| l.chars().count() <= 120), "{text}");
    assert!(folder.path().join("depthrig-zed-replay.1").exists());
    assert!(!help.contains("bench-reader"));
    for shell in ["bash", "zsh", "fish"] {
        assert!(Home::new().run(&["completions", shell]).good().contains("depthrig"), "{shell}");
    }
}

#[test]
fn without_a_rig_commands_say_how_to_start_one() {
    let home = Home::new();
    let collect = &["collect", "--task", "open the drawer"];
    for command in
        [&["status"][..], &["record", "stop"], &["tap", "d435/depth"], &["status", "--json"], collect]
    {
        let ran = home.run(command);
        assert_eq!(ran.code, 1, "{command:?}");
        assert!(ran.err.starts_with("depthrig: error: no rig"), "{command:?}: {}", ran.err);
        assert!(ran.err.contains("depthrig run"), "{command:?}: {}", ran.err);
        assert_eq!(ran.out, "");
    }
}

#[test]
fn top_needs_a_terminal_and_a_rig() {
    let ran = Home::new().run(&["top"]);
    assert_ne!(ran.code, 0);
    assert!(!ran.out.contains('\x1b'), "a pipe must not get terminal codes");
}

#[test]
fn config_show_is_a_configuration_that_check_accepts() {
    let home = Home::new();
    let text = home.run(&["config", "show"]).good();
    let file = home.write("rig.toml", &text);
    let said = home.run(&["config", "check", &file]).good();
    assert!(said.contains("good") && said.contains("7 cameras"), "{said}");
}

#[test]
fn config_check_names_every_problem_with_its_line() {
    let home = Home::new();
    let text = "rig = \"mount\"\n\n[sets]\nrate_hzz = 5.0\n\n[[camera]]\nname = \"Cam\"\nbackend = \"synthetic\"\nmodel = \"d435\"\n";
    let file = home.write("rig.toml", text);
    let ran = home.run(&["config", "check", &file]);
    assert_eq!(ran.code, 2, "{}", ran.err);
    assert!(ran.err.contains("rig.toml:4:") && ran.err.contains("rate_hz"), "{}", ran.err);
    assert!(ran.err.contains("rig.toml:7:"), "{}", ran.err);
    let ran = home.run(&["run", &file]);
    assert_eq!(ran.code, 2, "{}", ran.err);
}

#[test]
fn what_is_no_dataset_is_refused_by_name() {
    let home = Home::new();
    let text = home.write("notes.txt", "no dataset");
    for command in ["info", "verify", "prune"] {
        for path in ["does/not/exist", &text] {
            let ran = home.run(&[command, path]);
            assert_eq!(ran.code, 1, "{command} {path}: {}", ran.err);
            assert!(
                ran.err.starts_with("depthrig: error: ") && ran.err.contains(path),
                "{command}: {}",
                ran.err
            );
        }
    }
    let ran = home.run(&["replay", &text]);
    assert_ne!(ran.code, 0);
    assert!(ran.err.contains("notes.txt"), "{}", ran.err);
}

#[test]
fn a_closed_pipe_ends_quietly() {
    let mut child = depthrig()
        .args(["config", "show"])
        .stdout(std::process::Stdio::piped())
        .stderr(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    drop(child.stdout.take());
    let ran = child.wait_with_output().unwrap();
    assert_eq!(String::from_utf8_lossy(&ran.stderr), "");
    assert_eq!(ran.status.code(), Some(0));
}

#[test]
fn the_whole_way_of_a_small_rig() {
    let home = Home::new();
    home.images(6);
    let rig = home.rig_file("small");
    let running = home.start(&["run", &rig, "-q"]);
    home.wait_for_rig("small");

    let status: serde_json::Value = serde_json::from_str(&home.run(&["status", "--json"]).good()).unwrap();
    assert_eq!(status["rig"], "small");
    assert_eq!(status["cameras"][0]["state"], "streaming");
    let text = home.run(&["status"]).good();
    assert!(text.contains("desk/depth") && !text.contains('\x1b'), "{text}");

    let again = home.run(&["run", &rig]);
    assert_eq!(again.code, 1);
    assert!(
        again.err.contains("running already") && again.err.contains(&running.id().to_string()),
        "{}",
        again.err
    );

    let images = home.path().join("tapped");
    let said = home.run(&["tap", "desk/depth", "--count", "2", "--png", images.to_str().unwrap()]).good();
    assert_eq!(said.lines().filter(|l| l.starts_with("desk/depth #")).count(), 2, "{said}");
    let files: Vec<_> = std::fs::read_dir(&images).unwrap().map(|e| e.unwrap().path()).collect();
    assert_eq!(files.len(), 4, "{files:?}");
    let depth = files.iter().find(|f| !f.to_str().unwrap().contains("preview")).unwrap();
    assert!(home.is_a_source(depth), "the tapped depth is none of the images that the camera plays");
    let unknown = home.run(&["tap", "desk/infrared"]);
    assert_eq!(unknown.code, 1);
    assert!(unknown.err.contains("desk/depth"), "it names the streams that there are: {}", unknown.err);

    let out = home.path().join("data");
    let none = home.run(&["record", "stop"]);
    assert_eq!(none.code, 1, "{}", none.err);
    let elsewhere = home.path().join("elsewhere");
    let refused = home.run(&["record", "start", "--out", elsewhere.to_str().unwrap()]);
    assert!(refused.code != 0 && refused.err.contains("recording.allow"), "{}", refused.err);
    assert!(!elsewhere.exists());
    // Nine years of these small images are 5 TB, more than a disk for temporary files has.
    let first = ["record", "start", "--out", out.to_str().unwrap(), "--name", "first", "--scene", "desk"];
    let long = [&first[..], &["--for", "80000h"]].concat();
    let refused = home.run(&long);
    assert_eq!(refused.code, 1, "{}", refused.err);
    for part in ["needs about", "above the reserve of 0.0 GB", "minutes fit", "--force"] {
        assert!(refused.err.contains(part), "{}", refused.err);
    }
    assert!(!out.exists(), "nothing was begun");
    assert_eq!(home.run(&[&first[..], &["--for", "10"]].concat()).code, 2);
    home.run(&[&long[..], &["--force"]].concat()).good();
    let twice = home.run(&["record", "start", "--out", out.to_str().unwrap()]);
    assert_eq!(twice.code, 1);
    assert!(twice.err.contains("first"), "{}", twice.err);
    home.run(&["record", "note", "the cup was moved"]).good();
    home.wait_for_sets(5);
    let said = home.run(&["sessions", out.to_str().unwrap()]).good();
    assert!(said.contains("recording") && !said.contains("unfinished"), "{said}");
    let said = home.run(&["edit", out.join("first").to_str().unwrap(), "--scene", "table"]);
    assert_eq!(said.code, 2, "what is being recorded is not edited: {}", said.err);
    home.run(&["record", "stop"]).good();
    let dataset = out.join("first");
    // The end waits for the report for some seconds only.
    support::wait(|| dataset.join("report.html").exists(), "a recording ends with its report");
    let summary = running.interrupt();
    assert_eq!(summary.code, 0, "{}\n{}", summary.out, summary.err);

    check_dataset(&home, &dataset);
}

fn check_dataset(home: &Home, dataset: &Path) {
    let path = dataset.to_str().unwrap();
    let info: serde_json::Value = serde_json::from_str(&home.run(&["info", path, "--json"]).good()).unwrap();
    assert_eq!((&info["rig"], &info["scene"]), (&"small".into(), &"desk".into()));
    let sets = info["sets"].as_u64().unwrap();
    assert!(sets >= 5, "{sets} sets");
    let said = home.run(&["verify", path, "--decode"]).good();
    assert!(said.contains("whole"), "{said}");
    let page =
        std::fs::read_to_string(dataset.join("report.html")).expect("a recording ends with its report");
    assert!(page.contains("Whole: all ") && page.ends_with("</html>\n"), "{}", &page[page.len() - 200..]);
    let said = home.run(&["sessions", path]).good();
    assert!(said.contains("whole") && said.contains("desk"), "{said}");

    let replay: serde_json::Value =
        serde_json::from_str(&home.run(&["replay", path, "--as-fast-as-possible", "--json", "-q"]).good())
            .unwrap();
    assert_eq!(replay["sets"].as_u64(), Some(sets));

    // One byte in the middle of an image.
    let segment = dataset.join("seg_0000.mcap");
    let mut bytes = std::fs::read(&segment).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    std::fs::write(&segment, bytes).unwrap();
    let broken = home.run(&["verify", path]);
    assert_eq!(broken.code, 1, "{}{}", broken.out, broken.err);
    assert!(broken.out.contains("broken: seg_0000.mcap"), "{}", broken.out);
    let kept = home.run(&["report", path, "-q"]);
    assert!(kept.code == 2 && kept.err.contains("--overwrite"), "{}: {}", kept.code, kept.err);
    let report = home.run(&["report", path, "--overwrite", "-q"]);
    let page = std::fs::read_to_string(dataset.join("report.html")).unwrap();
    assert_eq!(report.code == 3, page.contains("Damaged: "), "{}{}", report.out, report.err);
}

#[test]
fn run_ends_after_its_time_and_records_with_the_given_labels() {
    let home = Home::new();
    home.images(4);
    let rig = home.rig_file("timed");
    let out = home.path().join("data");
    let said = home
        .run(&[
            "run",
            &rig,
            "--record",
            out.to_str().unwrap(),
            "--scene",
            "shelf",
            "--seconds",
            "1.5",
            "--json",
            "-q",
        ])
        .good();
    let summary: serde_json::Value = serde_json::from_str(&said).unwrap();
    assert_eq!(summary["lost"].as_array().unwrap().len(), 0);
    let path = summary["recording"]["path"].as_str().unwrap();
    assert!(path.ends_with("shelf"), "{path}");
    home.run(&["verify", path]).good();
}

#[test]
fn sigterm_closes_the_recording() {
    let home = Home::new();
    home.images(4);
    let rig = home.rig_file("term");
    let out = home.path().join("data");
    let running = home.start(&["run", &rig, "--record", out.to_str().unwrap(), "-q"]);
    home.wait_for_rig("term");
    home.wait_for_sets(2);
    let ended = running.signal("TERM");
    assert_eq!(ended.code, 0, "{}", ended.err);
    let dataset = std::fs::read_dir(&out).unwrap().next().unwrap().unwrap().path();
    home.run(&["verify", dataset.to_str().unwrap()]).good();
}

#[test]
fn an_output_that_cannot_be_written_is_named() {
    let home = Home::new();
    home.images(2);
    let rig = home.rig_file("blocked");
    let file = home.write("in_the_way", "a file, no folder");
    let ran = home.run(&["run", &rig, "--record", &file, "--seconds", "1"]);
    assert_ne!(ran.code, 0);
    assert!(ran.err.contains("in_the_way"), "{}", ran.err);
}

#[test]
fn a_run_that_lost_frames_ends_with_3_and_says_which() {
    let home = Home::new();
    let rig = home.write(
        "lossy.toml",
        "rig = \"lossy\"\n[[camera]]\nname = \"cam\"\nbackend = \"synthetic\"\nmodel = \"generic\"\ncheap = true\n\
         [[camera.fault]]\nkind = \"skip\"\nat_s = 0.5\ncount = 3\n",
    );
    let ran = home.run(&["run", &rig, "--seconds", "1.5", "-q"]);
    assert_eq!(ran.code, 3, "{}{}", ran.out, ran.err);
    // A busy computer may be too late for more.
    let lost = |line: &str| line.strip_prefix("lost: cam/color: ")?.split(' ').next()?.parse::<u64>().ok();
    let lost = ran.out.lines().find_map(lost).unwrap_or(0);
    assert!(lost >= 3 && ran.out.contains(&format!("({lost} device_gap)")), "{}", ran.out);
}

/// The option that a refusal advises exists: `run --record` suggests `--force`, and accepts it.
#[test]
fn a_run_that_will_not_fit_is_recorded_with_force() {
    let home = Home::new();
    let rig = home.path().join("rig.toml");
    // Ten weeks of this are 180 TB.
    let text = "rig = \"full\"\n[sets]\nrate_hz = 15.0\n[recording]\ncolor = \"raw\"\nreserve_mb = 16\nmin_minutes = \
                100000\n[[camera]]\nname = \"cam\"\nbackend = \"synthetic\"\ncheap = true\n[[camera.stream]]\nname = \
                \"color\"\nwidth = 1280\nheight = 720\n";
    std::fs::write(&rig, text).unwrap();
    let out = home.path().join("data");
    let record = ["run", rig.to_str().unwrap(), "--record", out.to_str().unwrap(), "--seconds", "1"];
    let refused = home.run(&record);
    assert!(refused.code == 1 && refused.err.contains("--force"), "{}: {}", refused.code, refused.err);
    assert!(!out.exists(), "nothing was begun");
    let forced = home.run(&[&record[..], &["--force"]].concat());
    // On a busy computer it may lose something, and says so.
    assert!([0, 3].contains(&forced.code), "{}: {}", forced.code, forced.err);
    assert_eq!(std::fs::read_dir(&out).unwrap().count(), 1);
    assert_eq!(home.run(&["run", rig.to_str().unwrap(), "--force"]).code, 2, "there is nothing to force");
}

/// A run of one camera that is not there exits with 3 and names it; a script must not take it for a recording.
#[test]
fn a_run_in_which_a_camera_never_gave_a_frame_ends_with_3() {
    let home = Home::new();
    let rig = home.write(
        "away.toml",
        "rig = \"away\"\n[[camera]]\nname = \"cam\"\nbackend = \"synthetic\"\nmodel = \"generic\"\ncheap = true\n\
         [[camera]]\nname = \"gone\"\nbackend = \"v4l2\"\nport = \"9-9.9\"\n[[camera.stream]]\nname = \"color\"\n",
    );
    let ran = home.run(&["run", &rig, "--seconds", "1", "-q"]);
    assert_eq!(ran.code, 3, "{}{}", ran.out, ran.err);
    assert!(ran.out.contains("lost: camera gone: no frame: "), "{}", ran.out);
    assert!(!ran.out.contains("camera cam"), "{}", ran.out);
}

/// A limit of the size of files is to a recording what a full disk is: it ends, its file is closed, the rig goes on.
#[test]
fn a_limit_of_the_size_of_files_ends_the_recording_and_not_the_rig() {
    let home = Home::new();
    let rig = home.write(
        "limited.toml",
        // Shared memory is files too: its 16 slots of 230 kB fit.
        "rig = \"limited\"\n[bus]\nslots = 16\n[sets]\nrate_hz = 30.0\n[recording]\ncolor = \"raw\"\nreserve_mb = 0\n\
         [[camera]]\nname = \"cam\"\nbackend = \"synthetic\"\ncheap = true\n\
         [[camera.stream]]\nname = \"color\"\nwidth = 320\nheight = 240\n",
    );
    let out = home.path().join("data");
    let program = depthrig().get_program().to_str().unwrap().to_owned();
    let limited = format!(
        "ulimit -f 4096; exec {program} --runtime-dir {} run {rig} --record {} --seconds 3 -q",
        home.path().join("run").display(),
        out.display()
    );
    let ran = support::Ran::of(&std::process::Command::new("bash").args(["-c", &limited]).output().unwrap());
    assert_eq!(ran.code, 3, "{}{}", ran.out, ran.err);
    assert!(ran.out.contains("ulimit -f"), "{}{}", ran.out, ran.err);
    let dataset = std::fs::read_dir(&out).unwrap().next().unwrap().unwrap().path();
    let found = home.run(&["verify", dataset.to_str().unwrap()]);
    assert!(found.code == 3 || found.code == 0, "{}{}", found.out, found.err);
}
