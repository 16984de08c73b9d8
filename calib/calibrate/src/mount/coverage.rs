//! Where in an image corners were seen.

use crate::intrinsics::ImageSize;
use glam::DVec2;

/// Corners in each cell of a grid over the image.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Coverage {
    /// Corners, row by row.
    pub corners: Vec<u32>,
    /// Cells along x.
    pub columns: usize,
}

/// Cells along x and y.
const COLUMNS: usize = 8;
const ROWS: usize = 6;

/// Parts of the image, for advice.
pub(crate) const NAMES: [[&str; 3]; 3] = [
    ["the top left", "the top", "the top right"],
    ["the left", "the middle", "the right"],
    ["the bottom left", "the bottom", "the bottom right"],
];

impl Coverage {
    /// Counts corners.
    pub fn new(size: ImageSize, pixels: impl Iterator<Item = DVec2>) -> Self {
        let mut corners = vec![0; COLUMNS * ROWS];
        let cell = |at: f64, side: u32, n: usize| {
            ((at + 0.5) / f64::from(side) * n as f64).clamp(0.0, n as f64 - 1.0) as usize
        };
        for pixel in pixels {
            corners[cell(pixel.y, size.height, ROWS) * COLUMNS + cell(pixel.x, size.width, COLUMNS)] += 1;
        }
        Self { corners, columns: COLUMNS }
    }

    /// Cells with a corner, of all.
    pub fn share(&self) -> f64 {
        let seen = self.corners.iter().filter(|n| **n > 0).count();
        seen as f64 / self.corners.len().max(1) as f64
    }

    /// Whether `other` has corners where this one names an empty part.
    pub(crate) fn fills(&self, other: &Self) -> bool {
        let mut both = self.clone();
        for (mine, theirs) in both.corners.iter_mut().zip(&other.corners) {
            *mine += theirs;
        }
        both.empty_parts().len() < self.empty_parts().len()
    }

    /// Names of the parts of the image, of nine, in which fewer than a third of the cells have a corner.
    pub fn empty_parts(&self) -> Vec<&'static str> {
        let mut empty = Vec::new();
        for (part_row, names) in NAMES.iter().enumerate() {
            for (part_column, name) in names.iter().enumerate() {
                let cells: Vec<usize> = (0..self.corners.len())
                    .filter(|i| {
                        let row = i / self.columns * 3 / ROWS;
                        let column = i % self.columns * 3 / self.columns;
                        row == part_row && column == part_column
                    })
                    .collect();
                let seen = cells.iter().filter(|i| self.corners[**i] > 0).count();
                if seen * 3 < cells.len() {
                    empty.push(*name);
                }
            }
        }
        empty
    }
}
