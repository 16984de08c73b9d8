//! The forms of a message of `side_by_side`, as others found them. All numbers are little-endian.
//!
//! **JPEG strips**: two `u32` of time, four `u64` sizes, then four grey baseline JPEGs. Below each other they are one
//! grey image whose bytes are the side-by-side image in YUYV.
//!
//! **H.264, H.265**: `u32` size of what follows, `u32` size of the access unit, the unit in Annex B form, then 56
//! bytes: width and height (0, 4), UTC in nanoseconds (0x18), size (0x20), kind (0x24, 3 for a key frame), number of
//! the last key frame (0x28) and of this one (0x30).

use depthrig_driver::bytes::{i32_at, u32_at, u64_at};

/// Strips of an image.
pub const STRIPS: usize = 4;
/// Bytes before the strips.
const STRIPS_HEAD: usize = 8 + 8 * STRIPS;
/// Bytes after an access unit.
const FOOTER: usize = 56;

/// Payload of a message.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Payload<'a> {
    /// Four JPEGs, from the top.
    Strips([&'a [u8]; STRIPS]),
    /// An access unit in Annex B form, and what follows it.
    H264(&'a [u8], Option<Footer>),
    /// The same, but H.265.
    H265,
    /// Neither, because of this.
    Unknown(&'static str),
}

/// The footer behind an access unit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Footer {
    /// Pixels per row of the side-by-side image.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// UTC, nanoseconds.
    pub time_ns: u64,
    /// It needs none before it.
    pub is_key: bool,
    /// Number of the newest key frame.
    pub last_key: i32,
    /// Its own number.
    pub number: i32,
}

impl Footer {
    fn parse(bytes: &[u8]) -> Option<Self> {
        if bytes.len() < FOOTER {
            return None;
        }
        Some(Self {
            width: u32_at(bytes, 0)?,
            height: u32_at(bytes, 4)?,
            time_ns: u64_at(bytes, 0x18)?,
            is_key: i32_at(bytes, 0x24)? == 3,
            last_key: i32_at(bytes, 0x28)?,
            number: i32_at(bytes, 0x30)?,
        })
    }

    /// Width and height of the side-by-side image.
    pub const fn size(self) -> (u32, u32) {
        (self.width, self.height)
    }

    /// Number of the key frame that pair `index`, which has this footer, depends on; `None` if the numbers are not
    /// those of the file's pairs, as in a file that was cut out of another.
    pub fn key_of(self, index: u64) -> Option<u64> {
        let own = u64::try_from(self.number).ok().filter(|n| *n == index)?;
        if self.is_key {
            return Some(own);
        }
        u64::try_from(self.last_key).ok().filter(|k| *k <= own)
    }
}

impl<'a> Payload<'a> {
    /// Looks at a message. Nothing is decoded.
    pub fn parse(data: &'a [u8]) -> Self {
        if let Some(strips) = strips(data) {
            return Self::Strips(strips);
        }
        let (Some(total), Some(size)) = (u32_at(data, 0), u32_at(data, 4)) else {
            return Self::Unknown("a message is too short");
        };
        let unit = usize::try_from(size).ok().and_then(|n| data.get(8..8usize.checked_add(n)?));
        let Some(unit) = unit.filter(|_| total >= size && total as usize <= data.len() - 4) else {
            return Self::Unknown("the sizes in a message are not its own");
        };
        let footer = data.get(8 + unit.len()..).and_then(Footer::parse);
        match codec(unit) {
            Some(Codec::H264) => Self::H264(unit, footer),
            Some(Codec::H265) => Self::H265,
            None => Self::Unknown("a message has no start code"),
        }
    }

    /// For messages.
    pub const fn name(&self) -> &'static str {
        match self {
            Self::Strips(_) => "JPEG",
            Self::H264(..) => "H.264",
            Self::H265 => "H.265",
            Self::Unknown(why) => why,
        }
    }
}

fn strips(data: &[u8]) -> Option<[&[u8]; STRIPS]> {
    let mut strips: [&[u8]; STRIPS] = [&[]; STRIPS];
    let mut at = STRIPS_HEAD;
    for (i, strip) in strips.iter_mut().enumerate() {
        let size = usize::try_from(u64_at(data, 8 + 8 * i)?).ok()?;
        *strip = data.get(at..at.checked_add(size)?)?;
        if !strip.starts_with(&[0xFF, 0xD8]) {
            return None;
        }
        at += size;
    }
    Some(strips)
}

enum Codec {
    H264,
    H265,
}

/// Identifies the codec by the headers of the first network abstraction layer units (ITU-T H.264 table 7-1, H.265
/// table 7-1): a unit of H.265 has two bytes of them, and parameter sets with numbers that H.264 does not use.
fn codec(unit: &[u8]) -> Option<Codec> {
    let mut seen = None;
    for i in 0..unit.len().saturating_sub(4) {
        if unit.get(i..i + 3) != Some(&[0, 0, 1]) {
            continue;
        }
        let (Some(first), Some(second)) = (unit.get(i + 3), unit.get(i + 4)) else { break };
        if first & 0x80 != 0 {
            return None;
        }
        // H.265: layer 0, temporal number 1; video, sequence and image parameter sets, delimiter.
        let h265_set = *second == 1 && matches!(first >> 1, 32..=35) && first & 1 == 0;
        // H.264: a reference image's sets, slices, delimiter; not 0, and nothing that is undefined.
        let h264 = matches!(first & 0x1F, 1..=9);
        match (h265_set, h264) {
            (true, _) => return Some(Codec::H265),
            (false, true) if matches!(first & 0x1F, 7..=9) => return Some(Codec::H264),
            // Slices: the second byte of H.265's header is 1 in all streams without layers.
            (false, true) => {
                seen = Some(if *second == 1 && matches!(first >> 1, 0..=21 | 39 | 40) && first & 1 == 0 {
                    Codec::H265
                } else {
                    Codec::H264
                });
                break;
            }
            _ => seen = seen.or(Some(Codec::H265)),
        }
    }
    seen
}
