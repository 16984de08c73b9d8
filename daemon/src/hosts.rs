//! The other computers of a rig: they record when this one does, and their parts are pulled and joined.
//!
//! Each of them runs a whole daemon that records its own cameras to its own disk, so that no image depends on a network. The daemon
//! here speaks to theirs over their control sockets, which a tunnel or anything else brings to this computer
//! ([`RuntimeDir::host_socket_path`]); this module knows sockets alone.
//!
//! ```text
//! session  the recordings with parts elsewhere, and a file beside each that says so
//! visit    what one look at a host's status leads to, and pulling beside it
//! mirrored its cameras, as they are seen here
//! reach    the way to its daemon
//! pull     segments by ranges of bytes, resumed where they ended, compared at the end
//! ```
//!
//! **Nothing is remembered that can be asked.** A thread for each host looks at its status, and does what it takes to come closer to what
//! should be: a host that was away while a recording began gets a part later, and one that missed its end is stopped
//! later, whoever was killed or cut off meanwhile.

mod mirrored;
mod pull;
pub(crate) mod reach;
mod refine;
mod session;
#[cfg(test)]
mod tests;
mod visit;

use crate::client::Client;
use crate::config::{HostConfig, RigConfig};
use crate::control::{FollowRequest, RecordRequest};
use crate::mirror::Mirror;
use crate::recording::reserve_bytes;
use crate::sets::Grid;
use crate::status::{
    CameraState, CameraStatus, HostState, HostStatus, HostsStatus, JoinState, RecordingStatus, RigStatus,
};
use crate::wake::Wake;
use crate::{Error, ErrorKind, Result};
use core::time::Duration;
use depthrig_bus::sync::lock;
use depthrig_bus::{HostTime, RigName, RuntimeDir};
use depthrig_link::{Key, Tunnel};
use depthrig_recorder::fs::RealFs;
use depthrig_recorder::{Health, SESSION_FILE, look_at};
use refine::HostRefine;
pub use refine::Place;
use session::{Session, Sessions};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};

/// Makes one dataset of others ([`crate::joining`]), and leaves so many bytes free on the disk.
pub type JoinParts = fn(&[PathBuf], &Path, &RuntimeDir, u64, &AtomicBool) -> Result<u64>;

/// The folder of the channels over which parts are joined, below that of the user's rigs.
pub const JOINING: &str = "joining";
/// From one look at a host, or at what it has to pull, to the next.
const LOOK: Duration = Duration::from_millis(500);
/// A host that was just reached gets the key of the clock first, and begins its part when it knows the clock, or after so long all the same.
const CLOCK_WAIT: Duration = Duration::from_secs(2);
/// From one look to the next meanwhile.
const CLOCK_LOOK: Duration = Duration::from_millis(100);
/// A start and a stop wait so long for the hosts that answer; they go on behind it.
const SETTLE_TIMEOUT: Duration = Duration::from_secs(5);

/// Folders of the parts that were pulled of the recording in `folder`.
///
/// # Errors
/// `BadInput` when other computers have no parts of it, or not all of them are here.
pub fn parts_of(folder: &Path) -> Result<Vec<PathBuf>> {
    let folder = std::path::absolute(folder).unwrap_or_else(|_| folder.to_owned());
    let bad = |what: String| Error::new(ErrorKind::BadInput, what);
    let none = || bad(format!("{} has no parts of other computers ({})", folder.display(), session::FILE));
    let session = Session::read(&folder).filter(|s| !s.parts.is_empty()).ok_or_else(none)?;
    if let Some(part) = session.parts.iter().find(|part| !part.is_complete) {
        let what = "is not here completely; it is pulled while this rig and host";
        return Err(bad(format!("part {} {what} {} run", part.name, part.host)));
    }
    Ok(session.part_folders().collect())
}

/// The other computers of a rig.
#[derive(Debug)]
pub struct Hosts {
    others: Vec<Host>,
    sessions: Mutex<Sessions>,
    /// With `sessions`: something changed.
    changed: Condvar,
    runtime: RuntimeDir,
    rig: RigName,
    /// Cameras of this computer.
    cameras: Vec<String>,
    /// Room that pulled parts and joined datasets leave on the disk.
    reserve_bytes: u64,
    join: Option<JoinParts>,
    grid: Arc<Grid>,
    /// The others sign the packets of the clock with it; none if nobody does.
    key: Option<Key>,
}

#[derive(Debug)]
struct Host {
    config: HostConfig,
    seen: Mutex<HostStatus>,
    /// Cameras there, at the last look.
    cameras: Mutex<Vec<CameraStatus>>,
    /// Its streams that come here.
    mirrors: Vec<Mirror>,
    /// Its cameras whose depth is refined here.
    refined: Vec<HostRefine>,
}

impl Host {
    fn status(&self) -> HostStatus {
        let seen = lock(&self.seen).clone();
        let mirrors: Vec<_> = self.mirrors.iter().map(Mirror::status).collect();
        let refined = self.refined.iter().map(HostRefine::status).collect();
        let made = |camera: &str| {
            let own = self.refined.iter().filter(|refine| refine.is_of(camera));
            own.flat_map(HostRefine::streams).collect()
        };
        let mirrored = mirrored::cameras(&seen, &lock(&self.cameras), &mirrors, &made);
        HostStatus { mirrors, refined, mirrored, ..seen }
    }

    /// Gives its cameras to the stage that refines depth.
    fn begin_refined(&self, status: &RigStatus, place: Place<'_>) {
        for refine in &self.refined {
            refine.begin(status, place);
        }
    }

    fn is_connected(&self) -> bool {
        lock(&self.seen).state == HostState::Connected
    }

    /// It records a part of `session`, as it was seen last: one that was asked for may not have begun.
    fn records_part_of(&self, session: &Session) -> bool {
        let recorded = lock(&self.seen).recording.clone();
        session.parts.iter().any(|part| recorded.as_deref() == Some(&part.name))
    }
}

impl Hosts {
    /// The computers of `config`, if it names any; `join` makes one dataset of the parts of a recording. Recordings whose parts
    /// an earlier daemon did not pull are found again.
    ///
    /// # Errors
    /// Those of making a link to a socket, and the folder for joining, which is needed at the end of the first recording.
    pub fn new(
        config: &RigConfig,
        runtime: &RuntimeDir,
        join: Option<JoinParts>,
        grid: Arc<Grid>,
        key: Option<Key>,
    ) -> Result<Option<Self>> {
        let Some(link) = config.link.as_ref().filter(|link| !link.hosts.is_empty()) else { return Ok(None) };
        RuntimeDir::at(&runtime.path().join(JOINING))?;
        for host in &link.hosts {
            reach::link_socket(host, &config.rig, runtime)?;
        }
        let seen = |host: &HostConfig| HostStatus {
            host: host.name.to_string(),
            why: Some("it was not asked yet".to_owned()),
            ..HostStatus::default()
        };
        let mirrors = |h: &HostConfig| {
            let socket = runtime.host_socket_path(&config.rig, &h.name);
            h.mirror.iter().map(|id| Mirror::new(id.clone(), &config.rig, runtime, socket.clone())).collect()
        };
        Ok(Some(Self {
            others: (link.hosts.iter())
                .map(|h| Host {
                    config: h.clone(),
                    seen: Mutex::new(seen(h)),
                    cameras: Mutex::default(),
                    mirrors: mirrors(h),
                    refined: HostRefine::of(h),
                })
                .collect(),
            sessions: Mutex::new(Sessions::left_in(&config.recording.directory)),
            changed: Condvar::new(),
            runtime: runtime.clone(),
            rig: config.rig.clone(),
            cameras: config.cameras.iter().map(|c| c.name.to_string()).collect(),
            reserve_bytes: reserve_bytes(&config.recording),
            join,
            grid,
            key,
        }))
    }

    /// Number of hosts; each has two threads of its own.
    pub const fn count(&self) -> usize {
        self.others.len()
    }

    /// State of the hosts, and of the newest recording.
    pub fn status(&self) -> HostsStatus {
        HostsStatus {
            hosts: self.others.iter().map(Host::status).collect(),
            session: lock(&self.sessions).newest().map(Session::status),
        }
    }

    /// The hosts get parts of a recording that has begun here. Returns when each that answers has one or says why not, after some
    /// seconds at most.
    pub fn begin(&self, here: &RecordingStatus, request: &RecordRequest) {
        lock(&self.sessions).begin(here, request);
        self.settle(|host, session| host.records_part_of(session) || session.excuse(host).is_some());
    }

    /// A recording ends here: the hosts end their parts at the same time.
    pub fn end(&self, path: &Path) {
        lock(&self.sessions).end(path);
        self.changed.notify_all();
    }

    /// Waits until the hosts that answer have ended their parts, for some seconds at most.
    pub fn wait_ended(&self) {
        self.settle(|host, session| !host.records_part_of(session));
    }

    /// Wakes the threads of all hosts, and waits until `is_done` of each that is connected and the newest session.
    fn settle(&self, is_done: impl Fn(&Host, &Session) -> bool) {
        self.changed.notify_all();
        let deadline = HostTime::now().plus(SETTLE_TIMEOUT);
        let mut sessions = lock(&self.sessions);
        while !deadline.from_now().is_zero() {
            let Some(session) = sessions.newest() else { return };
            if self.others.iter().all(|host| !host.is_connected() || is_done(host, session)) {
                return;
            }
            let waited = self.changed.wait_timeout(sessions, deadline.from_now().min(LOOK));
            (sessions, _) = waited.unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Keeps host `number` in step until `stop`. `active` is the folder that is being recorded into here; its depth is refined at `place`.
    ///
    /// # Errors
    /// When no client or tunnel can be made.
    pub fn keep(
        &self,
        number: usize,
        active: &dyn Fn() -> Option<PathBuf>,
        place: Place<'_>,
        stop: &AtomicBool,
    ) -> Result<()> {
        let Some(host) = self.others.get(number) else { return Ok(()) };
        let client = Client::of_host(&self.runtime, &self.rig, &host.config.name)?;
        let tunnel = reach::tunnel(&host.config, &self.rig, &self.runtime)?;
        let mut connected_since = None;
        let mut may_begin = true;
        while !stop.load(Ordering::Relaxed) {
            let mut sessions = lock(&self.sessions);
            // Under the lock: a session is added after its recording has become active.
            sessions.follow(active().as_deref());
            drop(sessions);
            if host.is_connected() {
                // By what was seen last: the next answer may come late, behind what is pulled.
                self.visit(host, &client, may_begin);
            } else {
                // One that is refused has nothing to begin, and may have a part to end.
                self.end_part(host, &client);
            }
            let looked = client.status();
            let is_new = self.note(host, looked.as_ref(), tunnel.as_ref());
            if let Ok(status) = &looked
                && host.is_connected()
            {
                self.lead(host, &client);
                let since = *connected_since.get_or_insert_with(HostTime::now);
                may_begin = lock(&host.seen).has_clock || since.elapsed() >= CLOCK_WAIT;
                self.visit(host, &client, may_begin);
                host.begin_refined(status, place);
            } else {
                connected_since = None;
                may_begin = true;
            }
            if is_new {
                self.changed.notify_all();
            }
            self.wait_for_change(if may_begin { LOOK } else { CLOCK_LOOK });
        }
        Ok(())
    }

    /// Pulls what host `number` records until `stop`, in another thread than [`Self::keep`]: a recording begins and ends there at once, however
    /// slow the way is.
    ///
    /// # Errors
    /// When no client can be made.
    pub fn pull(&self, number: usize, stop: &AtomicBool) -> Result<()> {
        let Some(host) = self.others.get(number) else { return Ok(()) };
        let client = Client::of_host(&self.runtime, &self.rig, &host.config.name)?;
        while !stop.load(Ordering::Relaxed) {
            if !host.is_connected() || !self.pull_parts(host, &client, stop) {
                self.wait_for_change(LOOK);
            }
        }
        Ok(())
    }

    fn wait_for_change(&self, at_most: Duration) {
        let sessions = lock(&self.sessions);
        drop(self.changed.wait_timeout(sessions, at_most).unwrap_or_else(PoisonError::into_inner));
    }

    /// Number of streams of all hosts whose frames come here; each has a thread of its own.
    pub fn mirrored(&self) -> usize {
        self.others.iter().map(|host| host.mirrors.len()).sum()
    }

    /// Publishes the frames of mirrored stream `number` here until `stop`, and raises `wake` for each.
    ///
    /// # Errors
    /// When this rig's bus cannot be opened.
    pub fn mirror(&self, number: usize, wake: &Wake, stop: &AtomicBool) -> Result<()> {
        let mut all =
            self.others.iter().flat_map(|host| host.mirrors.iter().map(move |mirror| (host, mirror)));
        let Some((host, mirror)) = all.nth(number) else { return Ok(()) };
        mirror.run(&|| host.is_connected(), wake, stop)
    }

    /// Gives the key and the ticks, and hears of the streams there.
    fn lead(&self, host: &Host, client: &Client) {
        let request = FollowRequest { key: self.key.clone(), phase_ns: self.grid.phase_ns() };
        if let Ok(heard) = client.follow(&request) {
            self.grid.set_other(host.config.name.as_str(), heard.streams);
        }
    }

    /// Writes down what a look at a host found; whether that is news.
    fn note(&self, host: &Host, looked: Result<&RigStatus, &Error>, tunnel: Option<&Tunnel>) -> bool {
        let name = &host.config.name;
        let mut seen = HostStatus { host: name.to_string(), ..lock(&host.seen).clone() };
        match looked {
            Ok(status) => {
                let refusal = self.refusal(host, status);
                seen.state = if refusal.is_some() { HostState::Refused } else { HostState::Connected };
                seen.why = refusal.or_else(|| lock(&self.sessions).excuse(name));
                seen.cameras = status.cameras.len();
                seen.streaming = status.cameras.iter().filter(|c| c.state == CameraState::Streaming).count();
                seen.has_clock = status.link.as_ref().is_some_and(|link| link.offset_s.is_some());
                seen.recording = status.recording.as_ref().filter(|r| r.active).map(|r| r.name.clone());
                if seen.state == HostState::Connected {
                    lock(&host.cameras).clone_from(&status.cameras);
                }
            }
            Err(e) => {
                seen.state = HostState::Absent;
                seen.why = Some(tunnel.and_then(Tunnel::why).unwrap_or_else(|| e.to_string()));
                seen.streaming = 0;
                seen.has_clock = false;
                seen.recording = None;
            }
        }
        let mut known = lock(&host.seen);
        let before = known.state;
        let is_new = *known != seen;
        *known = seen.clone();
        drop(known);
        if before != seen.state {
            match seen.state {
                HostState::Connected => tracing::info!("host {name} answers: {} cameras", seen.cameras),
                HostState::Absent | HostState::Refused => {
                    tracing::error!("host {name}: {}", seen.why.unwrap_or_default());
                }
            }
        }
        is_new
    }

    /// The reason to refuse a daemon that answers as this host; `None` without one.
    fn refusal(&self, host: &Host, status: &RigStatus) -> Option<String> {
        let name = &host.config.name;
        let misfit = reach::misfit(&self.rig, name, self.key.is_none(), status);
        if misfit.is_some() {
            return misfit;
        }
        let twice = |is_taken: &dyn Fn(&String) -> bool| {
            status.cameras.iter().map(|camera| &camera.name).find(|name| is_taken(name)).cloned()
        };
        // Cameras of one that is away may have moved to another.
        let others = self.others.iter().filter(|other| other.config.name != *name && other.is_connected());
        let here = twice(&|name| self.cameras.contains(name)).map(|c| (c, "this computer".to_owned()));
        let shared = here.or_else(|| {
            others.into_iter().find_map(|o| {
                let there = lock(&o.cameras);
                let name = twice(&|name| there.iter().any(|camera| camera.name == *name))?;
                Some((name, format!("host {}", o.config.name)))
            })
        });
        let (camera, place) = shared?;
        Some(reach::taken(&camera, &place))
    }

    /// Joins the parts of recordings as they become complete, until `stop`.
    pub fn join_complete(&self, stop: &AtomicBool) {
        while !stop.load(Ordering::Relaxed) {
            let Some(join) = self.join else { return };
            let due = lock(&self.sessions).due(|folder| {
                !matches!(look_at(&RealFs, folder).health, Health::Recording | Health::Unfinished)
            });
            let Some(session) = due else {
                self.wait_for_change(LOOK);
                continue;
            };
            let out = session.joined_folder();
            if out.join(SESSION_FILE).is_file() {
                // It gets its name when it is verified: an earlier daemon ended before it wrote that down.
                lock(&self.sessions).joined(&session.name, JoinState::Done, None);
                continue;
            }
            lock(&self.sessions).joined(&session.name, JoinState::Joining, None);
            let inputs: Vec<_> =
                core::iter::once(session.folder.clone()).chain(session.part_folders()).collect();
            let ended = join(&inputs, &out, &self.runtime, self.reserve_bytes, stop);
            if stop.load(Ordering::Relaxed) {
                return;
            }
            match &ended {
                Ok(sets) => tracing::info!("joined into {}: {sets} sets", out.display()),
                Err(e) => tracing::error!("the parts of {} are not joined: {e}", session.name),
            }
            let state = if ended.is_ok() { JoinState::Done } else { JoinState::Failed };
            lock(&self.sessions).joined(&session.name, state, ended.err().map(|e| e.to_string()));
        }
    }
}
