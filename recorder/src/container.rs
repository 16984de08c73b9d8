//! The MCAP container, written append only.
//!
//! Why not the `mcap` crate's writer: chunks are packed by the encode workers, in parallel, and appended as
//! they are; after a failed write the file is cut back to its last whole set and still gets its index; and
//! nothing seeks. The crate's writer does neither (after an error it refuses everything, index included).
//! Reading uses the crate's record parser, and the tests read every file with the crate as well.
//!
//! <https://mcap.dev/spec>

pub(crate) mod chunk;
pub(crate) mod copy;
pub(crate) mod pool;
pub(crate) mod record;
pub(crate) mod scan;
pub(crate) mod segment;

/// The first and last eight bytes of a file.
pub(crate) const MAGIC: [u8; 8] = *b"\x89MCAP0\r\n";
