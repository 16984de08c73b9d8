//! The cameras of a calibration, and which of them views are of.

use super::{Sightings, ViewedCamera};
use anyhow::{Result, bail};
use depthrig_calibrate::check::KnownCamera;
use depthrig_calibrate::file::Calibration;
use std::path::Path;

/// The cameras of a calibration.
pub fn cameras(file: &Calibration) -> Vec<KnownCamera> {
    file.cameras
        .iter()
        .map(|camera| KnownCamera {
            name: camera.name.clone(),
            intrinsics: camera.intrinsics(),
            rig_from_camera: (&camera.pose()).into(),
            covariance: camera.pose_covariance(),
        })
        .collect()
}

/// Index in the calibration of each camera that was looked at: the entry of its stream, or else its first one.
///
/// # Errors
/// For a camera that the calibration, which was read from `path`, does not have, or has with another size or serial number.
pub fn places(viewed: &[ViewedCamera], file: &Calibration, path: &Path) -> Result<Vec<usize>> {
    let path = path.display();
    viewed
        .iter()
        .map(|camera| {
            let stream = &camera.provenance.stream;
            let of_stream = file.cameras.iter().position(|c| c.name == camera.name && c.stream == *stream);
            let of_camera = || file.cameras.iter().position(|c| c.name == camera.name);
            let Some(place) = of_stream.or_else(of_camera) else {
                bail!("{path}: has no camera {}", camera.name);
            };
            let entry = &file.cameras[place];
            if entry.size() != camera.size {
                bail!(
                    "{path}: camera {} was calibrated at {}x{}, these images are {}x{}",
                    entry.name,
                    entry.width,
                    entry.height,
                    camera.size.width,
                    camera.size.height
                );
            }
            let serial = &camera.provenance.serial;
            if !entry.serial.is_empty() && !serial.is_empty() && entry.serial != *serial {
                bail!(
                    "{path}: camera {} was calibrated with serial number {}, now it has {serial}; calibrate again",
                    entry.name,
                    entry.serial
                );
            }
            Ok(place)
        })
        .collect()
}

/// Compares the conditions of views with those of the calibration, which was read from `path`; doubts are logged.
///
/// # Errors
/// When the calibration is not for these conditions, as for a lens that is focused otherwise.
pub fn compare_conditions(views: &Sightings, file: &Calibration, path: &Path) -> Result<()> {
    let path = path.display();
    for entry in &file.cameras {
        let Some(now) = views.conditions.get(&entry.name) else { continue };
        if let Some(why) = entry.conditions.refused(now) {
            bail!("{path}: the calibration of {} {why}", entry.name);
        }
        for doubt in entry.conditions.doubts(now) {
            tracing::warn!("{path}: {}: {doubt}", entry.name);
        }
    }
    Ok(())
}
