//! One camera of a rig: its configuration, what is known of it now, and what all cameras share.

use crate::Error;
use crate::config::{CameraConfig, SupervisorConfig};
use crate::stage::{Entrance, Lane};
use crate::status::CameraState;
use crate::stream::Stream;
use crate::wake::Wake;
use depthrig_bus::{Bus, HostTime, StreamId};
use depthrig_drivers::DeviceInfo;
use depthrig_drivers::stereo::{Descriptions, EYES, Notice, PREFIXES};
use depthrig_drivers::synthetic::Drawing;
use depthrig_recorder::Computed;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

mod open;
mod supervisor;

pub use supervisor::Supervisor;

/// A camera and the state of its supervisor.
#[derive(Debug)]
pub struct Camera {
    /// Its part of the configuration.
    pub config: CameraConfig,
    /// What computes each mode of its stereo, once it was open.
    pub computed: Descriptions,
    /// What is wrong with its eyes although it streams.
    pub notice: Notice,
    state: Mutex<State>,
}

/// What is known of a camera now.
#[derive(Debug)]
pub struct State {
    /// Where its supervisor stands.
    pub phase: CameraState,
    /// Since when.
    pub since: HostTime,
    /// Why it is not streaming.
    pub message: Option<String>,
    /// The error behind the message, for whoever waits for the first opening.
    pub error: Option<Error>,
    /// What the device says of itself, once it was open.
    pub info: Option<DeviceInfo>,
    /// Its streams, once it was open; they stay the same over reconnects.
    pub streams: Vec<Arc<Stream>>,
    /// Those that are made of them.
    pub made: Vec<Arc<Stream>>,
    /// How they are made.
    pub lane: Option<Arc<Lane>>,
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
            since: HostTime::from_ns(0),
            message: None,
            error: None,
            info: None,
            streams: Vec::new(),
            made: Vec::new(),
            lane: None,
            set_bytes: 0,
            short_of_memory: false,
            reconnects: 0,
        };
        Self {
            config,
            computed: Descriptions::default(),
            notice: Notice::default(),
            state: Mutex::new(state),
        }
    }

    /// What computed `stream`, if it is made of the eyes: for the dataset that it is recorded in.
    pub fn computed(&self, stream: &StreamId) -> Option<Computed> {
        let all = self.computed.lock().unwrap_or_else(PoisonError::into_inner);
        let mode = PREFIXES.iter().find_map(|p| stream.stream.as_str().strip_prefix(p))?;
        let d = all.get(mode)?;
        let eye = |name: &&str| StreamId::new(stream.camera.as_str(), name).ok();
        Some(Computed {
            stream: stream.clone(),
            // It is nobody's closed algorithm, and says so.
            name: format!("mimic_{mode}"),
            producer: d.producer.clone(),
            parameters: d.parameters.clone(),
            from: EYES.iter().filter_map(eye).collect(),
        })
    }

    /// What is known of it now.
    pub fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl State {
    /// Its streams and those that are made of them.
    pub fn all_streams(&self) -> impl Iterator<Item = &Arc<Stream>> {
        self.streams.iter().chain(&self.made)
    }

    /// It is `state` now, because of `message`; told once.
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

/// What every camera of a rig shares.
pub struct Shared {
    /// The rig's bus.
    pub bus: Bus,
    /// Rung after every frame.
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
    pub stage: Arc<Entrance>,
}
