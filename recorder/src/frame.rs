//! The input of the recorder: sets of frames whose pixels still lie in shared memory.

use depthrig_bus::{
    FrameHeader, HostTime, MOTION_SAMPLE_BYTES, MotionSample, SignalDescription, SignalSample, UtcPair,
};

/// The pixels of a frame, wherever they lie. The recorder drops the box as soon as it has encoded them, or where they
/// [may wait](Pixels::may_wait) and are stored as they are, written them.
pub trait Pixels: Send {
    /// The payload: at least `FrameHeader::payload_len` bytes.
    fn bytes(&self) -> &[u8];

    /// The stored image that these pixels were decoded from, if they were. It is stored again as it is, if its topic has messages of its type:
    /// encoding a second time takes time, and of a JPEG it would lose a second time.
    fn stored(&self) -> Option<StoredImage<'_>> {
        None
    }

    /// Whether the recorder owns these bytes, and may keep them until they are on the disk: then they are not copied.
    /// Pixels in shared memory may not, because a slow disk would keep their slots from the live feed.
    fn may_wait(&self) -> bool {
        false
    }
}

/// An image as a dataset has it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StoredImage<'a> {
    /// Its codec, as `DatasetFrame::codec` names it.
    pub codec: &'static str,
    /// Its bytes.
    pub bytes: &'a [u8],
}

/// Pixels that were read from a dataset, with the image that they were decoded from.
#[derive(Debug, Clone)]
pub struct ReadPixels {
    /// The pixels.
    pub pixels: Vec<u8>,
    /// Codec of the image, as `DatasetFrame::codec` names it.
    pub codec: &'static str,
    /// The image; `None` of pixels that are stored as they are.
    pub stored: Option<Vec<u8>>,
}

impl Pixels for ReadPixels {
    fn bytes(&self) -> &[u8] {
        &self.pixels
    }

    fn stored(&self) -> Option<StoredImage<'_>> {
        let codec = self.codec;
        self.stored.as_deref().map(|bytes| StoredImage { codec, bytes })
    }
}

impl Pixels for Vec<u8> {
    fn bytes(&self) -> &[u8] {
        self
    }

    fn may_wait(&self) -> bool {
        true
    }
}

impl Pixels for std::sync::Arc<[u8]> {
    fn bytes(&self) -> &[u8] {
        self
    }

    fn may_wait(&self) -> bool {
        true
    }
}

/// One frame of a set.
pub struct RecordFrame {
    /// Index of the stream in `Session::streams`.
    pub stream: usize,
    /// Its header; `set_id` is filled in by the recorder.
    pub header: FrameHeader,
    /// Its pixels.
    pub pixels: Box<dyn Pixels>,
}

/// A batch of samples of an IMU, as its channel carried it.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordMotion {
    /// Index of the IMU in `Session::motion`.
    pub unit: usize,
    /// The batch's header; `set_id` is filled in by the recorder.
    pub header: FrameHeader,
    /// Its samples, as many as the header's `width`.
    pub samples: Vec<MotionSample>,
}

/// Largest image of a dataset, bytes as its channel carries it. Reading, verifying and recovering take about this much
/// memory per thread, whatever a file holds.
pub const IMAGE_MAX_BYTES: u64 = 256 << 20;

/// The IMU batches of a set take at most this many bytes in the file, see [`RecordMotion::stored_bytes`]: some minutes
/// of one IMU. A caller whose sets are further apart leaves out batches, and counts them.
pub const SET_MOTION_MAX_BYTES: u64 = 64 << 20;

impl RecordMotion {
    /// About how many bytes this batch takes in the file, before the chunk is packed.
    pub fn stored_bytes(&self) -> u64 {
        Self::stored_bytes_of(self.samples.len() as u64)
    }

    /// The same of a batch of this many samples.
    pub const fn stored_bytes_of(samples: u64) -> u64 {
        // Each message has 31 bytes before its data: `frame_info` is 768 bytes and three short texts, an `Imu` 312 and
        // the name of its frame.
        const BATCH: u64 = 1024;
        const SAMPLE: u64 = MOTION_SAMPLE_BYTES as u64 + 448;
        BATCH.saturating_add(SAMPLE.saturating_mul(samples))
    }
}

/// Samples of a signal, as its channel carried them.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordSignal {
    /// Index of the signal in `Session::signals`.
    pub signal: usize,
    /// Its samples in their order, all of one publisher.
    pub samples: Vec<SignalSample>,
}

/// The samples of signals of a set take at most this many bytes in the file, see [`RecordSignal::stored_bytes`].
pub const SET_SIGNALS_MAX_BYTES: u64 = 64 << 20;

impl RecordSignal {
    /// About how many bytes these samples take in the file, before the chunk is packed.
    pub fn stored_bytes(&self) -> u64 {
        let of = |s: &SignalSample| Self::sample_bytes(s.description(), s.bytes().len());
        self.samples.iter().map(of).fold(256, u64::saturating_add)
    }

    /// The same of one sample with so many bytes of values.
    pub fn sample_bytes(description: &SignalDescription, values: usize) -> u64 {
        // In both messages the values, which are widened in the second one, and there name, type and unit of each field.
        let names: usize = description.all_fields().iter().map(|f| f.name.len() + f.unit.len() + 48).sum();
        (160 + names + description.frame().len() + 9 * values) as u64
    }
}

/// Bytes of the messages that wait for the mark of a set, and belong to no image.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Waiting {
    motion: u64,
    signals: u64,
}

impl Waiting {
    /// Takes in a message of `bytes` of an IMU; the error in words if a set has too many.
    pub(crate) fn motion(&mut self, bytes: usize) -> Result<(), String> {
        Self::add(&mut self.motion, bytes, SET_MOTION_MAX_BYTES, "motion")
    }

    /// The same of a signal.
    pub(crate) fn signal(&mut self, bytes: usize) -> Result<(), String> {
        Self::add(&mut self.signals, bytes, SET_SIGNALS_MAX_BYTES, "signals")
    }

    fn add(sum: &mut u64, bytes: usize, most: u64, what: &str) -> Result<(), String> {
        *sum = sum.saturating_add(bytes as u64);
        if *sum <= most {
            return Ok(());
        }
        Err(format!("a set has more than {most} bytes of {what} before its mark"))
    }
}

/// One set: at most one frame of each stream, all of about the same moment.
pub struct RecordSet {
    /// Number of the set; each is greater than the one before.
    pub id: u64,
    /// The moment the set stands for.
    pub tick: HostTime,
    /// A recent reading of both clocks. The first set's reading places the whole recording in UTC, so that a
    /// step of the wall clock never makes recorded times jump; the later ones are stored as they are.
    pub utc: UtcPair,
    /// The frames.
    pub frames: Vec<RecordFrame>,
    /// Indices of the streams that have no frame in this set.
    pub missing: Vec<usize>,
    /// The IMU batches since the set before, in order of arrival. They are lost with a set that is not recorded, so
    /// that the numbers of batches and samples show the gap.
    pub motion: Vec<RecordMotion>,
    /// The samples of signals since the set before, those of each signal in order. They too are lost with the set.
    pub signals: Vec<RecordSignal>,
    /// Latest minus earliest capture time, nanoseconds.
    pub spread_ns: i64,
}

/// Why a set was not recorded. The discriminant is the index into `SetCounts::dropped` and part of
/// the file format.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, serde::Serialize)]
#[serde(rename_all = "snake_case")]
#[repr(usize)]
#[non_exhaustive]
pub enum SetDrop {
    /// As many sets as allowed wait to be encoded: too little CPU for this rate.
    EncoderBusy = 0,
    /// As many encoded bytes as allowed wait to be written: the disk is too slow.
    DiskSlow = 1,
    /// The recording had ended after a failed write or for want of disk space.
    WriteFailed = 2,
    /// An image of the set could not be encoded.
    EncodeFailed = 3,
    /// The set contradicts itself or the session: unknown stream, wrong size, id not greater than the last.
    BadSet = 4,
    /// The recorder was being closed.
    Ended = 5,
}

impl SetDrop {
    /// Every reason, in the order of the file format.
    pub const ALL: [Self; 6] =
        [Self::EncoderBusy, Self::DiskSlow, Self::WriteFailed, Self::EncodeFailed, Self::BadSet, Self::Ended];

    /// The name used in reports, metrics and JSON.
    pub const fn name(self) -> &'static str {
        match self {
            Self::EncoderBusy => "encoder_busy",
            Self::DiskSlow => "disk_slow",
            Self::WriteFailed => "write_failed",
            Self::EncodeFailed => "encode_failed",
            Self::BadSet => "bad_set",
            Self::Ended => "ended",
        }
    }
}

/// A set that was refused; it is counted already.
#[derive(Debug)]
pub struct PushError {
    /// Why.
    pub reason: SetDrop,
    /// The same in words, with the numbers.
    pub message: String,
}

impl core::fmt::Display for PushError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(&self.message)
    }
}

impl std::error::Error for PushError {}
