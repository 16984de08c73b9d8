//! The baseline of stereo cameras, which the sub-pixel noise of their depth is a matter of.

use anyhow::Result;
use depthrig_bus::{CameraName, Pose};
use depthrig_calib::PoseExt;
use depthrig_recorder::StreamRecord;

/// Streams of the left and of the right image.
const PAIRS: [[&str; 2]; 3] =
    [["left", "right"], ["infrared_left", "infrared_right"], ["infrared", "infrared_right"]];

/// Baselines from the makers' data sheets, millimetres. Parts of names in lower case without spaces, more special ones first.
const MODELS: [(&str, f64); 10] = [
    ("d405", 18.0),
    ("d415", 55.0),
    ("d435", 50.0),
    ("d436", 50.0),
    ("d430", 50.0),
    ("d455", 95.0),
    ("d457", 95.0),
    ("zed2", 120.0),
    ("zedmini", 63.0),
    ("zedx", 120.0),
];

/// `CAMERA=MM` of the command line.
#[derive(Debug, Clone)]
pub struct Given {
    /// The camera.
    pub camera: String,
    /// Millimetres.
    pub mm: f64,
}

/// Parses `CAMERA=MM`.
///
/// # Errors
/// When the name is missing or the number is out of range.
pub fn given(text: &str) -> Result<Given, String> {
    let (camera, mm) = text.split_once('=').ok_or("write CAMERA=MM, such as d435=50")?;
    CameraName::new(camera).map_err(|e| format!("invalid camera name {camera}: {e}"))?;
    let mm: f64 = mm.parse().map_err(|_| format!("'{mm}' is not a number"))?;
    if !(1.0..=1000.0).contains(&mm) {
        return Err(format!("{mm} mm is out of range 1..=1000"));
    }
    Ok(Given { camera: camera.to_owned(), mm })
}

/// The baseline of a camera, metres: as given, from the poses of its recorded images, or from its model. `None` for cameras that
/// are not stereo cameras or not known.
pub fn of_camera(streams: &[StreamRecord], camera: &str, model: &str, given: &[Given]) -> Option<f64> {
    if let Some(given) = given.iter().find(|g| g.camera == camera) {
        return Some(given.mm * 1e-3);
    }
    let pose = |stream: &str| -> Option<&Pose> {
        streams
            .iter()
            .find(|r| r.id.camera.as_str() == camera && r.id.stream.as_str() == stream)
            .map(|r| &r.pose)
    };
    let recorded = PAIRS.iter().find_map(|[left, right]| {
        let between = pose(left)?.inverse().compose(pose(right)?);
        Some(between.translation_m.iter().map(|t| t * t).sum::<f64>().sqrt()).filter(|b| *b > 1e-3)
    });
    recorded.or_else(|| {
        let name: String = model.to_lowercase().chars().filter(char::is_ascii_alphanumeric).collect();
        MODELS.iter().find(|(part, _)| name.contains(part)).map(|(_, mm)| mm * 1e-3)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_baseline_is_given_or_that_of_the_model() {
        let of = |model: &str, list: &[Given]| of_camera(&[], "cam", model, list);
        assert_eq!(of("Intel RealSense D435I", &[]), Some(0.05));
        assert_eq!(of("ZED 2i", &[]), Some(0.12));
        assert_eq!(of("L515", &[]), None);
        assert_eq!(of("L515", &[given("cam=75").unwrap()]), Some(0.075));
        assert!(given("cam").is_err() && given("cam=0").is_err() && given("cam=x").is_err());
    }
}
