//! The messages of a recording one by one, for viewers that are connected while the cameras run: same topics, same schemas, same bytes.
//!
//! Two things differ from a file. Times lie in UTC by the offset that the caller gives, not by the one of a recording's first set. And depth is never in the
//! codec of [`crate::codec`], which no viewer knows: with [`DepthCodec::Rank`] a viewer gets the `16UC1` images of [`DepthCodec::Zstd`].

use crate::container::record::SchemaRecord;
use crate::encode::{Codec, ImageJob, ImageWriter};
use crate::msgs::frame_info::{self, Extra};
use crate::msgs::motion::Imu;
use crate::msgs::{diagnostics, image, tf};
use crate::options::DepthCodec;
use crate::recorder::topics::{Global, Topics, image_channel};
use crate::{Diagnostic, Error, ErrorKind, RecorderOptions, Result, Session};
use ::image::codecs::png::CompressionType;
use depthrig_bus::{FrameHeader, MotionSample};

/// Content of a channel; the number is the place of the stream in `Session::streams`, or of the IMU in `Session::motion`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum LiveSource {
    /// Images of a stream.
    Image(usize),
    /// Their `CameraInfo`.
    CameraInfo(usize),
    /// Their headers.
    FrameInfo(usize),
    /// Samples of an IMU.
    Imu(usize),
    /// Where everything sits on the mount.
    TfStatic,
    /// State of the rig.
    Diagnostics,
}

/// A channel as it is announced to a viewer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LiveChannel {
    /// Its content.
    pub source: LiveSource,
    /// Its topic.
    pub topic: String,
    /// Name of its message type.
    pub schema_name: String,
    /// Definition of the type, as `ros2msg`.
    pub schema: String,
}

/// Topics and messages of a rig.
pub struct LiveTopics {
    session: Session,
    topics: Topics,
    channels: Vec<LiveChannel>,
    options: RecorderOptions,
}

impl LiveTopics {
    /// The topics that a recording of `session` with these options has, but those that only a recording needs.
    ///
    /// # Errors
    /// Those of writing the session as TOML.
    pub fn new(session: Session, options: &RecorderOptions) -> Result<Self> {
        let options = RecorderOptions { depth: DepthCodec::Zstd, ..options.clone() };
        let topics = Topics::new(&session, &options);
        let preamble = topics.preamble(&session, 0)?;
        let schema = |id: u16| preamble.schemas.iter().find(|s: &&SchemaRecord| s.id == id);
        let mut sources = vec![
            (Global::TfStatic.channel(), LiveSource::TfStatic),
            (Global::Diagnostics.channel(), LiveSource::Diagnostics),
        ];
        for stream in 0..session.streams.len() {
            let id = image_channel(stream);
            sources.push((id, LiveSource::Image(stream)));
            sources.push((id + 1, LiveSource::CameraInfo(stream)));
            sources.push((id + 2, LiveSource::FrameInfo(stream)));
        }
        for unit in 0..session.motion.len() {
            sources.push((topics.unit(unit).channel + 2, LiveSource::Imu(unit)));
        }
        let channels = sources.into_iter().filter_map(|(id, source)| {
            let channel = preamble.channels.iter().find(|c| c.id == id)?;
            let schema = schema(channel.schema)?;
            Some(LiveChannel {
                source,
                topic: channel.topic.clone(),
                schema_name: schema.name.clone(),
                schema: String::from_utf8_lossy(&schema.data).into_owned(),
            })
        });
        Ok(Self { channels: channels.collect(), session, topics, options })
    }

    /// The channels.
    pub fn channels(&self) -> &[LiveChannel] {
        &self.channels
    }

    /// The streams and IMUs that the channels are of.
    pub const fn session(&self) -> &Session {
        &self.session
    }

    /// Appends the `CameraInfo` of a frame.
    pub fn camera_info(&self, buf: &mut Vec<u8>, stream: usize, h: &FrameHeader, utc_offset_ns: i64) {
        image::write_camera_info(buf, stamp(h, utc_offset_ns), self.topics.frame_id(stream), h);
    }

    /// Appends the `FrameInfo` of a frame.
    pub fn frame_info(&self, buf: &mut Vec<u8>, stream: usize, h: &FrameHeader, utc_offset_ns: i64) {
        let codec = h.pixel_format().map_or("", |format| Codec::of(format, &self.options).name());
        let frame_id = self.topics.frame_id(stream);
        let extra = Extra { stamp_utc_ns: stamp(h, utc_offset_ns), frame_id, codec };
        frame_info::write(buf, h, &extra);
    }

    /// Appends the `Imu` of a sample; returns its time, UTC nanoseconds.
    pub fn imu(&self, buf: &mut Vec<u8>, unit: usize, sample: &MotionSample, utc_offset_ns: i64) -> i64 {
        let imu = Imu::of(sample, utc_offset_ns);
        imu.write(buf, &self.topics.unit(unit).frame_id);
        imu.stamp_utc_ns
    }

    /// Appends the `TFMessage` of everything on the mount.
    pub fn tf_static(&self, buf: &mut Vec<u8>, utc_ns: i64) {
        tf::write(buf, utc_ns, &self.session);
    }

    /// Appends the `DiagnosticArray` of these.
    pub fn diagnostics(buf: &mut Vec<u8>, utc_ns: i64, statuses: &[Diagnostic]) {
        diagnostics::write(buf, utc_ns, statuses);
    }
}

fn stamp(h: &FrameHeader, utc_offset_ns: i64) -> i64 {
    h.capture_time_ns.saturating_add(utc_offset_ns)
}

/// Encodes images; it keeps its buffers from one to the next.
pub struct LiveEncoder {
    writer: ImageWriter,
}

impl LiveEncoder {
    /// An encoder with these options.
    pub fn new(options: &RecorderOptions) -> Self {
        Self { writer: ImageWriter::new(options.jpeg_quality) }
    }

    /// Appends the message of an image.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] for a frame that contradicts its header or its stream, [`ErrorKind::Codec`] when it cannot be encoded.
    pub fn image(
        &mut self,
        buf: &mut Vec<u8>,
        topics: &LiveTopics,
        stream: usize,
        frame: LiveFrame<'_>,
        utc_offset_ns: i64,
    ) -> Result<()> {
        let LiveFrame { header, pixels } = frame;
        let format = image::check_image(header, pixels.len())?;
        let announced = topics.session.streams.get(stream).map(|s| s.format);
        if announced != Some(format) {
            let name = format.name();
            let what = format!(
                "{}/{} sends {name} pixels, which was not announced",
                header.camera(),
                header.stream()
            );
            return Err(Error::new(ErrorKind::BadInput, what));
        }
        self.writer.write(
            buf,
            &ImageJob {
                header,
                format,
                pixels: &pixels[..header.payload_len as usize],
                stored: None,
                codec: Codec::of(format, &topics.options),
                packing: CompressionType::Fast,
                frame_id: topics.topics.frame_id(stream),
                stamp_utc_ns: stamp(header, utc_offset_ns),
            },
        )
    }
}

/// A frame as its channel carries it.
#[derive(Debug, Clone, Copy)]
pub struct LiveFrame<'a> {
    /// Its header.
    pub header: &'a FrameHeader,
    /// Its pixels.
    pub pixels: &'a [u8],
}
