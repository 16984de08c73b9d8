//! Turns the winners of both views into fractional disparities where the views agree.

use super::kernel::Winner;
use crate::stereo::Parameters;

/// No disparity, among those in 256ths of a pixel.
pub const NONE: u16 = u16::MAX;

/// 256ths of a pixel.
pub const ONE: u16 = 256;

/// Fills a row: disparities in 256ths of a pixel, [`NONE`] for no disparity, and the confidence of each.
///
/// A disparity is kept where the right view has one within `left_right_px` of it, and where the best cost that is not
/// beside it is worse by `uniqueness_percent`. Sureness is 1 plus twice the distance between these two, at most 255.
pub fn choose(
    winners: &[Winner],
    mirrored: &[u8],
    parameters: &Parameters,
    last: u8,
    out: &mut [u16],
    confidence: &mut [u8],
) {
    let least_margin = u32::from(parameters.uniqueness_percent);
    for (x, ((w, out), confidence)) in winners.iter().zip(out).zip(confidence).enumerate() {
        let d = w.disparity;
        let there = x.checked_sub(usize::from(d)).map(|x| mirrored[x]);
        let agree = there.is_some_and(|e| e.abs_diff(d) <= parameters.left_right_px);
        let margin = w.second.saturating_sub(w.cost);
        if agree && u32::from(margin) * 100 >= least_margin * u32::from(w.cost) {
            *out = (i32::from(d) * i32::from(ONE) + fraction(*w, last)) as u16;
            *confidence = 1 + margin.min(127) * 2;
        } else {
            (*out, *confidence) = (NONE, 0);
        }
    }
}

/// Gives disparities to pixels that [`choose`] left without one because the views disagree: that of the right view's pixel
/// which has the pixel as its match, the nearest of several, and with the least confidence. A point that the right
/// camera does not see has none there (Hirschmueller 2008, section 2.6, distinguishes mismatches from occlusions by
/// this). A pixel whose own winner is the same was refused for another reason and stays without.
pub fn rematch(
    winners: &[Winner],
    mirrored: &[u8],
    left_right_px: u8,
    out: &mut [u16],
    confidence: &mut [u8],
) {
    // From the left: of several pixels with one match the first has the largest disparity.
    for (x, d) in mirrored.iter().enumerate() {
        let to = x + usize::from(*d);
        let (Some(w), Some(out)) = (winners.get(to), out.get_mut(to)) else { continue };
        if *out == NONE && w.disparity.abs_diff(*d) > left_right_px {
            (*out, confidence[to]) = (u16::from(*d) * ONE, 1);
        }
    }
}

/// Where two lines of equal and opposite slope through the three costs meet, in 256ths of a pixel from the middle one
/// (the equiangular fit, Shimizu and Okutomi 2005); 0 at both ends of the search.
fn fraction(w: Winner, last: u8) -> i32 {
    if w.disparity == 0 || w.disparity == last {
        return 0;
    }
    let a = i32::from(w.before);
    let b = i32::from(w.cost);
    let c = i32::from(w.after);
    let slope = (a - b).max(c - b).max(1);
    ((a - c) * i32::from(ONE / 2) / slope).clamp(-i32::from(ONE / 2), i32::from(ONE / 2))
}
