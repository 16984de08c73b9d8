//! Live frames of another computer on the bus of this one.
//!
//! A subscriber here reads such a stream as any other: same channel, same header, times on the clock of the session, which is this computer's. One
//! thread asks for a stream, and one on the other computer answers, over a connection of the control socket that has become theirs
//! (`GET /v1/frames/CAMERA/STREAM`):
//!
//! ```text
//! ask     1 byte: how the next frame shall come, as it is or small
//! answer  8 bytes: what it is, its coding, two zeros, bytes of the image (u32, little-endian)
//!         of a frame: its header as it lies in shared memory, and the image
//! ```
//!
//! **Newest wins.** Nothing is sent that was not asked for, and an answer has the newest frame there is. So a way that is too slow loses frames
//! and is never late by more than one; neither side queues, and a peer that stalls costs the other one slot of shared memory. What was
//! left out is counted in the header as [`depthrig_bus::DropReason::QueueFull`].

mod answer;
mod ask;
mod connect;
mod numbers;
mod pace;

pub(crate) use answer::{Answering, answer};
pub(crate) use ask::Mirror;
use depthrig_recorder::transit::Coding;
use std::io;

/// The protocol's name in the HTTP header `upgrade`.
pub(crate) const PROTOCOL: &str = "depthrig-frames/1";
/// Bytes before the header of a frame.
const HEAD_BYTES: usize = 8;

/// A question for the next frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Ask {
    /// As it lies in shared memory.
    Raw,
    /// In its smaller coding.
    Small,
}

impl Ask {
    const fn byte(self) -> u8 {
        match self {
            Self::Raw => 0,
            Self::Small => 1,
        }
    }

    fn from_byte(byte: u8) -> io::Result<Self> {
        match byte {
            0 => Ok(Self::Raw),
            1 => Ok(Self::Small),
            _ => Err(garbled("the question", byte)),
        }
    }
}

/// The beginning of an answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Head {
    /// A frame follows, whose image has so many bytes.
    Frame(Coding, u32),
    /// No new frame came for some tenths of a second.
    Quiet,
    /// Nobody publishes the stream.
    Absent,
    /// The clock of the session is not known there.
    NoClock,
}

impl Head {
    /// Why no frame follows.
    const fn why(self) -> &'static str {
        match self {
            Self::Frame(..) => "a frame follows",
            Self::Quiet => "its camera sends no frames there",
            Self::Absent => "nobody publishes it there",
            Self::NoClock => "the clock of the session is not known there yet",
        }
    }

    fn bytes(self) -> [u8; HEAD_BYTES] {
        let mut bytes = [0; HEAD_BYTES];
        bytes[0] = match self {
            Self::Frame(..) => 1,
            Self::Quiet => 2,
            Self::Absent => 3,
            Self::NoClock => 4,
        };
        if let Self::Frame(coding, len) = self {
            bytes[1] = coding as u8;
            bytes[4..].copy_from_slice(&len.to_le_bytes());
        }
        bytes
    }

    fn from_bytes(bytes: [u8; HEAD_BYTES]) -> io::Result<Self> {
        let [kind, coding, _, _, len @ ..] = bytes;
        match kind {
            1 => {
                let coding = Coding::from_code(coding).ok_or_else(|| garbled("a coding", coding))?;
                Ok(Self::Frame(coding, u32::from_le_bytes(len)))
            }
            2 => Ok(Self::Quiet),
            3 => Ok(Self::Absent),
            4 => Ok(Self::NoClock),
            _ => Err(garbled("an answer", kind)),
        }
    }
}

fn garbled(what: &str, byte: u8) -> io::Error {
    let what = format!(
        "{what} is {byte}, which {PROTOCOL} does not have; run the same version of depthrig on both computers"
    );
    io::Error::new(io::ErrorKind::InvalidData, what)
}

#[cfg(test)]
mod tests;

#[cfg(test)]
mod bytes {
    use super::*;

    #[test]
    fn what_was_said_is_heard() {
        for ask in [Ask::Raw, Ask::Small] {
            assert_eq!(Ask::from_byte(ask.byte()).unwrap(), ask);
        }
        let frames = Coding::ALL.map(|coding| Head::Frame(coding, 0x0102_0304));
        for head in frames.into_iter().chain([Head::Quiet, Head::Absent, Head::NoClock]) {
            assert_eq!(Head::from_bytes(head.bytes()).unwrap(), head);
        }
        assert!(Ask::from_byte(2).is_err());
        assert!(Head::from_bytes([0; 8]).is_err() && Head::from_bytes([1, 9, 0, 0, 0, 0, 0, 0]).is_err());
    }
}
