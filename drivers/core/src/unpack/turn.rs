//! The L515's depth and infrared, which come transposed and flipped both ways.
//!
//! The pixel in row `i`, column `j` of what comes is the pixel at x = rows - 1 - i, y = columns - 1 - j of the
//! image (librealsense v2.54 `src/proc/rotation-transform.cpp`, Apache-2.0). Both sides are walked in blocks that
//! stay in the first-level cache, because one of them goes down columns.

use super::count;
use depthrig_bus::DropReason;

/// Pixels along a side of a block. Two blocks of 16-bit pixels are 16 KiB of the 32 KiB that a core has.
const BLOCK: usize = 64;

/// Turns an image of pixels of `N` bytes that came in rows of `columns` pixels.
///
/// # Errors
/// [`DropReason::Incomplete`] when `from` has less bytes than `to`, [`DropReason::WrongSize`] when more, or when they
/// are not a whole number of rows.
pub fn turn<const N: usize>(from: &[u8], columns: usize, to: &mut [u8]) -> Result<(), DropReason> {
    check(from.len(), to.len(), columns * N)?;
    let rows = from.len() / (columns * N);
    let (source, _) = from.as_chunks::<N>();
    let (target, _) = to.as_chunks_mut::<N>();
    for top in (0..rows).step_by(BLOCK) {
        let bottom = (top + BLOCK).min(rows);
        for left in (0..columns).step_by(BLOCK) {
            for j in left..(left + BLOCK).min(columns) {
                // Row `columns - 1 - j` of the image, from the right to the left.
                let start = (columns - 1 - j) * rows;
                let Some(out) = target.get_mut(start + rows - bottom..start + rows - top) else { continue };
                let column = source.iter().skip(top * columns + j).step_by(columns);
                for (to, from) in out.iter_mut().rev().zip(column) {
                    *to = *from;
                }
            }
        }
    }
    count(to.len());
    Ok(())
}

/// The confidence image: two pixels of 4 bits a byte, turned like depth. A byte becomes two pixels one below the
/// other, the low half above.
///
/// # Errors
/// As [`turn`], for half the bytes of `to`.
pub fn confidence(from: &[u8], columns: usize, to: &mut [u8]) -> Result<(), DropReason> {
    if !to.len().is_multiple_of(2) {
        return Err(DropReason::WrongSize);
    }
    check(from.len(), to.len() / 2, columns)?;
    let rows = from.len() / columns;
    for (y, pair) in to.chunks_exact_mut(2 * rows).enumerate() {
        let (above, below) = pair.split_at_mut(rows);
        let column = from.iter().skip(columns - 1 - y).step_by(columns);
        for ((above, below), byte) in above.iter_mut().zip(below).rev().zip(column) {
            *above = byte << 4;
            *below = byte & 0xF0;
        }
    }
    count(to.len());
    Ok(())
}

fn check(is: usize, must: usize, row: usize) -> Result<(), DropReason> {
    match is.cmp(&must) {
        core::cmp::Ordering::Less => Err(DropReason::Incomplete),
        core::cmp::Ordering::Greater => Err(DropReason::WrongSize),
        core::cmp::Ordering::Equal if row == 0 || !is.is_multiple_of(row) => Err(DropReason::WrongSize),
        core::cmp::Ordering::Equal => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The two loops of the rule.
    fn model<const N: usize>(from: &[u8], columns: usize) -> Vec<u8> {
        let rows = from.len() / (columns * N);
        let mut to = vec![0xA5; from.len()];
        for i in 0..rows {
            for j in 0..columns {
                let x = rows - 1 - i;
                let y = columns - 1 - j;
                for b in 0..N {
                    to[(y * rows + x) * N + b] = from[(i * columns + j) * N + b];
                }
            }
        }
        to
    }

    fn noise(len: usize, seed: u32) -> Vec<u8> {
        (0..len as u32).map(|i| (i.wrapping_mul(2_654_435_761) ^ seed).to_le_bytes()[2]).collect()
    }

    #[test]
    fn an_image_of_2_by_3_by_hand() {
        // Comes as 3 rows of 2: a b / c d / e f. The image is 3 wide and 2 high.
        let mut to = [0; 6];
        turn::<1>(b"abcdef", 2, &mut to).unwrap();
        assert_eq!(&to, b"fdbeca");
        let mut to = [0; 12];
        turn::<2>(b"aAbBcCdDeEfF", 2, &mut to).unwrap();
        assert_eq!(&to, b"fFdDbBeEcCaA");
    }

    #[test]
    fn the_camera_s_sizes() {
        for (columns, rows) in [(480, 640), (768, 1024), (240, 320)] {
            let from = noise(columns * rows * 2, 7);
            let mut to = vec![0; from.len()];
            turn::<2>(&from, columns, &mut to).unwrap();
            assert!(to == model::<2>(&from, columns));
        }
    }

    #[test]
    fn confidence_by_hand() {
        // 2 rows of 2 bytes: the image is 2 wide and 4 high.
        let mut to = [0; 8];
        confidence(&[0x12, 0x34, 0x56, 0x78], 2, &mut to).unwrap();
        assert_eq!(to, [0x80, 0x40, 0x70, 0x30, 0x60, 0x20, 0x50, 0x10]);
    }

    #[test]
    fn another_number_of_bytes_is_refused() {
        assert_eq!(turn::<2>(&[0; 10], 2, &mut [0; 12]), Err(DropReason::Incomplete));
        assert_eq!(turn::<2>(&[0; 14], 2, &mut [0; 12]), Err(DropReason::WrongSize));
        assert_eq!(turn::<2>(&[0; 12], 4, &mut [0; 12]), Err(DropReason::WrongSize));
        assert_eq!(turn::<1>(&[0; 12], 0, &mut [0; 12]), Err(DropReason::WrongSize));
        assert_eq!(confidence(&[0; 3], 2, &mut [0; 8]), Err(DropReason::Incomplete));
        assert_eq!(confidence(&[0; 5], 2, &mut [0; 8]), Err(DropReason::WrongSize));
        assert_eq!(confidence(&[0; 4], 2, &mut [0; 7]), Err(DropReason::WrongSize));
        assert_eq!(turn::<1>(&[], 3, &mut []), Ok(()));
    }

    proptest! {
        #[test]
        fn blocks_are_the_two_loops(columns in 1usize..150, rows in 1usize..150, seed in any::<u32>()) {
            let from = noise(columns * rows * 2, seed);
            let mut to = vec![0; from.len()];
            turn::<2>(&from, columns, &mut to).unwrap();
            prop_assert!(to == model::<2>(&from, columns));
            let from = &from[..columns * rows];
            let mut to = vec![0; from.len()];
            turn::<1>(from, columns, &mut to).unwrap();
            prop_assert!(to == model::<1>(from, columns));
            // Confidence is turned first, then each byte becomes two rows.
            let mut twice = vec![0; from.len() * 2];
            confidence(from, columns, &mut twice).unwrap();
            for (y, row) in to.chunks(rows).enumerate() {
                for (x, b) in row.iter().enumerate() {
                    prop_assert_eq!(twice[2 * y * rows + x], b << 4);
                    prop_assert_eq!(twice[(2 * y + 1) * rows + x], b & 0xF0);
                }
            }
        }
    }
}
