//! Y8I: the bytes of two imagers in turn, left first, taken apart into two grey images.
//!
//! Order of the bytes: librealsense `src/proc/y8i-to-y8y8.cpp` (Apache-2.0).

use super::count;
use depthrig_bus::DropReason;

/// The left image.
///
/// # Errors
/// [`DropReason::Incomplete`] when `from` has less than twice the bytes of `to`, [`DropReason::WrongSize`] when more.
pub fn left(from: &[u8], to: &mut [u8]) -> Result<(), DropReason> {
    half(from, to, 0)
}

/// The right image.
///
/// # Errors
/// As those of [`left`].
pub fn right(from: &[u8], to: &mut [u8]) -> Result<(), DropReason> {
    half(from, to, 1)
}

fn half(from: &[u8], to: &mut [u8], which: usize) -> Result<(), DropReason> {
    match from.len().cmp(&(to.len() * 2)) {
        core::cmp::Ordering::Less => return Err(DropReason::Incomplete),
        core::cmp::Ordering::Greater => return Err(DropReason::WrongSize),
        core::cmp::Ordering::Equal => {}
    }
    for (pair, out) in from.chunks_exact(2).zip(to.iter_mut()) {
        // `pair` has two bytes.
        *out = pair[which];
    }
    count(to.len());
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn left_is_first() {
        let mut l = [0; 3];
        let mut r = [0; 3];
        left(&[1, 2, 3, 4, 5, 6], &mut l).unwrap();
        right(&[1, 2, 3, 4, 5, 6], &mut r).unwrap();
        assert_eq!((l, r), ([1, 3, 5], [2, 4, 6]));
    }

    #[test]
    fn another_number_of_bytes_is_refused() {
        assert_eq!(left(&[0; 5], &mut [0; 3]), Err(DropReason::Incomplete));
        assert_eq!(right(&[0; 7], &mut [0; 3]), Err(DropReason::WrongSize));
    }
}
