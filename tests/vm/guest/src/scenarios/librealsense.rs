//! Intel's own library against the emulated cameras: its reports are compared with those of depthrig's driver for
//! the same camera, and both with the emulator's truth. The library is independent of depthrig, so that an assumption
//! which emulator and driver share does not go unnoticed.

mod frames;
mod geometry;
mod imu;
mod settings;
mod vendor;

use crate::checks::Checks;
use crate::subject::{plug, wait_for_imu};
use crate::{Scenario, system};
use depthrig_driver::Backend;
use depthrig_emulator::{Camera, Options};
use depthrig_realsense::RealsenseBackend;
use depthrig_realsense::config::{RealsenseConfig, TransportChoice};
use depthrig_realsense::l515::{L515Backend, L515Config};
use serde_json::json;
use vendor::Vendor;

/// See the module.
pub const SCENARIO: Scenario = Scenario {
    name: "librealsense",
    about: "Intel's own library and the drivers agree on D435, D405, D455 and L515: modes, calibration, frames, times, settings, IMU",
    cost: 90,
    limit_s: 400,
    needs: "librealsense",
    run,
};

/// Each model, and the folder of the library's version that knows it.
const MODELS: [(&str, &str); 5] =
    [("d435", "d400"), ("d405", "d400"), ("d455", "d400"), ("l515", "l515"), (ONLY_IMU, "d400")];
/// Those with an IMU.
const WITH_IMU: [&str; 3] = ["d455", "l515", ONLY_IMU];
/// A D435 with an IMU of another kind than the D455's: the rest of it is compared with the D435.
const ONLY_IMU: &str = "d435i";

fn run(checks: &mut Checks) -> anyhow::Result<()> {
    for module in
        ["vhci-hcd", "uvcvideo", "usbhid", "hid-sensor-hub", "hid-sensor-accel-3d", "hid-sensor-gyro-3d"]
    {
        system::modprobe(module, &[])?;
    }
    for (model, version) in MODELS {
        let camera = plug(model, Options { drift_ppm: 20.0, ..Options::default() })?;
        let has_imu = camera.model().imu.is_some();
        checks.equal(
            &format!("{model}: an IMU is where real ones have it"),
            has_imu,
            WITH_IMU.contains(&model),
        );
        if has_imu {
            wait_for_imu(checks, model);
        }
        let mut vendor = Vendor::start(version)?;
        let subject = Subject { checks, camera: &camera, vendor: &mut vendor, model };
        if let Err(error) = compare(subject) {
            checks.that(&format!("{model} is compared to the end"), false, format!("{error:#}"));
        }
        vendor.end();
    }
    Ok(())
}

/// A camera that is being compared.
pub struct Subject<'a> {
    checks: &'a mut Checks,
    camera: &'a Camera,
    vendor: &'a mut Vendor,
    model: &'static str,
}

impl Subject<'_> {
    /// The name of a check.
    fn name(&self, what: &str) -> String {
        format!("{}: {what}", self.model)
    }

    fn that(&mut self, what: &str, holds: bool, detail: impl core::fmt::Display) -> bool {
        let name = self.name(what);
        self.checks.that(&name, holds, detail)
    }

    fn is_l515(&self) -> bool {
        self.model == "l515"
    }

    /// The driver for this camera.
    fn backend(&self) -> Box<dyn Backend> {
        let port = self.camera.port_path();
        if self.is_l515() {
            return Box::new(L515Backend::new(L515Config { port, ..L515Config::default() }));
        }
        let transport = TransportChoice::Kernel;
        Box::new(RealsenseBackend::new(RealsenseConfig { port, transport, ..RealsenseConfig::default() }))
    }
}

fn compare(mut subject: Subject<'_>) -> anyhow::Result<()> {
    let device = subject.backend().open(None)?;
    let info = device.info().clone();
    let profiles = device.profiles().to_vec();
    drop(device);
    let reported = subject.vendor.ask(&json!({ "do": "open", "serial": subject.camera.serial() }))?;
    geometry::identity(&mut subject, &reported, &info);
    if subject.model == ONLY_IMU {
        return imu::compare(&mut subject, &reported);
    }
    geometry::modes(&mut subject, &reported, &profiles);
    geometry::intrinsics(&mut subject, &reported, &profiles);
    geometry::poses(&mut subject, &reported, &profiles);
    settings::options(&mut subject)?;
    if !subject.is_l515() {
        settings::advanced(&mut subject)?;
    }
    frames::compare(&mut subject)?;
    if subject.camera.model().imu.is_some() {
        imu::compare(&mut subject, &reported)?;
    }
    settings::rare(&mut subject);
    let unknown = subject.camera.unknown_opcodes();
    subject.that(
        "the emulated camera knows every request of the library",
        unknown.is_empty(),
        format!("{unknown:x?}"),
    );
    Ok(())
}
