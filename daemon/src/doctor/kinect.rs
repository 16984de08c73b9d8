//! Azure Kinects: Microsoft's libraries that are not there, and a display that the depth engine would miss.

use super::finding::{Finding, Severity};
use crate::config::{BackendConfig, CameraConfig, KinectSettings, RigConfig};
use depthrig_drivers::kinect::live::{CURE, LiveConfig, check_libraries};

/// Requirements of a session with attached Kinects that the computer does not meet.
#[derive(Debug, Clone, Default)]
pub struct KinectFacts {
    /// By camera of the rig: the missing requirement, in words.
    pub missing: Vec<(String, Missing, String)>,
    /// Whether programs of this user have a display.
    pub has_display: bool,
}

/// A library that is missing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Missing {
    /// libk4a: the camera is not opened.
    Library,
    /// The depth engine: it gives no depth.
    Engine,
}

impl KinectFacts {
    /// Asks for everything. Libraries are loaded, as they would be by the session; nothing is for a rig without a Kinect.
    pub(super) fn gather(config: &RigConfig) -> Self {
        let mut missing = Vec::new();
        for (camera, live) in attached(config) {
            let name = camera.name.to_string();
            if let Err(e) = check_libraries(&live.places, false) {
                missing.push((name, Missing::Library, e.to_string()));
            } else if wants_depth(camera)
                && let Err(e) = check_libraries(&live.places, true)
            {
                missing.push((name, Missing::Engine, e.to_string()));
            }
        }
        let is_set = |variable: &str| std::env::var_os(variable).is_some_and(|v| !v.is_empty());
        Self { missing, has_display: is_set("DISPLAY") }
    }

    /// Notes the missing requirements, and takes back findings about a camera that follow from them.
    pub(super) fn check(&self, config: &RigConfig, findings: &mut Vec<Finding>) {
        for (camera, missing, what) in &self.missing {
            let of_camera = |f: &Finding| f.camera.as_deref() == Some(camera) && f.id == "camera_failed";
            let (id, why) = match missing {
                Missing::Library => {
                    // Without it the camera could not be asked either.
                    findings.retain(|f| !of_camera(f));
                    (
                        "kinect_library",
                        "an attached Kinect is read through it; without it the rig does not start",
                    )
                }
                Missing::Engine => (
                    "kinect_engine",
                    "it makes depth of what the camera sends; without it the camera does not start",
                ),
            };
            findings.push(Finding::new(Severity::Error, id, what.as_str(), why, CURE).of(camera));
        }
        for (camera, _) in attached(config).filter(|(camera, _)| wants_depth(camera)) {
            let name = camera.name.as_str();
            if self.has_display || self.missing.iter().any(|(of, ..)| of == name) {
                continue;
            }
            let finding = Finding::new(
                Severity::Warning,
                "kinect_display",
                "the variable DISPLAY is not set, and the Kinect's depth engine needs an X display for OpenGL",
                "without one the camera does not start, or libk4a hangs in starting it",
                "set DISPLAY (such as :0) to a display that this user may use, in a service as well; a computer without a \
                 screen can run an X server on its graphics card all the same",
            );
            findings.push(finding.of(name));
        }
    }
}

/// The cameras of the rig that are Kinects to be attached.
fn attached(config: &RigConfig) -> impl Iterator<Item = (&CameraConfig, &LiveConfig)> {
    config.cameras.iter().filter_map(|c| match &c.backend {
        BackendConfig::Kinect(KinectSettings::Live(live)) => Some((c, live)),
        _ => None,
    })
}

fn wants_depth(camera: &CameraConfig) -> bool {
    camera.streams.is_empty() || camera.streams.iter().any(|s| s.stream.as_str() != "color")
}
