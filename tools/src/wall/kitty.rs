//! Images by the graphics protocol of kitty: PNG as base64, in parts. <https://sw.kovidgoyal.net/kitty/graphics-protocol/>

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use core::fmt::Write as _;
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder as _, RgbImage};

/// Asks whether the terminal knows the protocol; nothing is shown.
pub const QUESTION: &str = "\x1b_Gi=31,s=1,v=1,a=q,t=d,f=24;AAAA\x1b\\";
const ANSWER: &[u8] = b"\x1b_Gi=31;OK";
/// Deletes all images.
pub const ERASE: &str = "\x1b_Ga=d,d=A,q=2\x1b\\";
/// Bytes of a part.
const PART: usize = 4096;

/// Whether the question was answered with yes.
pub fn is_answer(answer: &[u8]) -> bool {
    answer.windows(ANSWER.len()).any(|w| w == ANSWER)
}

/// Shows an image where the cursor is, and leaves the cursor there. It replaces the one with the same number.
pub fn image(image: &RgbImage, number: usize) -> String {
    let mut png = Vec::new();
    let encoder = PngEncoder::new_with_quality(&mut png, CompressionType::Fast, FilterType::Adaptive);
    let written = encoder.write_image(image.as_raw(), image.width(), image.height(), ExtendedColorType::Rgb8);
    // Memory takes any image.
    if written.is_err() {
        return String::new();
    }
    let text = STANDARD.encode(png);
    let parts = text.as_bytes().chunks(PART).map(String::from_utf8_lossy);
    let last = text.len().div_ceil(PART).saturating_sub(1);
    let mut out = String::new();
    for (i, part) in parts.enumerate() {
        let head = if i == 0 { format!("a=T,f=100,i={},p=1,C=1,q=2,", number + 1) } else { String::new() };
        // Writing to a string cannot fail.
        let _ = write!(out, "\x1b_G{head}m={};{part}\x1b\\", u8::from(i < last));
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_are_short_and_together_they_are_the_png() {
        let noise = RgbImage::from_fn(100, 80, |x, y| {
            image::Rgb([(x * y) as u8, (x * 7 + y * y) as u8, (x ^ y) as u8])
        });
        let text = super::image(&noise, 4);
        let parts: Vec<&str> =
            text.split_terminator("\x1b\\").map(|p| p.strip_prefix("\x1b_G").unwrap()).collect();
        assert!(parts.len() > 1 && parts.iter().all(|p| p.len() < PART + 64));
        assert!(parts[0].starts_with("a=T,f=100,i=5,p=1,C=1,q=2,m=1;"));
        assert!(parts.last().unwrap().starts_with("m=0;"));
        let payload: String = parts.iter().map(|p| p.split_once(';').unwrap().1).collect();
        let png = STANDARD.decode(payload).unwrap();
        assert_eq!(image::load_from_memory(&png).unwrap().to_rgb8(), noise);
    }
}
