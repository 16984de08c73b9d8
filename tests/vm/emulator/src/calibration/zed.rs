//! The factory calibration of a ZED: the numbers, and the file that the vendor's servers hand out.

use super::Spread;
use core::fmt::Write;

/// Intrinsics of one side at one mode.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ZedIntrinsics {
    /// `fx fy cx cy`, pixels.
    pub pinhole: [f64; 4],
    /// `k1 k2 p1 p2 k3`.
    pub distortion: [f64; 5],
}

/// Calibration of both sides at one mode.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ZedMode {
    /// The mode's name in the file.
    pub name: &'static str,
    /// Intrinsics of the left camera.
    pub left: ZedIntrinsics,
    /// Intrinsics of the right camera.
    pub right: ZedIntrinsics,
    /// `Baseline TY TZ`, millimetres.
    pub translation_mm: [f64; 3],
    /// Rodrigues' vector `RX CV RZ`, radians.
    pub rotation: [f64; 3],
}

pub(super) fn modes(spread: &Spread<'_>) -> Vec<ZedMode> {
    let sizes =
        [("2K", 2208.0, 1242.0), ("FHD", 1920.0, 1080.0), ("HD", 1280.0, 720.0), ("VGA", 672.0, 376.0)];
    let s = |name: &str| f64::from(spread.at(name));
    let mode = |(name, width, height)| {
        let intrinsics = |side: &str| {
            // 2.1 mm lenses: 1070 pixels at 2208 wide; VGA and HD are binned, FHD is cropped.
            let f = if name == "FHD" { 1070.0 } else { 0.4846 * width } + s(side);
            let cx = width / 2.0 + 8.0 * s(&format!("{side} x"));
            let cy = height / 2.0 + 8.0 * s(&format!("{side} y"));
            ZedIntrinsics {
                pinhole: [f, f, cx, cy],
                distortion: [-0.05 + 0.01 * s(side), 0.02, 0.0003 * s(side), 0.0, -0.01],
            }
        };
        ZedMode {
            name,
            left: intrinsics("left"),
            right: intrinsics("right"),
            translation_mm: [119.9 + 0.2 * s("baseline"), 0.05 * s("ty"), 0.2 * s("tz")],
            rotation: [0.002 * s("rx"), 0.004 * s("cv"), 0.001 * s("rz")],
        }
    };
    sizes.map(mode).to_vec()
}

pub(super) fn conf(modes: &[ZedMode]) -> String {
    let mut text = String::new();
    let mut line = |text_line: String| {
        // Writing to a string does not fail.
        let _ = writeln!(text, "{text_line}");
    };
    for mode in modes {
        for (side, intrinsics) in [("LEFT", &mode.left), ("RIGHT", &mode.right)] {
            line(format!("[{side}_CAM_{}]", mode.name));
            let values = intrinsics.pinhole.iter().chain(&intrinsics.distortion);
            for (key, value) in ["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"].iter().zip(values) {
                line(format!("{key}={value}"));
            }
            line(String::new());
        }
    }
    if let Some(first) = modes.first() {
        line("[STEREO]".into());
        for (key, value) in ["Baseline", "TY", "TZ"].iter().zip(first.translation_mm) {
            line(format!("{key}={value}"));
        }
        for mode in modes {
            for (key, value) in ["RX", "CV", "RZ"].iter().zip(mode.rotation) {
                line(format!("{key}_{}={value}", mode.name));
            }
        }
        line("\n[MISC]\nSensor_ID=0".into());
    }
    text
}
