//! Side-by-side stereo images: each half goes straight into its own memory.

use super::copy_rows;
use depthrig_bus::DropReason;

/// Half of an image.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Half {
    /// The left one.
    Left,
    /// The right one.
    Right,
}

/// Copies one half of an image whose rows begin every `stride` bytes of `from` to `to`, where rows of `half_bytes`
/// follow each other. Both halves of an image together read each of its bytes once and write it once.
///
/// # Errors
/// [`DropReason::Incomplete`] when `from` ends before the last row does, [`DropReason::WrongSize`] when two halves do
/// not fit into a row or `to` is not a whole number of rows.
pub fn copy_half(
    from: &[u8],
    stride: usize,
    half_bytes: usize,
    half: Half,
    to: &mut [u8],
) -> Result<(), DropReason> {
    if half_bytes == 0 || stride / 2 < half_bytes {
        return Err(DropReason::WrongSize);
    }
    let from = match half {
        Half::Left => from,
        Half::Right => from.get(half_bytes..).ok_or(DropReason::Incomplete)?,
    };
    copy_rows(from, stride, half_bytes, to)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The obvious loop over rows and bytes.
    fn model(from: &[u8], stride: usize, half_bytes: usize, rows: usize, half: Half) -> Option<Vec<u8>> {
        let begin = if half == Half::Left { 0 } else { half_bytes };
        let mut out = Vec::new();
        for y in 0..rows {
            for x in 0..half_bytes {
                out.push(*from.get(y * stride + begin + x)?);
            }
        }
        Some(out)
    }

    proptest! {
        #[test]
        fn halves_are_those_of_the_obvious_loop(
            from in proptest::collection::vec(any::<u8>(), 0..600),
            half_bytes in 1usize..24,
            padding in 0usize..9,
            rows in 1usize..20,
        ) {
            let stride = 2 * half_bytes + padding;
            for half in [Half::Left, Half::Right] {
                let mut to = vec![0xA5; half_bytes * rows];
                let copied = copy_half(&from, stride, half_bytes, half, &mut to);
                let expected = model(&from, stride, half_bytes, rows, half);
                prop_assert_eq!(copied.map(|()| to), expected.ok_or(DropReason::Incomplete));
            }
        }
    }

    #[test]
    fn both_halves_are_the_image_in_yuyv() {
        // Two rows of 4 pixels of YUYV, halves of 2 pixels.
        let image: Vec<u8> = (0..16).collect();
        let half = |h| {
            let mut to = [0; 8];
            copy_half(&image, 8, 4, h, &mut to).unwrap();
            to
        };
        assert_eq!(half(Half::Left), [0, 1, 2, 3, 8, 9, 10, 11]);
        assert_eq!(half(Half::Right), [4, 5, 6, 7, 12, 13, 14, 15]);
    }

    #[test]
    fn halves_that_cannot_be_are_refused() {
        let mut to = [0; 8];
        assert_eq!(
            copy_half(&[0; 64], 7, 4, Half::Left, &mut to),
            Err(DropReason::WrongSize),
            "no room for two"
        );
        assert_eq!(copy_half(&[0; 64], 0, 0, Half::Left, &mut to), Err(DropReason::WrongSize));
        assert_eq!(copy_half(&[0; 64], 8, 3, Half::Right, &mut to), Err(DropReason::WrongSize), "2.7 rows");
        assert_eq!(copy_half(&[0; 3], 8, 4, Half::Right, &mut to), Err(DropReason::Incomplete));
    }
}
