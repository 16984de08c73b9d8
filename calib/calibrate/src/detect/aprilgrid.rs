//! Kalibr's AprilGrid.
//!
//! The crate `aprilgrid` would bring `faer`, `imageproc` and 150 more. The small squares between the tags make each corner of a tag one
//! between two black and two white squares, which the detector of the other boards finds; four of them that frame
//! a tag are decoded with the same library's dictionary.

use super::{Detection, Detector, FoundCorner, GrayImage, refined_in};
use crate::board::{APRILGRID_BORDER, Board};
use crate::homography::{self, Pair};
use calib_targets_aruco::{MarkerCell, Matcher, ScanDecodeConfig, scan_decode_markers_in_cells};
use calib_targets_chessboard::{ChessCorner, default_chess_config, detect_corners};
use calib_targets_core::Coord;
use depthrig_calib::Result;
use glam::{DMat3, DVec2};
use nalgebra::Point2;
use std::collections::BTreeMap;

/// Half-size of the refinement's window, of the gap between tags.
const WINDOW: f64 = 0.4;
/// Bits that may be read wrong; codes of tag36h11 differ in 11 or more.
const MAX_WRONG_BITS: u8 = 3;
/// Tags below which a grid is not used.
const MIN_TAGS: usize = 3;
/// How far a tag's corner may be from where its neighbour puts it, of a tag's side.
const MAX_BEND: f64 = 0.5;
/// A corner along an edge may be this far from the edge's direction (a sine).
const MAX_SLANT: f64 = 0.2;
/// How far the fourth corner of a tag may be from the parallelogram of the other three, of its side.
const MAX_SKEW: f64 = 0.4;
/// Points among which a corner's neighbours are looked for: those of four tags, with some of their bits.
const NEAR: usize = 40;
/// A tag's border is darker than the paper by this at least, of 255.
const MIN_CONTRAST: u16 = 15;
/// Corners tried along one direction: the nearest may be the other end of the gap.
const TRIED: usize = 2;

pub(super) struct AprilGrid {
    board: Board,
    matcher: Matcher,
    decoding: ScanDecodeConfig,
}

/// A decoded tag: its corners in the order of [`Board::corner`].
struct Tag {
    id: usize,
    corners: [DVec2; 4],
    wrong_bits: u8,
}

impl Tag {
    fn shortest_side(&self) -> f64 {
        (0..4).map(|k| self.corners[k].distance(self.corners[(k + 1) % 4])).fold(f64::INFINITY, f64::min)
    }
}

impl AprilGrid {
    pub(super) fn new(board: &Board) -> Result<Self> {
        Ok(Self {
            board: board.clone(),
            matcher: Matcher::new(board.dictionary()?, MAX_WRONG_BITS),
            decoding: ScanDecodeConfig::default()
                .with_border_bits(APRILGRID_BORDER)
                .with_inset_frac(0.0)
                .with_dedup_by_id(false),
        })
    }

    /// Quadrilaterals that may be tags: clockwise in the image, dark inside their edges and light outside.
    fn quadrilaterals(image: &GrayImage<'_>, cloud: &[ChessCorner]) -> Vec<[DVec2; 4]> {
        let points: Vec<DVec2> =
            cloud.iter().map(|c| DVec2::new(f64::from(c.position.x), f64::from(c.position.y))).collect();
        let near: Vec<Vec<usize>> = (0..points.len()).map(|i| nearest(&points, i)).collect();
        let mut found = Vec::new();
        for (i, corner) in cloud.iter().enumerate() {
            let axes = corner.axes.map(|a| DVec2::from_angle(f64::from(a.angle)));
            let directions = [axes[0], axes[1], -axes[0], -axes[1]];
            let ahead = directions.map(|d| along(&points, i, &near[i], d));
            for (k, first) in ahead.iter().enumerate() {
                for second in [&ahead[(k + 1) % 4], &ahead[(k + 3) % 4]] {
                    for a in first {
                        for b in second {
                            found.extend(closed(&points, i, *a, *b, &near[*a]));
                        }
                    }
                }
            }
        }
        // Found once from each of its corners: the one that begins at the least corner is kept.
        found
            .into_iter()
            .filter(|q| q.iter().all(|p| (p.y, p.x) >= (q[0].y, q[0].x)) && has_border(image, q))
            .collect()
    }

    fn tags(&self, image: &GrayImage<'_>, quadrilaterals: &[[DVec2; 4]]) -> Vec<Tag> {
        let cells: Vec<MarkerCell> = quadrilaterals
            .iter()
            .enumerate()
            .map(|(i, q)| {
                let at = q.map(|p| Point2::new(p.x as f32, p.y as f32));
                MarkerCell::new(Coord::new(i as i32, 0), at)
            })
            .collect();
        let pixels = (self.matcher.dictionary().marker_size() + 2 * APRILGRID_BORDER) * 4;
        scan_decode_markers_in_cells(&image.view(), &cells, pixels as f32, &self.decoding, &self.matcher)
            .into_iter()
            .filter(|m| !m.inverted && (m.id as usize) < (self.board.columns * self.board.rows) as usize)
            .filter_map(|m| {
                let q = m.corners_img?.map(|p| DVec2::new(f64::from(p.x), f64::from(p.y)));
                // Clockwise from the top-left one as printed; then counter-clockwise from the bottom-left one. The dictionary has
                // the tags upside down.
                let printed = |k: usize| q[(k + 2 + usize::from(m.rotation)) % 4];
                Some(Tag {
                    id: m.id as usize,
                    corners: [printed(3), printed(2), printed(1), printed(0)],
                    wrong_bits: m.hamming,
                })
            })
            .collect()
    }

    fn pairs(&self, tag: &Tag) -> [Pair; 4] {
        core::array::from_fn(|k| Pair {
            plane: self.board.corner(4 * tag.id + k).truncate(),
            image: tag.corners[k],
        })
    }
}

/// The points nearest to point `i`, nearest first.
fn nearest(points: &[DVec2], i: usize) -> Vec<usize> {
    let mut all: Vec<usize> = (0..points.len()).filter(|k| *k != i).collect();
    let far = |k: &usize| points[*k].distance_squared(points[i]);
    if all.len() > NEAR {
        all.select_nth_unstable_by(NEAR, |a, b| far(a).total_cmp(&far(b)));
        all.truncate(NEAR);
    }
    all.sort_by(|a, b| far(a).total_cmp(&far(b)));
    all
}

/// Those of the points `near` point `i` that lie along a direction from it.
fn along(points: &[DVec2], i: usize, near: &[usize], direction: DVec2) -> Vec<usize> {
    let is_along = |k: &&usize| {
        let d = points[**k] - points[i];
        d.dot(direction) > 0.0 && d.perp_dot(direction).abs() < MAX_SLANT * d.length()
    };
    near.iter().filter(is_along).take(TRIED).copied().collect()
}

/// The quadrilateral of corner `i`, its neighbours `a` and `b`, and the point `near` `a` where the fourth corner must be, clockwise.
fn closed(points: &[DVec2], i: usize, a: usize, b: usize, near: &[usize]) -> Option<[DVec2; 4]> {
    let u = points[a] - points[i];
    let v = points[b] - points[i];
    // Clockwise in an image whose y points down; the gap's rectangles are long.
    if u.perp_dot(v) <= 0.0 || u.length() > 2.0 * v.length() || v.length() > 2.0 * u.length() {
        return None;
    }
    let wanted = points[i] + u + v;
    let side = u.length().min(v.length());
    let far = |k: &usize| points[*k].distance_squared(wanted);
    let fourth = points[*near.iter().min_by(|p, q| far(p).total_cmp(&far(q)))?];
    (fourth.distance(wanted) < MAX_SKEW * side).then_some([points[i], points[a], fourth, points[b]])
}

/// Whether each edge is darker inside, where a tag's border is, than outside, where the gap is.
fn has_border(image: &GrayImage<'_>, corners: &[DVec2; 4]) -> bool {
    (0..4).all(|k| {
        let from = corners[k];
        let to = corners[(k + 1) % 4];
        let opposite = corners[(k + 2) % 4].midpoint(corners[(k + 3) % 4]);
        // A tenth of the way across: the middle of the border, and well before the gap's other side.
        let inward = (opposite - from.midpoint(to)) * 0.1;
        [0.3, 0.5, 0.7].iter().all(|share| {
            let at = from.lerp(to, *share);
            let inside = image.nearest(at + inward);
            let outside = image.nearest(at - inward);
            u16::from(inside) + MIN_CONTRAST < u16::from(outside)
        })
    })
}

impl Detector for AprilGrid {
    fn detect(&self, image: &GrayImage<'_>) -> Detection {
        let cloud = detect_corners(&image.view(), &default_chess_config());
        let mut tags = self.tags(image, &Self::quadrilaterals(image, &cloud));
        tags.sort_by_key(|t| t.wrong_bits);
        let mut boards = self.boards(&tags);
        boards.sort_by_key(|b| core::cmp::Reverse(b.len()));
        boards.retain(|b| b.len() >= MIN_TAGS);
        let Some(board) = boards.first() else { return Detection::default() };
        if boards[1..].iter().flatten().any(|t| board.iter().any(|b| b.id == t.id)) {
            return Detection::refused(
                "tags of a second board are in view; cover or remove all but one".to_owned(),
            );
        }
        // Parts of a board that something covers in the middle are of one board.
        let mut by_id: BTreeMap<usize, &Tag> = BTreeMap::new();
        for tag in boards.iter().flatten() {
            by_id.entry(tag.id).or_insert(tag);
        }
        let mut corners = Vec::with_capacity(4 * by_id.len());
        for tag in by_id.values() {
            let found = (0..4).map(|k| FoundCorner { id: 4 * tag.id + k, pixel: tag.corners[k] });
            let gap = tag.shortest_side() * self.board.marker_mm.unwrap_or(0.0) / self.board.square_mm;
            corners.extend(refined_in(image, found, WINDOW * gap));
        }
        Detection { corners, refused: None }
    }
}

impl AprilGrid {
    /// Groups of tags that are where their neighbours in the grid put them: no lens bends the way from one tag to the next.
    fn boards<'a>(&self, tags: &'a [Tag]) -> Vec<Vec<&'a Tag>> {
        let mut free: Vec<&Tag> = tags.iter().collect();
        let mut groups = Vec::new();
        while let Some(first) = free.pop() {
            let mut group = vec![first];
            let mut next = 0;
            while next < group.len() {
                let tag = group[next];
                let near = homography::homography(&self.pairs(tag)).ok();
                let (joined, others) = free.into_iter().partition(|other| {
                    near.is_some_and(|h| self.are_neighbours(tag, other) && self.shows(&h, tag, other))
                });
                free = others;
                let joined: Vec<&Tag> = joined;
                group.extend(joined);
                next += 1;
            }
            groups.push(group);
        }
        groups
    }

    fn are_neighbours(&self, a: &Tag, b: &Tag) -> bool {
        let columns = self.board.columns as usize;
        let apart = |f: fn(usize, usize) -> usize| f(a.id, columns).abs_diff(f(b.id, columns));
        apart(|id, n| id % n) + apart(|id, n| id / n) == 1
    }

    /// Whether a tag's homography shows its neighbour where that was found.
    fn shows(&self, h: &DMat3, tag: &Tag, neighbour: &Tag) -> bool {
        let near = MAX_BEND * tag.shortest_side();
        self.pairs(neighbour).iter().all(|p| (homography::apply(h, p.plane) - p.image).length() < near)
    }
}
