//! A calibration of ours in place of what the camera and the rig file say about intrinsics and pose.

use crate::config::CameraConfig;
use depthrig_bus::Pose;
use depthrig_calib::PoseExt;
use depthrig_calibrate::file::CalibratedCamera;
use depthrig_calibrate::mount::Source;
use depthrig_driver::{DeviceInfo, Error, ErrorKind, Result, StreamProfile};

/// Puts calibrated intrinsics into `profiles`, says so in `info`, and returns the pose of the camera on the mount.
///
/// # Errors
/// [`ErrorKind::BadInput`] for a calibration of another device or another size of image: a wrong calibration is worse than none.
pub(super) fn apply(
    config: &CameraConfig,
    profiles: &mut [StreamProfile],
    info: &mut DeviceInfo,
) -> Result<Pose> {
    let mut pose = None;
    for calibration in &config.calibration {
        let entry = &calibration.camera;
        if !entry.serial.is_empty() && entry.serial != info.serial {
            return Err(refused(
                entry,
                &format!("is of serial number {}, this camera has {}", entry.serial, info.serial),
            ));
        }
        let Some(profile) = profiles.iter_mut().find(|p| p.stream.as_str() == entry.stream) else { continue };
        if (profile.width, profile.height) != (entry.width, entry.height) {
            return Err(refused(
                entry,
                &format!(
                    "is for {}x{}, the stream has {}x{}",
                    entry.width, entry.height, profile.width, profile.height
                ),
            ));
        }
        if entry.source == Source::Calibrated {
            profile.intrinsics = entry.intrinsics();
            info.calibration = format!("calibrated {} ({})", calibration.created, info.calibration);
        }
        // The device as a whole moves with the stream that was calibrated.
        pose.get_or_insert_with(|| entry.pose().compose(&profile.pose_in_device.inverse()));
    }
    Ok(pose.unwrap_or(config.pose))
}

fn refused(entry: &CalibratedCamera, why: &str) -> Error {
    Error::new(
        ErrorKind::BadInput,
        format!(
            "the calibration of {}/{} {why}; calibrate this camera as it is used, or take its entry out of the calibration file",
            entry.name, entry.stream
        ),
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{CameraCalibration, RigConfig};
    use depthrig_bus::{ClockDomain, Intrinsics, MetadataLevel, PixelFormat, StreamName};
    use depthrig_calibrate::file::Calibration;
    use depthrig_driver::DeviceClock;
    use std::sync::Arc;

    const FILE: &str = r#"
format = "depthrig.calibration/1"
created = "2026-11-25T03:00:00Z"
reference = "cam"
rms_px = 0.2
[board]
pattern = "chessboard"
columns = 10
rows = 7
square_mm = 25.0
[[camera]]
name = "cam"
stream = "color"
serial = "7"
width = 640
height = 480
source = "calibrated"
intrinsics = { model = "none", fx = 601.0, fy = 602.0, cx = 321.0, cy = 241.0 }
pose = { translation_m = [1.0, 0.0, 0.0], rotation_xyzw = [0.0, 0.0, 0.0, 1.0], sigma_mm = 0.1, sigma_deg = 0.01 }
quality = { views = 9, corners = 400, rms_px = 0.2, projection_middle_px = 0.1, projection_worst_px = 0.3 }
"#;

    fn config() -> CameraConfig {
        let text = "rig = \"test\"\n[[camera]]\nname = \"cam\"\nbackend = \"synthetic\"\nmodel = \"d435\"\n";
        let mut config = RigConfig::parse(text, None).unwrap().cameras.remove(0);
        let file = Calibration::from_toml(FILE).unwrap();
        config.calibration = vec![Arc::new(CameraCalibration {
            created: file.created.clone(),
            camera: file.cameras[0].clone(),
        })];
        config
    }

    fn profile(name: &str, x_m: f64, width: u32) -> StreamProfile {
        StreamProfile {
            stream: StreamName::new(name).unwrap(),
            format: PixelFormat::Rgb8,
            width,
            height: 480,
            rate_hz: 30.0,
            depth_unit_m: 0.0,
            intrinsics: Intrinsics::pinhole(500.0, 500.0, 320.0, 240.0),
            pose_in_device: Pose { translation_m: [x_m, 0.0, 0.0], ..Pose::IDENTITY },
            clock: DeviceClock { counter_bits: 64, tick_ps: 1000, domain: ClockDomain::Device },
            sequence_bits: 64,
            metadata: MetadataLevel::Full,
        }
    }

    fn info(serial: &str) -> DeviceInfo {
        DeviceInfo { serial: serial.into(), calibration: "factory".into(), ..DeviceInfo::default() }
    }

    #[test]
    fn intrinsics_and_pose_are_those_of_the_file() {
        let mut profiles = [profile("depth", 0.0, 848), profile("color", 0.015, 640)];
        let mut info = info("7");
        let pose = apply(&config(), &mut profiles, &mut info).unwrap();
        assert_eq!(profiles[1].intrinsics.fx, 601.0);
        assert_eq!(profiles[0].intrinsics.fx, profile("depth", 0.0, 848).intrinsics.fx);
        // The colour camera is where it was found to be, and depth 15 mm beside it.
        assert_eq!(pose.compose(&profiles[1].pose_in_device).translation_m, [1.0, 0.0, 0.0]);
        assert!((pose.compose(&profiles[0].pose_in_device).translation_m[0] - 0.985).abs() < 1e-12);
        assert_eq!(info.calibration, "calibrated 2026-11-25T03:00:00Z (factory)");
    }

    #[test]
    fn a_calibration_of_another_camera_or_size_is_refused() {
        let mut other = [profile("color", 0.0, 1280)];
        let size = apply(&config(), &mut other, &mut info("7")).unwrap_err().to_string();
        assert!(size.contains("is for 640x480, the stream has 1280x480"), "{size}");
        let mut same = [profile("color", 0.0, 640)];
        let serial = apply(&config(), &mut same, &mut info("8")).unwrap_err().to_string();
        assert!(serial.contains("serial number 7, this camera has 8"), "{serial}");
    }
}
