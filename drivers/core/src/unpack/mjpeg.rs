//! One image of Motion JPEG: kept as it came, or decoded to red, green, blue.

use super::count;
use depthrig_bus::DropReason;
use depthrig_jpeg::{Form, Info, START};

/// End of a JPEG image (ITU-T T.81, table B.1).
const END: [u8; 2] = [0xFF, 0xD9];

/// The image in what a camera sent: from its start mark to its last end mark. Cameras pad behind it.
///
/// # Errors
/// [`DropReason::Incomplete`] without an end mark, [`DropReason::WrongSize`] when the bytes are not a JPEG.
pub fn jpeg_span(from: &[u8]) -> Result<&[u8], DropReason> {
    if !from.starts_with(&START) {
        return Err(if from.is_empty() { DropReason::Incomplete } else { DropReason::WrongSize });
    }
    let end = from.windows(2).rposition(|mark| mark == END).ok_or(DropReason::Incomplete)?;
    from.get(..end + 2).ok_or(DropReason::Incomplete)
}

/// Copies the image, as [`jpeg_span`] found it, to `to`, which has its length.
///
/// # Errors
/// [`DropReason::WrongSize`] when the lengths differ.
pub fn keep_jpeg(image: &[u8], to: &mut [u8]) -> Result<(), DropReason> {
    if image.len() != to.len() {
        return Err(DropReason::WrongSize);
    }
    to.copy_from_slice(image);
    count(to.len());
    Ok(())
}

/// Decodes an image of `width` x `height` pixels into `to`, 3 bytes a pixel.
///
/// Images without Huffman tables, as those of cameras, are decoded with the standard ones.
///
/// # Errors
/// [`DropReason::WrongSize`] when it is damaged, of another size, or not in colour.
pub fn decode_jpeg(image: &[u8], width: u32, height: u32, to: &mut [u8]) -> Result<(), DropReason> {
    decode(image, Info { width, height, form: Form::Rgb }, to)
}

/// Decodes a grey image of `width` x `height` pixels into `to`, one byte a pixel.
///
/// # Errors
/// [`DropReason::WrongSize`] when it is damaged, of another size, or in colour.
pub fn decode_grey_jpeg(image: &[u8], width: u32, height: u32, to: &mut [u8]) -> Result<(), DropReason> {
    decode(image, Info { width, height, form: Form::Grey }, to)
}

/// Width and height of an image, as its header has them.
pub fn jpeg_size(image: &[u8]) -> Option<(u32, u32)> {
    depthrig_jpeg::info(image).ok().map(|info| (info.width, info.height))
}

fn decode(image: &[u8], expected: Info, to: &mut [u8]) -> Result<(), DropReason> {
    depthrig_jpeg::decode_into(image, expected, to).map_err(|_| DropReason::WrongSize)?;
    count(to.len());
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use jpeg_encoder::{ColorType, Encoder};
    use proptest::prelude::*;

    const SIZE: (u32, u32) = (32, 16);

    fn image(color: [u8; 3]) -> Vec<u8> {
        let pixels: Vec<u8> = color.into_iter().cycle().take((SIZE.0 * SIZE.1 * 3) as usize).collect();
        let mut out = Vec::new();
        Encoder::new(&mut out, 95).encode(&pixels, SIZE.0 as u16, SIZE.1 as u16, ColorType::Rgb).unwrap();
        out
    }

    fn decoded(jpeg: &[u8]) -> Result<Vec<u8>, DropReason> {
        let mut to = vec![0xA5; (SIZE.0 * SIZE.1 * 3) as usize];
        decode_jpeg(jpeg, SIZE.0, SIZE.1, &mut to).map(|()| to)
    }

    #[test]
    fn an_image_is_decoded_to_its_pixels() {
        let pixels = decoded(&image([200, 40, 90])).unwrap();
        let near = |at: usize, want: u8| pixels[at].abs_diff(want) <= 3;
        assert!(
            pixels.chunks(3).count() == 512 && near(0, 200) && near(1, 40) && near(2, 90),
            "{:?}",
            &pixels[..3]
        );
        assert!(near(1533, 200) && near(1535, 90), "the last pixel too");
    }

    #[test]
    fn an_image_without_its_tables_is_decoded_when_it_is_marked_so() {
        let whole = image([10, 220, 60]);
        let mut bare = vec![0xFF, 0xD8, 0xFF, 0xE0, 0, 16];
        bare.extend(*b"AVI1\0\0\0\0\0\0\0\0\0\0");
        let mut at = 2;
        while whole[at + 1] != 0xDA {
            let length = 2 + usize::from(u16::from_be_bytes([whole[at + 2], whole[at + 3]]));
            if !matches!(whole[at + 1], 0xC4 | 0xE0) {
                bare.extend(&whole[at..at + length]);
            }
            at += length;
        }
        bare.extend(&whole[at..]);
        assert!(bare.len() < whole.len() - 400, "the tables are gone");
        assert_eq!(decoded(&bare), decoded(&whole));
    }

    #[test]
    fn padding_is_cut_off_and_a_cut_image_is_incomplete() {
        let whole = image([1, 2, 3]);
        let padded = [&whole[..], &[0; 100]].concat();
        assert_eq!(jpeg_span(&padded), Ok(&whole[..]));
        assert_eq!(jpeg_span(&whole[..whole.len() - 1]), Err(DropReason::Incomplete));
        assert_eq!(jpeg_span(b"YUYV"), Err(DropReason::WrongSize));
        assert_eq!(jpeg_span(&[]), Err(DropReason::Incomplete));
        let mut to = vec![0; whole.len()];
        assert_eq!(keep_jpeg(&whole, &mut to), Ok(()));
        assert_eq!(to, whole);
        assert_eq!(keep_jpeg(&whole, &mut to[1..]), Err(DropReason::WrongSize));
    }

    #[test]
    fn another_size_and_grey_are_refused() {
        let mut to = vec![0; 31 * 16 * 3];
        assert_eq!(decode_jpeg(&image([9; 3]), 31, 16, &mut to), Err(DropReason::WrongSize));
        let mut grey = Vec::new();
        Encoder::new(&mut grey, 90).encode(&[7; 512], SIZE.0 as u16, SIZE.1 as u16, ColorType::Luma).unwrap();
        assert_eq!(decoded(&grey), Err(DropReason::WrongSize));
        let mut one = vec![0xA5; 512];
        decode_grey_jpeg(&grey, SIZE.0, SIZE.1, &mut one).unwrap();
        assert!(one.iter().all(|v| v.abs_diff(7) <= 1) && jpeg_size(&grey) == Some(SIZE));
        assert_eq!(decode_grey_jpeg(&image([9; 3]), 32, 16, &mut one), Err(DropReason::WrongSize));
        assert_eq!(jpeg_size(b"no image"), None);
    }

    proptest! {
        #[test]
        fn damage_is_refused_or_decoded_but_never_a_panic(at in 0usize..2000, value: u8, cut in 0usize..2000) {
            let mut jpeg = image([128, 64, 32]);
            let n = jpeg.len();
            jpeg[at % n] = value;
            jpeg.truncate(cut % n);
            let _ = jpeg_span(&jpeg);
            let _ = decoded(&jpeg);
        }
    }
}
