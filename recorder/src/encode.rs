//! A frame becomes a chunk: JPEG or lossless pixels in a ROS image message, packed and ready to be appended.

use crate::codec::{DEPTH_CODEC, DepthEncoder, DepthShape};
use crate::container::chunk::{Chunk, ChunkBuilder, MessageHead};
use crate::frame::RecordFrame;
use crate::msgs::image;
use crate::options::{ColorCodec, Compression, DepthCodec};
use crate::{Error, ErrorKind, RecorderOptions, Result};
use ::image::codecs::png::{CompressionType, FilterType, PngEncoder};
use ::image::{ExtendedColorType, ImageEncoder};
use depthrig_bus::{FrameHeader, PixelFormat};
use jpeg_encoder::{ColorType, Encoder, SamplingFactor};

/// How the pixels of a stream are stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Codec {
    /// As they are, in an `Image`.
    Raw,
    /// As a JPEG made here.
    Jpeg,
    /// As the JPEG that the camera sent.
    Mjpeg,
    /// As a PNG made here.
    Png,
    /// With our own depth codec.
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
}

/// What a worker needs to know of a stream and a set to encode one frame.
pub(crate) struct FrameJob<'a> {
    pub(crate) frame: &'a RecordFrame,
    pub(crate) channel: u16,
    pub(crate) frame_id: &'a str,
    pub(crate) log_time: u64,
    pub(crate) stamp_utc_ns: i64,
}

/// A packed frame, with length and CRC-32 of its message.
#[derive(Debug)]
pub(crate) struct EncodedFrame {
    pub(crate) chunk: Chunk,
    pub(crate) message_bytes: u64,
    pub(crate) message_crc32: u32,
}

/// The buffers and settings of one worker.
pub(crate) struct FrameEncoder {
    builder: ChunkBuilder,
    options: RecorderOptions,
    repacked: Vec<u8>,
    depth: Option<DepthEncoder>,
}

impl FrameEncoder {
    pub(crate) fn new(options: &RecorderOptions) -> Self {
        Self { builder: ChunkBuilder::new(), options: options.clone(), repacked: Vec::new(), depth: None }
    }

    pub(crate) fn encode(&mut self, job: &FrameJob<'_>) -> Result<EncodedFrame> {
        let h = &job.frame.header;
        let (pixels, stored) = (job.frame.pixels.bytes(), job.frame.pixels.jpeg());
        let format = image::check_picture(h, pixels.len())?;
        let pixels = &pixels[..h.payload_len as usize];
        let codec = Codec::of(format, &self.options);
        let head = MessageHead {
            channel: job.channel,
            sequence: h.sequence as u32,
            log_time: job.log_time,
            publish_time: u64::try_from(job.stamp_utc_ns).unwrap_or(0),
        };
        let (quality, repacked) = (self.options.jpeg_quality.clamp(1, 100), &mut self.repacked);
        let (stamp, frame_id, depth) = (job.stamp_utc_ns, job.frame_id, &mut self.depth);
        let (message_bytes, message_crc32) =
            self.builder.message(head, |buf| match (codec, image::encoding(format)) {
                (Codec::Raw, Some(encoding)) => {
                    image::write_image(buf, stamp, frame_id, h, encoding, pixels);
                    Ok(())
                }
                (Codec::Raw, None) => Err(Error::new(
                    ErrorKind::BadInput,
                    format!("{} pictures cannot be stored as they are", format.name()),
                )),
                (Codec::Mjpeg, _) => image::write_compressed(buf, stamp, frame_id, "jpeg", |out| {
                    out.extend_from_slice(pixels);
                    Ok(())
                }),
                (Codec::Jpeg, _) => image::write_compressed(buf, stamp, frame_id, "jpeg", |out| {
                    if let Some(stored) = stored {
                        out.extend_from_slice(stored);
                        return Ok(());
                    }
                    jpeg(out, h, format, pixels, quality, repacked)
                }),
                (Codec::Png, _) => image::write_compressed(buf, stamp, frame_id, "png", |out| {
                    png(out, h, format, pixels, repacked)
                }),
                (Codec::Rank, _) => {
                    let shape = DepthShape { width: h.width, height: h.height, step: h.stride };
                    let encoder = depth.get_or_insert_default();
                    image::write_compressed_depth(buf, stamp, frame_id, shape, DEPTH_CODEC, |out| {
                        encoder.encode(pixels, shape, out)
                    })
                }
            })?;
        let compress = codec == Codec::Raw && self.options.compression == Compression::Zstd1;
        Ok(EncodedFrame { chunk: self.builder.pack(compress)?, message_bytes, message_crc32 })
    }
}

/// The pixels without row padding.
fn tight<'a>(h: &FrameHeader, format: PixelFormat, pixels: &'a [u8], repacked: &'a mut Vec<u8>) -> &'a [u8] {
    let row = format.row_bytes(h.width) as usize;
    if h.stride as usize == row {
        return pixels;
    }
    repacked.clear();
    pixels.chunks_exact(h.stride as usize).for_each(|r| repacked.extend_from_slice(&r[..row]));
    repacked
}

fn cannot(h: &FrameHeader, what: &str) -> String {
    format!("frame {} of {}/{} cannot be made a {what}", h.sequence, h.camera(), h.stream())
}

/// Appends the PNG of an RGB or BGR picture, with the quick settings.
fn png(
    out: &mut Vec<u8>,
    h: &FrameHeader,
    format: PixelFormat,
    pixels: &[u8],
    repacked: &mut Vec<u8>,
) -> Result<()> {
    let rgb = if format == PixelFormat::Bgr8 {
        repacked.clear();
        let row = format.row_bytes(h.width) as usize;
        for r in pixels.chunks_exact(h.stride as usize) {
            repacked.extend(r[..row].as_chunks::<3>().0.iter().flat_map(|[b, g, r]| [*r, *g, *b]));
        }
        repacked
    } else {
        tight(h, format, pixels, repacked)
    };
    PngEncoder::new_with_quality(out, CompressionType::Fast, FilterType::Paeth)
        .write_image(rgb, h.width, h.height, ExtendedColorType::Rgb8)
        .map_err(|e| Error::new(ErrorKind::Codec, cannot(h, "PNG")).with_source(e))
}

/// Appends the JPEG of an RGB or BGR picture, 4:4:4: colour is not averaged over neighbours, because edges
/// are where colour and depth must agree.
fn jpeg(
    out: &mut Vec<u8>,
    h: &FrameHeader,
    format: PixelFormat,
    pixels: &[u8],
    quality: u8,
    repacked: &mut Vec<u8>,
) -> Result<()> {
    let tight = tight(h, format, pixels, repacked);
    let color = if format == PixelFormat::Bgr8 { ColorType::Bgr } else { ColorType::Rgb };
    let (Ok(width), Ok(height)) = (u16::try_from(h.width), u16::try_from(h.height)) else {
        return Err(Error::new(ErrorKind::BadInput, "a JPEG has at most 65535 pixels per side"));
    };
    let mut encoder = Encoder::new(out, quality);
    encoder.set_sampling_factor(SamplingFactor::R_4_4_4);
    encoder
        .encode(tight, width, height, color)
        .map_err(|e| Error::new(ErrorKind::Codec, cannot(h, "JPEG")).with_source(e))
}
