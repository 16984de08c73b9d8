//! The packets of the clock, each of 72 bytes, little-endian: an answer is never larger than its question.

use crate::key::{SIGNATURE, Trust};

/// Length of a packet.
pub const LENGTH: usize = SIGNED + SIGNATURE;
/// The signed part of a packet: all but its signature.
const SIGNED: usize = 56;
/// First bytes of a packet: `drclock` and the version.
const MAGIC: [u8; 8] = *b"drclock2";

/// A question: a number that nobody can guess.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Question {
    /// Returned in the answer.
    pub nonce: [u8; 16],
}

/// An answer to one question.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Answer {
    /// That of the question.
    pub nonce: [u8; 16],
    /// Which clock answers ([`crate::identity`]).
    pub clock: u64,
    /// When the question arrived, nanoseconds of the answering host's `CLOCK_MONOTONIC`.
    pub t2: i64,
    /// When the answer was sent, on the same clock.
    pub t3: i64,
}

/// The answer to a question that is not believed. It is not signed, and means that a key is missing, and nothing else.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Refusal {
    /// That of the question.
    pub nonce: [u8; 16],
}

impl Question {
    /// The packet.
    pub fn to_bytes(self, trust: &Trust) -> [u8; LENGTH] {
        packet(0, self.nonce, [0; 3], trust)
    }

    /// The question in a packet; `None` for other packets.
    pub fn from_bytes(bytes: &[u8]) -> Option<Self> {
        let (nonce, _) = parts(bytes, 0)?;
        Some(Self { nonce })
    }
}

impl Refusal {
    /// The packet.
    pub fn to_bytes(self) -> [u8; LENGTH] {
        packet(2, self.nonce, [0; 3], &Trust::Nobody)
    }

    /// The refusal in a packet; `None` for other packets.
    pub fn from_bytes(bytes: &[u8]) -> Option<Self> {
        let (nonce, _) = parts(bytes, 2)?;
        Some(Self { nonce })
    }
}

impl Answer {
    /// The packet.
    pub fn to_bytes(self, trust: &Trust) -> [u8; LENGTH] {
        packet(1, self.nonce, [self.clock.cast_signed(), self.t2, self.t3], trust)
    }

    /// The answer in a packet; `None` for other packets.
    pub fn from_bytes(bytes: &[u8]) -> Option<Self> {
        let (nonce, [clock, t2, t3]) = parts(bytes, 1)?;
        Some(Self { nonce, clock: clock.cast_unsigned(), t2, t3 })
    }
}

/// Checks the signature of a packet.
pub fn is_trusted(bytes: &[u8], trust: &Trust) -> bool {
    bytes.split_at_checked(SIGNED).is_some_and(|(message, signature)| trust.believes(message, signature))
}

fn packet(kind: u8, nonce: [u8; 16], numbers: [i64; 3], trust: &Trust) -> [u8; LENGTH] {
    let mut out = [0; LENGTH];
    out[..8].copy_from_slice(&MAGIC);
    out[8] = kind;
    out[16..32].copy_from_slice(&nonce);
    for (to, number) in out[32..SIGNED].chunks_exact_mut(8).zip(numbers) {
        to.copy_from_slice(&number.to_le_bytes());
    }
    let signature = trust.sign(&out[..SIGNED]);
    out[SIGNED..].copy_from_slice(&signature);
    out
}

fn parts(bytes: &[u8], kind: u8) -> Option<([u8; 16], [i64; 3])> {
    if bytes.len() != LENGTH || !bytes.starts_with(&MAGIC) || bytes[8] != kind {
        return None;
    }
    let nonce = bytes[16..32].try_into().ok()?;
    let mut numbers = [0; 3];
    for (number, from) in numbers.iter_mut().zip(bytes[32..SIGNED].chunks_exact(8)) {
        *number = i64::from_le_bytes(from.try_into().ok()?);
    }
    Some((nonce, numbers))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::key::Key;

    #[test]
    fn packets_read_back_and_others_are_none() {
        let question = Question { nonce: *b"0123456789abcdef" };
        let answer = Answer { nonce: question.nonce, clock: u64::MAX, t2: -5, t3: i64::MAX };
        let trust = Trust::Key(Key::random().unwrap());
        let (asked, answered) = (question.to_bytes(&trust), answer.to_bytes(&trust));
        let refusal = Refusal { nonce: question.nonce };
        assert_eq!(Refusal::from_bytes(&refusal.to_bytes()), Some(refusal));
        assert_eq!(Refusal::from_bytes(&asked), None);
        assert_eq!(Answer::from_bytes(&refusal.to_bytes()), None);
        assert_eq!(Question::from_bytes(&asked), Some(question));
        assert_eq!(Answer::from_bytes(&answered), Some(answer));
        assert_eq!(Question::from_bytes(&answered), None);
        assert_eq!(Answer::from_bytes(&asked), None);
        assert_eq!(Answer::from_bytes(&answered[..LENGTH - 1]), None);
        assert_eq!(Answer::from_bytes(&[answered.as_slice(), &[0]].concat()), None);
        assert_eq!(Answer::from_bytes(&[]), None);
        let mut other = answered;
        other[7] = b'1';
        assert_eq!(Answer::from_bytes(&other), None);
    }

    #[test]
    fn a_packet_of_which_a_bit_was_changed_is_not_trusted() {
        let trust = Trust::Key(Key::random().unwrap());
        let answer = Answer { nonce: [3; 16], clock: 1, t2: 2, t3: 3 }.to_bytes(&trust);
        assert!(is_trusted(&answer, &trust));
        for bit in 0..8 * LENGTH {
            let mut other = answer;
            other[bit / 8] ^= 1 << (bit % 8);
            assert!(!is_trusted(&other, &trust), "bit {bit}");
        }
        for length in 0..LENGTH {
            assert!(!is_trusted(&answer[..length], &trust), "{length} bytes");
        }
        let unsigned = Question { nonce: [3; 16] }.to_bytes(&Trust::Anyone);
        assert!(is_trusted(&unsigned, &Trust::Anyone) && !is_trusted(&unsigned, &trust));
    }
}
