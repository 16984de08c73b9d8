//! The client of the control API, with which the command line talks to a running daemon.
//!
//! Calls block. Each one is a connection of its own, so a client may be kept for hours over restarts of the daemon.

mod http;
#[cfg(test)]
mod tests;

use crate::api::{
    self, BytesRequest, FileDigest, FileRequest, LoopRequest, NoteRequest, PageAddress, RateRequest,
    RecordingFiles, StepRequest,
};
use crate::control::{EpisodeRequest, FollowRequest, GridStreams, RecordRequest, SeekRequest};
use crate::status::{RecordingStatus, ReplayStatus, RigStatus};
use crate::{Error, ErrorKind, Result};
use core::time::Duration;
use depthrig_bus::{Name, RigName, RuntimeDir};
use depthrig_recorder::Episode;
use http::{Answer, Connector, Failure};
use serde::Serialize;
use serde::de::DeserializeOwned;

/// How long a call may take.
const TIMEOUT: Duration = Duration::from_secs(10);
/// How long closing a recording may take: the disk decides.
const STOP_TIMEOUT: Duration = Duration::from_mins(10);

/// Timeout of a call to another computer.
const HOST_TIMEOUT: Duration = Duration::from_secs(2);

/// A client of one rig's daemon. Not for use inside an async runtime: its calls block.
#[derive(Debug)]
pub struct Client {
    rig: RigName,
    runtime: RuntimeDir,
    /// The other computer whose daemon it is.
    host: Option<Name>,
    connector: Connector,
}

impl Client {
    /// A client of `rig`, or of the only rig that runs.
    ///
    /// # Errors
    /// `Unreachable` when no such rig runs or its daemon does not answer, `BadInput` when `rig` is `None` and
    /// several run (naming them), `PermissionDenied`.
    pub fn connect(runtime: &RuntimeDir, rig: Option<&RigName>) -> Result<Self> {
        let running = runtime.running_rigs();
        let names = || running.iter().map(RigName::as_str).collect::<Vec<_>>().join(", ");
        let folder = runtime.path().display();
        let rig = match (rig, running.as_slice()) {
            (Some(rig), _) if running.contains(rig) => rig.clone(),
            (None, [only]) => only.clone(),
            (None, []) => {
                let what = format!("no rig runs (none in {folder}); start one: depthrig run RIG.toml");
                return Err(Error::new(ErrorKind::Unreachable, what));
            }
            (None, _) => {
                let what = format!("several rigs run: {}; say which one (--rig NAME)", names());
                return Err(Error::new(ErrorKind::BadInput, what));
            }
            (Some(rig), []) => {
                let what = format!(
                    "rig \"{rig}\" does not run, nor does any other (none in {folder}); start it: depthrig run RIG.toml"
                );
                return Err(Error::new(ErrorKind::Unreachable, what));
            }
            (Some(rig), _) => {
                let what = format!("rig \"{rig}\" does not run; these do: {}", names());
                return Err(Error::new(ErrorKind::Unreachable, what));
            }
        };
        let connector = Connector::new(runtime.socket_path(&rig))?;
        let client = Self { rig, runtime: runtime.clone(), host: None, connector };
        // A daemon that does not answer is better said now than in the middle of something.
        client.send("GET", "/v1/config", None, client.timeout())?;
        Ok(client)
    }

    /// A client of the daemon of `rig` on another computer, through a socket that the daemon of this one keeps
    /// ([`crate::hosts`]), whether anything answers there now or not.
    ///
    /// # Errors
    /// `Other` when no client can be made.
    pub fn of_host(runtime: &RuntimeDir, rig: &RigName, host: &Name) -> Result<Self> {
        let connector = Connector::new(runtime.host_socket_path(rig, host))?;
        Ok(Self { rig: rig.clone(), runtime: runtime.clone(), host: Some(host.clone()), connector })
    }

    /// Timeout of a call that is answered at once.
    const fn timeout(&self) -> Duration {
        if self.host.is_some() { HOST_TIMEOUT } else { TIMEOUT }
    }

    /// The rig that this client speaks to.
    pub const fn rig(&self) -> &RigName {
        &self.rig
    }

    /// Everything there is to know about the rig now.
    ///
    /// # Errors
    /// `Unreachable` when the daemon has gone, and errors that the daemon returns.
    pub fn status(&self) -> Result<RigStatus> {
        self.get("/v1/status")
    }

    /// The rig's configuration as TOML text.
    ///
    /// # Errors
    /// As [`Self::status`].
    pub fn config(&self) -> Result<String> {
        let answer = self.send("GET", "/v1/config", None, self.timeout())?;
        String::from_utf8(answer.body).map_err(|e| self.garbled("/v1/config", &e).with_source(e))
    }

    /// Where the live page is.
    ///
    /// # Errors
    /// As [`Self::status`].
    pub fn page(&self) -> Result<PageAddress> {
        self.get("/v1/page")
    }

    /// Starts a recording. A relative folder in `request` is the daemon's, so callers make it absolute.
    ///
    /// # Errors
    /// As [`Self::status`] and [`crate::control::Control::record_start`].
    pub fn record_start(&self, request: &RecordRequest) -> Result<RecordingStatus> {
        self.post("/v1/record/start", request, TIMEOUT)
    }

    /// Ends the recording; returns when its files are closed.
    ///
    /// # Errors
    /// As [`Self::status`] and [`crate::control::Control::record_stop`].
    pub fn record_stop(&self) -> Result<RecordingStatus> {
        self.post("/v1/record/stop", &serde_json::Map::new(), STOP_TIMEOUT)
    }

    /// The recording in progress, or the last one.
    ///
    /// # Errors
    /// As [`Self::status`].
    pub fn record_status(&self) -> Result<Option<RecordingStatus>> {
        self.get("/v1/record")
    }

    /// Gives the key and the ticks of the session, and returns the streams that the ticks are chosen for.
    ///
    /// # Errors
    /// As [`Self::status`] and [`crate::control::Control::follow`].
    pub fn follow(&self, request: &FollowRequest) -> Result<GridStreams> {
        self.post("/v1/session/follow", request, self.timeout())
    }

    /// Adds a timed note to the recording.
    ///
    /// # Errors
    /// As [`Self::status`] and [`crate::control::Control::record_note`].
    pub fn record_note(&self, text: &str) -> Result<()> {
        let body = self.encode(&NoteRequest { text: text.to_owned() })?;
        self.send("POST", "/v1/record/note", Some(body), self.timeout()).map(drop)
    }

    /// Begins, ends or judges an episode.
    ///
    /// # Errors
    /// As [`Self::status`] and [`crate::control::Control::episode`].
    pub fn episode(&self, request: &EpisodeRequest) -> Result<Episode> {
        self.post("/v1/episode", request, self.timeout())
    }

    /// How far the replay has come.
    ///
    /// # Errors
    /// As [`Self::status`], `WrongState` when the rig is not a replay.
    pub fn replay(&self) -> Result<ReplayStatus> {
        self.get("/v1/replay")
    }

    /// Stops the replay where it is.
    ///
    /// # Errors
    /// As [`Self::replay`] and [`crate::control::ReplayControl::pause`].
    pub fn replay_pause(&self) -> Result<ReplayStatus> {
        self.post("/v1/replay/pause", &serde_json::Map::new(), self.timeout())
    }

    /// Plays on.
    ///
    /// # Errors
    /// As [`Self::replay`] and [`crate::control::ReplayControl::resume`].
    pub fn replay_resume(&self) -> Result<ReplayStatus> {
        self.post("/v1/replay/resume", &serde_json::Map::new(), self.timeout())
    }

    /// Goes to a set and publishes it.
    ///
    /// # Errors
    /// As [`Self::replay`] and [`crate::control::ReplayControl::seek`].
    pub fn replay_seek(&self, to: &SeekRequest) -> Result<ReplayStatus> {
        self.post("/v1/replay/seek", to, self.timeout())
    }

    /// Plays so many sets and pauses; a negative number goes back.
    ///
    /// # Errors
    /// As [`Self::replay`] and [`crate::control::ReplayControl::step`].
    pub fn replay_step(&self, sets: i64) -> Result<ReplayStatus> {
        self.post("/v1/replay/step", &StepRequest { sets }, self.timeout())
    }

    /// Changes the speed of the replay.
    ///
    /// # Errors
    /// As [`Self::replay`] and [`crate::control::ReplayControl::set_rate`].
    pub fn replay_rate(&self, rate: f64) -> Result<ReplayStatus> {
        self.post("/v1/replay/rate", &RateRequest { rate }, self.timeout())
    }

    /// Whether the replay begins again at its end.
    ///
    /// # Errors
    /// As [`Self::replay`] and [`crate::control::ReplayControl::set_loop`].
    pub fn replay_loop(&self, on: bool) -> Result<ReplayStatus> {
        self.post("/v1/replay/loop", &LoopRequest { on }, self.timeout())
    }

    /// Passes an event of a calibration on to those who follow.
    ///
    /// # Errors
    /// As [`Self::status`], and `NotFound` of a daemon that knows no such events.
    pub fn calibration_event(&self, event: &api::CaptureEvent) -> Result<()> {
        self.send("POST", "/v1/calibration/events", Some(self.encode(event)?), self.timeout()).map(drop)
    }

    /// The files of a recording.
    ///
    /// # Errors
    /// As [`Self::status`], `NotFound`.
    pub fn recording_files(&self, name: &str) -> Result<RecordingFiles> {
        self.post("/v1/recordings/files", &api::NameRequest { name: name.to_owned() }, self.timeout())
    }

    /// Bytes of a file of a recording; fewer than asked for at its end.
    ///
    /// # Errors
    /// As [`Self::recording_files`].
    pub fn recording_bytes(&self, part: &BytesRequest) -> Result<Vec<u8>> {
        let body = self.encode(part)?;
        Ok(self.send("POST", "/v1/recordings/bytes", Some(body), self.timeout())?.body)
    }

    /// Length and checksum of a file of a recording.
    ///
    /// # Errors
    /// As [`Self::recording_files`].
    pub fn recording_digest(&self, file: &FileRequest) -> Result<FileDigest> {
        self.post("/v1/recordings/digest", file, STOP_TIMEOUT)
    }

    /// Asks the daemon to end; it closes a recording before it does.
    ///
    /// # Errors
    /// As [`Self::status`].
    pub fn stop(&self) -> Result<()> {
        self.send("POST", "/v1/stop", Some(b"{}".to_vec()), self.timeout()).map(drop)
    }

    fn get<T: DeserializeOwned>(&self, path: &str) -> Result<T> {
        let answer = self.send("GET", path, None, self.timeout())?;
        serde_json::from_slice(&answer.body).map_err(|e| self.garbled(path, &e).with_source(e))
    }

    fn post<T: DeserializeOwned>(&self, path: &str, body: &impl Serialize, timeout: Duration) -> Result<T> {
        let answer = self.send("POST", path, Some(self.encode(body)?), timeout)?;
        serde_json::from_slice(&answer.body).map_err(|e| self.garbled(path, &e).with_source(e))
    }

    fn encode(&self, body: &impl Serialize) -> Result<Vec<u8>> {
        serde_json::to_vec(body).map_err(|e| self.garbled("the request", &e).with_source(e))
    }

    fn send(&self, method: &str, path: &str, body: Option<Vec<u8>>, timeout: Duration) -> Result<Answer> {
        let answer = self.connector.send(method, path, body, timeout).map_err(|f| self.unreachable(f))?;
        self.check_version(&answer)?;
        if (200..300).contains(&answer.status) {
            return Ok(answer);
        }
        Err(match serde_json::from_slice::<api::ErrorBody>(&answer.body) {
            Ok(body) => Error::new(api::kind_of_name(&body.error.kind), body.error.message),
            Err(e) => self.garbled(path, &format!("status {}", answer.status)).with_source(e),
        })
    }

    /// Refuses a daemon whose API may differ: another major version, or another minor one before 1.0.
    fn check_version(&self, answer: &Answer) -> Result<()> {
        let ours = env!("CARGO_PKG_VERSION");
        let theirs = answer.server.strip_prefix("depthrig/").unwrap_or("?");
        if compatible(ours, theirs) {
            return Ok(());
        }
        let rig = &self.rig;
        let what = format!(
            "the daemon of rig \"{rig}\" is of version {theirs}, this program of {ours}, and they do not understand each \
             other; restart the daemon with this version, or use the program of that one"
        );
        Err(Error::new(ErrorKind::Other, what))
    }

    fn garbled(&self, what: &str, why: &dyn core::fmt::Display) -> Error {
        let rig = &self.rig;
        Error::new(
            ErrorKind::Other,
            format!(
                "{what}: the daemon of rig \"{rig}\" and this program do not understand each other: {why}"
            ),
        )
    }

    fn unreachable(&self, failure: Failure) -> Error {
        let rig = &self.rig;
        if let Some(host) = &self.host {
            let what = match &failure {
                Failure::Absent(_) | Failure::Refused(_) => {
                    format!("host {host} of rig \"{rig}\" is not connected; depthrig status says why")
                }
                _ => format!(
                    "host {host} of rig \"{rig}\" does not answer: {failure}; depthrig runs there and is this rig?"
                ),
            };
            return Error::new(ErrorKind::Unreachable, what).with_source(failure);
        }
        let socket = self.connector.path().display();
        let holder = self.runtime.holder(rig);
        let (kind, what) = match (&failure, holder) {
            (Failure::Denied(e), _) => {
                let what = format!(
                    "control socket {socket} cannot be opened: {e}; a rig is controlled by the user that runs it"
                );
                (ErrorKind::PermissionDenied, what)
            }
            (Failure::Absent(_) | Failure::Refused(_), None) => {
                (ErrorKind::Unreachable, format!("rig \"{rig}\" has ended; start it: depthrig run RIG.toml"))
            }
            (Failure::Absent(_), Some(holder)) => {
                let what = format!(
                    "rig \"{rig}\" runs ({holder}) but has no control socket {socket}: it is still starting or already ending; try again"
                );
                (ErrorKind::Unreachable, what)
            }
            (Failure::Refused(_), Some(holder)) => {
                let what = format!(
                    "rig \"{rig}\" runs ({holder}) but nothing answers on {socket}, which is the socket of an earlier daemon; try again, then restart the rig"
                );
                (ErrorKind::Unreachable, what)
            }
            (Failure::Silent(timeout), holder) => {
                let who = holder.unwrap_or_else(|| "ended meanwhile".into());
                let what = format!("rig \"{rig}\" ({who}) did not answer within {} s", timeout.as_secs());
                (ErrorKind::Unreachable, what)
            }
            (Failure::Broken(e), _) => (
                ErrorKind::Unreachable,
                format!("the connection to rig \"{rig}\" broke off: {e}; it may have ended"),
            ),
        };
        Error::new(kind, what).with_source(failure)
    }
}

/// Whether versions `a` and `b` speak the same API, as semantic versioning has it.
fn compatible(a: &str, b: &str) -> bool {
    let parts = |v: &str| {
        let mut numbers = v.split(['.', '-', '+']).map(str::parse::<u64>);
        let major = numbers.next()?.ok()?;
        let minor = numbers.next()?.ok()?;
        Some((major, if major == 0 { minor } else { 0 }))
    };
    parts(a).is_some() && parts(a) == parts(b)
}
