//! Pixels of frames as the numbers that registration and refiners work on.

use crate::{Color, ColorFormat};
use crate::{Error, ErrorKind, Result};
use depthrig_bus::{FrameHeader, PixelFormat};

/// The unit that depth in metres is put into, metres: a tenth of a millimetre reaches 6.5 m, beyond which camera depth
/// models take depth for a hole.
pub const UNIT_OF_METRES: f64 = 0.0001;

/// Why a frame is unfit for the stage, if it is.
pub fn unfit(color: &FrameHeader, depth: &FrameHeader) -> Option<String> {
    let name = |h: &FrameHeader| h.pixel_format().map_or("an unknown format", PixelFormat::name);
    if !matches!(color.pixel_format(), Some(PixelFormat::Rgb8 | PixelFormat::Bgr8)) {
        return Some(format!(
            "its colour is {}, and only rgb8 and bgr8 can be refined with; ask for format = \"rgb8\" in its \
             [[camera.stream]] \"color\"",
            name(color)
        ));
    }
    if !depth.pixel_format().is_some_and(PixelFormat::is_depth) {
        return Some(format!("its depth has the format {}, which is not a depth format", name(depth)));
    }
    None
}

/// The colour image of a frame.
///
/// # Errors
/// [`ErrorKind::BadInput`] when the frame is shorter than its header says.
pub fn color<'a>(h: &FrameHeader, pixels: &'a [u8]) -> Result<Color<'a>> {
    let format = if h.format == PixelFormat::Bgr8 as u32 { ColorFormat::Bgr8 } else { ColorFormat::Rgb8 };
    let width = h.width as usize;
    let height = h.height as usize;
    let stride = h.stride as usize;
    let rows = stride.checked_mul(height.saturating_sub(1)).and_then(|n| n.checked_add(width * 3));
    if stride < width * 3 || rows.is_none_or(|n| n > pixels.len()) {
        return Err(short("colour"));
    }
    Ok(Color { pixels, format, width, height, stride })
}

/// 16-bit depth where it lies, when nothing need be changed about it.
pub fn in_place<'a>(h: &FrameHeader, pixels: &'a [u8]) -> Option<&'a [u16]> {
    let row = h.width as usize * 2;
    let bytes = h.width as usize * 2 * h.height as usize;
    if h.format != PixelFormat::Z16 as u32 || h.stride as usize != row {
        return None;
    }
    bytemuck::try_cast_slice(pixels.get(..bytes)?).ok()
}

/// The depth of a frame, without padding, and its unit in metres. Where it lies as it is wanted it is not copied;
/// `scratch` is used otherwise.
///
/// # Errors
/// [`ErrorKind::BadInput`] when the frame is shorter than its header says.
pub fn depth<'a>(h: &FrameHeader, pixels: &'a [u8], scratch: &'a mut Vec<u16>) -> Result<(&'a [u16], f64)> {
    let width = h.width as usize;
    let height = h.height as usize;
    let stride = h.stride as usize;
    let metres = h.format == PixelFormat::DepthF32 as u32;
    let row = width * if metres { 4 } else { 2 };
    let rows = stride.checked_mul(height.saturating_sub(1)).and_then(|n| n.checked_add(row));
    if stride < row || rows.is_none_or(|n| n > pixels.len()) {
        return Err(short("depth"));
    }
    if let Some(unpadded) = in_place(h, pixels) {
        return Ok((unpadded, h.depth_unit_m));
    }
    scratch.clear();
    for line in pixels.chunks(stride.max(1)).take(height) {
        let line = &line[..row];
        if metres {
            let units = |b: &[u8; 4]| {
                let v = f64::from(f32::from_le_bytes(*b)) / UNIT_OF_METRES;
                // NaN and values not above 0 become 0, and values beyond the range do.
                if v > 0.0 && v < 65534.5 { (v + 0.5) as u16 } else { 0 }
            };
            scratch.extend(line.as_chunks::<4>().0.iter().map(units));
        } else {
            scratch.extend(line.as_chunks::<2>().0.iter().map(|b| u16::from_le_bytes(*b)));
        }
    }
    Ok((scratch, if metres { UNIT_OF_METRES } else { h.depth_unit_m }))
}

fn short(what: &str) -> Error {
    Error::new(ErrorKind::BadInput, format!("a {what} frame is shorter than its header says"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn header(format: PixelFormat, width: u32, height: u32) -> FrameHeader {
        let mut h = FrameHeader { depth_unit_m: 0.001, ..FrameHeader::default() };
        h.set_image(format, width, height);
        h
    }

    #[test]
    fn depth_is_read_in_place_or_packed() {
        let mut scratch = Vec::new();
        let words = [1u16, 2, 3, 4];
        let bytes: &[u8] = bytemuck::cast_slice(&words);
        let (seen, unit) = depth(&header(PixelFormat::Z16, 2, 2), bytes, &mut scratch).unwrap();
        assert_eq!((seen, unit, seen.as_ptr()), (&words[..], 0.001, words.as_ptr()));
        // Two of three columns are pixels.
        let mut h = header(PixelFormat::Z16, 2, 2);
        h.stride = 6;
        let padded: [u16; 6] = [1, 2, 9, 3, 4, 9];
        let (seen, _) = depth(&h, bytemuck::cast_slice(&padded), &mut scratch).unwrap();
        assert_eq!(seen, words);
        let metres = [0.5f32, f32::NAN, -1.0, 7.0];
        let (seen, unit) =
            depth(&header(PixelFormat::DepthF32, 2, 2), bytemuck::cast_slice(&metres), &mut scratch).unwrap();
        assert_eq!((seen, unit), (&[5000, 0, 0, 0][..], 0.0001));
    }

    #[test]
    fn a_frame_shorter_than_it_says_is_refused() {
        let mut scratch = Vec::new();
        assert!(depth(&header(PixelFormat::Z16, 4, 4), &[0; 31], &mut scratch).is_err());
        assert!(color(&header(PixelFormat::Rgb8, 4, 4), &[0; 47]).is_err());
        assert!(color(&header(PixelFormat::Rgb8, 4, 4), &[0; 48]).is_ok());
    }
}
