//! A scripted rig.

use depthrig_daemon::control::{
    CalibratedImage, Control, EpisodeRequest, LossBucket, Losses, RecordRequest, RecordingEpisodes,
    RecordingLosses, ReplayControl, SeekRequest, UncertaintyOfImage,
};
use depthrig_daemon::status::{
    CameraState, CameraStatus, ClockStatus, HostRefineStatus, HostState, HostStatus, HostsStatus, JoinState,
    LinkState, LinkStatus, MirrorState, MirrorStatus, PartStatus, PreparingStatus, RecordingStatus,
    RefineState, RefineStatus, ReplayStatus, RigStatus, Ros2Status, SessionStatus, SetAccount, SetStatus,
    SharedMemoryStatus, SignalState, SignalStatus, StreamStatus,
};
use depthrig_daemon::{Error, ErrorKind, Result};
use depthrig_recorder::{Episode, EpisodeOutcome};
use std::sync::{Condvar, Mutex};
use std::time::Duration;

pub const CONFIG: &str = "rig = \"mount\" # \u{e4}\n";

fn refine() -> RefineStatus {
    let steps = || [("infer".to_owned(), 20.5)].into();
    RefineStatus {
        state: RefineState::Failed,
        state_for_s: 4.0,
        message: Some("no memory".into()),
        engine: "fill".into(),
        model: String::new(),
        nominal_hz: 5.0,
        rate_hz: 4.5,
        skipped: [("busy".to_owned(), 3)].into(),
        not_due: 77,
        restarts: 1,
        steps_p50_ms: steps(),
        steps_p99_ms: steps(),
    }
}

#[derive(Default)]
pub struct Fake {
    inner: Mutex<Inner>,
    called: Condvar,
}

#[derive(Default)]
struct Inner {
    all: Option<CameraState>,
    recording: Option<RecordingStatus>,
    request: Option<RecordRequest>,
    notes: Vec<String>,
    fail: Option<(ErrorKind, String)>,
    panic: bool,
    delay: Duration,
    calls: u32,
    stop: bool,
    roots: Vec<std::path::PathBuf>,
    /// Calls on the replay; `None` when this is a rig of cameras.
    replay: Option<Vec<String>>,
}

impl Fake {
    /// From now on this is a replay.
    pub fn become_replay(&self) {
        self.inner.lock().unwrap().replay = Some(Vec::new());
    }

    pub fn replay_calls(&self) -> Vec<String> {
        self.inner.lock().unwrap().replay.clone().unwrap_or_default()
    }

    fn note_call(&self, call: String) -> Result<ReplayStatus> {
        let mut inner = self.inner.lock().unwrap();
        if let Some((kind, message)) = inner.fail.take() {
            return Err(Error::new(kind, message));
        }
        let calls = inner.replay.as_mut().unwrap();
        calls.push(call);
        Ok(replay(calls))
    }

    /// Where recordings may go.
    pub fn set_roots(&self, roots: &[&std::path::Path]) {
        self.inner.lock().unwrap().roots = roots.iter().map(|r| r.to_path_buf()).collect();
    }

    pub fn set_all(&self, state: CameraState) {
        self.inner.lock().unwrap().all = Some(state);
    }

    pub fn fail_next(&self, kind: ErrorKind, message: &str) {
        self.inner.lock().unwrap().fail = Some((kind, message.to_owned()));
    }

    pub fn panic_next(&self) {
        self.inner.lock().unwrap().panic = true;
    }

    /// Makes `record_start` take this long.
    pub fn delay(&self, delay: Duration) {
        self.inner.lock().unwrap().delay = delay;
    }

    /// Waits until `record_start` has been called.
    pub fn wait_for_call(&self) {
        let inner = self.inner.lock().unwrap();
        let (inner, late) =
            self.called.wait_timeout_while(inner, Duration::from_secs(20), |i| i.calls == 0).unwrap();
        assert!(!late.timed_out() && inner.calls > 0, "the call never came");
    }

    pub fn last_request(&self) -> Option<RecordRequest> {
        self.inner.lock().unwrap().request.clone()
    }

    pub fn notes(&self) -> Vec<String> {
        self.inner.lock().unwrap().notes.clone()
    }

    pub fn stop_was_asked(&self) -> bool {
        self.inner.lock().unwrap().stop
    }

    pub fn current(&self) -> RigStatus {
        let inner = self.inner.lock().unwrap();
        let camera = |name: &str, state, message: Option<&str>| CameraStatus {
            name: name.into(),
            backend: "synthetic".into(),
            model: "D435".into(),
            serial: "s".into(),
            firmware: String::new(),
            port: String::new(),
            calibration: "simulated".into(),
            state: inner.all.unwrap_or(state),
            state_for_s: 1.5,
            message: message.map(str::to_owned),
            warnings: vec!["rows are 1.5 px apart".to_owned()],
            reconnects: 2,
            refine: (name == "d435").then(refine),
            mount: None,
            streams: vec![
                stream(&format!("{name}/depth"), Some(3.25)),
                stream(&format!("{name}/color"), None),
            ],
        };
        RigStatus {
            rig: "mount".into(),
            version: "0.1.0".into(),
            pid: 42,
            uptime_s: 12.5,
            utc_ns: 1_700_000_000_123_456_789,
            preparing: Some(PreparingStatus { images: 3, images_total: 12, share: 0.25, error: None }),
            signals: vec![SignalStatus {
                signal: "arm/joint_position".into(),
                required: true,
                state: SignalState::Silent,
                age_s: Some(1.5),
                samples: 3000,
                missed: 2,
            }],
            link: Some(LinkStatus {
                host: "left".into(),
                insecure: false,
                recorder: Some("10.0.0.1:7447".into()),
                state: LinkState::Live,
                offset_s: Some(1234.5),
                uncertainty_us: Some(27.0),
                rate_ppm: Some(-3.5),
                epoch: Some(1),
                round_trip_us: Some(180.0),
                age_s: Some(0.01),
                exchanges: 100,
                refused: 0,
            }),
            ros2: Some(Ros2Status { pid: None, why: Some("its process ended with exit code 1".into()) }),
            hosts: Some(HostsStatus {
                hosts: vec![HostStatus {
                    mirrors: vec![MirrorStatus {
                        stream: "wrist/color".into(),
                        state: MirrorState::Live,
                        why: None,
                        coding: Some("jpeg".into()),
                        rate_hz: 29.9,
                        frames: 900,
                        skipped: 3,
                    }],
                    refined: vec![HostRefineStatus { camera: "wrist".into(), refine: None }],
                    mirrored: vec![CameraStatus { name: "wrist".into(), ..CameraStatus::default() }],
                    host: "top".into(),
                    state: HostState::Refused,
                    why: Some("its rig is \"other\"".into()),
                    cameras: 3,
                    streaming: 2,
                    has_clock: true,
                    recording: Some("kitchen_top".into()),
                }],
                session: Some(SessionStatus {
                    name: "kitchen".into(),
                    parts: vec![PartStatus {
                        host: "top".into(),
                        name: "kitchen_top".into(),
                        bytes: 200,
                        pulled_bytes: 100,
                        is_complete: false,
                        why: None,
                    }],
                    joined: JoinState::Waiting,
                    dataset: None,
                    why: None,
                }),
            }),
            cameras: vec![
                camera("d435", CameraState::Streaming, None),
                camera("d405", CameraState::Reconnecting, Some("unplugged")),
            ],
            sets: SetStatus { nominal_hz: 5.0, sent: 7, spread_max_ms: 12.0, ..SetStatus::default() },
            recording: inner.recording.clone(),
            shared_memory: SharedMemoryStatus { free_bytes: 1 << 40, slots: 48, reserved_bytes: 1 << 30 },
            cpu_cores: 0.5,
            replay: inner.replay.as_ref().map(|calls| replay(calls)),
        }
    }
}

fn stream(id: &str, age: Option<f64>) -> StreamStatus {
    StreamStatus {
        id: id.into(),
        derived: false,
        format: "z16".into(),
        width: 1280,
        height: 720,
        nominal_hz: 30.0,
        rate_hz: 29.97,
        samples_hz: None,
        captured: 12,
        delivered: 10,
        dropped: [("no_slot".to_owned(), 2)].into(),
        last_frame_age_ms: age,
        latency_p50_ms: 3.0,
        latency_p99_ms: 4.0,
        clock: ClockStatus { domain: "device".into(), rate_ppm: -12.5, ..ClockStatus::default() },
        in_sets: SetAccount { used: 2, decimated: 7, pending: 1, ..SetAccount::default() },
    }
}

impl Control for Fake {
    fn recording_roots(&self) -> Vec<std::path::PathBuf> {
        self.inner.lock().unwrap().roots.clone()
    }

    fn status(&self) -> RigStatus {
        self.current()
    }

    fn config_text(&self) -> String {
        CONFIG.to_owned()
    }

    fn record_start(&self, request: &RecordRequest) -> Result<RecordingStatus> {
        let mut inner = self.inner.lock().unwrap();
        inner.calls += 1;
        self.called.notify_all();
        let delay = inner.delay;
        let panic = std::mem::take(&mut inner.panic);
        let fail = inner.fail.take();
        drop(inner);
        std::thread::sleep(delay);
        assert!(!panic, "as scripted");
        if let Some((kind, message)) = fail {
            return Err(Error::new(kind, message));
        }
        let mut inner = self.inner.lock().unwrap();
        if inner.recording.as_ref().is_some_and(|r| r.active) {
            return Err(Error::new(ErrorKind::InUse, "a recording goes on already"));
        }
        let status = RecordingStatus {
            active: true,
            scene: request.scene.clone(),
            dropped: [("backlog_full".to_owned(), 1)].into(),
            missing: [("front/color".to_owned(), 2)].into(),
            frames_dropped: [("no_slot".to_owned(), 2)].into(),
            ..RecordingStatus::default()
        };
        (inner.request, inner.recording) = (Some(request.clone()), Some(status.clone()));
        Ok(status)
    }

    fn record_stop(&self) -> Result<RecordingStatus> {
        let mut inner = self.inner.lock().unwrap();
        let running = inner.recording.as_mut().filter(|r| r.active);
        let recording = running.ok_or_else(|| Error::new(ErrorKind::WrongState, "no recording goes on"))?;
        (recording.active, recording.error) = (false, Some("1 set was lost".into()));
        Ok(recording.clone())
    }

    fn episode(&self, request: &EpisodeRequest) -> Result<Episode> {
        match request {
            EpisodeRequest::Start { task } => Ok(Episode {
                number: 1,
                task: task.clone(),
                start_utc_ns: 7,
                end_utc_ns: None,
                outcome: None,
                discarded: false,
                cut_start: false,
                cut_end: false,
            }),
            _ => Err(Error::new(ErrorKind::WrongState, "no episode is running")),
        }
    }

    fn episodes(&self) -> Option<RecordingEpisodes> {
        let path = self.inner.lock().unwrap().recording.as_ref()?.path.clone();
        let episode = Episode {
            number: 1,
            task: "cup".into(),
            start_utc_ns: 7,
            end_utc_ns: Some(9),
            outcome: Some(EpisodeOutcome::Failure),
            discarded: true,
            cut_start: false,
            cut_end: false,
        };
        Some(RecordingEpisodes { path, episodes: vec![episode] })
    }

    fn record_note(&self, text: &str) -> Result<()> {
        let mut inner = self.inner.lock().unwrap();
        if text.is_empty() {
            return Err(Error::new(ErrorKind::BadInput, "the note is empty"));
        }
        if !inner.recording.as_ref().is_some_and(|r| r.active) {
            return Err(Error::new(ErrorKind::WrongState, "no recording goes on"));
        }
        inner.notes.push(text.to_owned());
        Ok(())
    }

    fn calibration(&self) -> Vec<CalibratedImage> {
        let uncertainty = UncertaintyOfImage {
            distance_m: 0.8,
            pixel_mm: 1.3,
            columns: 2,
            sigma_px: vec![Some(0.2), None],
            middle_px: 0.2,
            worst_px: 0.2,
        };
        let image = |stream: &str, uncertainty| CalibratedImage {
            stream: stream.into(),
            created: "2026-11-25T03:00:00Z".into(),
            width: 640,
            height: 480,
            uncertainty,
        };
        vec![image("front/color", Some(uncertainty)), image("left/color", None)]
    }

    fn record_losses(&self) -> Option<RecordingLosses> {
        let recording = self.inner.lock().unwrap().recording.clone()?;
        let losses =
            Losses { sets: recording.dropped, missing: recording.missing, frames: recording.frames_dropped };
        let buckets = vec![LossBucket { from_s: 4.0, losses }];
        Some(RecordingLosses { path: recording.path, duration_s: 7.5, bucket_s: 2.0, buckets })
    }

    fn request_stop(&self) {
        self.inner.lock().unwrap().stop = true;
    }

    fn replay(&self) -> Option<&dyn ReplayControl> {
        self.inner.lock().unwrap().replay.is_some().then_some(self)
    }
}

impl ReplayControl for Fake {
    fn status(&self) -> ReplayStatus {
        replay(&self.replay_calls())
    }

    fn pause(&self) -> Result<ReplayStatus> {
        self.note_call("pause".into())
    }

    fn resume(&self) -> Result<ReplayStatus> {
        self.note_call("resume".into())
    }

    fn seek(&self, to: &SeekRequest) -> Result<ReplayStatus> {
        self.note_call(format!("{to:?}"))
    }

    fn step(&self, sets: i64) -> Result<ReplayStatus> {
        self.note_call(format!("step {sets}"))
    }

    fn set_rate(&self, rate: f64) -> Result<ReplayStatus> {
        self.note_call(format!("rate {rate}"))
    }

    fn set_loop(&self, on: bool) -> Result<ReplayStatus> {
        self.note_call(format!("loop {on}"))
    }
}

fn replay(calls: &[String]) -> ReplayStatus {
    ReplayStatus {
        datasets: vec!["/data/a".into()],
        position_s: 1.5,
        set: (!calls.is_empty()).then_some(7),
        lost: vec!["a set".into()],
        ..ReplayStatus::default()
    }
}
