//! The frame counter as a strip of black and white blocks in the top-left corner of colour images, so that
//! whoever gets an image, through whatever codec, can identify its frame.
//!
//! Blocks are 4x4 pixels: white, black, the counter's low 32 bits with the highest first (white = 1), four
//! bits of checksum (the XOR of the counter's eight half-bytes), white, black.

const BLOCK: usize = 4;
const BITS: usize = 40;
/// Pixels per row below which an image gets no strip.
pub const MIN_WIDTH: u32 = (BLOCK * BITS) as u32;

fn encode(counter: u32) -> u64 {
    let check = (0..8).fold(0, |sum, i| sum ^ ((counter >> (4 * i)) & 0xF));
    (0b10 << 38) | (u64::from(counter) << 6) | (u64::from(check) << 2) | 0b10
}

/// Draws the strip into an RGB8 image without row padding; an image that is too small is left alone.
pub fn draw(rgb: &mut [u8], width: u32, counter: u32) {
    let row_bytes = width as usize * 3;
    if width < MIN_WIDTH || rgb.len() < row_bytes * BLOCK {
        return;
    }
    let code = encode(counter);
    let mut strip = [0u8; BITS * BLOCK * 3];
    for (i, block) in strip.chunks_exact_mut(BLOCK * 3).enumerate() {
        block.fill(if code >> (BITS - 1 - i) & 1 == 1 { 235 } else { 16 });
    }
    for row in rgb.chunks_exact_mut(row_bytes).take(BLOCK) {
        row[..strip.len()].copy_from_slice(&strip);
    }
}

/// The counter in the strip of an RGB8 image; `None` when the strip is missing or damaged.
pub fn read(rgb: &[u8], width: u32) -> Option<u32> {
    let row_bytes = width as usize * 3;
    if width < MIN_WIDTH || rgb.len() < row_bytes * BLOCK {
        return None;
    }
    let mut code = 0u64;
    for i in 0..BITS {
        // The inner 2x2 pixels: a codec blurs the border.
        let at = |x: usize, y: usize| y * row_bytes + (i * BLOCK + x) * 3;
        let sum: u32 =
            [(1, 1), (2, 1), (1, 2), (2, 2)].iter().map(|(x, y)| u32::from(rgb[at(*x, *y) + 1])).sum();
        code = (code << 1) | u64::from(sum > 4 * 126);
    }
    let counter = (code >> 6) as u32;
    (code == encode(counter)).then_some(counter)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_drawn_is_read() {
        let mut rgb = vec![90; 200 * 8 * 3];
        assert_eq!(read(&rgb, 200), None);
        for counter in [0, 1, 0xDEAD_BEEF, u32::MAX] {
            draw(&mut rgb, 200, counter);
            assert_eq!(read(&rgb, 200), Some(counter));
        }
        assert!(rgb[4 * 600..].iter().all(|b| *b == 90), "only the first four rows are touched");
        rgb[4 * 3 * 10 + 600 + 4] ^= 0xFF; // one of the four pixels that make a bit
        rgb[4 * 3 * 10 + 600 + 7] ^= 0xFF;
        rgb[4 * 3 * 10 + 1200 + 4] ^= 0xFF;
        assert_eq!(read(&rgb, 200), None);
        assert_eq!(read(&rgb[..100], 200), None);
    }

    #[test]
    fn a_small_image_is_left_alone() {
        let mut rgb = vec![7; 159 * 8 * 3];
        draw(&mut rgb, 159, 5);
        assert!(rgb.iter().all(|b| *b == 7));
    }
}
