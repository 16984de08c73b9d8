//! `depthrig cameras`: its list against the plugged-in cameras; in use, forbidden, on USB2, unplugged.

use crate::checks::Checks;
use crate::daemon::{Daemon, drops, streams, summary};
use crate::{Scenario, system};
use anyhow::Context;
use depthrig_emulator::{Camera, Options, Speed};
use serde_json::Value;
use std::fs::{File, Permissions};
use std::os::unix::fs::PermissionsExt;
use std::os::unix::process::CommandExt;
use std::process::{Command, Stdio};
use std::time::Duration;

/// See the module.
pub const SCENARIO: Scenario = Scenario {
    name: "cameras",
    about: "depthrig cameras: free, on USB2, held by a process or a rig, forbidden, unplugged; every model",
    cost: 16,
    limit_s: 60,
    needs: "",
    run,
};

const TIMEOUT: Duration = Duration::from_secs(5);
const ENUMERATION: Duration = Duration::from_secs(15);
/// Any user but root.
const NOBODY: u32 = 65534;

/// The exit code and the list, as `user`.
pub fn listed(user: Option<u32>) -> anyhow::Result<(i32, Value)> {
    let mut command = Command::new("depthrig");
    command.args(["cameras", "--json", "--runtime-dir"]);
    command.arg(user.map_or("/tmp/rig/run".to_owned(), |id| format!("/tmp/run-{id}")));
    if let Some(id) = user {
        command.uid(id).gid(id);
    }
    let done = command.stderr(Stdio::inherit()).output().context("depthrig cameras")?;
    let text = String::from_utf8_lossy(&done.stdout);
    let json = serde_json::from_str(&text).with_context(|| format!("no JSON: {text}"))?;
    Ok((done.status.code().unwrap_or(-1), json))
}

/// The camera at the port of `camera`.
pub fn entry<'v>(listed: &'v Value, camera: &Camera) -> Option<&'v Value> {
    let port = camera.port_path()?;
    listed["cameras"].as_array()?.iter().find(|c| c["port"] == port.as_str())
}

fn run(checks: &mut Checks) -> anyhow::Result<()> {
    std::fs::create_dir_all("/tmp/rig")?;
    std::fs::set_permissions("/tmp", Permissions::from_mode(0o1777))?;
    system::modprobe("vhci-hcd", &[])?;
    system::modprobe("uvcvideo", &[])?;
    let (code, none) = listed(None)?;
    checks.equal("nothing is attached: exit code", code, 0);
    checks.equal("nothing is attached: cameras", none["cameras"].as_array().map(Vec::len), Some(0));

    let fast = Camera::plug("d435", Options::default())?;
    let slow = Camera::plug("d435", Options { speed: Speed::High, ..Options::default() })?;
    let twelve = || system::video_nodes().is_ok_and(|nodes| nodes.len() == 12);
    checks.that("two cameras have twelve nodes", system::wait_until(TIMEOUT, twelve), "");

    let (code, both) = listed(None)?;
    checks.equal("both are free: exit code", code, 0);
    free(checks, "the fast one", &both, &fast, 5000);
    free(checks, "the slow one", &both, &slow, 480);
    let problems = |v: &Value, camera| entry(v, camera).map_or(String::new(), |c| c["problems"].to_string());
    checks.that(
        "the one on USB2 is complained about",
        problems(&both, &slow).contains("USB2"),
        problems(&both, &slow),
    );
    checks.that("the other is not", !problems(&both, &fast).contains("USB2"), problems(&both, &fast));

    let node =
        entry(&both, &fast).and_then(|c| c["nodes"][2]["path"].as_str()).context("no third node")?.to_owned();
    held(checks, &fast, &slow, &node)?;
    forbidden(checks, &fast, &slow)?;

    fast.unplug()?;
    let six = || system::video_nodes().is_ok_and(|nodes| nodes.len() == 6);
    checks.that("unplugged, its nodes go", system::wait_until(TIMEOUT, six), "");
    let (_, rest) = listed(None)?;
    checks.that("unplugged, it is not listed", entry(&rest, &fast).is_none(), &rest);
    checks.equal("the other is", rest["cameras"].as_array().map(Vec::len), Some(1));
    drop(fast);
    drop(slow);
    every_model(checks)
}

/// One of each model, as a table and as JSON; one of them in a rig that runs, which notices nothing.
fn every_model(checks: &mut Checks) -> anyhow::Result<()> {
    let none = || system::video_nodes().is_ok_and(|nodes| nodes.is_empty());
    checks.that("all are unplugged", system::wait_until(TIMEOUT, none), "");
    let mut cameras = Vec::new();
    for (model, name, backend) in [
        ("d435", "D435", "realsense"),
        ("d405", "D405", "realsense"),
        ("d415", "D415", "realsense"),
        ("d455", "D455", "realsense"),
        ("l515", "L515", "l515"),
        ("zed2i", "ZED 2i", "zed"),
    ] {
        cameras.push((Camera::plug(model, Options::default())?, name, backend));
    }
    // Enumerated one after the other, and the drivers take them later still. Counting nodes is cheap, listing is not.
    let nodes: usize = cameras.iter().map(|(c, ..)| 2 * c.model().streams().count()).sum();
    let there = || system::video_nodes().is_ok_and(|there| there.len() == nodes);
    checks.that("each has its nodes", system::wait_until(ENUMERATION, there), nodes);
    let free = || {
        let states =
            listed(None).ok().and_then(|(_, v)| v["cameras"].as_array().cloned()).unwrap_or_default();
        states.iter().filter(|c| c["state"] == "free").count() == cameras.len()
    };
    checks.that("one of each model is there and free", system::wait_until(ENUMERATION, free), "");
    let (front, ..) = cameras.first().context("no camera")?;
    let keys = format!("serial = \"{}\"", front.serial());
    let stream = "[[camera.stream]]\nname = \"depth\"\nwidth = 640\nheight = 480\nrate_hz = 30.0";
    let rig = format!("[[camera]]\nname = \"front\"\nbackend = \"realsense\"\n{keys}\n{stream}\n");
    let daemon = Daemon::start(&rig)?;
    daemon.wait_until_streaming()?;
    let (_, all) = listed(None)?;
    for (camera, name, backend) in &cameras {
        let c = entry(&all, camera).cloned().unwrap_or_default();
        checks.equal(
            &format!("{name}: model and backend"),
            (&c["model"], &c["backend"]),
            (&(*name).into(), &(*backend).into()),
        );
        checks.equal(&format!("{name}: serial"), &c["serial"], camera.serial());
    }
    let c = entry(&all, front).cloned().unwrap_or_default();
    checks.equal("in a rig: state", &c["state"], "in_use");
    checks.equal("in a rig: which", &c["rig"], "\"vm\", camera \"front\"");
    for arguments in
        [&["cameras", "--nodes"][..], &["cameras", "--modes", "d405"], &["doctor", "/tmp/rig/rig.toml"]]
    {
        let mut command = Command::new("depthrig");
        let text = command.args(arguments).args(["--runtime-dir", "/tmp/rig/run"]).output()?.stdout;
        let text = String::from_utf8_lossy(&text);
        println!("$ depthrig {}\n{text}", arguments.join(" "));
        let longest = text.lines().map(|line| line.chars().count()).max().unwrap_or(0);
        checks.that(&format!("{}: lines fit", arguments.join(" ")), (1..=120).contains(&longest), longest);
    }
    let status = daemon.status()?;
    let camera = status.cameras.first().context("no camera in the status")?;
    checks.equal("the rig was not disturbed: frames lost", drops(camera), "");
    checks.equal("the rig was not disturbed: reconnects", camera.reconnects, 0);
    checks.that("the rig streams", streams(camera), summary(&status));
    daemon.stop()?;
    drop(cameras);
    checks.that("all are unplugged again", system::wait_until(TIMEOUT, none), "");
    Ok(())
}

/// The complete entry of a free camera.
fn free(checks: &mut Checks, name: &str, listed: &Value, camera: &Camera, mbps: u64) {
    let Some(c) = entry(listed, camera) else {
        checks.that(&format!("{name} is listed at its port"), false, listed);
        return;
    };
    for (key, expected) in [
        ("model", Value::from("D435")),
        ("backend", Value::from("realsense")),
        ("state", Value::from("free")),
        ("rig", Value::Null),
        ("serial", Value::from(camera.serial())),
        ("usb_id", Value::from("8086:0b07")),
        ("usb_mbps", Value::from(mbps)),
        ("calibration", Value::from("factory")),
        ("kernel_metadata", Value::from("full")),
    ] {
        checks.equal(&format!("{name}: {key}"), &c[key], &expected);
    }
    let count =
        |role: &str| c["nodes"].as_array().map_or(0, |n| n.iter().filter(|n| n["role"] == role).count());
    checks.equal(&format!("{name}: nodes"), (count("images"), count("metadata"), count("usb")), (3, 3, 1));
    let has = |stream: &str, format: &str| {
        let is = |m: &Value| {
            m["stream"] == stream && m["format"] == format && m["width"] == 640 && m["height"] == 480
        };
        c["modes"].as_array().is_some_and(|modes| modes.iter().any(is))
    };
    checks.that(&format!("{name}: depth of 640x480"), has("depth", "z16"), &c["modes"]);
    let firmware = c["firmware"].as_str().unwrap_or_default();
    checks.that(&format!("{name}: firmware"), firmware.split('.').count() == 4, firmware);
}

/// Another program has a node open: it is named, and the camera is left alone.
fn held(checks: &mut Checks, camera: &Camera, other: &Camera, node: &str) -> anyhow::Result<()> {
    let mut holder = Command::new("sleep").arg("1000").stdin(File::open(node)?).spawn()?;
    let (code, listed) = listed(None)?;
    let c = entry(&listed, camera).cloned().unwrap_or_default();
    checks.equal("held: exit code", code, 0);
    checks.equal("held: state", &c["state"], "in_use");
    checks.equal("held: by whom", &c["held_by"][0]["pid"], holder.id());
    checks.equal("held: it is not asked", &c["serial"], &Value::Null);
    checks.equal("the other is free", entry(&listed, other).map(|c| c["state"].clone()), Some("free".into()));
    holder.kill()?;
    holder.wait()?;
    Ok(())
}

/// A user without permission to open a node gets the udev rule that grants it; data of `/sys` is listed all the same.
fn forbidden(checks: &mut Checks, camera: &Camera, other: &Camera) -> anyhow::Result<()> {
    for node in system::video_nodes()? {
        std::fs::set_permissions(&node, Permissions::from_mode(0o000))?;
    }
    let (code, listed) = listed(Some(NOBODY))?;
    checks.equal("forbidden: exit code", code, 3);
    for camera in [camera, other] {
        let c = entry(&listed, camera).cloned().unwrap_or_default();
        checks.equal("forbidden: state", &c["state"], "denied");
        checks.equal("forbidden: model", &c["model"], "D435");
    }
    let why = listed["not_asked"].to_string();
    checks.that("forbidden: the rule is named", why.contains("depthrig install --print"), why);
    for node in system::video_nodes()? {
        std::fs::set_permissions(&node, Permissions::from_mode(0o660))?;
    }
    Ok(())
}
