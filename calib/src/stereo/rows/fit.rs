//! Robust fit of one plane through many places, and its uncertainty.

use glam::{DMat3, DVec3};

/// Squares that an image is divided into, across and down. Places of one square err alike, in one pair and in the next one
/// of a scene that stands still.
const SQUARES: (usize, usize) = (8, 6);
/// Pairs that count at once at most.
pub const PAIRS: usize = 8;
/// Rounds of weighing; most settle after four.
const ROUNDS: usize = 12;
/// Beyond so many standard deviations a place counts for nothing (Tukey's biweight, 95 % efficient for normal errors).
const TUKEY: f64 = 4.685;
/// Median deviation of normal errors to their standard deviation.
const MAD: f64 = 1.4826;
/// Errors are taken to be no smaller than this, pixels.
const LEAST_PX: f64 = 0.05;

/// Measurement at one place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point {
    /// Column and row, -0.5 to 0.5 of the image.
    pub at: (f64, f64),
    /// Rows by which it lies lower in the right image, pixels.
    pub rows: f64,
    /// Number of the pair, from 0.
    pub pair: usize,
}

impl Point {
    fn square(&self) -> usize {
        let of = |at: f64, n: usize| (((at + 0.5) * n as f64) as usize).min(n - 1);
        of(self.at.1, SQUARES.1) * SQUARES.0 + of(self.at.0, SQUARES.0)
    }
}

/// A plane.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Plane {
    /// In the middle, from the left side to the right one, and from top to bottom, pixels.
    pub terms: DVec3,
    /// Standard deviations of these.
    pub deviations: DVec3,
    /// Share of the places that agree.
    pub agree: f64,
    /// Squares of the image with places that agree.
    pub squares: usize,
}

fn median(values: &mut [f64]) -> f64 {
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// The plane, or its height in the middle alone when `is_flat`. `scratch` holds as many numbers as there are points.
/// `None` when their positions do not determine it.
pub fn fit(points: &[Point], is_flat: bool, scratch: &mut Vec<f64>) -> Option<Plane> {
    if points.is_empty() {
        return None;
    }
    let row = |p: &Point| if is_flat { DVec3::X } else { DVec3::new(1.0, p.at.0, p.at.1) };
    // A flat one has no slopes to be found.
    let rest = if is_flat { DMat3::from_diagonal(DVec3::new(0.0, 1.0, 1.0)) } else { DMat3::ZERO };
    scratch.clear();
    scratch.extend(points.iter().map(|p| p.rows));
    let mut terms = DVec3::new(median(scratch), 0.0, 0.0);
    let mut bread = DMat3::IDENTITY;
    let mut scale = LEAST_PX;
    let weight = |error: f64, scale: f64| {
        let share = error / (TUKEY * scale);
        (1.0 - share * share).max(0.0).powi(2)
    };
    // Of `weight` times the error.
    let slope = |error: f64, scale: f64| {
        let square = (error / (TUKEY * scale)).powi(2);
        (1.0 - square) * (1.0 - 5.0 * square)
    };
    for _ in 0..ROUNDS {
        scratch.clear();
        scratch.extend(points.iter().map(|p| (p.rows - row(p).dot(terms)).abs()));
        scale = (MAD * median(scratch)).max(LEAST_PX);
        let mut normal = rest;
        let mut sums = DVec3::ZERO;
        for p in points {
            let r = row(p);
            let w = weight(p.rows - r.dot(terms), scale);
            normal += outer(r, r) * w;
            sums += r * (w * p.rows);
        }
        if normal.determinant() < 1e-6 * normal.x_axis.x.powi(3) && !is_flat || normal.x_axis.x <= 0.0 {
            return None;
        }
        bread = normal.inverse();
        let next = bread * sums;
        let moved = (next - terms).abs().max_element();
        terms = next;
        if moved < 1e-4 {
            break;
        }
    }
    // How much the sums of whole squares vary, and of whole pairs, is what the result varies by (a sandwich estimate with two
    // kinds of clusters; Cameron, Gelbach and Miller 2011). That of both together is left out, which errs to the safe side.
    let mut by_square = [DVec3::ZERO; SQUARES.0 * SQUARES.1];
    let mut by_pair = [DVec3::ZERO; PAIRS];
    let mut used = [false; SQUARES.0 * SQUARES.1];
    let mut pairs = [false; PAIRS];
    let mut agree = 0_usize;
    let mut weights = 0.0;
    let mut slopes = 0.0;
    for p in points {
        let r = row(p);
        let error = p.rows - r.dot(terms);
        let w = weight(error, scale);
        if w > 0.0 {
            weights += w;
            slopes += slope(error, scale);
            let square = p.square();
            let pair = p.pair % PAIRS;
            by_square[square] += r * (w * error);
            by_pair[pair] += r * (w * error);
            (used[square], pairs[pair]) = (true, true);
            agree += 1;
        }
    }
    let spread = |sums: &[DVec3], used: &[bool]| {
        let n = used.iter().filter(|u| **u).count() as f64;
        let all = sums.iter().fold(DMat3::ZERO, |all, s| all + outer(*s, *s));
        if n > 1.0 { bread * all * bread * (n / (n - 1.0)) } else { DMat3::ZERO }
    };
    let v = spread(&by_square, &used) + spread(&by_pair, &pairs);
    // Such an estimate divides by the slopes of what is summed, `normal` has the weights in their place (Huber 1981, 7.6).
    let steeper = weights / slopes.max(0.5 * weights).max(f64::MIN_POSITIVE);
    let variances = DVec3::new(v.x_axis.x, v.y_axis.y, v.z_axis.z).max(DVec3::ZERO);
    let deviations = variances.map(f64::sqrt) * steeper.max(1.0);
    let squares = used.iter().filter(|u| **u).count();
    Some(Plane { terms, deviations, agree: agree as f64 / points.len() as f64, squares })
}

fn outer(a: DVec3, b: DVec3) -> DMat3 {
    DMat3::from_cols(a * b.x, a * b.y, a * b.z)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A grid of places over the image in several pairs; `rows` gives the offset from the place, its pair and its
    /// number.
    fn grid(pairs: usize, rows: impl Fn(f64, f64, usize, usize) -> f64) -> Vec<Point> {
        let mut points = Vec::new();
        for pair in 0..pairs {
            for i in 0..400 {
                let at = ((i % 20) as f64 / 20.0 - 0.475, (i / 20) as f64 / 20.0 - 0.475);
                points.push(Point { at, rows: rows(at.0, at.1, pair, i), pair });
            }
        }
        points
    }

    /// Between -1 and 1.
    fn noise(a: usize, b: usize) -> f64 {
        let mixed =
            (a as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15) ^ (b as u64).wrapping_mul(0xD1B5_4A32_D192_ED03);
        let mixed = (mixed ^ (mixed >> 31)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        (mixed >> 40) as f64 / f64::from(1 << 23) - 1.0
    }

    #[test]
    fn a_third_that_disagrees_changes_nothing() {
        let wild = |i: usize| if i.is_multiple_of(3) { 6.0 * noise(i, 9) + 1.0 } else { 0.0 };
        let points = grid(1, |x, y, _, i| 1.25 - 0.8 * x + 0.5 * y + 0.05 * noise(i, 1) + wild(i));
        let plane = fit(&points, false, &mut Vec::new()).unwrap();
        assert!((plane.terms - DVec3::new(1.25, -0.8, 0.5)).abs().max_element() < 0.03, "{plane:?}");
        assert!((0.6..0.8).contains(&plane.agree) && plane.squares == 48, "{plane:?}");
        assert!(plane.deviations.max_element() < 0.03, "{plane:?}");
    }

    /// Cameras that expose at different moments on a shaking mount: pairs differ, and all places of a pair agree. Many
    /// places must not make that look certain.
    #[test]
    fn what_differs_from_pair_to_pair_is_uncertain() {
        let shaking = |n: usize| grid(n, |_, _, pair, i| 0.5 * noise(pair, 3) + 0.02 * noise(i, pair));
        for n in [2, 4, 8] {
            let plane = fit(&shaking(n), true, &mut Vec::new()).unwrap();
            assert!(plane.terms.x.abs() < 3.0 * plane.deviations.x.max(0.02), "{n}: {plane:?}");
            assert!(plane.deviations.x > 0.05, "{n}: {plane:?}");
        }
        let still = grid(4, |_, _, pair, i| 0.02 * noise(i, pair));
        assert!(fit(&still, true, &mut Vec::new()).unwrap().deviations.x < 0.003);
    }

    /// The same places of a scene that stands still err alike: more pairs of it are no more certain.
    #[test]
    fn a_scene_that_stands_still_says_no_more_in_more_pairs() {
        let scene = |pairs| fit(&grid(pairs, |_, _, _, i| 0.2 * noise(i, 5)), true, &mut Vec::new()).unwrap();
        let one = scene(1);
        let eight = scene(8);
        assert!((one.terms - eight.terms).abs().max_element() < 1e-6);
        assert!((0.8..1.2).contains(&(eight.deviations.x / one.deviations.x)), "{one:?} {eight:?}");
    }

    #[test]
    fn too_little_is_no_plane() {
        let mut scratch = Vec::new();
        assert_eq!(fit(&[], true, &mut scratch), None);
        // All in one column: nothing is known of the others.
        let column: Vec<_> =
            (0..50).map(|i| Point { at: (0.2, i as f64 / 50.0 - 0.5), rows: 1.0, pair: 0 }).collect();
        assert_eq!(fit(&column, false, &mut scratch), None);
        assert!((fit(&column, true, &mut scratch).unwrap().terms.x - 1.0).abs() < 1e-9);
    }
}
