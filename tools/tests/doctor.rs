//! `depthrig cameras` and `depthrig doctor` from the command line, on this computer and on fake ones.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

#[path = "support/home.rs"]
mod support;

use depthrig_usb::fake::{FakeDevice, FakeTree};
use serde_json::Value;
use support::{Home, Ran};

fn parsed(ran: &Ran) -> Value {
    serde_json::from_str(&ran.out).unwrap_or_else(|e| panic!("{e}\n{}\n{}", ran.out, ran.err))
}

fn ids(report: &Value) -> Vec<&str> {
    report["findings"].as_array().unwrap().iter().map(|f| f["id"].as_str().unwrap()).collect()
}

/// Whatever this computer is like, the exit code follows the verdict, and the rig's own cameras are fine.
#[test]
fn a_rig_of_images_is_examined_and_nothing_is_left_behind() {
    let home = Home::new();
    home.images(3);
    let rig = home.rig_file("pics");
    let before = std::fs::read_dir(home.path()).unwrap().count();
    let ran = home.run(&["doctor", &rig, "--json"]);
    let report = parsed(&ran);
    let code = match report["verdict"].as_str().unwrap() {
        "error" => 1,
        "warning" => 3,
        _ => 0,
    };
    assert_eq!(ran.code, code, "{}", ran.out);
    assert!(!ids(&report).iter().any(|id| id.starts_with("camera")), "{}", ran.out);
    let camera = &report["cameras"][0];
    assert_eq!((camera["name"].as_str(), camera["streams"].as_array().unwrap().len()), (Some("desk"), 2));
    assert_eq!(camera["streams"][1]["stream"], "depth");
    // 64x48: 3 bytes of colour, 2 of depth, 48 slots.
    assert_eq!(report["shm_needed_bytes"], 64 * 48 * 5 * 48);
    assert!(report["disk"]["needed_bytes_per_s"].as_f64().unwrap() > 0.0);
    // The runtime folder is all that is new.
    let after = std::fs::read_dir(home.path()).unwrap().count();
    assert!(after <= before + 1, "{after} entries, {before} before");
    let text = home.run(&["doctor", &rig, "--no-disk"]);
    assert_eq!(text.code, code);
    assert!(text.out.contains("desk") && text.out.contains("shared memory"), "{}", text.out);
    assert!(text.out.lines().all(|l| l.chars().count() <= 120), "{}", text.out);
}

#[test]
fn a_rig_that_runs_is_found_running() {
    let home = Home::new();
    home.images(3);
    let rig = home.rig_file("pics");
    let running = home.start(&["run", &rig]);
    home.wait_for_rig("pics");
    let ran = home.run(&["doctor", &rig, "--json", "--no-disk"]);
    assert_eq!(ran.code, 1, "{}", ran.out);
    assert!(ids(&parsed(&ran)).contains(&"rig_running"), "{}", ran.out);
    let other = home.run(&["doctor", &rig, "--json", "--no-disk", "--rig", "another"]);
    assert!(!ids(&parsed(&other)).contains(&"rig_running"), "{}", other.out);
    assert_eq!(running.interrupt().code, 0);
}

#[test]
fn a_wrong_file_is_2_and_missing_images_are_1() {
    let home = Home::new();
    let wrong = home.write("wrong.toml", "rig = 7\n");
    assert_eq!(home.run(&["doctor", &wrong]).code, 2);
    let text = "rig = \"a\"\n[[camera]]\nname = \"desk\"\nbackend = \"files\"\nmanifest = \"none.toml\"\n";
    let ran = home.run(&["doctor", &home.write("rig.toml", text), "--no-disk"]);
    assert_eq!(ran.code, 1, "{}", ran.out);
    assert!(ran.out.contains("camera_unusable") && ran.out.contains("none.toml"), "{}", ran.out);
    assert!(ran.out.trim_end().lines().last().unwrap().starts_with("not ready: "), "{}", ran.out);
}

#[test]
fn what_is_attached_is_listed_with_port_speed_and_holder() {
    let home = Home::new();
    let tree = FakeTree::new(&home.path().join("computer"));
    tree.plug(&FakeDevice::new("4-1.2", 0));
    tree.plug(&FakeDevice {
        id: (0x8086, 0x0b5b),
        speed: 480,
        version: " 2.10",
        ..FakeDevice::new("3-4", 10)
    });
    tree.process(4711, "obs", &["/dev/video4"]);
    let root = home.path().join("computer");
    let root = root.to_str().unwrap();
    let ran = home.run(&["cameras", "--json", "--sys-root", root]);
    let found = parsed(&ran);
    let [slow, held] = found["cameras"].as_array().unwrap().as_slice() else { panic!("{}", ran.out) };
    assert_eq!(
        (slow["model"].as_str(), slow["port"].as_str(), slow["usb_mbps"].as_u64()),
        (Some("D405"), Some("3-4"), Some(480))
    );
    assert!(slow["problems"][0].as_str().unwrap().contains("USB2"), "{}", ran.out);
    assert_eq!((held["state"].as_str(), &held["held_by"][0]["pid"]), (Some("in_use"), &Value::from(4711)));
    assert_eq!(held["controller"], "0000:00:14.0");

    let text = home.run(&["cameras", "--nodes", "--modes", "--sys-root", root]).out;
    for part in
        ["D435", "4-1.2", "USB3 5 Gbit/s", "in use by obs (process 4711)", "USB2 480 Mbit/s", "video4"]
    {
        assert!(text.contains(part), "{part} in\n{text}");
    }
    let one = home.run(&["cameras", "d405", "--sys-root", root]).out;
    assert!(one.contains("D405") && !one.contains("D435"), "{one}");
}

#[test]
fn where_nothing_is_attached_that_is_said() {
    let home = Home::new();
    let tree = home.path().join("computer");
    FakeTree::new(&tree);
    let said = home.run(&["cameras", "--sys-root", tree.to_str().unwrap()]).good();
    assert_eq!(said.trim(), "no camera is attached");
}
