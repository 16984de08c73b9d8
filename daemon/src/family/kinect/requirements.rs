//! Microsoft's libraries that an attached Kinect needs, and the display that its depth engine needs.

use crate::doctor::{Finding, Severity};
use crate::family::Unmet;
use depthrig_kinect::live::CURE;

/// Facts about this computer that a session with an attached Kinect depends on.
pub(crate) struct Facts {
    /// libk4a, or why it cannot be loaded.
    pub(crate) library: core::result::Result<(), String>,
    /// The depth engine, or why it cannot be loaded.
    pub(crate) engine: core::result::Result<(), String>,
    /// Whether a stream of depth or infrared is started.
    pub(crate) wants_depth: bool,
    /// Whether programs of this user have a display.
    pub(crate) has_display: bool,
}

impl Facts {
    /// The first requirement that is not met; the later ones depend on it.
    pub(crate) fn unmet(self) -> Option<Unmet> {
        if let Err(what) = self.library {
            let why = "an attached Kinect is read through it; without it the rig does not start";
            let finding = Finding::new(Severity::Error, "kinect_library", what, why, CURE);
            return Some(Unmet { finding, explains_failure: true });
        }
        let finding = match self.engine {
            Err(what) => Finding::new(
                Severity::Error,
                "kinect_engine",
                what,
                "it makes depth of what the camera sends; without it the camera does not start",
                CURE,
            ),
            Ok(()) if self.wants_depth && !self.has_display => Finding::new(
                Severity::Warning,
                "kinect_display",
                "the variable DISPLAY is not set, and the Kinect's depth engine needs an X display for OpenGL",
                "without one the camera does not start, or libk4a hangs in starting it",
                "set DISPLAY (such as :0) to a display that this user may use, in a service as well; a computer without a \
                 screen can run an X server on its graphics card all the same",
            ),
            Ok(()) => return None,
        };
        Some(Unmet { finding, explains_failure: false })
    }
}
