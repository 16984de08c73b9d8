//! The process's side: a camera that it serves.

use super::mode::{check_all, invalid};
use super::{
    About, ExternalAnswer, ExternalLock, ExternalMode, ExternalOffer, ExternalReason, ExternalState,
    ExternalWant, HEARTBEAT, MAX_MODES, Mode, Place, SILENCE, VERSION, lock_camera, plain,
};
use crate::channel::{self, Inlet, IoxService, Outlet};
use crate::sync::lock;
use crate::text;
use crate::{Bus, Error, ErrorKind, HostTime, Result};
use core::sync::atomic::{AtomicBool, Ordering};
use core::time::Duration;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;

/// How often the heartbeat thread checks whether it must end.
const LOOK: Duration = Duration::from_millis(50);
/// Answers that are read at a time; the channel keeps no more.
const MOST_AT_A_TIME: usize = 64;
/// Slots of the offers: one being written, the unread ones of each subscriber, and one that is kept for latecomers.
const OFFER_SLOTS: usize = 24;

/// A camera that this process serves to a rig.
///
/// ```no_run
/// # fn main() -> Result<(), Box<dyn std::error::Error>> {
/// use depthrig_bus::{Name, PixelFormat, external::{About, ExternalCamera, ExternalFrame, Mode, Place}};
/// let modes = [Mode::new(Name::new("color")?, PixelFormat::Rgb8, 640, 480, 30.0)];
/// let about = About { model: "Webcam".into(), serial: "1".into(), ..About::default() };
/// let mut camera = ExternalCamera::offer(&Place::from_environment()?, &about, &modes)?;
/// loop {
///     let Some(mut session) = camera.next_session(std::time::Duration::from_secs(1))? else { continue };
///     // Start the device in the modes of `session.modes()`; on failure: `session.refuse(reason, "…")`.
///     session.started();
///     while session.is_wanted() {
///         let image = [0; 640 * 480 * 3]; // from the device
///         session.send_copy(0, &ExternalFrame { device_time: 0, ..ExternalFrame::default() }, &image)?;
///     }
///     // Stop the device.
/// }
/// # }
/// ```
///
/// The heartbeat has a thread of its own, so an SDK call may take any time. Dropping the value ends the camera and
/// frees its place.
#[derive(Debug)]
pub struct ExternalCamera {
    pub(super) shared: Arc<Shared>,
    pub(super) place: Place,
    pub(super) bus: Bus,
    pub(super) taken: u64,
    thread: Option<JoinHandle<()>>,
    _lock: ExternalLock,
}

/// State shared by the process's threads.
#[derive(Debug)]
pub(super) struct Shared {
    pub(super) modes: Vec<Mode>,
    pub(super) instance: u64,
    pub(super) bell: Notifier<IoxService>,
    offers: Mutex<OfferSender>,
    wanted: Mutex<Wanted>,
    pub(super) changed: Condvar,
    end: AtomicBool,
}

/// The current offer, and the port that sends it.
#[derive(Debug)]
struct OfferSender {
    out: Outlet<ExternalOffer>,
    offer: ExternalOffer,
    records: Vec<u8>,
}

/// The daemon's current request.
#[derive(Debug, Clone, Default)]
pub(super) struct Wanted {
    pub(super) session: u64,
    /// Indices of the modes that are to run; empty for none.
    pub(super) modes: Vec<usize>,
    pub(super) refusal: Option<String>,
    heard: Option<HostTime>,
}

impl ExternalCamera {
    /// Offers a camera at `place` in these modes; the first of each stream is its default.
    ///
    /// # Errors
    /// [`ErrorKind::InUse`] naming the process that serves it already, [`ErrorKind::Other`] for invalid modes,
    /// [`ErrorKind::VersionMismatch`] when the daemon runs with another version, else as [`Bus::open`].
    pub fn offer(place: &Place, about: &About, modes: &[Mode]) -> Result<Self> {
        let in_camera = |e: Error| {
            Error::new(e.kind(), format!("camera \"{}\" cannot be offered: {e}", place.camera)).with_source(e)
        };
        check_all(modes).map_err(in_camera)?;
        let records: Vec<ExternalMode> = modes.iter().map(Mode::encode).collect();
        for record in &records {
            Mode::decode(record).map_err(in_camera)?;
        }
        let mut offer = ExternalOffer { modes: modes.len() as u32, ..ExternalOffer::default() };
        about.encode(&mut offer);
        About::decode(&offer).map_err(in_camera)?;
        let records = records.iter().flat_map(plain::bytes_of_mode).collect();
        Self::offer_unchecked(place, modes, offer, records)
    }

    /// Offers unchecked content, for tests of the other side.
    #[doc(hidden)]
    pub fn offer_unchecked(
        place: &Place,
        modes: &[Mode],
        mut offer: ExternalOffer,
        records: Vec<u8>,
    ) -> Result<Self> {
        let pid = std::process::id();
        offer.instance = (HostTime::now().ns() as u64) << 16 | u64::from(pid & 0xFFFF) | 1;
        offer.pid = pid;
        let who = format!("process {pid} ({})", text::shown(&offer.program));
        let lock = lock_camera(&place.runtime, &place.rig, &place.camera, &who)?;
        let bus = Bus::open(&place.runtime, &place.rig)?;
        bus.clean_dead();
        let offers = place.offers();
        let answers = place.answers();
        let sender =
            OfferSender { out: offers.outlet(bus.node(), records.len(), OFFER_SLOTS)?, offer, records };
        let shared = Arc::new(Shared {
            modes: modes.to_vec(),
            instance: offer.instance,
            bell: offers.notifier(bus.node())?,
            offers: Mutex::new(sender),
            wanted: Mutex::default(),
            changed: Condvar::new(),
            end: AtomicBool::new(false),
        });
        let inlet = answers.inlet(bus.node(), true)?;
        let listener = answers.listener(bus.node())?;
        shared.say()?;
        let theirs = Arc::clone(&shared);
        let thread = std::thread::Builder::new()
            .name("heartbeat".to_owned())
            .spawn(move || theirs.beat(&inlet, &listener))
            .map_err(|e| Error::new(ErrorKind::Other, "no thread for the heart-beat").with_source(e))?;
        Ok(Self { shared, place: place.clone(), bus, taken: 0, thread: Some(thread), _lock: lock })
    }

    /// The modes that are offered, in their order.
    pub fn modes(&self) -> &[Mode] {
        &self.shared.modes
    }

    /// Reports that the camera is unavailable, and why: it is unplugged, or another process holds it. The process
    /// stays.
    ///
    /// # Errors
    /// [`ErrorKind::Other`] when the message cannot be sent.
    pub fn unavailable(&mut self, reason: ExternalReason, why: &str) -> Result<()> {
        self.shared.stand(0, ExternalState::Refused, reason, why)
    }

    /// Reports that the camera is available again.
    ///
    /// # Errors
    /// As [`Self::unavailable`].
    pub fn available(&mut self) -> Result<()> {
        self.shared.stand(0, ExternalState::Idle, ExternalReason::None, "")
    }

    /// Ends the camera and reports why.
    pub fn end(self, reason: ExternalReason, why: &str) {
        self.shared.last_words(reason, why);
    }
}

impl Drop for ExternalCamera {
    fn drop(&mut self) {
        self.shared.end.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
        self.shared.last_words(ExternalReason::None, "the process let go of the camera");
    }
}

impl Shared {
    pub(super) fn wanted(&self) -> MutexGuard<'_, Wanted> {
        lock(&self.wanted)
    }

    /// Whether the daemon still wants frames of `session`.
    pub(super) fn wants(&self, session: u64) -> bool {
        let wanted = self.wanted();
        wanted.session == session && !wanted.modes.is_empty()
    }

    /// Why the daemon refused `session`, if it did.
    pub(super) fn refusal(&self, session: u64) -> Option<String> {
        let wanted = self.wanted();
        wanted.refusal.clone().filter(|_| wanted.session == session)
    }

    /// Waits until the daemon ends `session`; returns whether it did.
    pub(super) fn wait_for_stop(&self, session: u64, timeout: Duration) -> bool {
        let deadline = HostTime::now().plus(timeout);
        let mut wanted = self.wanted();
        loop {
            // A daemon that is gone sends nothing and wants nothing.
            if wanted.session == session && wanted.modes.is_empty() && wanted.heard.is_some() {
                return wanted.refusal.is_none();
            }
            let left = deadline.from_now();
            if left.is_zero() {
                return false;
            }
            let waited = self.changed.wait_timeout(wanted, left);
            wanted = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// Sends the process's new state.
    pub(super) fn stand(
        &self,
        session: u64,
        state: ExternalState,
        reason: ExternalReason,
        why: &str,
    ) -> Result<()> {
        {
            let mut sender = lock(&self.offers);
            if sender.offer.state == ExternalState::Ended as u32 {
                return Ok(());
            }
            let offer = &mut sender.offer;
            (offer.session, offer.state, offer.reason) = (session, state as u32, reason as u32);
            text::set(&mut offer.text, why);
        }
        self.say()
    }

    fn last_words(&self, reason: ExternalReason, why: &str) {
        if let Err(e) = self.stand(0, ExternalState::Ended, reason, why) {
            tracing::debug!(error = %e, "the last message could not be sent");
        }
    }

    /// Sends the offer as it is now.
    fn say(&self) -> Result<()> {
        let mut sender = lock(&self.offers);
        let mut loan = sender.out.loan(sender.records.len())?;
        channel::bytes_mut(&mut loan).copy_from_slice(&sender.records);
        sender.offer.number += 1;
        sender.offer.sent_ns = HostTime::now().ns();
        *loan.user_header_mut() = sender.offer;
        sender.out.send(loan)?;
        channel::ring(&self.bell, sender.out.what());
        Ok(())
    }

    /// Heartbeat thread: sends the offer and reads the daemon's answers.
    fn beat(&self, inlet: &Inlet<ExternalAnswer>, listener: &Listener<IoxService>) {
        let mut due = HostTime::now().plus(HEARTBEAT);
        while !self.end.load(Ordering::Relaxed) {
            if let Err(e) = channel::sleep(listener, due.from_now().min(LOOK), "the daemon's answers") {
                tracing::debug!(error = %e, "cannot wait");
                std::thread::sleep(LOOK);
            }
            self.hear(inlet);
            if due.from_now().is_zero() {
                due = HostTime::now().plus(HEARTBEAT);
                if let Err(e) = self.say() {
                    tracing::warn!(error = %e, "no heart-beat could be sent");
                }
            }
        }
    }

    /// Reads the daemon's answers since the last call.
    fn hear(&self, inlet: &Inlet<ExternalAnswer>) {
        let mut newest: Option<Wanted> = None;
        // No more than that at a time: a flooded channel must not delay the heartbeat.
        for _ in 0..MOST_AT_A_TIME {
            match inlet.try_receive() {
                Ok(Some(sample)) => {
                    let said = Wanted::decode(
                        sample.user_header(),
                        sample.payload(),
                        self.instance,
                        self.modes.len(),
                    );
                    if let Some(wanted) = said {
                        newest = Some(wanted);
                    }
                }
                Ok(None) => break,
                Err(e) => {
                    tracing::debug!(error = %e, "an answer cannot be read");
                    break;
                }
            }
        }
        let mut wanted = self.wanted();
        // If two answer, such as an abandoned thread of the daemon, the later session counts.
        if let Some(newest) = newest.filter(|n| n.session == 0 || n.session >= wanted.session) {
            let changed = (wanted.session, &wanted.modes, &wanted.refusal)
                != (newest.session, &newest.modes, &newest.refusal);
            *wanted = newest;
            if changed {
                self.changed.notify_all();
            }
        } else if wanted.heard.is_some_and(|t| t.elapsed() > SILENCE) {
            // The daemon is gone. A session is never resumed, so its request is cleared.
            wanted.modes.clear();
            wanted.heard = None;
            self.changed.notify_all();
        }
    }
}

impl Wanted {
    /// Decodes an answer with arbitrary content, if it is addressed to start `instance` of a process with so many
    /// modes.
    pub(super) fn decode(
        answer: &ExternalAnswer,
        payload: &[u8],
        instance: u64,
        modes: usize,
    ) -> Option<Self> {
        let answer = *answer; // a copy, which the daemon cannot change any more
        let mut wanted = Self { heard: Some(HostTime::now()), ..Self::default() };
        if answer.magic != super::ANSWER_MAGIC || answer.instance != instance {
            return None;
        }
        if answer.version != VERSION || usize::from(answer.size) != size_of::<ExternalAnswer>() {
            let why = format!(
                "it speaks version {} of the hand-shake ({} bytes), this program version {VERSION} ({} bytes)",
                answer.version,
                answer.size,
                size_of::<ExternalAnswer>()
            );
            return Some(Self { refusal: Some(why), ..wanted });
        }
        // An old answer must not stop the current session.
        if HostTime::from_ns(answer.sent_ns).elapsed() > SILENCE {
            return None;
        }
        let Some(want) = ExternalWant::from_code(answer.want) else {
            let why = format!("it wants {}, which this program does not know", answer.want);
            return Some(Self { refusal: Some(why), ..wanted });
        };
        let counted = (payload.len(), answer.modes as usize) == (modes, modes);
        if want == ExternalWant::Run && !counted {
            let says = answer.modes;
            let bytes = payload.len();
            let why = format!("it answers for {says} modes in {bytes} bytes, and this camera has {modes}");
            return Some(Self { refusal: Some(why), ..wanted });
        }
        wanted.session = answer.session;
        match want {
            ExternalWant::Stop => {}
            ExternalWant::Refused => wanted.refusal = Some(text::shown(&answer.text)),
            ExternalWant::Run => {
                wanted.modes = payload
                    .iter()
                    .take(MAX_MODES)
                    .enumerate()
                    .filter(|(_, f)| **f == 1)
                    .map(|(i, _)| i)
                    .collect();
            }
        }
        Some(wanted)
    }
}

/// The error for a mode that the session does not run.
pub(super) fn no_such_mode(mode: usize) -> Error {
    invalid(&format!("mode {mode} is not one that the session runs"))
}

#[cfg(test)]
mod tests;
