//! The daemon's side: reads the process's messages and frames, and answers them.

use super::mode::{check_all, check_count, invalid};
use super::{
    About, ExternalAnswer, ExternalFrame, ExternalOffer, ExternalReason, ExternalState, ExternalWant,
    MODE_BYTES, Mode, OFFER_MAGIC, Place, TEXT_BYTES, VERSION, plain,
};
use crate::channel::{self, Inlet, IoxService, Outlet, Received};
use crate::text;
use crate::{Bus, Error, ErrorKind, HostTime, Result, StreamName};
use core::time::Duration;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;

/// Slots of the answers.
const ANSWER_SLOTS: usize = 24;
/// Messages that are read at a time; the channel keeps no more.
const MOST_AT_A_TIME: usize = 64;

/// The daemon's end of the hand-shake with the process that serves a camera.
#[derive(Debug)]
pub struct ExternalLink {
    offers: Inlet<ExternalOffer>,
    bell: Listener<IoxService>,
    out: Outlet<ExternalAnswer>,
    notifier: Notifier<IoxService>,
    number: u64,
    place: Place,
    bus: Bus,
}

/// State and times of a process's last message.
#[derive(Debug, Clone, Copy)]
pub struct Beat {
    /// Identifies this start of the process.
    pub instance: u64,
    /// Number of the message.
    pub number: u64,
    /// The session that the state is about.
    pub session: u64,
    /// State of the process; `None` for a state of a later version.
    pub state: Option<ExternalState>,
    /// Reason of a refusal or an end.
    pub reason: ExternalReason,
    /// Process number.
    pub pid: u32,
    /// When it was sent; at most the current time.
    pub sent: HostTime,
    text: [u8; TEXT_BYTES],
}

impl Beat {
    /// The reason in words; bytes that are not text are left out.
    pub fn text(&self) -> String {
        text::shown(&self.text)
    }

    fn of(offer: &ExternalOffer) -> Self {
        Self {
            instance: offer.instance,
            number: offer.number,
            session: offer.session,
            state: ExternalState::from_code(offer.state),
            reason: ExternalReason::from_code(offer.reason).unwrap_or(ExternalReason::None),
            pid: offer.pid,
            sent: HostTime::from_ns(offer.sent_ns).min(HostTime::now()),
            text: offer.text,
        }
    }
}

/// A process's offer.
#[derive(Debug, Clone, PartialEq)]
pub struct Offer {
    /// Description of the camera.
    pub about: About,
    /// The modes, in the order that answers refer to.
    pub modes: Vec<Mode>,
}

impl Offer {
    /// Decodes an offer from a header and payload with arbitrary content.
    ///
    /// # Errors
    /// As [`OfferMessage::offer`].
    pub fn decode(header: &ExternalOffer, payload: &[u8]) -> Result<Self> {
        let header = *header; // a copy, which the process cannot change any more
        if header.magic != OFFER_MAGIC {
            return Err(invalid("its offer does not begin as one does"));
        }
        if header.version != VERSION || usize::from(header.size) != size_of::<ExternalOffer>() {
            return Err(Error::new(
                ErrorKind::VersionMismatch,
                format!(
                    "it speaks version {} of the hand-shake ({} bytes), this daemon version {VERSION} ({} bytes)",
                    header.version,
                    header.size,
                    size_of::<ExternalOffer>()
                ),
            ));
        }
        let (records, rest) = payload.as_chunks::<MODE_BYTES>();
        // Checked before decoding: the payload may be as large as the computer's memory.
        check_count(header.modes as usize)?;
        if records.len() != header.modes as usize || !rest.is_empty() {
            let n = header.modes;
            let bytes = payload.len();
            return Err(invalid(&format!(
                "it says {n} modes of {MODE_BYTES} bytes, and sends {bytes} bytes"
            )));
        }
        if header.instance == 0 {
            return Err(invalid("its field `instance` is 0"));
        }
        let about = About::decode(&header)?;
        let modes = records.iter().map(|r| Mode::decode(&plain::mode_of(r))).collect::<Result<Vec<_>>>()?;
        check_all(&modes)?;
        Ok(Self { about, modes })
    }
}

/// A message of the process: its state, and the offer still to be decoded.
#[derive(Debug)]
pub struct OfferMessage {
    /// State and times of the process.
    pub beat: Beat,
    sample: Received<ExternalOffer>,
}

impl OfferMessage {
    /// Decodes and checks the offer.
    ///
    /// # Errors
    /// [`ErrorKind::VersionMismatch`] naming both versions, [`ErrorKind::Other`] naming the invalid part.
    pub fn offer(&self) -> Result<Offer> {
        Offer::decode(self.sample.user_header(), self.sample.payload())
    }
}

/// The daemon's answer to a process.
#[derive(Debug, Clone, Copy)]
pub struct Answer<'a> {
    /// The start of the process that it is addressed to.
    pub instance: u64,
    /// The session.
    pub session: u64,
    /// The request.
    pub want: ExternalWant,
    /// Reason of a refusal.
    pub reason: ExternalReason,
    /// The reason in words.
    pub text: &'a str,
    /// One byte for each mode of the offer: 1 to run it.
    pub modes: &'a [u8],
}

impl ExternalLink {
    /// Joins the hand-shake of the camera at `place`, whether or not a process serves it yet.
    ///
    /// # Errors
    /// [`ErrorKind::VersionMismatch`] when a process of another version has the channels open, else as
    /// [`Bus::subscriber`].
    pub fn open(place: &Place) -> Result<Self> {
        let bus = Bus::open(&place.runtime, &place.rig)?;
        let offers = place.offers();
        let answers = place.answers();
        Ok(Self {
            offers: offers.inlet(bus.node(), true)?,
            bell: offers.listener(bus.node())?,
            out: answers.outlet(bus.node(), super::MAX_MODES, ANSWER_SLOTS)?,
            notifier: answers.notifier(bus.node())?,
            number: 0,
            place: place.clone(),
            bus,
        })
    }

    /// The newest message of the process since the last call among those that `wanted` accepts; others are skipped.
    ///
    /// # Errors
    /// [`ErrorKind::Other`] when the process's memory cannot be mapped.
    pub fn newest(&self, wanted: impl Fn(&Beat) -> bool) -> Result<Option<OfferMessage>> {
        let mut newest = None;
        for _ in 0..MOST_AT_A_TIME {
            let Some(sample) = self.offers.try_receive()? else { break };
            let beat = Beat::of(sample.user_header());
            if wanted(&beat) {
                newest = Some(OfferMessage { beat, sample });
            }
        }
        Ok(newest)
    }

    /// Waits until the process has sent a message or `timeout` has passed.
    ///
    /// # Errors
    /// [`ErrorKind::Other`] when the event cannot be waited for.
    pub fn sleep(&self, timeout: Duration) -> Result<()> {
        channel::sleep(&self.bell, timeout, "the process's event")
    }

    /// Sends an answer to the process.
    ///
    /// # Errors
    /// [`ErrorKind::NoSpace`] or [`ErrorKind::Other`] when it cannot be sent.
    pub fn answer(&mut self, answer: &Answer<'_>) -> Result<()> {
        let mut loan = self.out.loan(answer.modes.len())?;
        channel::bytes_mut(&mut loan).copy_from_slice(answer.modes);
        self.number += 1;
        let mut header = ExternalAnswer {
            instance: answer.instance,
            number: self.number,
            sent_ns: HostTime::now().ns(),
            session: answer.session,
            want: answer.want as u32,
            reason: answer.reason as u32,
            modes: answer.modes.len() as u32,
            pid: std::process::id(),
            ..ExternalAnswer::default()
        };
        text::set(&mut header.text, answer.text);
        *loan.user_header_mut() = header;
        self.out.send(loan)?;
        channel::ring(&self.notifier, self.out.what());
        Ok(())
    }

    /// The frames of a stream, from now on.
    ///
    /// # Errors
    /// As [`Self::open`].
    pub fn frames(&self, stream: &StreamName) -> Result<FrameInlet> {
        Ok(FrameInlet { inlet: self.place.frames(stream).inlet(self.bus.node(), true)? })
    }

    /// Frees what killed processes left behind.
    pub fn clean_dead(&self) {
        self.bus.clean_dead();
    }
}

/// The frames of one stream as they come from the process.
#[derive(Debug)]
pub struct FrameInlet {
    inlet: Inlet<ExternalFrame>,
}

impl FrameInlet {
    /// The oldest unread frame, if there is one.
    ///
    /// # Errors
    /// [`ErrorKind::Other`] when the process's memory cannot be mapped.
    pub fn try_next(&self) -> Result<Option<SentFrame>> {
        Ok(self.inlet.try_receive()?.map(|sample| SentFrame { header: *sample.user_header(), sample }))
    }
}

/// A frame in the process's memory. Nothing of it is checked.
#[derive(Debug)]
pub struct SentFrame {
    header: ExternalFrame,
    sample: Received<ExternalFrame>,
}

impl SentFrame {
    /// The header, copied when the frame was read; the process can no longer change it.
    pub const fn header(&self) -> &ExternalFrame {
        &self.header
    }

    /// Its pixels. The process could still write to them.
    pub fn pixels(&self) -> &[u8] {
        self.sample.payload()
    }
}
