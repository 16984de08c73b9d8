//! Blue, green, red and a byte of alpha, without the alpha.

use super::count;
use depthrig_bus::DropReason;

/// Writes the first three bytes of each pixel of four to `to`; rows of `width` pixels begin every `stride` bytes. The
/// last row may lack its padding.
///
/// # Errors
/// [`DropReason::Incomplete`] when `from` ends before the last row does, [`DropReason::WrongSize`] when rows overlap or
/// `to` is not a whole number of rows.
pub fn drop_alpha(from: &[u8], stride: usize, width: usize, to: &mut [u8]) -> Result<(), DropReason> {
    if width == 0 || stride < width * 4 || !to.len().is_multiple_of(width * 3) {
        return Err(DropReason::WrongSize);
    }
    let rows = to.len() / (width * 3);
    let needed = rows.checked_sub(1).map_or(0, |before| before * stride + width * 4);
    let from = from.get(..needed).ok_or(DropReason::Incomplete)?;
    for (row, out) in from.chunks(stride).zip(to.chunks_exact_mut(width * 3)) {
        let (pixels, _) = row.as_chunks::<4>();
        let (targets, _) = out.as_chunks_mut::<3>();
        for (target, pixel) in targets.iter_mut().zip(pixels) {
            *target = [pixel[0], pixel[1], pixel[2]];
        }
    }
    count(to.len());
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn as_pixel_by_pixel(
            from in proptest::collection::vec(any::<u8>(), 0..600),
            width in 1usize..12,
            padding in 0usize..9,
            rows in 0usize..12,
        ) {
            let stride = width * 4 + padding;
            let mut to = vec![0xA5; width * 3 * rows];
            let done = drop_alpha(&from, stride, width, &mut to);
            let model: Option<Vec<u8>> = (0..rows * width * 3)
                .map(|i| {
                    let y = i / (width * 3);
                    let x = i / 3 % width;
                    let c = i % 3;
                    from.get(y * stride + x * 4 + c).copied()
                })
                .collect();
            // The last pixel's alpha must be there too.
            let whole = rows == 0 || from.len() >= (rows - 1) * stride + width * 4;
            if let Some(model) = model.filter(|_| whole) {
                prop_assert_eq!(done, Ok(()));
                prop_assert_eq!(to, model);
            } else {
                prop_assert_eq!(done, Err(DropReason::Incomplete));
            }
        }
    }

    #[test]
    fn rows_that_cannot_be_are_refused() {
        assert_eq!(drop_alpha(&[0; 64], 7, 2, &mut [0; 6]), Err(DropReason::WrongSize));
        assert_eq!(drop_alpha(&[0; 64], 8, 2, &mut [0; 7]), Err(DropReason::WrongSize));
        assert_eq!(drop_alpha(&[], 0, 0, &mut []), Err(DropReason::WrongSize));
    }
}
