//! A board as black rectangles on paper.

use super::{Board, Pattern};
use depthrig_calib::{Error, ErrorKind, Result};

/// Size of the paper, millimetres, as it lies: the longer side across.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Paper {
    /// Across.
    pub width_mm: f64,
    /// Down.
    pub height_mm: f64,
}

/// A rectangle, millimetres from the paper's top-left corner.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rectangle {
    /// Left side.
    pub x: f64,
    /// Upper side.
    pub y: f64,
    /// Across.
    pub width: f64,
    /// Down.
    pub height: f64,
}

/// Where a line of text begins: its base line, millimetres from the paper's top-left corner.
#[derive(Debug, Clone, PartialEq)]
pub struct Label {
    /// Left end.
    pub x: f64,
    /// Base line.
    pub y: f64,
    /// The text, in ASCII.
    pub text: String,
}

/// A sheet to print.
#[derive(Debug, Clone, PartialEq)]
pub struct Drawing {
    /// The sheet.
    pub paper: Paper,
    /// Black rectangles; they touch but do not overlap.
    pub black: Vec<Rectangle>,
    /// Lines of text.
    pub labels: Vec<Label>,
}

/// White around the board: a detector needs it, and printers cannot print to the edge.
const MARGIN_MM: f64 = 10.0;
/// Height of the line with the ruler and the description, below the board.
const FOOTER_MM: f64 = 12.0;
/// Thickness of the ruler's line.
const RULER_LINE_MM: f64 = 0.3;
/// Height of the ticks at the ruler's ends.
const RULER_TICK_MM: f64 = 4.0;

impl Paper {
    /// A size by its name: `a4`, `a3`, `a2`, `a1`, `a0`, `letter`, `tabloid`, or `WIDTHxHEIGHT` in millimetres.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] for another name.
    pub fn parse(name: &str) -> Result<Self> {
        let of = |width_mm, height_mm| Ok(Self { width_mm, height_mm });
        match name.to_ascii_lowercase().as_str() {
            "a4" => of(297.0, 210.0),
            "a3" => of(420.0, 297.0),
            "a2" => of(594.0, 420.0),
            "a1" => of(841.0, 594.0),
            "a0" => of(1189.0, 841.0),
            "letter" => of(279.4, 215.9),
            "tabloid" => of(431.8, 279.4),
            other => {
                let sides = other.split_once('x').map(|(w, h)| (w.parse::<f64>(), h.parse::<f64>()));
                match sides {
                    Some((Ok(w), Ok(h))) if w >= 50.0 && h >= 50.0 && w <= 5000.0 && h <= 5000.0 => of(w, h),
                    _ => Err(Error::new(
                        ErrorKind::BadInput,
                        format!(
                            "unknown paper '{name}'; use a4, a3, a2, a1, a0, letter, tabloid or WIDTHxHEIGHT in millimetres (50..=5000)"
                        ),
                    )),
                }
            }
        }
    }

    /// A sheet on which the board just fits.
    #[must_use]
    pub fn around(board: &Board) -> Self {
        let size = extent(board);
        Self { width_mm: size.width + 2.0 * MARGIN_MM, height_mm: size.height + 2.0 * MARGIN_MM + FOOTER_MM }
    }

    /// The largest square of whole millimetres with which a board of so many fits.
    pub(super) fn largest_square_mm(&self, board: &Board) -> f64 {
        let unit = extent(&Board { square_mm: 1.0, marker_mm: Some(0.3), ..board.clone() });
        let across = (self.width_mm - 2.0 * MARGIN_MM) / unit.width;
        let down = (self.height_mm - 2.0 * MARGIN_MM - FOOTER_MM) / unit.height;
        across.min(down).floor().max(1.0)
    }
}

/// Size of the printed part.
fn extent(board: &Board) -> Rectangle {
    let of = |n: u32| match board.pattern {
        Pattern::Aprilgrid => {
            let gap = board.marker_mm.unwrap_or(0.0);
            // Small squares stand in the gaps, around the outer tags too.
            f64::from(n) * (board.square_mm + gap) + gap
        }
        _ => f64::from(n) * board.square_mm,
    };
    Rectangle { x: 0.0, y: 0.0, width: of(board.columns), height: of(board.rows) }
}

impl Drawing {
    /// Draws a board in the middle of a sheet, with a ruler below it.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] for a board that does not fit, with the square that would.
    pub fn new(board: &Board, paper: Paper) -> Result<Self> {
        board.check()?;
        let size = extent(board);
        let free_width = paper.width_mm - 2.0 * MARGIN_MM;
        let free_height = paper.height_mm - 2.0 * MARGIN_MM - FOOTER_MM;
        // Both were computed in millimetres; a rounding error is no reason to refuse.
        if size.width > free_width + 1e-6 || size.height > free_height + 1e-6 {
            return Err(Error::new(
                ErrorKind::BadInput,
                format!(
                    "the board is {:.0}x{:.0} mm, the paper has room for {free_width:.0}x{free_height:.0}; use squares of {} mm or larger paper",
                    size.width,
                    size.height,
                    paper.largest_square_mm(board)
                ),
            ));
        }
        let mut drawing = Self { paper, black: Vec::new(), labels: Vec::new() };
        let left = (paper.width_mm - size.width) / 2.0;
        let top = MARGIN_MM + (free_height - size.height) / 2.0;
        match board.pattern {
            Pattern::Chessboard | Pattern::Charuco => drawing.squares(board, left, top),
            Pattern::Aprilgrid => {}
        }
        match board.pattern {
            Pattern::Chessboard => {}
            Pattern::Charuco => drawing.charuco_markers(board, left, top)?,
            Pattern::Aprilgrid => drawing.tags(board, left, top)?,
        }
        drawing.ruler(board);
        Ok(drawing)
    }

    /// Black squares, the top-left one black.
    fn squares(&mut self, board: &Board, left: f64, top: f64) {
        let side = board.square_mm;
        for row in 0..board.rows {
            for column in (row % 2..board.columns).step_by(2) {
                self.rectangle(left + f64::from(column) * side, top + f64::from(row) * side, side, side);
            }
        }
    }

    fn charuco_markers(&mut self, board: &Board, left: f64, top: f64) -> Result<()> {
        let dictionary = board.dictionary()?;
        let side = board.marker_mm.unwrap_or(0.0);
        let inset = (board.square_mm - side) / 2.0;
        let mut codes = dictionary.codes().iter();
        for row in 0..board.rows {
            for column in ((row + 1) % 2..board.columns).step_by(2) {
                let Some(code) = codes.next() else { return Ok(()) };
                let x = left + f64::from(column) * board.square_mm + inset;
                let y = top + f64::from(row) * board.square_mm + inset;
                self.marker(
                    *code,
                    dictionary.marker_size(),
                    1,
                    Rectangle { x, y, width: side, height: side },
                );
            }
        }
        Ok(())
    }

    /// Tags with a black border of two bits, row by row from the bottom-left one, and the small squares between their corners.
    fn tags(&mut self, board: &Board, left: f64, top: f64) -> Result<()> {
        let dictionary = board.dictionary()?;
        let side = board.square_mm;
        let gap = board.marker_mm.unwrap_or(0.0);
        let pitch = side + gap;
        for row in 0..board.rows {
            for column in 0..board.columns {
                let id = (row * board.columns + column) as usize;
                let x = left + gap + f64::from(column) * pitch;
                let y = top + gap + f64::from(board.rows - 1 - row) * pitch;
                self.marker(
                    // OpenCV's dictionary has the tags upside down from where their makers have them.
                    calib_targets_aruco::rotate_code_u64(dictionary.codes()[id], dictionary.marker_size(), 2),
                    dictionary.marker_size(),
                    APRILGRID_BORDER,
                    Rectangle { x, y, width: side, height: side },
                );
            }
        }
        for row in 0..=board.rows {
            for column in 0..=board.columns {
                self.rectangle(left + f64::from(column) * pitch, top + f64::from(row) * pitch, gap, gap);
            }
        }
        Ok(())
    }

    /// A marker as rows of black bits: a bit of its code that is 1 is black.
    fn marker(&mut self, code: u64, bits: usize, border: usize, at: Rectangle) {
        let cells = bits + 2 * border;
        let cell = at.width / cells as f64;
        let black = |row: usize, column: usize| {
            let inside = |i: usize| (border..border + bits).contains(&i);
            !(inside(row) && inside(column)) || code >> ((row - border) * bits + column - border) & 1 == 1
        };
        for row in 0..cells {
            let mut column = 0;
            while column < cells {
                let run = (column..cells).take_while(|c| black(row, *c)).count();
                if run > 0 {
                    self.rectangle(
                        at.x + column as f64 * cell,
                        at.y + row as f64 * cell,
                        run as f64 * cell,
                        cell,
                    );
                }
                column += run.max(1);
            }
        }
    }

    fn ruler(&mut self, board: &Board) {
        let y = self.paper.height_mm - MARGIN_MM - FOOTER_MM / 2.0;
        let x = MARGIN_MM;
        let length = board.ruler_mm.min(self.paper.width_mm - 2.0 * MARGIN_MM);
        // From the outer edge of one tick to that of the other.
        self.rectangle(x, y - RULER_LINE_MM / 2.0, length, RULER_LINE_MM);
        for end in [x, x + length - RULER_LINE_MM] {
            self.rectangle(
                end,
                y - RULER_TICK_MM / 2.0,
                RULER_LINE_MM,
                RULER_TICK_MM / 2.0 - RULER_LINE_MM / 2.0,
            );
            self.rectangle(
                end,
                y + RULER_LINE_MM / 2.0,
                RULER_LINE_MM,
                RULER_TICK_MM / 2.0 - RULER_LINE_MM / 2.0,
            );
        }
        let kind = match board.pattern {
            Pattern::Charuco => "ChArUco",
            Pattern::Chessboard => "chessboard",
            Pattern::Aprilgrid => "AprilGrid",
        };
        let marker = match (board.pattern, board.marker_mm) {
            (Pattern::Charuco, Some(m)) => {
                format!(", markers {m} mm, {}", board.dictionary.as_deref().unwrap_or(""))
            }
            (Pattern::Aprilgrid, Some(m)) => format!(", gaps {m} mm, tag36h11"),
            _ => String::new(),
        };
        self.labels.push(Label {
            x: x + length + 4.0,
            y: y - 0.8,
            text: format!(
                "{length} mm from tick to tick? Measure, and write it into board.toml (measured_ruler_mm)."
            ),
        });
        self.labels.push(Label {
            x: x + length + 4.0,
            y: y + 3.2,
            text: format!("depthrig {kind} {}x{}, {} mm{marker}", board.columns, board.rows, board.square_mm),
        });
    }

    fn rectangle(&mut self, x: f64, y: f64, width: f64, height: f64) {
        self.black.push(Rectangle { x, y, width, height });
    }
}

/// Width of the black border of an AprilGrid's tags, in bits (Kalibr's `kalibr_create_target_pdf`).
pub(crate) const APRILGRID_BORDER: usize = 2;
