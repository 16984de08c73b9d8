//! The header of a sample: a contract with every other process, as that of a frame is.
//!
//! A field is never moved or given another meaning within one [`SIGNAL_VERSION`]; new fields take space from `reserved`.
//! Every field lies at a multiple of its size, so nothing is padded implicitly.

use crate::Field;
use core::mem::offset_of;
use iceoryx2::prelude::ZeroCopySend;

/// The version of the header's layout.
pub const SIGNAL_VERSION: u16 = 1;
/// Bytes of a [`SignalHeader`]. The payload follows at once, at a multiple of 8.
pub const SIGNAL_HEADER_SIZE: usize = 128;
/// First bytes of a [`SignalHeader`].
pub const SIGNAL_MAGIC: [u8; 4] = *b"DRSG";

/// The header of one sample of a signal. The payload is the description as JSON, zeros up to a multiple of 8 bytes, and
/// the values.
///
/// Times are nanoseconds on the host's `CLOCK_MONOTONIC` (see [`crate::clock`]).
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, ZeroCopySend)]
#[type_name("depthrig.SignalHeader.v1")]
pub struct SignalHeader {
    /// The bytes `DRSG`.
    pub magic: [u8; 4],
    /// [`SIGNAL_VERSION`].
    pub version: u16,
    /// [`SIGNAL_HEADER_SIZE`].
    pub size: u16,
    /// Number of this sample of its publisher: 1, 2, 3, … A gap is samples that did not reach this subscriber.
    pub sequence: u64,
    /// Identifies one publisher's life: when it began, so that a later one of the signal has a larger one. Never 0.
    pub session: u64,
    /// When the values were measured, or took effect. Rises with every sample of a session.
    pub time_ns: i64,
    /// When the sample was published.
    pub publish_time_ns: i64,
    /// `time_ns` is right within this much, nanoseconds; 0 when the publisher states none.
    pub uncertainty_ns: u64,
    /// FNV-1a (64 bits) of the description's JSON.
    pub description_hash: u64,
    /// Bytes of the description's JSON, without the zeros behind it.
    pub description_len: u32,
    /// Bytes of the payload: description, zeros, and values.
    pub payload_len: u32,
    /// [`SignalFlags`] bits.
    pub flags: u32,
    /// Zero.
    pub reserved_word: u32,
    /// Zero; space for later fields of this version.
    pub reserved: [u64; 7],
}

const _: () = assert!(size_of::<SignalHeader>() == SIGNAL_HEADER_SIZE && align_of::<SignalHeader>() == 8);

impl Default for SignalHeader {
    fn default() -> Self {
        Self {
            magic: SIGNAL_MAGIC,
            version: SIGNAL_VERSION,
            size: SIGNAL_HEADER_SIZE as u16,
            sequence: 0,
            session: 0,
            time_ns: 0,
            publish_time_ns: 0,
            uncertainty_ns: 0,
            description_hash: 0,
            description_len: 0,
            payload_len: 0,
            flags: 0,
            reserved_word: 0,
            reserved: [0; 7],
        }
    }
}

impl SignalHeader {
    /// Whether this is a header of the version that this build speaks.
    pub fn is_valid(&self) -> bool {
        self.magic == SIGNAL_MAGIC
            && self.version == SIGNAL_VERSION
            && self.size as usize == SIGNAL_HEADER_SIZE
    }

    /// Whether all bits of `flag` are set.
    pub const fn has(&self, flag: SignalFlags) -> bool {
        SignalFlags(self.flags).has(flag)
    }
}

/// Facts about a sample, one bit each.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SignalFlags(pub u32);

impl SignalFlags {
    /// Published by a replay; the time is that of the recording.
    pub const REPLAYED: Self = Self(1);
    /// The time may be wrong by more than its uncertainty.
    pub const TIME_UNCERTAIN: Self = Self(1 << 1);
    /// Nobody stated when the values were measured: the time is that of publishing.
    pub const PUBLISH_TIME: Self = Self(1 << 2);
    /// Computed by a reader between two samples; no sample on a channel has it.
    pub const INTERPOLATED: Self = Self(1 << 3);

    /// Every flag with its name.
    pub const ALL: [(&'static str, Self); 4] = [
        ("replayed", Self::REPLAYED),
        ("time_uncertain", Self::TIME_UNCERTAIN),
        ("publish_time", Self::PUBLISH_TIME),
        ("interpolated", Self::INTERPOLATED),
    ];

    /// Whether all bits of `flag` are set.
    pub const fn has(self, flag: Self) -> bool {
        self.0 & flag.0 == flag.0
    }

    /// Both sets of flags together.
    #[must_use]
    pub const fn with(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }
}

macro_rules! fields {
    ($($name:ident => $kind:literal x $count:expr;)*) => {
        &[$(Field { name: stringify!($name), offset: offset_of!(SignalHeader, $name), kind: $kind, count: $count }),*]
    };
}

/// Every field of [`SignalHeader`] in the order of its bytes, without a gap.
pub const SIGNAL_FIELDS: &[Field] = fields! {
    magic => "u8" x 4;
    version => "u16" x 1;
    size => "u16" x 1;
    sequence => "u64" x 1;
    session => "u64" x 1;
    time_ns => "i64" x 1;
    publish_time_ns => "i64" x 1;
    uncertainty_ns => "u64" x 1;
    description_hash => "u64" x 1;
    description_len => "u32" x 1;
    payload_len => "u32" x 1;
    flags => "u32" x 1;
    reserved_word => "u32" x 1;
    reserved => "u64" x 7;
};

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_cover_every_byte_once_and_never_move() {
        let mut end = 0;
        for f in SIGNAL_FIELDS {
            assert_eq!(f.offset, end, "{} does not follow its predecessor", f.name);
            end += f.bytes();
        }
        assert_eq!(end, SIGNAL_HEADER_SIZE);
        let at = |name: &str| SIGNAL_FIELDS.iter().find(|f| f.name == name).unwrap().offset;
        let seen = ["sequence", "session", "time_ns", "description_hash", "payload_len", "flags", "reserved"];
        assert_eq!(seen.map(at), [8, 16, 24, 48, 60, 64, 72]);
    }

    #[test]
    fn a_header_of_another_version_is_invalid() {
        let header = SignalHeader::default();
        assert!(header.is_valid());
        assert!(!SignalHeader { version: 2, ..header }.is_valid());
        assert!(!SignalHeader { magic: *b"DRFH", ..header }.is_valid());
        assert!(!SignalHeader { size: 120, ..header }.is_valid());
    }
}
