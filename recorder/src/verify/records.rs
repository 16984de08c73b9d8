//! The records of a segment in the order of the file, read in large pieces into one buffer that is used again.

use crate::container::scan::{HEAD, RECORD_MAX, SegmentReader};
use crate::{ErrorKind, Result};

/// Bytes read at a time: few calls, and what was read is still in the processor's cache for the checksum.
const WINDOW: usize = 1 << 20;

/// A reader of records from one place on.
pub(super) struct Records<'a> {
    reader: &'a SegmentReader,
    buf: Vec<u8>,
    /// `buf[start..end]` was read and not yet consumed.
    start: usize,
    end: usize,
    /// Where `buf[start]` lies in the file.
    pub(super) offset: u64,
}

/// A record, and what follows it as far as it was asked for.
pub(super) struct Raw<'a> {
    pub(super) opcode: u8,
    /// Opcode, length and fields.
    pub(super) whole: &'a [u8],
    /// The bytes after it: as many as [`PEEK`], fewer at the end of the file.
    pub(super) after: &'a [u8],
}

impl Raw<'_> {
    pub(super) fn body(&self) -> &[u8] {
        &self.whole[HEAD as usize..]
    }
}

/// A message index of one message, and the opcode of the record after it.
pub(super) const PEEK: usize = HEAD as usize + 22 + 1;

impl<'a> Records<'a> {
    pub(super) fn new(reader: &'a SegmentReader, offset: u64) -> Self {
        Self { reader, buf: Vec::new(), start: 0, end: 0, offset }
    }

    /// The record at the present place; `None` at the end of the file.
    ///
    /// # Errors
    /// [`ErrorKind::Truncated`] when the file ends in it, [`ErrorKind::Io`].
    pub(super) fn record(&mut self) -> Result<Option<Raw<'_>>> {
        if self.offset >= self.reader.size {
            return Ok(None);
        }
        let head = HEAD as usize;
        let there = self.fill(head)?;
        let len = match self.buf[self.start..self.start + there.min(head)].split_first_chunk::<9>() {
            Some((h, _)) => h[1..].iter().rev().fold(0, |v, b| v << 8 | u64::from(*b)),
            None => return Err(self.cut(HEAD)),
        };
        if len > RECORD_MAX || self.offset + HEAD + len > self.reader.size {
            return Err(self.cut(len));
        }
        let whole = head + len as usize;
        let there = self.fill(whole + PEEK)?;
        let bytes = &self.buf[self.start..self.start + there.min(whole + PEEK)];
        let (whole, after) = bytes.split_at(whole);
        Ok(Some(Raw { opcode: whole[0], whole, after }))
    }

    /// Advances by `len` bytes that were delivered.
    pub(super) fn advance(&mut self, len: usize) {
        self.start += len;
        self.offset += len as u64;
    }

    fn cut(&self, len: u64) -> crate::Error {
        let size = self.reader.size;
        let what = format!("{len} bytes are wanted, the file ends at byte {size}");
        self.reader.error(ErrorKind::Truncated, self.offset, what)
    }

    /// Fills the buffer with `want` bytes, or all up to the end of the file; returns how many there are.
    fn fill(&mut self, want: usize) -> Result<usize> {
        let there = self.end - self.start;
        let left = self.reader.size - self.offset - there as u64;
        if there >= want || left == 0 {
            return Ok(there);
        }
        self.buf.copy_within(self.start..self.end, 0);
        self.start = 0;
        self.end = there;
        // Not more than the file has: a short file should not cost a window.
        let room = want.max(WINDOW).min(there.saturating_add(usize::try_from(left).unwrap_or(usize::MAX)));
        if self.buf.len() < room {
            self.buf.resize(room, 0);
        }
        let n = ((self.buf.len() - there) as u64).min(left) as usize;
        self.reader.read_at(&mut self.buf[there..there + n], self.offset + there as u64)?;
        self.end = there + n;
        Ok(self.end)
    }
}
