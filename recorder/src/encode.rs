//! Encodes a frame into a chunk: JPEG or lossless pixels in a ROS image message, packed and ready to be appended.

use crate::codec::{DEPTH_CODEC, DepthEncoder, DepthShape};
use crate::container::chunk::{Chunk, ChunkBuilder, MessageHead, Tail};
use crate::container::pool::Pool;
use crate::frame::RecordFrame;
use crate::msgs::image;
use crate::options::{ColorCodec, Compression, DepthCodec};
use crate::{Error, ErrorKind, RecorderOptions, Result};
use ::image::codecs::png::{CompressionType, FilterType, PngEncoder};
use ::image::{ExtendedColorType, ImageEncoder};
use depthrig_bus::{FrameHeader, PixelFormat};
use jpeg_encoder::{ColorType, Encoder, SamplingFactor};
use std::sync::Arc;

/// How the pixels of a stream are stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Codec {
    /// Unchanged, in an `Image`.
    Raw,
    /// As JPEG, encoded by the recorder.
    Jpeg,
    /// As JPEG, as the camera sent it.
    Mjpeg,
    /// As PNG, encoded by the recorder.
    Png,
    /// With depthrig's depth codec.
    Rank,
}

impl Codec {
    const ALL: [Self; 5] = [Self::Raw, Self::Jpeg, Self::Mjpeg, Self::Png, Self::Rank];

    pub(crate) const fn of(format: PixelFormat, options: &RecorderOptions) -> Self {
        match (format, options.color, options.depth) {
            (PixelFormat::Mjpeg, ..) => Self::Mjpeg,
            (PixelFormat::Rgb8 | PixelFormat::Bgr8, ColorCodec::Jpeg, _) => Self::Jpeg,
            (PixelFormat::Rgb8 | PixelFormat::Bgr8, ColorCodec::Png, _) => Self::Png,
            (PixelFormat::Z16, _, DepthCodec::Rank) => Self::Rank,
            _ => Self::Raw,
        }
    }

    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Raw => "raw",
            Self::Jpeg => "jpeg",
            Self::Mjpeg => "mjpeg",
            Self::Png => "png",
            Self::Rank => "rank",
        }
    }

    pub(crate) fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|c| c.name() == name)
    }

    /// Whether messages of both have one type, and so may be on one topic.
    const fn has_type_of(self, other: Self) -> bool {
        use Codec::{Jpeg, Mjpeg, Png, Rank, Raw};
        matches!((self, other), (Jpeg | Mjpeg | Png, Jpeg | Mjpeg | Png) | (Rank, Rank) | (Raw, Raw))
    }
}

/// How much CPU time an encoder may spend on a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Effort {
    /// As configured in the options.
    Full,
    /// As little as possible: lossless, hardly compressed, in a message of its channel's type.
    Least,
}

/// A frame to encode, with all that a worker needs to know of its stream and its set.
pub(crate) struct FrameJob<'a> {
    pub(crate) frame: RecordFrame,
    pub(crate) channel: u16,
    pub(crate) frame_id: &'a str,
    pub(crate) log_time: u64,
    pub(crate) stamp_utc_ns: i64,
}

/// A packed frame, with length and CRC-32 of its message.
#[derive(Debug)]
pub(crate) struct EncodedFrame {
    pub(crate) chunk: Chunk,
    pub(crate) codec: Codec,
    pub(crate) message_bytes: u64,
    pub(crate) message_crc32: u32,
}

/// The buffers and settings of one worker.
pub(crate) struct FrameEncoder {
    builder: ChunkBuilder,
    options: RecorderOptions,
    writer: ImageWriter,
}

impl FrameEncoder {
    /// An encoder whose chunks are in buffers of `pool`.
    pub(crate) fn new(options: &RecorderOptions, pool: &Arc<Pool>) -> Self {
        Self {
            builder: ChunkBuilder::with_pool(pool),
            options: options.clone(),
            writer: ImageWriter::new(options.jpeg_quality),
        }
    }

    pub(crate) fn encode(&mut self, job: FrameJob<'_>, effort: Effort) -> Result<EncodedFrame> {
        let h = &job.frame.header;
        let pixels = job.frame.pixels.bytes();
        let format = image::check_image(h, pixels.len())?;
        let pixels = &pixels[..h.payload_len as usize];
        let mut codec = Codec::of(format, &self.options);
        let stored = job.frame.pixels.stored().and_then(|s| Some((Codec::from_name(s.codec)?, s.bytes)));
        let stored = stored.filter(|(stored, _)| *stored != Codec::Raw && stored.has_type_of(codec));
        codec = stored.map_or(codec, |(stored, _)| stored);
        let mut compress = codec == Codec::Raw && self.options.compression == Compression::Zstd1;
        let mut packing = CompressionType::Fast;
        // Depth of the rank codec has a message type of its own, and an image that is stored already costs nothing.
        if effort == Effort::Least {
            compress = false;
            packing = CompressionType::Uncompressed;
            if codec == Codec::Jpeg && stored.is_none() {
                codec = Codec::Png;
            }
        }
        let head = MessageHead {
            channel: job.channel,
            sequence: h.sequence as u32,
            log_time: job.log_time,
            publish_time: u64::try_from(job.stamp_utc_ns).unwrap_or(0),
        };
        if codec == Codec::Raw && !compress {
            if job.frame.pixels.may_wait() {
                return self.by_reference(job, head, format);
            }
            self.builder.expect(image::room(job.frame_id, pixels));
        }
        let image = ImageJob {
            header: h,
            format,
            pixels,
            stored: stored.map(|(_, bytes)| bytes),
            codec,
            packing,
            frame_id: job.frame_id,
            stamp_utc_ns: job.stamp_utc_ns,
        };
        let writer = &mut self.writer;
        let (message_bytes, message_crc32) = self.builder.message(head, |buf| writer.write(buf, &image))?;
        Ok(EncodedFrame { chunk: self.builder.pack(compress)?, codec, message_bytes, message_crc32 })
    }

    /// Stores pixels as they are, from where they lie.
    fn by_reference(
        &mut self,
        job: FrameJob<'_>,
        head: MessageHead,
        format: PixelFormat,
    ) -> Result<EncodedFrame> {
        let encoding = format.ros_encoding().ok_or_else(|| as_they_are(format))?;
        let h = &job.frame.header;
        let tail = Tail::new(job.frame.pixels, h.payload_len as usize);
        let tail =
            tail.ok_or_else(|| Error::new(ErrorKind::BadInput, cannot(h, "a message: it is too short")))?;
        let (message_bytes, message_crc32) = self.builder.message_with_tail(head, tail, |buf| {
            image::write_image_head(buf, job.stamp_utc_ns, job.frame_id, h, encoding, h.payload_len);
        });
        Ok(EncodedFrame { chunk: self.builder.pack(false)?, codec: Codec::Raw, message_bytes, message_crc32 })
    }
}

/// An image, and how its message has it.
pub(crate) struct ImageJob<'a> {
    pub(crate) header: &'a FrameHeader,
    pub(crate) format: PixelFormat,
    /// As many as the header says.
    pub(crate) pixels: &'a [u8],
    /// The image of this codec that they were decoded from, if they were.
    pub(crate) stored: Option<&'a [u8]>,
    pub(crate) codec: Codec,
    /// How hard a PNG is packed.
    pub(crate) packing: CompressionType,
    pub(crate) frame_id: &'a str,
    pub(crate) stamp_utc_ns: i64,
}

/// Writes the messages of images.
pub(crate) struct ImageWriter {
    quality: u8,
    repacked: Vec<u8>,
    depth: Option<DepthEncoder>,
}

impl ImageWriter {
    pub(crate) fn new(jpeg_quality: u8) -> Self {
        Self { quality: jpeg_quality.clamp(1, 100), repacked: Vec::new(), depth: None }
    }

    /// Appends the message.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] for pixels that are no image, [`ErrorKind::Codec`] when they cannot be encoded.
    pub(crate) fn write(&mut self, buf: &mut Vec<u8>, image: &ImageJob<'_>) -> Result<()> {
        let ImageJob { header: h, format, pixels, stored, codec, packing, frame_id, stamp_utc_ns } = *image;
        let stamp = stamp_utc_ns;
        let shape = DepthShape { width: h.width, height: h.height, step: h.stride };
        let encode = |out: &mut Vec<u8>| match stored {
            Some(stored) => {
                out.extend_from_slice(stored);
                Ok(())
            }
            None => self.encode(out, codec, h, pixels, packing),
        };
        match (codec, format.ros_encoding()) {
            (Codec::Raw, Some(encoding)) => {
                image::write_image(buf, stamp, frame_id, h, encoding, pixels);
                Ok(())
            }
            (Codec::Raw, None) => Err(as_they_are(format)),
            (Codec::Mjpeg | Codec::Jpeg, _) => image::write_compressed(buf, stamp, frame_id, "jpeg", encode),
            (Codec::Png, _) => image::write_compressed(buf, stamp, frame_id, "png", encode),
            (Codec::Rank, _) => {
                image::write_compressed_depth(buf, stamp, frame_id, shape, DEPTH_CODEC, encode)
            }
        }
    }

    /// Appends the image alone, without a message around it.
    ///
    /// # Errors
    /// As [`Self::write`].
    pub(crate) fn encode(
        &mut self,
        out: &mut Vec<u8>,
        codec: Codec,
        h: &FrameHeader,
        pixels: &[u8],
        packing: CompressionType,
    ) -> Result<()> {
        match codec {
            Codec::Raw | Codec::Mjpeg => {
                out.extend_from_slice(pixels);
                Ok(())
            }
            Codec::Jpeg => jpeg(out, h, pixels, self.quality, &mut self.repacked),
            Codec::Png => png(out, h, pixels, packing, &mut self.repacked),
            Codec::Rank => {
                let shape = DepthShape { width: h.width, height: h.height, step: h.stride };
                self.depth.get_or_insert_default().encode(pixels, shape, out)
            }
        }
    }
}

fn as_they_are(format: PixelFormat) -> Error {
    Error::new(ErrorKind::BadInput, format!("{} images cannot be stored as they are", format.name()))
}

/// The pixels of a colour image without row padding.
fn tight<'a>(h: &FrameHeader, pixels: &'a [u8], repacked: &'a mut Vec<u8>) -> &'a [u8] {
    let row = 3 * h.width as usize;
    if h.stride as usize == row {
        return pixels;
    }
    repacked.clear();
    pixels.chunks_exact(h.stride as usize).for_each(|r| repacked.extend_from_slice(&r[..row]));
    repacked
}

fn cannot(h: &FrameHeader, what: &str) -> String {
    format!("frame {} of {}/{} cannot be encoded as {what}", h.sequence, h.camera(), h.stream())
}

/// Appends the PNG of an RGB or BGR image, with the quick settings.
fn png(
    out: &mut Vec<u8>,
    h: &FrameHeader,
    pixels: &[u8],
    packing: CompressionType,
    repacked: &mut Vec<u8>,
) -> Result<()> {
    let rgb = if h.pixel_format() == Some(PixelFormat::Bgr8) {
        repacked.clear();
        let row = 3 * h.width as usize;
        for r in pixels.chunks_exact(h.stride as usize) {
            repacked.extend(r[..row].as_chunks::<3>().0.iter().flat_map(|[b, g, r]| [*r, *g, *b]));
        }
        repacked
    } else {
        tight(h, pixels, repacked)
    };
    let filter = match packing {
        CompressionType::Uncompressed => FilterType::NoFilter,
        _ => FilterType::Paeth,
    };
    PngEncoder::new_with_quality(out, packing, filter)
        .write_image(rgb, h.width, h.height, ExtendedColorType::Rgb8)
        .map_err(|e| Error::new(ErrorKind::Codec, cannot(h, "PNG")).with_source(e))
}

/// Appends the JPEG of an RGB or BGR image, 4:4:4: colour is not averaged over neighbours, because edges
/// are where colour and depth must agree.
fn jpeg(
    out: &mut Vec<u8>,
    h: &FrameHeader,
    pixels: &[u8],
    quality: u8,
    repacked: &mut Vec<u8>,
) -> Result<()> {
    let tight = tight(h, pixels, repacked);
    let color = if h.pixel_format() == Some(PixelFormat::Bgr8) { ColorType::Bgr } else { ColorType::Rgb };
    let (Ok(width), Ok(height)) = (u16::try_from(h.width), u16::try_from(h.height)) else {
        return Err(Error::new(ErrorKind::BadInput, "a JPEG has at most 65535 pixels per side"));
    };
    let mut encoder = Encoder::new(out, quality);
    encoder.set_sampling_factor(SamplingFactor::R_4_4_4);
    encoder
        .encode(tight, width, height, color)
        .map_err(|e| Error::new(ErrorKind::Codec, cannot(h, "JPEG")).with_source(e))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::{Pixels, ReadPixels};

    /// Pixels in borrowed memory.
    struct Lent(Vec<u8>);

    impl Pixels for Lent {
        fn bytes(&self) -> &[u8] {
            &self.0
        }
    }

    fn encode(
        options: &RecorderOptions,
        format: PixelFormat,
        pixels: Box<dyn Pixels>,
    ) -> Result<EncodedFrame> {
        let mut header = FrameHeader::default();
        header.set_image(format, 40, 30);
        header.sequence = 17;
        header.depth_unit_m = 0.001;
        let frame = RecordFrame { stream: 0, header, pixels };
        let job = FrameJob { frame, channel: 3, frame_id: "a_frame", log_time: 5, stamp_utc_ns: 4 };
        FrameEncoder::new(options, &Pool::new(1 << 20)).encode(job, Effort::Full)
    }

    #[test]
    fn an_image_that_was_read_is_stored_again_as_it_is() {
        let options = RecorderOptions { depth: DepthCodec::Rank, ..RecorderOptions::default() };
        let again = |format: PixelFormat, codec, stored: &[u8]| {
            let pixels = vec![9; format.frame_bytes(40, 30)];
            let read = ReadPixels { pixels, codec, stored: Some(stored.to_vec()) };
            let done = encode(&options, format, Box::new(read)).unwrap();
            let bytes = done.chunk.parts().concat();
            (done.codec, bytes.windows(stored.len()).any(|window| window == stored))
        };
        // Images that no encoder makes: they are found in the file or were encoded anew.
        let image: Vec<u8> = (0..200u8).map(|i| i.wrapping_mul(37)).collect();
        for (format, codec, expected) in [
            (PixelFormat::Rgb8, "jpeg", (Codec::Jpeg, true)),
            // Of a recorder that was short of time.
            (PixelFormat::Bgr8, "png", (Codec::Png, true)),
            (PixelFormat::Z16, "rank", (Codec::Rank, true)),
            // Its topic has messages of another type.
            (PixelFormat::Rgb8, "rank", (Codec::Jpeg, false)),
            (PixelFormat::Z16, "png", (Codec::Rank, false)),
            (PixelFormat::Rgb8, "raw", (Codec::Jpeg, false)),
            (PixelFormat::Rgb8, "of a later version", (Codec::Jpeg, false)),
        ] {
            assert_eq!(again(format, codec, &image), expected, "{codec}");
        }
    }

    #[test]
    fn pixels_that_may_wait_are_stored_as_those_that_may_not_but_without_a_copy() {
        let plain = RecorderOptions {
            color: ColorCodec::Raw,
            compression: Compression::None,
            ..RecorderOptions::default()
        };
        for (options, by_reference) in [(&plain, true), (&RecorderOptions::default(), false)] {
            for format in [PixelFormat::Rgb8, PixelFormat::Z16, PixelFormat::Mono8] {
                // The three bytes after the image do not belong to it.
                let bytes: Vec<u8> = (0..format.frame_bytes(40, 30) + 3).map(|i| (i * 7) as u8).collect();
                let at = bytes.as_ptr();
                let lent = encode(options, format, Box::new(Lent(bytes.clone()))).unwrap();
                let kept = encode(options, format, Box::new(bytes)).unwrap();
                let [_, tail] = kept.chunk.parts();
                assert_eq!(tail.as_ptr() == at, by_reference, "{}", format.name());
                assert!(lent.chunk.parts()[1].is_empty());
                let same = |f: &EncodedFrame| {
                    let bytes = f.chunk.parts().concat();
                    assert_eq!(f.chunk.len(), bytes.len() as u64);
                    assert_eq!(f.chunk.crc, crc32fast::hash(&bytes));
                    (
                        bytes,
                        f.message_bytes,
                        f.message_crc32,
                        f.chunk.uncompressed_size,
                        f.chunk.compressed_size,
                    )
                };
                assert_eq!(same(&lent), same(&kept), "{}", format.name());
            }
        }
        let short = encode(&plain, PixelFormat::Z16, Box::new(vec![0; 40])).unwrap_err();
        assert_eq!(short.kind(), ErrorKind::BadInput, "{short}");
        let no_image = encode(&plain, PixelFormat::Motion, Box::new(vec![0; 4096 * 64])).unwrap_err();
        assert_eq!(no_image.kind(), ErrorKind::BadInput, "{no_image}");
    }
}
