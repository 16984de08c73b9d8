//! A frame becomes a chunk: JPEG or lossless pixels in a ROS image message, packed and ready to be appended.

use crate::container::chunk::{Chunk, ChunkBuilder, MessageHead};
use crate::frame::RecordFrame;
use crate::msgs::image;
use crate::options::{ColorCodec, Compression};
use crate::{Error, ErrorKind, RecorderOptions, Result};
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
}

impl Codec {
    pub(crate) const fn of(format: PixelFormat, color: ColorCodec) -> Self {
        match (format, color) {
            (PixelFormat::Mjpeg, _) => Self::Mjpeg,
            (PixelFormat::Rgb8 | PixelFormat::Bgr8, ColorCodec::Jpeg) => Self::Jpeg,
            _ => Self::Raw,
        }
    }

    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Raw => "raw",
            Self::Jpeg => "jpeg",
            Self::Mjpeg => "mjpeg",
        }
    }

    pub(crate) fn from_name(name: &str) -> Option<Self> {
        [Self::Raw, Self::Jpeg, Self::Mjpeg].into_iter().find(|c| c.name() == name)
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
    jpeg_quality: u8,
    color: ColorCodec,
    compression: Compression,
    repacked: Vec<u8>,
}

impl FrameEncoder {
    pub(crate) fn new(options: &RecorderOptions) -> Self {
        Self {
            builder: ChunkBuilder::new(),
            jpeg_quality: options.jpeg_quality.clamp(1, 100),
            color: options.color,
            compression: options.compression,
            repacked: Vec::new(),
        }
    }

    pub(crate) fn encode(&mut self, job: &FrameJob<'_>) -> Result<EncodedFrame> {
        let h = &job.frame.header;
        let (pixels, stored) = (job.frame.pixels.bytes(), job.frame.pixels.jpeg());
        let format = image::check_picture(h, pixels.len())?;
        let pixels = &pixels[..h.payload_len as usize];
        let codec = Codec::of(format, self.color);
        let head = MessageHead {
            channel: job.channel,
            sequence: h.sequence as u32,
            log_time: job.log_time,
            publish_time: u64::try_from(job.stamp_utc_ns).unwrap_or(0),
        };
        let (quality, repacked) = (self.jpeg_quality, &mut self.repacked);
        let (message_bytes, message_crc32) =
            self.builder.message(head, |buf| match (codec, image::encoding(format)) {
                (Codec::Raw, Some(encoding)) => {
                    image::write_image(buf, job.stamp_utc_ns, job.frame_id, h, encoding, pixels);
                    Ok(())
                }
                (Codec::Raw, None) => Err(Error::new(
                    ErrorKind::BadInput,
                    format!("{} pictures cannot be stored as they are", format.name()),
                )),
                (Codec::Mjpeg, _) => image::write_compressed(buf, job.stamp_utc_ns, job.frame_id, |out| {
                    out.extend_from_slice(pixels);
                    Ok(())
                })
                .map(|_| ()),
                (Codec::Jpeg, _) => image::write_compressed(buf, job.stamp_utc_ns, job.frame_id, |out| {
                    if let Some(stored) = stored {
                        out.extend_from_slice(stored);
                        return Ok(());
                    }
                    jpeg(out, h, format, pixels, quality, repacked)
                })
                .map(|_| ()),
            })?;
        let compress = codec == Codec::Raw && self.compression == Compression::Zstd1;
        Ok(EncodedFrame { chunk: self.builder.pack(compress)?, message_bytes, message_crc32 })
    }
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
    let row = format.row_bytes(h.width) as usize;
    let tight = if h.stride as usize == row {
        pixels
    } else {
        repacked.clear();
        pixels.chunks_exact(h.stride as usize).for_each(|r| repacked.extend_from_slice(&r[..row]));
        repacked
    };
    let color = if format == PixelFormat::Bgr8 { ColorType::Bgr } else { ColorType::Rgb };
    let (Ok(width), Ok(height)) = (u16::try_from(h.width), u16::try_from(h.height)) else {
        return Err(Error::new(ErrorKind::BadInput, "a JPEG has at most 65535 pixels per side"));
    };
    let mut encoder = Encoder::new(out, quality);
    encoder.set_sampling_factor(SamplingFactor::R_4_4_4);
    encoder.encode(tight, width, height, color).map_err(|e| {
        let message = format!("frame {} of {}/{} cannot be made a JPEG", h.sequence, h.camera(), h.stream());
        Error::new(ErrorKind::Codec, message).with_source(e)
    })
}
