//! Subscribing to a signal: every sample, in order, with its description.

use super::description::SignalDescription;
use super::header::SignalHeader;
use super::sample::SignalSample;
use crate::channel::Receiver;
use crate::{HostTime, Result};
use core::time::Duration;
use std::sync::Arc;

/// The reading end of a signal.
///
/// Up to 512 unread samples wait for it; older ones are replaced by newer ones and show in [`Self::missed`].
#[derive(Debug)]
pub struct SignalSubscriber {
    receiver: Receiver<SignalHeader>,
    known: Option<Arc<SignalDescription>>,
    session: u64,
    sequence: u64,
    missed: u64,
    restarts: u64,
}

impl SignalSubscriber {
    pub(super) const fn new(receiver: Receiver<SignalHeader>) -> Self {
        Self { receiver, known: None, session: 0, sequence: 0, missed: 0, restarts: 0 }
    }

    /// The oldest unread sample, if there is one. It may be of another publisher than the one before, with another
    /// description; [`Self::restarts`] counts that.
    ///
    /// # Errors
    /// [`crate::ErrorKind::VersionMismatch`] or [`crate::ErrorKind::Invalid`] when the sample cannot be read, which then
    /// counts as missed; the next call goes on behind it.
    pub fn try_next(&mut self) -> Result<Option<SignalSample>> {
        loop {
            let Some(received) = self.receiver.try_receive()? else { return Ok(None) };
            let what = self.receiver.what();
            // One that cannot be read is counted with the next one, as a gap.
            let sample =
                SignalSample::decode(received.user_header(), received.payload(), &mut self.known, what)?;
            if self.count(sample.header()) {
                return Ok(Some(sample));
            }
        }
    }

    /// Counts a sample that was read, and those that were not; false for one to skip.
    fn count(&mut self, header: &SignalHeader) -> bool {
        if header.session < self.session {
            // It comes behind one of the next publisher: a remnant, which would break the order.
            self.missed += 1;
            return false;
        }
        if header.session > self.session {
            if self.session > 0 {
                // A subscriber that was there before gets all of a new publisher.
                self.restarts += 1;
                self.missed += header.sequence.saturating_sub(1);
            }
            self.session = header.session;
        } else {
            self.missed += header.sequence.saturating_sub(self.sequence + 1);
        }
        self.sequence = header.sequence;
        true
    }

    /// The oldest unread sample, waiting up to `timeout` for one; `None` when none came.
    ///
    /// # Errors
    /// As [`Self::try_next`].
    pub fn next_timeout(&mut self, timeout: Duration) -> Result<Option<SignalSample>> {
        let deadline = HostTime::now().plus(timeout);
        loop {
            if let Some(sample) = self.try_next()? {
                return Ok(Some(sample));
            }
            let left = deadline.from_now();
            if left.is_zero() {
                return Ok(None);
            }
            self.receiver.wait(left)?;
        }
    }

    /// Samples that were published but did not reach this subscriber: it was too slow, or their publisher had no memory.
    pub const fn missed(&self) -> u64 {
        self.missed
    }

    /// Number of times that another publisher took over.
    pub const fn restarts(&self) -> u64 {
        self.restarts
    }

    /// Whether the signal has a publisher now. A killed one counts until a process cleans up after it
    /// ([`super::Signals::clean_dead`]).
    pub fn is_live(&self) -> bool {
        self.receiver.has_publisher()
    }

    /// The signal's name for messages.
    pub fn what(&self) -> &str {
        self.receiver.what()
    }
}
