//! The file: records, chunks, connections and messages (<http://wiki.ros.org/Bags/Format/2.0>).
//!
//! Nothing a file says is believed before it is checked against the bytes that are there: a record is not longer than
//! the rest of the file, and a chunk is unpacked to [`CHUNK_MAX`] at most.

use depthrig_recorder::fs::ReadFile;
use depthrig_recorder::{Error, ErrorKind, Result};
use std::collections::BTreeMap;
use std::io::Read;
use std::path::{Path, PathBuf};

/// The first line.
const MAGIC: &[u8] = b"#ROSBAG V2.0\n";
/// The longest header of a record, bytes; ours are a few hundred.
const HEAD_MAX: u32 = 1 << 20;
/// The largest chunk, packed or not, bytes: librealsense writes one image in each.
const CHUNK_MAX: u32 = 256 << 20;

const OP_MESSAGE: u8 = 2;
const OP_CHUNK: u8 = 5;
const OP_CONNECTION: u8 = 7;

/// A bag opened for reading.
pub(super) struct Bag {
    file: Box<dyn ReadFile>,
    pub path: PathBuf,
    pub size: u64,
}

/// Which messages a connection carries.
#[derive(Debug, Clone)]
pub(super) struct Connection {
    pub topic: String,
}

/// A message and where it lies.
pub(super) struct Message<'a> {
    pub connection: &'a Connection,
    /// Time of the message in the bag, nanoseconds since the recording began as librealsense writes it.
    pub time_ns: i64,
    pub data: &'a [u8],
    pub place: Place,
}

/// Where a message lies.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Place {
    /// Offset of the record of the chunk, or of the message that lies in none.
    chunk: u64,
    /// Offset of the data in the unpacked chunk.
    at: usize,
    len: usize,
}

/// An unpacked chunk, kept for the next message in it.
#[derive(Default)]
pub(super) struct Unpacked {
    chunk: Option<u64>,
    bytes: Vec<u8>,
}

/// Fields of a record by name.
struct Head<'a>(Vec<(&'a [u8], &'a [u8])>);

impl<'a> Head<'a> {
    fn parse(mut bytes: &'a [u8]) -> Option<Self> {
        let mut fields = Vec::new();
        while !bytes.is_empty() {
            let (len, rest) = bytes.split_first_chunk()?;
            let (field, rest) = rest.split_at_checked(u32::from_le_bytes(*len) as usize)?;
            let at = field.iter().position(|b| *b == b'=')?;
            fields.push((&field[..at], &field[at + 1..]));
            bytes = rest;
        }
        Some(Self(fields))
    }

    fn get(&self, name: &str) -> Option<&'a [u8]> {
        self.0.iter().find(|(n, _)| *n == name.as_bytes()).map(|(_, v)| *v)
    }

    fn u32(&self, name: &str) -> Option<u32> {
        Some(u32::from_le_bytes(self.get(name)?.try_into().ok()?))
    }

    fn text(&self, name: &str) -> Option<&'a str> {
        core::str::from_utf8(self.get(name)?).ok()
    }

    fn op(&self) -> Option<u8> {
        match self.get("op")? {
            [op] => Some(*op),
            _ => None,
        }
    }
}

/// One record in memory: header and data, and what follows.
fn record(bytes: &[u8]) -> Option<(Head<'_>, &[u8], &[u8])> {
    let (len, rest) = bytes.split_first_chunk()?;
    let (head, rest) = rest.split_at_checked(u32::from_le_bytes(*len) as usize)?;
    let (len, rest) = rest.split_first_chunk()?;
    let (data, rest) = rest.split_at_checked(u32::from_le_bytes(*len) as usize)?;
    Some((Head::parse(head)?, data, rest))
}

impl Bag {
    pub(super) fn open(file: Box<dyn ReadFile>, path: &Path) -> Result<Self> {
        let size = file.size().map_err(|e| Error::reading("read", path, e))?;
        let mut begin = vec![0; (MAGIC.len() as u64).min(size) as usize];
        file.read_exact_at(&mut begin, 0).map_err(|e| Error::reading("read", path, e))?;
        if begin != MAGIC {
            let what = if begin.starts_with(b"#ROSBAG V1") {
                "is a rosbag of version 1; convert it with `rosbag fix`"
            } else if begin.starts_with(b"SQLite") || begin.starts_with(b"\x89MCAP") {
                "is a recording of ROS 2, not a rosbag of version 2"
            } else {
                "is not a rosbag of version 2"
            };
            return Err(Error::new(ErrorKind::BadRecording, format!("{} {what}", path.display())));
        }
        Ok(Self { file, path: path.to_owned(), size })
    }

    fn corrupt(&self, offset: u64, what: impl core::fmt::Display) -> Error {
        let what = format!("{}: at byte {offset}: {what}", self.path.display());
        Error::new(ErrorKind::Corrupt, what)
    }

    fn cut(&self) -> Error {
        let path = self.path.display();
        let what = format!("{path}: it ends in the middle of a record, at byte {}", self.size);
        Error::new(ErrorKind::Truncated, what)
    }

    fn bytes(&self, offset: u64, len: u32) -> Result<Vec<u8>> {
        if offset.checked_add(u64::from(len)).is_none_or(|end| end > self.size) {
            return Err(self.cut());
        }
        let mut bytes = vec![0; len as usize];
        self.file.read_exact_at(&mut bytes, offset).map_err(|e| Error::reading("read", &self.path, e))?;
        Ok(bytes)
    }

    fn u32_at(&self, offset: u64) -> Result<u32> {
        let bytes = self.bytes(offset, 4)?;
        Ok(bytes.first_chunk().map_or(0, |b| u32::from_le_bytes(*b)))
    }

    /// Header, offset and length of the data of the record at `offset`, which is there as a whole.
    fn record_at(&self, offset: u64) -> Result<(Vec<u8>, u64, u32)> {
        let len = self.u32_at(offset)?;
        if len > HEAD_MAX {
            return Err(self.corrupt(offset, format_args!("a record's header of {len} bytes")));
        }
        let head = self.bytes(offset + 4, len)?;
        let at = offset + 4 + u64::from(len);
        let len = self.u32_at(at)?;
        if at + 4 + u64::from(len) > self.size {
            return Err(self.cut());
        }
        Ok((head, at + 4, len))
    }

    /// Unpacks the chunk of the record at `offset`; a message that lies in no chunk is one of its own.
    fn unpack(&self, offset: u64, into: &mut Unpacked) -> Result<()> {
        if into.chunk == Some(offset) {
            return Ok(());
        }
        let (head, at, len) = self.record_at(offset)?;
        let head = Head::parse(&head).filter(|h| matches!(h.op(), Some(OP_CHUNK | OP_MESSAGE)));
        let head = head.ok_or_else(|| self.corrupt(offset, "no chunk where one was"))?;
        let bare = head.op() == Some(OP_MESSAGE);
        let wrong = |what: String| self.corrupt(offset, what);
        let size = if bare { Some(len) } else { head.u32("size") };
        let size = size.ok_or_else(|| wrong("a chunk without a size".to_owned()))?;
        if size > CHUNK_MAX || len > CHUNK_MAX {
            return Err(wrong(format!("a chunk of {} bytes; {CHUNK_MAX} is the most", size.max(len))));
        }
        into.chunk = None;
        into.bytes.clear();
        let packed = self.bytes(at, len)?;
        let packing = if bare { Some("none") } else { head.text("compression") };
        match packing {
            Some("none") => into.bytes = packed,
            Some("lz4") => {
                let mut decoder = lz4_flex::frame::FrameDecoder::new(&packed[..]).take(u64::from(size) + 1);
                decoder
                    .read_to_end(&mut into.bytes)
                    .map_err(|e| wrong(format!("its lz4 data is damaged: {e}")))?;
            }
            Some("bz2") => {
                let what = format!(
                    "{} is packed with bz2, which is not read here; run `rosbag decompress` or `rosbag compress \
                     --lz4` on it first",
                    self.path.display()
                );
                return Err(Error::new(ErrorKind::BadRecording, what));
            }
            other => return Err(wrong(format!("a chunk packed with {other:?}"))),
        }
        if into.bytes.len() != size as usize {
            return Err(wrong(format!("a chunk has {} bytes, its header says {size}", into.bytes.len())));
        }
        into.chunk = Some(offset);
        Ok(())
    }

    /// Calls `each` with every message in the order of the file. Damaged chunks are reported to `damage` and skipped;
    /// so is the end of a file that was cut. Messages in no chunk are reported and read.
    pub(super) fn messages(
        &self,
        each: &mut dyn FnMut(Message<'_>) -> Result<()>,
        damage: &mut dyn FnMut(String),
    ) -> Result<()> {
        let mut pass = Pass { bag: self, connections: BTreeMap::new(), unclosed: false, each, damage };
        let mut content = Unpacked::default();
        let mut offset = MAGIC.len() as u64;
        while offset < self.size {
            let (head, at, len) = match self.record_at(offset) {
                Ok(record) => record,
                Err(e) if e.kind() == ErrorKind::Io => return Err(e),
                Err(e) => {
                    pass.damaged(&e);
                    return Ok(());
                }
            };
            let Some((op, head)) = Head::parse(&head).and_then(|h| Some((h.op()?, h))) else {
                pass.damaged(&self.corrupt(offset, "no record where one must be"));
                return Ok(());
            };
            match op {
                OP_CHUNK | OP_MESSAGE => match self.unpack(offset, &mut content) {
                    Ok(()) if op == OP_CHUNK => pass.chunk(offset, &content.bytes)?,
                    Ok(()) => pass.bare(offset, &head, &content.bytes)?,
                    Err(e) if matches!(e.kind(), ErrorKind::Io | ErrorKind::BadRecording) => return Err(e),
                    Err(e) => pass.damaged(&e),
                },
                OP_CONNECTION => connect(&mut pass.connections, &head),
                _ => {}
            }
            offset = at + u64::from(len);
        }
        Ok(())
    }

    /// The data of a message that was seen before.
    pub(super) fn message<'u>(&self, place: Place, chunk: &'u mut Unpacked) -> Result<&'u [u8]> {
        self.unpack(place.chunk, chunk)?;
        let data = chunk.bytes.get(place.at..).and_then(|b| b.get(..place.len));
        data.ok_or_else(|| self.corrupt(place.chunk, "the file is not as it was when it was opened"))
    }
}

/// One way through the file, from front to back.
struct Pass<'a> {
    bag: &'a Bag,
    connections: BTreeMap<u32, Connection>,
    /// Messages were seen that lie in no chunk.
    unclosed: bool,
    each: &'a mut dyn FnMut(Message<'_>) -> Result<()>,
    damage: &'a mut dyn FnMut(String),
}

impl Pass<'_> {
    fn damaged(&mut self, e: &Error) {
        (self.damage)(e.to_string());
    }

    /// The content of the chunk at `offset`.
    fn chunk(&mut self, offset: u64, bytes: &[u8]) -> Result<()> {
        let mut rest = bytes;
        while !rest.is_empty() {
            let Some((head, data, after)) = record(rest) else {
                self.damaged(&self.bag.corrupt(offset, "a chunk ends in the middle of a record"));
                return Ok(());
            };
            rest = after;
            match head.op() {
                Some(OP_CONNECTION) => connect(&mut self.connections, &head),
                Some(OP_MESSAGE) => {
                    let at = bytes.len() - rest.len() - data.len();
                    self.message(&head, data, Place { chunk: offset, at, len: data.len() })?;
                }
                _ => {}
            }
        }
        Ok(())
    }

    /// A message that lies in no chunk. The head of a chunk is written when it begins, and again with its
    /// size when it ends: of a recorder that was killed the last head says 0, and bare records follow it.
    fn bare(&mut self, offset: u64, head: &Head<'_>, data: &[u8]) -> Result<()> {
        if !std::mem::replace(&mut self.unclosed, true) {
            let what = "messages in no chunk: the recorder was ended before it closed its last chunk";
            self.damaged(&self.bag.corrupt(offset, what));
        }
        self.message(head, data, Place { chunk: offset, at: 0, len: data.len() })
    }

    fn message(&mut self, head: &Head<'_>, data: &[u8], place: Place) -> Result<()> {
        let connection = head.u32("conn").and_then(|id| self.connections.get(&id));
        let time = head.get("time").and_then(|t| t.first_chunk::<8>());
        let (Some(connection), Some([a, b, c, d, e, f, g, h])) = (connection, time) else {
            self.damaged(&self.bag.corrupt(place.chunk, "a message of a connection that is not described"));
            return Ok(());
        };
        let s = u32::from_le_bytes([*a, *b, *c, *d]);
        let ns = u32::from_le_bytes([*e, *f, *g, *h]);
        let time_ns = i64::from(s) * 1_000_000_000 + i64::from(ns);
        (self.each)(Message { connection, time_ns, data, place })
    }
}

/// Notes a connection's topic. Its type is not read: the topics of librealsense say more.
fn connect(connections: &mut BTreeMap<u32, Connection>, head: &Head<'_>) {
    if let (Some(id), Some(topic)) = (head.u32("conn"), head.text("topic")) {
        connections.entry(id).or_insert_with(|| Connection { topic: topic.to_owned() });
    }
}
