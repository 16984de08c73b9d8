//! EBML as Matroska uses it (RFC 8794, RFC 9559): elements of an identifier, a length and that many bytes.
//!
//! Pure functions on bytes. What claims more bytes than there are is `None` or the end of an iteration, never a guess.

/// The identifiers that a Kinect's recording has. RFC 9559, section 5.1.
pub mod id {
    #![allow(missing_docs)] // their names are the standard's
    pub const EBML: u32 = 0x1A45_DFA3;
    pub const DOC_TYPE: u32 = 0x4282;
    pub const CRC_32: u32 = 0xBF;
    pub const VOID: u32 = 0xEC;
    pub const SEGMENT: u32 = 0x1853_8067;
    pub const SEEK_HEAD: u32 = 0x114D_9B74;
    pub const SEEK: u32 = 0x4DBB;
    pub const SEEK_ID: u32 = 0x53AB;
    pub const SEEK_POSITION: u32 = 0x53AC;
    pub const INFO: u32 = 0x1549_A966;
    pub const TIMESTAMP_SCALE: u32 = 0x002A_D7B1;
    pub const DURATION: u32 = 0x4489;
    pub const DATE_UTC: u32 = 0x4461;
    pub const WRITING_APP: u32 = 0x5741;
    pub const TRACKS: u32 = 0x1654_AE6B;
    pub const TRACK_ENTRY: u32 = 0xAE;
    pub const TRACK_NUMBER: u32 = 0xD7;
    pub const TRACK_UID: u32 = 0x73C5;
    pub const TRACK_NAME: u32 = 0x536E;
    pub const CODEC_ID: u32 = 0x86;
    pub const CODEC_PRIVATE: u32 = 0x63A2;
    pub const DEFAULT_DURATION: u32 = 0x0023_E383;
    pub const ATTACHMENTS: u32 = 0x1941_A469;
    pub const ATTACHED_FILE: u32 = 0x61A7;
    pub const FILE_NAME: u32 = 0x466E;
    pub const FILE_DATA: u32 = 0x465C;
    pub const FILE_UID: u32 = 0x46AE;
    pub const TAGS: u32 = 0x1254_C367;
    pub const TAG: u32 = 0x7373;
    pub const TARGETS: u32 = 0x63C0;
    pub const TAG_TRACK_UID: u32 = 0x63C5;
    pub const TAG_ATTACHMENT_UID: u32 = 0x63C6;
    pub const SIMPLE_TAG: u32 = 0x67C8;
    pub const TAG_NAME: u32 = 0x45A3;
    pub const TAG_STRING: u32 = 0x4487;
    pub const CLUSTER: u32 = 0x1F43_B675;
    pub const TIMESTAMP: u32 = 0xE7;
    pub const SIMPLE_BLOCK: u32 = 0xA3;
    pub const BLOCK_GROUP: u32 = 0xA0;
    pub const BLOCK: u32 = 0xA1;
    pub const CUES: u32 = 0x1C53_BB6B;
    pub const CUE_POINT: u32 = 0xBB;
    pub const CUE_TIME: u32 = 0xB3;
    pub const CUE_TRACK_POSITIONS: u32 = 0xB7;
    pub const CUE_CLUSTER_POSITION: u32 = 0xF1;
    pub const CHAPTERS: u32 = 0x1043_A770;
}

/// The most bytes that the head of an element has.
pub const MAX_HEAD: usize = 12;

/// The head of an element.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Head {
    /// Its identifier, with the marks of its length.
    pub id: u32,
    /// Bytes of the head itself.
    pub len: usize,
    /// Bytes of what follows; `None` when the writer did not know.
    pub size: Option<u64>,
}

/// The head at the start of `bytes`; `None` if it is incomplete or invalid.
pub fn head(bytes: &[u8]) -> Option<Head> {
    let id_len = bytes.first()?.leading_zeros() as usize + 1;
    if id_len > 4 {
        return None;
    }
    let id = bytes.get(..id_len)?.iter().fold(0, |id, b| id << 8 | u32::from(*b));
    let (size, size_len) = vint(bytes.get(id_len..)?)?;
    Some(Head { id, len: id_len + size_len, size })
}

/// A number of variable length at the start of `bytes`, and that length; the number is `None` when all its bits are
/// set, which stands for "unknown".
pub fn vint(bytes: &[u8]) -> Option<(Option<u64>, usize)> {
    let len = bytes.first()?.leading_zeros() as usize + 1;
    let all = u64::MAX >> (64 - 7 * len.min(8));
    let value = bytes.get(..len).filter(|_| len <= 8)?.iter().fold(0, |n, b| n << 8 | u64::from(*b)) & all;
    Some((Some(value).filter(|v| *v != all), len))
}

/// The elements in the body of another, up to the first incomplete one.
#[derive(Debug, Clone)]
pub struct Children<'a> {
    rest: &'a [u8],
    is_complete: bool,
}

/// The elements in `body`.
pub const fn children(body: &[u8]) -> Children<'_> {
    Children { rest: body, is_complete: true }
}

impl Children<'_> {
    /// Whether all elements so far were complete: false after an iteration that an element ended which claims more than
    /// there is.
    pub const fn is_complete(&self) -> bool {
        self.is_complete
    }
}

impl<'a> Iterator for Children<'a> {
    type Item = (u32, &'a [u8]);

    fn next(&mut self) -> Option<Self::Item> {
        if self.rest.is_empty() || !self.is_complete {
            return None;
        }
        let found = head(self.rest).and_then(|h| {
            let rest = self.rest.get(h.len..)?;
            let (body, rest) = rest.split_at_checked(usize::try_from(h.size?).ok()?)?;
            Some((h.id, body, rest))
        });
        let Some((id, body, rest)) = found else {
            self.is_complete = false;
            return None;
        };
        self.rest = rest;
        Some((id, body))
    }
}

/// The first child of `body` with this identifier.
pub fn child(body: &[u8], id: u32) -> Option<&[u8]> {
    children(body).find(|c| c.0 == id).map(|c| c.1)
}

/// An unsigned number: big-endian, up to 8 bytes, none for 0.
pub fn uint(body: &[u8]) -> Option<u64> {
    (body.len() <= 8).then(|| body.iter().fold(0, |n, b| n << 8 | u64::from(*b)))
}

/// The unsigned number in the child `id` of `body`.
pub fn child_uint(body: &[u8], id: u32) -> Option<u64> {
    uint(child(body, id)?)
}

/// A float of 4 or 8 bytes, whatever it holds.
pub fn float(body: &[u8]) -> Option<f64> {
    match body.len() {
        4 => Some(f64::from(f32::from_be_bytes(*body.first_chunk()?))),
        8 => Some(f64::from_be_bytes(*body.first_chunk()?)),
        _ => None,
    }
}

/// Text, which ends at a zero byte if it has one; invalid UTF-8 is replaced.
pub fn text(body: &[u8]) -> String {
    String::from_utf8_lossy(body.split(|b| *b == 0).next().unwrap_or_default()).into_owned()
}

/// The text in the child `id` of `body`.
pub fn child_text(body: &[u8], id: u32) -> Option<String> {
    child(body, id).map(text)
}

/// How several frames share a block. RFC 9559, section 10.3.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
enum Lacing {
    #[default]
    None,
    Xiph,
    Fixed,
    Ebml,
}

/// A block: of which track, when, and its frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Block<'a> {
    /// Number of the track.
    pub track: u64,
    /// Time after the cluster's, in units of the file.
    pub time: i16,
    lacing: Lacing,
    /// From the number of frames on, if frames share the block; else the frame.
    body: &'a [u8],
}

/// Reads the head of a `SimpleBlock` or `Block`.
pub fn block(body: &[u8]) -> Option<Block<'_>> {
    let (track, len) = vint(body)?;
    let [high, low, flags] = *body.get(len..)?.first_chunk()?;
    let lacing = match flags >> 1 & 3 {
        0 => Lacing::None,
        1 => Lacing::Xiph,
        2 => Lacing::Fixed,
        _ => Lacing::Ebml,
    };
    Some(Block { track: track?, time: i16::from_be_bytes([high, low]), lacing, body: body.get(len + 3..)? })
}

/// The frames of a block, one after the other.
#[derive(Debug, Clone, Default)]
pub struct Frames<'a> {
    lacing: Lacing,
    /// Where the sizes are that are still to be read.
    sizes: &'a [u8],
    /// The frames that are still to be taken.
    data: &'a [u8],
    left: usize,
    /// Size of the frame before, for sizes that are given as differences.
    last: Option<u64>,
}

impl<'a> Block<'a> {
    /// Its frames; `None` when their sizes do not fit in it.
    pub fn frames(&self) -> Option<Frames<'a>> {
        if self.lacing == Lacing::None {
            return Some(Frames { lacing: self.lacing, sizes: &[], data: self.body, left: 1, last: None });
        }
        let (count, rest) = self.body.split_first()?;
        let left = usize::from(*count) + 1;
        // The sizes of all frames but the last come first.
        let mut probe = Frames { lacing: self.lacing, sizes: rest, data: &[], left, last: None };
        let mut total = 0_u64;
        if self.lacing == Lacing::Fixed {
            if !rest.len().is_multiple_of(left) {
                return None;
            }
            return Some(Frames { data: rest, last: Some((rest.len() / left) as u64), ..probe });
        }
        for _ in 1..left {
            total = total.checked_add(probe.size()?)?;
        }
        let data = probe.sizes;
        let fits = usize::try_from(total).is_ok_and(|total| total <= data.len());
        fits.then_some(Frames { lacing: self.lacing, sizes: rest, data, left, last: None })
    }
}

impl Frames<'_> {
    /// The next size out of the list.
    fn size(&mut self) -> Option<u64> {
        match self.lacing {
            Lacing::None => None,
            Lacing::Fixed => self.last,
            Lacing::Xiph => {
                let full = self.sizes.iter().take_while(|b| **b == 255).count();
                let end = *self.sizes.get(full)?;
                self.sizes = self.sizes.get(full + 1..)?;
                Some(full as u64 * 255 + u64::from(end))
            }
            Lacing::Ebml => {
                let (value, len) = vint(self.sizes)?;
                self.sizes = self.sizes.get(len..)?;
                let size = match self.last {
                    None => value?,
                    // Differences are moved up by half of what their length can hold.
                    Some(last) => last.checked_add_signed(value? as i64 - ((1 << (7 * len - 1)) - 1))?,
                };
                self.last = Some(size);
                Some(size)
            }
        }
    }
}

impl<'a> Iterator for Frames<'a> {
    type Item = &'a [u8];

    fn next(&mut self) -> Option<&'a [u8]> {
        self.left = self.left.checked_sub(1)?;
        if self.left == 0 {
            return Some(core::mem::take(&mut self.data));
        }
        let size = usize::try_from(self.size()?).ok()?;
        let (frame, rest) = self.data.split_at_checked(size)?;
        self.data = rest;
        Some(frame)
    }
}

#[cfg(test)]
mod tests;
