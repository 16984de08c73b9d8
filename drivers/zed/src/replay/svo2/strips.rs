//! Images in four grey JPEGs whose bytes are YUYV.

use super::super::Pair;
use super::payload::STRIPS;
use depthrig_driver::unpack::{Half, copy_half, decode_grey_jpeg, jpeg_size};
use rayon::prelude::*;

/// Images beyond this come from no camera.
const MAX_BYTES: usize = 1 << 28;

/// Width and height of the side-by-side image in these strips.
pub(super) fn size(strips: &[&[u8]; STRIPS]) -> Option<(u32, u32)> {
    let mut whole: Option<(u32, u32)> = None;
    for strip in strips {
        let (width, height) = jpeg_size(strip)?;
        let (first, above) = whole.unwrap_or((width, 0));
        if first != width {
            return None;
        }
        whole = Some((width, above.checked_add(height)?));
    }
    let (width, height) = whole?;
    // A pixel of YUYV has two bytes.
    let fits = width.is_multiple_of(2) && (width as usize).checked_mul(height as usize)? <= MAX_BYTES;
    fits.then_some((width / 2, height))
}

/// The decoder of one file.
pub(super) struct Strips {
    size: (u32, u32),
    both: Vec<u8>,
}

impl Strips {
    /// For side-by-side images of this size.
    pub(super) fn new(width: u32, height: u32) -> Self {
        Self { size: (width, height), both: vec![0; 2 * width as usize * height as usize] }
    }

    /// Decodes an image into `pair`, whose images have their size; why it cannot otherwise.
    pub(super) fn decode(&mut self, strips: &[&[u8]; STRIPS], pair: &mut Pair) -> Result<(), String> {
        if size(strips) != Some(self.size) {
            return Err("its strips have another size than the images before it".to_owned());
        }
        let row = 2 * self.size.0 as usize;
        let mut rest = self.both.as_mut_slice();
        let mut parts = Vec::with_capacity(STRIPS);
        for strip in strips {
            let (width, height) = jpeg_size(strip).unwrap_or_default();
            let (part, after) = core::mem::take(&mut rest)
                .split_at_mut_checked(width as usize * height as usize)
                .ok_or("its strips are too high")?;
            parts.push((*strip, (width, height), part));
            rest = after;
        }
        parts
            .into_par_iter()
            .try_for_each(|(strip, (width, height), part)| decode_grey_jpeg(strip, width, height, part))
            .map_err(|_| "one of its strips is damaged, or not a grey JPEG".to_owned())?;
        for (half, image) in [(Half::Left, &mut pair.left), (Half::Right, &mut pair.right)] {
            copy_half(&self.both, row, row / 2, half, image).map_err(|reason| reason.name().to_owned())?;
        }
        Ok(())
    }
}
