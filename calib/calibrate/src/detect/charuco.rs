//! ChArUco boards.

use super::{Detection, Detector, FoundCorner, GrayImage, refined};
use crate::board::Board;
use crate::homography::{self, Pair};
use calib_targets_charuco::{CharucoBoardSpec, CharucoDetection, CharucoDetector, CharucoParams};
use depthrig_calib::{Error, ErrorKind, Result};
use glam::{DMat3, DVec2, IVec2};

/// Corners below which a ChArUco board is not used: fewer say little, and may be wrong.
const MIN_CORNERS: usize = 6;
/// Corners below which something that does not fit the board is a wrong detection, and not a second board.
const MIN_OTHER: usize = 4;
/// Neighbours in the board are this many spacings apart in the image at most: perspective shortens one of two neighbours by far less.
const MAX_STRETCH: f64 = 2.5;
/// How far a part of the board behind something may be from where the rest puts it, in squares: lenses bend, other boards are elsewhere.
const MAX_BEND: f64 = 1.5;
/// Corners this far outside of the board's outline belong to it still, in squares.
const MARGIN: f64 = 0.5;

pub(super) struct Charuco {
    board: Board,
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
        Ok(Self { board: board.clone(), detectors, window: (0.9 * (1.0 - relative) / 2.0).min(0.3) })
    }

    /// Column and row of a corner.
    fn place(&self, id: usize) -> IVec2 {
        let across = self.board.columns as i32 - 1;
        IVec2::new(id as i32 % across, id as i32 / across)
    }

    /// Groups of corners that are next to each other in the board and in the image, the largest first. The library joins
    /// what two boards show of each number: each is then a group of its own.
    fn groups(&self, corners: &[FoundCorner]) -> Vec<Vec<FoundCorner>> {
        let spacings = super::spacings(corners);
        let mut free: Vec<usize> = (0..corners.len()).collect();
        let mut groups = Vec::new();
        while let Some(first) = free.pop() {
            let mut group = vec![first];
            let mut next = 0;
            while next < group.len() {
                let at = group[next];
                let joins = |other: &usize| {
                    let apart = (self.place(corners[at].id) - self.place(corners[*other].id)).abs();
                    let near = MAX_STRETCH * spacings[at].min(spacings[*other]);
                    apart.max_element() == 1 && corners[at].pixel.distance(corners[*other].pixel) <= near
                };
                let (joined, others): (Vec<usize>, Vec<usize>) = free.into_iter().partition(joins);
                free = others;
                group.extend(joined);
                next += 1;
            }
            groups.push(group.into_iter().map(|i| corners[i]).collect::<Vec<_>>());
        }
        groups.sort_by_key(|g| core::cmp::Reverse(g.len()));
        groups
    }

    /// From squares, counted from the first corner, to pixels.
    fn view(&self, corners: &[FoundCorner]) -> Option<DMat3> {
        let pairs: Vec<Pair> =
            corners.iter().map(|c| Pair { plane: self.place(c.id).as_dvec2(), image: c.pixel }).collect();
        homography::homography(&pairs).ok()
    }

    /// Whether a corner is about where a view puts it.
    fn fits(&self, view: &DMat3, corner: &FoundCorner) -> bool {
        let at = self.place(corner.id).as_dvec2();
        let shown = homography::apply(view, at);
        let across = homography::apply(view, at + DVec2::X).distance(shown);
        let down = homography::apply(view, at + DVec2::Y).distance(shown);
        corner.pixel.distance(shown) <= MAX_BEND * across.max(down)
    }

    /// The corners of one board, or why there is more than one.
    fn of_one_board(&self, corners: &[FoundCorner]) -> Result<Vec<FoundCorner>, Detection> {
        let mut groups = self.groups(corners).into_iter();
        let Some(mut board) = groups.next() else { return Ok(Vec::new()) };
        for group in groups {
            let view = self.view(&board);
            if view.is_some_and(|h| group.iter().all(|c| self.fits(&h, c))) {
                board.extend(group);
            } else if group.len() >= MIN_OTHER {
                return Err(second_board());
            }
        }
        Ok(board)
    }
}

fn second_board() -> Detection {
    Detection::refused(
        "a second board with the same markers is in view; cover or remove all but one".to_owned(),
    )
}

fn found_corners(found: &CharucoDetection) -> Vec<FoundCorner> {
    let corner = |c: &calib_targets_charuco::CharucoCorner| FoundCorner {
        id: c.id as usize,
        pixel: DVec2::new(f64::from(c.position.x), f64::from(c.position.y)),
    };
    found.corners.iter().map(corner).collect()
}

impl Detector for Charuco {
    fn detect(&self, image: &GrayImage<'_>) -> Detection {
        let view = image.view();
        let Some(first) = self.detectors.first() else { return Detection::default() };
        let cloud = first.detect_corners(&view);
        // The first that succeeds: the others are for blurred and for badly lit images.
        let with_cloud =
            self.detectors.iter().find_map(|d| Some((d, d.detect_with_corners(&view, &cloud).ok()?)));
        let Some((detector, found)) = with_cloud else { return Detection::default() };
        let corners = match self.of_one_board(&found_corners(&found)) {
            Ok(corners) => corners,
            Err(refused) => return refused,
        };
        // What the library leaves when boards are turned against each other.
        if let Some(h) = self.view(&corners) {
            let inverse = h.inverse();
            let low = DVec2::splat(-1.0 - MARGIN);
            let high = DVec2::new(f64::from(self.board.columns), f64::from(self.board.rows)) - 1.0 + MARGIN;
            let is_elsewhere = |c: &&calib_targets_chessboard::ChessCorner| {
                let pixel = DVec2::new(f64::from(c.position.x), f64::from(c.position.y));
                let at = homography::apply(&inverse, pixel);
                !(at.cmpge(low).all() && at.cmple(high).all())
            };
            let rest: Vec<_> = cloud.iter().filter(is_elsewhere).copied().collect();
            let other =
                if rest.len() < MIN_CORNERS { None } else { detector.detect_with_corners(&view, &rest).ok() };
            let elsewhere =
                other.map_or(0, |o| found_corners(&o).iter().filter(|c| !self.fits(&h, c)).count());
            if elsewhere >= MIN_OTHER {
                return second_board();
            }
        }
        let mut corners = refined(image, corners, self.window);
        corners.sort_by_key(|c| c.id);
        if corners.len() < MIN_CORNERS {
            return Detection::default();
        }
        Detection { corners, refused: None }
    }
}
