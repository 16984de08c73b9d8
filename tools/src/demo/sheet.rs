//! The contact sheet: what the cameras saw in one picture: colour, each depth, and refined depth beside each other.

use image::{Rgb, RgbImage, imageops};

/// Height of a picture on the sheet.
const HEIGHT: u32 = 120;
/// Space between pictures.
const GAP: u32 = 4;
/// Cameras side by side.
const COLUMNS: u32 = 2;
const BACKGROUND: Rgb<u8> = Rgb([24, 24, 28]);

/// Pictures of a camera in one cell; the others stand in further cells.
const ABREAST: usize = 3;

/// The sheet of `cameras`, each with its pictures from left to right, [`ABREAST`] in a cell and two cells abreast. Where one is
/// missing is background.
pub fn contact_sheet<'a>(cameras: impl IntoIterator<Item = Vec<Option<&'a RgbImage>>>) -> RgbImage {
    let cells = |pictures: Vec<Option<&RgbImage>>| -> Vec<Vec<RgbImage>> {
        pictures.chunks(ABREAST).map(|cell| cell.iter().map(|p| small(*p)).collect()).collect()
    };
    let all: Vec<Vec<RgbImage>> = cameras.into_iter().flat_map(cells).collect();
    let width = |pictures: &Vec<RgbImage>| pictures.iter().map(|p| p.width() + GAP).sum::<u32>();
    let cell = all.iter().map(width).max().unwrap_or(1) + 2 * GAP;
    let rows = (all.len() as u32).div_ceil(COLUMNS).max(1);
    let mut sheet = RgbImage::from_pixel(cell * COLUMNS, rows * (HEIGHT + 2 * GAP), BACKGROUND);
    for (i, pictures) in all.iter().enumerate() {
        let (column, row) = (i as u32 % COLUMNS, i as u32 / COLUMNS);
        let (mut x, y) = (column * cell + GAP, row * (HEIGHT + 2 * GAP) + GAP);
        for picture in pictures {
            imageops::replace(&mut sheet, picture, x.into(), y.into());
            x += picture.width() + GAP;
        }
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
        let sheet =
            contact_sheet([vec![Some(&red), Some(&blue)], vec![None, Some(&blue)], vec![Some(&red), None]]);
        assert_eq!(sheet.height(), 2 * (HEIGHT + 2 * GAP));
        assert_eq!(sheet.get_pixel(GAP + 5, GAP + 5).0, [255, 0, 0]);
        assert_eq!(sheet.get_pixel(GAP + 160 + GAP + 5, GAP + 5).0, [0, 0, 255]);
        assert_eq!(*sheet.get_pixel(0, 0), BACKGROUND);
    }

    #[test]
    fn a_camera_with_many_pictures_goes_on_in_the_next_cell() {
        let red = RgbImage::from_pixel(640, 480, Rgb([255, 0, 0]));
        let blue = RgbImage::from_pixel(640, 480, Rgb([0, 0, 255]));
        let sheet = contact_sheet([vec![Some(&red), Some(&red), Some(&red), Some(&blue), Some(&blue)]]);
        assert_eq!(sheet.height(), HEIGHT + 2 * GAP, "two cells stand side by side");
        assert_eq!(sheet.get_pixel(sheet.width() / 2 + GAP + 5, GAP + 5).0, [0, 0, 255]);
    }
}
