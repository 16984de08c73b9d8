//! The channel of frame sets: which frames of all cameras belong to one moment.
//!
//! A set message names frames by stream and sequence number; their pixels are in the streams' own channels.

use crate::channel::{self, Received, Receiver, Sender};
use crate::text;
use crate::{Error, ErrorKind, HostTime, Result, StreamId};
use core::time::Duration;
use iceoryx2::prelude::ZeroCopySend;

/// Streams that one set can have at most.
pub const MAX_MEMBERS: usize = 64;
/// Bytes of one [`MemberRecord`] in the payload of a set message.
pub const RECORD_BYTES: usize = 96;

/// The header of a frame set.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, ZeroCopySend)]
#[type_name("depthrig.SetHeader.v1")]
pub struct SetHeader {
    /// Number of the set: 1, 2, 3, …
    pub set_id: u64,
    /// The moment the set is for, nanoseconds on the host clock.
    pub tick_ns: i64,
    /// Latest minus earliest capture time of its frames, nanoseconds.
    pub spread_ns: i64,
    /// Sets so far that lacked a stream.
    pub incomplete: u64,
    /// Members in the payload, present and missing.
    pub members: u32,
    /// Members that are present.
    pub present: u32,
}

/// One stream's member of a set.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MemberRecord {
    /// The stream.
    pub id: StreamId,
    /// The frame's `sequence` on its channel; `None` when the stream is missing from the set.
    pub sequence: Option<u64>,
    /// Its capture time on the host clock; the tick when missing.
    pub capture_time_ns: i64,
}

impl MemberRecord {
    /// The record's bytes: camera 32, stream 32, sequence 8, capture time 8, present 8, zero 8.
    fn encode(&self, out: &mut [u8]) {
        out.fill(0);
        let mut name = [0; 32];
        text::set(&mut name, self.id.camera.as_str());
        out[..32].copy_from_slice(&name);
        text::set(&mut name, self.id.stream.as_str());
        out[32..64].copy_from_slice(&name);
        out[64..72].copy_from_slice(&self.sequence.unwrap_or(0).to_le_bytes());
        out[72..80].copy_from_slice(&self.capture_time_ns.to_le_bytes());
        out[80..88].copy_from_slice(&u64::from(self.sequence.is_some()).to_le_bytes());
    }

    fn decode(bytes: &[u8]) -> Option<Self> {
        let word = |at: usize| Some(u64::from_le_bytes(bytes.get(at..at + 8)?.try_into().ok()?));
        Some(Self {
            id: StreamId::new(text::valid_part(bytes.get(0..32)?), text::valid_part(bytes.get(32..64)?))
                .ok()?,
            sequence: (word(80)? != 0).then_some(word(64)?),
            capture_time_ns: word(72)? as i64,
        })
    }
}

/// The writing end of a rig's set channel.
#[derive(Debug)]
pub struct SetPublisher {
    sender: Sender<SetHeader>,
}

impl SetPublisher {
    pub(crate) const MAX_BYTES: usize = MAX_MEMBERS * RECORD_BYTES;
    pub(crate) const SLOTS: usize = 64;

    pub(crate) const fn new(sender: Sender<SetHeader>) -> Self {
        Self { sender }
    }

    /// Delivers the last set to late joiners, as [`crate::Publisher::welcome`] does.
    pub fn welcome(&self) {
        self.sender.welcome();
    }

    /// Publishes a set; `members` and `present` of `header` are filled in.
    ///
    /// # Errors
    /// [`ErrorKind::LimitReached`] for more than 64 members, [`ErrorKind::NoSpace`] when subscribers hold
    /// every slot.
    pub fn send(&self, mut header: SetHeader, members: &[MemberRecord]) -> Result<()> {
        let mut loan = self.sender.loan(members.len() * RECORD_BYTES)?;
        for (record, out) in members.iter().zip(channel::bytes_mut(&mut loan).chunks_exact_mut(RECORD_BYTES))
        {
            record.encode(out);
        }
        header.members = members.len() as u32;
        header.present = members.iter().filter(|m| m.sequence.is_some()).count() as u32;
        *loan.user_header_mut() = header;
        self.sender.send(loan)?;
        Ok(())
    }
}

/// The reading end of a rig's set channel.
#[derive(Debug)]
pub struct SetSubscriber {
    receiver: Receiver<SetHeader>,
}

impl SetSubscriber {
    pub(crate) const fn new(receiver: Receiver<SetHeader>) -> Self {
        Self { receiver }
    }

    /// The oldest unread set, waiting up to `timeout` for one.
    ///
    /// # Errors
    /// [`ErrorKind::LimitReached`] when sixteen sets are held already.
    pub fn next_timeout(&mut self, timeout: Duration) -> Result<Option<SetFrame>> {
        let deadline = HostTime::now().plus(timeout);
        loop {
            if let Some(sample) = self.receiver.try_receive()? {
                return Ok(Some(SetFrame { sample }));
            }
            let left = deadline.from_now();
            if left.is_zero() {
                return Ok(None);
            }
            self.receiver.wait(left)?;
        }
    }
}

/// A set in shared memory.
#[derive(Debug)]
pub struct SetFrame {
    sample: Received<SetHeader>,
}

impl SetFrame {
    /// The set's header.
    pub fn header(&self) -> &SetHeader {
        self.sample.user_header()
    }

    /// Its members in the rig's order of streams.
    ///
    /// # Errors
    /// [`ErrorKind::VersionMismatch`] when a record is not what this version writes.
    pub fn members(&self) -> Result<Vec<MemberRecord>> {
        let records = self.sample.payload().chunks_exact(RECORD_BYTES).map(MemberRecord::decode);
        let broken = || Error::new(ErrorKind::VersionMismatch, "a frame set has a record of another version");
        records.map(|r| r.ok_or_else(broken)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn records_round_trip() {
        for sequence in [None, Some(7)] {
            let record =
                MemberRecord { id: StreamId::new("d435", "depth").unwrap(), sequence, capture_time_ns: -5 };
            let mut bytes = [0xFF; RECORD_BYTES];
            record.encode(&mut bytes);
            assert_eq!(MemberRecord::decode(&bytes), Some(record));
        }
        assert_eq!(MemberRecord::decode(&[0xFF; RECORD_BYTES]), None);
    }
}
