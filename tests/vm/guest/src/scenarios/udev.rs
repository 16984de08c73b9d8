//! The udev rules of `depthrig install` under the real udev, where the host has it: modes, group, no autosuspend.

use crate::checks::Checks;
use crate::{Scenario, system};
use anyhow::Context;
use depthrig_emulator::{Camera, Options};
use depthrig_realsense::iio;
use depthrig_usb::SysRoot;
use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

/// See the module.
pub const SCENARIO: Scenario = Scenario {
    name: "udev",
    about: "depthrig install --apply under udev: who may open a camera, and that it is left awake",
    cost: 1,
    limit_s: 60,
    needs: "",
    run,
};

const UDEVADM: &str = "/bin/udevadm";
const TIMEOUT: Duration = Duration::from_secs(5);
/// The group `video` of Debian.
const VIDEO: u32 = 44;

fn run(checks: &mut Checks) -> anyhow::Result<()> {
    if !Path::new(UDEVADM).exists() {
        checks.note("the host has no udevadm (Debian package udev), so the rules were not tried");
        return Ok(());
    }
    system::modprobe("vhci-hcd", &[])?;
    system::modprobe("uvcvideo", &[])?;
    for module in ["usbhid", "hid-sensor-hub", "hid-sensor-accel-3d", "hid-sensor-gyro-3d"] {
        system::modprobe(module, &[])?;
    }
    let camera = Camera::plug("d455", Options::default())?;
    let six = || system::video_nodes().is_ok_and(|nodes| nodes.len() == 6);
    checks.that("six nodes", system::wait_until(TIMEOUT, six), "");
    let port = camera.port_path().context("a camera without a port")?;
    let power = format!("/sys/bus/usb/devices/{port}/power/control");
    checks.equal("without rules the kernel may put it to sleep", fs::read_to_string(&power)?.trim(), "auto");
    camera.unplug()?;
    checks.that("it is gone", system::wait_until(TIMEOUT, || !six()), "");

    fs::create_dir_all("/etc")?;
    fs::write("/etc/group", format!("root:x:0:\nvideo:x:{VIDEO}:\n"))?;
    fs::write("/etc/passwd", "root:x:0:0:root:/root:/bin/sh\n")?;
    system::run(Command::new("depthrig").args(["install", "--apply", "--user", "root"]))?;
    // One program under two names; another scenario of this boot may have made the second.
    if !Path::new("/bin/systemd-udevd").exists() {
        std::os::unix::fs::symlink(UDEVADM, "/bin/systemd-udevd")?;
    }
    system::run(Command::new("/bin/systemd-udevd").arg("--daemon"))?;
    camera.replug()?;
    checks.that("six nodes again", system::wait_until(TIMEOUT, six), "");
    system::run(Command::new(UDEVADM).args(["settle", "--timeout=10"]))?;

    let modes = |path: &Path| fs::metadata(path).map(|m| (format!("{:o}", m.mode() & 0o777), m.gid()));
    for node in system::video_nodes()? {
        checks.equal(
            &format!("{}: mode and group", node.display()),
            modes(&node)?,
            ("660".to_owned(), VIDEO),
        );
    }
    let sensors = iio::on_port(&SysRoot::default(), &port);
    checks.equal("the IMU has two sensors", sensors.len(), 2);
    for sensor in sensors {
        let name = &sensor.name;
        checks.equal(
            &format!("{name}: mode and group of its node"),
            modes(&sensor.node)?,
            ("660".to_owned(), VIDEO),
        );
        for file in sensor.switches() {
            let wanted = ("664".to_owned(), VIDEO);
            checks.equal(&format!("{name}: mode and group of {}", file.display()), modes(&file)?, wanted);
        }
    }
    let number = |file: &str| -> anyhow::Result<u32> {
        Ok(fs::read_to_string(format!("/sys/bus/usb/devices/{port}/{file}"))?.trim().parse()?)
    };
    let usb = format!("/dev/bus/usb/{:03}/{:03}", number("busnum")?, number("devnum")?);
    checks.equal("the USB device: mode and group", modes(Path::new(&usb))?, ("660".to_owned(), VIDEO));
    checks.equal("the kernel leaves it awake", fs::read_to_string(&power)?.trim(), "on");
    system::run(Command::new(UDEVADM).args(["control", "--exit"]))?;
    Ok(())
}
