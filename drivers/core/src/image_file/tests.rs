//! Headers that lie, kinds that are refused, and damage anywhere.

use super::*;
use image::{ExtendedColorType, ImageEncoder, codecs::png::PngEncoder};
use jpeg_encoder::{ColorType, Encoder};
use proptest::prelude::*;

fn pixels(len: usize) -> Vec<u8> {
    (0..len).map(|i| (i * 7 + i / 13) as u8).collect()
}

fn png_of(kind: ExtendedColorType, w: u32, h: u32) -> Vec<u8> {
    let mut out = Vec::new();
    let pixels = pixels((w * h * u32::from(kind.bits_per_pixel()) / 8) as usize);
    PngEncoder::new(&mut out).write_image(&pixels, w, h, kind).unwrap();
    out
}

fn jpeg_of(kind: ColorType, w: u16, h: u16) -> Vec<u8> {
    let mut out = Vec::new();
    let pixels = pixels(usize::from(w) * usize::from(h) * if kind == ColorType::Luma { 1 } else { 3 });
    Encoder::new(&mut out, 75).encode(&pixels, w, h, kind).unwrap();
    out
}

fn png() -> Vec<u8> {
    png_of(ExtendedColorType::Rgb8, 6, 5)
}

fn jpeg() -> Vec<u8> {
    jpeg_of(ColorType::Rgb, 24, 16)
}

fn look(bytes: &[u8]) -> Result<Info, String> {
    inspect(BufReader::new(Cursor::new(bytes))).map_err(|b| b.into_error(Path::new("p")).to_string())
}

#[track_caller]
fn refused(bytes: &[u8], word: &str) {
    let error = look(bytes).unwrap_err();
    assert!(error.starts_with("p: ") && error.contains(word), "{word:?} is not in: {error}");
}

#[test]
fn headers_are_read() {
    assert_eq!(look(&png()), Ok(Info { width: 6, height: 5, kind: Kind::Rgb8 }));
    assert_eq!(look(&jpeg()), Ok(Info { width: 24, height: 16, kind: Kind::Rgb8 }));
    let deep = png_of(ExtendedColorType::L16, 3, 9);
    assert_eq!(look(&deep), Ok(Info { width: 3, height: 9, kind: Kind::Grey16 }));
    let grey = jpeg_of(ColorType::Luma, 9, 3);
    assert_eq!(look(&grey), Ok(Info { width: 9, height: 3, kind: Kind::Grey8 }));
}

#[test]
fn kinds_that_no_frame_has_are_refused() {
    // In a PNG the width stands at byte 16, the bits at 24, the colour type at 25.
    let with = |at: usize, bytes: &[u8]| {
        let mut file = png();
        file[at..at + bytes.len()].copy_from_slice(bytes);
        file
    };
    refused(&with(24, &[1, 0]), "1-bit grey is not supported");
    refused(&with(24, &[16, 2]), "16-bit colour is not supported");
    refused(&with(24, &[8, 3]), "palette of 8-bit colours");
    refused(&with(24, &[8, 6]), "alpha");
    refused(&with(16, &[0x7F, 0xFF, 0xFF, 0xFF]), "2147483647x5 8-bit colour is an unsupported size");
    refused(&with(16, &[0; 4]), "0x5 8-bit colour is an unsupported size");
    refused(&with(1, b"XNG"), "neither PNG nor JPEG");

    let mut transparent = png();
    let first_data = transparent.windows(4).position(|w| w == b"IDAT").unwrap() - 4;
    transparent.splice(first_data..first_data, *b"\0\0\0\x06tRNS\0\0\0\0\0\0\0\0\0\0");
    refused(&transparent, "alpha");

    // In a JPEG the frame header is FF C0, length, bits, height, width, components.
    let sof = jpeg().windows(2).position(|w| w == [0xFF, 0xC0]).unwrap();
    let with = |at: usize, byte: u8| {
        let mut file = jpeg();
        file[sof + at] = byte;
        file
    };
    refused(&with(9, 4), "4 components with 8 bits");
    refused(&with(4, 12), "3 components with 12 bits");
    refused(&with(1, 0xC3), "lossless, hierarchical and arithmetic JPEG");
}

#[test]
fn an_end_mark_inside_a_thumbnail_is_not_the_end() {
    let mut file = jpeg();
    file.splice(2..2, *b"\xFF\xE1\x00\x08\xFF\xD8\xFF\xD9\x00\x00");
    assert!(look(&file).is_ok());
    file.truncate(file.len() - 2);
    refused(&file, "cut off");
}

proptest! {
    /// Whatever a file holds, it decodes or is refused; nothing panics.
    #[test]
    fn damage_never_panics(
        as_png in any::<bool>(),
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..6),
    ) {
        let mut file = if as_png { png() } else { jpeg() };
        for (at, byte) in changes {
            let at = at.index(file.len());
            file[at] = byte;
        }
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("p");
        std::fs::write(&path, &file).unwrap();
        if let Ok(info) = probe(&path) && info.bytes() < 1 << 20 {
            let mut pixels = vec![0; info.bytes() as usize];
            if let Err(e) = decode(&path, &info, &mut pixels) {
                prop_assert!(e.to_string().contains(&path.display().to_string()));
            }
        }
    }

    /// A damaged PNG is never shown: its checksums reveal it.
    #[test]
    fn damaged_png_data_is_noticed(at in any::<prop::sample::Index>(), bit in 0..8u32) {
        let whole = png_of(ExtendedColorType::L16, 16, 16);
        let start = whole.windows(4).position(|w| w == b"IDAT").unwrap() + 4;
        let end = whole.windows(4).rposition(|w| w == b"IEND").unwrap() - 4;
        let mut file = whole.clone();
        file[start + at.index(end - start)] ^= 1 << bit;
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("p");
        std::fs::write(&path, &file).unwrap();
        let info = Info { width: 16, height: 16, kind: Kind::Grey16 };
        prop_assert!(decode(&path, &info, &mut [0; 512]).is_err());
    }
}
