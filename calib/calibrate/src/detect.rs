//! Corners of a board in an image.
//!
//! One trait for all kinds of boards. Corners are found and numbered by libraries (ChESS corners and grids of
//! `calib-targets`), then placed by [`refine`], whose window fits the spacing of the corners: the libraries'
//! own positions are noisier by a fifth on real images.

use crate::board::{Board, Pattern};
use calib_targets_chessboard::GrayImageView;
use depthrig_calib::{Error, ErrorKind, Result};
use glam::DVec2;

mod aprilgrid;
mod charuco;
mod chessboard;
mod refine;
#[cfg(test)]
mod tests;

pub use refine::refine;

/// A grey image of 8 bits, row by row without padding.
#[derive(Debug, Clone, Copy)]
pub struct GrayImage<'a> {
    width: usize,
    height: usize,
    pixels: &'a [u8],
}

impl<'a> GrayImage<'a> {
    /// Wraps pixels.
    ///
    /// # Errors
    /// [`ErrorKind::SizeMismatch`] if there are not `width * height` of them.
    pub fn new(width: usize, height: usize, pixels: &'a [u8]) -> Result<Self> {
        if pixels.len() != width * height {
            return Err(Error::new(
                ErrorKind::SizeMismatch,
                format!("a grey image of {width}x{height} has {} pixels", pixels.len()),
            ));
        }
        Ok(Self { width, height, pixels })
    }

    /// Columns.
    pub const fn width(&self) -> usize {
        self.width
    }

    /// Rows.
    pub const fn height(&self) -> usize {
        self.height
    }

    fn view(&self) -> GrayImageView<'a> {
        GrayImageView { width: self.width, height: self.height, data: self.pixels }
    }

    /// The pixel nearest to `at`; the edge outside the image.
    fn nearest(&self, at: DVec2) -> u8 {
        let x = at.x.round().clamp(0.0, self.width as f64 - 1.0) as usize;
        let y = at.y.round().clamp(0.0, self.height as f64 - 1.0) as usize;
        self.pixels[y * self.width + x]
    }
}

/// A corner in the image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FoundCorner {
    /// Its number, as in [`Board::corner`].
    pub id: usize,
    /// Its place; the centre of the top-left pixel is (0, 0).
    pub pixel: DVec2,
}

/// Corners of a board in an image.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Detection {
    /// The corners, by number; empty if no board is seen.
    pub corners: Vec<FoundCorner>,
    /// Why a board that seems to be there was refused, with the cure.
    pub refused: Option<String>,
}

impl Detection {
    fn refused(why: String) -> Self {
        Self { corners: Vec::new(), refused: Some(why) }
    }
}

/// Finds the corners of one board.
pub trait Detector: Send + Sync {
    /// Finds the board's corners; none where the board is not seen.
    fn detect(&self, image: &GrayImage<'_>) -> Detection;
}

/// The detector for a board.
///
/// # Errors
/// As [`Board::check`].
pub fn detector(board: &Board) -> Result<Box<dyn Detector>> {
    board.check()?;
    Ok(match board.pattern {
        Pattern::Charuco => Box::new(charuco::Charuco::new(board)?),
        Pattern::Chessboard => Box::new(chessboard::Chessboard::new(board)),
        Pattern::Aprilgrid => Box::new(aprilgrid::AprilGrid::new(board)?),
    })
}

/// The least distance of each corner to another one, pixels.
fn spacings(corners: &[FoundCorner]) -> Vec<f64> {
    let nearest = |i: usize| {
        let others = corners.iter().enumerate().filter(|(k, _)| *k != i);
        others.map(|(_, c)| c.pixel.distance_squared(corners[i].pixel)).fold(f64::INFINITY, f64::min)
    };
    (0..corners.len()).map(|i| nearest(i).sqrt()).collect()
}

/// Places corners exactly, in windows of `share` of their spacing; those that cannot be placed are left out.
fn refined(image: &GrayImage<'_>, corners: Vec<FoundCorner>, share: f64) -> Vec<FoundCorner> {
    let spacings = spacings(&corners);
    let each = corners.into_iter().zip(spacings);
    each.flat_map(|(corner, spacing)| refined_in(image, [corner], share * spacing)).collect()
}

/// Places corners exactly, in windows of this half-size, pixels.
fn refined_in<'a>(
    image: &'a GrayImage<'_>,
    corners: impl IntoIterator<Item = FoundCorner> + 'a,
    half: f64,
) -> impl Iterator<Item = FoundCorner> + 'a {
    let half = half.clamp(MIN_HALF_WINDOW, MAX_HALF_WINDOW).round() as usize;
    corners.into_iter().filter_map(move |c| Some(FoundCorner { pixel: refine(image, c.pixel, half)?, ..c }))
}

/// Half-sizes of the window of [`refine`]: below, there are too few pixels; above, the lens bends the edges.
const MIN_HALF_WINDOW: f64 = 2.0;
const MAX_HALF_WINDOW: f64 = 11.0;
