//! Letters of 3x5 pixels, enough for labels in an image: no font need be there.

use image::{Rgb, RgbImage};

/// Pixels from one letter to the next.
pub const ADVANCE: u32 = 4;

/// Rows from the top, three bits each, the highest bit leftmost.
const fn glyph(c: char) -> u16 {
    match c {
        'A' => 0b010_101_111_101_101,
        'B' => 0b110_101_110_101_110,
        'C' => 0b011_100_100_100_011,
        'D' => 0b110_101_101_101_110,
        'E' => 0b111_100_110_100_111,
        'F' => 0b111_100_110_100_100,
        'G' => 0b011_100_101_101_011,
        'H' => 0b101_101_111_101_101,
        'I' => 0b111_010_010_010_111,
        'J' => 0b001_001_001_101_010,
        'K' => 0b101_101_110_101_101,
        'L' => 0b100_100_100_100_111,
        'M' => 0b101_111_111_101_101,
        'N' => 0b110_101_101_101_101,
        'O' | '0' => 0b010_101_101_101_010,
        'P' => 0b110_101_110_100_100,
        'Q' => 0b010_101_101_110_011,
        'R' => 0b110_101_110_101_101,
        'S' => 0b011_100_010_001_110,
        'T' => 0b111_010_010_010_010,
        'U' => 0b101_101_101_101_111,
        'V' => 0b101_101_101_101_010,
        'W' => 0b101_101_111_111_101,
        'X' => 0b101_101_010_101_101,
        'Y' => 0b101_101_010_010_010,
        'Z' => 0b111_001_010_100_111,
        '1' => 0b010_110_010_010_111,
        '2' => 0b110_001_010_100_111,
        '3' => 0b110_001_010_001_110,
        '4' => 0b101_101_111_001_001,
        '5' => 0b111_100_110_001_110,
        '6' => 0b011_100_110_101_010,
        '7' => 0b111_001_010_010_010,
        '8' => 0b010_101_010_101_010,
        '9' => 0b010_101_011_001_110,
        '.' => 0b000_000_000_000_010,
        ',' => 0b000_000_000_010_100,
        ':' => 0b000_010_000_010_000,
        '-' => 0b000_000_111_000_000,
        '+' => 0b000_010_111_010_000,
        '_' => 0b000_000_000_000_111,
        '/' => 0b001_001_010_100_100,
        '%' => 0b101_001_010_100_101,
        '(' => 0b001_010_010_010_001,
        ')' => 0b100_010_010_010_100,
        '@' => 0b010_101_111_100_011,
        _ => 0,
    }
}

/// Writes `text` in capitals with its top left corner at (x, y), each pixel of a letter `size` pixels wide.
pub fn text(image: &mut RgbImage, (x, y): (u32, u32), size: u32, color: Rgb<u8>, text: &str) {
    for (n, c) in text.chars().enumerate() {
        let bits = glyph(c.to_ascii_uppercase());
        for at in (0..15u32).filter(|at| bits >> (14 - at) & 1 == 1) {
            let left = x + (n as u32 * ADVANCE + at % 3) * size;
            let top = y + at / 3 * size;
            for py in top..(top + size).min(image.height()) {
                for px in left..(left + size).min(image.width()) {
                    image.put_pixel(px, py, color);
                }
            }
        }
    }
}
