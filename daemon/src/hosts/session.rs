//! Recordings that other computers have parts of, and the file beside each that says so.

use super::Host;
use crate::control::RecordRequest;
use crate::status::{JoinState, PartStatus, RecordingStatus, SessionStatus};
use depthrig_bus::{HostTime, Name};
use depthrig_recorder::check_name;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fs::File;
use std::io::Write as _;
use std::path::{Path, PathBuf};

/// The file in a recording's folder that names the parts of other computers.
pub(super) const FILE: &str = "hosts.toml";
/// The longest such file that is read, bytes.
const MAX_FILE_BYTES: u64 = 1 << 20;
/// Sessions that are remembered after their end.
const MAX_ENDED: usize = 100;

/// A recording with parts on other computers.
#[derive(Debug, Clone)]
pub(super) struct Session {
    /// Its name here.
    pub(super) name: String,
    /// Its folder.
    pub(super) folder: PathBuf,
    /// It is being recorded now.
    pub(super) goes_on: bool,
    /// The request that parts are begun with, while it goes on.
    request: RecordRequest,
    /// When it ends by itself.
    ends: Option<HostTime>,
    /// Parts in the order of their beginning.
    pub(super) parts: Vec<Part>,
    /// Why a host has none.
    excuses: BTreeMap<Name, String>,
    joined: JoinState,
    why: Option<String>,
}

/// A part of it.
#[derive(Debug, Clone)]
pub(super) struct Part {
    pub(super) host: Name,
    pub(super) name: String,
    /// It was asked for, and nothing said yet that it began.
    pub(super) is_asked: bool,
    pub(super) is_complete: bool,
    pub(super) bytes: u64,
    pub(super) pulled_bytes: u64,
    pub(super) why: Option<String>,
    /// When it was asked for, or read from the file.
    pub(super) since: HostTime,
}

/// The contents of [`FILE`].
#[derive(Debug, Serialize, Deserialize)]
struct Written {
    /// The dataset that the parts are in.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    joined: Option<String>,
    #[serde(default)]
    part: Vec<WrittenPart>,
}

#[derive(Debug, Serialize, Deserialize)]
struct WrittenPart {
    host: Name,
    name: String,
    #[serde(default, skip_serializing_if = "core::ops::Not::not")]
    asked: bool,
    #[serde(default)]
    complete: bool,
}

impl Session {
    /// Why a host has no part, or its part does not go on.
    pub(super) fn excuse(&self, host: &Host) -> Option<&String> {
        self.excuses.get(&host.config.name)
    }

    /// The request that a new part of `host` begins with.
    pub(super) fn part_request(&self, host: &Name) -> RecordRequest {
        let plain = format!("{}_{host}", self.name);
        let is_taken = |name: &str| self.parts.iter().any(|part| part.name == name);
        // A host that was started anew has another one.
        let numbered = (2..).map(|n| format!("{plain}_{n}"));
        let name = core::iter::once(plain.clone()).chain(numbered).find(|name| !is_taken(name));
        RecordRequest {
            directory: None,
            name,
            max_duration_s: self.ends.map(|ends| ends.from_now().as_secs_f64().max(0.1)),
            ..self.request.clone()
        }
    }

    /// Where a part is pulled to, and where it is when it is complete.
    pub(super) fn part_folder(&self, name: &str) -> PathBuf {
        self.folder.with_file_name(name)
    }

    pub(super) fn part_folders(&self) -> impl Iterator<Item = PathBuf> {
        self.parts.iter().map(|part| self.part_folder(&part.name))
    }

    pub(super) fn joined_name(&self) -> String {
        format!("{}_joined", self.name)
    }

    pub(super) fn joined_folder(&self) -> PathBuf {
        self.folder.with_file_name(self.joined_name())
    }

    pub(super) fn status(&self) -> SessionStatus {
        let part = |part: &Part| PartStatus {
            host: part.host.to_string(),
            name: part.name.clone(),
            bytes: part.bytes,
            pulled_bytes: part.pulled_bytes,
            is_complete: part.is_complete,
            why: part.why.clone(),
        };
        SessionStatus {
            name: self.name.clone(),
            parts: self.parts.iter().map(part).collect(),
            joined: self.joined,
            dataset: (self.joined == JoinState::Done).then(|| self.joined_name()),
            why: self.why.clone(),
        }
    }

    /// The session of a recording's folder, if other computers have parts of it.
    pub(super) fn read(folder: &Path) -> Option<Self> {
        let path = folder.join(FILE);
        if std::fs::metadata(&path).ok()?.len() > MAX_FILE_BYTES {
            return None;
        }
        let written = match toml::from_str::<Written>(&std::fs::read_to_string(&path).ok()?) {
            Ok(written) => written,
            Err(e) => {
                tracing::warn!("{} is not read: {}", path.display(), e.message());
                return None;
            }
        };
        if let Some(odd) = written.part.iter().find(|part| check_name(&part.name).is_err()) {
            tracing::warn!("{} is not read: {:?} is not the name of a dataset", path.display(), odd.name);
            return None;
        }
        let part = |part: WrittenPart| Part {
            host: part.host,
            name: part.name,
            is_asked: part.asked,
            is_complete: part.complete,
            bytes: 0,
            pulled_bytes: 0,
            why: None,
            since: HostTime::now(),
        };
        Some(Self {
            name: folder.file_name()?.to_str()?.to_owned(),
            folder: folder.to_owned(),
            goes_on: false,
            request: RecordRequest::default(),
            ends: None,
            parts: written.part.into_iter().map(part).collect(),
            excuses: BTreeMap::new(),
            joined: if written.joined.is_some() { JoinState::Done } else { JoinState::Waiting },
            why: None,
        })
    }

    /// Writes the file, in one step.
    fn write(&self) -> std::io::Result<()> {
        let part = |part: &Part| WrittenPart {
            host: part.host.clone(),
            name: part.name.clone(),
            asked: part.is_asked,
            complete: part.is_complete,
        };
        let written = Written {
            joined: (self.joined == JoinState::Done).then(|| self.joined_name()),
            part: self.parts.iter().map(part).collect(),
        };
        let text = toml::to_string(&written).map_err(std::io::Error::other)?;
        let path = self.folder.join(FILE);
        let tmp = path.with_extension("tmp");
        let mut file = File::create(&tmp)?;
        file.write_all(text.as_bytes())?;
        file.sync_all()?;
        std::fs::rename(&tmp, &path)
    }

    fn keep(&self) {
        if let Err(e) = self.write() {
            let path = self.folder.join(FILE);
            tracing::error!(
                "{} is not written: {e}; parts are not found again after a restart",
                path.display()
            );
        }
    }
}

/// All sessions of this daemon, and those that an earlier one did not finish.
#[derive(Debug, Default)]
pub(super) struct Sessions(Vec<Session>);

impl Sessions {
    /// Those below `directory` that are not joined yet.
    pub(super) fn left_in(directory: &Path) -> Self {
        let entries = std::fs::read_dir(directory).into_iter().flatten().filter_map(Result::ok);
        let mut found: Vec<_> = entries.filter_map(|entry| Session::read(&entry.path())).collect();
        found.retain(|session| session.joined != JoinState::Done);
        found.sort_by(|a, b| a.name.cmp(&b.name));
        Self(found)
    }

    pub(super) fn newest(&self) -> Option<&Session> {
        self.0.last()
    }

    /// A recording has begun here.
    pub(super) fn begin(&mut self, here: &RecordingStatus, request: &RecordRequest) {
        let ended = self.0.len().saturating_sub(MAX_ENDED);
        self.0.drain(..ended);
        self.0.push(Session {
            name: here.name.clone(),
            folder: std::path::absolute(&here.path).unwrap_or_else(|_| here.path.clone().into()),
            goes_on: true,
            request: request.clone(),
            ends: request.max_duration_s.map(|s| HostTime::now().plus_ns((s * 1e9) as i64)),
            parts: Vec::new(),
            excuses: BTreeMap::new(),
            joined: JoinState::Waiting,
            why: None,
        });
    }

    /// The recording into `path` ends here.
    pub(super) fn end(&mut self, path: &Path) {
        let path = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
        for session in self.0.iter_mut().filter(|session| session.folder == path) {
            session.goes_on = false;
        }
    }

    /// Ends those that are not recorded into any more: a recording may end by itself.
    pub(super) fn follow(&mut self, active: Option<&Path>) {
        let active = active.map(|path| std::path::absolute(path).unwrap_or_else(|_| path.to_owned()));
        for session in self.0.iter_mut().filter(|session| Some(&session.folder) != active.as_ref()) {
            session.goes_on = false;
        }
    }

    /// Why `host` has no part of the recording that goes on.
    pub(super) fn excuse(&self, host: &Name) -> Option<String> {
        let session = self.newest().filter(|session| session.goes_on)?;
        session.excuses.get(host).cloned()
    }

    /// Copies of those that have something to do with `host`.
    pub(super) fn of(&self, host: &Name) -> Vec<Session> {
        let concerns = |s: &&Session| s.goes_on || s.parts.iter().any(|p| p.host == *host && !p.is_complete);
        self.0.iter().filter(concerns).cloned().collect()
    }

    /// Whether a recording of this name is a part of one that has ended.
    pub(super) fn is_over(&self, part: &str) -> bool {
        let of = self.0.iter().rfind(|session| session.parts.iter().any(|p| p.name == part));
        of.is_some_and(|session| !session.goes_on)
    }

    /// Adds a part.
    pub(super) fn add(&mut self, session: &str, host: &Name, part: &str) {
        let Some(session) = self.0.iter_mut().rfind(|s| s.name == session) else { return };
        session.parts.push(Part {
            host: host.clone(),
            name: part.to_owned(),
            is_asked: true,
            is_complete: false,
            bytes: 0,
            pulled_bytes: 0,
            why: None,
            since: HostTime::now(),
        });
        session.excuses.remove(host);
        session.keep();
    }

    /// Takes a part back that did not begin, because of `why`.
    pub(super) fn take_back(&mut self, session: &str, host: &Name, part: &str, why: String) {
        let Some(session) = self.0.iter_mut().rfind(|s| s.name == session) else { return };
        session.parts.retain(|p| p.name != part);
        session.excuses.insert(host.clone(), why);
        session.keep();
    }

    /// Says why a host has no part.
    pub(super) fn excuse_of(&mut self, session: &str, host: &Name, why: String) {
        if let Some(session) = self.0.iter_mut().rfind(|s| s.name == session) {
            session.excuses.insert(host.clone(), why);
        }
    }

    /// Changes a part.
    pub(super) fn change(&mut self, session: &str, part: &str, change: impl FnOnce(&mut Part)) {
        let Some(session) = self.0.iter_mut().rfind(|s| s.name == session) else { return };
        let Some(part) = session.parts.iter_mut().find(|p| p.name == part) else { return };
        let written = |part: &Part| (part.is_asked, part.is_complete);
        let before = written(part);
        change(part);
        if written(part) != before {
            session.keep();
        }
    }

    /// One whose parts are all here and that is not joined.
    pub(super) fn due(&self, is_closed: impl Fn(&Path) -> bool) -> Option<Session> {
        let is_due = |s: &&Session| {
            !s.goes_on
                && s.joined == JoinState::Waiting
                && !s.parts.is_empty()
                && s.parts.iter().all(|p| p.is_complete)
                && is_closed(&s.folder)
        };
        self.0.iter().find(is_due).cloned()
    }

    /// Says how the joining of a session stands.
    pub(super) fn joined(&mut self, session: &str, state: JoinState, why: Option<String>) {
        let Some(session) = self.0.iter_mut().rfind(|s| s.name == session) else { return };
        session.joined = state;
        session.why = why;
        if state == JoinState::Done {
            session.keep();
        }
    }
}
