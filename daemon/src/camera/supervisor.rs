//! A camera under supervision: opened, watched, lost, opened again. The other cameras do not notice.
//!
//! ```text
//! opening ──frame──▶ streaming ──no frame──▶ stalled ──still none──▶ reconnecting ──▶ (opened again)
//!    │                   │  ▲──────frame───────┘                          ▲
//!    └──────error────────┴──────────────────error, hang───────────────────┘
//! an error that cannot pass (wrong settings) ──▶ failed      end of the files ──▶ finished
//! ```
//!
//! "No frame" is said of each stream: one that is silent alone, while the others go on, has its camera stalled and
//! opened again all the same.

use super::open::{SharedBackend, open_session};
use super::{Camera, Shared};
use crate::priority;
use crate::status::CameraState;
use core::time::Duration;
use depthrig_bus::HostTime;
use depthrig_driver::ErrorKind as DriverErrorKind;
use depthrig_driver::capture::{Capture, End, StopOutcome};
use std::sync::Arc;

/// How long opening a device may take before its thread is given up for hung.
const OPEN_TIMEOUT: Duration = Duration::from_secs(15);
/// How long a recording may be silent that waits for its modes.
const WAITS_FOR_MODES: Duration = Duration::from_mins(1);
/// A supervisor that steps so late after its last step did not run meanwhile, and neither did the cameras' threads: the process
/// was stopped or the computer slept. Silence of that time says nothing of a device.
const STOPPED: Duration = Duration::from_secs(1);
/// A stalled camera is opened again after this many stall times without a frame.
const STALLS_UNTIL_RESTART: u32 = 4;

/// Drives one [`Camera`]; owned by the rig's supervisor thread.
pub struct Supervisor {
    camera: Arc<Camera>,
    shared: Arc<Shared>,
    backend: SharedBackend,
    capture: Option<Capture>,
    opened_at: HostTime,
    retry_at: HostTime,
    backoff: Duration,
    lost: bool,
    heard: Vec<Heard>,
    stepped_at: HostTime,
    /// Until then no silence counts.
    excused_until: HostTime,
}

/// When a stream last announced a frame, kept or lost.
#[derive(Debug, Clone, Copy)]
struct Heard {
    captured: u64,
    at: HostTime,
}

impl Supervisor {
    /// A supervisor that opens its camera at its first [`Self::step`].
    pub fn new(camera: Arc<Camera>, shared: Arc<Shared>) -> Self {
        let backoff = Duration::from_secs_f64(shared.supervisor.backoff_min_s);
        Self {
            camera,
            shared,
            backend: SharedBackend::default(),
            capture: None,
            opened_at: HostTime::from_ns(0),
            retry_at: HostTime::from_ns(0),
            backoff,
            lost: false,
            heard: Vec::new(),
            stepped_at: HostTime::from_ns(i64::MAX),
            excused_until: HostTime::from_ns(0),
        }
    }

    /// Looks at the camera and takes the steps that are due. Never blocks on the device.
    pub fn step(&mut self, now: HostTime) {
        let name = self.camera.config.name.clone();
        // Noted at every step, also while the camera is away, which is no sign of a supervisor that did not run.
        let was_stopped = now.since_ns(self.stepped_at) > STOPPED.as_nanos() as i64;
        self.stepped_at = now;
        let Some(capture) = &self.capture else {
            let waiting =
                matches!(self.camera.state().phase, CameraState::Opening | CameraState::Reconnecting);
            if waiting && now >= self.retry_at {
                self.open(now);
            }
            return;
        };
        if capture.has_ended() {
            if let Some(StopOutcome::Ended(end)) = self.capture.take().map(|c| c.stop(Duration::ZERO)) {
                self.ended(now, end);
            }
            return;
        }
        let stall = self.stall_time();
        if was_stopped {
            self.excused_until = now.plus(stall);
        }
        if now < self.excused_until {
            return;
        }
        let heartbeat_age = Duration::from_nanos(now.since_ns(capture.heartbeat()).max(0) as u64);
        let Some(last_frame) = capture.last_frame().filter(|t| *t >= self.opened_at) else {
            // Not a frame yet: opening, or open and silent.
            let open = !self.camera.state().streams.is_empty();
            let silence = Duration::from_nanos(now.since_ns(self.opened_at).max(0) as u64);
            if heartbeat_age > OPEN_TIMEOUT + self.camera.config.backend.extra_open_time() {
                self.give_up(now, "the device did not come back from being opened");
            } else if open && silence > stall * STALLS_UNTIL_RESTART && heartbeat_age < stall {
                self.restart(now, &format!("open, but not one frame in {:.1} s", silence.as_secs_f64()));
            }
            return;
        };
        let silence = Duration::from_nanos(now.since_ns(last_frame).max(0) as u64);
        if heartbeat_age > stall * 2 {
            let hang = heartbeat_age.as_secs_f64();
            self.give_up(now, &format!("the driver hangs in the device for {hang:.1} s"));
        } else if silence > stall * STALLS_UNTIL_RESTART {
            self.restart(
                now,
                &format!("no frame for {:.1} s, the device is opened again", silence.as_secs_f64()),
            );
        } else if silence > stall {
            let mut state = self.camera.state();
            if state.phase != CameraState::Stalled {
                let why = format!("no frame for {:.1} s although the device answers", stall.as_secs_f64());
                state.enter(name.as_str(), CameraState::Stalled, Some(why));
            }
        } else if let Some((stream, silence)) = self.mute_stream(now).filter(|(_, silence)| *silence > stall)
        {
            let why =
                format!("no frame of {stream} for {:.1} s while other streams go on", silence.as_secs_f64());
            if silence > stall * STALLS_UNTIL_RESTART {
                self.restart(now, &format!("{why}, the device is opened again"));
            } else if self.camera.state().phase != CameraState::Stalled {
                self.camera.state().enter(name.as_str(), CameraState::Stalled, Some(why));
            }
        } else {
            let mut state = self.camera.state();
            if state.phase != CameraState::Streaming {
                if self.lost {
                    state.reconnects += 1;
                    self.lost = false;
                }
                state.enter(name.as_str(), CameraState::Streaming, None);
            }
            self.backoff = Duration::from_secs_f64(self.shared.supervisor.backoff_min_s);
        }
    }

    /// Asks the camera thread to end, without waiting.
    pub fn request_stop(&self) {
        if let Some(capture) = &self.capture {
            capture.request_stop();
        }
    }

    /// Ends the camera thread, waiting for at most `timeout`.
    pub fn stop(&mut self, timeout: Duration) {
        let name = self.camera.config.name.clone();
        if self.end_capture(timeout) {
            tracing::warn!(camera = %name, "the device hangs; its thread is left behind");
        }
        let mut state = self.camera.state();
        if !matches!(state.phase, CameraState::Failed | CameraState::Finished) {
            state.enter(name.as_str(), CameraState::Stopped, None);
        }
    }

    /// The stream that has announced no frame for the longest, and for how long.
    fn mute_stream(&mut self, now: HostTime) -> Option<(String, Duration)> {
        let state = self.camera.state();
        let unheard = Heard { captured: u64::MAX, at: now };
        self.heard.resize(state.streams.len(), unheard);
        let mut longest = None;
        for (stream, heard) in state.streams.iter().zip(&mut self.heard) {
            // How long matching takes says nothing of the device. An IMU that is silent alone is reported in the
            // status: to open the camera again would cost its images, which matter more.
            if self.camera.config.joins_late(&stream.id.stream) || stream.profile.format.is_motion() {
                continue;
            }
            let captured = stream.books().captured;
            // A camera that was opened again starts with all its time.
            if heard.captured != captured || heard.at < self.opened_at {
                *heard = Heard { captured, at: now };
            }
            let silence = Duration::from_nanos(now.since_ns(heard.at).max(0) as u64);
            if longest.as_ref().is_none_or(|(_, most)| silence > *most) {
                longest = Some((stream.id.stream.to_string(), silence));
            }
        }
        longest
    }

    fn stall_time(&self) -> Duration {
        // A recording that waits for its slowest mode is silent for as long as that takes.
        if self.camera.config.stereo.as_ref().is_some_and(|s| s.every_pair) {
            return WAITS_FOR_MODES;
        }
        let state = self.camera.state();
        let images = state.streams.iter().filter(|s| !s.profile.format.is_motion());
        let slowest = images.map(|s| s.profile.period_ns()).max().unwrap_or(0);
        Duration::from_secs_f64(self.shared.supervisor.stall_s).max(Duration::from_nanos(3 * slowest))
    }

    fn ended(&mut self, now: HostTime, end: End) {
        let name = self.camera.config.name.as_str();
        match end {
            End::Failed(e) if e.kind().is_transient() && !self.never_will(&e) => {
                self.lose(now, &e.to_string(), Some(e));
            }
            End::Failed(e) => {
                let mut state = self.camera.state();
                state.enter(name, CameraState::Failed, Some(e.to_string()));
                state.error = Some(e.into());
            }
            End::Finished => {
                self.camera.state().enter(
                    name,
                    CameraState::Finished,
                    Some("the files are at their end".into()),
                );
            }
            End::Stopped => self.camera.state().enter(name, CameraState::Stopped, None),
        }
    }

    /// Whether an opening failed for good: files that are not there are a mistake, not an unplugged camera.
    fn never_will(&self, e: &depthrig_driver::Error) -> bool {
        e.kind() == DriverErrorKind::NotFound
            && self.camera.config.backend.reads_files()
            && self.camera.state().streams.is_empty()
    }

    /// The camera is lost; it is tried again after a pause.
    fn lose(&mut self, now: HostTime, why: &str, error: Option<depthrig_driver::Error>) {
        let mut state = self.camera.state();
        // Once it was open it counts, even if it was lost before it was seen to stream.
        self.lost |= !state.streams.is_empty();
        state.enter(self.camera.config.name.as_str(), CameraState::Reconnecting, Some(why.to_owned()));
        state.error = error.map(Into::into);
        drop(state);
        self.retry_at = now.plus(self.backoff);
        self.backoff = (self.backoff * 2).min(Duration::from_secs_f64(self.shared.supervisor.backoff_max_s));
    }

    /// Ends a thread that still answers, then opens the device again.
    fn restart(&mut self, now: HostTime, why: &str) {
        self.end_capture(Duration::from_millis(200));
        self.lose(now, why, None);
    }

    /// Leaves a hung thread behind.
    fn give_up(&mut self, now: HostTime, why: &str) {
        self.end_capture(Duration::ZERO);
        self.lose(now, why, None);
    }

    /// Ends the camera thread if there is one; whether it had to be left behind.
    fn end_capture(&mut self, timeout: Duration) -> bool {
        let abandoned =
            self.capture.take().is_some_and(|c| matches!(c.stop(timeout), StopOutcome::Abandoned));
        if abandoned {
            for stream in &self.camera.state().streams {
                stream.books().close();
            }
        }
        abandoned
    }

    fn open(&mut self, now: HostTime) {
        self.opened_at = now;
        let camera = Arc::clone(&self.camera);
        let shared = Arc::clone(&self.shared);
        let backend = Arc::clone(&self.backend);
        let opening = Capture::spawn(self.camera.config.name.as_str(), move || {
            // Ordinary until it streams: opening is work, and must not keep other cameras' threads from theirs.
            let session = open_session(&camera, &shared, &backend)?;
            if shared.supervisor.raise_priority {
                priority::raise_current_thread();
            }
            Ok(session)
        });
        match opening {
            Ok(capture) => self.capture = Some(capture),
            Err(e) => self.lose(now, &e.to_string(), Some(e)),
        }
    }
}
