//! The factory calibration, a file `SN<serial>.conf`: intrinsics of both cameras in each mode, and the right camera's
//! pose.
//!
//! Lengths in the file are millimetres and become metres; angles are radians. Distortion is Brown-Conrady in
//! `OpenCV`'s order `k1 k2 p1 p2 k3`, and the pixel convention is `OpenCV`'s too, so intrinsics are taken as they are.
//!
//! **The pose.** `[STEREO]` holds a rotation vector `r = (RX, CV, RZ)` and a translation `t = (Baseline, TY, TZ)`.
//! The vendor's open code hands `R = exp(r)` and `t` to `OpenCV`'s `stereoRectify`, whose `R` turns left coordinates
//! into right ones. There a right camera to the right has a negative `t.x`; the file's baseline is positive, and
//! `stereoRectify` gives the same rectification for `t` and `-t`. A point therefore moves from left to right by
//! `p_right = R p_left - t`, and the pose that is returned here, that of the right camera in the left one, is its
//! inverse: `p_left = Rᵀ p_right + Rᵀ t`.

use super::ini::{Ini, Number};
use super::mode::{Mode, Side};
use core::fmt::Write as _;
use core::ops::RangeInclusive;
use depthrig_bus::{Distortion, Intrinsics, Pose};
use depthrig_driver::{Error, ErrorKind, Result};
use glam::{DQuat, DVec3};
use std::path::{Path, PathBuf};

/// No such file is longer than a few thousand bytes.
const MAX_FILE_BYTES: u64 = 1 << 20;
/// Baselines of the family lie between 50 mm (ZED X Mini) and 120 mm (ZED 2i).
const BASELINE_MM: RangeInclusive<f64> = 20.0..=300.0;
/// Largest angle between the cameras, which assembly leaves nearly parallel; the largest angles seen are below 0.02.
const MAX_ANGLE_RAD: f64 = 0.2;

/// Both cameras in one mode.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StereoCalibration {
    /// Intrinsics of the left camera at the mode's size.
    pub left: Intrinsics,
    /// Intrinsics of the right camera at the mode's size.
    pub right: Intrinsics,
    /// Pose of the right camera in the left one, metres: `p_left = R p_right + t`, so that `t.x` is the baseline.
    pub right_in_left: Pose,
}

impl StereoCalibration {
    /// Intrinsics of the camera on `side`.
    pub const fn intrinsics(&self, side: Side) -> Intrinsics {
        match side {
            Side::Left => self.left,
            Side::Right => self.right,
        }
    }

    /// Pose of the camera on `side` in the ZED's frame, which is that of the left camera.
    pub const fn pose(&self, side: Side) -> Pose {
        match side {
            Side::Left => Pose::IDENTITY,
            Side::Right => self.right_in_left,
        }
    }

    /// Distance between the two cameras, metres.
    pub fn baseline_m(&self) -> f64 {
        DVec3::from_array(self.right_in_left.translation_m).length()
    }
}

/// A factory calibration, mode by mode.
#[derive(Debug, Clone, PartialEq)]
pub struct FactoryCalibration {
    /// In the order of [`Mode::ALL`]; `None` for a mode that the file does not have.
    modes: [Option<StereoCalibration>; 4],
}

impl FactoryCalibration {
    /// Reads and checks `text`; `origin` names its file in messages.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] with the line for a value that is missing, not a number, or out of range for this
    /// family.
    pub fn parse(text: &str, origin: &str) -> Result<Self> {
        let ini = Ini::parse(text, origin)?;
        let mut modes = [None; 4];
        for (slot, mode) in modes.iter_mut().zip(Mode::ALL) {
            let [left, right] = ["LEFT", "RIGHT"].map(|side| format!("{side}_CAM_{}", mode.suffix()));
            match (ini.section(&left), ini.section(&right)) {
                (None, None) => {}
                (Some(_), Some(_)) => *slot = Some(stereo(&ini, mode, &left, &right)?),
                (Some(line), None) => return Err(ini.at(line, format_args!("[{left}] has no [{right}]"))),
                (None, Some(line)) => return Err(ini.at(line, format_args!("[{right}] has no [{left}]"))),
            }
        }
        if modes.iter().all(Option::is_none) {
            return Err(ini.problem(
                "no section [LEFT_CAM_2K], _FHD, _HD or _VGA; a factory calibration of a ZED has them. When the file \
                 was downloaded, see whether it is a page that says why not",
            ));
        }
        Ok(Self { modes })
    }

    /// Reads the file at `path`.
    ///
    /// # Errors
    /// [`ErrorKind::NotFound`], [`ErrorKind::PermissionDenied`], [`ErrorKind::Io`], and those of [`Self::parse`].
    pub fn load(path: &Path) -> Result<Self> {
        let unreadable = |e: std::io::Error| {
            let kind = match e.kind() {
                std::io::ErrorKind::NotFound => ErrorKind::NotFound,
                std::io::ErrorKind::PermissionDenied => ErrorKind::PermissionDenied,
                _ => ErrorKind::Io,
            };
            Error::new(kind, format!("the factory calibration {} cannot be read: {e}", path.display()))
                .with_source(e)
        };
        let shown = path.display().to_string();
        let size = std::fs::metadata(path).map_err(unreadable)?.len();
        if size > MAX_FILE_BYTES {
            let what = format!("{shown} has {size} bytes; a factory calibration has a few thousand");
            return Err(Error::new(ErrorKind::BadInput, what));
        }
        let bytes = depthrig_bus::files::read(path, MAX_FILE_BYTES).map_err(unreadable)?;
        let text = String::from_utf8(bytes).map_err(|e| {
            Error::new(ErrorKind::BadInput, format!("{shown} is not UTF-8 text: {e}")).with_source(e)
        })?;
        Self::parse(&text, &shown)
    }

    /// The calibration at `mode`, if the file has it.
    pub fn at(&self, mode: Mode) -> Option<&StereoCalibration> {
        Mode::ALL.into_iter().zip(&self.modes).find(|(m, _)| *m == mode).and_then(|(_, c)| c.as_ref())
    }

    /// The file's text with all of it, for a camera that is emulated.
    pub fn build(&self) -> String {
        let mut text = String::new();
        let known = || Mode::ALL.into_iter().filter_map(|m| Some((m.suffix(), self.at(m)?)));
        for (name, c) in known() {
            for (side, i) in [("LEFT", &c.left), ("RIGHT", &c.right)] {
                let [k1, k2, p1, p2, k3, ..] = i.coeffs;
                let fx = i.fx;
                let fy = i.fy;
                let cx = i.cx;
                let cy = i.cy;
                let _ = writeln!(
                    text,
                    "[{side}_CAM_{name}]\nfx={fx}\nfy={fy}\ncx={cx}\ncy={cy}\nk1={k1}\nk2={k2}\np1={p1}\np2={p2}\nk3={k3}\n"
                );
            }
        }
        let _ = writeln!(text, "[STEREO]");
        for (i, (name, c)) in known().enumerate() {
            let to_right = DQuat::from_array(c.right_in_left.rotation_xyzw).inverse();
            let t = to_right * DVec3::from_array(c.right_in_left.translation_m) * 1000.0;
            // To picometres and picoradians: what turning them left of rounding would put a number at its limit beyond
            // it.
            let r = (to_right.to_scaled_axis() * 1e12).round() / 1e12;
            if i == 0 {
                let t = (t * 1e9).round() / 1e9;
                let _ = writeln!(text, "Baseline={}\nTY={}\nTZ={}", t.x, t.y, t.z);
            }
            let _ = writeln!(text, "CV_{name}={}\nRX_{name}={}\nRZ_{name}={}", r.y, r.x, r.z);
        }
        text
    }
}

/// Where the factory calibration of the camera `serial` is looked for: where the SDK and where the vendor's open code
/// keep it. `home` is the user's home folder.
pub fn known_paths(serial: &str, home: Option<&Path>) -> Vec<PathBuf> {
    let name = format!("SN{serial}.conf");
    let own = home.map(|h| h.join("zed/settings").join(&name));
    [Some(Path::new("/usr/local/zed/settings").join(&name)), own].into_iter().flatten().collect()
}

/// How to get the factory calibration of the camera `serial`, for messages. It is never downloaded automatically.
pub fn how_to_get(serial: &str) -> String {
    format!(
        "fetch https://calib.stereolabs.com/?SN={serial} on a computer with internet, save it as SN{serial}.conf in \
         /usr/local/zed/settings or ~/zed/settings, or name it in the rig file with calibration = \"…\""
    )
}

fn stereo(ini: &Ini<'_>, mode: Mode, left: &str, right: &str) -> Result<StereoCalibration> {
    Ok(StereoCalibration {
        left: intrinsics(ini, mode, left)?,
        right: intrinsics(ini, mode, right)?,
        right_in_left: right_in_left(ini, mode)?,
    })
}

fn intrinsics(ini: &Ini<'_>, mode: Mode, section: &str) -> Result<Intrinsics> {
    let (width, height) = mode.image_size();
    let width = f64::from(width);
    let height = f64::from(height);
    let required = |key: &str, low: f64, high: f64| -> Result<f64> {
        let Some(n) = ini.number(section, key)? else {
            let line = ini.section(section).unwrap_or(1);
            return Err(ini.at(line, format_args!("[{section}] has no {key}")));
        };
        let what = format_args!("pixels at {width} x {height}");
        within(ini, section, n, low..=high, what).map(|()| n.value)
    };
    // A lens of 2.1 mm has f = 0.42 widths, one of 4 mm 0.86; rates and binning do not change that.
    let fx = required("fx", 0.2 * width, 3.0 * width)?;
    let fy = required("fy", 0.8 * fx, 1.25 * fx)?;
    let cx = required("cx", 0.25 * width, 0.75 * width)?;
    let cy = required("cy", 0.2 * height, 0.8 * height)?;
    let mut coeffs = [0.0; 8];
    for (slot, key) in coeffs.iter_mut().zip(["k1", "k2", "p1", "p2", "k3"]) {
        let Some(n) = ini.number(section, key)? else { continue };
        within(ini, section, n, -10.0..=10.0, format_args!("a distortion coefficient"))?;
        *slot = n.value;
    }
    Ok(Intrinsics { coeffs, model: Distortion::BrownConrady as u32, ..Intrinsics::pinhole(fx, fy, cx, cy) })
}

fn right_in_left(ini: &Ini<'_>, mode: Mode) -> Result<Pose> {
    const STEREO: &str = "STEREO";
    let missing = |what: &str| match ini.section(STEREO) {
        Some(line) => ini.at(line, format_args!("[STEREO] has no {what}")),
        None => ini.problem(format_args!("no section [STEREO], which has the {what}")),
    };
    // The value of this mode, else that of all modes.
    let value = |key: &str| -> Result<Option<Number<'_>>> {
        match ini.number(STEREO, &format!("{key}_{}", mode.suffix()))? {
            Some(n) => Ok(Some(n)),
            None => ini.number(STEREO, key),
        }
    };
    let baseline = value("Baseline")?.ok_or_else(|| missing("Baseline"))?;
    if baseline.value < 0.0 {
        let what = format_args!(
            "[STEREO] Baseline = {} is negative; it is the distance from the left camera to the right one, millimetres",
            baseline.value
        );
        return Err(ini.at(baseline.line, what));
    }
    within(ini, STEREO, baseline, BASELINE_MM, format_args!("millimetres"))?;
    let mut t = DVec3::new(baseline.value, 0.0, 0.0);
    for (slot, key) in [(&mut t.y, "TY"), (&mut t.z, "TZ")] {
        let Some(n) = value(key)? else { continue };
        let limit = 0.1 * baseline.value;
        within(ini, STEREO, n, -limit..=limit, format_args!("millimetres, a tenth of the baseline at most"))?;
        *slot = n.value;
    }
    let mut r = DVec3::ZERO;
    for (slot, key) in [(&mut r.x, "RX"), (&mut r.y, "CV"), (&mut r.z, "RZ")] {
        let n = value(key)?.ok_or_else(|| missing(&format!("{key}_{} nor {key}", mode.suffix())))?;
        within(ini, STEREO, n, -MAX_ANGLE_RAD..=MAX_ANGLE_RAD, format_args!("radians"))?;
        *slot = n.value;
    }
    let to_right = DQuat::from_scaled_axis(r);
    let to_left = to_right.inverse();
    Ok(Pose {
        translation_m: (to_left * t / 1000.0).to_array(),
        rotation_xyzw: to_left.normalize().to_array(),
    })
}

fn within(
    ini: &Ini<'_>,
    section: &str,
    n: Number<'_>,
    range: RangeInclusive<f64>,
    what: core::fmt::Arguments<'_>,
) -> Result<()> {
    if range.contains(&n.value) {
        return Ok(());
    }
    let (low, high) = range.into_inner();
    let message = format_args!("[{section}] {} = {} is out of range {low}..={high} ({what})", n.key, n.value);
    Err(ini.at(n.line, message))
}

#[cfg(test)]
mod tests;
