//! The calibration of an emulated camera: numbers that follow from its serial, so that no two cameras have the same and
//! a test can ask for them.

mod imu;
mod l515;
mod zed;

use crate::content::hash;
use crate::model::{Family, Model};
use depthrig_realsense::protocol::tables::{Coefficients, Pinhole, RgbTable, SIZES};
pub use imu::{ImuAxes, ImuCalibration};
pub use l515::{L515, L515Color, L515Depth};
pub use zed::{ZedIntrinsics, ZedMode};

/// Calibration of a camera.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Calibration {
    /// The stereo pair of a D400.
    pub coefficients: Option<Coefficients>,
    /// The colour camera of a D400.
    pub rgb: Option<RgbTable>,
    /// The tables of an L515.
    pub l515: Option<L515>,
    /// The IMU of a RealSense camera that has one.
    pub imu: Option<ImuCalibration>,
    /// The modes of a ZED, largest first.
    pub zed: Vec<ZedMode>,
}

/// Numbers between −1 and 1 that follow from a serial and a name.
pub(crate) struct Spread<'a>(pub &'a str);

impl Spread<'_> {
    pub fn at(&self, name: &str) -> f32 {
        let h = hash(&format!("{} {name}", self.0));
        ((h ^ (h >> 29)).wrapping_mul(0xBF58_476D_1CE4_E5B9) >> 40) as f32 / (1 << 23) as f32 - 1.0
    }
}

/// A small rotation, row after row, from three angles in radians: Rz Ry Rx.
pub(crate) fn rotation([rx, ry, rz]: [f32; 3]) -> [f32; 9] {
    let [(sx, cx), (sy, cy), (sz, cz)] = [rx, ry, rz].map(|a| f64::from(a).sin_cos());
    [
        cz * cy,
        cz * sy * sx - sz * cx,
        cz * sy * cx + sz * sx,
        sz * cy,
        sz * sy * sx + cz * cx,
        sz * sy * cx - cz * sx,
        -sy,
        cy * sx,
        cy * cx,
    ]
    .map(|v| v as f32)
}

impl Calibration {
    /// The calibration of a model with a serial.
    pub fn new(model: &Model, serial: &str) -> Self {
        let spread = Spread(serial);
        let imu = model.imu.map(|_| ImuCalibration::new(&spread));
        match model.family {
            Family::D400 => Self {
                coefficients: Some(coefficients(model, &spread)),
                rgb: Some(rgb(model, &spread)),
                imu,
                ..Self::default()
            },
            Family::L515 => Self { l515: Some(L515::new(&spread)), imu, ..Self::default() },
            Family::Zed | Family::ZedMcu => Self { zed: zed::modes(&spread), ..Self::default() },
            Family::Plain => Self::default(),
        }
    }

    /// The factory calibration file of a ZED; empty for another camera.
    pub fn zed_conf(&self) -> String {
        zed::conf(&self.zed)
    }
}

/// Rectified intrinsics: the focal length in pixels follows from the width, as on a real unit, and the rest from the
/// serial.
fn coefficients(model: &Model, spread: &Spread<'_>) -> Coefficients {
    let focal = 0.66 + 0.01 * spread.at("focal");
    let cx = 0.01 * spread.at("cx");
    let cy = 0.01 * spread.at("cy");
    let mut rectified = [Pinhole::default(); 16];
    for (entry, size) in rectified.iter_mut().zip(SIZES) {
        if let Some((width, height)) = size {
            let width = width as f32;
            let height = height as f32;
            let fx = focal * width.max(height * 4.0 / 3.0);
            *entry = Pinhole { fx, fy: fx, ppx: width * (0.5 + cx), ppy: height * (0.5 + cy) };
        }
    }
    let k = |side: &str| {
        let f = 2.0 * focal + 0.001 * spread.at(side);
        [f, 0.0, 0.01 * spread.at(side), 0.0, f * 1.6, 0.0, -0.05, 0.06, 0.0]
    };
    Coefficients {
        version: [3, 0],
        param: 0,
        left: k("left"),
        right: k("right"),
        world_to_left: rotation([0.001 * spread.at("lx"), 0.002 * spread.at("ly"), 0.0005]),
        world_to_right: rotation([0.001 * spread.at("rx"), 0.002 * spread.at("ry"), -0.0005]),
        baseline_mm: model.baseline_mm * (1.0 + 0.002 * spread.at("baseline")),
        distortion_model: 1,
        rectified,
    }
}

fn rgb(model: &Model, spread: &Spread<'_>) -> RgbTable {
    let f = 1.40 + 0.02 * spread.at("rgb focal");
    let angles = ["a", "b", "c"].map(|n| 0.005 * spread.at(&format!("rgb angle {n}")));
    let offset = [
        model.color_offset_mm * (1.0 + 0.01 * spread.at("rgb x")),
        0.1 * spread.at("rgb y"),
        0.3 * spread.at("rgb z"),
    ];
    let k = [
        f,
        0.0,
        0.02 * spread.at("rgb ppx"),
        0.0,
        f * 16.0 / 9.0,
        0.02 * spread.at("rgb ppy"),
        0.0,
        0.0,
        1.0,
    ];
    // A third of the units have no distortion in their table, as retail units often have.
    let strength = if hash(spread.0).is_multiple_of(3) { 0.0 } else { 0.02 };
    let distortion = ["k1", "k2", "p1", "p2", "k3"].map(|name| {
        let scale = if name.starts_with('p') { 0.02 } else { 1.0 };
        strength * scale * spread.at(name)
    });
    RgbTable {
        version: [2, 0],
        param: 0,
        k,
        distortion,
        rotation: angles,
        translation_mm: offset,
        projection: [0.0; 12],
        calibrated: (1920, 1080),
        rectified_k: k,
        rectified_rotation: rotation(angles),
        rectified_translation_mm: offset,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cameras_differ_and_the_same_serial_is_the_same_camera() {
        let model = Model::named("d435").unwrap();
        let one = Calibration::new(&model, "830000000001");
        assert_eq!(one, Calibration::new(&model, "830000000001"));
        let two = Calibration::new(&model, "830000000002");
        assert_ne!(one.coefficients, two.coefficients);
        assert_ne!(one.rgb, two.rgb);
    }

    #[test]
    fn a_unit_looks_like_one() {
        let model = Model::named("d435").unwrap();
        for n in 0..50 {
            let unit = Calibration::new(&model, &format!("{n:012}"));
            let table = unit.coefficients.unwrap();
            assert!((49.5..50.5).contains(&-table.baseline_mm), "{}", table.baseline_mm);
            for (entry, size) in table.rectified.iter().zip(SIZES) {
                let Some((width, height)) = size else { continue };
                assert!((0.4..0.6).contains(&(entry.ppx / width as f32)), "{size:?} {entry:?}");
                assert!((0.4..0.6).contains(&(entry.ppy / height as f32)), "{size:?} {entry:?}");
                assert!(entry.fx / width as f32 > 0.5 && entry.ppx != entry.ppy);
            }
            let r = unit.rgb.unwrap().rectified_rotation;
            for (i, j) in [(0, 0), (0, 1), (1, 2), (2, 2)] {
                let dot: f32 = (0..3).map(|k| r[3 * i + k] * r[3 * j + k]).sum();
                let wanted = if i == j { 1.0 } else { 0.0 };
                assert!((dot - wanted).abs() < 1e-6, "rows {i} and {j} of {r:?}");
            }
        }
    }
}
