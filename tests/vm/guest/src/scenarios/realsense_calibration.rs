//! The factory calibration as it comes out of the device, against the tables that the emulated camera was given.
//!
//! Expected values are computed here, from the tables' own numbers, and not by the functions of the driver.

use crate::checks::Checks;
use crate::subject::plug;
use crate::{Scenario, system};
use anyhow::Context;
use depthrig_bus::{Distortion, Pose};
use depthrig_calib::PoseExt;
use depthrig_driver::{Backend, ErrorKind, StreamProfile};
use depthrig_emulator::{Camera, Fault, Options};
use depthrig_realsense::RealsenseBackend;
use depthrig_realsense::config::{RealsenseConfig, TransportChoice};
use depthrig_realsense::protocol::tables::{Coefficients, RgbTable, SIZES};

/// See the module.
pub const SCENARIO: Scenario = Scenario {
    name: "realsense-calibration",
    about: "intrinsics, extrinsics, depth units of every D400 model equal the emulator's tables, by the kernel and libusb",
    cost: 2,
    limit_s: 60,
    needs: "",
    run,
};

/// The models, and metres per unit of depth of each.
const MODELS: [(&str, &str, f64); 5] = [
    ("d405", "D405", 0.0001),
    ("d415", "D415", 0.001),
    ("d435", "D435", 0.001),
    ("d435i", "D435i", 0.001),
    ("d455", "D455", 0.001),
];

fn run(checks: &mut Checks) -> anyhow::Result<()> {
    system::modprobe("vhci-hcd", &[])?;
    system::modprobe("uvcvideo", &[])?;
    for (model, name, depth_unit_m) in MODELS {
        let camera = plug(model, Options::default())?;
        // By the extension unit, then by the vendor's bulk endpoints.
        read(checks, &camera, TransportChoice::Kernel, name, depth_unit_m)?;
        read(checks, &camera, TransportChoice::Libusb, &format!("{name} by libusb"), depth_unit_m)?;
    }
    refused(checks)
}

/// All data that a camera reports when it is opened; `what` begins with its model.
fn read(
    checks: &mut Checks,
    camera: &Camera,
    transport: TransportChoice,
    what: &str,
    depth_unit_m: f64,
) -> anyhow::Result<()> {
    let model = what.split(' ').next().unwrap_or_default();
    let backend = backend(camera, transport, false);
    let Some(device) = checks.done(&format!("{what} opens"), backend.open(None)) else { return Ok(()) };
    let said = (device.info().model.as_str(), device.info().serial.as_str());
    checks.equal(&format!("{what} says its model and serial number"), said, (model, camera.serial()));
    let given = camera.calibration();
    let stereo = given.coefficients.context("no table 25")?;
    let rgb = given.rgb.context("no table 32")?;
    let (depth_unit, depth) = stereo_of(device.profiles(), &stereo);
    let (colors, color) = color_of(device.profiles(), &rgb, model == "D405");
    checks.that(&format!("{what}: depth unit"), (depth_unit - depth_unit_m).abs() < 1e-12, depth_unit);
    checks.that(&format!("{what}: intrinsics of depth and infrared"), depth.holds(), depth);
    checks.that(&format!("{what}: intrinsics of {colors} colour modes"), color.holds() && colors > 0, color);
    poses(checks, what, device.profiles(), &stereo, &rgb);
    Ok(())
}

fn backend(camera: &Camera, transport: TransportChoice, allow_uncalibrated: bool) -> RealsenseBackend {
    let port = camera.port_path();
    RealsenseBackend::new(RealsenseConfig {
        port,
        transport,
        allow_uncalibrated,
        ..RealsenseConfig::default()
    })
}

/// The largest difference between read and given values, pixels, and the number of modes.
#[derive(Default)]
struct Off {
    pixels: f64,
    modes: u32,
    is_other_model: bool,
}

impl Off {
    fn holds(&self) -> bool {
        self.modes > 0 && self.pixels < 1e-6 && !self.is_other_model
    }

    fn compare(&mut self, p: &StreamProfile, wanted: [f64; 4]) {
        let i = &p.intrinsics;
        for (got, wanted) in [i.fx, i.fy, i.cx, i.cy].into_iter().zip(wanted) {
            // Written so that a NaN is far off.
            let off = (got - wanted).abs();
            self.pixels = if off < self.pixels { self.pixels } else { off };
        }
        self.modes += 1;
    }
}

impl core::fmt::Display for Off {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "{:.2e} px at most over {} modes", self.pixels, self.modes)
    }
}

/// Depth unit, and depth and infrared at the sizes that the table has an entry for.
fn stereo_of(profiles: &[StreamProfile], table: &Coefficients) -> (f64, Off) {
    let mut unit = f64::NAN;
    let mut off = Off::default();
    for p in profiles.iter().filter(|p| p.stream.as_str() != "color") {
        if p.stream.as_str() == "depth" {
            unit = p.depth_unit_m;
        }
        let Some(at) = SIZES.iter().position(|s| *s == Some((p.width, p.height))) else { continue };
        let e = table.rectified[at];
        off.compare(p, [e.fx, e.fy, e.ppx, e.ppy].map(f64::from));
        off.is_other_model |= p.intrinsics.distortion() != Distortion::None;
    }
    (unit, off)
}

/// Colour at every size, by the formulas of the notes on the table, written out.
fn color_of(profiles: &[StreamProfile], table: &RgbTable, is_d405: bool) -> (u32, Off) {
    let mut off = Off::default();
    let k = table.k.map(f64::from);
    for p in profiles.iter().filter(|p| p.stream.as_str() == "color") {
        let w = f64::from(p.width);
        let h = f64::from(p.height);
        let pixels = |[fx, px, fy, py]: [f64; 4], w: f64, h: f64| {
            [fx * w / 2.0, fy * h / 2.0, (1.0 + px) * w / 2.0, (1.0 + py) * h / 2.0]
        };
        let plain = [k[0], k[2], k[4], k[5]];
        let cw = f64::from(table.calibrated.0);
        let ch = f64::from(table.calibrated.1);
        let wanted = match (is_d405, p.width, p.height) {
            (false, ..) => {
                let a = h / w;
                let c = ch / cw;
                let scaled = if a < c {
                    [k[0], k[2], k[4] * c / a, k[5] * c / a]
                } else {
                    [k[0] * a / c, k[2] * a / c, k[4], k[5]]
                };
                pixels(scaled, w, h)
            }
            (true, 1280, 720) => pixels(plain, w, h),
            (true, 640, 480) => {
                let [fx, fy, cx, cy] =
                    pixels([k[0], k[2], k[4] * ch / 800.0, k[5] * ch / 800.0], 1280.0, 800.0);
                // 1280x800 to a width of 770, which is 481.25 high; the middle 480 rows, then 65 columns less.
                let s = (770.0_f64 / 1280.0).max(480.0 / 800.0);
                let left = (1280.0 * s - 770.0) / 2.0;
                let top = (800.0 * s - 480.0) / 2.0;
                [fx * s, fy * s, cx * s - left - 65.0, cy * s - top]
            }
            (true, ..) => {
                let [fx, fy, cx, cy] = pixels(plain, cw, ch);
                let s = (w / cw).max(h / ch);
                [fx * s, fy * s, cx * s - (cw * s - w) / 2.0, cy * s - (ch * s - h) / 2.0]
            }
        };
        off.compare(p, wanted);
        let coeffs = p.intrinsics.coeffs.iter().zip(table.distortion);
        off.is_other_model |= p.intrinsics.distortion() != Distortion::InverseBrownConrady
            || coeffs.into_iter().any(|(a, b)| (a - f64::from(b)).abs() > 1e-12);
    }
    (off.modes, off)
}

/// Where colour and the right imager are, seen from depth: `p_depth = Mᵀ p_color − 0.001 T`, with M row after row.
fn poses(checks: &mut Checks, name: &str, profiles: &[StreamProfile], stereo: &Coefficients, rgb: &RgbTable) {
    let pose = |stream: &str| profiles.iter().find(|p| p.stream.as_str() == stream).map(|p| p.pose_in_device);
    let m = nearest_rotation(rgb.rectified_rotation.map(f64::from));
    let t = rgb.rectified_translation_mm.map(f64::from);
    let color = |p: [f64; 3]| {
        core::array::from_fn(|i| (0..3).map(|j| m[3 * j + i] * p[j]).sum::<f64>() - 0.001 * t[i])
    };
    let right = |p: [f64; 3]| [p[0] - 0.001 * f64::from(stereo.baseline_mm), p[1], p[2]];
    let same = |p: [f64; 3]| p;
    for (stream, wanted) in [
        ("color", &color as &dyn Fn([f64; 3]) -> [f64; 3]),
        ("ir_right", &right),
        ("ir_left", &same),
        ("depth", &same),
    ] {
        let Some(pose) = pose(stream) else {
            // A D405 that shows no interleaved infrared has no right imager to look through.
            checks.note(format!("{name} has no {stream}"));
            continue;
        };
        let off = farthest(&pose, wanted);
        checks.that(&format!("{name}: pose of {stream}"), off < 1e-9, format!("{off:.2e} m at 1 m"));
        let origin = PoseExt::transform_point(&pose, [0.0; 3].into()).to_array();
        let off = origin.iter().zip(wanted([0.0; 3])).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        checks.that(&format!("{name}: origin of {stream}"), off < 1e-9, format!("{off:.2e} m"));
    }
}

/// The rotation nearest to a table's 32-bit numbers, row after row: each row made orthogonal to the others in equal
/// parts, over and over (Björck and Bowie 1971: R ← R (3 I − Rᵀ R) / 2).
fn nearest_rotation(m: [f64; 9]) -> [f64; 9] {
    let step = |r: [f64; 9]| -> [f64; 9] {
        let gram = |i: usize, j: usize| (0..3).map(|k| r[3 * k + i] * r[3 * k + j]).sum::<f64>();
        let factor = |i: usize, j: usize| if i == j { 3.0 - gram(i, j) } else { -gram(i, j) };
        core::array::from_fn(|at| (0..3).map(|k| r[at / 3 * 3 + k] * factor(k, at % 3)).sum::<f64>() / 2.0)
    };
    (0..5).fold(m, |r, _| step(r))
}

/// The largest distance between where `pose` and `wanted` put points 1 m away.
fn farthest(pose: &Pose, wanted: &dyn Fn([f64; 3]) -> [f64; 3]) -> f64 {
    let points = [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]];
    let off = |p: [f64; 3]| {
        let a = PoseExt::transform_point(pose, p.into()).to_array();
        let b = wanted(p);
        a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
    };
    points.into_iter().map(off).fold(0.0, f64::max)
}

/// A camera without calibration is refused unless the rig allows it; one whose table is damaged as well.
fn refused(checks: &mut Checks) -> anyhow::Result<()> {
    for (fault, word) in [
        (Fault::DamagedTable(25), "checksum"),
        (Fault::DamagedTable(32), "checksum"),
        (Fault::Uncalibrated, "not calibrated"),
    ] {
        let camera = plug("d435", Options::default())?;
        camera.fault(fault.clone())?;
        let refused = backend(&camera, TransportChoice::Kernel, false).open(None).err();
        let text = refused.as_ref().map(ToString::to_string).unwrap_or_default();
        let holds = refused.is_some_and(|e| e.kind() == ErrorKind::Unsupported)
            && text.contains(word)
            && text.contains("allow_uncalibrated");
        checks.that(&format!("{fault:?} is refused with its cure"), holds, &text);
        let allowed = backend(&camera, TransportChoice::Kernel, true).open(None);
        let unknown = allowed.is_ok_and(|d| d.profiles().iter().all(|p| !p.intrinsics.is_known()));
        checks.that("unless the rig allows it, and then the intrinsics are unknown", unknown, "");
    }
    Ok(())
}
