//! Whether two rectified pictures are in their order: a thing is never further right in the right eye's picture.

/// Half the side of a patch, pixels.
const HALF: usize = 4;
/// Patches along each side of the picture.
const ACROSS: usize = 24;
/// The least mean step between neighbouring pixels of a patch that can be found again.
const TEXTURE: u32 = 4;
/// Disparities up to this tell nothing: what is far away is in the same place, and rectification errs by as much.
const NEAR_PX: usize = 3;
/// How many patches must agree.
const ENOUGH: u32 = 24;

/// What the pictures say.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EyeOrder {
    /// The left one is the left one.
    Right,
    /// They are exchanged: matching would find nothing but chance.
    Swapped,
    /// Too little was found again: no texture, everything far away, or two pictures of different things.
    Unknown,
}

/// Looks for patches of the left picture in the same rows of the right one, in both directions. Both are grey, rectified,
/// of `width` x `height` pixels and without padding. Takes about as long as rectifying a picture; allocates nothing.
pub fn eye_order(left: &[u8], right: &[u8], (width, height): (usize, usize)) -> EyeOrder {
    let pixels = width.checked_mul(height);
    let reach = width / 6;
    if pixels.is_none_or(|n| left.len() != n || right.len() != n)
        || reach <= 2 * NEAR_PX
        || height <= 2 * HALF
    {
        return EyeOrder::Unknown;
    }
    let (mut before, mut after) = (0u32, 0u32);
    for (i, j) in (0..ACROSS).flat_map(|j| (0..ACROSS).map(move |i| (i, j))) {
        // Where the whole search fits into the picture.
        let x = HALF + reach + (width - 2 * (HALF + reach)) * i / ACROSS;
        let y = HALF + (height - 2 * HALF) * j / ACROSS;
        match find(left, right, width, (x, y), reach) {
            Some(shift) if shift < -(NEAR_PX as isize) => before += 1,
            Some(shift) if shift > NEAR_PX as isize => after += 1,
            _ => {}
        }
    }
    if before + after < ENOUGH {
        EyeOrder::Unknown
    } else if after >= 8 * before {
        EyeOrder::Swapped
    } else if before >= 8 * after {
        EyeOrder::Right
    } else {
        EyeOrder::Unknown
    }
}

/// By how much the patch around (`x`, `y`) is further right in the right picture; `None` when it could be in two places.
fn find(left: &[u8], right: &[u8], width: usize, (x, y): (usize, usize), reach: usize) -> Option<isize> {
    let row = |picture: &'_ [u8], x: usize, y: usize| -> [u8; 2 * HALF + 1] {
        let at = y * width + x - HALF;
        picture.get(at..at + 2 * HALF + 1).and_then(|r| r.try_into().ok()).unwrap_or([0; 2 * HALF + 1])
    };
    let patch: [[u8; 2 * HALF + 1]; 2 * HALF + 1] = core::array::from_fn(|i| row(left, x, y - HALF + i));
    let steps: u32 = patch.iter().flat_map(|r| r.windows(2)).map(|w| u32::from(w[0].abs_diff(w[1]))).sum();
    if steps < TEXTURE * (2 * HALF * (2 * HALF + 1)) as u32 {
        return None;
    }
    let difference = |shift: isize| -> u32 {
        let at = x.saturating_add_signed(shift);
        let sum = |(i, own): (usize, &[u8; 2 * HALF + 1])| -> u32 {
            row(right, at, y - HALF + i).iter().zip(own).map(|(a, b)| u32::from(a.abs_diff(*b))).sum()
        };
        patch.iter().enumerate().map(sum).sum()
    };
    let reach = reach as isize;
    let (mut best, mut at) = (u32::MAX, 0);
    for shift in -reach..=reach {
        let d = difference(shift);
        if d < best {
            (best, at) = (d, shift);
        }
    }
    // Half a picture's worth of steps is chance; and no other place may be nearly as good.
    if best > steps / 2 {
        return None;
    }
    let others = (-reach..=reach).filter(|s| (s - at).abs() > 2);
    others.map(difference).all(|d| d > best + best / 4 + 64).then_some(at)
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: (usize, usize) = (320, 200);

    /// A wall of spots at disparity `d`.
    fn wall(d: isize) -> (Vec<u8>, Vec<u8>) {
        let spot = |x: isize, y: isize| {
            let n = ((x / 3) as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15)
                ^ ((y / 3) as u64).wrapping_mul(0xC2B2_AE3D_27D4_EB4F);
            (n.wrapping_mul(0xD6E8_FEB8_6659_FD93) >> 56) as u8
        };
        let eye = |shift: isize| -> Vec<u8> {
            (0..SIZE.0 * SIZE.1)
                .map(|i| spot((i % SIZE.0) as isize + shift + 1000, (i / SIZE.0) as isize))
                .collect()
        };
        (eye(0), eye(d))
    }

    #[test]
    fn the_order_of_the_eyes_shows() {
        let (left, right) = wall(20);
        assert_eq!(eye_order(&left, &right, SIZE), EyeOrder::Right);
        assert_eq!(eye_order(&right, &left, SIZE), EyeOrder::Swapped);
    }

    #[test]
    fn what_tells_nothing_is_not_judged() {
        let (left, far) = wall(1);
        assert_eq!(eye_order(&left, &far, SIZE), EyeOrder::Unknown, "too far away");
        let grey = vec![90; SIZE.0 * SIZE.1];
        assert_eq!(eye_order(&grey, &grey, SIZE), EyeOrder::Unknown, "no texture");
        let stripes: Vec<u8> = (0..SIZE.0 * SIZE.1).map(|i| if i % 16 < 8 { 30 } else { 220 }).collect();
        assert_eq!(eye_order(&stripes, &stripes, SIZE), EyeOrder::Unknown, "it could be anywhere");
        let (_, other) = wall(7919);
        assert_eq!(eye_order(&left, &other, SIZE), EyeOrder::Unknown, "two different things");
        assert_eq!(eye_order(&left, &far[1..], SIZE), EyeOrder::Unknown);
        assert_eq!(eye_order(&[], &[], (0, 0)), EyeOrder::Unknown);
    }
}
