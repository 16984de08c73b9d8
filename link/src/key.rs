//! The key that the computers of a session share, and signatures of the clock's packets by it.

use core::fmt;
use hmac::{Hmac, Mac};
use serde::{Deserialize, Serialize};
use sha2::Sha256;
use std::fs::File;
use std::io::{self, Read};

/// Length of a signature: HMAC-SHA-256 (RFC 2104), of which the first half is kept.
pub const SIGNATURE: usize = 16;

/// A secret of 128 bits. Serialized it is 32 hexadecimal digits.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(into = "String", try_from = "String")]
pub struct Key(u128);

/// Whose packets are believed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Trust {
    /// Everyone's.
    Anyone,
    /// Those signed by a key.
    Key(Key),
    /// Nobody's until a key comes.
    Nobody,
}

impl Key {
    /// A new one.
    ///
    /// # Errors
    /// When the kernel gives no random numbers.
    pub fn random() -> io::Result<Self> {
        let mut bytes = [0; 16];
        File::open("/dev/urandom")?.read_exact(&mut bytes)?;
        Ok(Self(u128::from_le_bytes(bytes)))
    }

    fn signature(&self, message: &[u8]) -> [u8; SIGNATURE] {
        let whole = self.hmac(message).finalize().into_bytes();
        core::array::from_fn(|i| whole[i])
    }

    fn hmac(&self, message: &[u8]) -> Hmac<Sha256> {
        // Of the length of a block, a key is never refused.
        let mut block = [0; 64];
        block[..16].copy_from_slice(&self.0.to_le_bytes());
        let mut hmac = Hmac::<Sha256>::new(&block.into());
        hmac.update(message);
        hmac
    }
}

impl From<Key> for String {
    fn from(key: Key) -> Self {
        format!("{:032x}", key.0)
    }
}

impl TryFrom<String> for Key {
    type Error = &'static str;

    fn try_from(text: String) -> Result<Self, Self::Error> {
        // A number may have a sign, too.
        let is_hex = text.len() == 32 && text.bytes().all(|b| b.is_ascii_hexdigit());
        let number = u128::from_str_radix(&text, 16).ok().filter(|_| is_hex);
        number.map(Self).ok_or("a key has 32 hexadecimal digits")
    }
}

/// Nothing of the secret gets into a log.
impl fmt::Debug for Key {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Key(..)")
    }
}

impl Trust {
    /// The signature of a message; zeros without a key.
    pub(crate) fn sign(&self, message: &[u8]) -> [u8; SIGNATURE] {
        match self {
            Self::Key(key) => key.signature(message),
            Self::Anyone | Self::Nobody => [0; SIGNATURE],
        }
    }

    /// Checks the signature of a message, in a time that does not depend on the bytes of either.
    pub(crate) fn believes(&self, message: &[u8], signature: &[u8]) -> bool {
        match self {
            Self::Anyone => true,
            Self::Nobody => false,
            Self::Key(key) => {
                signature.len() == SIGNATURE && key.hmac(message).verify_truncated_left(signature).is_ok()
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_signature_is_that_of_other_implementations() {
        // printf depthrig | openssl dgst -sha256 -mac HMAC -macopt hexkey:0f0e0d0c0b0a09080706050403020100
        let key = Key::try_from("000102030405060708090a0b0c0d0e0f".to_owned()).unwrap();
        let expected = 0xd7dd_c145_1205_b848_0373_d3eb_2d1f_f24e;
        assert_eq!(u128::from_be_bytes(key.signature(b"depthrig")), expected);
    }

    #[test]
    fn a_key_signs_and_another_does_not() {
        let key = Key::random().unwrap();
        let other = Key::random().unwrap();
        let trust = Trust::Key(key.clone());
        let good = trust.sign(b"a message");
        assert!(trust.believes(b"a message", &good));
        assert!(!trust.believes(b"a massage", &good));
        assert!(!Trust::Key(other).believes(b"a message", &good));
        for bit in 0..8 * SIGNATURE {
            let mut bad = good;
            bad[bit / 8] ^= 1 << (bit % 8);
            assert!(!trust.believes(b"a message", &bad));
        }
        for length in 0..SIGNATURE {
            assert!(!trust.believes(b"a message", &good[..length]));
        }
        assert!(Trust::Anyone.believes(b"a message", &[0; SIGNATURE]));
        assert!(!Trust::Nobody.believes(b"a message", &[0; SIGNATURE]));
    }

    #[test]
    fn a_key_is_written_in_full_or_not_at_all() {
        let key = Key::random().unwrap();
        let text = String::from(key.clone());
        assert_eq!(Key::try_from(text.clone()).unwrap(), key);
        assert!(!format!("{:?}", Trust::Key(key)).contains(&text[..4]));
        for text in [
            "",
            "+00102030405060708090a0b0c0d0e0f",
            "000102030405060708090a0b0c0d0e0",
            "é0102030405060708090a0b0c0d0e0f",
        ] {
            assert!(Key::try_from(text.to_owned()).is_err(), "{text}");
        }
    }
}
