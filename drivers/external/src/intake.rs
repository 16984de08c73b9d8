//! The frames of one stream on their way in: checked against the mode that was announced, counted, copied once.

use super::facts::{Facts, is_header};
use super::rate_limiter::RateLimiter;
use depthrig_bus::external::{ExternalFrame, FrameInlet, SentFrame};
use depthrig_bus::{DropReason, HostTime, PixelFormat, Result};
use depthrig_driver::{FrameSink, Gate, Outcome, StreamProfile};

/// Frames in a row that are not what was announced, after which the session is refused.
pub(super) const STRANGE_IN_A_ROW: u32 = 8;
/// Frames that one look skips at most: those of a session that is over, from a process that does not stop.
const MAX_SKIPPED: u32 = 64;

/// Identifies a session: which start of the process, and its number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct SessionId {
    pub(super) instance: u64,
    pub(super) number: u64,
}

/// One stream.
#[derive(Debug)]
pub(super) struct Intake {
    index: usize,
    inlet: FrameInlet,
    gate: Gate,
    limiter: RateLimiter,
    profile: StreamProfile,
    facts: Facts,
    pending: Option<SentFrame>,
    strange: u32,
    warned: bool,
}

/// Result of one look.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Look {
    /// Nothing was there.
    Empty,
    /// A frame was taken, delivered or dropped.
    Frame,
    /// A frame was not copied because too many come.
    Flood,
}

impl Intake {
    /// Stream number `index` with mode `profile`, whose device counts frames if `has_counter`.
    pub(super) fn new(index: usize, inlet: FrameInlet, profile: &StreamProfile, has_counter: bool) -> Self {
        Self {
            index,
            inlet,
            gate: Gate::new(index, profile),
            limiter: RateLimiter::new(profile.rate_hz),
            profile: profile.clone(),
            facts: Facts::new(profile, has_counter),
            pending: None,
            strange: 0,
            warned: false,
        }
    }

    /// Whether a frame of `session` waits.
    pub(super) fn has_frame(&mut self, session: SessionId) -> Result<bool> {
        if self.pending.is_none() {
            self.pending = self.next(session)?;
        }
        Ok(self.pending.is_some())
    }

    /// How long to leave a flood alone.
    pub(super) fn wait(&self) -> core::time::Duration {
        self.limiter.wait()
    }

    /// Why the frames cannot be used, once there were too many that are not what was announced.
    pub(super) fn verdict(&self) -> Option<String> {
        (self.strange >= STRANGE_IN_A_ROW)
            .then(|| format!("{STRANGE_IN_A_ROW} frames in a row are not {}", self.profile.describe()))
    }

    /// Takes the next frame of `session`, if there is one.
    pub(super) fn take(&mut self, session: SessionId, sink: &mut dyn FrameSink) -> Result<Look> {
        let frame = match self.pending.take() {
            Some(frame) => frame,
            None => match self.next(session)? {
                Some(frame) => frame,
                None => return Ok(Look::Empty),
            },
        };
        let header = *frame.header();
        let now = HostTime::now();
        let raw = self.facts.raw(&header, frame.pixels().len(), now);
        self.gate.explain_gap(self.facts.lost_before(&header), DropReason::QueueFull);
        let takes = self.limiter.takes(now);
        let outcome = self.gate.deliver(&raw, sink, |memory| {
            if !takes {
                return Err(DropReason::QueueFull);
            }
            // The payload was measured above; a process cannot make it shorter any more.
            let pixels = frame.pixels().get(..memory.len()).ok_or(DropReason::WrongSize)?;
            memory.copy_from_slice(pixels);
            Ok(())
        });
        self.judge(&header, frame.pixels().len(), outcome);
        Ok(if takes { Look::Frame } else { Look::Flood })
    }

    /// The next frame of `session`; frames of other sessions are skipped.
    fn next(&mut self, session: SessionId) -> Result<Option<SentFrame>> {
        for _ in 0..MAX_SKIPPED {
            let Some(frame) = self.inlet.try_next()? else { break };
            let header = frame.header();
            if !is_header(header) {
                self.strange = self.strange.saturating_add(1);
                self.warn(|| "the header of a frame has an unsupported version".to_owned());
                return Ok(None);
            }
            let id = SessionId { instance: header.instance, number: header.session };
            if id == session && header.sequence > 0 {
                return Ok(Some(frame));
            }
        }
        Ok(None)
    }

    /// Counts frames that are not what was announced, and says so once.
    fn judge(&mut self, header: &ExternalFrame, sent: usize, outcome: Outcome) {
        let strange = match outcome {
            Outcome::Dropped(DropReason::WrongSize) => true,
            Outcome::Dropped(_) | Outcome::AlreadyCounted => return,
            Outcome::Delivered => false,
        };
        if !strange {
            self.strange = 0;
            return;
        }
        self.strange = self.strange.saturating_add(1);
        let format = PixelFormat::from_code(header.format).map_or("unknown", PixelFormat::name);
        let width = header.width;
        let height = header.height;
        let says = header.payload_len;
        self.warn(|| {
            format!("the process sends {width}x{height} {format}, says {says} bytes and gives {sent}")
        });
    }

    fn warn(&mut self, what: impl FnOnce() -> String) {
        if !core::mem::replace(&mut self.warned, true) {
            let announced = self.profile.describe();
            let bytes = self.profile.frame_bytes();
            tracing::warn!(
                stream = self.index,
                announced,
                bytes,
                "a frame is not what was announced: {}",
                what()
            );
        }
    }
}
