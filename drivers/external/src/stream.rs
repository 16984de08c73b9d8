//! A camera that streams out of another process.

use super::intake::{Intake, Look, SessionId};
use super::process::{SharedKeeper, kill, stalled};
use super::{Place, kind_of, of_bus, refusal};
use core::time::Duration;
use depthrig_bus::HostTime;
use depthrig_bus::external::{
    Answer, Beat, ExternalLink, ExternalReason, ExternalState, ExternalWant, FrameInlet, HEARTBEAT,
};
use depthrig_driver::{Error, ErrorKind, FrameSink, Poll, Result, Stream, StreamProfile};

/// Frames of one stream that one poll takes at most; as many may wait unread.
const FRAMES_PER_POLL: usize = 4;
/// How long a silent process is left before its lock is looked at, and how often.
const LOCK_AFTER: Duration = Duration::from_millis(100);
const LOCK_EVERY: Duration = Duration::from_millis(50);
/// A process that wakes the daemon without a frame more often than this is not listened to for a moment.
const IDLE_WAKES: u32 = 16;
const WAKE_PAUSE: Duration = Duration::from_millis(2);

/// The session that the process was asked for.
#[derive(Debug)]
pub(super) struct Started {
    /// Which start of the process.
    pub(super) instance: u64,
    /// Number of the session.
    pub(super) session: u64,
    /// One byte for each mode of the offer.
    pub(super) wanted: Vec<u8>,
    /// Silence that means that it hangs.
    pub(super) heartbeat: Duration,
    /// Its number, for messages.
    pub(super) pid: u32,
}

/// A running camera.
#[derive(Debug)]
pub(super) struct ExternalStream {
    place: Place,
    link: ExternalLink,
    keeper: SharedKeeper,
    started: Started,
    profiles: Vec<StreamProfile>,
    intakes: Vec<Intake>,
    /// The last sign of life.
    alive: HostTime,
    /// When the request was last sent.
    asked: HostTime,
    looked: HostTime,
    state: ExternalState,
    over: Option<Over>,
}

/// How it came to its end.
#[derive(Debug, Clone)]
enum Over {
    Finished,
    Failed(Error),
}

impl ExternalStream {
    pub(super) fn new(
        place: Place,
        link: ExternalLink,
        keeper: SharedKeeper,
        started: Started,
        profiles: Vec<StreamProfile>,
        inlets: Vec<(FrameInlet, bool)>,
    ) -> Self {
        let now = HostTime::now();
        let intakes = inlets
            .into_iter()
            .zip(&profiles)
            .enumerate()
            .map(|(i, ((inlet, has_counter), profile))| Intake::new(i, inlet, profile, has_counter))
            .collect();
        let alive = now;
        let looked = now;
        let asked = HostTime::from_ns(0);
        let state = ExternalState::Idle;
        Self { place, link, keeper, started, profiles, intakes, alive, asked, looked, state, over: None }
    }

    /// Asks the process to run, and waits for its first frame: cameras may take seconds to start, and until then a
    /// supervisor must not take this one for silent.
    pub(super) fn wait_for_first_frame(&mut self, timeout: Duration) -> Result<()> {
        let deadline = HostTime::now().plus(timeout);
        let session = self.session();
        loop {
            self.attend()?;
            if self.over.is_some() {
                return Ok(()); // finished before it began
            }
            for intake in &mut self.intakes {
                if intake.has_frame(session).map_err(of_bus)? {
                    return Ok(());
                }
                if let Some(why) = intake.verdict() {
                    return Err(self.refuse(&why));
                }
            }
            if deadline.from_now().is_zero() {
                let s = timeout.as_secs_f64();
                let state = self.state.name();
                let what =
                    format!("was asked to run and sent no frame within {s:.1} s (its state is \"{state}\")");
                let e = stalled(ErrorKind::Stalled, &self.keeper, self.started.pid, &what);
                kill(&self.keeper, &what);
                self.over = Some(Over::Failed(e.clone()));
                return Err(e);
            }
            self.link.sleep(HEARTBEAT.min(deadline.from_now()).min(LOCK_EVERY)).map_err(of_bus)?;
        }
    }

    const fn session(&self) -> SessionId {
        SessionId { instance: self.started.instance, number: self.started.session }
    }

    /// Reads the process's messages, repeats the request, and checks whether the process still runs.
    fn attend(&mut self) -> Result<()> {
        match &self.over {
            Some(Over::Failed(e)) => return Err(e.clone()),
            Some(Over::Finished) => return Ok(()),
            None => {}
        }
        let result = self.hear().and_then(|()| self.repeat_request()).and_then(|()| self.look());
        if let Err(e) = &result {
            self.over = Some(Over::Failed(e.clone()));
        }
        result
    }

    fn hear(&mut self) -> Result<()> {
        let instance = self.started.instance;
        let said = self.link.newest(|beat| beat.instance == instance).map_err(of_bus)?;
        let Some(said) = said else { return Ok(()) };
        self.alive = self.alive.max(said.beat.sent);
        self.judge(&said.beat)
    }

    /// Applies the process's state to the stream.
    fn judge(&mut self, beat: &Beat) -> Result<()> {
        let ours = beat.session == self.started.session;
        let Some(state) = beat.state else { return Ok(()) };
        match state {
            ExternalState::Ended if beat.reason == ExternalReason::Finished => {
                self.over = Some(Over::Finished);
                Ok(())
            }
            ExternalState::Ended => {
                let why = beat.text();
                let why = if why.is_empty() { beat.reason.name() } else { &why };
                let what = format!("its process {} ended: {why}", beat.pid);
                Err(Error::new(ErrorKind::Disconnected, what))
            }
            ExternalState::Refused if ours || beat.session == 0 => {
                if beat.reason == ExternalReason::Finished {
                    self.over = Some(Over::Finished);
                    return Ok(());
                }
                Err(Error::new(kind_of(beat.reason), refusal(beat)))
            }
            ExternalState::Idle if ours => {
                let what = format!("its process {} stopped the camera by itself", beat.pid);
                Err(Error::new(ErrorKind::Disconnected, what))
            }
            _ => {
                if ours {
                    self.state = state;
                }
                Ok(())
            }
        }
    }

    /// Sends the request again when that is due.
    fn repeat_request(&mut self) -> Result<()> {
        if self.asked.elapsed() < HEARTBEAT {
            return Ok(());
        }
        self.answer(ExternalWant::Run, ExternalReason::None, "").map_err(of_bus)?;
        self.asked = HostTime::now();
        Ok(())
    }

    fn answer(&mut self, want: ExternalWant, reason: ExternalReason, text: &str) -> depthrig_bus::Result<()> {
        let Started { instance, session, wanted, .. } = &self.started;
        let instance = *instance;
        let session = *session;
        self.link.answer(&Answer { instance, session, want, reason, text, modes: wanted })
    }

    /// Whether a process that says nothing is still there.
    fn look(&mut self) -> Result<()> {
        let silence = self.alive.elapsed();
        if self.over.is_some() || silence < LOCK_AFTER || self.looked.elapsed() < LOCK_EVERY {
            return Ok(());
        }
        self.looked = HostTime::now();
        let pid = self.started.pid;
        let holder = self.place.holder();
        if holder.as_ref().is_none_or(|h| !is_of(h, pid)) {
            // Its last words may have come between.
            self.hear()?;
            if self.over.is_some() {
                return Ok(());
            }
            self.link.clean_dead();
            let heir = holder.map_or_else(String::new, |h| format!("; {h} serves it now"));
            let what = format!("its process {pid} ended without a word{heir}");
            return Err(Error::new(ErrorKind::Disconnected, what));
        }
        if silence > self.started.heartbeat {
            let what = format!("has said nothing for {:.1} s", silence.as_secs_f64());
            let e = stalled(ErrorKind::Disconnected, &self.keeper, pid, &what);
            kill(&self.keeper, &what);
            return Err(e);
        }
        Ok(())
    }

    /// Ends the session because its frames cannot be used, and says why to both sides.
    fn refuse(&mut self, why: &str) -> Error {
        if let Err(e) = self.answer(ExternalWant::Refused, ExternalReason::Invalid, why) {
            tracing::debug!(error = %e, "the refusal could not be sent to the process");
        }
        let e = Error::new(
            ErrorKind::Protocol,
            format!("its process {} does not send what it announced: {why}", self.started.pid),
        );
        self.over = Some(Over::Failed(e.clone()));
        e
    }

    /// Takes the frames that wait, a few of each stream. How long a flood is to be left alone, if any came.
    fn take(&mut self, sink: &mut dyn FrameSink) -> Result<Option<Duration>> {
        let session = self.session();
        let mut came = false;
        let mut flood = Duration::ZERO;
        let mut wrong = None;
        for intake in &mut self.intakes {
            for _ in 0..FRAMES_PER_POLL {
                let look = intake.take(session, sink).map_err(of_bus)?;
                wrong = wrong.or_else(|| intake.verdict());
                if look == Look::Empty {
                    break;
                }
                came = true;
                if look == Look::Flood {
                    flood = flood.max(intake.wait());
                }
            }
        }
        if let Some(why) = wrong {
            return Err(self.refuse(&why));
        }
        if came {
            self.alive = HostTime::now();
        }
        Ok(came.then_some(flood))
    }
}

/// Whether the text of a lock is that of process `pid`.
pub(super) fn is_of(holder: &str, pid: u32) -> bool {
    let number = holder.strip_prefix("process ").and_then(|rest| rest.split(' ').next());
    number.and_then(|n| n.parse::<u32>().ok()).is_none_or(|n| n == pid)
}

impl Stream for ExternalStream {
    fn profiles(&self) -> &[StreamProfile] {
        &self.profiles
    }

    fn poll(&mut self, timeout: Duration, sink: &mut dyn FrameSink) -> Result<Poll> {
        let deadline = HostTime::now().plus(timeout);
        let mut wakes = 0;
        loop {
            if let Some(Over::Failed(e)) = &self.over {
                return Err(e.clone());
            }
            if let Some(flood) = self.take(sink)? {
                self.attend()?;
                // The channel discards frames that come meanwhile, at the cost of the process.
                std::thread::sleep(flood.min(deadline.from_now()));
                return Ok(Poll::Frame);
            }
            if matches!(self.over, Some(Over::Finished)) {
                return Ok(Poll::End);
            }
            self.attend()?;
            if matches!(self.over, Some(Over::Finished)) {
                continue; // its last frames may have come between
            }
            let left = deadline.from_now();
            if left.is_zero() {
                return Ok(Poll::Idle);
            }
            wakes += 1;
            if wakes > IDLE_WAKES {
                std::thread::sleep(WAKE_PAUSE.min(left));
            }
            self.link.sleep(left.min(LOCK_EVERY)).map_err(of_bus)?;
        }
    }
}

impl Drop for ExternalStream {
    fn drop(&mut self) {
        // At the end of files too: it is how the process learns that its last frames were taken.
        if !matches!(self.over, Some(Over::Failed(_)))
            && let Err(e) = self.answer(ExternalWant::Stop, ExternalReason::None, "")
        {
            tracing::debug!(error = %e, "the request to stop could not be sent to the process");
        }
    }
}
