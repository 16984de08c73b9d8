//! One camera of a rig: its configuration, its present state, and the state that all cameras share.

use crate::Error;
use crate::config::{CameraConfig, SupervisorConfig};
use crate::stage::{Intake, Refinement};
use crate::status::CameraState;
use crate::stream::Stream;
use crate::wake::Wake;
use depthrig_bus::sync::lock;
use depthrig_bus::{Bus, HostTime, Pose, StreamId};
use depthrig_driver::DeviceInfo;
use depthrig_driver::controls::{ControlPanel, ControlValue};
use depthrig_recorder::Computed;
use depthrig_sim::synthetic::Drawing;
use depthrig_stereo::{Descriptions, Notice, PREFIXES, SIDES};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, Weak};

mod calibration;
pub(crate) use calibration::status as calibration_status;
mod open;
mod supervisor;

pub use supervisor::Supervisor;

/// A camera and the state of its supervisor.
pub struct Camera {
    /// Its part of the configuration.
    pub config: CameraConfig,
    /// The algorithm of each mode of its stereo, once it was open.
    pub computed: Descriptions,
    /// A problem with its stereo images although it streams.
    pub notice: Notice,
    /// Controls that were changed while it ran, with their values, by key. It has them again when it comes back.
    pub changed: Mutex<BTreeMap<String, ControlValue>>,
    state: Mutex<State>,
}

/// The present state of a camera.
pub struct State {
    /// Where its supervisor stands.
    pub phase: CameraState,
    /// Since when.
    pub since: HostTime,
    /// Why it is not streaming.
    pub message: Option<String>,
    /// The error behind the message, for whoever waits for the first opening.
    pub error: Option<Error>,
    /// Pose of the camera on the mount: the rig file's until it was open, then that of its calibration, if it has one.
    pub pose: Pose,
    /// The device's facts about itself, once it was open.
    pub info: Option<DeviceInfo>,
    /// Its streams, once it was open; they stay the same over reconnects.
    pub streams: Vec<Arc<Stream>>,
    /// The computed ones.
    pub derived: Vec<Arc<Stream>>,
    /// The controls of the running device.
    pub panel: Option<Weak<dyn ControlPanel>>,
    /// Refinement of its depth.
    pub refinement: Option<Arc<Refinement>>,
    /// Bytes of one frame of every stream, once it was open.
    pub set_bytes: u64,
    /// Shared memory is too small for it.
    pub short_of_memory: bool,
    /// Times that it came back.
    pub reconnects: u64,
}

impl Camera {
    /// A camera that was never opened.
    pub fn new(config: CameraConfig) -> Self {
        let state = State {
            phase: CameraState::Opening,
            since: HostTime::now(),
            message: None,
            error: None,
            pose: config.pose,
            info: None,
            streams: Vec::new(),
            derived: Vec::new(),
            panel: None,
            refinement: None,
            set_bytes: 0,
            short_of_memory: false,
            reconnects: 0,
        };
        Self {
            config,
            computed: Descriptions::default(),
            notice: Notice::default(),
            changed: Mutex::default(),
            state: Mutex::new(state),
        }
    }

    /// The algorithm behind `stream`, if it is computed from left and right: for the dataset that it is recorded in.
    pub fn computed(&self, stream: &StreamId) -> Option<Computed> {
        let all = lock(&self.computed);
        let mode = PREFIXES.iter().find_map(|p| stream.stream.as_str().strip_prefix(p))?;
        let d = all.get(mode)?;
        let side = |name: &&str| StreamId::new(stream.camera.as_str(), name).ok();
        Some(Computed {
            stream: stream.clone(),
            // It is nobody's closed algorithm, and says so.
            name: format!("mimic_{mode}"),
            producer: d.producer.clone(),
            parameters: d.parameters.clone(),
            from: SIDES.iter().filter_map(side).collect(),
        })
    }

    /// Its present state.
    pub fn state(&self) -> MutexGuard<'_, State> {
        lock(&self.state)
    }
}

impl State {
    /// Its streams, those of the device and the computed ones.
    pub fn all_streams(&self) -> impl Iterator<Item = &Arc<Stream>> {
        self.streams.iter().chain(&self.derived)
    }

    /// Enters `state`, because of `message`, which is logged once.
    fn enter(&mut self, camera: &str, state: CameraState, message: Option<String>) {
        if self.phase == state && self.message == message {
            return;
        }
        match (&message, state) {
            (Some(why), CameraState::Failed) => tracing::error!(camera, state = state.name(), "{why}"),
            (Some(why), _) => tracing::warn!(camera, state = state.name(), "{why}"),
            (None, _) => tracing::info!(camera, state = state.name(), "camera"),
        }
        if self.phase != state {
            self.since = HostTime::now();
        }
        (self.phase, self.message) = (state, message);
    }
}

/// Everything that the cameras of a rig share.
pub struct Shared {
    /// The rig's bus.
    pub bus: Bus,
    /// Raised after every frame.
    pub frames: Arc<Wake>,
    /// Bytes of shared memory that one camera may plan with.
    pub memory_share: u64,
    /// Slots per stream when memory is plenty.
    pub slots: usize,
    /// When the rig began: the beginning of time for simulated cameras.
    pub began: HostTime,
    /// Supervision settings.
    pub supervisor: SupervisorConfig,
    /// Renders the scenes of simulated cameras while they stream, if they are to stream at once.
    pub drawing: Option<Arc<Drawing>>,
    /// Where depth is refined.
    pub stage: Arc<Intake>,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::RigConfig;

    #[test]
    fn a_camera_that_was_never_opened_is_in_its_state_since_it_was_made() {
        let text = "rig = \"test\"\n[[camera]]\nname = \"front\"\nbackend = \"synthetic\"\n";
        let rig = RigConfig::parse(text, None).unwrap();
        let began = HostTime::now();
        let camera = Camera::new(rig.cameras[0].clone());
        assert!(camera.state().since >= began);
    }
}
