//! Converts records of the hand-shake to bytes and back; each record from another process is checked before use.
#![allow(unsafe_code)] // transmutes between a record and its bytes

use super::ExternalMode;
#[cfg(any(test, feature = "testing"))]
use super::{ExternalAnswer, ExternalFrame, ExternalOffer};

macro_rules! records {
    ($($record:ident: $of_bytes:ident, $bytes_of:ident;)*) => {$(
        #[doc = concat!("The `", stringify!($record), "` of these bytes, whatever they are.")]
        pub const fn $of_bytes(bytes: &[u8; size_of::<$record>()]) -> $record {
            // SAFETY: all fields are integers, floats and arrays of them, for which every bit pattern is a value; the
            // sizes are equal or this would not compile.
            unsafe { core::mem::transmute::<[u8; size_of::<$record>()], $record>(*bytes) }
        }

        #[doc = concat!("The bytes of an `", stringify!($record), "`.")]
        pub const fn $bytes_of(record: &$record) -> [u8; size_of::<$record>()] {
            // SAFETY: the type is `#[repr(C)]` and its fields cover every byte (checked at compile time in `fields`), so
            // no byte is uninitialised padding; the sizes are equal or this would not compile.
            unsafe { core::mem::transmute::<$record, [u8; size_of::<$record>()]>(*record) }
        }
    )*};
}

records! {
    ExternalMode: mode_of, bytes_of_mode;
}

// iceoryx2 carries these as they are; fuzz targets make them from bytes.
#[cfg(any(test, feature = "testing"))]
records! {
    ExternalOffer: offer_of, bytes_of_offer;
    ExternalAnswer: answer_of, bytes_of_answer;
    ExternalFrame: frame_of, bytes_of_frame;
}
