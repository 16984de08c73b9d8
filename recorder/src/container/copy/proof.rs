//! Bytes that a checkpoint, or the checksum of the whole data, vouches for.

use super::{Groups, Role, WINDOW, is_damage};
use crate::container::record::op;
use crate::container::scan::HEAD;
use crate::msgs::frame_set::Checkpoint;
use crate::{ErrorKind, Result};
use mcap::records::Record;

impl Groups<'_> {
    /// Compares the bytes from `from`, before which they have the checksum `crc`, to the next checkpoint with
    /// what that says; `records` is a place after `from` where a record begins.
    pub(super) fn prove(&mut self, from: u64, crc: u32, records: u64) -> Result<()> {
        let Some((to, expected)) = self.next_checkpoint(records)? else { return Ok(()) };
        let mut hasher = crc32fast::Hasher::new_with_initial(crc);
        let mut buf = Vec::new();
        let mut at = from;
        while at < to {
            let len = WINDOW.min(to - at);
            self.reader.read_into(&mut buf, at, len)?;
            hasher.update(&buf);
            at += len;
        }
        if hasher.finalize() == expected {
            self.proven = to;
        }
        Ok(())
    }

    /// Where the next checkpoint (or the end of the data) is, and the checksum of all bytes before it.
    fn next_checkpoint(&self, mut at: u64) -> Result<Option<(u64, u32)>> {
        let mut last_chunk = None;
        while at < self.reader.size {
            let found = self.checkpoint_at(at, &mut last_chunk);
            match found {
                Ok((_, Some(found))) => return Ok(Some(found)),
                Ok((next, None)) => at = next,
                Err(e) if is_damage(&e) => return Ok(None),
                Err(e) => return Err(e),
            }
        }
        Ok(None)
    }

    /// Looks at the record at `at`; where the next begins, and the checkpoint if it is one.
    fn checkpoint_at(&self, at: u64, last_chunk: &mut Option<u64>) -> Result<(u64, Option<(u64, u32)>)> {
        let (opcode, len) = self.reader.record_head(at)?;
        let next = at.saturating_add(HEAD).saturating_add(len);
        match opcode {
            op::CHUNK => *last_chunk = Some(at),
            op::DATA_END => {
                let body = self.reader.read(at + HEAD, len)?;
                if let Record::DataEnd(end) = self.reader.parse(opcode, &body, at)? {
                    let crc = Some(end.data_section_crc).filter(|crc| *crc != 0);
                    return Ok((self.reader.size, crc.map(|crc| (at, crc))));
                }
            }
            op::MESSAGE_INDEX => {
                let id = self.reader.read(at + HEAD, 2)?;
                let role = self.roles.get(&u16::from_le_bytes([id[0], id[1]]));
                let Some(chunk) = last_chunk.filter(|_| role == Some(&Role::Checkpoint)) else {
                    return Ok((next, None));
                };
                let (_, body) = self.reader.record(chunk)?;
                let mut found = None;
                self.reader.chunk_messages(&body, chunk, |m| {
                    if self.roles.get(&m.channel) == Some(&Role::Checkpoint) {
                        let c = Checkpoint::read(m.data)?;
                        found = (c.file_bytes == chunk).then_some((chunk, c.crc32));
                    }
                    Ok(())
                })?;
                return Ok((next, found));
            }
            1..=0x0F => {}
            other => {
                let what = format!("no record of type {other} belongs here");
                return Err(self.reader.error(ErrorKind::Corrupt, at, what));
            }
        }
        Ok((next, None))
    }
}
