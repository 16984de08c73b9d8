//! Questions of the rig's threads to their shared state.

use super::{Inner, SetAccounts, join};
use crate::recording::{Recording, StreamFacts};
use crate::sets::SpreadStats;
use crate::status::CameraState;
use crate::{Error, ErrorKind, Result};
use core::time::Duration;
use depthrig_bus::sync::lock;
use depthrig_bus::{HostTime, StreamId};
use depthrig_sim::synthetic::DrawingProgress;
use std::sync::atomic::Ordering;
use std::sync::{Arc, MutexGuard};

impl Inner {
    pub(super) fn drawing(&self) -> Option<DrawingProgress> {
        self.shared.drawing.as_ref()?.progress()
    }

    /// Refuses while simulated cameras show coarse images: a dataset of them would look like a broken one.
    pub(super) fn must_be_drawn(&self) -> Result<()> {
        let Some(DrawingProgress { done, total, error }) = self.drawing() else { return Ok(()) };
        let cure = match error {
            Some(e) => e,
            None => format!(
                "{} % are done; try again when `depthrig status` no longer reports `preparing`",
                100 * done / total
            ),
        };
        let what =
            format!("the images of simulated cameras are still being rendered and coarse until then: {cure}");
        Err(Error::new(ErrorKind::WrongState, what))
    }

    pub(super) fn spreads(&self) -> MutexGuard<'_, SpreadStats> {
        lock(&self.spreads)
    }

    pub(super) fn recording(&self) -> MutexGuard<'_, Recording> {
        lock(&self.recording)
    }

    pub(super) fn set_accounts(&self) -> MutexGuard<'_, SetAccounts> {
        lock(&self.set_accounts)
    }

    /// Waits until the sets that wait for refined depth are with the recorder.
    pub(super) fn finish_held(&self) {
        self.closing.store(true, Ordering::Relaxed);
        let deadline = HostTime::now().plus(join::TIMEOUT);
        while self.held_sets.load(Ordering::Relaxed) > 0 && !deadline.from_now().is_zero() {
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    pub(super) fn all_done(&self) -> bool {
        self.cameras.iter().all(|c| matches!(c.state().phase, CameraState::Finished | CameraState::Failed))
    }

    pub(super) fn stream_facts(&self) -> Vec<StreamFacts> {
        let mut facts = Vec::new();
        for camera in &self.cameras {
            let state = camera.state();
            let Some(info) = &state.info else { continue };
            facts.extend(state.all_streams().map(|stream| {
                let mut calibration = info.calibration.clone();
                if stream.profile.format.is_motion() && !info.motion.is_empty() {
                    calibration = format!("{calibration}; {}", info.motion);
                }
                let correction = camera.config.refined_correction();
                if let Some(correction) = correction.filter(|_| is_refined(&stream.id)) {
                    calibration = format!("{calibration}; {correction}");
                }
                StreamFacts {
                    stream: Arc::clone(stream),
                    model: info.model.clone(),
                    serial: info.serial.clone(),
                    firmware: info.firmware.clone(),
                    calibration,
                    camera_pose: state.pose,
                    computed: camera.computed(&stream.id),
                }
            }));
        }
        facts
    }
}

/// Whether the refine stage makes the stream.
pub(super) fn is_refined(id: &StreamId) -> bool {
    [depthrig_cdm::stage::REFINED, depthrig_cdm::stage::ALIGNED].contains(&id.stream.as_str())
}
