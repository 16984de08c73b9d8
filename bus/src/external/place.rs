//! The camera and rig that a process serves, and the channels that it shares with the daemon.

use super::{
    BUFFER, CAMERA_VARIABLE, ExternalAnswer, ExternalFrame, ExternalOffer, LOCK_SUFFIX, MAX_EVENT_PORTS,
    MAX_HELD, MAX_NODES, MAX_PUBLISHERS, MAX_SUBSCRIBERS, PREFIX, RIG_VARIABLE, SCHEMA,
};
use crate::channel::{Channel, Form};
use crate::{CameraName, Error, ErrorKind, Name, Result, RigName, RuntimeDir, StreamName, shm};

const TALK: Form = Form {
    schema: SCHEMA,
    publishers: MAX_PUBLISHERS,
    subscribers: MAX_SUBSCRIBERS,
    buffer: BUFFER,
    held: MAX_HELD,
    history: 1,
    nodes: MAX_NODES,
    notifiers: MAX_EVENT_PORTS,
    listeners: MAX_EVENT_PORTS,
    loans: 2,
    fewest_slots: shm::MIN_SLOTS,
};
/// No history: nobody waits for an old frame.
const FRAMES: Form = Form { history: 0, loans: 4, ..TALK };

/// A camera of a rig of this user.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Place {
    /// Where the rig's files are.
    pub runtime: RuntimeDir,
    /// The rig.
    pub rig: RigName,
    /// The camera.
    pub camera: CameraName,
}

impl Place {
    /// The place that the daemon gave to a process that it started with `command`: the variables `DEPTHRIG_RIG` and
    /// `DEPTHRIG_CAMERA`, and the runtime folder.
    ///
    /// # Errors
    /// [`ErrorKind::NotFound`] when one of the variables is not set, [`ErrorKind::BadName`] for an invalid name, else
    /// as [`RuntimeDir::of_user`].
    pub fn from_environment() -> Result<Self> {
        let name = |variable: &str| {
            let value = std::env::var(variable).map_err(|e| {
                let why = format!(
                    "{variable} is not set: it names what this process serves (see docs/external.md)"
                );
                Error::new(ErrorKind::NotFound, why).with_source(e)
            })?;
            Name::new(value)
        };
        Ok(Self { runtime: RuntimeDir::of_user()?, rig: name(RIG_VARIABLE)?, camera: name(CAMERA_VARIABLE)? })
    }

    /// The process that serves the camera now, in its own words; `None` without one.
    pub fn holder(&self) -> Option<String> {
        super::holder(&self.runtime, &self.rig, &self.camera)
    }

    pub(super) fn offers(&self) -> Channel<ExternalOffer> {
        Channel::new(TALK, self.name("offer"), self.what("what the process offers"))
    }

    pub(super) fn answers(&self) -> Channel<ExternalAnswer> {
        Channel::new(TALK, self.name("answer"), self.what("what the daemon answers"))
    }

    pub(super) fn frames(&self, stream: &StreamName) -> Channel<ExternalFrame> {
        Channel::new(
            FRAMES,
            self.name(&format!("frames/{stream}")),
            self.what(&format!("the process's frames of {stream}")),
        )
    }

    fn name(&self, what: &str) -> String {
        format!("{PREFIX}/{}/{}/{what}", self.rig, self.camera)
    }

    fn what(&self, what: &str) -> String {
        format!("camera \"{}\" of rig \"{}\": {what}", self.camera, self.rig)
    }
}

/// The cameras below `runtime` that a process serves now, each with that process as it described itself; sorted.
pub fn served(runtime: &RuntimeDir) -> Vec<(Place, String)> {
    let Ok(entries) = std::fs::read_dir(runtime.path()) else { return Vec::new() };
    let place = |name: &str| {
        let (rig, camera) = name.strip_suffix(LOCK_SUFFIX)?.split_once('.')?;
        let rig = Name::new(rig).ok()?;
        let camera = Name::new(camera).ok()?;
        Some(Place { runtime: runtime.clone(), rig, camera })
    };
    let mut served: Vec<_> = entries
        .filter_map(|e| {
            let place = place(e.ok()?.file_name().to_str()?)?;
            let holder = place.holder()?;
            Some((place, holder))
        })
        .collect();
    served.sort_by(|(a, _), (b, _)| (&a.rig, &a.camera).cmp(&(&b.rig, &b.camera)));
    served
}
