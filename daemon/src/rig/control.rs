//! A rig of cameras as the control API sees it.

use super::{Inner, controls, lock, report};
use crate::attached::System;
use crate::config::RigConfig;
use crate::control::{
    CalibratedImage, CameraControls, Control, ControlChanges, ControlList, ControlRequest, EpisodeRequest,
    FollowRequest, GridStreams, LiveRig, RecordRequest, RecordingEpisodes, Shows,
};
use crate::doctor::{self, Surroundings};
use crate::losses::RecordingLosses;
use crate::recording::{self, Begun};
use crate::status::{RecordingStatus, RigStatus};
use crate::{Error, ErrorKind, Result};
use core::sync::atomic::Ordering;
use depthrig_bus::HostTime;
use depthrig_link::Reading;
use depthrig_recorder::Episode;
use depthrig_usb::SysRoot;
use std::path::PathBuf;

impl Control for Inner {
    fn status(&self) -> RigStatus {
        report::status(self)
    }

    fn session_clock(&self, at: HostTime) -> Option<Reading> {
        self.link.as_ref()?.at(at)
    }

    fn config_text(&self) -> String {
        self.config.text.clone()
    }

    fn recording_roots(&self) -> Vec<PathBuf> {
        let config = &self.config.recording;
        core::iter::once(&config.directory).chain(&config.allow).cloned().collect()
    }

    fn recordings(&self) -> Result<PathBuf> {
        Ok(std::path::absolute(&self.config.recording.directory)
            .unwrap_or_else(|_| self.config.recording.directory.clone()))
    }

    fn shows(&self) -> Option<&dyn Shows> {
        self.shows.as_deref()
    }

    fn doctor(&self) -> Result<doctor::Examined> {
        // Doctor would find that a rig of this name runs: it is the one that answers.
        let around = Surroundings { root: SysRoot::new("/"), runtime: None, measure_disk: false };
        let system = System::of_rig(&self.config, Some(self.runtime.clone()));
        // Its own socket has the address of the clock, and its threads the way to the other computers: `status` says how they do.
        let config = RigConfig { link: None, ..self.config.clone() };
        doctor::examine_all(&config, &around, &system)
    }

    fn calibration(&self) -> Vec<CalibratedImage> {
        let entries = self.config.cameras.iter().flat_map(|camera| &camera.calibration);
        entries.map(|c| CalibratedImage::of(&c.camera, &c.created)).collect()
    }

    fn controls(&self) -> Result<ControlList> {
        controls::list(self)
    }

    fn set_control(&self, request: &ControlRequest) -> Result<CameraControls> {
        controls::set(self, request)
    }

    fn revert_controls(&self, camera: &str) -> Result<CameraControls> {
        controls::revert(self, camera)
    }

    fn control_changes(&self) -> Result<ControlChanges> {
        controls::changes(self)
    }

    fn save_controls(&self, fingerprint: &str) -> Result<ControlChanges> {
        controls::save(self, fingerprint)
    }

    fn record_start(&self, request: &RecordRequest) -> Result<RecordingStatus> {
        let _one_at_a_time = lock(&self.starting);
        self.recording().must_be_idle()?;
        self.must_be_drawn()?;
        self.signals_must_come()?;
        let sets_hz = self.config.sets.rate_hz;
        // Without the recording's lock: making a file must not keep the set thread waiting.
        let signals = self.recording().signals();
        let streams = self.stream_facts();
        let begun = Begun::new(&self.config, request, streams, signals, sets_hz, &self.outside)?;
        let status = self.recording().begin(begun);
        if let Some(note) = controls::note(self)
            && let Err(e) = self.recording().note(&note)
        {
            tracing::warn!("the recording does not say which controls were changed: {e}");
        }
        if let Some(hosts) = &self.hosts {
            hosts.begin(&status, request);
        }
        Ok(status)
    }

    fn record_stop(&self) -> Result<RecordingStatus> {
        if let (Some(hosts), Some(active)) = (&self.hosts, self.recording().active_path()) {
            hosts.end(&active);
        }
        self.finish_held();
        let stopped = recording::stop(&self.recording);
        self.closing.store(false, Ordering::Relaxed);
        let status = stopped?;
        self.reports.begin(PathBuf::from(&status.path));
        if let Some(hosts) = &self.hosts {
            hosts.wait_ended();
        }
        Ok(status)
    }

    fn follow(&self, request: &FollowRequest) -> Result<GridStreams> {
        if !self.link.as_ref().is_some_and(|link| link.follow(request.key.as_ref())) {
            let what =
                "this rig follows the clock of no other computer ([link] with recorder in its rig file)";
            return Err(Error::new(ErrorKind::WrongState, what));
        }
        self.grid.set_phase_ns(request.phase_ns);
        Ok(GridStreams { streams: self.grid.own() })
    }

    fn record_note(&self, text: &str) -> Result<()> {
        self.recording().note(text)
    }

    fn episode(&self, request: &EpisodeRequest) -> Result<Episode> {
        self.recording().episode(request)
    }

    fn episodes(&self) -> Option<RecordingEpisodes> {
        self.recording().episodes()
    }

    fn record_losses(&self) -> Option<RecordingLosses> {
        self.recording().losses()
    }

    fn live(&self) -> Option<LiveRig> {
        let utc = (self.outside.utc)();
        Some(recording::live_rig(&self.config, self.stream_facts(), utc))
    }

    fn request_stop(&self) {
        self.stop_asked.store(true, Ordering::Relaxed);
        self.ended.raise();
    }
}
