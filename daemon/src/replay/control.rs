//! A replay as the control API sees it: a rig whose cameras are datasets.

use super::{Inner, lock};
use crate::control::{
    Control, EpisodeRequest, LiveRig, RecordRequest, RecordingEpisodes, ReplayControl, SeekRequest,
};
use crate::losses::RecordingLosses;
use crate::recording::{self, Begun, StreamFacts};
use crate::status::{
    CameraState, CameraStatus, RecordingStatus, ReplayStatus, RigStatus, SetAccount, SetStatus,
    SharedMemoryStatus,
};
use crate::{Error, ErrorKind, Result};
use core::time::Duration;
use depthrig_bus::{HostTime, Pose, UtcPair, shm};
use depthrig_recorder::{Episode, PixelMode};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::Ordering;

/// How long a command waits for its set to be published; it will be, later.
const TIMEOUT: Duration = Duration::from_secs(3);

impl Inner {
    /// How far the replay has come.
    pub(super) fn replay_status(&self) -> ReplayStatus {
        let t = lock(&self.transport);
        let paused = t.is_paused();
        let rate = t.rate();
        let looped = t.is_looped();
        let rounds = t.rounds();
        drop(t);
        let n = lock(&self.numbers);
        let seconds = |ns: i64| ns as f64 / 1e9;
        let frames = self.streams.iter().map(|s| s.books().delivered).sum();
        ReplayStatus {
            datasets: self.paths.iter().map(|p| p.display().to_string()).collect(),
            paused,
            done: self.done.load(Ordering::Acquire),
            position_s: n.last.map_or(0.0, |(moment, _)| seconds(self.timeline.times()[moment])),
            length_s: seconds(self.timeline.length_ns()),
            set: n.last.map(|(moment, _)| moment as u64),
            set_id: n.last.map(|(_, id)| id),
            length_sets: self.timeline.len() as u64,
            rate,
            as_fast_as_possible: self.lossless(),
            looped,
            rounds,
            sets: n.sets,
            frames,
            waiting_for: n.waiting_for.clone(),
            lost: n.lost.clone(),
        }
    }

    /// Waits until the effect of a command was published.
    fn settle(&self) -> ReplayStatus {
        self.wake.raise();
        let transport = lock(&self.transport);
        let waited = self
            .acted
            .wait_timeout_while(transport, TIMEOUT, |t| t.is_showing() && !self.stopping())
            .unwrap_or_else(std::sync::PoisonError::into_inner);
        drop(waited);
        self.replay_status()
    }

    /// Refuses commands that would make the time of a recording go backwards.
    fn must_not_be_recorded(&self, what: &str) -> Result<()> {
        if lock(&self.recording).is_active() {
            return Err(Error::new(
                ErrorKind::WrongState,
                format!(
                    "this replay is being recorded, and {what} would make the recording's time go backwards; \
                         stop the recording first (depthrig record stop)"
                ),
            ));
        }
        Ok(())
    }

    fn moment_of(&self, to: &SeekRequest) -> Result<usize> {
        let bad = |what: String| Error::new(ErrorKind::BadInput, what);
        let last = self.timeline.len().saturating_sub(1);
        match *to {
            SeekRequest { seconds: Some(s), set: None, id: None } => {
                let length = self.timeline.length_ns() as f64 / 1e9;
                let usable = s.is_finite() && s >= 0.0;
                let moment = usable.then(|| self.timeline.at_or_after((s * 1e9).round() as i64)).flatten();
                moment.ok_or_else(|| bad(format!("there is no set at {s} s; the replay has 0 to {length} s")))
            }
            SeekRequest { seconds: None, set: Some(n), id: None } => {
                let moment = usize::try_from(n).ok().filter(|n| *n <= last);
                moment.ok_or_else(|| bad(format!("there is no set number {n}; the replay has 0 to {last}")))
            }
            SeekRequest { seconds: None, set: None, id: Some(id) } => {
                let number = lock(&self.sources).number_of(id)?;
                let outside = || bad(format!("the set with the id {id} is outside of --from and --to"));
                self.timeline.moment_of(number).ok_or_else(outside)
            }
            _ => Err(bad("say where to: seconds, set or id, one of them".into())),
        }
    }

    fn cameras(&self) -> Vec<CameraStatus> {
        let now = HostTime::now();
        let replay = self.replay_status();
        let mut cameras: Vec<CameraStatus> = Vec::new();
        let images = self.records.iter().map(|r| (&r.id, &r.model, &r.serial, &r.calibration));
        let units = self.units.iter().map(|r| (&r.id, &r.model, &r.serial, &r.calibration));
        let streams = self.streams.iter().chain(&self.unit_streams);
        for ((id, model, serial, calibration), stream) in images.chain(units).zip(streams) {
            let name = id.camera.to_string();
            let used = stream.books().delivered;
            let status = stream.status(SetAccount { used, ..SetAccount::default() }, now);
            if let Some(camera) = cameras.iter_mut().find(|c| c.name == name) {
                camera.streams.push(status);
                continue;
            }
            cameras.push(CameraStatus {
                name,
                backend: "replay".to_owned(),
                model: model.clone(),
                serial: serial.clone(),
                firmware: String::new(),
                port: String::new(),
                calibration: calibration.clone(),
                state: if replay.done { CameraState::Finished } else { CameraState::Streaming },
                state_for_s: self.started.elapsed().as_secs_f64(),
                message: replay.paused.then(|| format!("paused at {:.3} s", replay.position_s)),
                warnings: Vec::new(),
                reconnects: 0,
                streams: vec![status],
                refine: None,
                mount: None,
            });
        }
        for refinement in lock(&self.refinements).iter() {
            let name = refinement.camera.to_string();
            let Some(camera) = cameras.iter_mut().find(|c| c.name == name) else { continue };
            camera.refine = Some(refinement.status());
            let status = |s: &Arc<crate::stream::Stream>| s.status(SetAccount::default(), now);
            camera.streams.extend(refinement.streams().map(status));
        }
        cameras
    }

    /// Sets a second of the original.
    fn nominal_hz(&self) -> f64 {
        let gaps = self.timeline.len().saturating_sub(1) as f64;
        let length_s = self.timeline.length_ns() as f64 / 1e9;
        if length_s > 0.0 { gaps / length_s } else { 0.0 }
    }

    fn stream_facts(&self) -> Vec<StreamFacts> {
        let facts =
            |(record, stream): (&depthrig_recorder::StreamRecord, &Arc<crate::stream::Stream>)| StreamFacts {
                stream: Arc::clone(stream),
                model: record.model.clone(),
                serial: record.serial.clone(),
                firmware: String::new(),
                calibration: record.calibration.clone(),
                camera_pose: Pose::IDENTITY,
                computed: self.computed.iter().find(|c| c.stream == record.id).cloned(),
            };
        let unit =
            |(record, stream): (&depthrig_recorder::MotionRecord, &Arc<crate::stream::Stream>)| StreamFacts {
                stream: Arc::clone(stream),
                model: record.model.clone(),
                serial: record.serial.clone(),
                firmware: String::new(),
                calibration: record.calibration.clone(),
                camera_pose: Pose::IDENTITY,
                computed: None,
            };
        let units = self.units.iter().zip(&self.unit_streams).map(unit);
        self.records.iter().zip(&self.streams).map(facts).chain(units).collect()
    }
}

impl Control for Inner {
    fn status(&self) -> RigStatus {
        let spreads = lock(&self.spreads).clone();
        let (sent, incomplete) = {
            let n = lock(&self.numbers);
            (n.sets, n.incomplete)
        };
        let ms = |quantile: f64| spreads.quantile_ns(quantile) as f64 / 1e6;
        let slots = self.slots();
        let recording = lock(&self.recording).status();
        RigStatus {
            rig: self.config.rig.to_string(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            pid: std::process::id(),
            uptime_s: self.started.elapsed().as_secs_f64(),
            utc_ns: UtcPair::sample().utc_ns,
            preparing: None,
            cameras: self.cameras(),
            sets: SetStatus {
                nominal_hz: self.nominal_hz(),
                sent,
                incomplete,
                spread_p50_ms: ms(0.5),
                spread_p95_ms: ms(0.95),
                spread_p99_ms: ms(0.99),
                spread_max_ms: spreads.max_ns() as f64 / 1e6,
                skews: Vec::new(),
            },
            recording,
            shared_memory: SharedMemoryStatus {
                free_bytes: shm::free_bytes(shm::SHM_DIR.as_ref()).unwrap_or(0),
                slots,
                reserved_bytes: self
                    .streams
                    .iter()
                    .chain(&self.unit_streams)
                    .map(|s| (slots * s.profile.frame_bytes()) as u64)
                    .sum(),
            },
            cpu_cores: self.cpu_millicores.load(Ordering::Relaxed) as f64 / 1000.0,
            signals: Vec::new(),
            link: None,
            hosts: None,
            ros2: None,
            replay: Some(self.replay_status()),
        }
    }

    fn config_text(&self) -> String {
        self.config.text.clone()
    }

    fn record_start(&self, request: &RecordRequest) -> Result<RecordingStatus> {
        let _one_at_a_time = lock(&self.starting);
        lock(&self.recording).must_be_idle()?;
        if lock(&self.transport).is_looped() {
            return Err(Error::new(
                ErrorKind::WrongState,
                "this replay begins again at its end, and a recording's time cannot go backwards; end the loop first \
                 (depthrig replay loop off)",
            ));
        }
        let next = lock(&self.transport).next().min(self.timeline.len() - 1);
        let mut sources = lock(&self.sources);
        let tick = sources.read(&self.timeline, next, PixelMode::None).tick;
        let pair = UtcPair { mono: tick, utc_ns: sources.utc_ns(tick), width_ns: 0 };
        let mut request = request.clone();
        let session = sources.session();
        for (field, original) in
            [(&mut request.scene, &session.scene), (&mut request.operator, &session.operator)]
        {
            if field.is_empty() {
                field.clone_from(original);
            }
        }
        let signals = sources.signals().to_vec();
        drop(sources);
        *lock(&self.clock) = pair;
        // As fast as possible is as fast as the disk takes it; then a second of the original takes this much.
        let sets_hz = self.nominal_hz() * lock(&self.transport).rate();
        let streams = self.stream_facts();
        let begun = Begun::new(&self.config, &request, streams, signals, sets_hz, &self.outside)?;
        Ok(lock(&self.recording).begin(begun))
    }

    fn record_stop(&self) -> Result<RecordingStatus> {
        let status = recording::stop(&self.recording)?;
        self.reports.begin(PathBuf::from(&status.path));
        Ok(status)
    }

    fn record_note(&self, text: &str) -> Result<()> {
        lock(&self.recording).note(text)
    }

    fn episode(&self, request: &EpisodeRequest) -> Result<Episode> {
        lock(&self.recording).episode(request)
    }

    fn episodes(&self) -> Option<RecordingEpisodes> {
        lock(&self.recording).episodes()
    }

    fn record_losses(&self) -> Option<RecordingLosses> {
        lock(&self.recording).losses()
    }

    fn live(&self) -> Option<LiveRig> {
        let sources = lock(&self.sources);
        let started = sources.session().started_utc_ns;
        let offset = sources.utc_ns(HostTime::from_ns(0));
        drop(sources);
        let utc = UtcPair { mono: HostTime::from_ns(started - offset), utc_ns: started, width_ns: 0 };
        Some(recording::live_rig(&self.config, self.stream_facts(), utc))
    }

    fn request_stop(&self) {
        self.stop_asked.store(true, Ordering::Relaxed);
        self.ended.raise();
    }

    fn replay(&self) -> Option<&dyn ReplayControl> {
        Some(self)
    }
}

impl ReplayControl for Inner {
    fn status(&self) -> ReplayStatus {
        self.replay_status()
    }

    fn pause(&self) -> Result<ReplayStatus> {
        lock(&self.transport).pause(HostTime::now());
        Ok(self.settle())
    }

    fn resume(&self) -> Result<ReplayStatus> {
        lock(&self.transport).resume(HostTime::now())?;
        Ok(self.settle())
    }

    fn seek(&self, to: &SeekRequest) -> Result<ReplayStatus> {
        let moment = self.moment_of(to)?;
        let mut transport = lock(&self.transport);
        if moment < transport.next() {
            self.must_not_be_recorded("seeking back")?;
        }
        transport.seek(moment);
        drop(transport);
        Ok(self.settle())
    }

    fn step(&self, sets: i64) -> Result<ReplayStatus> {
        if sets < 0 {
            self.must_not_be_recorded("stepping back")?;
        }
        lock(&self.transport).step(sets)?;
        Ok(self.settle())
    }

    fn set_rate(&self, rate: f64) -> Result<ReplayStatus> {
        lock(&self.transport).set_rate(rate, HostTime::now())?;
        Ok(self.settle())
    }

    fn set_loop(&self, on: bool) -> Result<ReplayStatus> {
        // A recording that is being started has looked at the loop, and is not there to be seen yet.
        let one_at_a_time = lock(&self.starting);
        if on {
            self.must_not_be_recorded("beginning again")?;
        }
        lock(&self.transport).set_loop(on);
        drop(one_at_a_time);
        Ok(self.settle())
    }
}
