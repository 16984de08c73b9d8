//! How far out a lens model can be trusted: where the shown radius stops growing.

use super::Lens;

/// Radii beyond this are not looked at: 89.4° from the axis.
const MAX_RADIUS: f64 = 100.0;

/// The radius on the plane z = 1 up to which the shown radius grows with the radius. Infinite for a pinhole.
pub(super) fn monotone(lens: &Lens) -> f64 {
    match lens {
        Lens::None => f64::INFINITY,
        Lens::Rational([k1, k2, _, _, k3, k4, k5, k6]) => {
            let top = [1.0, *k1, *k2, *k3];
            let bottom = [1.0, *k4, *k5, *k6];
            // With q = r²: d(r N/D)/dr = 0 where N D + 2 q (N' D − N D') = 0.
            let mut slope = [0.0; 7];
            for (i, n) in top.iter().enumerate() {
                for (j, d) in bottom.iter().enumerate() {
                    slope[i + j] += n * d * (1.0 + 2.0 * (i as f64 - j as f64));
                }
            }
            let q = MAX_RADIUS * MAX_RADIUS;
            first_root(&slope, q).min(first_root(&bottom, q)).sqrt()
        }
        Lens::InverseBrownConrady([k1, k2, _, _, k3]) => {
            first_root(&[1.0, 3.0 * k1, 5.0 * k2, 7.0 * k3], MAX_RADIUS * MAX_RADIUS).sqrt()
        }
        Lens::KannalaBrandt([k1, k2, k3, k4]) => {
            let theta = MAX_RADIUS.atan();
            let q = first_root(&[1.0, 3.0 * k1, 5.0 * k2, 7.0 * k3, 9.0 * k4], theta * theta);
            q.sqrt().tan()
        }
    }
}

/// The least root of a polynomial (constant term first, positive at 0) in (0, `end`], or `end`. A root at which the
/// polynomial does not change its sign is one too as far as rounding lets it be seen.
fn first_root(polynomial: &[f64], end: f64) -> f64 {
    let mut roots = [0.0; 8];
    let n = roots_of(polynomial, end, &mut roots);
    if n == 0 { end } else { roots[0] }
}

/// The sign changes of a polynomial in (0, `end`), ascending: between two neighbouring extremes there is at most one.
fn roots_of(polynomial: &[f64], end: f64, roots: &mut [f64; 8]) -> usize {
    let Some(degree) = polynomial.iter().rposition(|c| *c != 0.0).filter(|d| *d > 0) else { return 0 };
    let mut derivative = [0.0; 8];
    for (i, c) in polynomial[..=degree].iter().enumerate().skip(1) {
        derivative[i - 1] = c * i as f64;
    }
    let mut bounds = [0.0; 8];
    let n = roots_of(&derivative[..degree], end, &mut bounds);
    let value = |q: f64| polynomial[..=degree].iter().rev().fold(0.0, |sum, c| sum * q + c);
    let mut found = 0;
    let mut low = 0.0;
    for high in bounds[..n].iter().copied().chain([end]) {
        let a = value(low);
        let b = value(high);
        if a != 0.0 && (b == 0.0 || (a > 0.0) != (b > 0.0)) {
            roots[found] = bisect(value, low, high);
            found += 1;
        }
        low = high;
    }
    found
}

/// The sign change between `low` and `high`, on the side of `low`.
fn bisect(value: impl Fn(f64) -> f64, mut low: f64, mut high: f64) -> f64 {
    let positive = value(low) > 0.0;
    for _ in 0..200 {
        let middle = 0.5 * (low + high);
        if middle <= low || middle >= high {
            break;
        }
        let v = value(middle);
        if v != 0.0 && (v > 0.0) == positive {
            low = middle;
        } else {
            high = middle;
        }
    }
    low
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_of_several_roots() {
        // (q − 1)(q − 2)(q − 3) · −1, positive at 0.
        let p = [6.0, -11.0, 6.0, -1.0];
        assert!((first_root(&p, 10.0) - 1.0).abs() < 1e-12);
        assert_eq!(first_root(&p, 0.5), 0.5);
        assert_eq!(first_root(&[1.0, 0.0, 3.0], 7.0), 7.0);
        assert_eq!(first_root(&[1.0], 7.0), 7.0);
        assert!((first_root(&[1.0, -4.0], 7.0) - 0.25).abs() < 1e-15);
    }
}
