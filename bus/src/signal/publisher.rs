//! Publishing a signal.

use super::MAX_AHEAD;
use super::description::SignalDescription;
use super::header::{SignalFlags, SignalHeader};
use super::value::{self, Value};
use crate::channel::{self, Sender};
use crate::{Error, ErrorKind, HostTime, Result};
use std::fs::File;

/// When the values of a sample were measured, and how sure that is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Stamp {
    /// When they were measured.
    pub time: HostTime,
    /// The time is right within this much, nanoseconds; 0 when unknown.
    pub uncertainty_ns: u64,
    /// Facts about the sample. With [`SignalFlags::REPLAYED`] the time is that of a recording, and may be any.
    pub flags: SignalFlags,
}

impl Stamp {
    /// Values that were measured at `time`.
    pub const fn at(time: HostTime) -> Self {
        Self { time, uncertainty_ns: 0, flags: SignalFlags(0) }
    }
}

/// The writing end of a signal, of which there is one at a time. Dropping it frees the signal.
///
/// It never blocks on a subscriber: a slow one loses its oldest unread samples, and sees that in their `sequence`.
#[derive(Debug)]
pub struct SignalPublisher {
    sender: Sender<SignalHeader>,
    description: SignalDescription,
    /// The description and the zeros behind it.
    head: Vec<u8>,
    session: u64,
    sequence: u64,
    last: Option<HostTime>,
    values: Vec<u8>,
    _lock: File,
}

impl SignalPublisher {
    pub(super) fn new(sender: Sender<SignalHeader>, description: &SignalDescription, lock: File) -> Self {
        let mut head = description.json().as_bytes().to_vec();
        head.resize(head.len().next_multiple_of(8), 0);
        Self {
            sender,
            description: description.clone(),
            head,
            session: HostTime::now().ns().max(1) as u64,
            sequence: 0,
            last: None,
            values: Vec::new(),
            _lock: lock,
        }
    }

    /// The signal's description.
    pub const fn description(&self) -> &SignalDescription {
        &self.description
    }

    /// Identifies this publisher in the headers of its samples.
    pub const fn session(&self) -> u64 {
        self.session
    }

    /// Publishes values that are measured now: one for each element of each field, in the order of the fields. Returns the
    /// number of the sample.
    ///
    /// # Errors
    /// [`ErrorKind::Invalid`] when the values do not fit the description; then there is no such sample.
    /// [`ErrorKind::NoSpace`] or [`ErrorKind::Other`] when the sample is lost, which subscribers see as a gap.
    pub fn publish<'v, V: Into<Value<'v>>>(&mut self, values: impl IntoIterator<Item = V>) -> Result<u64> {
        let now = HostTime::now();
        // A stated time may lie ahead of the clock by a little.
        let time = self.last.map_or(now, |last| now.max(last.plus_ns(1)));
        self.send(&Stamp { flags: SignalFlags::PUBLISH_TIME, ..Stamp::at(time) }, values)
    }

    /// Publishes values that were measured at another time than now.
    ///
    /// # Errors
    /// As [`Self::publish`]; also [`ErrorKind::Invalid`] for a time that is not after that of the sample before, or lies
    /// more than [`MAX_AHEAD`] ahead of the clock.
    pub fn publish_at<'v, V: Into<Value<'v>>>(
        &mut self,
        stamp: &Stamp,
        values: impl IntoIterator<Item = V>,
    ) -> Result<u64> {
        if !stamp.flags.has(SignalFlags::REPLAYED) {
            self.check(stamp.time)?;
        }
        self.send(stamp, values)
    }

    fn check(&self, time: HostTime) -> Result<()> {
        let name = self.description.name();
        let invalid = |why: String| Err(Error::new(ErrorKind::Invalid, format!("signal {name}: {why}")));
        if let Some(last) = self.last.filter(|last| time <= *last) {
            let time = time.ns();
            let behind = last.ns();
            return invalid(format!(
                "time {time} ns is not after that of the sample before, {behind} ns; each sample has a later time"
            ));
        }
        let now = HostTime::now();
        if time > now.plus(MAX_AHEAD) {
            let ahead_ms = time.since_ns(now) / 1_000_000;
            let most_ms = MAX_AHEAD.as_millis();
            let time = time.ns();
            return invalid(format!(
                "time {time} ns lies {ahead_ms} ms ahead of the clock, at most {most_ms} ms are possible; times are \
                 nanoseconds on the host's CLOCK_MONOTONIC, not UTC and not those of a device"
            ));
        }
        Ok(())
    }

    fn send<'v, V: Into<Value<'v>>>(
        &mut self,
        stamp: &Stamp,
        values: impl IntoIterator<Item = V>,
    ) -> Result<u64> {
        value::encode(&self.description, values.into_iter().map(Into::into), &mut self.values)?;
        // Counted from here on: a sample that cannot be sent is a gap.
        self.sequence += 1;
        self.last = Some(stamp.time);
        let start = self.head.len();
        let len = start + self.values.len();
        let mut loan = self.sender.loan(len)?;
        let bytes = channel::bytes_mut(&mut loan);
        bytes[..start].copy_from_slice(&self.head);
        bytes[start..].copy_from_slice(&self.values);
        *loan.user_header_mut() = SignalHeader {
            sequence: self.sequence,
            session: self.session,
            time_ns: stamp.time.ns(),
            publish_time_ns: HostTime::now().ns(),
            uncertainty_ns: stamp.uncertainty_ns,
            description_hash: self.description.hash(),
            description_len: self.description.json().len() as u32,
            payload_len: len as u32,
            flags: stamp.flags.0,
            ..SignalHeader::default()
        };
        self.sender.send(loan)?;
        Ok(self.sequence)
    }

    /// Delivers the last sample to subscribers that came since. Publishing does it as well, so only a publisher that
    /// pauses needs it.
    pub fn welcome(&self) {
        self.sender.welcome();
    }
}
