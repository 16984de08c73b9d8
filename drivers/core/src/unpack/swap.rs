//! 16-bit pixels whose high byte comes first, as the low byte first.

use super::count;
use depthrig_bus::DropReason;

/// Copies `from` to `to` with the two bytes of every pixel swapped.
///
/// # Errors
/// [`DropReason::Incomplete`] when `from` has fewer bytes than `to`, [`DropReason::WrongSize`] when it has more, or
/// when its length is not a multiple of a pixel.
pub fn copy_swapped(from: &[u8], to: &mut [u8]) -> Result<(), DropReason> {
    if from.len() < to.len() {
        return Err(DropReason::Incomplete);
    }
    let (pixels, rest) = from.as_chunks::<2>();
    let (targets, left) = to.as_chunks_mut::<2>();
    if pixels.len() != targets.len() || !rest.is_empty() || !left.is_empty() {
        return Err(DropReason::WrongSize);
    }
    for (target, pixel) in targets.iter_mut().zip(pixels) {
        *target = u16::from_be_bytes(*pixel).to_le_bytes();
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
        fn bytes_change_places(from in proptest::collection::vec(any::<u8>(), 0..300)) {
            let mut to = vec![0xA5; from.len()];
            let done = copy_swapped(&from, &mut to);
            if from.len().is_multiple_of(2) {
                prop_assert_eq!(done, Ok(()));
                prop_assert!((0..from.len()).all(|i| to[i] == from[i ^ 1]));
            } else {
                prop_assert_eq!(done, Err(DropReason::WrongSize));
            }
        }
    }

    #[test]
    fn other_lengths_are_refused() {
        assert_eq!(copy_swapped(&[0; 6], &mut [0; 8]), Err(DropReason::Incomplete));
        assert_eq!(copy_swapped(&[0; 8], &mut [0; 6]), Err(DropReason::WrongSize));
    }
}
