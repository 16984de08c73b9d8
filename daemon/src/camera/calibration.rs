//! A calibration of ours in place of what the camera and the rig file say about intrinsics and pose.

use crate::config::{CameraCalibration, CameraConfig};
use crate::status::CalibrationStatus;
use depthrig_bus::Pose;
use depthrig_calib::PoseExt;
use depthrig_calibrate::file::{CalibratedCamera, Conditions, FileLatency, age_days, old};
use depthrig_calibrate::mount::Source;
use depthrig_cdm::stage::{Correct, RefineConfig};
use depthrig_driver::clock::CalibratedLatency;
use depthrig_driver::{DeviceInfo, Error, ErrorKind, Result, StreamProfile};
use std::sync::Arc;

/// A camera's part of the calibration, beside the intrinsics.
#[derive(Debug, PartialEq)]
pub(super) struct Applied {
    /// Its pose on the mount.
    pub pose: Pose,
    /// Latency of each of its streams, where one was calibrated.
    pub latencies: Vec<Option<CalibratedLatency>>,
}

/// Puts calibrated intrinsics into `profiles`, says so and how late frames come in `info`, and returns the rest.
///
/// # Errors
/// [`ErrorKind::BadInput`] for a calibration of another device or another size of image: a wrong calibration is worse than none.
pub(super) fn apply(
    config: &CameraConfig,
    profiles: &mut [StreamProfile],
    info: &mut DeviceInfo,
) -> Result<Applied> {
    let mut pose = None;
    let mut latencies: Vec<Option<&FileLatency>> = vec![None; profiles.len()];
    for calibration in &config.calibration {
        let entry = &calibration.camera;
        if !entry.serial.is_empty() && entry.serial != info.serial {
            return Err(refused(
                entry,
                &format!("is of serial number {}, this camera has {}", entry.serial, info.serial),
            ));
        }
        let now = conditions(info, calibration, None);
        if let Some(why) = entry.conditions.refused(&now) {
            return Err(refused(entry, &why));
        }
        let Some(index) = profiles.iter().position(|p| p.stream.as_str() == entry.stream) else { continue };
        let profile = &mut profiles[index];
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
        latencies[index] = entry.latency.as_ref();
    }
    // Streams without an entry of their own come over the same cable: without this they would not pair with the others any more.
    let first = latencies.iter().flatten().next().copied();
    if let Some(latency) = first {
        info.calibration = format!("{}, {}", info.calibration, latency.describe());
    }
    let of_stream = |own: Option<&FileLatency>| {
        own.or(first).map(|l| CalibratedLatency { ns: l.latency_ns(), bound_ns: l.bound_ns() })
    };
    Ok(Applied {
        pose: pose.unwrap_or(config.pose),
        latencies: latencies.into_iter().map(of_stream).collect(),
    })
}

/// State of the camera now, as far as it matters to its calibration.
fn conditions(info: &DeviceInfo, calibration: &CameraCalibration, temperature_c: Option<f64>) -> Conditions {
    Conditions { firmware: info.firmware.clone(), temperature_c, lens_position: calibration.lens_position }
}

/// How the calibration of a camera stands; `None` without one.
pub(crate) fn status(
    config: &CameraConfig,
    info: &DeviceInfo,
    temperature_c: Option<f64>,
    now_utc_ns: i64,
) -> Option<CalibrationStatus> {
    let calibration = config.calibration.first()?;
    let entry = &calibration.camera;
    let age_days = age_days(&calibration.created, now_utc_ns);
    let mut warnings = entry.conditions.doubts(&conditions(info, calibration, temperature_c));
    warnings.extend(age_days.and_then(old));
    warnings.extend(entry.poor());
    Some(CalibrationStatus {
        created: calibration.created.clone(),
        age_days,
        worth: entry.worth(),
        sigma_mm: entry.pose.sigma_mm,
        sigma_deg: entry.pose.sigma_deg,
        rms_px: entry.quality.rms_px,
        held_out_px: entry.quality.held_out_px,
        projection_worst_px: entry.quality.projection_worst_px,
        halves_differ_px: entry.quality.halves_differ_px,
        halves_differ_mm: entry.quality.halves_differ_mm,
        warnings,
    })
}

/// How the refine stage corrects the camera's depth first, if its settings ask for it.
///
/// # Errors
/// [`crate::ErrorKind::BadInput`] when the correction is of another device or size of image.
pub(super) fn correct_of(
    config: &CameraConfig,
    refine: &RefineConfig,
    depth: &StreamProfile,
    info: &DeviceInfo,
) -> crate::Result<Option<Correct>> {
    if !refine.corrected {
        return Ok(None);
    }
    // The rig's start has refused a calibration without it.
    let Some(entry) = config.refined_correction() else { return Ok(None) };
    let refused = |e: depthrig_calib::Error| crate::Error::new(crate::ErrorKind::BadInput, e.to_string());
    entry.check_fits(&info.serial, depth.width, depth.height).map_err(refused)?;
    let correction = entry.correction();
    Ok(Some(Correct(Arc::new(move |counts, unit_m| correction.apply_to_counts(unit_m, counts)))))
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
    use crate::config::RigConfig;
    use depthrig_bus::{ClockDomain, Intrinsics, MetadataLevel, PixelFormat, StreamName};
    use depthrig_calibrate::file::Calibration;
    use depthrig_driver::DeviceClock;

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
            lens_position: Some(30),
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
        let Applied { pose, latencies } = apply(&config(), &mut profiles, &mut info).unwrap();
        assert_eq!(profiles[1].intrinsics.fx, 601.0);
        assert_eq!(profiles[0].intrinsics.fx, profile("depth", 0.0, 848).intrinsics.fx);
        // The colour camera is where it was found to be, and depth 15 mm beside it.
        assert_eq!(pose.compose(&profiles[1].pose_in_device).translation_m, [1.0, 0.0, 0.0]);
        assert!((pose.compose(&profiles[0].pose_in_device).translation_m[0] - 0.985).abs() < 1e-12);
        assert_eq!(info.calibration, "calibrated 2026-11-25T03:00:00Z (factory)");
        assert_eq!(latencies, [None, None]);
    }

    #[test]
    fn a_latency_is_that_of_the_camera_and_is_named() {
        let mut config = config();
        let mut of_camera = CameraCalibration::clone(&config.calibration[0]);
        of_camera.camera.latency = Some(FileLatency {
            latency_ms: 4.7,
            sigma_ms: 0.02,
            reference: "other".to_owned(),
            created: "2026-11-25T04:00:00Z".to_owned(),
            dataset: "wave".to_owned(),
            board: "chessboard".to_owned(),
        });
        config.calibration = vec![Arc::new(of_camera)];
        let mut profiles = [profile("depth", 0.0, 848), profile("color", 0.015, 640)];
        let mut info = info("7");
        let applied = apply(&config, &mut profiles, &mut info).unwrap();
        let latency = Some(CalibratedLatency { ns: 4_700_000, bound_ns: 60_000 });
        assert_eq!(applied.latencies, [latency, latency]);
        let named =
            "calibrated 2026-11-25T03:00:00Z (factory), latency 4.70 ms ± 0.02 of 2026-11-25T04:00:00Z";
        assert_eq!(info.calibration, named);
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

    #[test]
    fn a_calibration_of_another_focus_is_refused() {
        let mut config = config();
        let mut calibration = CameraCalibration::clone(&config.calibration[0]);
        for (then, fits) in [(30, true), (31, false)] {
            calibration.camera.conditions.lens_position = Some(then);
            config.calibration = vec![Arc::new(calibration.clone())];
            let applied = apply(&config, &mut [profile("color", 0.0, 640)], &mut info("7"));
            assert_eq!(applied.is_ok(), fits);
            if let Err(e) = applied {
                assert!(e.to_string().contains("focus_absolute = 31"), "{e}");
            }
        }
    }

    #[test]
    fn the_status_says_what_a_calibration_is_worth_and_why_it_may_not_hold() {
        let mut config = config();
        let mut calibration = CameraCalibration::clone(&config.calibration[0]);
        calibration.camera.conditions.firmware = "5.1".into();
        calibration.camera.conditions.temperature_c = Some(20.0);
        calibration.camera.conditions.lens_position = Some(30);
        config.calibration = vec![Arc::new(calibration)];
        // 2026-11-25T03:00:00Z and half a day.
        let soon = (1_795_575_600 + 43_200) * 1_000_000_000;
        let same = DeviceInfo { firmware: "5.1".into(), ..info("7") };
        let good = status(&config, &same, Some(25.0), soon).unwrap();
        assert_eq!((good.age_days, good.warnings.len()), (Some(0.5), 0), "{:?}", good.warnings);
        assert!(good.worth.contains("pose ± 0.10 mm"), "{}", good.worth);
        let other = DeviceInfo { firmware: "5.2".into(), ..info("7") };
        let later = status(&config, &other, Some(45.0), soon + 100 * 86_400 * 1_000_000_000).unwrap();
        assert_eq!(later.warnings.len(), 3, "{:?}", later.warnings);
        config.calibration.clear();
        assert_eq!(status(&config, &same, None, soon), None);
    }
}
