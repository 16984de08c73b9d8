//! The contact sheet: what the cameras saw, colour beside depth, in one picture.

use image::{Rgb, RgbImage, imageops};

/// Height of a picture on the sheet.
const HEIGHT: u32 = 120;
/// Space between pictures.
const GAP: u32 = 4;
/// Cameras side by side.
const COLUMNS: u32 = 2;
const BACKGROUND: Rgb<u8> = Rgb([24, 24, 28]);

/// The sheet of `cameras`, two abreast, each colour and then depth. Where one has no picture is background.
pub fn contact_sheet<'a>(
    cameras: impl IntoIterator<Item = (Option<&'a RgbImage>, Option<&'a RgbImage>)>,
) -> RgbImage {
    let pairs: Vec<[RgbImage; 2]> =
        cameras.into_iter().map(|(color, depth)| [small(color), small(depth)]).collect();
    let cell = pairs.iter().map(|[a, b]| a.width() + GAP + b.width()).max().unwrap_or(1) + 3 * GAP;
    let rows = (pairs.len() as u32).div_ceil(COLUMNS).max(1);
    let mut sheet = RgbImage::from_pixel(cell * COLUMNS, rows * (HEIGHT + 2 * GAP), BACKGROUND);
    for (i, [color, depth]) in pairs.iter().enumerate() {
        let (column, row) = (i as u32 % COLUMNS, i as u32 / COLUMNS);
        let (x, y) = (column * cell + GAP, row * (HEIGHT + 2 * GAP) + GAP);
        imageops::replace(&mut sheet, color, x.into(), y.into());
        imageops::replace(&mut sheet, depth, (x + color.width() + GAP).into(), y.into());
    }
    sheet
}

/// The picture at the sheet's height.
fn small(picture: Option<&RgbImage>) -> RgbImage {
    let Some(picture) = picture.filter(|p| p.height() > 0) else {
        return RgbImage::from_pixel(1, HEIGHT, BACKGROUND);
    };
    let width = (picture.width() * HEIGHT).div_ceil(picture.height()).max(1);
    imageops::thumbnail(picture, width, HEIGHT)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_stand_side_by_side() {
        let red = RgbImage::from_pixel(640, 480, Rgb([255, 0, 0]));
        let blue = RgbImage::from_pixel(320, 240, Rgb([0, 0, 255]));
        let sheet = contact_sheet([(Some(&red), Some(&blue)), (None, Some(&blue)), (Some(&red), None)]);
        assert_eq!(sheet.height(), 2 * (HEIGHT + 2 * GAP));
        assert_eq!(sheet.get_pixel(GAP + 5, GAP + 5).0, [255, 0, 0]);
        assert_eq!(sheet.get_pixel(GAP + 160 + GAP + 5, GAP + 5).0, [0, 0, 255]);
        assert_eq!(*sheet.get_pixel(0, 0), BACKGROUND);
    }
}
