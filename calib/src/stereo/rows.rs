//! Checks that rows of the left image are rows of the right one, as matching assumes.
//!
//! After rectification with the right calibration, a point lies in the same row of both images. A calibration that is
//! stale, or of another camera, leaves them tenths to several pixels apart: matching then finds less, and finds wrong
//! disparities. Here many distinctive places are searched for in other rows too. Their offsets are a plane over the
//! image: pitch moves all rows, roll more on one side than on the other, another focal length more at the bottom than
//! at the top.

use super::pyramid::Pyramid;
use super::{Gray, StereoPair};
use crate::Result;
use core::fmt;
use fit::{PAIRS, Point};
use track::Reach;

mod fit;
mod track;

/// Images are halved until they are no wider than this.
const WIDTH: usize = 360;
/// Rows that are searched up and down, pixels of the full size, at least.
const ROWS_PX: usize = 6;
/// Fewer places give no result.
const POINTS: usize = 40;
/// Fewer squares of the image give no result.
const SQUARES: usize = 8;
/// Share of the places that must agree.
const AGREE: f64 = 0.6;
/// An offset that is less certain than this is discarded.
const UNSURE_PX: f64 = 0.25;
/// A slope counts when it is this many standard deviations from 0.
const SHOWN: f64 = 3.0;
/// Standard deviations that are stated, for 95 %.
const STATED: f64 = 2.0;
/// Error beyond the scatter of the places: interpolation, and differences between the two images.
const FLOOR_PX: f64 = 0.05;
/// Rows further apart than this overall cause a warning: docs/stereo.md lists the cost.
const LIMIT_PX: f64 = 0.4;

/// An offset is corrected when it is larger than this many times what is uncertain of it,
const SIGNIFICANT: f64 = 2.0;
/// and by more than this beyond that: less costs matching nothing that can be measured, and moving rows blurs them a little.
const WORTH_PX: f64 = 0.15;

/// Row offset between the two images; positive if the content lies lower in the right image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RowOffset {
    /// In the middle of the image, pixels.
    pub middle_px: f64,
    /// How much more it is at the right side than at the left one, pixels; 0 when neither this nor the next is
    /// significant.
    pub across_px: f64,
    /// How much more it is at the bottom than at the top, pixels; likewise.
    pub down_px: f64,
    /// How far each of them may be off, pixels: in 95 of 100 cases it is less.
    pub unsure_px: [f64; 3],
    /// Places that were found in both images.
    pub places: usize,
    /// Pairs that they come from.
    pub pairs: usize,
}

impl RowOffset {
    /// The offset at a place of the image, given as shares of its width and height.
    pub fn at(&self, across: f64, down: f64) -> f64 {
        self.middle_px + self.across_px * (across - 0.5) + self.down_px * (down - 0.5)
    }

    /// The root of the mean square over the image, pixels.
    pub fn overall_px(&self) -> f64 {
        overall([self.middle_px, self.across_px, self.down_px])
    }

    /// Whether the offset exceeds, beyond its uncertainty, the limit at which depth suffers.
    pub fn is_bad(&self) -> bool {
        self.overall_px() - overall(self.unsure_px) > LIMIT_PX
    }

    /// Whether the offset is significant beyond its uncertainty, so that moving the right image's rows by it brings
    /// them nearer to the left image's. Every offset that [`RowOffset::is_bad`] is.
    pub fn is_significant(&self) -> bool {
        let px = self.overall_px();
        let unsure_px = overall(self.unsure_px);
        px > SIGNIFICANT * unsure_px && px - unsure_px > WORTH_PX
    }

    /// The offset of images that were corrected by `self` when `rest` was measured in them.
    #[must_use]
    pub fn with_rest(&self, rest: &Self) -> Self {
        Self {
            middle_px: self.middle_px + rest.middle_px,
            across_px: self.across_px + rest.across_px,
            down_px: self.down_px + rest.down_px,
            ..*rest
        }
    }

    /// The correction as a `key=value` word, for the metadata of results from corrected images.
    pub fn describe_correction(&self) -> String {
        format!("rows_moved_px={:.3},{:.3},{:.3}", self.middle_px, self.across_px, self.down_px)
    }

    /// The warning for a bad offset: the measurement, its effect and the remedy. The caller names the camera.
    /// `is_corrected`: the right image's rows are moved by it before they are matched.
    pub fn warning(&self, is_corrected: bool) -> Option<String> {
        let done = if is_corrected {
            "The right image is moved by that before it is matched; where the offset is not a plane over the image, depth has \
             holes and errors"
        } else {
            "Depth has holes and errors that grow with this; from 1 px on most of it is unusable"
        };
        self.is_bad().then(|| {
            format!(
                "left and right are not rectified to the same rows: {self}. {done}. The calibration does not fit the camera: calibrate it anew with its maker's \
                 tool, or take the factory calibration of this very serial number and resolution (that of another unit does this)"
            )
        })
    }
}

/// Root mean square over the image of a plane with these terms.
fn overall([middle, across, down]: [f64; 3]) -> f64 {
    (middle * middle + (across * across + down * down) / 12.0).sqrt()
}

impl fmt::Display for RowOffset {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let side = if self.middle_px < 0.0 { "higher" } else { "lower" };
        let middle = self.middle_px.abs();
        let unsure = self.unsure_px[0];
        write!(f, "what both see lies {middle:.2} ± {unsure:.2} px {side} in the right one")?;
        let sign = if self.middle_px < 0.0 { -1.0 } else { 1.0 };
        for (slope, from, to, ends) in [
            (self.across_px, (0.0, 0.5), (1.0, 0.5), ["left", "right"]),
            (self.down_px, (0.5, 0.0), (0.5, 1.0), ["top", "bottom"]),
        ] {
            if slope != 0.0 {
                let [a, b] = [from, to].map(|(x, y)| sign * self.at(x, y));
                write!(f, ", {a:.2} at the {} and {b:.2} at the {}", ends[0], ends[1])?;
            }
        }
        let pairs = if self.pairs == 1 { "pair" } else { "pairs" };
        write!(f, " ({} places, {} {pairs})", self.places, self.pairs)
    }
}

/// Measures how far the rows of rectified pairs of one size are apart. Looking at a pair allocates nothing.
#[derive(Debug)]
pub struct RowCheck {
    size: (usize, usize),
    pyramid: Pyramid,
    reach: Reach,
    places: Vec<(u16, u16)>,
    scores: Vec<f32>,
    /// Places of the last pairs, oldest first.
    points: Vec<Point>,
    /// Number of places of each pair.
    counts: [usize; PAIRS],
    pairs: usize,
    scratch: Vec<f64>,
}

impl RowCheck {
    /// Pairs whose places count at once: those of one more replace the oldest pair's.
    pub const PAIRS: usize = PAIRS;

    /// Prepares for pairs of a size.
    pub fn new(width: usize, height: usize) -> Self {
        let pyramid = Pyramid::new((width, height), WIDTH);
        let scale = 1_usize << pyramid.halvings();
        let (w, h) = pyramid.smallest(width, height);
        let places = track::most_places(w, h);
        // The outermost rows are searched only to know that the best is not beyond them.
        let rows = ROWS_PX.div_ceil(scale).max(3) as isize + 1;
        let reach = Reach { near: -4, far: (w / 5).max(8) as isize, rows };
        let scores = ((2 * reach.far + 1) * (2 * rows + 1)).unsigned_abs();
        Self {
            size: (width, height),
            pyramid,
            reach,
            places: Vec::with_capacity(places),
            scores: Vec::with_capacity(scores),
            points: Vec::with_capacity(places * PAIRS),
            counts: [0; PAIRS],
            pairs: 0,
            scratch: Vec::with_capacity(places * PAIRS),
        }
    }

    /// Measures one more pair and returns the number of places measured.
    ///
    /// # Errors
    /// [`crate::ErrorKind::SizeMismatch`] for images of another size.
    pub fn look(&mut self, pair: &StereoPair<'_>) -> Result<usize> {
        pair.left.check("left", self.size.0, self.size.1)?;
        pair.right.check("right", self.size.0, self.size.1)?;
        let slot = self.pairs % PAIRS;
        if self.pairs >= PAIRS {
            self.points.drain(..self.counts[slot]);
        }
        let before = self.points.len();
        let number = self.pairs;
        let (width, height) = self.size;
        let Self { pyramid, reach, places, scores, points, .. } = self;
        pyramid.fill(pair);
        let last = pyramid.halvings();
        let [left, right] = pyramid.level(pair, last);
        track::places(&left, places);
        for &(x, y) in &*places {
            let small = (isize::try_from(x).unwrap_or(0), isize::try_from(y).unwrap_or(0));
            let mut found = track::coarse([&left, &right], small, *reach, scores);
            for halvings in (0..last).rev() {
                let [left, right]: [Gray<'_>; 2] = pyramid.level(pair, halvings);
                let by = last - halvings;
                // The middle of what was halved.
                let at = (small.0 << by, small.1 << by);
                found = found.and_then(|found| track::follow([&left, &right], at, found));
            }
            let at = (small.0 << last, small.1 << last);
            let rows = found.and_then(|found| track::fine([&pair.left, &pair.right], at, found));
            points.extend(rows.map(|rows| Point {
                at: (at.0 as f64 / width as f64 - 0.5, at.1 as f64 / height as f64 - 0.5),
                rows,
                pair: number,
            }));
        }
        let found = self.points.len() - before;
        self.counts[slot] = found;
        self.pairs += 1;
        Ok(found)
    }

    /// The offset over all pairs; `None` for too few places: images without texture, with repeating patterns, or
    /// without common content.
    pub fn offset(&mut self) -> Option<RowOffset> {
        let Self { points, scratch, .. } = self;
        if points.len() < POINTS {
            return None;
        }
        let flat = fit::fit(points, true, scratch)?;
        let sloping = fit::fit(points, false, scratch)?;
        let is_shown = |term: f64, deviation: f64| term.abs() > SHOWN * deviation.max(FLOOR_PX);
        let terms = sloping.terms;
        let deviations = sloping.deviations;
        let is_sloping = is_shown(terms.y, deviations.y) || is_shown(terms.z, deviations.z);
        let plane = if is_sloping { sloping } else { flat };
        let stated = |deviation: f64| (STATED * deviation).hypot(FLOOR_PX);
        let mut unsure = plane.deviations.map(stated);
        if !is_sloping {
            // A slope that is there and could not be shown is what it looked like, as far as that is sure.
            unsure.y = terms.y.abs() + stated(deviations.y);
            unsure.z = terms.z.abs() + stated(deviations.z);
        }
        let unsure = unsure.to_array();
        let is_known = plane.agree >= AGREE && plane.squares >= SQUARES && overall(unsure) <= UNSURE_PX;
        let [middle_px, across_px, down_px] = plane.terms.to_array();
        let pairs = self.pairs.min(PAIRS);
        is_known.then_some(RowOffset {
            middle_px,
            across_px,
            down_px,
            unsure_px: unsure,
            places: self.points.len(),
            pairs,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Between -1 and 1.
    fn noise(a: usize, b: usize) -> f64 {
        let mixed = (a as u64 + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15)
            ^ (b as u64).wrapping_mul(0xD1B5_4A32_D192_ED03);
        let mixed = (mixed ^ (mixed >> 31)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        (mixed >> 40) as f64 / f64::from(1 << 23) - 1.0
    }

    /// Fits `n` places in a grid over `part` of the image, from four pairs.
    fn offset(n: usize, part: f64, rows: impl Fn(usize, usize) -> f64) -> Option<RowOffset> {
        let mut check = RowCheck::new(400, 240);
        check.pairs = 4;
        let side = (n as f64).sqrt().ceil();
        check.points.extend((0..n).map(|i| {
            let at = |i: f64| ((i + 0.5) / side - 0.5) * part;
            let at = (at((i as f64 / side).floor()), at(i as f64 % side));
            Point { at, rows: rows(i, i % 4), pair: i % 4 }
        }));
        check.offset()
    }

    #[test]
    fn too_little_says_nothing() {
        let good = |i: usize, _: usize| 1.0 + 0.05 * noise(i, 1);
        let said = offset(40, 1.0, good).unwrap();
        assert!((said.middle_px - 1.0).abs() < 0.05 && said.is_bad(), "{said}");
        assert_eq!(offset(39, 1.0, good), None, "too few places");
        assert!(offset(400, 0.9, good).is_some());
        assert_eq!(offset(400, 0.2, good), None, "of one corner");
        let most_disagree = |i: usize, _: usize| {
            if i.is_multiple_of(2) { 1.0 + 0.02 * noise(i, 1) } else { 9.0 * noise(i, 2) }
        };
        assert_eq!(offset(400, 1.0, most_disagree), None, "half of it is something else");
        assert_eq!(
            offset(400, 1.0, |i, pair| 2.0 * noise(pair, 7) + 0.05 * noise(i, 1)),
            None,
            "pairs that differ"
        );
    }

    #[test]
    fn a_slope_is_said_where_it_can_be_shown() {
        let flat = offset(60, 1.0, |i, _| 0.3 * noise(i, 4)).unwrap();
        assert_eq!((flat.across_px, flat.down_px), (0.0, 0.0), "{flat}");
        assert!(!flat.to_string().contains(" at the "), "{flat}");
        // One that is there and too small to be shown lies within what is stated.
        let slight = offset(400, 1.0, |i, _| 0.14 * (((i / 20) as f64 + 0.5) / 20.0 - 0.5)).unwrap();
        assert!(slight.across_px == 0.0 && (0.14..0.25).contains(&slight.unsure_px[1]), "{slight:?}");
        assert!(slight.unsure_px[2] < 0.06 && slight.unsure_px[0] < 0.06, "{slight:?}");
        // Column by column from the left.
        let sloping =
            offset(400, 1.0, |i, _| ((i / 20) as f64 + 0.5) / 10.0 - 1.0 + 0.05 * noise(i, 4)).unwrap();
        assert!((sloping.across_px - 2.0).abs() < 0.1 && sloping.is_bad(), "{sloping}");
        assert!(sloping.to_string().contains("at the left and"), "{sloping}");
        assert!(sloping.warning(false).is_some_and(|w| w.contains("calibrate it anew")));
    }

    #[test]
    fn what_is_uncertain_or_small_is_not_corrected() {
        let of = |middle_px: f64, unsure: f64| RowOffset {
            middle_px,
            across_px: 0.0,
            down_px: 0.0,
            unsure_px: [unsure; 3],
            places: 100,
            pairs: 4,
        };
        for (middle, unsure, is) in [
            (0.0, 0.05, false),
            (0.15, 0.05, false),
            (0.19, 0.05, false),
            (0.22, 0.05, true),
            (-0.22, 0.05, true),
            (0.4, 0.2, false),
            (0.5, 0.2, true),
            (1.0, 0.05, true),
        ] {
            assert_eq!(of(middle, unsure).is_significant(), is, "{middle} ± {unsure}");
        }
        // Whatever is warned about is corrected, up to the least certain offset that is stated.
        for unsure in [0.05, 0.1, 0.2, UNSURE_PX / (7.0_f64 / 6.0).sqrt()] {
            for step in 0..300 {
                let offset = of(f64::from(step) / 100.0, unsure);
                assert!(offset.is_significant() || !offset.is_bad(), "{offset:?}");
            }
        }
        let total = of(1.0, 0.1).with_rest(&RowOffset { across_px: 0.5, ..of(-0.25, 0.05) });
        assert_eq!((total.middle_px, total.across_px, total.unsure_px[0]), (0.75, 0.5, 0.05));
        assert_eq!(total.describe_correction(), "rows_moved_px=0.750,0.500,0.000");
    }

    /// A corrected camera is recognised after as many pairs as count at once.
    #[test]
    fn old_pairs_are_forgotten() {
        let w = 240;
        let h = 160;
        let left: Vec<u8> = (0..w * h).map(|i| (127.0 + 120.0 * noise(i, 3)) as u8).collect();
        let mut low = left.clone();
        low.rotate_right(2 * w);
        let [left, low] = [&left, &low].map(|p| Gray::packed(p, w, h));
        let mut check = RowCheck::new(w, h);
        for _ in 0..PAIRS {
            check.look(&StereoPair::new(left, low)).unwrap();
        }
        let before = check.offset().unwrap();
        assert!((before.middle_px - 2.0).abs() < 0.05 && before.is_bad(), "{before}");
        for _ in 0..PAIRS {
            check.look(&StereoPair::new(left, left)).unwrap();
        }
        let after = check.offset().unwrap();
        assert!(after.overall_px() < 0.05 && after.places < before.places * 3 / 2, "{before}, then {after}");
        assert!(check.look(&StereoPair::new(left, Gray::packed(low.pixels, h, w))).is_err());
    }
}
