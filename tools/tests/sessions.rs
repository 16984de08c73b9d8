//! Listing, editing and recovering datasets from the command line.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

#[path = "support/home.rs"]
mod support;

use depthrig_bus::{FrameHeader, HostTime, Intrinsics, PixelFormat, Pose, UtcPair};
use depthrig_recorder::{
    RecordFrame, RecordSet, Recorder, RecorderOptions, Session, StreamRecord,
    fs::{Fs, RealFs},
};
use std::collections::BTreeMap;
use std::fs::Permissions;
use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, SystemTime};
use support::Home;

/// One set of one small image.
fn write(dir: &Path, scene: &str, started_utc_ns: i64) {
    record(dir, scene, started_utc_ns).finish().unwrap();
}

/// As [`write`], up to where the files are closed.
fn record(dir: &Path, scene: &str, started_utc_ns: i64) -> Recorder {
    let mut session = Session::new(dir.file_name().unwrap().to_str().unwrap(), "rig");
    (session.scene, session.operator) = (scene.into(), "ada".into());
    session.started_utc_ns = started_utc_ns;
    session.streams = vec![StreamRecord {
        id: "desk/depth".parse().unwrap(),
        model: String::new(),
        serial: String::new(),
        format: PixelFormat::Z16,
        width: 8,
        height: 8,
        rate_hz: 30.0,
        depth_unit_m: 0.001,
        calibration: String::new(),
        intrinsics: Intrinsics::default(),
        pose: Pose::IDENTITY,
    }];
    let options = RecorderOptions { min_free_bytes: 0, ..RecorderOptions::default() };
    let r = Recorder::create(Arc::new(RealFs), dir, session, options).unwrap();
    r.push(set(started_utc_ns)).unwrap();
    r
}

/// The set that [`record`] pushes.
fn set(started_utc_ns: i64) -> RecordSet {
    let mut header = FrameHeader::default();
    header.set_image(PixelFormat::Z16, 8, 8);
    header.set_names("rig", &"desk/depth".parse().unwrap());
    let utc = UtcPair { mono: HostTime::from_ns(1), utc_ns: started_utc_ns, width_ns: 1 };
    let frame = RecordFrame { stream: 0, header, pixels: Box::new(vec![1; 128]) };
    RecordSet {
        id: 1,
        tick: HostTime::from_ns(1),
        utc,
        frames: vec![frame],
        missing: vec![],
        motion: Vec::new(),
        signals: Vec::new(),
        spread_ns: 0,
    }
}

/// Every file of a folder: its bytes and when they were last written.
fn files(dir: &Path) -> BTreeMap<String, (Vec<u8>, SystemTime)> {
    let entries = std::fs::read_dir(dir).unwrap().map(Result::unwrap);
    let read = |e: std::fs::DirEntry| {
        let modified = e.metadata().unwrap().modified().unwrap();
        (e.file_name().into_string().unwrap(), (std::fs::read(e.path()).unwrap(), modified))
    };
    entries.map(read).collect()
}

fn names(json: &str) -> Vec<String> {
    let list: serde_json::Value = serde_json::from_str(json).unwrap();
    list.as_array().unwrap().iter().map(|e| e["name"].as_str().unwrap().to_owned()).collect()
}

#[test]
fn a_folder_is_listed_sorted_and_filtered() {
    let home = Home::new();
    let data = home.path().join("datasets");
    for (name, scene, at) in [("b", "Kitchen", 3), ("a", "lab\n2", 1), ("c", "kitchen sink", 2)] {
        write(&data.join(name), scene, at * 1_000_000_000_000_000_000 / 2);
    }
    let data = data.to_str().unwrap();
    let listed = |more: &[&str]| names(&home.run(&[&["sessions", data, "--json"], more].concat()).good());
    assert_eq!(listed(&[]), ["a", "c", "b"]);
    assert_eq!(listed(&["--sort", "name", "--reverse"]), ["c", "b", "a"]);
    assert_eq!(listed(&["--scene", "KITCHEN"]), ["c", "b"]);
    assert_eq!(listed(&["--filter", "sink"]), ["c"]);
    assert_eq!(listed(&["--filter", "Ada"]).len(), 3);
    let text = home.run(&["sessions", data]).good();
    assert!(text.contains("lab 2") && text.contains("3 datasets, 3 sets"), "{text}");
    assert!(!home.run(&["sessions", data, "--sort", "colour"]).err.is_empty());

    // One that is bad makes the exit code 3, and is in the list.
    std::fs::remove_file(Path::new(data).join("b/seg_0000.mcap")).unwrap();
    let ran = home.run(&["sessions", data]);
    assert_eq!(ran.code, 3, "{}", ran.err);
    assert!(ran.out.contains("damaged:") && ran.out.contains("there are no segments"), "{}", ran.out);
    assert_eq!(home.run(&["sessions", data, "--filter", "a"]).code, 3, "operator ada has all of them");
    assert_eq!(home.run(&["sessions", data, "--scene", "sink"]).code, 0);
    let ran = home.run(&["sessions", "/no/such/folder"]);
    assert_eq!(ran.code, 1);
    assert!(ran.err.contains("/no/such/folder"), "{}", ran.err);
}

#[test]
fn an_edit_shows_in_info_and_leaves_its_history() {
    let home = Home::new();
    let dir = home.path().join("first");
    write(&dir, "old scene", 1_700_000_000_000_000_000);
    let at = dir.to_str().unwrap();
    assert!(home.run(&["edit", at]).good().contains("never edited"));
    let said = home.run(&["edit", at, "--scene", "new scene", "--note", "bumped"]).good();
    assert!(said.contains("\"old scene\" is now \"new scene\"") && said.contains("note added"), "{said}");
    assert!(home.run(&["edit", at, "--scene", "new scene"]).good().contains("nothing to change"));
    assert!(home.run(&["info", at]).good().contains("new scene"));
    let json = home.run(&["edit", at, "--rename", "second", "--json"]).good();
    let json: serde_json::Value = serde_json::from_str(&json).unwrap();
    assert_eq!(json["changed"][0]["after"], "second");
    assert_eq!(json["history"].as_array().unwrap().len(), 3);
    let to = home.path().join("second");
    assert!(to.join("seg_0000.mcap").exists() && !dir.exists());
    assert!(home.run(&["verify", to.to_str().unwrap()]).good().contains("whole"));
    for bad in [&["--rename", "a/b"][..], &["--note", " "]] {
        let ran = home.run(&[&["edit", to.to_str().unwrap()], bad].concat());
        assert_eq!(ran.code, 2, "{bad:?}: {}", ran.err);
    }
    assert_eq!(home.run(&["edit", "/no/such/dataset", "--scene", "x"]).code, 1);
}

#[test]
fn info_tells_what_a_dataset_says_that_it_lost() {
    let home = Home::new();
    let dir = home.path().join("data");
    let started = 1_700_000_000_000_000_000;
    write(&dir, "sink", started);
    assert!(!home.run(&["info", dir.to_str().unwrap()]).good().contains("lost: "));

    let dir = home.path().join("less");
    let recorder = record(&dir, "sink", started);
    recorder.push(set(started)).unwrap_err(); // this id is taken
    recorder.finish().unwrap();
    for (path, said) in [
        (dir.clone(), "lost: 1 of 2 sets were not recorded: bad_set"),
        // Its last account has it too.
        (dir.join("seg_0000.mcap"), "lost: 1 sets were not recorded: bad_set"),
    ] {
        let ran = home.run(&["info", path.to_str().unwrap()]);
        assert_eq!(ran.code, 3, "{}{}", ran.out, ran.err);
        assert_eq!(ran.out.lines().filter(|l| l.starts_with("lost: ")).collect::<Vec<_>>(), [said]);
    }
}

#[test]
fn a_report_is_a_page_or_json_and_its_exit_code_says_how_it_is() {
    let home = Home::new();
    let dir = home.path().join("data");
    write(&dir, "a <b>", 1_700_000_000_000_000_000);
    let at = dir.to_str().unwrap();
    let said = home.run(&["report", at, "-q"]).good();
    assert!(said.contains("Whole: ") && said.contains("report.html"), "{said}");
    assert!(std::fs::read_to_string(dir.join("report.html")).unwrap().contains("a &lt;b&gt;"));

    let other = home.path().join("other.html");
    let json = home.run(&["report", at, "--json", "--out", other.to_str().unwrap(), "-q"]).good();
    let json: serde_json::Value = serde_json::from_str(&json).unwrap();
    assert_eq!((&json["verdict"]["health"], &json["sets"]["count"]), (&"whole".into(), &1.into()));
    assert!(other.exists());

    let segment = dir.join("seg_0000.mcap");
    assert_eq!(home.run(&["report", segment.to_str().unwrap(), "-q"]).code, 2, "where should the page be?");
    std::fs::rename(&segment, dir.join("seg_0000.mcap.part")).unwrap();
    // An existing file is kept, whatever its name.
    std::fs::write(dir.join("report.html"), "mine").unwrap();
    let ran = home.run(&["report", at, "-q"]);
    assert!(ran.code == 2 && ran.err.contains("report.html: exists"), "{}: {}", ran.code, ran.err);
    assert!(ran.err.contains("--overwrite"), "{}", ran.err);
    assert_eq!(std::fs::read_to_string(dir.join("report.html")).unwrap(), "mine");
    let ran = home.run(&["report", at, "--overwrite", "-q"]);
    assert_eq!(ran.code, 3, "{}", ran.err);
    assert!(ran.out.contains("depthrig recover"), "{}", ran.out);
    assert_eq!(home.run(&["report", "/no/such/dataset", "-q"]).code, 1);
}

#[test]
fn a_crash_is_recovered_once_and_the_exit_code_says_what_it_cost() {
    let home = Home::new();
    let dir = home.path().join("cut");
    let recorder = record(&dir, "sink", 1_700_000_000_000_000_000);
    while recorder.progress().sets.recorded < 1 {
        std::thread::sleep(Duration::from_millis(1));
    }
    let at = dir.to_str().unwrap();
    let refused = home.run(&["recover", at, "-q"]);
    assert_eq!(refused.code, 1, "{}", refused.err);
    assert!(refused.err.contains("is being recorded right now"), "{}", refused.err);
    drop(recorder); // as a crash does
    let before = files(&dir);

    let plan = home.run(&["recover", at, "--dry-run", "-q"]);
    assert_eq!(plan.code, 3, "{}", plan.err);
    assert!(plan.out.contains("can be recovered, 1 set") && plan.out.contains("lost: "), "{}", plan.out);
    assert!(files(&dir) == before, "a dry run changed something");
    if rustix::process::geteuid().is_root() {
        println!("skipped: root may write into every folder");
    } else {
        // A read-only folder is detected without writing to it.
        let set_mode = |mode| std::fs::set_permissions(&dir, Permissions::from_mode(mode)).unwrap();
        set_mode(0o555);
        let refused = [&["recover", at, "-q"][..], &["recover", at, "--dry-run", "-q"]].map(|c| home.run(c));
        set_mode(0o755);
        for ran in &refused {
            assert!(
                ran.code == 1 && ran.err.contains("choose a folder that this user may write"),
                "{}",
                ran.err
            );
        }
        assert_eq!(refused[0].err, refused[1].err);
    }
    let lock = RealFs.lock(&dir).unwrap();
    assert_eq!(home.run(&["recover", at, "-q"]).code, 1);
    assert!(files(&dir) == before, "a refused recovery changed something");
    drop(lock);

    let json = |ran: support::Ran, code| -> serde_json::Value {
        assert_eq!(ran.code, code, "{}{}", ran.out, ran.err);
        serde_json::from_str(&ran.out).unwrap()
    };
    let done = json(home.run(&["recover", at, "--json", "-q"]), 3);
    assert_eq!((&done["changed"], &done["sets"]), (&true.into(), &1.into()));
    assert_eq!(done["segments"][0]["action"], "rebuilt");
    assert!(done["lost"][0].as_str().unwrap().contains("cut off"), "{done}");
    let recovered = files(&dir);
    assert_eq!(recovered.keys().collect::<Vec<_>>(), ["seg_0000.mcap", "session.toml"]);
    let info = json(home.run(&["info", at, "--json"]), 3);
    assert_eq!((&info["sets"], &info["scene"]), (&1.into(), &"sink".into()));
    assert_eq!(info["lost"][0], done["lost"][0], "{info}");

    let again = json(home.run(&["recover", at, "--json", "-q"]), 0);
    assert_eq!((&again["changed"], &again["lost"]), (&false.into(), &serde_json::json!([])));
    assert!(home.run(&["recover", at, "-q"]).good().contains("nothing to do, 1 set"));
    assert!(files(&dir) == recovered, "a second time changed something");

    // Killed between its index and its name: nothing is lost.
    let named = home.path().join("named");
    write(&named, "sink", 1_700_000_000_000_000_000);
    let mut session = depthrig_recorder::Dataset::open(&named).unwrap().session().clone();
    session.outcome = None;
    std::fs::write(named.join("session.toml"), session.to_toml().unwrap()).unwrap();
    let whole = std::fs::read(named.join("seg_0000.mcap")).unwrap();
    std::fs::rename(named.join("seg_0000.mcap"), named.join("seg_0000.mcap.part")).unwrap();
    assert!(home.run(&["recover", named.to_str().unwrap(), "-q"]).good().contains("got its final name"));
    assert!(std::fs::read(named.join("seg_0000.mcap")).unwrap() == whole);

    assert_eq!(home.run(&["recover", "/no/such/dataset", "-q"]).code, 1);
    assert_eq!(home.run(&["recover"]).code, 2);
}
