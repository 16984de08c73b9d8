//! Sixel images: six rows of pixels at a time, colour by colour (DEC STD 070).

use color_quant::NeuQuant;
use core::fmt::Write as _;
use image::RgbImage;

/// Colours of an image. More would make it larger, and many terminals have no more than 256.
const COLORS: usize = 128;
/// Every n-th pixel decides about the colours, 1 to 30.
const SAMPLE: i32 = 7;
/// Rows of a band.
const BAND: u32 = 6;
/// Repetitions from which a run is shorter than its characters.
const RUN: usize = 4;

/// Draws an image where the cursor is. The cursor is somewhere else afterwards.
pub fn image(image: &RgbImage) -> String {
    let width = image.width() as usize;
    let rgba: Vec<u8> = image.pixels().flat_map(|p| [p[0], p[1], p[2], 255]).collect();
    let quantizer = NeuQuant::new(SAMPLE, COLORS, &rgba);
    let palette = quantizer.color_map_rgb();
    let indices = indices(&rgba, &quantizer);
    // Pixels that no colour sets stay as they are (0;1), and are square (1;1).
    let mut out = format!("\x1bP0;1;0q\"1;1;{};{}", image.width(), image.height());
    let mut used = [false; 256];
    for index in &indices {
        used[usize::from(*index)] = true;
    }
    for (index, color) in palette.as_chunks::<3>().0.iter().enumerate().filter(|(i, _)| used[*i]) {
        let [r, g, b] = color.map(|c| (u32::from(c) * 100 + 127) / 255);
        // Writing to a string cannot fail.
        let _ = write!(out, "#{index};2;{r};{g};{b}");
    }
    for rows in indices.chunks(width * BAND as usize) {
        band(rows, width, &mut out);
        out.push('-');
    }
    out.push_str("\x1b\\");
    out
}

/// The palette's colour of each pixel. Colours that agree in their five upper bits share one.
fn indices(rgba: &[u8], quantizer: &NeuQuant) -> Vec<u8> {
    let mut known = vec![None; 1 << 15];
    let index = |pixel: &[u8; 4]| {
        let key = pixel[..3].iter().fold(0, |key, c| (key << 5) | usize::from(c >> 3));
        *known[key].get_or_insert_with(|| quantizer.index_of(pixel) as u8)
    };
    rgba.as_chunks::<4>().0.iter().map(index).collect()
}

/// One band: for each of its colours, a character a column with a bit a row.
fn band(rows: &[u8], width: usize, out: &mut String) {
    let mut colors: Vec<u8> = rows.to_vec();
    colors.sort_unstable();
    colors.dedup();
    for (i, color) in colors.iter().enumerate() {
        let _ = write!(out, "{}#{color}", if i == 0 { "" } else { "$" });
        let column = |x: usize| {
            let bits = rows.iter().skip(x).step_by(width).enumerate();
            bits.fold(0, |bits, (row, index)| bits | (u8::from(index == color) << row))
        };
        let mut run = 0;
        let mut last = column(0);
        for x in 1..=width {
            run += 1;
            let next = (x < width).then(|| column(x));
            if next != Some(last) {
                let character = char::from(b'?' + last);
                if run < RUN {
                    out.extend(core::iter::repeat_n(character, run));
                } else {
                    let _ = write!(out, "!{run}{character}");
                }
                run = 0;
                last = next.unwrap_or(0);
            }
        }
    }
}
