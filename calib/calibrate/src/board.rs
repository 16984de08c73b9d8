//! Printed boards: their geometry, their description in `board.toml`, and how they are drawn.

use depthrig_calib::{Error, ErrorKind, Result};
use glam::DVec3;
use serde::{Deserialize, Serialize};

mod draw;
mod print;
#[cfg(test)]
mod tests;

pub(crate) use draw::APRILGRID_BORDER;
pub use draw::{Drawing, Paper};

/// A printed board, as `board.toml` describes it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Board {
    /// The kind of board.
    pub pattern: Pattern,
    /// Columns: squares of a ChArUco board or chessboard, tags of an AprilGrid.
    pub columns: u32,
    /// Rows, likewise.
    pub rows: u32,
    /// Side of a square, of an AprilGrid of a tag, as drawn, millimetres.
    pub square_mm: f64,
    /// ChArUco: side of a marker, millimetres. AprilGrid: gap between tags, millimetres.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub marker_mm: Option<f64>,
    /// Dictionary of the markers, with the name that OpenCV gives it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub dictionary: Option<String>,
    /// Length of the ruler line as drawn, millimetres.
    #[serde(default = "ruler_mm")]
    pub ruler_mm: f64,
    /// Length of the ruler line on the paper, measured, millimetres: printers scale.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub measured_ruler_mm: Option<f64>,
}

/// Kinds of boards.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Pattern {
    /// A chessboard with a marker in each white square (OpenCV's layout since 4.6): may be partly hidden, has a top.
    Charuco,
    /// Black and white squares: must be seen whole.
    Chessboard,
    /// Kalibr's grid of AprilTags 36h11: may be partly hidden, has a top.
    Aprilgrid,
}

const fn ruler_mm() -> f64 {
    100.0
}

/// A scale of the printer beyond which the ruler was rather read wrong.
const MAX_SCALE_ERROR: f64 = 0.1;

impl Board {
    /// The board with a number of squares that fits the paper, and squares of whole millimetres.
    ///
    /// # Errors
    /// As [`Board::check`], and for a board that does not fit.
    pub fn for_paper(
        pattern: Pattern,
        columns: u32,
        rows: u32,
        square_mm: Option<f64>,
        paper: Paper,
    ) -> Result<Self> {
        let mut board = Self {
            pattern,
            columns,
            rows,
            square_mm: square_mm.unwrap_or(1.0),
            marker_mm: None,
            dictionary: None,
            ruler_mm: ruler_mm(),
            measured_ruler_mm: None,
        };
        if square_mm.is_none() {
            board.square_mm = paper.largest_square_mm(&board);
        }
        board.marker_mm = match pattern {
            // White enough around a marker that refining a corner does not see it.
            Pattern::Charuco => Some((board.square_mm * 0.7 * 10.0).round() / 10.0),
            Pattern::Aprilgrid => Some((board.square_mm * 0.3 * 100.0).round() / 100.0),
            Pattern::Chessboard => None,
        };
        board.dictionary = match pattern {
            // Few bits are large ones; the smallest dictionary has the least similar markers.
            Pattern::Charuco => {
                let size = [50, 100, 250].into_iter().find(|n| board.marker_count() <= *n).unwrap_or(1000);
                Some(format!("DICT_4X4_{size}"))
            }
            Pattern::Aprilgrid => Some("DICT_APRILTAG_36h11".to_owned()),
            Pattern::Chessboard => None,
        };
        board.check()?;
        Ok(board)
    }

    /// Reads `board.toml`.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] with the line of what is wrong.
    pub fn from_toml(text: &str) -> Result<Self> {
        let board: Self = toml::from_str(text)
            .map_err(|e| Error::new(ErrorKind::BadInput, format!("invalid board: {e}")))?;
        board.check()?;
        Ok(board)
    }

    /// The text of `board.toml`.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] for numbers that TOML cannot hold.
    pub fn to_toml(&self) -> Result<String> {
        toml::to_string(self)
            .map_err(|e| Error::new(ErrorKind::BadInput, format!("the board cannot be written: {e}")))
    }

    /// Checks sizes and names.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] with what to change.
    pub fn check(&self) -> Result<()> {
        let least = if self.pattern == Pattern::Aprilgrid { 1 } else { 3 };
        if self.columns < least || self.rows < least || self.columns > 100 || self.rows > 100 {
            return bad(format!(
                "{}x{} columns and rows are out of range {least}..=100",
                self.columns, self.rows
            ));
        }
        if !(self.square_mm.is_finite() && self.square_mm > 0.0 && self.square_mm < 10_000.0) {
            return bad(format!("square_mm = {} is out of range 0..=10000", self.square_mm));
        }
        match (self.pattern, self.marker_mm) {
            (Pattern::Chessboard, _) => {}
            (_, None) => {
                return bad(
                    "marker_mm is missing: the side of a marker, of an AprilGrid the gap between tags"
                        .to_owned(),
                );
            }
            (Pattern::Charuco, Some(m)) if !(m > 0.0 && m < self.square_mm) => {
                return bad(format!("marker_mm = {m} is not between 0 and square_mm = {}", self.square_mm));
            }
            (Pattern::Aprilgrid, Some(m)) if !(m > 0.0 && m <= self.square_mm) => {
                return bad(format!(
                    "marker_mm = {m}, the gap between tags, is not between 0 and square_mm = {}, the side of a tag",
                    self.square_mm
                ));
            }
            _ => {}
        }
        if self.pattern != Pattern::Chessboard {
            let dictionary = self.dictionary()?;
            let needed = self.marker_count();
            if needed > dictionary.codes().len() {
                return bad(format!(
                    "the board has {needed} markers, {} has {}; choose a larger dictionary or fewer squares",
                    dictionary.name(),
                    dictionary.codes().len()
                ));
            }
        }
        if self.pattern == Pattern::Chessboard && (self.columns + self.rows).is_multiple_of(2) {
            return bad(format!(
                "a chessboard of {}x{} squares looks the same upside down; use an even and an odd number",
                self.columns, self.rows
            ));
        }
        let scale = self.scale();
        if !((1.0 - MAX_SCALE_ERROR)..=(1.0 + MAX_SCALE_ERROR)).contains(&scale) {
            return bad(format!(
                "measured_ruler_mm = {} for a ruler drawn {} mm long; measure the line again from tip to tip, or print without \"fit to page\"",
                self.measured_ruler_mm.unwrap_or(f64::NAN),
                self.ruler_mm
            ));
        }
        Ok(())
    }

    /// By how much the printer enlarged the board.
    pub fn scale(&self) -> f64 {
        self.measured_ruler_mm.map_or(1.0, |m| m / self.ruler_mm)
    }

    /// Corners that can be seen.
    pub fn corner_count(&self) -> usize {
        let columns = self.columns as usize;
        let rows = self.rows as usize;
        match self.pattern {
            Pattern::Charuco | Pattern::Chessboard => (columns - 1) * (rows - 1),
            Pattern::Aprilgrid => 4 * columns * rows,
        }
    }

    /// Where a corner is on the paper, metres; z is 0. Of a ChArUco board and a chessboard the corners between squares, row by row from the
    /// top-left one, x to the right and y down, from the board's top-left corner (as OpenCV has them). Of an AprilGrid four of each
    /// tag, counter-clockwise from its bottom-left one, tags row by row from the bottom-left one, x to the right and y up (as
    /// Kalibr has them).
    pub fn corner(&self, id: usize) -> DVec3 {
        let metres = self.scale() * 1e-3;
        match self.pattern {
            Pattern::Charuco | Pattern::Chessboard => {
                let across = self.columns as usize - 1;
                let x = (id % across + 1) as f64;
                let y = (id / across + 1) as f64;
                DVec3::new(x, y, 0.0) * (self.square_mm * metres)
            }
            Pattern::Aprilgrid => {
                let tag = id / 4;
                let pitch = self.square_mm + self.marker_mm.unwrap_or(0.0);
                let right = matches!(id % 4, 1 | 2);
                let top = id % 4 >= 2;
                let side = |far: bool| if far { self.square_mm } else { 0.0 };
                let x = (tag % self.columns as usize) as f64 * pitch + side(right);
                let y = (tag / self.columns as usize) as f64 * pitch + side(top);
                DVec3::new(x, y, 0.0) * metres
            }
        }
    }

    /// The dictionary of its markers.
    pub(crate) fn dictionary(&self) -> Result<calib_targets_aruco::Dictionary> {
        let name = self.dictionary.as_deref().unwrap_or("");
        calib_targets_aruco::resolve_dictionary(name).ok_or_else(|| {
            Error::new(
                ErrorKind::BadInput,
                format!("unknown dictionary '{name}'; use a name like DICT_5X5_1000 or DICT_APRILTAG_36h11"),
            )
        })
    }

    fn marker_count(&self) -> usize {
        let squares = self.columns as usize * self.rows as usize;
        if self.pattern == Pattern::Aprilgrid { squares } else { squares / 2 }
    }
}

fn bad<T>(message: String) -> Result<T> {
    Err(Error::new(ErrorKind::BadInput, message))
}
