//! State shared by a camera's handle and its thread: commands one way, accounts the other.

use crate::clock::DeviceClock;
use crate::fault::Fault;
use crate::firmware::Asked;
use crate::firmware::imu::ImuSample;
use crate::model::Mode;
use crate::{Accounts, Error, Result};
use core::time::Duration;
use depthrig_bus::HostTime;
use rustix::event::{EventfdFlags, eventfd};
use rustix::fd::OwnedFd;
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::os::unix::net::UnixStream;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};

/// Most commands that wait; further ones are refused.
const COMMANDS: usize = 64;
/// Starts of a stream that are remembered.
const SESSIONS: usize = 8192;
/// Requests of the hardware monitor that are remembered.
const ASKED: usize = 1024;

/// From the start of an exposure to its middle, where nothing else is known.
const HALF_EXPOSURE_NS: i64 = 4_000_000;

/// Samples of the IMU that are remembered.
const IMU_SAMPLES: usize = 1 << 16;

/// A command from a handle to its camera's thread.
pub(crate) enum Command {
    /// Serve the host at the other end of this socket; the number of its port, when it has one.
    Serve(UnixStream, Option<u32>),
    /// Leave the bus, and come back after a time if there is one.
    Unplug(Option<Duration>),
    Fault(Fault),
    End,
}

/// One run of a stream, from a start to a stop.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Session {
    pub first_index: u64,
    /// Mid-exposure of its first frame, in nanoseconds of the device since power-on.
    pub first_ns: i64,
    pub period_ns: i64,
    pub mode: Mode,
    pub clock: DeviceClock,
}

impl Session {
    /// When the frame of an index was captured: the middle of its exposure.
    pub fn captured(&self, index: u64) -> HostTime {
        let k = index.saturating_sub(self.first_index) as i64;
        self.clock.host(self.first_ns + k * self.period_ns)
    }
}

/// Where the camera is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Presence {
    Unplugged,
    /// It will come back by itself.
    Away,
    Plugged(Option<u32>),
}

pub(crate) struct State {
    pub commands: VecDeque<Command>,
    pub accounts: Vec<Accounts>,
    pub sessions: Vec<VecDeque<Session>>,
    pub faults: BTreeMap<&'static str, u64>,
    pub asked: VecDeque<Asked>,
    /// Opcodes of the hardware monitor that the firmware does not know.
    pub unknown: BTreeSet<u32>,
    pub imu: VecDeque<ImuSample>,
    /// Which streams are running.
    pub running: Vec<bool>,
    pub presence: Presence,
    /// Why it is not on the bus although it should be.
    pub trouble: Option<String>,
}

pub(crate) struct Shared {
    state: Mutex<State>,
    pub changed: Condvar,
    pub wake: OwnedFd,
}

impl Shared {
    pub fn new(streams: usize) -> Result<Self> {
        let wake = eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK)
            .map_err(|e| Error::new(format!("no eventfd: {e}")))?;
        let state = State {
            commands: VecDeque::with_capacity(COMMANDS),
            accounts: vec![Accounts::default(); streams],
            sessions: vec![VecDeque::new(); streams],
            faults: BTreeMap::new(),
            asked: VecDeque::new(),
            unknown: BTreeSet::new(),
            imu: VecDeque::new(),
            running: vec![false; streams],
            presence: Presence::Unplugged,
            trouble: None,
        };
        Ok(Self { state: Mutex::new(state), changed: Condvar::new(), wake })
    }

    pub fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Hands a command to the thread.
    pub fn ask(&self, command: Command) -> Result<()> {
        let mut state = self.lock();
        if state.commands.len() >= COMMANDS {
            return Err(Error::new("the camera's thread does not take commands any more"));
        }
        state.commands.push_back(command);
        drop(state);
        rustix::io::write(&self.wake, &1u64.to_ne_bytes())
            .map_err(|e| Error::new(format!("the camera's thread cannot be woken: {e}")))?;
        Ok(())
    }

    /// Waits until `wanted` holds for the camera's presence.
    pub fn wait(&self, limit: Duration, wanted: impl Fn(Presence) -> bool) -> Result<()> {
        let end = HostTime::now().plus(limit);
        let mut state = self.lock();
        while !wanted(state.presence) {
            let left = end.from_now();
            if left.is_zero() {
                let why = state.trouble.clone().unwrap_or_else(|| "its thread did not say why".into());
                return Err(Error::new(format!(
                    "the camera is still {:?} after {limit:?}: {why}",
                    state.presence
                )));
            }
            let (again, _) = self.changed.wait_timeout(state, left).unwrap_or_else(PoisonError::into_inner);
            state = again;
        }
        Ok(())
    }

    pub fn set_presence(&self, presence: Presence) {
        self.lock().presence = presence;
        self.changed.notify_all();
    }

    pub fn count_fault(&self, name: &'static str) {
        *self.lock().faults.entry(name).or_default() += 1;
    }

    pub fn remember(&self, asked: Asked) {
        let mut state = self.lock();
        if state.asked.len() >= ASKED {
            state.asked.pop_front();
        }
        state.asked.push_back(asked);
    }

    pub fn measured(&self, samples: Vec<ImuSample>) {
        let mut state = self.lock();
        for sample in samples {
            if state.imu.len() >= IMU_SAMPLES {
                state.imu.pop_front();
            }
            state.imu.push_back(sample);
        }
    }

    pub fn begin_session(&self, stream: usize, session: Session) {
        let mut state = self.lock();
        if let Some(accounts) = state.accounts.get_mut(stream) {
            accounts.starts += 1;
        }
        if let Some(sessions) = state.sessions.get_mut(stream) {
            if sessions.len() >= SESSIONS {
                sessions.pop_front();
            }
            sessions.push_back(session);
        }
        if let Some(running) = state.running.get_mut(stream) {
            *running = true;
        }
    }

    pub fn end_session(&self, stream: usize) {
        if let Some(running) = self.lock().running.get_mut(stream) {
            *running = false;
        }
    }

    /// How many exposures of the first stream have begun in its present run; `None` while it does not run.
    pub fn exposures(&self, now: HostTime) -> Option<u64> {
        let state = self.lock();
        let session = state.sessions.first()?.back().filter(|_| state.running.first() == Some(&true))?;
        let since = now.since_ns(session.captured(session.first_index)) + HALF_EXPOSURE_NS;
        u64::try_from(since.div_euclid(session.period_ns) + 1).ok()
    }
}
