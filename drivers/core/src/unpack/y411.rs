//! Y411, which an L515 calls NV12: blocks of 2 x 2 pixels of six bytes each, taken apart into real NV12.
//!
//! Order of the bytes: u, the upper two y, v, the lower two y (librealsense v2.54 `src/proc/y411-converter.cpp`,
//! Apache-2.0). Nothing is lost: NV12 has the same samples in another order.

use super::count;
use depthrig_bus::DropReason;

/// Takes blocks apart into an NV12 image of rows of `width` pixels.
///
/// # Errors
/// [`DropReason::Incomplete`] when `from` has less bytes than `to`, [`DropReason::WrongSize`] when more, or when they
/// are not a whole number of pairs of rows.
pub fn to_nv12(from: &[u8], width: usize, to: &mut [u8]) -> Result<(), DropReason> {
    let pair = width * 3; // two rows
    match from.len().cmp(&to.len()) {
        core::cmp::Ordering::Less => return Err(DropReason::Incomplete),
        core::cmp::Ordering::Greater => return Err(DropReason::WrongSize),
        core::cmp::Ordering::Equal => {}
    }
    if width == 0 || !width.is_multiple_of(2) || !from.len().is_multiple_of(pair) {
        return Err(DropReason::WrongSize);
    }
    let (luma, chroma) = to.split_at_mut(from.len() / 3 * 2);
    let rows = luma.chunks_exact_mut(2 * width).zip(chroma.chunks_exact_mut(width));
    for ((luma, chroma), blocks) in rows.zip(from.chunks_exact(pair)) {
        let (upper, lower) = luma.split_at_mut(width);
        let (upper, _) = upper.as_chunks_mut::<2>();
        let (lower, _) = lower.as_chunks_mut::<2>();
        let (chroma, _) = chroma.as_chunks_mut::<2>();
        let (blocks, _) = blocks.as_chunks::<6>();
        for (((upper, lower), chroma), [u, y0, y1, v, y2, y3]) in
            upper.iter_mut().zip(lower).zip(chroma).zip(blocks)
        {
            (*upper, *lower, *chroma) = ([*y0, *y1], [*y2, *y3], [*u, *v]);
        }
    }
    count(to.len());
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn an_image_of_4_by_2_by_hand() {
        let mut to = [0; 12];
        to_nv12(b"uABvCDwEFxGH", 4, &mut to).unwrap();
        assert_eq!(&to, b"ABEFCDGHuvwx");
    }

    #[test]
    fn another_number_of_bytes_is_refused() {
        assert_eq!(to_nv12(&[0; 11], 4, &mut [0; 12]), Err(DropReason::Incomplete));
        assert_eq!(to_nv12(&[0; 13], 4, &mut [0; 12]), Err(DropReason::WrongSize));
        assert_eq!(to_nv12(&[0; 12], 3, &mut [0; 12]), Err(DropReason::WrongSize));
        assert_eq!(to_nv12(&[0; 12], 0, &mut [0; 12]), Err(DropReason::WrongSize));
        assert_eq!(to_nv12(&[0; 18], 4, &mut [0; 18]), Err(DropReason::WrongSize), "half a pair of rows");
    }

    proptest! {
        #[test]
        fn every_sample_is_where_its_pixel_is(w in 1usize..40, h in 1usize..40, seed in any::<u8>()) {
            let width = 2 * w;
            let height = 2 * h;
            let from: Vec<u8> = (0..w * h * 6).map(|i| (i as u8).wrapping_mul(31) ^ seed).collect();
            let mut to = vec![0xA5; from.len()];
            to_nv12(&from, width, &mut to).unwrap();
            for y in 0..height {
                for x in 0..width {
                    let block = &from[((y / 2) * w + x / 2) * 6..][..6];
                    prop_assert_eq!(to[y * width + x], block[[[1, 2], [4, 5]][y % 2][x % 2]]);
                    let chroma = width * height + (y / 2) * width + x / 2 * 2;
                    prop_assert_eq!((to[chroma], to[chroma + 1]), (block[0], block[3]));
                }
            }
        }
    }
}
