//! Whether left and right are what they are said to be: swapped pictures give disparities that nothing agrees with.

use super::sgm::SgmMatcher;
use super::{DisparityMap, Gray, Matcher, Parameters, Preset, Resolution, StereoPair};
use crate::{Error, ErrorKind, Result};

/// What a pair looks like.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Order {
    /// Left is left.
    AsNamed,
    /// The picture that is called left is the right one.
    Swapped,
    /// Too little was found either way: a wall without texture, a covered lens, or pictures that are not rectified.
    Unclear,
}

/// Least share of the pixels that must be matched, in the order that is believed.
const ENOUGH: f64 = 0.15;
/// How many times as much must be matched in one order as in the other.
const CLEARLY: f64 = 1.6;
/// Pictures are halved until they are no wider than this.
const WIDTH: usize = 360;

/// Compares how much is found with left and right as they are named and with them exchanged. A check costs less than a
/// pair with [`Preset::Performance`].
#[derive(Debug)]
pub struct OrderCheck {
    size: (usize, usize),
    /// Each half as large as the one before, of the left and the right picture.
    pictures: Vec<(usize, usize, [Vec<u8>; 2])>,
    matcher: SgmMatcher,
    map: DisparityMap,
}

impl OrderCheck {
    /// Prepares for pairs of a size that are searched for `max_disparity` disparities.
    ///
    /// # Errors
    /// As [`SgmMatcher::new`].
    pub fn new(width: usize, height: usize, max_disparity: usize) -> Result<Self> {
        let mut pictures = Vec::new();
        let (mut w, mut h, mut disparities) = (width, height, max_disparity);
        while w > WIDTH {
            (w, h, disparities) = (w.div_ceil(2), h.div_ceil(2), disparities.div_ceil(2));
            pictures.push((w, h, [vec![0; w * h], vec![0; w * h]]));
        }
        let parameters = Parameters {
            resolution: Resolution::Full,
            // Only what is found counts here, and both views must say the same.
            left_right_px: 1,
            rematch: false,
            gap_px: 0,
            ..Parameters::preset(Preset::Quality, disparities)
        };
        let matcher = SgmMatcher::new(w, h, &parameters, 1)?;
        Ok(Self { size: (width, height), pictures, matcher, map: DisparityMap::default() })
    }

    /// What `pair` looks like.
    ///
    /// # Errors
    /// [`ErrorKind::SizeMismatch`] for pictures of another size.
    pub fn check(&mut self, pair: &StereoPair<'_>) -> Result<Order> {
        pair.left.check("left", self.size.0, self.size.1)?;
        pair.right.check("right", self.size.0, self.size.1)?;
        let Self { pictures, matcher, map, .. } = self;
        for i in 0..pictures.len() {
            let (before, here) = pictures.split_at_mut(i);
            let Some((_, _, to)) = here.first_mut() else { break };
            let from = match before.last() {
                Some((w, h, [left, right])) => [Gray::packed(left, *w, *h), Gray::packed(right, *w, *h)],
                None => [pair.left, pair.right],
            };
            for (from, to) in from.iter().zip(to) {
                super::sgm::halve(from, to);
            }
        }
        let [left, right] = match pictures.last() {
            Some((w, h, [left, right])) => [Gray::packed(left, *w, *h), Gray::packed(right, *w, *h)],
            None => [pair.left, pair.right],
        };
        let mut found = |left, right| {
            matcher.run(&StereoPair::new(left, right), map)?;
            // What is at the far end of both orders says nothing.
            let some = map.disparity.iter().filter(|d| **d >= 1.0).count();
            Ok::<_, Error>(some as f64 / map.disparity.len() as f64)
        };
        let (named, exchanged) = (found(left, right)?, found(right, left)?);
        Ok(if named >= ENOUGH && named >= CLEARLY * exchanged {
            Order::AsNamed
        } else if exchanged >= ENOUGH && exchanged >= CLEARLY * named {
            Order::Swapped
        } else {
            Order::Unclear
        })
    }

    /// Refuses a pair whose pictures are swapped.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`], and it says so; else as [`OrderCheck::check`].
    pub fn refuse_swapped(&mut self, pair: &StereoPair<'_>) -> Result<()> {
        if self.check(pair)? == Order::Swapped {
            return Err(Error::new(
                ErrorKind::BadInput,
                "left and right are swapped: with the pictures exchanged far more is found than as they are; exchange them",
            ));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Noise of blobs, as a picture that was cut `shift` pixels further to the right.
    fn picture(width: usize, height: usize, shift: usize) -> Vec<u8> {
        let blob =
            |x: usize, y: usize| (((x * 7919) ^ (y * 104_729)).wrapping_mul(2_654_435_761) >> 9) & 0xff;
        (0..width * height).map(|i| blob((i % width + shift) / 3, i / width / 2) as u8).collect()
    }

    #[test]
    fn exchanged_pictures_are_noticed() {
        for (w, h) in [(200, 60), (1001, 90)] {
            let (a, b) = (picture(w, h, 0), picture(w, h, 24));
            let (a, b) = (Gray::packed(&a, w, h), Gray::packed(&b, w, h));
            let mut check = OrderCheck::new(w, h, 64).unwrap();
            assert_eq!(check.check(&StereoPair::new(a, b)).unwrap(), Order::AsNamed);
            assert_eq!(check.check(&StereoPair::new(b, a)).unwrap(), Order::Swapped);
            check.refuse_swapped(&StereoPair::new(a, b)).unwrap();
            let said = check.refuse_swapped(&StereoPair::new(b, a)).unwrap_err().to_string();
            assert!(said.contains("swapped"), "{said}");
        }
    }

    #[test]
    fn what_says_nothing_is_unclear() {
        let (w, h) = (200, 60);
        let grey = vec![90; w * h];
        let grey = Gray::packed(&grey, w, h);
        let mut check = OrderCheck::new(w, h, 64).unwrap();
        assert_eq!(check.check(&StereoPair::new(grey, grey)).unwrap(), Order::Unclear);
        // Infinitely far: no order is better.
        let far = picture(w, h, 0);
        let far = Gray::packed(&far, w, h);
        assert_eq!(check.check(&StereoPair::new(far, far)).unwrap(), Order::Unclear);
        assert!(check.check(&StereoPair::new(far, Gray::packed(far.pixels, h, w))).is_err());
    }
}
