//! Fake SVO2 files for the tests of this crate and of those above: written by the `mcap` crate, with strips by the JPEG
//! encoder, and H.264 written bit by bit, without loss, so that decoded images can be compared byte by byte.

#![allow(clippy::missing_errors_doc, clippy::unwrap_used)] // for tests alone

use super::Pair;
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use depthrig_driver::bytes::put;
use jpeg_encoder::{ColorType, Encoder};
use std::io::Cursor;

/// Serial number of the fake camera.
pub const SERIAL: u32 = 32_101_234;
/// Its rate.
pub const RATE_HZ: u32 = 15;
/// Time of the first pair, nanoseconds of UTC.
const BEGAN_NS: i64 = 1_738_434_526_000_000_000;

/// A file to be written.
#[derive(Debug, Clone)]
pub struct FakeSvo {
    /// Topic of the video.
    pub topic: String,
    /// The message `svo_header`, if there is one.
    pub header: Option<String>,
    /// The messages of the video.
    pub frames: Vec<Vec<u8>>,
    /// Whether messages are in chunks.
    pub chunked: bool,
    /// Whether chunks have an index.
    pub indexed: bool,
    /// Pairs per chunk.
    pub per_chunk: usize,
}

impl FakeSvo {
    /// A file of `frames` messages.
    pub fn new(size: (u32, u32), frames: Vec<Vec<u8>>) -> Self {
        Self {
            topic: format!("Camera_SN{SERIAL}/side_by_side"),
            header: Some(Self::header_of(size, "5.0.1", false)),
            frames,
            chunked: true,
            indexed: true,
            per_chunk: 3,
        }
    }

    /// `n` pairs of [`images`] in JPEG strips.
    pub fn strips(size: (u32, u32), n: u64) -> Self {
        Self::new(size, (0..n).map(|i| strips(size, &images(size, i))).collect())
    }

    /// `n` pairs of [`images`] in H.264; each third is a key frame, and those between repeat it.
    pub fn h264(size: (u32, u32), n: u64) -> Self {
        let frame = |i: u64| {
            let key = i / 3 * 3;
            let bytes =
                if i == key { h264_key(size, &images(size, i)) } else { h264_repeat(size, (i - key) as u32) };
            unit(&bytes, (2 * size.0, size.1), i as i32, key as i32)
        };
        Self::new(size, (0..n).map(frame).collect())
    }

    /// The JSON of the header for images of this size.
    pub fn header_of((width, height): (u32, u32), sdk: &str, encrypted: bool) -> String {
        let mut bytes = [0; 128];
        for (at, v) in [(0, 2 * width), (4, height), (8, SERIAL), (0xC, RATE_HZ), (0x14, 8)] {
            put(&mut bytes, at, &v.to_le_bytes());
        }
        let text = STANDARD.encode(bytes);
        format!(
            r#"{{"zed_sdk_version":"{sdk}","imu_frequency_hz":400,"encrypted":{encrypted},"header":"{text}"}}"#
        )
    }

    /// The file.
    pub fn build(&self) -> Vec<u8> {
        let mut file = Cursor::new(Vec::new());
        let options = mcap::WriteOptions::new()
            .library("libmcap stereolabs")
            .use_chunks(self.chunked)
            .chunk_size(None)
            .emit_message_indexes(self.indexed);
        let mut w = options.create(&mut file).unwrap();
        let none = std::collections::BTreeMap::new();
        let head = w.add_channel(0, "svo_header", "json", &none).unwrap();
        let video = w.add_channel(0, &self.topic, "zed_sdk_encoded", &none).unwrap();
        let mut write = |channel_id: u16, sequence: u32, time: i64, data: &[u8], flush: bool| {
            let log_time = time as u64;
            let header =
                mcap::records::MessageHeader { channel_id, sequence, log_time, publish_time: log_time };
            w.write_to_known_channel(&header, data).unwrap();
            if flush {
                w.flush().unwrap();
            }
        };
        if let Some(json) = &self.header {
            write(head, 0, 0, json.as_bytes(), false);
        }
        for (i, frame) in self.frames.iter().enumerate() {
            write(video, i as u32, time_of(i as u64), frame, self.chunked && (i + 1) % self.per_chunk == 0);
        }
        w.finish().unwrap();
        drop(w);
        file.into_inner()
    }
}

/// When pair `i` was taken.
pub fn time_of(i: u64) -> i64 {
    BEGAN_NS + i as i64 * 66_666_667
}

/// Bytes that are nothing.
pub fn noise(n: usize) -> Vec<u8> {
    (0..n as u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 11) as u8 | 2).collect()
}

/// The left and right image of pair `i` in YUYV: smooth, the right one being the left one a few pixels to the left.
/// Rows come in pairs of one colour, so that 4:2:0 loses nothing.
pub fn images((width, height): (u32, u32), i: u64) -> Pair {
    let image = |shift: f64| -> Vec<u8> {
        let pixel = |x: u32, y: u32| {
            let luminance =
                120.0 + 60.0 * ((f64::from(x) + shift) / 23.0 + i as f64).sin() + f64::from(y % 64);
            let color = 128 + (y / 2 % 16) as u8 + i as u8;
            [luminance as u8, color + (x % 2) as u8]
        };
        (0..height).flat_map(|y| (0..width).flat_map(move |x| pixel(x, y))).collect()
    };
    Pair { index: i, capture_time_ns: time_of(i), left: image(0.0), right: image(8.0) }
}

/// Rows of both images beside each other.
fn beside(width: u32, pair: &Pair) -> Vec<u8> {
    let row = 2 * width as usize;
    let rows = pair.left.chunks(row).zip(pair.right.chunks(row));
    rows.flat_map(|(l, r)| [l, r]).flatten().copied().collect()
}

/// A message with a pair as four strips.
pub fn strips(size: (u32, u32), pair: &Pair) -> Vec<u8> {
    let row = 4 * size.0 as usize;
    let both = beside(size.0, pair);
    let rows = size.1 as usize / 4;
    let mut parts = Vec::new();
    for i in 0..4 {
        let end = if i == 3 { both.len() } else { (i + 1) * rows * row };
        let strip = &both[i * rows * row..end];
        let mut jpeg = Vec::new();
        let encoder = Encoder::new(&mut jpeg, 95);
        encoder.encode(strip, row as u16, (strip.len() / row) as u16, ColorType::Luma).unwrap();
        parts.push(jpeg);
    }
    let mut message = vec![0; 8];
    for p in &parts {
        message.extend((p.len() as u64).to_le_bytes());
    }
    message.extend(parts.concat());
    message
}

/// A message with an access unit and its footer.
pub fn unit(bytes: &[u8], (width, height): (u32, u32), number: i32, last_key: i32) -> Vec<u8> {
    let mut footer = [0; 56];
    put(&mut footer, 0, &width.to_le_bytes());
    put(&mut footer, 4, &height.to_le_bytes());
    put(&mut footer, 0x18, &time_of(number as u64).to_le_bytes());
    put(&mut footer, 0x20, &(bytes.len() as u32).to_le_bytes());
    put(&mut footer, 0x24, &(if number == last_key { 3i32 } else { 0 }).to_le_bytes());
    put(&mut footer, 0x28, &last_key.to_le_bytes());
    put(&mut footer, 0x30, &number.to_le_bytes());
    let size = bytes.len() as u32;
    [&(size + 60).to_le_bytes()[..], &size.to_le_bytes(), bytes, &footer].concat()
}

/// Bits of H.264, the highest first (ITU-T H.264, 7.2 and 9.1).
#[derive(Default)]
struct Bits {
    bytes: Vec<u8>,
    used: u32,
}

impl Bits {
    fn u(&mut self, n: u32, value: u32) -> &mut Self {
        for i in (0..n).rev() {
            if self.used.is_multiple_of(8) {
                self.bytes.push(0);
            }
            *self.bytes.last_mut().unwrap() |= ((value >> i & 1) as u8) << (7 - self.used % 8);
            self.used += 1;
        }
        self
    }

    /// Unsigned Exp-Golomb.
    fn ue(&mut self, value: u32) -> &mut Self {
        let n = (value + 1).ilog2();
        self.u(n, 0).u(n + 1, value + 1)
    }

    /// The unit with its start code, and with 3 put in where the bytes would look like one.
    fn nal(&mut self, header: u8) -> Vec<u8> {
        self.u(1, 1);
        let mut out = vec![0, 0, 0, 1, header];
        let mut zeros = 0;
        for b in &self.bytes {
            if zeros == 2 && *b <= 3 {
                out.push(3);
                zeros = 0;
            }
            zeros = if *b == 0 { zeros + 1 } else { 0 };
            out.push(*b);
        }
        out
    }
}

/// A key frame whose pixels are written out (macroblocks of type `I_PCM`), with both parameter sets.
fn h264_key(size: (u32, u32), pair: &Pair) -> Vec<u8> {
    let width = 2 * size.0 as usize;
    let height = size.1 as usize;
    let both = beside(size.0, pair);
    let across = width.div_ceil(16);
    let down = height.div_ceil(16);
    let mut sps = Bits::default();
    // Baseline, level 4; no order counts, one reference; macroblocks across and down.
    sps.u(8, 66).u(8, 0xC0).u(8, 40).ue(0).ue(0).ue(2).ue(1).u(1, 0);
    sps.ue(across as u32 - 1).ue(down as u32 - 1).u(1, 1).u(1, 1);
    // The excess of the macroblocks is cut off, in steps of two pixels.
    sps.u(1, 1).ue(0).ue((16 * across - width) as u32 / 2).ue(0).ue((16 * down - height) as u32 / 2).u(1, 0);
    let mut pps = Bits::default();
    pps.ue(0).ue(0).u(2, 0).ue(0).ue(0).ue(0).u(3, 0).ue(0).ue(0).ue(0).u(1, 1).u(2, 0);
    let mut slice = Bits::default();
    slice.ue(0).ue(7).ue(0).u(4, 0).ue(0).u(2, 0).ue(0).ue(1);
    let at = |x: usize, y: usize| 2 * (y.min(height - 1) * width + x.min(width - 1));
    for (my, mx) in (0..down).flat_map(|y| (0..across).map(move |x| (y, x))) {
        slice.ue(25);
        while !slice.used.is_multiple_of(8) {
            slice.u(1, 0);
        }
        let mut samples = Vec::with_capacity(384);
        for (y, x) in (0..16).flat_map(|y| (0..16).map(move |x| (y, x))) {
            samples.push(both[at(16 * mx + x, 16 * my + y)]);
        }
        for (c, y, x) in (0..2).flat_map(|c| (0..8).flat_map(move |y| (0..8).map(move |x| (c, y, x)))) {
            // Of YUYV the even pixel has U and the odd one V.
            let px = 16 * mx + 2 * x;
            let py = 16 * my + 2 * y;
            samples.push(both[at(px.min(width - 2) + c, py) + 1]);
        }
        slice.bytes.extend(&samples);
        slice.used += 8 * samples.len() as u32;
    }
    [sps.nal(0x67), pps.nal(0x68), slice.nal(0x65)].concat()
}

/// An image that is the one before it (all macroblocks skipped).
fn h264_repeat(size: (u32, u32), since_key: u32) -> Vec<u8> {
    let blocks = (2 * size.0).div_ceil(16) * size.1.div_ceil(16);
    let mut slice = Bits::default();
    slice.ue(0).ue(5).ue(0).u(4, since_key % 16).u(3, 0).ue(0).ue(1).ue(blocks);
    slice.nal(0x41)
}
