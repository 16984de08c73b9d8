//! `depthrig doctor` on emulated cameras: a rig that is well, and one with everything that can be wrong with a camera.

use crate::checks::Checks;
use crate::{Scenario, system};
use anyhow::Context;
use depthrig_emulator::{Camera, Options, Speed};
use serde_json::Value;
use std::fs::File;
use std::process::{Command, Stdio};
use std::time::Duration;

/// See the module.
pub const SCENARIO: Scenario = Scenario {
    name: "doctor",
    about: "depthrig doctor: a good rig, and cameras that are missing, held, on USB2, asked for modes they lack",
    cost: 1,
    limit_s: 60,
    needs: "",
    run,
};

const TIMEOUT: Duration = Duration::from_secs(5);

/// The exit code and the report on a rig of `cameras`.
fn examined(cameras: &str) -> anyhow::Result<(i32, Value)> {
    std::fs::create_dir_all("/tmp/rig")?;
    let file = "/tmp/rig/doctor.toml";
    let head = "rig = \"vm\"\n[recording]\ndirectory = \"/tmp\"\nreserve_mb = 1\nmin_minutes = 0\n";
    std::fs::write(file, format!("{head}{cameras}"))?;
    let arguments = ["doctor", file, "--json", "--no-disk", "--runtime-dir", "/tmp/rig/run"];
    let done = Command::new("depthrig").args(arguments).stderr(Stdio::inherit()).output()?;
    let text = String::from_utf8_lossy(&done.stdout);
    let json = serde_json::from_str(&text).with_context(|| format!("no JSON: {text}"))?;
    Ok((done.status.code().unwrap_or(-1), json))
}

fn camera(name: &str, keys: &str) -> String {
    format!("[[camera]]\nname = \"{name}\"\nbackend = \"realsense\"\n{keys}\n")
}

const VGA: &str = "[[camera.stream]]\nname = \"depth\"\nwidth = 640\nheight = 480\nrate_hz = 30.0\n";

/// The findings about a camera: kind and all of its words.
fn findings(report: &Value, camera: &str) -> Vec<(String, String)> {
    let of = |f: &&Value| f["camera"] == camera;
    let finding = |f: &Value| (f["id"].as_str().unwrap_or_default().to_owned(), f.to_string());
    report["findings"].as_array().map_or(Vec::new(), |all| all.iter().filter(of).map(finding).collect())
}

/// Whether `camera` has the finding `id`, whose words have `part`.
fn has(checks: &mut Checks, report: &Value, camera: &str, id: &str, part: &str) {
    let all = findings(report, camera);
    let holds = all.iter().any(|(i, text)| i == id && text.contains(part));
    checks.that(&format!("{camera}: {id}"), holds, format!("{all:?}"));
}

fn run(checks: &mut Checks) -> anyhow::Result<()> {
    system::modprobe("vhci-hcd", &[])?;
    system::modprobe("uvcvideo", &[])?;
    let front = Camera::plug("d435", Options::default())?;
    let slow = Camera::plug("d435", Options { speed: Speed::High, hub: 1, ..Options::default() })?;
    let taken = Camera::plug("d405", Options::default())?;
    let ready = || system::video_nodes().is_ok_and(|nodes| nodes.len() >= 18);
    checks.that("three cameras are there", system::wait_until(TIMEOUT, ready), "");
    let port = |c: &Camera| c.port_path().context("a camera without a port");

    let well = camera("front", &format!("serial = \"{}\"\n{VGA}", front.serial()));
    let (code, report) = examined(&well)?;
    let of_front = findings(&report, "front");
    // The kernel may put it to sleep: there is no udev in this machine.
    let only_sleep = of_front.iter().all(|(id, _)| id == "autosuspend");
    checks.that("a good camera has no finding but autosuspend", only_sleep, format!("{of_front:?}"));
    checks.that("a good rig can run", code == 0 || code == 3, format!("{code}: {report}"));
    checks.equal("its device", &report["cameras"][0]["port"], port(&front)?.as_str());
    let stream = &report["cameras"][0]["streams"][0];
    checks.equal("its mode", (&stream["width"], &stream["rate_hz"]), (&640.into(), &30.0.into()));
    let mbit_s = stream["usb_mbit_s"].as_f64().unwrap_or(0.0);
    checks.that("its bandwidth", (mbit_s - 147.456).abs() < 1e-6, mbit_s);
    checks.that(
        "a link carries it",
        report["links"][0]["load_mbit_s"] == stream["usb_mbit_s"],
        &report["links"],
    );

    let node = std::fs::canonicalize(format!("/sys/bus/usb/devices/{0}/{0}:1.0/video4linux", port(&taken)?))?;
    let name = std::fs::read_dir(node)?.next().context("no node")??.file_name();
    let mut holder = Command::new("sleep")
        .arg("1000")
        .stdin(File::open(format!("/dev/{}", name.to_string_lossy()))?)
        .spawn()?;
    let serial = front.serial();
    let mistyped = format!("{}9", serial.get(..serial.len() - 1).unwrap_or_default());
    let wide = "[[camera.stream]]\nname = \"depth\"\nwidth = 1280\nheight = 720\nrate_hz = 30.0\n";
    let rig = [
        camera("mistyped", &format!("serial = \"{mistyped}\"")),
        camera("nowhere", "port = \"9-9\""),
        camera("slow", &format!("port = \"{}\"\n{wide}", port(&slow)?)),
        camera("taken", &format!("port = \"{}\"", port(&taken)?)),
        camera("any", ""),
    ];
    let (code, report) = examined(&rig.concat())?;
    holder.kill()?;
    holder.wait()?;
    checks.equal("a rig that cannot run: exit code", code, 1);
    has(checks, &report, "mistyped", "camera_missing", serial);
    has(checks, &report, "nowhere", "camera_missing", &port(&front)?);
    has(checks, &report, "slow", "usb2", &port(&slow)?);
    has(checks, &report, "slow", "mode_missing", "1280x720");
    has(checks, &report, "taken", "camera_in_use", &format!("process {}", holder.id()));
    has(checks, &report, "any", "camera_ambiguous", &port(&taken)?);

    front.unplug()?;
    let gone = || system::video_nodes().is_ok_and(|nodes| nodes.len() < 18);
    checks.that("unplugged, its nodes go", system::wait_until(TIMEOUT, gone), "");
    let (code, report) = examined(&well)?;
    checks.equal("unplugged: exit code", code, 1);
    has(checks, &report, "front", "camera_missing", "plug it in");
    Ok(())
}
