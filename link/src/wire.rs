//! The two packets of the clock, each of 64 bytes, little-endian: an answer is never larger than its question.

/// Length of a packet.
pub const LENGTH: usize = 64;
/// First bytes of a packet: `drclock` and the version.
const MAGIC: [u8; 8] = *b"drclock1";

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

impl Question {
    /// The packet.
    pub fn to_bytes(self) -> [u8; LENGTH] {
        packet(0, self.nonce, [0; 3])
    }

    /// The question in a packet; `None` for other packets.
    pub fn from_bytes(bytes: &[u8]) -> Option<Self> {
        let (nonce, _) = parts(bytes, 0)?;
        Some(Self { nonce })
    }
}

impl Answer {
    /// The packet.
    pub fn to_bytes(self) -> [u8; LENGTH] {
        packet(1, self.nonce, [self.clock.cast_signed(), self.t2, self.t3])
    }

    /// The answer in a packet; `None` for other packets.
    pub fn from_bytes(bytes: &[u8]) -> Option<Self> {
        let (nonce, [clock, t2, t3]) = parts(bytes, 1)?;
        Some(Self { nonce, clock: clock.cast_unsigned(), t2, t3 })
    }
}

fn packet(kind: u8, nonce: [u8; 16], numbers: [i64; 3]) -> [u8; LENGTH] {
    let mut out = [0; LENGTH];
    out[..8].copy_from_slice(&MAGIC);
    out[8] = kind;
    out[16..32].copy_from_slice(&nonce);
    for (to, number) in out[32..56].chunks_exact_mut(8).zip(numbers) {
        to.copy_from_slice(&number.to_le_bytes());
    }
    out
}

fn parts(bytes: &[u8], kind: u8) -> Option<([u8; 16], [i64; 3])> {
    if bytes.len() != LENGTH || !bytes.starts_with(&MAGIC) || bytes[8] != kind {
        return None;
    }
    let nonce = bytes[16..32].try_into().ok()?;
    let mut numbers = [0; 3];
    for (number, from) in numbers.iter_mut().zip(bytes[32..56].chunks_exact(8)) {
        *number = i64::from_le_bytes(from.try_into().ok()?);
    }
    Some((nonce, numbers))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn packets_read_back_and_others_are_none() {
        let question = Question { nonce: *b"0123456789abcdef" };
        let answer = Answer { nonce: question.nonce, clock: u64::MAX, t2: -5, t3: i64::MAX };
        let (asked, answered) = (question.to_bytes(), answer.to_bytes());
        assert_eq!(Question::from_bytes(&asked), Some(question));
        assert_eq!(Answer::from_bytes(&answered), Some(answer));
        assert_eq!(Question::from_bytes(&answered), None);
        assert_eq!(Answer::from_bytes(&asked), None);
        assert_eq!(Answer::from_bytes(&answered[..63]), None);
        assert_eq!(Answer::from_bytes(&[answered.as_slice(), &[0]].concat()), None);
        assert_eq!(Answer::from_bytes(&[]), None);
        let mut other = answered;
        other[7] = b'2';
        assert_eq!(Answer::from_bytes(&other), None);
    }
}
