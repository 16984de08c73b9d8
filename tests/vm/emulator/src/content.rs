//! Contents of frames: a pattern computed once for each (camera, stream, mode), and a stamp that identifies each frame.
//!
//! Software emulation pays for every byte that is computed, so nothing but 32 bytes changes from frame to frame, and
//! the pattern is smooth, so that compressing it is cheap too. [`frame`]
//! computes the same bytes again from serial, stream, mode and index.

use crate::model::{Layout, Mode};

/// The length of a stamp.
pub const STAMP: usize = 32;
const MAGIC: [u8; 4] = *b"DRIG";

/// The first 32 bytes of every image (of both images, in a frame that holds two).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Stamp {
    /// [`hash`] of the serial.
    pub serial_hash: u64,
    /// The index of the stream in its model.
    pub stream: u16,
    /// The index of the frame: it counts every frame that was due since the camera was created, sent or not, and never
    /// starts again.
    pub index: u64,
}

impl Stamp {
    /// Its bytes: magic, stream (16 bits), 0, serial hash, index, CRC-32 of those 24, 0.
    pub fn bytes(&self) -> [u8; STAMP] {
        let mut bytes = [0; STAMP];
        bytes[..4].copy_from_slice(&MAGIC);
        bytes[4..6].copy_from_slice(&self.stream.to_le_bytes());
        bytes[8..16].copy_from_slice(&self.serial_hash.to_le_bytes());
        bytes[16..24].copy_from_slice(&self.index.to_le_bytes());
        let crc = crc32fast::hash(&bytes[..24]);
        bytes[24..28].copy_from_slice(&crc.to_le_bytes());
        bytes
    }

    /// Reads the stamp of an image that has been unpacked (and turned upright), or of a JPEG image as it came; `None`
    /// when it is missing or damaged.
    pub fn read(image: &[u8]) -> Option<Self> {
        let bytes: &[u8; STAMP] = image.strip_prefix(&JPEG_HEAD).unwrap_or(image).first_chunk()?;
        let long = |at: usize| Some(u64::from_le_bytes(*bytes.get(at..)?.first_chunk()?));
        let crc = u32::from_le_bytes([bytes[24], bytes[25], bytes[26], bytes[27]]);
        if bytes[..4] != MAGIC || crc32fast::hash(&bytes[..24]) != crc {
            return None;
        }
        let stream = u16::from_le_bytes([bytes[4], bytes[5]]);
        Some(Self { serial_hash: long(8)?, stream, index: long(16)? })
    }
}

/// A hash of a text (FNV-1a, 64 bits), which seeds what differs between cameras.
pub fn hash(text: &str) -> u64 {
    text.bytes().fold(0xCBF2_9CE4_8422_2325, |h, b| (h ^ u64::from(b)).wrapping_mul(0x100_0000_01B3))
}

/// Bytes before the stamp of a JPEG image: start of image, then a comment with room for it (ITU-T T.81, B.1.1).
const JPEG_HEAD: [u8; 6] = [0xFF, 0xD8, 0xFF, 0xFE, 0, STAMP as u8 + 2];
/// Quality of JPEG images, percent.
const JPEG_QUALITY: u8 = 95;

/// The bytes of a frame as they travel.
pub fn frame(serial: &str, stream: u16, mode: &Mode, index: u64) -> Vec<u8> {
    let mut bytes = pattern(serial, stream, mode);
    let stamp = Stamp { serial_hash: hash(serial), stream, index };
    put_stamp(&mut bytes, mode, &stamp);
    bytes
}

/// The pattern of a stream, without stamps.
pub(crate) fn pattern(serial: &str, stream: u16, mode: &Mode) -> Vec<u8> {
    if mode.layout == Layout::Jpeg {
        return jpeg(serial, stream, mode);
    }
    let seed = seed(serial, stream);
    let row = mode.row();
    let height = usize::from(mode.height);
    let mut bytes = vec![0; row * height];
    let wide = mode.fourcc == *b"Z16 ";
    for (y, line) in bytes.chunks_exact_mut(row.max(1)).enumerate() {
        // A band of rows differs from the next one, and a column from the next one: an image that is shifted, turned
        // or mixed up does not compare equal.
        let base = seed.wrapping_add(y as u32 * 7);
        if wide {
            for (x, pixel) in line.chunks_exact_mut(2).enumerate() {
                let depth = 400 + (base.wrapping_add(x as u32 * 3) & 0x7FF) as u16;
                pixel.copy_from_slice(&depth.to_le_bytes());
            }
        } else {
            for (x, byte) in line.iter_mut().enumerate() {
                *byte = (base.wrapping_add((x as u32 & !3) + (x as u32 & 3) * 61)) as u8;
            }
        }
    }
    bytes
}

fn seed(serial: &str, stream: u16) -> u32 {
    (hash(serial) ^ u64::from(stream).wrapping_mul(0x9E37_79B9)) as u32
}

/// The image that a JPEG of a stream was made of: red, green, blue, row after row. It is smooth, so that decoding it gives
/// nearly the same, and no two places of it look alike.
pub fn painted(serial: &str, stream: u16, mode: &Mode) -> Vec<u8> {
    let seed = seed(serial, stream);
    let width = u32::from(mode.width);
    let height = u32::from(mode.height);
    let ramp = |at: u32, of: u32| (at * 200 / of.max(1)) as u8 + 28;
    let blue = 40 + (seed % 160) as u8;
    let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
    pixels.flat_map(|(x, y)| [ramp(x, width), ramp(y, height), blue]).collect()
}

/// [`painted`] as a JPEG image with room for a stamp; empty when it cannot be encoded.
fn jpeg(serial: &str, stream: u16, mode: &Mode) -> Vec<u8> {
    let mut coded = Vec::new();
    let encoder = jpeg_encoder::Encoder::new(&mut coded, JPEG_QUALITY);
    let pixels = painted(serial, stream, mode);
    if encoder.encode(&pixels, mode.width, mode.height, jpeg_encoder::ColorType::Rgb).is_err() {
        return Vec::new();
    }
    let rest = coded.get(2..).unwrap_or_default();
    [&JPEG_HEAD[..], &[0; STAMP], rest].concat()
}

/// Writes the stamp into a frame, where its layout has it.
pub(crate) fn put_stamp(frame: &mut [u8], mode: &Mode, stamp: &Stamp) {
    let bytes = stamp.bytes();
    let mut put = |at: usize, value: u8| {
        if let Some(byte) = frame.get_mut(at) {
            *byte = value;
        }
    };
    for (i, value) in bytes.into_iter().enumerate() {
        match mode.layout {
            Layout::Plain => put(i, value),
            Layout::Jpeg => put(JPEG_HEAD.len() + i, value),
            Layout::Interleaved => {
                put(2 * i, value);
                put(2 * i + 1, value);
            }
            Layout::SideBySide => {
                put(i, value);
                put(mode.row() / 2 + i, value);
            }
            Layout::Turned => put(turned_offset(mode, i), value),
        }
    }
}

/// Where byte `i` of the first upright row lies in a turned frame.
///
/// The wire's pixel (row i, column j) belongs at x = Hs − 1 − i, y = Ws − 1 − j (librealsense
/// src/l500, rotation-transform.cpp, Apache-2.0), so upright (x, 0) is row Hs − 1 − x, column Ws − 1.
fn turned_offset(mode: &Mode, i: usize) -> usize {
    let pixel = (usize::from(mode.bits) / 8).max(1);
    let x = i / pixel;
    let part = i % pixel;
    let width = usize::from(mode.width);
    let height = usize::from(mode.height);
    ((height - 1 - x.min(height - 1)) * width + width - 1) * pixel + part
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mode(layout: Layout, bits: u8) -> Mode {
        let fourcc = if bits == 16 { *b"Z16 " } else { *b"GREY" };
        Mode { fourcc, layout, bits, width: 64, height: 48, interval: 333_333 }
    }

    #[test]
    fn a_stamp_reads_back_and_a_damaged_one_does_not() {
        let stamp = Stamp { serial_hash: hash("012345"), stream: 2, index: 1 << 33 };
        assert_eq!(Stamp::read(&stamp.bytes()), Some(stamp));
        for bit in 0..28 * 8 {
            let mut bytes = stamp.bytes();
            bytes[bit / 8] ^= 1 << (bit % 8);
            // Bytes 6 and 7 are covered by the checksum although they mean nothing.
            assert_eq!(Stamp::read(&bytes), None, "bit {bit}");
        }
        assert_eq!(Stamp::read(&stamp.bytes()[..31]), None);
    }

    #[test]
    fn both_images_of_a_frame_are_stamped() {
        let stamp = Stamp { serial_hash: hash("a"), stream: 1, index: 9 };
        let y8i = frame("a", 1, &mode(Layout::Interleaved, 16), 9);
        let (left, right): (Vec<u8>, Vec<u8>) = y8i.chunks(2).map(|p| (p[0], p[1])).unzip();
        assert_eq!((Stamp::read(&left), Stamp::read(&right)), (Some(stamp), Some(stamp)));
        let sbs = frame("a", 1, &mode(Layout::SideBySide, 16), 9);
        assert_eq!((Stamp::read(&sbs), Stamp::read(&sbs[64..])), (Some(stamp), Some(stamp)));
    }

    #[test]
    fn a_jpeg_has_its_stamp_in_a_comment_and_is_the_image_that_was_painted() {
        let mode = Mode { fourcc: *b"MJPG", ..mode(Layout::Jpeg, 16) };
        let sent = frame("a", 1, &mode, 9);
        assert_eq!(Stamp::read(&sent), Some(Stamp { serial_hash: hash("a"), stream: 1, index: 9 }));
        assert_eq!(Stamp::read(&sent[2..]), None);
        let mut seen = vec![0; 64 * 48 * 3];
        depthrig_driver::unpack::decode_jpeg(&sent, 64, 48, &mut seen).unwrap();
        let off = seen.iter().zip(painted("a", 1, &mode)).map(|(a, b)| a.abs_diff(b)).max();
        assert!(off.unwrap() <= 8, "{off:?}");
        assert_ne!(painted("a", 1, &mode), painted("b", 1, &mode));
    }

    #[test]
    fn a_turned_frame_has_its_stamp_upright() {
        let mode = mode(Layout::Turned, 16);
        let wire = frame("a", 0, &mode, 3);
        let ws = 64;
        let hs = 48;
        let mut upright = vec![0u8; wire.len()];
        for i in 0..hs {
            for j in 0..ws {
                let to = ((ws - 1 - j) * hs + (hs - 1 - i)) * 2;
                upright[to..to + 2].copy_from_slice(&wire[(i * ws + j) * 2..][..2]);
            }
        }
        assert_eq!(Stamp::read(&upright).map(|s| s.index), Some(3));
    }

    #[test]
    fn frames_differ_by_camera_stream_and_index() {
        let mode = mode(Layout::Plain, 16);
        let one = frame("a", 0, &mode, 0);
        assert_ne!(one[STAMP..], frame("b", 0, &mode, 0)[STAMP..]);
        assert_ne!(one[STAMP..], frame("a", 1, &mode, 0)[STAMP..]);
        assert_ne!(one, frame("a", 0, &mode, 1));
        assert_eq!(one[STAMP..], frame("a", 0, &mode, 1)[STAMP..]);
    }
}
