//! The contact sheet: a row of labelled images for each camera, depth in one scale, and a bar that says which.

use crate::font;
use crate::image_file::depth_range;
use crate::turbo::depth_color;
use image::{Rgb, RgbImage, imageops};

/// Height of an image on the sheet.
const HEIGHT: u32 = 200;
/// Space around images.
const GAP: u32 = 8;
/// Images side by side; further images of a camera are in the next row.
const ABREAST: usize = 3;
/// Pixels of a letter's pixel in labels, and in the names of cameras.
const LABEL: u32 = 2;
const TITLE: u32 = 3;
/// Rows of a letter.
const LETTER_ROWS: u32 = 5;
/// Width and height of the bar.
const BAR: (u32, u32) = (600, 20);
/// Depths that are named along the bar.
const TICKS: u32 = 5;
const BACKGROUND: Rgb<u8> = Rgb([24, 24, 28]);
const INK: Rgb<u8> = Rgb([230, 230, 230]);

/// An image of a camera.
#[derive(Debug, Clone)]
pub enum Shot {
    /// As it is.
    Color(RgbImage),
    /// Depth in metres, row by row; 0 where depth is missing.
    Depth {
        /// Pixels in a row.
        width: u32,
        /// Rows.
        height: u32,
        /// The depths.
        metres: Vec<f32>,
    },
}

/// An image with its label.
#[derive(Debug)]
pub struct Tile<'a> {
    /// Written above it.
    pub label: String,
    /// The image.
    pub shot: &'a Shot,
}

/// A camera on the sheet.
#[derive(Debug)]
pub struct Camera<'a> {
    /// Written above its images.
    pub title: String,
    /// Its images from left to right.
    pub tiles: Vec<Tile<'a>>,
}

/// The depths at the ends of the scale of colours, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Scale {
    near: f32,
    far: f32,
}

impl Scale {
    /// The scale that fits all depths.
    fn of(cameras: &[Camera<'_>]) -> Self {
        let depths = |tile: &Tile<'_>| match tile.shot {
            Shot::Color(_) => Vec::new(),
            Shot::Depth { metres, .. } => metres.iter().copied().step_by(11).collect(),
        };
        let all: Vec<f32> = cameras.iter().flat_map(|c| &c.tiles).flat_map(depths).collect();
        let (near, far) = depth_range(&all);
        Self { near, far }
    }

    /// The depth at `share` of the bar; colours are equal steps of 1/z.
    fn at(self, share: f32) -> f32 {
        1.0 / (1.0 / self.near + (1.0 / self.far - 1.0 / self.near) * share)
    }
}

/// One row of a sheet.
struct Row<'a> {
    /// Above the first row of a camera.
    title: Option<&'a str>,
    /// Each with its label.
    images: Vec<(&'a str, RgbImage)>,
}

/// The sheet of `cameras`.
pub fn contact_sheet(cameras: &[Camera<'_>]) -> RgbImage {
    let scale = Scale::of(cameras);
    let rows: Vec<Row<'_>> = cameras
        .iter()
        .flat_map(|camera| {
            camera.tiles.chunks(ABREAST).enumerate().map(move |(i, tiles)| Row {
                title: (i == 0).then_some(camera.title.as_str()),
                images: tiles.iter().map(|t| (t.label.as_str(), small(t.shot, scale))).collect(),
            })
        })
        .collect();
    let row_width = |row: &Row<'_>| row.images.iter().map(|i| i.1.width() + GAP).sum::<u32>();
    let width = rows.iter().map(row_width).max().unwrap_or(0).max(BAR.0 + 30 * GAP) + GAP;
    let title_rows = TITLE * LETTER_ROWS + 2 * GAP;
    let label_rows = LABEL * LETTER_ROWS + GAP;
    let row_height = |title: Option<&str>| title.map_or(0, |_| title_rows) + label_rows + HEIGHT + GAP;
    let height =
        rows.iter().map(|r| row_height(r.title)).sum::<u32>() + GAP + title_rows + BAR.1 + label_rows;
    let mut sheet = RgbImage::from_pixel(width, height, BACKGROUND);
    let mut y = GAP;
    for row in &rows {
        if let Some(title) = row.title {
            font::text(&mut sheet, (GAP, y + GAP), TITLE, INK, title);
            y += title_rows;
        }
        let mut x = GAP;
        for (label, image) in &row.images {
            font::text(&mut sheet, (x, y), LABEL, INK, label);
            imageops::replace(&mut sheet, image, x.into(), (y + label_rows).into());
            x += image.width() + GAP;
        }
        y += label_rows + HEIGHT + GAP;
    }
    bar(&mut sheet, y + GAP, scale);
    sheet
}

/// The bar of colours with its depths, and the black of no depth, from row `y` on.
fn bar(sheet: &mut RgbImage, y: u32, scale: Scale) {
    font::text(sheet, (GAP, y), TITLE, INK, "depth, m");
    let top = y + TITLE * LETTER_ROWS + GAP;
    let share = |x: u32| x as f32 / (BAR.0 - 1) as f32;
    for x in 0..BAR.0 {
        let color = Rgb(depth_color(scale.at(share(x)), scale.near, scale.far));
        for row in 0..BAR.1 {
            sheet.put_pixel(GAP + x, top + row, color);
        }
    }
    for tick in 0..TICKS {
        let x = tick * (BAR.0 - 1) / (TICKS - 1);
        let text = format!("{:.2}", scale.at(share(x)));
        let wide = text.len() as u32 * font::ADVANCE * LABEL;
        font::text(sheet, (GAP + x.min(BAR.0 - wide), top + BAR.1 + 4), LABEL, INK, &text);
    }
    let none = GAP + BAR.0 + 3 * GAP;
    for x in none..none + BAR.1 {
        for row in 0..BAR.1 {
            sheet.put_pixel(x, top + row, Rgb([0; 3]));
        }
    }
    font::text(sheet, (none + BAR.1 + GAP, top + 5), LABEL, INK, "black: no depth");
}

/// The image at the sheet's height, depth in the colours of `scale`.
fn small(shot: &Shot, scale: Scale) -> RgbImage {
    let colored;
    let image = match shot {
        Shot::Color(image) => image,
        Shot::Depth { width, height, metres } => {
            colored = RgbImage::from_fn(*width, *height, |x, y| {
                let z = metres.get((y * width + x) as usize).copied().unwrap_or_default();
                Rgb(depth_color(z, scale.near, scale.far))
            });
            &colored
        }
    };
    let width = (image.width() * HEIGHT).div_ceil(image.height().max(1)).max(1);
    imageops::thumbnail(image, width, HEIGHT)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn flat(metres: f32) -> Shot {
        Shot::Depth { width: 64, height: 48, metres: vec![metres; 64 * 48] }
    }

    fn camera<'a>(title: &str, shots: &[&'a Shot]) -> Camera<'a> {
        let tiles = shots.iter().map(|shot| Tile { label: String::new(), shot }).collect();
        Camera { title: title.into(), tiles }
    }

    /// The middle of the image of `shot` on a sheet on which it stands alone in the first row.
    fn middle(sheet: &RgbImage) -> Rgb<u8> {
        let y = GAP + TITLE * LETTER_ROWS + 2 * GAP + LABEL * LETTER_ROWS + GAP + HEIGHT / 2;
        *sheet.get_pixel(GAP + 100, y)
    }

    /// The same depth has the same colour whichever camera saw it, and the bar names it.
    #[test]
    fn all_depth_is_in_one_scale() {
        let near = flat(0.5);
        let far = flat(2.0);
        let first = contact_sheet(&[camera("A", &[&near]), camera("B", &[&far])]);
        let second = contact_sheet(&[camera("B", &[&far]), camera("A", &[&near])]);
        assert_eq!(middle(&first).0, depth_color(0.5, 0.5, 2.0));
        assert_eq!(middle(&second).0, depth_color(2.0, 0.5, 2.0));
        let scale = Scale::of(&[camera("A", &[&near, &far])]);
        assert_eq!(scale, Scale { near: 0.5, far: 2.0 });
        assert!((scale.at(0.0) - 0.5).abs() < 1e-6 && (scale.at(1.0) - 2.0).abs() < 1e-6);
        assert!((scale.at(0.5) - 0.8).abs() < 1e-6, "the middle of 1/0.5 and 1/2");
    }

    #[test]
    fn a_label_is_written_above_its_image() {
        let shot = Shot::Color(RgbImage::from_pixel(64, 48, Rgb([255, 0, 0])));
        let mut rig = camera("d435", &[&shot]);
        let ink = |sheet: &RgbImage| sheet.pixels().filter(|p| **p == INK).count();
        let without = ink(&contact_sheet(std::slice::from_ref(&rig)));
        rig.tiles[0].label = "colour".into();
        assert!(ink(&contact_sheet(&[rig])) > without + 100);
    }

    #[test]
    fn a_camera_with_many_images_goes_on_in_the_next_row() {
        let shot = flat(1.0);
        let three = contact_sheet(&[camera("A", &[&shot; 3])]);
        let four = contact_sheet(&[camera("A", &[&shot; 4])]);
        assert_eq!(four.height() - three.height(), LABEL * LETTER_ROWS + GAP + HEIGHT + GAP);
        assert_eq!(three.width(), four.width());
    }
}
