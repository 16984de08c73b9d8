//! Chessboards, seen whole.

use super::{Detection, Detector, FoundCorner, GrayImage, refined};
use crate::board::Board;
use crate::homography::{self, Pair};
use calib_targets_chessboard::{
    ChessboardDetection, ChessboardDetector, ChessboardParams, default_chess_config, detect_corners,
};
use glam::DVec2;
use std::collections::BTreeMap;

/// Half-size of the refinement's window, of the spacing of corners (measured on OpenCV's sample images).
const WINDOW: f64 = 0.3;
/// A corner further than this from where its neighbours put it is not the board's, of the spacing.
const MAX_BEND: f64 = 0.25;
/// Corners that may be missing in the grid and are found from their neighbours, of all.
const MAX_MISSING: f64 = 0.15;

pub(super) struct Chessboard {
    detectors: Vec<ChessboardDetector>,
    /// Corners across and down.
    columns: i32,
    rows: i32,
}

/// Place of a corner in a grid: column and row.
type Place = glam::IVec2;

impl Chessboard {
    pub(super) fn new(board: &Board) -> Self {
        let detectors = ChessboardParams::sweep_default()
            .into_iter()
            .filter_map(|p| ChessboardDetector::new(p).ok())
            .collect();
        Self { detectors, columns: board.columns as i32 - 1, rows: board.rows as i32 - 1 }
    }

    /// The part of a grid that is the board, numbered from any of its corners; `None` if too little of it is there.
    fn crop(&self, grid: &BTreeMap<[i32; 2], DVec2>) -> Option<BTreeMap<[i32; 2], DVec2>> {
        let most = |axis: usize| grid.keys().map(|k| k[axis]).max().unwrap_or(0) + 1;
        let mut best: Option<BTreeMap<[i32; 2], DVec2>> = None;
        for turned in [false, true] {
            let (across, down) = if turned { (self.rows, self.columns) } else { (self.columns, self.rows) };
            for u0 in 0..=(most(0) - across).max(0) {
                for v0 in 0..=(most(1) - down).max(0) {
                    let part: BTreeMap<[i32; 2], DVec2> = grid
                        .iter()
                        .map(|(k, p)| (Place::new(k[0] - u0, k[1] - v0), *p))
                        .filter(|(k, _)| k.min_element() >= 0 && k.x < across && k.y < down)
                        // Turned by a quarter: columns run along the board's longer side again.
                        .map(|(k, p)| if turned { ([k.y, across - 1 - k.x], p) } else { ([k.x, k.y], p) })
                        .collect();
                    if best.as_ref().is_none_or(|b| part.len() > b.len()) {
                        best = Some(part);
                    }
                }
            }
        }
        let least = f64::from(self.columns * self.rows) * (1.0 - MAX_MISSING);
        best.filter(|b| b.len() as f64 >= least)
    }

    /// All corners of the board, numbered as they are printed.
    fn complete(&self, image: &GrayImage<'_>, part: &BTreeMap<[i32; 2], DVec2>) -> Option<Vec<FoundCorner>> {
        let pairs: Vec<Pair> = part
            .iter()
            .map(|(k, p)| Pair { plane: DVec2::new(f64::from(k[0]), f64::from(k[1])), image: *p })
            .collect();
        let h = homography::homography(&pairs).ok()?;
        let shown = |x: f64, y: f64| homography::apply(&h, DVec2::new(x, y));
        // Neighbours correct the homography for the lens.
        let place = |at: Place| {
            let bend: Vec<DVec2> = part
                .iter()
                .filter(|(k, _)| (Place::from_array(**k) - at).abs().max_element() <= 1)
                .map(|(k, p)| *p - shown(f64::from(k[0]), f64::from(k[1])))
                .collect();
            let mean = bend.iter().sum::<DVec2>() / bend.len().max(1) as f64;
            shown(f64::from(at.x), f64::from(at.y)) + mean
        };
        // The square between the first four corners is black; half a turn makes it white.
        let first = shown(0.5, 0.5);
        let last = shown(f64::from(self.columns) - 1.5, f64::from(self.rows) - 1.5);
        let turned = brightness(image, &shown, first) > brightness(image, &shown, last);
        let mut corners = Vec::new();
        for row in 0..self.rows {
            for column in 0..self.columns {
                let at = if turned {
                    Place::new(self.columns - 1 - column, self.rows - 1 - row)
                } else {
                    Place::new(column, row)
                };
                let pixel = part.get(&at.to_array()).copied().unwrap_or_else(|| place(at));
                corners.push(FoundCorner { id: (row * self.columns + column) as usize, pixel });
            }
        }
        let all = corners.len();
        let corners = refined(image, corners, WINDOW);
        (corners.len() == all && self.is_smooth(&corners)).then_some(corners)
    }

    /// Whether every corner lies between its neighbours, along rows and columns.
    fn is_smooth(&self, corners: &[FoundCorner]) -> bool {
        let at = |column: i32, row: i32| corners[(row * self.columns + column) as usize].pixel;
        let between =
            |a: DVec2, b: DVec2, c: DVec2| (b - (a + c) * 0.5).length() <= MAX_BEND * (c - a).length() * 0.5;
        let along = |columns: i32, rows: i32, dx: i32, dy: i32| {
            (0..rows).all(|r| {
                (0..columns).all(|c| between(at(c, r), at(c + dx, r + dy), at(c + 2 * dx, r + 2 * dy)))
            })
        };
        along(self.columns - 2, self.rows, 1, 0) && along(self.columns, self.rows - 2, 0, 1)
    }
}

impl Detector for Chessboard {
    fn detect(&self, image: &GrayImage<'_>) -> Detection {
        let cloud = detect_corners(&image.view(), &default_chess_config());
        for detector in &self.detectors {
            let boards: Vec<Vec<FoundCorner>> = detector
                .detect_all(&cloud)
                .iter()
                .filter_map(|found| self.complete(image, &self.crop(&right_handed(found))?))
                .collect();
            match boards.len() {
                0 => {}
                1 => {
                    return Detection {
                        corners: boards.into_iter().next().unwrap_or_default(),
                        refused: None,
                    };
                }
                n => {
                    return Detection::refused(format!(
                        "{n} boards of this size are in view; cover or remove all but one"
                    ));
                }
            }
        }
        Detection::default()
    }
}

/// Mean of the pixels around the middle of a square.
fn brightness(image: &GrayImage<'_>, shown: &impl Fn(f64, f64) -> DVec2, middle: DVec2) -> f64 {
    let step = (shown(1.0, 0.0) - shown(0.0, 0.0)) * 0.15;
    let other = (shown(0.0, 1.0) - shown(0.0, 0.0)) * 0.15;
    let near = [DVec2::ZERO, step, -step, other, -other];
    near.iter().map(|d| f64::from(image.nearest(middle + *d))).sum::<f64>() / near.len() as f64
}

/// A grid's corners with columns and rows oriented like the image's x and y.
fn right_handed(found: &ChessboardDetection) -> BTreeMap<[i32; 2], DVec2> {
    let grid: BTreeMap<[i32; 2], DVec2> = found
        .corners
        .iter()
        .map(|c| ([c.grid.u, c.grid.v], DVec2::new(f64::from(c.position.x), f64::from(c.position.y))))
        .collect();
    let mut handed = 0.0;
    for ([u, v], p) in &grid {
        if let (Some(x), Some(y)) = (grid.get(&[u + 1, *v]), grid.get(&[*u, v + 1])) {
            handed += (*x - *p).perp_dot(*y - *p).signum();
        }
    }
    if handed >= 0.0 { grid } else { grid.into_iter().map(|([u, v], p)| ([v, u], p)).collect() }
}
