//! The records of a metadata node of the kernel: its own stamp of 10 bytes before each payload header.
//!
//! Layout: the public description of `V4L2_META_FMT_UVC` in the kernel's documentation.

use super::{PTS, SCR};
use depthrig_driver::bytes::{u8_at, u16_at, u64_at};

/// Bytes before the payload header: 64 bits of time, 16 bits of bus frame.
const STAMP: usize = 10;

/// The part of a payload header that the kernel keeps.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RecordFormat {
    /// `UVCH`: its standard part. Its first byte is the length that the camera sent all the same.
    Standard,
    /// `D4XX`: all of it.
    Whole,
}

/// One record.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Record<'a> {
    /// The host's clock when the kernel saw the header, nanoseconds; normally of `CLOCK_MONOTONIC`.
    pub system_ns: u64,
    /// The bus frame at that moment, 16 bits.
    pub host_sof: u16,
    /// The payload header, as much of it as is there.
    pub header: &'a [u8],
}

/// Walks the records of a buffer until it ends or one does not fit.
pub fn records(mut buffer: &[u8], format: RecordFormat) -> impl Iterator<Item = Record<'_>> {
    core::iter::from_fn(move || {
        let rest = buffer.get(STAMP..)?;
        let length = u8_at(rest, 0)?;
        let flags = u8_at(rest, 1)?;
        let standard = 2 + if flags & PTS != 0 { 4 } else { 0 } + if flags & SCR != 0 { 6 } else { 0 };
        let size = match format {
            RecordFormat::Standard => standard,
            RecordFormat::Whole => usize::from(length),
        };
        let header = rest.get(..size).filter(|h| h.len() >= standard)?;
        let record = Record { system_ns: u64_at(buffer, 0)?, host_sof: u16_at(buffer, 8)?, header };
        buffer = rest.get(size..)?;
        Some(record)
    })
}

/// The bytes of a record, for tests.
pub fn build_record(system_ns: u64, host_sof: u16, header: &[u8]) -> Vec<u8> {
    [&system_ns.to_le_bytes()[..], &host_sof.to_le_bytes(), header].concat()
}
