//! The sets of a dataset one after the other.

use super::{Dataset, PixelFilter, decode};
use crate::container::scan::{ChannelInfo, ChunkEntry, SegmentReader};
use crate::encode::Codec;
use crate::frame::Waiting;
use crate::msgs::frame_set::FrameSetMsg;
use crate::msgs::schemas::Schema;
use crate::msgs::{frame_info, motion, signal};
use crate::{Error, ErrorKind, RecordMotion, RecordSignal, Result};
use depthrig_bus::{FrameHeader, HostTime, PixelFormat, StreamId};
use std::collections::{BTreeMap, VecDeque};
use std::ops::{Bound, RangeBounds};

/// Which sets: by their log time, UTC nanoseconds since 1970, both ends included.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SetRange {
    /// Not before.
    pub from_utc_ns: i64,
    /// Not after.
    pub to_utc_ns: i64,
}

impl SetRange {
    /// Every set.
    pub const ALL: Self = Self { from_utc_ns: i64::MIN, to_utc_ns: i64::MAX };
}

impl Default for SetRange {
    fn default() -> Self {
        Self::ALL
    }
}

impl<R: RangeBounds<i64>> From<R> for SetRange {
    fn from(range: R) -> Self {
        let from_utc_ns = match range.start_bound() {
            Bound::Included(t) => *t,
            Bound::Excluded(t) => t.saturating_add(1),
            Bound::Unbounded => i64::MIN,
        };
        let to_utc_ns = match range.end_bound() {
            Bound::Included(t) => *t,
            Bound::Excluded(t) => t.saturating_sub(1),
            Bound::Unbounded => i64::MAX,
        };
        Self { from_utc_ns, to_utc_ns }
    }
}

/// How pixels are delivered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PixelMode {
    /// Deliver them as the camera's channel did.
    Decoded,
    /// Deliver what is stored: the JPEG, or the pixels of an image stored losslessly.
    Stored,
    /// As `Decoded`, with the stored image where that is another one.
    DecodedAndStored,
    /// Deliver none; the images are not even read.
    None,
}

/// A set read from a dataset.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct DatasetSet {
    /// Its number.
    pub id: u64,
    /// The moment it stands for.
    pub tick: HostTime,
    /// Its log time: UTC of the tick, nanoseconds since 1970, strictly increasing over a dataset.
    pub utc_ns: i64,
    /// Added to a monotonic time of its headers this gives UTC.
    pub utc_offset_ns: i64,
    /// Latest minus earliest capture time, nanoseconds.
    pub spread_ns: i64,
    /// Its frames, in the order in which they were handed to the recorder.
    pub frames: Vec<DatasetFrame>,
    /// Indices of the streams without a frame.
    pub missing: Vec<usize>,
    /// IMU batches since the set before.
    pub motion: Vec<RecordMotion>,
    /// Samples of signals since the set before.
    pub signals: Vec<RecordSignal>,
}

/// A frame read from a dataset.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct DatasetFrame {
    /// Index of its stream in `Session::streams`.
    pub stream: usize,
    /// The header as it was on the channel, bit by bit, with `set_id` filled in.
    pub header: FrameHeader,
    /// How the pixels are stored: `raw`, `jpeg`, `mjpeg`, `png` or `rank`.
    pub codec: &'static str,
    /// Bytes of the stored message.
    pub stored_bytes: u64,
    /// The payload, as [`PixelMode`] says.
    pub pixels: Vec<u8>,
    /// The image that the pixels were decoded from, with [`PixelMode::DecodedAndStored`]; `None` where pixels are stored as they are.
    pub stored: Option<Vec<u8>>,
    /// Of its dataset, for pixels that are not decoded yet.
    pub(crate) filter: Option<PixelFilter>,
}

impl DatasetFrame {
    /// The payload as the camera's channel carried it, of a frame that was read with [`PixelMode::Stored`].
    ///
    /// # Errors
    /// [`ErrorKind::Codec`] when it cannot be decoded.
    pub fn decoded(&self) -> Result<Vec<u8>> {
        let unknown = || Error::new(ErrorKind::Version, format!("codec \"{}\" is unknown here", self.codec));
        let codec = Codec::from_name(self.codec).ok_or_else(unknown)?;
        let mut pixels = decode::decode(&self.pixels, codec, &self.header)?;
        if let Some(filter) = &self.filter {
            filter.apply(&self.header, &mut pixels)?;
        }
        Ok(pixels)
    }
}

/// Iterator over the sets of a dataset; it holds one set in memory.
///
/// A set that cannot be read is an error of its own and the next one follows. A file that was cut delivers
/// its complete sets, then the error.
pub struct Sets {
    dataset: Dataset,
    range: SetRange,
    mode: PixelMode,
    next_segment: usize,
    segment: Option<Open>,
    ready: VecDeque<Result<DatasetSet>>,
}

/// A segment being read.
pub(super) struct Open {
    pub(super) reader: SegmentReader,
    pub(super) kinds: BTreeMap<u16, Kind>,
    next_chunk: usize,
    partial: Partial,
}

/// Content of a channel that sets are made of.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Kind {
    Image(StreamId),
    Info(StreamId),
    /// The header of a batch of an IMU.
    UnitInfo(StreamId),
    /// The samples of a batch.
    Samples(StreamId),
    /// A sample, for readers that do not know batches.
    Imu(StreamId),
    /// Samples of a signal.
    Signal(StreamId),
    /// A sample of a signal, for readers that know only ROS.
    SignalSingle(StreamId),
    Set,
}

impl Kind {
    /// Counts a message of an IMU or a signal of `bytes`; the error in words if a set has too many.
    pub(crate) fn count(&self, waiting: &mut Waiting, bytes: usize) -> core::result::Result<(), String> {
        match self {
            Self::UnitInfo(_) | Self::Samples(_) | Self::Imu(_) => waiting.motion(bytes),
            Self::Signal(_) | Self::SignalSingle(_) => waiting.signal(bytes),
            Self::Image(_) | Self::Info(_) | Self::Set => Ok(()),
        }
    }
}

/// The messages since the last set's end.
#[derive(Default)]
struct Partial {
    images: BTreeMap<StreamId, (u64, Vec<u8>)>,
    infos: BTreeMap<StreamId, (u64, Vec<u8>)>,
    batches: Vec<PartialBatch>,
    /// Samples of signals, each with its log time.
    signals: Vec<(StreamId, u64, Vec<u8>)>,
    waiting: Waiting,
}

/// A batch of an IMU, as far as it was read.
struct PartialBatch {
    unit: StreamId,
    log_time: u64,
    info: Vec<u8>,
    samples: Option<Vec<u8>>,
}

impl Sets {
    pub(super) fn new(dataset: &Dataset, range: SetRange, mode: PixelMode) -> Self {
        Self { dataset: dataset.clone(), range, mode, next_segment: 0, segment: None, ready: VecDeque::new() }
    }

    /// Reads on until something is ready; `None` at the end.
    fn advance(&mut self) -> Option<()> {
        let Some(open) = &mut self.segment else {
            let opened = self.dataset.open_segment(self.next_segment)?;
            self.next_segment += 1;
            match opened {
                Ok(reader) => {
                    let kinds = kinds(&reader);
                    self.segment = Some(Open::new(reader, kinds));
                }
                Err(e) => self.ready.push_back(Err(e)),
            }
            return Some(());
        };
        let Some(entry) = open.reader.chunks.get(open.next_chunk).cloned() else {
            self.ready.extend(open.cut_error().map(Err));
            self.segment = None;
            return Some(());
        };
        open.next_chunk += 1;
        let outside = (entry.end_time as i64) < self.range.from_utc_ns
            || (entry.start_time as i64) > self.range.to_utc_ns;
        if outside || !open.wants(&entry, self.mode) {
            return Some(());
        }
        let read = open.read_chunk(&entry, self.mode, &self.dataset, self.range, &mut self.ready);
        if let Err(e) = read {
            self.ready.push_back(Err(e));
        }
        Some(())
    }
}

impl Iterator for Sets {
    type Item = Result<DatasetSet>;

    fn next(&mut self) -> Option<Self::Item> {
        while self.ready.is_empty() {
            self.advance()?;
        }
        self.ready.pop_front()
    }
}

impl Open {
    pub(super) fn new(reader: SegmentReader, kinds: BTreeMap<u16, Kind>) -> Self {
        Self { reader, kinds, next_chunk: 0, partial: Partial::default() }
    }

    /// Forgets messages of a set whose end was not read.
    pub(super) fn forget(&mut self) {
        self.partial = Partial::default();
    }

    /// Whether a chunk holds anything that sets read in this mode are made of.
    pub(super) fn wants(&self, entry: &ChunkEntry, mode: PixelMode) -> bool {
        let wanted = |id: &u16| match self.kinds.get(id) {
            Some(Kind::Image(_)) => mode != PixelMode::None,
            Some(_) => true,
            None => false,
        };
        // A chunk without message indexes says nothing of its channels: look into it.
        entry.channels.is_empty() || entry.channels.iter().any(wanted)
    }

    /// The error that says where the segment was cut, if it was.
    pub(super) fn cut_error(&self) -> Option<Error> {
        let (offset, why) = self.reader.cut.as_ref()?;
        let what = format!("{why}; the sets before it are complete");
        Some(self.reader.error(ErrorKind::Truncated, *offset, what))
    }

    pub(super) fn read_chunk(
        &mut self,
        entry: &ChunkEntry,
        mode: PixelMode,
        dataset: &Dataset,
        range: SetRange,
        ready: &mut VecDeque<Result<DatasetSet>>,
    ) -> Result<()> {
        let Self { reader, kinds, partial, .. } = self;
        reader.messages(entry, |m| {
            let kind = kinds.get(&m.channel);
            if let Some(Err(what)) = kind.map(|kind| kind.count(&mut partial.waiting, m.data.len())) {
                *partial = Partial::default();
                return Err(reader.error(ErrorKind::Corrupt, entry.offset, what));
            }
            match kind {
                Some(Kind::Image(id)) if mode != PixelMode::None => {
                    partial.images.insert(id.clone(), (m.log_time, m.data.to_vec()));
                }
                Some(Kind::Info(id)) => {
                    partial.infos.insert(id.clone(), (m.log_time, m.data.to_vec()));
                }
                Some(Kind::UnitInfo(id)) => partial.batches.push(PartialBatch {
                    unit: id.clone(),
                    log_time: m.log_time,
                    info: m.data.to_vec(),
                    samples: None,
                }),
                Some(Kind::Samples(id)) => {
                    // It follows its header.
                    let last = partial.batches.iter_mut().rfind(|b| b.unit == *id);
                    if let Some(last) = last.filter(|b| b.samples.is_none() && b.log_time == m.log_time) {
                        last.samples = Some(m.data.to_vec());
                    }
                }
                Some(Kind::Signal(id)) => {
                    partial.signals.push((id.clone(), m.log_time, m.data.to_vec()));
                }
                Some(Kind::Set) => {
                    let partial = std::mem::take(partial);
                    let inside = (range.from_utc_ns..=range.to_utc_ns).contains(&(m.log_time as i64));
                    if inside {
                        ready.push_back(assemble(m.data, m.log_time, partial, mode, dataset).map_err(|e| {
                            let what = format!("a set cannot be read: {e}");
                            reader.error(e.kind(), entry.offset, what)
                        }));
                    }
                }
                _ => {}
            }
            Ok(())
        })
    }
}

/// Puts a set together from its commit mark and the messages before it.
fn assemble(
    message: &[u8],
    log_time: u64,
    mut partial: Partial,
    mode: PixelMode,
    dataset: &Dataset,
) -> Result<DatasetSet> {
    let set = FrameSetMsg::read(message)?;
    let streams = &dataset.session().streams;
    let index = |name: &str| {
        streams.iter().position(|s| s.id.to_string() == name).ok_or_else(|| {
            let what = format!("set {} has stream {name}, which the session does not", set.id);
            Error::new(ErrorKind::Corrupt, what)
        })
    };
    let lacks = |name: &str, what: &str| {
        Error::new(ErrorKind::Corrupt, format!("set {} lacks the {what} of {name}", set.id))
    };
    let mut frames = Vec::with_capacity(set.members.len());
    for member in &set.members {
        let stream = index(&member.stream)?;
        let id = &streams[stream].id;
        let info = partial.infos.remove(id).filter(|(t, _)| *t == log_time);
        let (_, info) = info.ok_or_else(|| lacks(&member.stream, "frame_info"))?;
        let (header, extra) = frame_info::read(&info)?;
        let codec = Codec::from_name(extra.codec).ok_or_else(|| {
            let what = format!("{} is stored with codec \"{}\", unknown here", member.stream, extra.codec);
            Error::new(ErrorKind::Version, what)
        })?;
        let mut kept = None;
        let pixels = if mode == PixelMode::None {
            Vec::new()
        } else {
            let image = partial.images.remove(id).filter(|(t, _)| *t == log_time);
            let (_, image) = image.ok_or_else(|| lacks(&member.stream, "image"))?;
            if crc32fast::hash(&image) != member.message_crc32 {
                return Err(lacks(&member.stream, "right image: another one is in its place, that"));
            }
            let stored = decode::stored(&image, codec)?;
            // Of filtered pixels it would be another image.
            let is_kept =
                mode == PixelMode::DecodedAndStored && codec != Codec::Raw && dataset.filter().is_none();
            kept = is_kept.then(|| stored.to_vec());
            if mode == PixelMode::Stored {
                stored.to_vec()
            } else {
                let mut pixels = decode::decode(stored, codec, &header)?;
                if let Some(filter) = dataset.filter() {
                    filter.apply(&header, &mut pixels)?;
                }
                pixels
            }
        };
        let stored_bytes = member.message_bytes;
        let filter = dataset.filter().filter(|_| mode == PixelMode::Stored).cloned();
        let codec = codec.name();
        frames.push(DatasetFrame { stream, header, codec, stored_bytes, pixels, stored: kept, filter });
    }
    let batches = partial.batches.into_iter().filter(|b| b.log_time == log_time);
    let motion = batches.map(|b| batch(b, set.id, dataset)).collect::<Result<_>>()?;
    let samples = partial.signals.into_iter().filter(|(_, t, _)| *t == log_time);
    let signals = samples.map(|(id, _, m)| signal_part(&id, &m, set.id, dataset)).collect::<Result<_>>()?;
    Ok(DatasetSet {
        id: set.id,
        tick: HostTime::from_ns(set.tick_ns),
        utc_ns: log_time as i64,
        utc_offset_ns: set.utc_offset_ns,
        spread_ns: set.spread_ns,
        frames,
        missing: set.missing.iter().map(|name| index(name)).collect::<Result<_>>()?,
        motion,
        signals,
    })
}

/// Samples of a signal in set `set`, restored.
fn signal_part(id: &StreamId, message: &[u8], set: u64, dataset: &Dataset) -> Result<RecordSignal> {
    let signals = &dataset.session().signals;
    let signal = signals.iter().position(|s| s.id == *id).ok_or_else(|| {
        Error::new(ErrorKind::Corrupt, format!("set {set}: {id} is not a signal of the session"))
    })?;
    let samples = signal::read_samples(message, &signals[signal].description)?.samples;
    Ok(RecordSignal { signal, samples })
}

/// A batch of set `set`, restored.
fn batch(partial: PartialBatch, set: u64, dataset: &Dataset) -> Result<RecordMotion> {
    let PartialBatch { unit, info, samples, .. } = partial;
    let corrupt = |what: String| Error::new(ErrorKind::Corrupt, format!("set {set}: {what}"));
    let index = dataset.session().motion.iter().position(|u| u.id == unit);
    let index = index.ok_or_else(|| corrupt(format!("{unit} is not an IMU of the session")))?;
    let (header, _) = frame_info::read(&info)?;
    let n = header.sequence;
    let samples = samples.ok_or_else(|| corrupt(format!("batch {n} of {unit} has no samples")))?;
    let samples = motion::read_samples(&samples)?;
    if samples.sequence != n || samples.samples.len() != header.width as usize {
        let has = samples.samples.len();
        let of = samples.sequence;
        let width = header.width;
        let what = format!("batch {n} of {unit} has {width} samples, {has} of batch {of} are there");
        return Err(corrupt(what));
    }
    Ok(RecordMotion { unit: index, header, samples: samples.samples })
}

/// Contents of a segment's channels, by type and by the `stream` in their metadata.
pub(crate) fn kinds(reader: &SegmentReader) -> BTreeMap<u16, Kind> {
    reader.channels.iter().filter_map(|(id, channel)| Some((*id, kind_of(channel)?))).collect()
}

/// Content of a channel; `None` for one that sets are not made of.
pub(crate) fn kind_of(channel: &ChannelInfo) -> Option<Kind> {
    let is = |s: Schema| channel.schema == s.name();
    if is(Schema::FrameSet) {
        return Some(Kind::Set);
    }
    let stream = channel.metadata.get("stream").and_then(|s| s.parse().ok())?;
    if is(Schema::FrameInfo) {
        let motion = channel.metadata.get("format").is_some_and(|f| f == PixelFormat::Motion.name());
        return Some(if motion { Kind::UnitInfo(stream) } else { Kind::Info(stream) });
    }
    if is(Schema::MotionSamples) {
        return Some(Kind::Samples(stream));
    }
    if is(Schema::Imu) {
        return Some(Kind::Imu(stream));
    }
    if is(Schema::SignalSamples) {
        return Some(Kind::Signal(stream));
    }
    if [Schema::JointState, Schema::PoseStamped, Schema::SignalValues].into_iter().any(is) {
        return Some(Kind::SignalSingle(stream));
    }
    Schema::IMAGES.into_iter().any(is).then_some(Kind::Image(stream))
}
