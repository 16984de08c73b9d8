//! From the bytes of a camera into lent memory: one kernel per way in which cameras lay out their images.
//!
//! Each kernel writes every byte of `to` or says why it cannot, in words of the gate's ([`DropReason`]), so that it
//! can be the `fill` of [`crate::Gate::deliver`]. What is copied is counted.

mod alpha;
mod mjpeg;
mod side_by_side;
mod swap;
pub mod turn;
pub mod y411;
pub mod y8i;

pub use alpha::drop_alpha;
pub use mjpeg::{decode_grey_jpeg, decode_jpeg, jpeg_size, jpeg_span, keep_jpeg};
pub use side_by_side::{Half, copy_half};
pub use swap::copy_swapped;

use core::sync::atomic::{AtomicU64, Ordering};
use depthrig_bus::DropReason;

/// Bytes of images that this process wrote into lent memory.
static COPIED: AtomicU64 = AtomicU64::new(0);

/// Bytes of images that the kernels of this module wrote since the process began. With the bytes that were
/// delivered meanwhile, it says how often an image is copied.
pub fn copied_bytes() -> u64 {
    COPIED.load(Ordering::Relaxed)
}

/// Counts a write of `bytes` bytes; each kernel calls it once per image.
fn count(bytes: usize) {
    COPIED.fetch_add(bytes as u64, Ordering::Relaxed);
}

/// Copies rows of `row_bytes` that begin every `stride` bytes of `from` to `to`, where they follow each other. The
/// last row may lack its padding.
///
/// # Errors
/// [`DropReason::Incomplete`] when `from` ends before the last row does, [`DropReason::WrongSize`] when rows overlap
/// or `to` is not a whole number of rows.
pub fn copy_rows(from: &[u8], stride: usize, row_bytes: usize, to: &mut [u8]) -> Result<(), DropReason> {
    if row_bytes == 0 || stride < row_bytes || !to.len().is_multiple_of(row_bytes) {
        return Err(DropReason::WrongSize);
    }
    let rows = to.len() / row_bytes;
    let needed = rows.checked_sub(1).map_or(0, |before| before * stride + row_bytes);
    let from = from.get(..needed).ok_or(DropReason::Incomplete)?;
    if stride == row_bytes {
        to.copy_from_slice(from);
    } else {
        for (row, out) in from.chunks(stride).zip(to.chunks_exact_mut(row_bytes)) {
            // The last chunk has `row_bytes`, the others `stride`, which is more.
            out.copy_from_slice(row.get(..row_bytes).ok_or(DropReason::Incomplete)?);
        }
    }
    count(to.len());
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Byte by byte, as slow and as plain as can be.
    fn model(from: &[u8], stride: usize, row_bytes: usize, rows: usize) -> Option<Vec<u8>> {
        let mut out = Vec::new();
        for y in 0..rows {
            for x in 0..row_bytes {
                out.push(*from.get(y * stride + x)?);
            }
        }
        Some(out)
    }

    proptest! {
        #[test]
        fn rows_are_copied_as_byte_by_byte(
            from in proptest::collection::vec(any::<u8>(), 0..600),
            row_bytes in 1usize..40,
            padding in 0usize..9,
            rows in 0usize..20,
        ) {
            let stride = row_bytes + padding;
            let mut to = vec![0xA5; row_bytes * rows];
            let copied = copy_rows(&from, stride, row_bytes, &mut to);
            if let Some(expected) = model(&from, stride, row_bytes, rows) {
                prop_assert_eq!(copied, Ok(()));
                prop_assert_eq!(to, expected);
            } else {
                prop_assert_eq!(copied, Err(DropReason::Incomplete));
            }
        }
    }

    #[test]
    fn rows_that_cannot_be_are_refused() {
        let mut to = [0; 8];
        assert_eq!(copy_rows(&[0; 64], 3, 4, &mut to), Err(DropReason::WrongSize), "rows overlap");
        assert_eq!(copy_rows(&[0; 64], 4, 3, &mut to), Err(DropReason::WrongSize), "two rows and a bit");
        assert_eq!(copy_rows(&[0; 64], 0, 0, &mut to), Err(DropReason::WrongSize));
    }

    #[test]
    fn what_is_copied_is_counted() {
        let before = copied_bytes();
        copy_rows(&[1; 100], 10, 10, &mut [0; 100]).unwrap();
        assert!(copied_bytes() - before >= 100);
    }
}
