//! Metadata that the kernel delivers beside an image: the payload headers of USB video, and how to find those of an
//! image.

use depthrig_usb::uvc::formats::FourCc;

/// The format that a metadata node was set to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
pub enum MetadataFormat {
    /// Payload headers with the blocks of RealSense D400 cameras.
    D4xx,
    /// Payload headers of 2 to 12 bytes.
    Uvch,
    /// No metadata node, or one with another format.
    #[default]
    None,
}

impl MetadataFormat {
    /// The code that asks the kernel for it.
    pub const fn fourcc(self) -> Option<FourCc> {
        match self {
            Self::D4xx => Some(FourCc::D4XX),
            Self::Uvch => Some(FourCc::UVCH),
            Self::None => None,
        }
    }

    /// The format that the kernel set.
    pub fn from_fourcc(code: FourCc) -> Self {
        match code {
            FourCc::D4XX => Self::D4xx,
            FourCc::UVCH => Self::Uvch,
            _ => Self::None,
        }
    }
}

/// Bytes of the kernel's own prefix of a block: host time (8) and bus frame number (2). Kernel documentation,
/// "V4L2_META_FMT_UVC".
const PREFIX: usize = 10;

/// The payload header in a buffer of a metadata node: its first block without the kernel's prefix, from the byte
/// with its own length to its end. `None` when the buffer is too short for what it claims.
///
/// The kernel writes one block per payload; an image that came in several has the same stamp in each. With
/// [`MetadataFormat::Uvch`] it leaves out what the vendor put behind the standard part, yet the length stays that of
/// the whole.
pub fn payload_header(record: &[u8], format: MetadataFormat) -> Option<&[u8]> {
    let block = record.get(PREFIX..)?;
    let length = usize::from(*block.first()?);
    let flags = *block.get(1)?;
    if length < 2 {
        return None;
    }
    // USB video class 1.5, table 2-6: presentation time of 4 bytes, clock sample of 6.
    let standard = 2 + if flags & 0x04 == 0 { 0 } else { 4 } + if flags & 0x08 == 0 { 0 } else { 6 };
    block.get(..if format == MetadataFormat::Uvch { length.min(standard) } else { length })
}

/// The longest record that is kept: prefix and a header of 255 bytes.
pub(super) const RECORD_BYTES: usize = PREFIX + 255;

/// Two stamps of one image, taken at two moments, are no further apart than this (5 ms).
const NEAR_NS: i64 = 5_000_000;
/// Records that wait for their images; more are never on their way, as there are no more buffers.
const KEPT: usize = 16;

/// One record of a metadata node.
#[derive(Clone, Copy)]
pub(super) struct Record {
    pub(super) sequence: u32,
    pub(super) stamp_ns: i64,
    length: usize,
    bytes: [u8; RECORD_BYTES],
}

impl Record {
    /// A copy of the first bytes of a buffer: what lies behind the first block is dropped.
    pub(super) fn new(sequence: u32, stamp_ns: i64, buffer: &[u8]) -> Self {
        let mut bytes = [0; RECORD_BYTES];
        let length = buffer.len().min(RECORD_BYTES);
        for (to, from) in bytes.iter_mut().zip(buffer) {
            *to = *from;
        }
        Self { sequence, stamp_ns, length, bytes }
    }

    pub(super) fn bytes(&self) -> &[u8] {
        self.bytes.get(..self.length).unwrap_or_default()
    }

    /// Whether this belongs to the image with that number and stamp.
    ///
    /// `uvcvideo` gives both to the record; with its parameter `hwtimestamps` the image's stamp is moved a little
    /// afterwards. `vivid` counts the records by themselves and gives them the image's stamp.
    fn belongs_to(&self, sequence: u32, stamp_ns: i64) -> bool {
        self.stamp_ns == stamp_ns
            || (self.sequence == sequence && self.stamp_ns.abs_diff(stamp_ns) < NEAR_NS.unsigned_abs())
    }
}

/// Records that wait for their images.
#[derive(Default)]
pub(super) struct Waiting {
    records: Vec<Record>,
}

impl Waiting {
    /// Keeps one; the oldest goes when there are too many.
    pub(super) fn keep(&mut self, record: &Record) {
        if self.records.len() >= KEPT {
            self.records.remove(0);
        }
        self.records.push(*record);
    }

    /// Whether the record of that image has come.
    pub(super) fn has(&self, sequence: u32, stamp_ns: i64) -> bool {
        self.records.iter().any(|r| r.belongs_to(sequence, stamp_ns))
    }

    /// The record of that image. Those that came before it are dropped: their images will not come any more.
    pub(super) fn take(&mut self, sequence: u32, stamp_ns: i64) -> Option<Record> {
        let at = self.records.iter().position(|r| r.belongs_to(sequence, stamp_ns))?;
        let record = self.records.get(at).copied();
        self.records.drain(..=at);
        record
    }
}

#[cfg(test)]
mod tests {
    use super::MetadataFormat::{D4xx, Uvch};
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn a_header_is_cut_out_of_its_record() {
        let mut record = vec![0; PREFIX];
        record.extend([12, 0x8F, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 99]);
        assert_eq!(payload_header(&record, D4xx), Some(&record[10..22]));
        assert_eq!(payload_header(&record[..21], D4xx), None, "the last byte of the header is missing");
        record[10] = 1;
        assert_eq!(payload_header(&record, D4xx), None, "shorter than length and flags");
        assert_eq!(payload_header(&[], D4xx), None);
    }

    #[test]
    fn the_standard_header_of_a_longer_one_is_told_by_its_flags() {
        // uvcvideo's record of the header of a D435: 232 bytes long, of which it hands over 12.
        let mut record = vec![0; PREFIX];
        record.extend([232, 0x8F, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10]);
        assert_eq!(payload_header(&record, Uvch), Some(&record[10..22]));
        record.extend([0; 250]);
        assert_eq!(
            payload_header(&record, Uvch),
            Some(&record[10..22]),
            "the next record does not belong to it"
        );
        record[11] = 0x86;
        assert_eq!(payload_header(&record, Uvch), Some(&record[10..16]), "presentation time alone");
        record[10] = 2;
        assert_eq!(payload_header(&record, Uvch), Some(&record[10..12]));
    }

    proptest! {
        #[test]
        fn any_bytes_are_a_header_or_none(record: Vec<u8>) {
            if let Some(header) = payload_header(&record, D4xx) {
                prop_assert_eq!(header.len(), usize::from(header[0]));
                prop_assert_eq!(header.as_ptr(), record[PREFIX..].as_ptr());
            }
        }
    }

    #[test]
    fn an_image_gets_its_own_record_and_no_other() {
        let mut waiting = Waiting::default();
        for (sequence, stamp) in [(7, 100_000_000), (8, 133_000_000), (9, 166_000_000)] {
            waiting.keep(&Record::new(sequence, stamp, &[sequence as u8]));
        }
        assert!(waiting.has(8, 133_000_000));
        assert!(!waiting.has(12, 133_000_001), "another image, a moment later");
        assert!(!waiting.has(8, 150_000_000), "that number, but long after: the counter began anew");
        assert_eq!(waiting.take(8, 134_000_000).unwrap().bytes(), [8], "stamp moved by the kernel");
        assert!(!waiting.has(7, 100_000_000), "its image was lost before");
        assert_eq!(waiting.take(30, 166_000_000).unwrap().bytes(), [9], "records counted by themselves");
        assert!(waiting.take(9, 166_000_000).is_none());
    }

    #[test]
    fn records_without_images_do_not_pile_up() {
        let mut waiting = Waiting::default();
        for i in 0..100 {
            waiting.keep(&Record::new(i, i64::from(i) * 33_000_000, &[0; 400]));
        }
        assert_eq!(waiting.records.len(), KEPT);
        assert_eq!(waiting.take(99, 99 * 33_000_000).unwrap().bytes().len(), RECORD_BYTES);
    }
}
