//! ChArUco boards.

use super::{Detection, Detector, FoundCorner, GrayImage, refined};
use crate::board::Board;
use calib_targets_charuco::{CharucoBoardSpec, CharucoDetector, CharucoParams};
use depthrig_calib::{Error, ErrorKind, Result};
use glam::DVec2;

/// Corners below which a ChArUco board is not used: fewer say little, and may be wrong.
const MIN_CORNERS: usize = 6;

pub(super) struct Charuco {
    detectors: Vec<CharucoDetector>,
    /// Half-size of the refinement's window, of the spacing of corners: it ends before the markers.
    window: f64,
}

impl Charuco {
    pub(super) fn new(board: &Board) -> Result<Self> {
        let relative = board.marker_mm.unwrap_or(0.0) / board.square_mm;
        let spec = CharucoBoardSpec::new(
            board.rows,
            board.columns,
            board.square_mm as f32,
            relative as f32,
            board.dictionary()?,
        );
        let detectors: core::result::Result<Vec<_>, _> =
            CharucoParams::sweep_for_board(&spec).into_iter().map(CharucoDetector::new).collect();
        let detectors = detectors.map_err(|e| {
            Error::new(ErrorKind::BadInput, format!("a ChArUco board that cannot be detected: {e}"))
        })?;
        Ok(Self { detectors, window: (0.9 * (1.0 - relative) / 2.0).min(0.3) })
    }
}

impl Detector for Charuco {
    fn detect(&self, image: &GrayImage<'_>) -> Detection {
        let view = image.view();
        // The first that succeeds: the others are for blurred and for badly lit images.
        let found = self.detectors.iter().find_map(|d| d.detect(&view).ok());
        let Some(found) = found else { return Detection::default() };
        let corners: Vec<FoundCorner> = found
            .corners
            .iter()
            .map(|c| FoundCorner {
                id: c.id as usize,
                pixel: DVec2::new(f64::from(c.position.x), f64::from(c.position.y)),
            })
            .collect();
        let mut corners = refined(image, corners, self.window);
        corners.sort_by_key(|c| c.id);
        if corners.len() < MIN_CORNERS {
            return Detection::default();
        }
        Detection { corners, refused: None }
    }
}
