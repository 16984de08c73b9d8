//! Images of half blocks: the upper half of a character in one colour, the lower in another.

use super::layout::Place;
use core::fmt::Write as _;
use image::{Rgb, RgbImage};

/// Draws an image at a place, two rows of pixels a line.
pub fn image(image: &RgbImage, place: Place) -> String {
    let mut out = String::new();
    for line in 0..image.height().div_ceil(2) {
        // Writing to a string cannot fail.
        let _ = write!(out, "\x1b[{};{}H", place.row + line as usize, place.column);
        let mut colors = None;
        for x in 0..image.width() {
            let upper = *image.get_pixel(x, 2 * line);
            let lower = image.get_pixel_checked(x, 2 * line + 1).copied();
            if colors != Some((upper, lower)) {
                colors = Some((upper, lower));
                color(&mut out, 38, Some(upper));
                color(&mut out, 48, lower);
            }
            out.push('▀');
        }
        out.push_str("\x1b[0m");
    }
    out
}

/// Sets a colour of 24 bits, or the terminal's own.
fn color(out: &mut String, which: u8, color: Option<Rgb<u8>>) {
    let _ = match color {
        Some(Rgb([r, g, b])) => write!(out, "\x1b[{which};2;{r};{g};{b}m"),
        None => write!(out, "\x1b[{}m", which + 1),
    };
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_rows_share_a_line_and_equal_colours_are_set_once() {
        let mut picked = RgbImage::new(2, 3);
        picked.put_pixel(0, 0, Rgb([1, 2, 3]));
        picked.put_pixel(1, 0, Rgb([1, 2, 3]));
        let text = image(&picked, Place { row: 5, column: 7 });
        let expected =
            "\x1b[5;7H\x1b[38;2;1;2;3m\x1b[48;2;0;0;0m▀▀\x1b[0m\x1b[6;7H\x1b[38;2;0;0;0m\x1b[49m▀▀\x1b[0m";
        assert_eq!(text, expected);
    }
}
