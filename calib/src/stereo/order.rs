//! Checks that left and right are not swapped: a thing is never further right in the right image.
//!
//! One search over both directions lets them compete for each pixel, and a pixel counts when one place is clearly the
//! best. Repetition defeats that: for a fence whose next post is nearer than the right one, every pixel gives the wrong
//! answer. So an image that resembles itself elsewhere gives no verdict.

use super::pyramid::Pyramid;
use super::sgm::SgmMatcher;
use super::{DisparityMap, Gray, MAX_DISPARITIES, Matcher, Parameters, Preset, Resolution, StereoPair};
use crate::{Error, ErrorKind, Result};
use core::ops::Range;

/// Verdict on a pair.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Order {
    /// Left and right are as named.
    AsNamed,
    /// Left and right are swapped.
    Swapped,
    /// No verdict: a wall without texture or of one pattern, a covered lens, everything far away, or images that
    /// are not rectified.
    Unclear,
}

/// Least share of the pixels that must agree.
const ENOUGH: f64 = 0.2;
/// Least ratio of the pixels that agree to those that say the opposite.
const CLEARLY: f64 = 8.0;
/// Share of them by which as many may look like others in their own image. Images of rooms have 0.25 and patterns 0.65.
const REPEATED: f64 = 0.45;
/// By how many percent another place must be worse.
const UNIQUE_PERCENT: u8 = 15;
/// Disparities up to this are ignored: rectification errs by as much.
const NEAR_PX: f32 = 1.5;
/// A match this near the end of the search often belongs beyond it: on a slope any place fits as well.
const END_PX: f32 = 2.0;
/// A pixel looks like those beside it; only what is farther away than this is a repetition.
const APART_PX: usize = 3;
/// Images are halved until they are no wider than this.
const WIDTH: usize = 360;

/// Checks whether things lie further left in the right image, as they must, or further right. A check costs about as
/// much as a pair with [`Preset::Performance`] and allocates nothing after the first.
#[derive(Debug)]
pub struct OrderCheck {
    size: (usize, usize),
    pyramid: Pyramid,
    /// An image of the last size whose pixels were moved.
    moved: Vec<u8>,
    /// Disparities to look for in each direction, in the last size.
    reach: usize,
    matcher: SgmMatcher,
    map: DisparityMap,
}

impl OrderCheck {
    /// Prepares for pairs of a size. Disparities above a sixth of the width are ignored.
    ///
    /// # Errors
    /// As [`SgmMatcher::new`].
    pub fn new(width: usize, height: usize) -> Result<Self> {
        let pyramid = Pyramid::new((width, height), WIDTH);
        let (w, h) = pyramid.smallest(width, height);
        let reach = (w / 6).clamp(1, MAX_DISPARITIES / 2);
        let parameters = Parameters {
            resolution: Resolution::Full,
            uniqueness_percent: UNIQUE_PERCENT,
            // Only what is found counts here, and both views must say the same.
            left_right_px: 1,
            rematch: false,
            gap_px: 0,
            ..Parameters::preset(Preset::Quality, 2 * reach)
        };
        let matcher = SgmMatcher::new(w, h, &parameters, 1)?;
        let moved = vec![0; w * h];
        Ok(Self { size: (width, height), pyramid, moved, reach, matcher, map: DisparityMap::default() })
    }

    /// Judges `pair`.
    ///
    /// # Errors
    /// [`ErrorKind::SizeMismatch`] for images of another size.
    pub fn check(&mut self, pair: &StereoPair<'_>) -> Result<Order> {
        pair.left.check("left", self.size.0, self.size.1)?;
        pair.right.check("right", self.size.0, self.size.1)?;
        let Self { pyramid, moved, reach, matcher, map, .. } = self;
        pyramid.fill(pair);
        let [left, right] = pyramid.level(pair, pyramid.halvings());
        let mut look = |left: &Gray<'_>, right: &Gray<'_>| sides(matcher, map, moved, *reach, left, right);
        // The search ends at the sides of the image, which draws what fits everywhere to one of them; with the images
        // exchanged it is drawn there again, and what was found is found on the other side.
        let [further_left, further_right] = look(&left, &right)?;
        let exchanged = look(&right, &left)?;
        let named = further_left.min(exchanged[1]);
        let swapped = further_right.min(exchanged[0]);
        let (order, most) = if named >= ENOUGH && named >= CLEARLY * further_right.max(exchanged[0]) {
            (Order::AsNamed, named)
        } else if swapped >= ENOUGH && swapped >= CLEARLY * further_left.max(exchanged[1]) {
            (Order::Swapped, swapped)
        } else {
            return Ok(Order::Unclear);
        };
        let mut repeated = 0.0_f64;
        for image in [left, right] {
            shift(&image, APART_PX as isize, moved);
            matcher.run(&StereoPair::new(image, Gray::packed(moved, image.width, image.height)), map)?;
            // At the near end are those that merely look like what is beside them.
            repeated = repeated.max(share(map, 2 * *reach..image.width, |d| d > APART_PX as f32));
        }
        Ok(if repeated < REPEATED * most { order } else { Order::Unclear })
    }

    /// Refuses a pair whose images are swapped.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] for swapped images; else as [`OrderCheck::check`].
    pub fn refuse_swapped(&mut self, pair: &StereoPair<'_>) -> Result<()> {
        if self.check(pair)? == Order::Swapped {
            return Err(Error::new(
                ErrorKind::BadInput,
                "left and right are swapped: what is near lies further right in the right image; exchange them",
            ));
        }
        Ok(())
    }
}

/// The image moved to the right by `by` pixels; black where nothing is left.
fn shift(image: &Gray<'_>, by: isize, to: &mut [u8]) {
    for (y, to) in to.chunks_mut(image.width.max(1)).enumerate() {
        let row = image.row(y);
        let n = by.unsigned_abs().min(row.len());
        let kept = row.len() - n;
        if by < 0 {
            to[..kept].copy_from_slice(&row[n..]);
            to[kept..].fill(0);
        } else {
            to[n..].copy_from_slice(&row[..kept]);
            to[..n].fill(0);
        }
    }
}

/// Share of the pixels that lie further left, and further right, in the other image than in this one.
fn sides(
    matcher: &mut SgmMatcher,
    map: &mut DisparityMap,
    moved: &mut [u8],
    reach: usize,
    here: &Gray<'_>,
    other: &Gray<'_>,
) -> Result<[f64; 2]> {
    // A point `reach` further right than here is found at 0, one as far to the left at `2 * reach`.
    shift(other, -(reach as isize), moved);
    matcher.run(&StereoPair::new(*here, Gray::packed(moved, here.width, here.height)), map)?;
    // Of the others a part of the search lies beside the image.
    let whole = 2 * reach..here.width - reach;
    let middle = reach as f32;
    Ok([
        share(map, whole.clone(), |d| d > middle + NEAR_PX && d < 2.0 * middle - END_PX),
        share(map, whole, |d| d < middle - NEAR_PX && d > END_PX),
    ])
}

/// Share of the pixels in these columns whose disparity is one of those that count.
fn share(map: &DisparityMap, columns: Range<usize>, counts: impl Fn(f32) -> bool) -> f64 {
    let rows = map.disparity.chunks(map.width.max(1));
    let found = rows.clone().filter_map(|r| r.get(columns.clone())).flatten().filter(|d| counts(**d)).count();
    found as f64 / (columns.len() * rows.len()).max(1) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Noise of blobs, as an image that was cut `shift` pixels further to the right.
    fn image(width: usize, height: usize, shift: usize) -> Vec<u8> {
        let blob =
            |x: usize, y: usize| (((x * 7919) ^ (y * 104_729)).wrapping_mul(2_654_435_761) >> 9) & 0xff;
        (0..width * height).map(|i| blob((i % width + shift) / 3, i / width / 2) as u8).collect()
    }

    #[test]
    fn exchanged_images_are_noticed() {
        for (w, h) in [(200, 60), (1001, 90)] {
            let a = image(w, h, 0);
            let b = image(w, h, 24);
            let a = Gray::packed(&a, w, h);
            let b = Gray::packed(&b, w, h);
            let mut check = OrderCheck::new(w, h).unwrap();
            assert_eq!(check.check(&StereoPair::new(a, b)).unwrap(), Order::AsNamed);
            assert_eq!(check.check(&StereoPair::new(b, a)).unwrap(), Order::Swapped);
            check.refuse_swapped(&StereoPair::new(a, b)).unwrap();
            let said = check.refuse_swapped(&StereoPair::new(b, a)).unwrap_err().to_string();
            assert!(said.contains("swapped"), "{said}");
        }
    }

    #[test]
    fn what_says_nothing_is_unclear() {
        let w = 200;
        let h = 60;
        let mut grey = vec![90; w * h];
        let mut framed = vec![90; w * h];
        framed.chunks_mut(w).for_each(|row| row[..9].fill(0));
        grey[w * h / 2] = 91;
        let [grey, framed] = [&grey, &framed].map(|p| Gray::packed(p, w, h));
        let mut check = OrderCheck::new(w, h).unwrap();
        for alike in [grey, framed] {
            assert_eq!(check.check(&StereoPair::new(alike, alike)).unwrap(), Order::Unclear);
        }
        // Infinitely far: no order is better.
        let far = image(w, h, 0);
        let far = Gray::packed(&far, w, h);
        assert_eq!(check.check(&StereoPair::new(far, far)).unwrap(), Order::Unclear);
        assert!(check.check(&StereoPair::new(far, Gray::packed(far.pixels, h, w))).is_err());
        // Too small to look for anything.
        for (w, h) in [(1, 1), (5, 3), (16, 1)] {
            let small = image(w, h, 0);
            let small = Gray::packed(&small, w, h);
            let Ok(mut check) = OrderCheck::new(w, h) else { continue };
            assert_eq!(check.check(&StereoPair::new(small, small)).unwrap(), Order::Unclear, "{w}x{h}");
        }
    }

    #[test]
    fn images_are_moved_as_far_as_they_go() {
        let pixels = [1, 2, 3, 9, 4, 5, 6, 9];
        let image = Gray { pixels: &pixels, width: 3, height: 2, stride: 4 };
        let mut out = [7; 6];
        for (by, expected) in [
            (1, [0, 1, 2, 0, 4, 5]),
            (-2, [3, 0, 0, 6, 0, 0]),
            (0, [1, 2, 3, 4, 5, 6]),
            (5, [0; 6]),
            (-5, [0; 6]),
        ] {
            shift(&image, by, &mut out);
            assert_eq!(out, expected, "{by}");
        }
    }
}
