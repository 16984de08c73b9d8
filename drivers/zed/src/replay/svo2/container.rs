//! The MCAP container of an SVO2 file: lists its messages and reads them one after the other.
//!
//! The file is walked once by the heads of its records, so that a cut end costs what is cut and nothing else. Chunks
//! are then read one record at a time by the `mcap` crate, which checks their checksums first. Memory stays that of one
//! chunk. The crate's own reader of the index at the end is not used: a file that was not finished has none.

use depthrig_driver::bytes::{u16_at, u32_at, u64_at};
use depthrig_driver::image_file::io_error;
use depthrig_driver::{Error, ErrorKind, Result};
use mcap::records::{Record, op};
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// The first bytes of every MCAP file (its specification, "Magic").
const MAGIC: &[u8; 8] = b"\x89MCAP0\r\n";
/// Bytes of a record's opcode and length.
const HEAD: u64 = 9;
/// Bytes of a message before its data: channel, sequence and two times.
const MESSAGE_HEAD: usize = 22;
/// No pair of images is longer, nor a chunk: 2208x1242 twice in YUYV has 22 MB.
const MAX_RECORD: u64 = 256 << 20;
/// The longest record whose contents are read while walking.
const MAX_SMALL: u64 = 16 << 20;
/// Chunks that are searched for a header that no index names.
const SEARCHED: usize = 64;
/// Times that are kept to derive the rate from.
const FIRST_TIMES: usize = 64;

/// A run of records that is read from its beginning.
#[derive(Debug, Clone, Copy)]
struct Stretch {
    begin: u64,
    end: u64,
    /// Number of its first pair, and how many it has.
    first: u64,
    frames: u64,
}

/// A message of the video.
#[derive(Debug, Default)]
pub struct Message {
    /// When it was taken, nanoseconds of UTC.
    pub time_ns: i64,
    /// Its payload.
    pub data: Vec<u8>,
    /// Why it could not be read, if so.
    pub damaged: Option<String>,
}

/// Where a container's bytes are.
pub trait Bytes: Read + Seek + Send {}

impl<T: Read + Seek + Send> Bytes for T {}

/// An open container.
pub struct Container {
    path: PathBuf,
    file: Box<dyn Bytes>,
    stretches: Vec<Stretch>,
    video: u16,
    topic: String,
    header: Vec<u8>,
    first_times: Vec<i64>,
    /// The stretch that is read, and the pairs of it that were.
    at: usize,
    given: u64,
    reading: Option<Reading>,
}

/// A stretch on its way through the decoder.
struct Reading {
    reader: LinearReader,
    position: u64,
    end: u64,
}

/// How many messages each channel has, if an index says so.
type Counts = Option<Vec<(u16, u64)>>;

/// Results of the walk through the file.
#[derive(Default)]
struct Walk {
    /// Begin and end of each chunk or run of messages, and how many messages of each channel it has, if an index says
    /// so.
    runs: Vec<(u64, u64, Counts)>,
    channels: Vec<(u16, String)>,
}

impl Container {
    /// Walks through the file at `path` and finds its video and its header.
    ///
    /// # Errors
    /// [`ErrorKind::NotFound`], [`ErrorKind::PermissionDenied`], [`ErrorKind::Io`]; [`ErrorKind::BadInput`] if it is
    /// not an SVO2 file, or lacks video or header.
    pub fn open(path: &Path) -> Result<Self> {
        let file = depthrig_bus::files::open(path).map_err(|e| io_error(path, e))?;
        let length = file.metadata().map_err(|e| io_error(path, e))?.len();
        Self::new(Box::new(file), length, path)
    }

    /// The same for `length` bytes of `file`, which is called `path` in messages.
    ///
    /// # Errors
    /// As [`Self::open`].
    pub fn new(mut file: Box<dyn Bytes>, length: u64, path: &Path) -> Result<Self> {
        let bad = |what: &str| Error::new(ErrorKind::BadInput, format!("{}: {what}", path.display()));
        let mut magic = [0; 8];
        let whole = length >= 8 && file.read_exact(&mut magic).is_ok();
        if !whole || magic != *MAGIC {
            return Err(bad(
                "not an SVO2 file (no MCAP magic); SVO files of SDK 3 and before have another format: convert it with the \
                 vendor's ZED_SVO_Editor",
            ));
        }
        let mut walk = walk(file.as_mut(), length).map_err(|e| io_error(path, e))?;
        let mut container = Self {
            path: path.to_owned(),
            file,
            stretches: Vec::new(),
            video: 0,
            topic: String::new(),
            header: Vec::new(),
            first_times: Vec::new(),
            at: 0,
            given: 0,
            reading: None,
        };
        container.find_header(&mut walk)?;
        let video = walk.channels.iter().find(|(_, topic)| topic.ends_with("/side_by_side"));
        let Some((video, topic)) = video.cloned() else {
            return Err(bad(
                "it has no topic Camera_SN…/side_by_side: it is an MCAP file, but not an SVO2 file",
            ));
        };
        (container.video, container.topic) = (video, topic);
        if container.header.is_empty() {
            return Err(bad(
                "it has no message svo_header: it is an MCAP file, but not an SVO2 file, or was cut off at its beginning",
            ));
        }
        container.count(&walk)?;
        container.seek(0)?;
        Ok(container)
    }

    /// The message `svo_header`.
    pub fn header(&self) -> &[u8] {
        &self.header
    }

    /// The serial number in the video's topic.
    pub fn serial(&self) -> Option<String> {
        let digits = self.topic.strip_prefix("Camera_SN")?.split('/').next()?;
        (!digits.is_empty() && digits.bytes().all(|c| c.is_ascii_digit())).then(|| digits.to_owned())
    }

    /// Pairs in the file, as far as it goes.
    pub fn frames(&self) -> u64 {
        self.stretches.last().map_or(0, |s| s.first + s.frames)
    }

    /// Times of the first pairs, nanoseconds.
    pub fn first_times(&self) -> &[i64] {
        &self.first_times
    }

    /// Goes to pair `index`.
    ///
    /// # Errors
    /// [`ErrorKind::Io`].
    pub fn seek(&mut self, index: u64) -> Result<()> {
        self.at = self.stretches.partition_point(|s| s.first + s.frames <= index);
        (self.given, self.reading) = (0, None);
        let mut passed = Message::default();
        let before = self.stretches.get(self.at).map_or(0, |s| index - s.first);
        for _ in 0..before {
            self.next(&mut passed)?;
        }
        Ok(())
    }

    /// Fills `message` with the next pair's; `false` at the end. Of a damaged stretch each pair that its index promised
    /// is said to be damaged, so that those after it keep their numbers.
    ///
    /// # Errors
    /// [`ErrorKind::Io`].
    pub fn next(&mut self, message: &mut Message) -> Result<bool> {
        message.damaged = None;
        while let Some(stretch) = self.stretches.get(self.at).copied() {
            if self.given >= stretch.frames {
                (self.at, self.given, self.reading) = (self.at + 1, 0, None);
                continue;
            }
            let mut reading = match self.reading.take() {
                Some(reading) => reading,
                None => Reading::new(&stretch),
            };
            let found = reading.message(self.file.as_mut(), |channel| channel == self.video, message);
            self.given += 1;
            match found {
                Ok(true) => self.reading = Some(reading),
                Ok(false) => {
                    message.damaged = Some("a chunk has fewer messages than its index says".to_owned());
                }
                Err(Fault::Io(e)) => return Err(io_error(&self.path, e)),
                Err(Fault::Damage(why)) => message.damaged = Some(format!("its chunk is damaged: {why}")),
            }
            if message.damaged.is_some() {
                // The rest of the stretch cannot be trusted; the reading that failed fails again.
                self.reading = Some(Reading { end: 0, position: 0, ..Reading::new(&stretch) });
            }
            return Ok(true);
        }
        Ok(false)
    }

    /// Reads the header, and channels that only chunks name.
    fn find_header(&mut self, walk: &mut Walk) -> Result<()> {
        let id = |walk: &Walk| walk.channels.iter().find(|(_, t)| t == "svo_header").map(|(id, _)| *id);
        let mut searched = 0;
        for (begin, end, counts) in &walk.runs.clone() {
            let has_video = walk.channels.iter().any(|(_, t)| t.ends_with("/side_by_side"));
            if !self.header.is_empty() && has_video {
                return Ok(());
            }
            // An index shows which chunks need not be searched.
            if let (Some(id), Some(counts), true) = (id(walk), counts, has_video)
                && !counts.iter().any(|(c, n)| *c == id && *n > 0)
            {
                continue;
            }
            searched += 1;
            if searched > SEARCHED {
                return Ok(());
            }
            let mut reading = Reading { position: *begin, end: *end, ..Reading::new(&Stretch::nowhere()) };
            loop {
                let channels = &mut walk.channels;
                let header = &mut self.header;
                let more = reading.each(self.file.as_mut(), |opcode, data| match opcode {
                    op::CHANNEL => learn(channels, data),
                    op::MESSAGE if header.is_empty() => {
                        let of = u16_at(data, 0);
                        if channels.iter().any(|(id, t)| Some(*id) == of && t == "svo_header") {
                            header.extend_from_slice(data.get(MESSAGE_HEAD..).unwrap_or_default());
                        }
                    }
                    _ => {}
                });
                match more {
                    Ok(true) => {}
                    // A damaged chunk is left out here and said when it is played.
                    Ok(false) | Err(Fault::Damage(_)) => break,
                    Err(Fault::Io(e)) => return Err(io_error(&self.path, e)),
                }
            }
        }
        Ok(())
    }

    /// Counts the pairs of each stretch: by its index, else by reading it.
    fn count(&mut self, walk: &Walk) -> Result<()> {
        let mut first = 0;
        for (begin, end, counts) in &walk.runs {
            let mut stretch = Stretch { begin: *begin, end: *end, first, frames: 0 };
            let sample = self.first_times.len() < FIRST_TIMES;
            let indexed =
                counts.as_ref().map(|c| c.iter().filter(|(id, _)| *id == self.video).map(|(_, n)| n).sum());
            if let Some(n) = indexed {
                stretch.frames = n;
            }
            if indexed.is_none() || (sample && stretch.frames > 0) {
                let mut reading = Reading::new(&stretch);
                let mut message = Message::default();
                let mut n = 0;
                while indexed.is_none() || (n < stretch.frames && self.first_times.len() < FIRST_TIMES) {
                    match reading.message(self.file.as_mut(), |c| c == self.video, &mut message) {
                        Ok(true) => n += 1,
                        Ok(false) | Err(Fault::Damage(_)) => break,
                        Err(Fault::Io(e)) => return Err(io_error(&self.path, e)),
                    }
                    if self.first_times.len() < FIRST_TIMES {
                        self.first_times.push(message.time_ns);
                    }
                }
                if indexed.is_none() {
                    stretch.frames = n;
                }
            }
            first = stretch.first.saturating_add(stretch.frames);
            if stretch.frames > 0 {
                self.stretches.push(stretch);
            }
        }
        Ok(())
    }
}

/// Why a stretch cannot be read on.
enum Fault {
    Io(std::io::Error),
    Damage(String),
}

impl Stretch {
    const fn nowhere() -> Self {
        Self { begin: 0, end: 0, first: 0, frames: 0 }
    }
}

impl Reading {
    fn new(stretch: &Stretch) -> Self {
        let options = LinearReaderOptions::default()
            .with_skip_start_magic(true)
            .with_skip_end_magic(true)
            .with_prevalidate_chunk_crcs(true)
            .with_record_length_limit(MAX_RECORD as usize);
        Self { reader: LinearReader::new_with_options(options), position: stretch.begin, end: stretch.end }
    }

    /// Hands the next record to `see`; `false` at the end.
    fn each(&mut self, file: &mut dyn Bytes, see: impl FnOnce(u8, &[u8])) -> Result<bool, Fault> {
        loop {
            match self.reader.next_event() {
                None => return Ok(false),
                Some(Err(e)) => return Err(Fault::Damage(e.to_string())),
                Some(Ok(LinearReadEvent::Record { data, opcode })) => {
                    see(opcode, data);
                    return Ok(true);
                }
                Some(Ok(LinearReadEvent::ReadRequest(n))) => {
                    let left = self.end.saturating_sub(self.position).min(MAX_RECORD);
                    let n = n.min(left as usize);
                    if n > 0 {
                        file.seek(SeekFrom::Start(self.position)).map_err(Fault::Io)?;
                        file.read_exact(self.reader.insert(n)).map_err(Fault::Io)?;
                    }
                    self.reader.notify_read(n);
                    self.position += n as u64;
                }
            }
        }
    }

    /// Fills `message` with the next one of a channel that `is_wanted`; `false` at the end.
    fn message(
        &mut self,
        file: &mut dyn Bytes,
        is_wanted: impl Fn(u16) -> bool,
        message: &mut Message,
    ) -> Result<bool, Fault> {
        let mut found = false;
        while !found {
            let more = self.each(file, |opcode, data| {
                let Some(body) = data.get(MESSAGE_HEAD..).filter(|_| opcode == op::MESSAGE) else { return };
                if u16_at(data, 0).is_some_and(&is_wanted) {
                    found = true;
                    message.time_ns = u64_at(data, 6).map_or(0, |t| i64::try_from(t).unwrap_or(i64::MAX));
                    message.data.clear();
                    message.data.extend_from_slice(body);
                }
            })?;
            if !more {
                return Ok(false);
            }
        }
        Ok(true)
    }
}

/// Walks over the heads of the records of a file of `length` bytes.
fn walk(file: &mut dyn Bytes, length: u64) -> std::io::Result<Walk> {
    let mut walk = Walk::default();
    let mut at = MAGIC.len() as u64;
    // Whether the last run is of messages outside of chunks, which the next one joins.
    let mut loose = false;
    let mut summary = false;
    let mut body = Vec::new();
    while at + HEAD <= length {
        let mut head = [0; HEAD as usize];
        file.seek(SeekFrom::Start(at))?;
        file.read_exact(&mut head)?;
        let opcode = head[0];
        let size = u64_at(&head, 1).unwrap_or(u64::MAX);
        let end = (at + HEAD).checked_add(size).filter(|end| *end <= length);
        // A record that reaches beyond the end was cut off; everything before it is complete.
        let Some(end) = end else { break };
        let mut read = |limit: u64, file: &mut dyn Bytes| -> std::io::Result<()> {
            body.clear();
            body.resize(size.min(limit) as usize, 0);
            file.read_exact(&mut body)
        };
        match opcode {
            op::CHUNK if !summary => {
                walk.runs.push((at, end, None));
                loose = false;
            }
            op::MESSAGE if !summary => {
                match walk.runs.last_mut() {
                    Some((_, last, _)) if loose => *last = end,
                    _ => walk.runs.push((at, end, None)),
                }
                loose = true;
            }
            op::MESSAGE_INDEX if !summary && !loose && size <= MAX_SMALL => {
                read(MAX_SMALL, file)?;
                // Channel, then the bytes of its entries, 16 each.
                let channel = u16_at(&body, 0);
                let bytes = u32_at(&body, 2);
                if let (Some(channel), Some(bytes), Some(run)) = (channel, bytes, walk.runs.last_mut()) {
                    let entries = u64::from(bytes).min(size) / 16;
                    run.2.get_or_insert_with(Vec::new).push((channel, entries));
                }
            }
            op::CHANNEL if size <= MAX_SMALL => {
                read(MAX_SMALL, file)?;
                learn(&mut walk.channels, &body);
                if loose && let Some((_, last, _)) = walk.runs.last_mut() {
                    *last = end;
                }
            }
            op::DATA_END => summary = true,
            op::FOOTER => break,
            _ => {}
        }
        at = end;
    }
    Ok(walk)
}

/// Notes a channel's number and topic.
fn learn(channels: &mut Vec<(u16, String)>, body: &[u8]) {
    if let Ok(Record::Channel(c)) = mcap::parse_record(op::CHANNEL, body)
        && !channels.iter().any(|(id, _)| *id == c.id)
    {
        channels.push((c.id, c.topic));
    }
}
