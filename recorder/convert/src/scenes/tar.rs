//! The part of tar (POSIX.1-1988 ustar) that shards need: plain files with short names.
//!
//! Not the crate `tar` (0.4.44), here and in `depthrig eval`: it takes an archive for complete that was cut between two members
//! or in its end, and pads a header's checksum in another way, while the bytes of shards are promised to stay.

use std::io::{self, Read, Seek, SeekFrom, Write};
use std::path::Path;

const BLOCK: usize = 512;

/// Writes an archive.
#[derive(Debug)]
pub(super) struct Tar<W: Write> {
    out: W,
    bytes: u64,
}

impl<W: Write> Tar<W> {
    pub(super) const fn new(out: W) -> Self {
        Self { out, bytes: 0 }
    }

    /// Adds a file. The archive depends on names and contents alone: owner and time are 0.
    pub(super) fn append(&mut self, name: &str, content: &[u8]) -> io::Result<()> {
        if name.len() >= 100 || content.len() as u64 >= 1 << 33 {
            return Err(io::Error::new(
                io::ErrorKind::InvalidInput,
                format!("{name} does not fit into a tar file"),
            ));
        }
        let mut head = [0u8; BLOCK];
        let mut put = |at: usize, text: &str| head[at..at + text.len()].copy_from_slice(text.as_bytes());
        put(0, name);
        put(100, "0000644\0");
        put(108, "0000000\0");
        put(116, "0000000\0");
        put(124, &format!("{:011o}\0", content.len()));
        put(136, "00000000000\0");
        put(148, "        "); // the checksum counts its own field as spaces
        put(156, "0");
        put(257, "ustar\x0000");
        let sum: u32 = head.iter().map(|b| u32::from(*b)).sum();
        head[148..156].copy_from_slice(format!("{sum:06o}\0 ").as_bytes());
        self.write(&head)?;
        self.write(content)?;
        let rest = content.len().next_multiple_of(BLOCK) - content.len();
        self.write(&[0; BLOCK][..rest])
    }

    /// Ends the archive; its length in bytes.
    pub(super) fn finish(mut self) -> io::Result<u64> {
        self.write(&[0; 2 * BLOCK])?;
        self.out.flush()?;
        Ok(self.bytes)
    }

    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.bytes += bytes.len() as u64;
        self.out.write_all(bytes)
    }
}

/// Whether a shard is there with exactly these samples and its end; only headers are read.
pub(super) fn is_whole(path: &Path, samples: core::ops::Range<u64>) -> bool {
    depthrig_bus::files::open(path).and_then(|file| has(file, samples)).unwrap_or(false)
}

fn has(mut file: impl Read + Seek, samples: core::ops::Range<u64>) -> io::Result<bool> {
    let mut next = samples.start;
    let mut head = [0u8; BLOCK];
    loop {
        file.read_exact(&mut head)?;
        if head == [0; BLOCK] {
            let mut rest = Vec::new();
            file.take(BLOCK as u64 + 1).read_to_end(&mut rest)?;
            return Ok(rest == [0; BLOCK] && next == samples.end);
        }
        let name = head[..100].split(|b| *b == 0).next().and_then(|n| core::str::from_utf8(n).ok());
        let size = core::str::from_utf8(&head[124..135]).ok().and_then(|s| u64::from_str_radix(s, 8).ok());
        let (Some(name), Some(size)) = (name, size) else { return Ok(false) };
        // The record is a sample's last member.
        if let Some(key) = name.strip_suffix(".json") {
            if key.parse() != Ok(next) {
                return Ok(false);
            }
            next += 1;
        }
        file.seek(SeekFrom::Current(size.next_multiple_of(BLOCK as u64) as i64))?;
    }
}
