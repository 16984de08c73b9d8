//! Mutations that know what an MCAP file is: without them nearly every changed byte ends at a checksum or inside a
//! compressed chunk, and the code behind is never reached.

use crate::container::MAGIC;
use crate::container::record::op;
use std::collections::BTreeMap;

/// Far longer than any chunk of the seeds; a longer one stays compressed.
const CHUNK_MAX: usize = 1 << 16;
/// Opcode and length.
const HEAD: usize = 9;
/// Fields of a chunk before the name of its compression.
const CHUNK_HEAD: usize = 28;
/// Fields of a message before its data.
const MESSAGE_HEAD: usize = 22;

/// A file as records, whatever is in them.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct File {
    /// Opcodes and fields.
    pub records: Vec<(u8, Vec<u8>)>,
    /// The bytes after the last whole record; the magic of a finished file.
    pub tail: Vec<u8>,
}

/// SplitMix64, so that a mutation follows from its seed.
struct Rng(u64);

impl Rng {
    /// A number below `n`; 0 when `n` is.
    fn below(&mut self, n: usize) -> usize {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) % n.max(1) as u64) as usize
    }
}

/// Little-endian at `at`.
fn u64_at(bytes: &[u8], at: usize) -> Option<u64> {
    Some(u64::from_le_bytes(*bytes.get(at..)?.first_chunk()?))
}

fn put_u64(bytes: &mut [u8], at: usize, v: u64) {
    if let Some(place) = bytes.get_mut(at..).and_then(|b| b.first_chunk_mut()) {
        *place = v.to_le_bytes();
    }
}

/// Whole records from the start of `bytes`, and the rest.
fn split(mut bytes: &[u8]) -> File {
    let mut records = Vec::new();
    while let Some(len) = u64_at(bytes, 1).and_then(|n| usize::try_from(n).ok()) {
        let Some(body) = bytes[HEAD..].get(..len) else { break };
        records.push((bytes[0], body.to_vec()));
        bytes = &bytes[HEAD + len..];
    }
    File { records, tail: bytes.to_vec() }
}

/// Name of the compression, and where the records of a chunk begin.
fn chunk_parts(body: &[u8]) -> Option<(&[u8], usize)> {
    let len = u32::from_le_bytes(*body.get(CHUNK_HEAD..)?.first_chunk()?) as usize;
    let name = body.get(CHUNK_HEAD + 4..)?.get(..len)?;
    let data = CHUNK_HEAD + 4 + len + 8;
    (data <= body.len()).then_some((name, data))
}

/// The records in a chunk, unpacked.
fn unpacked(body: &[u8]) -> Option<Vec<u8>> {
    match chunk_parts(body)? {
        (b"", data) => Some(body[data..].to_vec()),
        (b"zstd", data) => zstd::bulk::decompress(&body[data..], CHUNK_MAX).ok(),
        _ => None,
    }
}

/// A chunk's fields with other records, stored unpacked; its times are kept.
fn chunk_with(body: &[u8], records: &[u8]) -> Vec<u8> {
    let len = (records.len() as u64).to_le_bytes();
    let crc = crc32fast::hash(records).to_le_bytes();
    [&body[..16], &len, &crc, &[0; 4], &len, records].concat()
}

impl File {
    /// The records of a file; `None` when it does not begin as an MCAP file does.
    pub fn parse(bytes: &[u8]) -> Option<Self> {
        Some(split(bytes.strip_prefix(&MAGIC)?))
    }

    /// The file.
    pub fn to_bytes(&self) -> Vec<u8> {
        [&MAGIC, &self.records_bytes()[..]].concat()
    }

    fn records_bytes(&self) -> Vec<u8> {
        let mut out = Vec::new();
        for (opcode, body) in &self.records {
            out.push(*opcode);
            out.extend((body.len() as u64).to_le_bytes());
            out.extend(body);
        }
        out.extend(&self.tail);
        out
    }

    /// Makes every checksum agree with what it covers.
    pub fn mend_checksums(&mut self) {
        for (opcode, body) in &mut self.records {
            if *opcode == op::CHUNK {
                if let Some(inside) = unpacked(body) {
                    body[24..CHUNK_HEAD].copy_from_slice(&crc32fast::hash(&inside).to_le_bytes());
                }
            } else if let (op::ATTACHMENT, Some(at)) = (*opcode, body.len().checked_sub(4)) {
                let crc = crc32fast::hash(&body[..at]);
                body[at..].copy_from_slice(&crc.to_le_bytes());
            }
        }
        let mut crc = crc32fast::Hasher::new();
        crc.update(&MAGIC);
        for (opcode, body) in &mut self.records {
            match (*opcode, body.len()) {
                (op::DATA_END, 4) => {
                    body.copy_from_slice(&crc.finalize().to_le_bytes());
                    crc = crc32fast::Hasher::new();
                    continue;
                }
                (op::FOOTER, 20) => {
                    let mut crc = crc.clone();
                    crc.update(&[op::FOOTER]);
                    crc.update(&20u64.to_le_bytes());
                    crc.update(&body[..16]);
                    body[16..].copy_from_slice(&crc.finalize().to_le_bytes());
                }
                _ => {}
            }
            crc.update(&[*opcode]);
            crc.update(&(body.len() as u64).to_le_bytes());
            crc.update(body);
        }
    }

    /// The same file with other records, and every offset in the index put right, as long as each record is
    /// still there: lengths may have changed, the order may not.
    pub fn with_lengths_of(mut self, old: &Self) -> Self {
        let starts = |file: &Self| {
            let mut at = MAGIC.len() as u64;
            let step = |(_, body): &(u8, Vec<u8>)| {
                let start = at;
                at += (HEAD + body.len()) as u64;
                start
            };
            file.records.iter().map(step).collect::<Vec<_>>()
        };
        let moved: BTreeMap<u64, u64> = starts(old).into_iter().zip(starts(&self)).collect();
        for (opcode, body) in &mut self.records {
            let mut places = match *opcode {
                op::CHUNK_INDEX => vec![16],
                op::ATTACHMENT_INDEX | op::METADATA_INDEX => vec![0],
                op::SUMMARY_OFFSET => vec![1],
                op::FOOTER => vec![0, 8],
                _ => continue,
            };
            if *opcode == op::CHUNK_INDEX {
                // A map from channel (2 bytes) to offset, after its length in bytes.
                let len = body.get(32..).and_then(|b| b.first_chunk()).map_or(0, |n| u32::from_le_bytes(*n));
                places.extend((0..len as usize / 10).map(|i| 36 + 10 * i + 2));
            }
            for at in places {
                if let Some(new) = u64_at(body, at).and_then(|old| moved.get(&old)) {
                    put_u64(body, at, *new);
                }
            }
        }
        self.mend_checksums();
        self
    }

    /// The file without the text of its schemas, which is most of a short one and which no reader of ours looks at.
    pub fn without_schema_text(&self) -> Self {
        let mut short = self.clone();
        for (_, body) in short.records.iter_mut().filter(|(opcode, _)| *opcode == op::SCHEMA) {
            let text =
                |at: usize| Some(at + 4 + u32::from_le_bytes(*body.get(at..)?.first_chunk()?) as usize);
            if let Some(end) = text(2).and_then(text) {
                body.truncate(end);
                body.extend([0; 4]);
            }
        }
        short.with_lengths_of(self)
    }
}

/// A mutation of `bytes`: of the fields of a record, of the contents of a chunk (stored unpacked afterwards), or of the
/// order of records. `change` mutates single byte strings. Checksums are put right in seven of eight cases. `None` when
/// plain bytes should be changed instead.
pub fn mutate(bytes: &[u8], seed: u64, change: &mut dyn FnMut(&[u8]) -> Vec<u8>) -> Option<Vec<u8>> {
    let mut rng = Rng(seed);
    let kind = rng.below(8);
    let mut file = File::parse(bytes).filter(|f| kind > 0 && !f.records.is_empty())?;
    let records = &mut file.records;
    let at = rng.below(records.len());
    let to = rng.below(records.len());
    match kind {
        1 => drop(records.remove(at)),
        2 => records.insert(to, records[at].clone()),
        3 => records.swap(at, to),
        4 => records[at].1 = change(&records[at].1),
        _ => {
            let chunks: Vec<usize> = (0..records.len()).filter(|i| records[*i].0 == op::CHUNK).collect();
            let at = chunks.get(rng.below(chunks.len())).copied().unwrap_or(at);
            let body = &records[at].1;
            records[at].1 = match unpacked(body) {
                Some(inside) => chunk_with(body, &mutate_inside(&inside, &mut rng, change)),
                None => change(body),
            };
        }
    }
    if rng.below(8) > 0 {
        file.mend_checksums();
    }
    Some(file.to_bytes())
}

/// Changes a record inside a chunk, nearly always a message, and puts its length right.
fn mutate_inside(inside: &[u8], rng: &mut Rng, change: &mut dyn FnMut(&[u8]) -> Vec<u8>) -> Vec<u8> {
    let mut file = split(inside);
    let at = rng.below(file.records.len());
    let Some((_, body)) = file.records.get_mut(at).filter(|_| rng.below(4) > 0) else {
        return change(inside);
    };
    // The data of a message change as often as its head.
    let head = if rng.below(2) == 0 { body.len().min(MESSAGE_HEAD) } else { 0 };
    *body = [&body[..head], &change(&body[head..])].concat();
    file.records_bytes()
}
