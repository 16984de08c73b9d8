//! Four panels: colour, raw depth, refined depth, and their difference from 0 to 0.2 m, each with its legend.

use super::Look;
use crate::font;
use crate::turbo::{depth_color, turbo};
use image::{Rgb, RgbImage};

/// The difference at the end of the colours, metres; the panel of the paper on camera depth models has it too.
const MAX_DIFFERENCE_M: f32 = 0.2;
/// Panels are shrunk by a whole number to at most this width.
const MAX_WIDTH: u32 = 960;
const PAPER: Rgb<u8> = Rgb([250, 250, 250]);
const INK: Rgb<u8> = Rgb([20, 20, 20]);
/// What has depth in one of both alone.
const ONLY_REFINED: Rgb<u8> = Rgb([70, 70, 70]);
const ONLY_RAW: Rgb<u8> = Rgb([200, 0, 200]);
/// Height of the line above a panel, and of the legend below.
const HEAD: u32 = 26;
const LEGEND: u32 = 40;
const GAP: u32 = 12;
const LETTER: u32 = 3;

/// The picture.
pub(super) fn draw(look: &Look) -> RgbImage {
    let (w, h) = look.color.dimensions();
    let step = w.div_ceil(MAX_WIDTH).max(1);
    let (pw, ph) = ((w / step).max(1), (h / step).max(1));
    let (width, height) = (2 * pw + 3 * GAP, 2 * (ph + HEAD + LEGEND) + 3 * GAP);
    let mut image = RgbImage::from_pixel(width, height, PAPER);
    let (near, far) = range(&look.raw, &look.refined);
    let at = |x: u32, y: u32| (y * step).min(h - 1) as usize * w as usize + (x * step).min(w - 1) as usize;
    let depth = |z: f32| Rgb(depth_color(z, near, far));
    let difference = |i: usize| match (look.raw[i] > 0.0, look.refined[i] > 0.0) {
        (true, true) => Rgb(turbo((look.raw[i] - look.refined[i]).abs() / MAX_DIFFERENCE_M)),
        (false, true) => ONLY_REFINED,
        (true, false) => ONLY_RAW,
        (false, false) => Rgb([0, 0, 0]),
    };
    let share =
        |depth: &[f32]| 100.0 * depth.iter().filter(|z| **z > 0.0).count() as f64 / depth.len() as f64;
    let titles = [
        format!("colour: {}", look.title),
        format!("raw depth, {:.1} % of the pixels", share(&look.raw)),
        format!("refined by {}, {:.1} %", look.engine, share(&look.refined)),
        "difference of both".to_owned(),
    ];
    for (n, title) in titles.iter().enumerate() {
        let n = n as u32;
        let (x0, y0) = (GAP + n % 2 * (pw + GAP), GAP + n / 2 * (ph + HEAD + LEGEND + GAP));
        let letters = (pw / (LETTER * font::ADVANCE)) as usize;
        let short: String = title.chars().take(letters).collect();
        font::text(&mut image, (x0, y0 + 4), LETTER, INK, &short);
        for y in 0..ph {
            for x in 0..pw {
                let i = at(x, y);
                let color = match n {
                    0 => *look.color.get_pixel((x * step).min(w - 1), (y * step).min(h - 1)),
                    1 => depth(look.raw[i]),
                    2 => depth(look.refined[i]),
                    _ => difference(i),
                };
                image.put_pixel(x0 + x, y0 + HEAD + y, color);
            }
        }
        let below = (x0, y0 + HEAD + ph + 6);
        match n {
            0 => font::text(&mut image, below, LETTER, INK, &format!("{w}x{h} {}", look.note)),
            3 => {
                legend(&mut image, below, pw, turbo, &["0".to_owned(), format!("{MAX_DIFFERENCE_M} m")]);
                let row = below.1 + 18;
                let mut x = below.0 + 24 * LETTER * font::ADVANCE / 2;
                for (color, what) in [(ONLY_REFINED, "refined alone"), (ONLY_RAW, "raw alone")] {
                    if x + (what.len() as u32 + 2) * LETTER * font::ADVANCE > below.0 + pw {
                        break;
                    }
                    fill(&mut image, (x, row), (15, 15), color);
                    font::text(&mut image, (x + 20, row), LETTER, INK, what);
                    x += 20 + (what.len() as u32 + 1) * LETTER * font::ADVANCE;
                }
            }
            _ => {
                let z = |t: f32| 1.0 / (1.0 / near + t * (1.0 / far - 1.0 / near));
                let ends = [format!("{near:.2} m"), format!("{:.2}", z(0.5)), format!("{far:.2} m")];
                legend(&mut image, below, pw, |t| depth_color(z(t), near, far), &ends);
            }
        }
    }
    image
}

/// A band of colours with words below it, from left to right.
fn legend(
    image: &mut RgbImage,
    (x0, y0): (u32, u32),
    width: u32,
    color: impl Fn(f32) -> [u8; 3],
    words: &[String],
) {
    for x in 0..width {
        fill(image, (x0 + x, y0), (1, 12), Rgb(color(x as f32 / width as f32)));
    }
    for (n, word) in words.iter().enumerate() {
        let long = word.chars().count() as u32 * LETTER * font::ADVANCE;
        let room = width.saturating_sub(long);
        let x = if words.len() > 1 { room * n as u32 / (words.len() as u32 - 1) } else { 0 };
        font::text(image, (x0 + x, y0 + 18), LETTER, INK, word);
    }
}

fn fill(image: &mut RgbImage, (x0, y0): (u32, u32), (w, h): (u32, u32), color: Rgb<u8>) {
    for y in y0..(y0 + h).min(image.height()) {
        for x in x0..(x0 + w).min(image.width()) {
            image.put_pixel(x, y, color);
        }
    }
}

/// One range of colours for both depths, without the tails.
fn range(raw: &[f32], refined: &[f32]) -> (f32, f32) {
    let mut some: Vec<f32> = raw.iter().chain(refined).copied().filter(|z| *z > 0.0).step_by(7).collect();
    some.sort_unstable_by(f32::total_cmp);
    let at = |share| crate::bench::stats::quantile(&some, share).unwrap_or(1.0);
    let near = at(0.02);
    (near, at(0.98).max(near * 1.01))
}
