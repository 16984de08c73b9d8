//! `calibration.toml`: what a calibration found, with where it comes from.

use crate::adjustment::INTRINSIC_PARAMETERS;
use crate::board::Board;
use crate::intrinsics::ImageSize;
use crate::mount::{CameraResult, MountResult, Source, UncertaintyMap};
use depthrig_bus::{Distortion, Intrinsics, Pose};
use depthrig_calib::{Error, ErrorKind, Result};
use nalgebra::{Matrix6, Vector6};
use serde::{Deserialize, Serialize};

mod conditions;
mod depth;
mod latency;
#[cfg(test)]
mod tests;
mod worth;

pub use conditions::{Conditions, MAX_TEMPERATURE_CHANGE, lens_position};
pub use worth::{OLD_DAYS, age_days, old};

pub use latency::FileLatency;

pub use depth::{DepthCorrection, DepthPlace};

/// The version of the file that is written; others are refused.
pub const FORMAT: &str = "depthrig.calibration/1";

/// A mount's calibration.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Calibration {
    /// [`FORMAT`].
    pub format: String,
    /// When it was made, RFC 3339 in UTC.
    pub created: String,
    /// Who made it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub by: Option<String>,
    /// The camera whose frame is the rig's.
    pub reference: String,
    /// Root mean square of all residuals' lengths, pixels.
    pub rms_px: f64,
    /// The board.
    pub board: Board,
    /// The cameras.
    #[serde(rename = "camera")]
    pub cameras: Vec<CalibratedCamera>,
    /// Corrections of depth.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub depth: Vec<DepthCorrection>,
}

/// A camera in the file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CalibratedCamera {
    /// Its name in the rig.
    pub name: String,
    /// The stream whose images were used.
    pub stream: String,
    /// Serial number of the device; empty if it was not known.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub serial: String,
    /// Columns of its images.
    pub width: u32,
    /// Rows of its images.
    pub height: u32,
    /// Whether `intrinsics` were calibrated or are the factory's.
    pub source: Source,
    /// Its intrinsics.
    pub intrinsics: FileIntrinsics,
    /// Its pose on the mount: `p_mount = R p_camera + t`, optical axes.
    pub pose: FilePose,
    /// State that the camera reported meanwhile.
    #[serde(default, skip_serializing_if = "Conditions::is_empty")]
    pub conditions: Conditions,
    /// Measures of how good they are.
    pub quality: Quality,
    /// Uncertainty of projection over the image, of which `quality` has the middle and the largest; files of earlier versions have none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub uncertainty: Option<UncertaintyMap>,
    /// How late its frames are delivered, once `depthrig calibrate time` has found it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub latency: Option<FileLatency>,
}

/// Intrinsics in the file, with the names that `rig.toml` has for them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FileIntrinsics {
    /// The distortion model.
    pub model: Distortion,
    /// Focal length along x, pixels.
    pub fx: f64,
    /// Focal length along y, pixels.
    pub fy: f64,
    /// Principal point x, pixels; the centre of the top-left pixel is (0, 0).
    pub cx: f64,
    /// Principal point y, pixels.
    pub cy: f64,
    /// Coefficients in the order of the model.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub coeffs: Vec<f64>,
    /// Standard deviations of fx, fy, cx, cy and the coefficients; empty for the factory's.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub sigmas: Vec<f64>,
}

/// A pose in the file, with its standard deviations.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FilePose {
    /// Metres.
    pub translation_m: [f64; 3],
    /// Unit quaternion x, y, z, w.
    pub rotation_xyzw: [f64; 4],
    /// Standard deviation of the place, millimetres; 0 for the reference.
    pub sigma_mm: f64,
    /// Standard deviation of the direction, degrees; 0 for the reference.
    pub sigma_deg: f64,
    /// Covariance of the pose, six rows: rotations (radians) and places (metres) about and along the camera's axes.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub covariance: Vec<[f64; 6]>,
}

/// Measures of how good a camera's calibration is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Quality {
    /// Views that show the board.
    pub views: usize,
    /// Corners that were used.
    pub corners: usize,
    /// Root mean square of the residuals' lengths, pixels.
    pub rms_px: f64,
    /// Residual of views that the intrinsics were not fitted to, pixels.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub held_out_px: Option<f64>,
    /// Residual of the factory's intrinsics, pixels.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub factory_px: Option<f64>,
    /// Standard deviation of the projection in the middle of the image, pixels.
    pub projection_middle_px: f64,
    /// The same where it is largest.
    pub projection_worst_px: f64,
    /// Mean difference of projection between the calibrations of two halves of the views, pixels.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub halves_differ_px: Option<f64>,
    /// Their difference in place, millimetres.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub halves_differ_mm: Option<f64>,
    /// Their difference in direction, degrees.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub halves_differ_deg: Option<f64>,
}

/// Origin of the images of a calibrated camera.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Provenance {
    /// The stream.
    pub stream: String,
    /// Serial number; empty if unknown.
    pub serial: String,
}

impl Calibration {
    /// The file of a result; `of` has the provenance of each camera, in order.
    pub fn new(
        result: &MountResult,
        board: &Board,
        of: &[Provenance],
        created: String,
        by: Option<String>,
    ) -> Self {
        Self {
            format: FORMAT.to_owned(),
            created,
            by,
            reference: result.cameras.first().map(|c| c.name.clone()).unwrap_or_default(),
            rms_px: result.rms_px,
            board: board.clone(),
            cameras: result.cameras.iter().zip(of).map(|(c, of)| CalibratedCamera::new(c, of)).collect(),
            depth: Vec::new(),
        }
    }

    /// Takes over from an earlier calibration of the same devices what views of a board at rest do not show: latencies and corrections of
    /// depth. Returns the cameras, or the cameras' streams, for which there was something.
    pub fn keep_from(&mut self, before: &Self) -> Vec<String> {
        let mut kept = Vec::new();
        for camera in &mut self.cameras {
            let same = |c: &&CalibratedCamera| {
                c.name == camera.name && c.stream == camera.stream && c.serial == camera.serial
            };
            if let Some(latency) = before.cameras.iter().find(same).and_then(|c| c.latency.clone()) {
                camera.latency = Some(latency);
                kept.push(format!("latency of {}", camera.name));
            }
        }
        for correction in &before.depth {
            let same = |c: &CalibratedCamera| c.name == correction.camera && c.serial == correction.serial;
            if self.cameras.iter().any(same) {
                kept.push(format!("depth of {}/{}", correction.camera, correction.stream));
                self.depth.push(correction.clone());
            }
        }
        kept
    }

    /// Reads a file's text.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] with the line of what is wrong.
    pub fn from_toml(text: &str) -> Result<Self> {
        let bad = |why: String| Error::new(ErrorKind::BadInput, why);
        let found: Self = toml::from_str(text).map_err(|e| bad(format!("invalid calibration: {e}")))?;
        if found.format != FORMAT {
            return Err(bad(format!(
                "calibration of format '{}'; this version reads {FORMAT}",
                found.format
            )));
        }
        found.board.check()?;
        for (i, camera) in found.cameras.iter().enumerate() {
            camera.check().map_err(|e| bad(format!("camera {}: {e}", camera.name)))?;
            if found.cameras[..i].iter().any(|c| c.name == camera.name && c.stream == camera.stream) {
                return Err(bad(format!("camera {}: stream {} is there twice", camera.name, camera.stream)));
            }
        }
        for (i, entry) in found.depth.iter().enumerate() {
            entry.check()?;
            if found.depth[..i].iter().any(|d| d.camera == entry.camera && d.stream == entry.stream) {
                return Err(bad(format!("depth of {}/{} is there twice", entry.camera, entry.stream)));
            }
        }
        Ok(found)
    }

    /// The file's text.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] for numbers that TOML cannot hold.
    pub fn to_toml(&self) -> Result<String> {
        toml::to_string(self)
            .map_err(|e| Error::new(ErrorKind::BadInput, format!("the calibration cannot be written: {e}")))
    }

    /// The entries of a camera.
    pub fn of_camera(&self, name: &str) -> impl Iterator<Item = &CalibratedCamera> {
        self.cameras.iter().filter(move |c| c.name == name)
    }

    /// The correction of a depth stream.
    pub fn depth_of(&self, camera: &str, stream: &str) -> Option<&DepthCorrection> {
        self.depth.iter().find(|d| d.camera == camera && d.stream == stream)
    }
}

impl CalibratedCamera {
    fn new(camera: &CameraResult, of: &Provenance) -> Self {
        let k = &camera.intrinsics;
        let count = coefficients(k.distortion());
        let calibrated = camera.source == Source::Calibrated;
        let pose = Pose::from(&camera.rig_from_camera);
        let halves = camera.cross_validation.as_ref();
        Self {
            name: camera.name.clone(),
            stream: of.stream.clone(),
            serial: of.serial.clone(),
            width: camera.size.width,
            height: camera.size.height,
            source: camera.source,
            intrinsics: FileIntrinsics {
                model: k.distortion(),
                fx: k.fx,
                fy: k.fy,
                cx: k.cx,
                cy: k.cy,
                coeffs: k.coeffs[..count].to_vec(),
                sigmas: if calibrated { camera.sigmas[..4 + count].to_vec() } else { Vec::new() },
            },
            pose: FilePose {
                translation_m: pose.translation_m,
                rotation_xyzw: pose.rotation_xyzw,
                sigma_mm: camera.pose_sigma.metres * 1e3,
                sigma_deg: camera.pose_sigma.radians.to_degrees(),
                covariance: (0..6)
                    .map(|i| core::array::from_fn(|j| camera.pose_covariance[(i, j)]))
                    .collect(),
            },
            conditions: Conditions::default(),
            quality: Quality {
                views: camera.views,
                corners: camera.corners,
                rms_px: camera.rms_px,
                held_out_px: camera.held_out_px,
                factory_px: camera.factory_px,
                projection_middle_px: camera.uncertainty.middle_px(),
                projection_worst_px: camera.uncertainty.worst_px(),
                halves_differ_px: halves.and_then(|h| h.projection.as_ref()).map(|p| p.mean_px),
                halves_differ_mm: halves.and_then(|h| h.pose).map(|p| p.metres * 1e3),
                halves_differ_deg: halves.and_then(|h| h.pose).map(|p| p.radians.to_degrees()),
            },
            uncertainty: Some(UncertaintyMap {
                sigma_px: camera.uncertainty.sigma_px.iter().map(|s| (s * 1e4).round() / 1e4).collect(),
                ..camera.uncertainty.clone()
            }),
            latency: None,
        }
    }

    /// The size of its images.
    pub const fn size(&self) -> ImageSize {
        ImageSize { width: self.width, height: self.height }
    }

    /// Its intrinsics.
    pub fn intrinsics(&self) -> Intrinsics {
        let k = &self.intrinsics;
        let mut coeffs = [0.0; INTRINSIC_PARAMETERS - 4];
        for (to, from) in coeffs.iter_mut().zip(&k.coeffs) {
            *to = *from;
        }
        Intrinsics { coeffs, model: k.model as u32, ..Intrinsics::pinhole(k.fx, k.fy, k.cx, k.cy) }
    }

    /// Its pose on the mount.
    pub const fn pose(&self) -> Pose {
        Pose { translation_m: self.pose.translation_m, rotation_xyzw: self.pose.rotation_xyzw }
    }

    /// Covariance of its pose, as [`crate::adjustment::Covariance::pose`] has it; from the standard deviations if the file has no
    /// more.
    pub fn pose_covariance(&self) -> Matrix6<f64> {
        let rows = &self.pose.covariance;
        if rows.len() == 6 {
            return Matrix6::from_fn(|i, j| rows[i][j]);
        }
        let rotation = self.pose.sigma_deg.to_radians().powi(2) / 3.0;
        let place = (self.pose.sigma_mm * 1e-3).powi(2) / 3.0;
        Matrix6::from_diagonal(&Vector6::new(rotation, rotation, rotation, place, place, place))
    }

    fn check(&self) -> Result<()> {
        let bad = |why: String| Err(Error::new(ErrorKind::BadInput, why));
        if self.name.is_empty() || self.stream.is_empty() || self.width == 0 || self.height == 0 {
            return bad("name, stream, width and height are needed".to_owned());
        }
        let most = coefficients(self.intrinsics.model);
        if self.intrinsics.coeffs.len() > most {
            return bad(format!("coeffs has {} values; this model has {most}", self.intrinsics.coeffs.len()));
        }
        let length = self.pose.rotation_xyzw.iter().map(|c| c * c).sum::<f64>().sqrt();
        if length.is_nan() || (length - 1.0).abs() > 1e-3 {
            return bad(format!("rotation_xyzw has the length {length:.4}; a rotation has 1"));
        }
        let rows = &self.pose.covariance;
        if !(rows.is_empty() || rows.len() == 6) || rows.iter().flatten().any(|c| !c.is_finite()) {
            return bad("covariance has six rows of six finite numbers, or is left out".to_owned());
        }
        if self.pose.translation_m.iter().any(|t| !t.is_finite()) {
            return bad("translation_m is not finite".to_owned());
        }
        let is_grid = |m: &UncertaintyMap| m.columns > 0 && m.sigma_px.len().is_multiple_of(m.columns);
        if !self.uncertainty.as_ref().is_none_or(is_grid) {
            return bad("uncertainty has rows of `columns` values each".to_owned());
        }
        if let Some(latency) = &self.latency {
            latency.check()?;
        }
        depthrig_calib::Camera::new(&self.intrinsics()).map(|_| ())
    }
}

/// Coefficients of a model.
pub(crate) const fn coefficients(model: Distortion) -> usize {
    match model {
        Distortion::BrownConrady | Distortion::InverseBrownConrady => 5,
        Distortion::KannalaBrandt4 => 4,
        Distortion::Rational => 8,
        _ => 0,
    }
}
