//! One picture of Motion JPEG: kept as it came, or decoded to red, green, blue.

use super::count;
use depthrig_bus::DropReason;
use image::codecs::jpeg::JpegDecoder;
use image::{ColorType, ImageDecoder};
use std::io::Cursor;
use std::panic::{AssertUnwindSafe, catch_unwind};

/// Start and end of a JPEG picture (ITU-T T.81, table B.1).
const START: [u8; 2] = [0xFF, 0xD8];
const END: [u8; 2] = [0xFF, 0xD9];

/// The picture in what a camera sent: from its start mark to its last end mark. Cameras pad behind it.
///
/// # Errors
/// [`DropReason::Incomplete`] without an end mark, [`DropReason::WrongSize`] when it is no JPEG.
pub fn jpeg_span(from: &[u8]) -> Result<&[u8], DropReason> {
    if !from.starts_with(&START) {
        return Err(if from.is_empty() { DropReason::Incomplete } else { DropReason::WrongSize });
    }
    let end = from.windows(2).rposition(|mark| mark == END).ok_or(DropReason::Incomplete)?;
    from.get(..end + 2).ok_or(DropReason::Incomplete)
}

/// Copies the picture, as [`jpeg_span`] found it, to `to`, which has its length.
///
/// # Errors
/// [`DropReason::WrongSize`] when the lengths differ.
pub fn keep_jpeg(picture: &[u8], to: &mut [u8]) -> Result<(), DropReason> {
    if picture.len() != to.len() {
        return Err(DropReason::WrongSize);
    }
    to.copy_from_slice(picture);
    count(to.len());
    Ok(())
}

/// Decodes a picture of `width` x `height` pixels into `to`, 3 bytes a pixel.
///
/// Pictures without Huffman tables are decoded when they are marked as such (`AVI1`), as those of cameras are.
///
/// # Errors
/// [`DropReason::WrongSize`] when it is damaged, of another size, or not in colour.
pub fn decode_jpeg(picture: &[u8], width: u32, height: u32, to: &mut [u8]) -> Result<(), DropReason> {
    decode(picture, (width, height), ColorType::Rgb8, to)
}

/// Decodes a grey picture of `width` x `height` pixels into `to`, one byte a pixel.
///
/// # Errors
/// [`DropReason::WrongSize`] when it is damaged, of another size, or in colour.
pub fn decode_grey_jpeg(picture: &[u8], width: u32, height: u32, to: &mut [u8]) -> Result<(), DropReason> {
    decode(picture, (width, height), ColorType::L8, to)
}

/// Width and height of a picture, as far as its header says them.
pub fn jpeg_size(picture: &[u8]) -> Option<(u32, u32)> {
    let read = || JpegDecoder::new(Cursor::new(picture)).ok().map(|d| d.dimensions());
    catch_unwind(AssertUnwindSafe(read)).ok().flatten()
}

fn decode(picture: &[u8], size: (u32, u32), color: ColorType, to: &mut [u8]) -> Result<(), DropReason> {
    // zune-jpeg, which `image` decodes with, has panicked on damaged pictures (0.4.21; none is known for 0.5.15); as does
    // the reader of datasets, this gives up what it worked on then.
    let decoded = catch_unwind(AssertUnwindSafe(|| {
        let decoder = JpegDecoder::new(Cursor::new(picture)).ok()?;
        let fits = decoder.dimensions() == size
            && decoder.color_type() == color
            && decoder.total_bytes() == to.len() as u64;
        if !fits {
            return None;
        }
        decoder.read_image(to).ok()
    }));
    match decoded {
        Ok(Some(())) => {
            count(to.len());
            Ok(())
        }
        Ok(None) | Err(_) => Err(DropReason::WrongSize),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::codecs::jpeg::JpegEncoder;
    use proptest::prelude::*;

    const SIZE: (u32, u32) = (32, 16);

    fn picture(color: [u8; 3]) -> Vec<u8> {
        let pixels: Vec<u8> = color.into_iter().cycle().take((SIZE.0 * SIZE.1 * 3) as usize).collect();
        let mut out = Vec::new();
        let mut encoder = JpegEncoder::new_with_quality(&mut out, 95);
        encoder.encode(&pixels, SIZE.0, SIZE.1, image::ExtendedColorType::Rgb8).unwrap();
        out
    }

    fn decoded(jpeg: &[u8]) -> Result<Vec<u8>, DropReason> {
        let mut to = vec![0xA5; (SIZE.0 * SIZE.1 * 3) as usize];
        decode_jpeg(jpeg, SIZE.0, SIZE.1, &mut to).map(|()| to)
    }

    #[test]
    fn a_picture_is_decoded_to_its_pixels() {
        let pixels = decoded(&picture([200, 40, 90])).unwrap();
        let near = |at: usize, want: u8| pixels[at].abs_diff(want) <= 3;
        assert!(
            pixels.chunks(3).count() == 512 && near(0, 200) && near(1, 40) && near(2, 90),
            "{:?}",
            &pixels[..3]
        );
        assert!(near(1533, 200) && near(1535, 90), "the last pixel too");
    }

    #[test]
    fn a_picture_without_its_tables_is_decoded_when_it_is_marked_so() {
        let whole = picture([10, 220, 60]);
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
    fn padding_is_cut_off_and_a_cut_picture_is_incomplete() {
        let whole = picture([1, 2, 3]);
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
        assert_eq!(decode_jpeg(&picture([9; 3]), 31, 16, &mut to), Err(DropReason::WrongSize));
        let mut grey = Vec::new();
        let mut encoder = JpegEncoder::new(&mut grey);
        encoder.encode(&[7; 512], SIZE.0, SIZE.1, image::ExtendedColorType::L8).unwrap();
        assert_eq!(decoded(&grey), Err(DropReason::WrongSize));
        let mut one = vec![0xA5; 512];
        decode_grey_jpeg(&grey, SIZE.0, SIZE.1, &mut one).unwrap();
        assert!(one.iter().all(|v| v.abs_diff(7) <= 1) && jpeg_size(&grey) == Some(SIZE));
        assert_eq!(decode_grey_jpeg(&picture([9; 3]), 32, 16, &mut one), Err(DropReason::WrongSize));
        assert_eq!(jpeg_size(b"no picture"), None);
    }

    proptest! {
        #[test]
        fn damage_is_refused_or_decoded_but_never_a_panic(at in 0usize..2000, value: u8, cut in 0usize..2000) {
            let mut jpeg = picture([128, 64, 32]);
            let n = jpeg.len();
            jpeg[at % n] = value;
            jpeg.truncate(cut % n);
            let _ = jpeg_span(&jpeg);
            let _ = decoded(&jpeg);
        }
    }
}
