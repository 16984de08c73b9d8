//! Image files of the layout become pixels. The size is checked before memory is taken for it.

use depthrig_bus::{Layout, PixelFormat, Sample};
use depthrig_recorder::npy::{self, Array};
use image::codecs::png::PngDecoder;
use image::{ColorType, ImageDecoder};
use std::io::Cursor;

/// The largest image that is read: twice the pixels of the largest depth camera's colour sensor.
const MAX_PIXELS: u64 = 64 << 20;
/// The longest side of an image, pixels: a longer one would overflow the size of an image.
pub(super) const MAX_SIDE: u32 = 1 << 16;
/// The largest file that is read, bytes.
pub(super) const MAX_FILE: u64 = MAX_PIXELS * 8;

/// An image without padding.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Image {
    pub format: PixelFormat,
    pub width: u32,
    pub height: u32,
    pub pixels: Vec<u8>,
    /// An opacity was there and was left out.
    pub alpha_dropped: bool,
}

/// Kind of image that a file's name promises.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Want {
    /// 16-bit depth.
    Depth,
    /// Three colours.
    Color,
    /// One brightness, 8 or 16 bits.
    Grey,
    /// Exactly this, as `calibration.json` says.
    Exactly(PixelFormat, u32, u32),
    /// Floats, as NPY.
    Metres,
}

/// Reads a PNG or NPY file.
pub(super) fn read(bytes: &[u8], ending: &str, want: Want) -> Result<Image, String> {
    let image = if ending == "npy" { npy_image(bytes, want)? } else { png(bytes, want)? };
    if let Want::Exactly(_, width, height) = want
        && (image.width, image.height) != (width, height)
    {
        return Err(format!("it is {}x{}, the stream is {width}x{height}", image.width, image.height));
    }
    Ok(image)
}

fn png(bytes: &[u8], want: Want) -> Result<Image, String> {
    let damaged = |e: image::ImageError| format!("it cannot be read as a PNG: {e}");
    let decoder = PngDecoder::new(Cursor::new(bytes)).map_err(damaged)?;
    let (width, height) = decoder.dimensions();
    if width == 0 || height == 0 || u64::from(width) * u64::from(height) > MAX_PIXELS {
        return Err(format!("it is {width}x{height}, which no depth camera makes"));
    }
    let color = decoder.color_type();
    let format = match (color, want) {
        (ColorType::L16, Want::Depth | Want::Exactly(PixelFormat::Z16, ..)) => PixelFormat::Z16,
        (ColorType::L16, Want::Grey | Want::Exactly(PixelFormat::Mono16, ..)) => PixelFormat::Mono16,
        (ColorType::L8, Want::Exactly(PixelFormat::Confidence8, ..)) => PixelFormat::Confidence8,
        (ColorType::L8, Want::Grey | Want::Exactly(PixelFormat::Mono8, ..)) => PixelFormat::Mono8,
        (ColorType::Rgb8 | ColorType::Rgba8, Want::Exactly(PixelFormat::Bgr8, ..)) => PixelFormat::Bgr8,
        (ColorType::Rgb8 | ColorType::Rgba8, Want::Color | Want::Exactly(PixelFormat::Rgb8, ..)) => {
            PixelFormat::Rgb8
        }
        (ColorType::L8, Want::Depth) => {
            return Err("it has 8 bits, depth has 16: it is an image of depth, not depth".to_owned());
        }
        _ => return Err(format!("it is {color:?}, which does not fit its name or calibration")),
    };
    let mut pixels = vec![0; usize::try_from(decoder.total_bytes()).map_err(|e| e.to_string())?];
    decoder.read_image(&mut pixels).map_err(damaged)?;
    let alpha_dropped = color == ColorType::Rgba8;
    if alpha_dropped {
        pixels = pixels.as_chunks().0.iter().flat_map(|[r, g, b, _]| [*r, *g, *b]).collect();
    }
    match (format.layout(), format.sample()) {
        (Layout::Bgr, _) => pixels.as_chunks_mut::<3>().0.iter_mut().for_each(|p| p.swap(0, 2)),
        // The decoder gives numbers of this computer.
        (_, Sample::U16) if cfg!(target_endian = "big") => {
            pixels.as_chunks_mut::<2>().0.iter_mut().for_each(|p| p.swap(0, 1));
        }
        _ => {}
    }
    Ok(Image { format, width, height, pixels, alpha_dropped })
}

fn npy_image(bytes: &[u8], want: Want) -> Result<Image, String> {
    let Array { kind, shape, data } = array(bytes)?;
    let (format, width, height) = match (want, kind, &shape[..]) {
        (Want::Metres, "<f4", [h, w]) => (PixelFormat::DepthF32, *w as u32, *h as u32),
        (Want::Exactly(format, w, h), ..) => {
            if kind != format.numpy() {
                return Err(format!("its numbers are {kind}, the stream is {}", format.name()));
            }
            (format, w, h)
        }
        _ => return Err(format!("it is {kind} of shape {shape:?}, not metres as two-dimensional <f4")),
    };
    if data.len() != format.frame_bytes(width, height) || data.is_empty() {
        return Err(format!("it has shape {shape:?}, the stream is {width}x{height} {}", format.name()));
    }
    Ok(Image { format, width, height, pixels: data.to_vec(), alpha_dropped: false })
}

/// An array of numbers that an image may have.
pub(super) fn array(bytes: &[u8]) -> Result<Array<'_>, String> {
    let array = npy::read(bytes)?;
    if !["|u1", "<u2", "<f4"].contains(&array.kind) {
        return Err(format!("its numbers are {}; |u1, <u2 and <f4 can be read", array.kind));
    }
    if array.shape.iter().any(|side| *side > MAX_SIDE as usize) {
        return Err(format!("invalid image shape {:?}", array.shape));
    }
    Ok(array)
}

#[cfg(test)]
mod tests {
    use super::*;
    use depthrig_bus::FrameHeader;
    use depthrig_recorder::{StillFormat, still::encode};

    #[test]
    fn what_is_written_is_read() {
        let images = |f: &PixelFormat| *f != PixelFormat::Mjpeg && !f.is_motion();
        for format in PixelFormat::ALL.into_iter().filter(images) {
            let mut h = FrameHeader::default();
            h.set_image(format, 6, 4);
            let pixels: Vec<u8> = (0..format.frame_bytes(6, 4)).map(|i| (i * 37) as u8).collect();
            let form = StillFormat::of(format);
            let file = encode(&h, format, &pixels, form).unwrap();
            let read = read(&file, form.extension(), Want::Exactly(format, 6, 4)).unwrap();
            assert_eq!((read.format, read.pixels), (format, pixels), "{}", format.name());
        }
    }

    #[test]
    fn what_does_not_fit_is_refused() {
        let mut h = FrameHeader::default();
        h.set_image(PixelFormat::Mono8, 6, 4);
        let grey = encode(&h, PixelFormat::Mono8, &[7; 24], StillFormat::Png).unwrap();
        assert!(read(&grey, "png", Want::Depth).unwrap_err().contains("8 bits"));
        assert!(read(&grey, "png", Want::Color).is_err());
        let size = Want::Exactly(PixelFormat::Mono8, 6, 5);
        assert_eq!(read(&grey, "png", size).unwrap_err(), "it is 6x4, the stream is 6x5");
        assert!(read(&grey[..40], "png", Want::Grey).unwrap_err().contains("cannot be read as a PNG"));
        let npy = encode(&h, PixelFormat::Mono8, &[7; 24], StillFormat::Npy).unwrap();
        assert!(read(&npy, "npy", Want::Metres).unwrap_err().contains("not metres"));
        for at in 0..npy.len() {
            assert!(array(&npy[..at]).is_err());
        }
    }
}
