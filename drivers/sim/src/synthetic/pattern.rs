//! Cheap frames: one memory copy each, and every byte can be checked from seed, stream and frame counter.
//!
//! A stream has one long strip of bytes, made when it starts; frame `n` is the window that begins `n mod 32`
//! steps into it, with `n` itself written over the first eight bytes. The strip is a smooth ramp with a little
//! noise, so that compressing it costs about what a camera's image does.

use super::noise::{Rolls, mix, normal_of, text_seed};
use depthrig_bus::PixelFormat;

/// Bytes between the windows of two frames: whole pixels of two and of three bytes, and a cache line.
const STEP: usize = 192;
const WINDOWS: u64 = 32;

/// The frames of one cheap stream.
#[derive(Debug, Clone)]
pub struct Pattern {
    strip: Vec<u8>,
    len: usize,
}

impl Pattern {
    /// The pattern of the stream called `stream`, for images of this format and size.
    pub fn new(seed: u64, stream: &str, format: PixelFormat, width: u32, height: u32) -> Self {
        let len = format.frame_bytes(width, height);
        let total = len + STEP * (WINDOWS as usize - 1);
        let seed = text_seed(seed, stream);
        let width = width as usize;
        let mut strip = Vec::with_capacity(total + 8);
        if format == PixelFormat::Z16 {
            for i in 0..total.div_ceil(2) as u64 {
                let x = i as usize % width;
                let y = i as usize / width;
                let bits = mix(seed ^ i);
                // One pixel in 64 is a hole, as in a camera's depth.
                let z = 600.0 + x as f32 * 0.25 + y as f32 * 0.5 + normal_of(bits);
                let z = if bits.is_multiple_of(64) { 0 } else { z as u16 };
                strip.extend_from_slice(&z.to_le_bytes());
            }
        } else {
            let base = Rolls::new(seed, 0, 0, 0).bits(0).to_le_bytes();
            for i in 0..total.div_ceil(3) as u64 {
                let x = i as usize % width;
                let y = i as usize / width;
                let noise = mix(seed ^ i).to_le_bytes();
                for c in 0..3 {
                    let ramp = usize::from(base[c]) + (x + y * (c + 1)) / 8;
                    strip.push((ramp as u8).wrapping_add(noise[c] & 3));
                }
            }
        }
        strip.truncate(total);
        Self { strip, len }
    }

    /// Writes frame `counter`.
    pub fn fill(&self, counter: u64, to: &mut [u8]) {
        to.copy_from_slice(self.window(counter));
        let stamp = counter.to_le_bytes();
        let n = to.len().min(stamp.len());
        to[..n].copy_from_slice(&stamp[..n]);
    }

    /// The number of the frame that `bytes` are, if they are exactly one of this pattern.
    pub fn identify(&self, bytes: &[u8]) -> Option<u64> {
        let counter = u64::from_le_bytes(bytes.get(..8)?.try_into().ok()?);
        (bytes.len() == self.len && bytes[8..] == self.window(counter)[8..]).then_some(counter)
    }

    fn window(&self, counter: u64) -> &[u8] {
        let start = STEP * (counter % WINDOWS) as usize;
        &self.strip[start..start + self.len]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_is_recognised_and_one_wrong_byte_is_too() {
        for format in [PixelFormat::Rgb8, PixelFormat::Z16] {
            let pattern = Pattern::new(3, "depth", format, 37, 11);
            let mut frame = vec![0; format.frame_bytes(37, 11)];
            for counter in [0, 1, 31, 32, 1 << 40] {
                pattern.fill(counter, &mut frame);
                assert_eq!(pattern.identify(&frame), Some(counter));
                assert_eq!(Pattern::new(3, "depth", format, 37, 11).identify(&frame), Some(counter));
                assert_eq!(Pattern::new(4, "depth", format, 37, 11).identify(&frame), None);
                let last = frame.len() - 1;
                frame[last] ^= 1;
                assert_eq!(pattern.identify(&frame), None);
            }
        }
    }
}
