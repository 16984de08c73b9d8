//! From a D400's calibration tables to the intrinsics and poses of its streams at the size that is streamed.
//!
//! Rules: librealsense `src/ds/d400/d400-private.cpp` (Apache-2.0), computed in 64-bit floats.

use super::protocol_error;
use super::tables::{Coefficients, Pinhole, RectifiedItem, RgbTable};
use depthrig_bus::{Distortion, Intrinsics, Pose};
use depthrig_calib::PoseExt;
use depthrig_driver::{Error, ErrorKind, Result};
use glam::{DAffine3, DMat3, DVec3};

/// Where the intrinsics of a depth stream come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Basis {
    /// The camera has an entry of this size.
    Entry,
    /// A window of an entry of another size, as the camera cuts it out.
    Window,
    /// An entry of another shape, scaled: what the camera cuts away is not known, so they are off by that. Say so.
    Scaled,
}

/// Size of the entry that others are scaled from.
const LARGEST: (u32, u32) = (1920, 1080);

/// The rectified intrinsics of depth and of the left imager at `width` x `height`. `items` are those of
/// `RECPARAMSGET`, empty when the firmware does not have it.
///
/// # Errors
/// [`ErrorKind::Unsupported`] when the camera was never calibrated; [`ErrorKind::BadInput`] for an empty size.
pub fn depth(
    table: &Coefficients,
    items: &[RectifiedItem],
    width: u32,
    height: u32,
) -> Result<(Intrinsics, Basis)> {
    if width == 0 || height == 0 {
        return Err(Error::new(ErrorKind::BadInput, format!("no image has {width}x{height} pixels")));
    }
    let of_size = |i: &&RectifiedItem| (u32::from(i.width), u32::from(i.height)) == (width, height);
    if let Some(item) = items.iter().find(of_size).filter(|i| is_set(&i.pinhole)) {
        return Ok((pinhole(item.pinhole, width, height)?, Basis::Entry));
    }
    let entry = |w, h| table.entry(w, h).filter(is_set);
    if let Some(e) = entry(width, height) {
        return Ok((pinhole(e, width, height)?, Basis::Entry));
    }
    if let ((848, 100), Some(e)) = ((width, height), entry(848, 480)) {
        let whole = pinhole(e, 848, 480)?;
        return Ok((Intrinsics { cy: whole.cy - 190.0, ..whole }, Basis::Window));
    }
    let (w, h) = LARGEST;
    let Some(e) = entry(w, h) else {
        return Err(uncalibrated(
            "its table has no intrinsics for this size, and none to scale from",
            width,
            height,
        ));
    };
    let whole = pinhole(e, w, h)?;
    if (width, height) == (256, 144) {
        // The middle of 1920x1080, unscaled.
        return Ok((Intrinsics { cx: whole.cx - 832.0, cy: whole.cy - 468.0, ..whole }, Basis::Window));
    }
    let sx = f64::from(width) / f64::from(w);
    let sy = f64::from(height) / f64::from(h);
    let scaled = Intrinsics::pinhole(whole.fx * sx, whole.fy * sy, whole.cx * sx, whole.cy * sy);
    Ok((scaled, Basis::Scaled))
}

/// Whether an entry was ever written: a size that the firmware does not use has zeros.
fn is_set(p: &Pinhole) -> bool {
    [p.fx, p.fy, p.ppx, p.ppy].iter().all(|v| v.is_finite()) && p.fx > 0.0 && p.fy > 0.0
}

/// An entry as intrinsics; without distortion, because these images are rectified.
fn pinhole(p: Pinhole, width: u32, height: u32) -> Result<Intrinsics> {
    if p.fx == p.fy && p.ppx == p.ppy {
        // Uncalibrated units have these; the vendor's software goes on with an ideal lens.
        return Err(uncalibrated("its table holds placeholders", width, height));
    }
    Ok(Intrinsics::pinhole(p.fx.into(), p.fy.into(), p.ppx.into(), p.ppy.into()))
}

fn uncalibrated(what: &str, width: u32, height: u32) -> Error {
    Error::new(
        ErrorKind::Unsupported,
        format!(
            "the camera is not calibrated: {what} (depth {width}x{height}). Restore its factory calibration with the \
             vendor's calibration tool, or allow an uncalibrated camera, whose intrinsics are then unknown"
        ),
    )
}

/// The intrinsics of a colour sensor of its own (all but D405) at `width` x `height`.
///
/// # Errors
/// [`ErrorKind::Unsupported`] when the table holds no intrinsics; [`ErrorKind::BadInput`] for an empty size.
pub fn color(table: &RgbTable, width: u32, height: u32) -> Result<Intrinsics> {
    let mut k = Normalised::of(table, width, height)?;
    let calibrated = match table.calibrated {
        (0, _) | (_, 0) => 9.0 / 16.0,
        (w, h) => f64::from(h) / f64::from(w),
    };
    let actual = f64::from(height) / f64::from(width);
    // The sensor keeps one side whole and cuts the other.
    if actual < calibrated {
        k.y(calibrated / actual);
    } else {
        k.x(actual / calibrated);
    }
    Ok(k.at(width.into(), height.into(), table))
}

/// The intrinsics of a D405's colour, which comes from its left imager, at `width` x `height`.
///
/// # Errors
/// Those of [`color`], and [`ErrorKind::Unsupported`] when the table lacks the size of calibration.
pub fn d405_color(table: &RgbTable, width: u32, height: u32) -> Result<Intrinsics> {
    let mut k = Normalised::of(table, width, height)?;
    if (width, height) == (1280, 720) {
        return Ok(k.at(1280.0, 720.0, table));
    }
    let w = f64::from(table.calibrated.0);
    let h = f64::from(table.calibrated.1);
    if w == 0.0 || h == 0.0 {
        return Err(uncalibrated("its colour table does not say at which size", width, height));
    }
    if (width, height) == (640, 480) {
        // The only one of 4:3: the whole sensor of 1280x800 is scaled to 770x480, then cut to 640.
        k.y(h / 800.0);
        let scaled = fill(k.at(1280.0, 800.0, table), [1280.0, 800.0], [770.0, 480.0]);
        return Ok(Intrinsics { cx: scaled.cx - 65.0, ..scaled });
    }
    Ok(fill(k.at(w, h, table), [w, h], [width.into(), height.into()]))
}

/// Intrinsics of an image of size `from`, scaled until it fills `to` and cut in its middle.
fn fill(i: Intrinsics, from: [f64; 2], to: [f64; 2]) -> Intrinsics {
    let scale = (to[0] / from[0]).max(to[1] / from[1]);
    Intrinsics {
        fx: i.fx * scale,
        fy: i.fy * scale,
        cx: i.cx * scale - (from[0] * scale - to[0]) / 2.0,
        cy: i.cy * scale - (from[1] * scale - to[1]) / 2.0,
        ..i
    }
}

/// Intrinsics on an image whose sides go from -1 to 1.
struct Normalised {
    fx: f64,
    fy: f64,
    px: f64,
    py: f64,
}

impl Normalised {
    fn of(table: &RgbTable, width: u32, height: u32) -> Result<Self> {
        if width == 0 || height == 0 {
            return Err(Error::new(ErrorKind::BadInput, format!("no image has {width}x{height} pixels")));
        }
        let [fx, _, px, _, fy, py, ..] = table.k.map(f64::from);
        let finite = table.k.iter().chain(&table.distortion).all(|v| v.is_finite());
        if !finite || fx <= 0.0 || fy <= 0.0 {
            return Err(uncalibrated("its colour table holds no intrinsics", width, height));
        }
        Ok(Self { fx, fy, px, py })
    }

    fn x(&mut self, factor: f64) {
        self.fx *= factor;
        self.px *= factor;
    }

    fn y(&mut self, factor: f64) {
        self.fy *= factor;
        self.py *= factor;
    }

    /// In pixels of an image of `width` x `height`, with the table's distortion.
    fn at(&self, width: f64, height: f64, table: &RgbTable) -> Intrinsics {
        let mut i = Intrinsics::pinhole(
            self.fx * width / 2.0,
            self.fy * height / 2.0,
            (1.0 + self.px) * width / 2.0,
            (1.0 + self.py) * height / 2.0,
        );
        i.model = Distortion::InverseBrownConrady as u32;
        for (to, from) in i.coeffs.iter_mut().zip(table.distortion) {
            *to = from.into();
        }
        i
    }
}

/// No camera of the family is as wide as that.
const LARGEST_OFFSET_M: f64 = 1.0;

/// The pose of the colour sensor in the depth frame: `p_depth = Mᵀ p_color + t`, with M the table's rotation row
/// after row, and t = -0.001 times its translation.
///
/// # Errors
/// [`ErrorKind::Protocol`] unless M is a rotation and t a distance within a camera.
pub fn color_in_depth(table: &RgbTable) -> Result<Pose> {
    let rotation = rotation(table.rectified_rotation)?.transpose();
    let translation = DVec3::from_array(table.rectified_translation_mm.map(f64::from)) * -0.001;
    rigid(rotation, translation)
}

/// The pose of the right imager in the depth frame, which is that of the left one.
///
/// # Errors
/// [`ErrorKind::Protocol`] when the baseline is zero or not a distance within a camera.
pub fn right_in_depth(table: &Coefficients) -> Result<Pose> {
    // From depth to right the table's sign holds; the pose is its inverse.
    let translation = DVec3::new(-0.001 * f64::from(table.baseline_mm), 0.0, 0.0);
    if table.baseline_mm == 0.0 {
        return Err(protocol_error("the table of coefficients has a baseline of 0"));
    }
    rigid(DMat3::IDENTITY, translation)
}

/// A 3x3 matrix, row after row, that must be a rotation within 1e-3.
pub(super) fn rotation(rows: [f32; 9]) -> Result<DMat3> {
    let m = DMat3::from_cols_array(&rows.map(f64::from)).transpose();
    let off = m * m.transpose() - DMat3::IDENTITY;
    let norm = off.to_cols_array().iter().map(|v| v * v).sum::<f64>().sqrt();
    // Written so that a matrix with a NaN in it does not pass.
    if norm < 1e-3 && m.determinant() > 0.0 {
        // The table's 32-bit floats are a rotation within 1e-7 or so; the nearest one is found by Newton's iteration
        // for the polar decomposition, which squares the error in each step.
        Ok((0..3).fold(m, |r, _| (r + r.inverse().transpose()) * 0.5))
    } else {
        Err(protocol_error(format!("a calibration table holds an invalid rotation (off by {norm:.3})")))
    }
}

pub(super) fn rigid(rotation: DMat3, translation: DVec3) -> Result<Pose> {
    if !(translation.is_finite() && translation.length() < LARGEST_OFFSET_M) {
        return Err(protocol_error(format!(
            "a calibration table holds an offset between two sensors of {translation} m"
        )));
    }
    Ok(Pose::from_affine(&DAffine3::from_mat3_translation(rotation, translation)))
}

#[cfg(test)]
mod tests;
