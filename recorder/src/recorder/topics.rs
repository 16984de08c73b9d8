//! Which topic, channel and frame name a stream has in the file.

use crate::container::record::Channel;
use crate::container::segment::Preamble;
use crate::encode::Codec;
use crate::frame::{RecordMotion, RecordSet, RecordSignal, SET_MOTION_MAX_BYTES, SET_SIGNALS_MAX_BYTES};
use crate::msgs::image;
use crate::msgs::schemas::Schema;
use crate::msgs::signal::SignalForm;
use crate::msgs::tf::{mount_frame, optical_frame, unit_frame};
use crate::{IMAGE_MAX_BYTES, MotionRecord, RecorderOptions, Result, Session, SignalRecord};
use depthrig_bus::{FrameHeader, MOTION_SAMPLE_BYTES, PixelFormat};
use std::collections::BTreeMap;

/// The metadata record that marks an MCAP file as a depthrig segment.
pub(crate) const SESSION_METADATA: &str = "depthrig.session";
/// The metadata record at the end of a segment.
pub(crate) const SEGMENT_METADATA: &str = "depthrig.segment";
/// The codec of an IMU batch in `frame_info`.
pub(crate) const MOTION_CODEC: &str = "samples";
/// The attachment with the rig's configuration.
const RIG_ATTACHMENT: &str = "rig.toml";

/// Channels that exist once per file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Global {
    FrameSet,
    Clock,
    Accounts,
    Notes,
    TfStatic,
    Diagnostics,
    Checkpoint,
}

impl Global {
    const ALL: [Self; 7] = [
        Self::FrameSet,
        Self::Clock,
        Self::Accounts,
        Self::Notes,
        Self::TfStatic,
        Self::Diagnostics,
        Self::Checkpoint,
    ];

    pub(crate) const fn channel(self) -> u16 {
        self as u16 + 1
    }

    const fn schema(self) -> Schema {
        match self {
            Self::FrameSet => Schema::FrameSet,
            Self::Clock => Schema::ClockPair,
            Self::Accounts => Schema::Accounts,
            Self::Notes => Schema::Log,
            Self::TfStatic => Schema::TfMessage,
            Self::Diagnostics => Schema::DiagnosticArray,
            Self::Checkpoint => Schema::Checkpoint,
        }
    }

    fn topic(self, rig: &str) -> String {
        match self {
            Self::FrameSet => format!("/{rig}/frame_set"),
            Self::Clock => format!("/{rig}/clock"),
            Self::Accounts => format!("/{rig}/accounts"),
            Self::Notes => format!("/{rig}/notes"),
            Self::TfStatic => "/tf_static".to_owned(),
            Self::Diagnostics => "/diagnostics".to_owned(),
            Self::Checkpoint => format!("/{rig}/checkpoint"),
        }
    }
}

/// The image channel of the stream of this index; its camera information and frame information follow.
pub(crate) const fn image_channel(stream: usize) -> u16 {
    (Global::ALL.len() + 1 + 3 * stream) as u16
}

/// The frame information of the IMU of this index; its batches and its samples follow.
const fn motion_channel(streams: usize, unit: usize) -> u16 {
    image_channel(streams) + 3 * unit as u16
}

/// The samples of the signal of this index; its single samples follow. Signals come last, so that one which appears while
/// a recording goes on moves no other channel.
pub(crate) const fn signal_channel(streams: usize, units: usize, signal: usize) -> u16 {
    motion_channel(streams, units) + 2 * signal as u16
}

/// The number of the last sample of a signal: its publisher's session and its place there.
pub(crate) type SampleNumber = (u64, u64);

/// An IMU.
pub(crate) struct Unit {
    name: String,
    pub(crate) frame_id: String,
    /// The channel of its frame information; those of batches and samples follow.
    pub(crate) channel: u16,
    /// Most samples of one batch.
    batch: u32,
}

pub(crate) struct Topics {
    frame_ids: Vec<String>,
    /// Image formats as announced, with width and height.
    formats: Vec<PixelFormat>,
    names: Vec<String>,
    codecs: Vec<Codec>,
    units: Vec<Unit>,
}

impl Topics {
    pub(crate) fn new(session: &Session, options: &RecorderOptions) -> Self {
        let streams = &session.streams;
        Self {
            frame_ids: streams.iter().map(|s| optical_frame(&s.id)).collect(),
            formats: streams.iter().map(|s| s.format).collect(),
            names: streams.iter().map(|s| s.id.to_string()).collect(),
            codecs: streams.iter().map(|s| Codec::of(s.format, options)).collect(),
            units: (session.motion.iter().enumerate())
                .map(|(i, u)| Unit {
                    name: u.id.to_string(),
                    frame_id: unit_frame(&u.id),
                    channel: motion_channel(streams.len(), i),
                    batch: u.batch,
                })
                .collect(),
        }
    }

    pub(crate) fn unit(&self, unit: usize) -> &Unit {
        &self.units[unit]
    }

    /// The channel of the samples of a signal; that of its single ones follows.
    pub(super) fn signal_channel(&self, signal: usize) -> u16 {
        signal_channel(self.names.len(), self.units.len(), signal)
    }

    pub(crate) fn frame_id(&self, stream: usize) -> &str {
        &self.frame_ids[stream]
    }

    pub(super) fn name(&self, stream: usize) -> &str {
        &self.names[stream]
    }

    /// Checks that a set can be recorded after the set `last_id` and these batches of each IMU; the error in words.
    pub(super) fn check(
        &self,
        set: &RecordSet,
        last_id: Option<u64>,
        last_batches: &[Option<u64>],
    ) -> Result<(), String> {
        if last_id.is_some_and(|last| set.id <= last) {
            return Err(format!("its id is not greater than that of the set before, {last_id:?}"));
        }
        let mut seen = vec![false; self.names.len()];
        for stream in set.frames.iter().map(|f| f.stream).chain(set.missing.iter().copied()) {
            match seen.get_mut(stream) {
                None => return Err(format!("stream number {stream} is not in the session")),
                Some(true) => return Err(format!("stream {} is in it twice", self.names[stream])),
                Some(seen) => *seen = true,
            }
        }
        for f in &set.frames {
            let format = image::check_image(&f.header, f.pixels.bytes().len()).map_err(|e| e.to_string())?;
            if u64::from(f.header.payload_len) > IMAGE_MAX_BYTES {
                let name = &self.names[f.stream];
                let bytes = f.header.payload_len;
                return Err(format!("an image of {name} has {bytes} bytes, {IMAGE_MAX_BYTES} is the limit"));
            }
            let announced = self.formats[f.stream];
            if format != announced {
                return Err(format!(
                    "{} sent {} pixels, the session announced {}",
                    self.names[f.stream],
                    format.name(),
                    announced.name()
                ));
            }
        }
        self.check_motion(&set.motion, last_batches)
    }

    /// Checks the IMU batches of a set; the error in words.
    fn check_motion(&self, motion: &[RecordMotion], last_batches: &[Option<u64>]) -> Result<(), String> {
        let mut last = last_batches.to_vec();
        let mut bytes = 0;
        for batch in motion {
            let Some((unit, last)) = self.units.get(batch.unit).zip(last.get_mut(batch.unit)) else {
                return Err(format!("IMU number {} is not in the session", batch.unit));
            };
            let h = &batch.header;
            let name = &unit.name;
            check_batch(h, batch.samples.len(), unit.batch)
                .map_err(|why| format!("batch {} of {name}: {why}", h.sequence))?;
            if let Some(before) = last.filter(|before| h.sequence <= *before) {
                return Err(format!("batch {} of {name} follows batch {before}", h.sequence));
            }
            *last = Some(h.sequence);
            bytes += batch.stored_bytes();
        }
        if bytes > SET_MOTION_MAX_BYTES {
            return Err(format!("its motion takes {bytes} bytes, {SET_MOTION_MAX_BYTES} is the limit"));
        }
        Ok(())
    }

    /// Checks the samples of a set of these signals, after these of each; the error in words.
    pub(super) fn check_signals(
        signals: &[RecordSignal],
        known: &[SignalRecord],
        last: &[Option<SampleNumber>],
    ) -> Result<(), String> {
        let mut last = last.to_vec();
        last.resize(known.len(), None);
        let mut bytes = 0_u64;
        for part in signals {
            let Some((record, last)) = known.get(part.signal).zip(last.get_mut(part.signal)) else {
                return Err(format!("signal number {} is not in the session", part.signal));
            };
            let session = part.samples.first().map(|s| s.header().session);
            for sample in &part.samples {
                let h = sample.header();
                let number = (h.session, h.sequence);
                let what = if sample.description() != &record.description {
                    "has other fields than the session says"
                } else if Some(h.session) != session {
                    "is of another publisher than those before it"
                } else if last.is_some_and(|last| number <= last) {
                    "does not follow the one before it"
                } else {
                    *last = Some(number);
                    continue;
                };
                return Err(format!("sample {} of signal {} {what}", h.sequence, record.id));
            }
            bytes = bytes.saturating_add(part.stored_bytes());
        }
        if bytes > SET_SIGNALS_MAX_BYTES {
            return Err(format!("its signals take {bytes} bytes, {SET_SIGNALS_MAX_BYTES} is the limit"));
        }
        Ok(())
    }

    /// Everything that a segment says before its first chunk.
    pub(crate) fn preamble(&self, session: &Session, segment: u32) -> Result<Preamble> {
        let rig = &session.rig;
        let mut channels: Vec<Channel> = Global::ALL
            .into_iter()
            .map(|g| Channel {
                id: g.channel(),
                schema: g.schema().id(),
                topic: g.topic(rig),
                metadata: BTreeMap::from([qos(g == Global::TfStatic)]),
            })
            .collect();
        for (i, s) in session.streams.iter().enumerate() {
            let base = format!("/{rig}/{}/{}", s.id.camera, s.id.stream);
            // One folder per stream: viewers match an image with the camera_info beside it.
            let (image, schema) = match self.codecs[i] {
                Codec::Raw => ("image_raw", Schema::Image),
                Codec::Jpeg | Codec::Mjpeg | Codec::Png => ("image_compressed", Schema::CompressedImage),
                Codec::Rank => ("depth_compressed", Schema::CompressedDepth),
            };
            let facts = [
                ("stream", s.id.to_string()),
                ("model", s.model.clone()),
                ("serial", s.serial.clone()),
                ("format", s.format.name().to_owned()),
                ("codec", self.codecs[i].name().to_owned()),
                ("depth_unit_m", s.depth_unit_m.to_string()),
                ("rate_hz", s.rate_hz.to_string()),
                ("frame_id", self.frame_ids[i].clone()),
                ("parent_frame_id", mount_frame(rig)),
                ("calibration", s.calibration.clone()),
            ];
            let mut metadata: BTreeMap<_, _> = facts.map(|(k, v)| (k.to_owned(), v)).into();
            metadata.extend([qos(false)]);
            for computed in session.computed.iter().filter(|c| c.stream == s.id) {
                let facts = [
                    ("computed", &computed.name),
                    ("producer", &computed.producer),
                    ("parameters", &computed.parameters),
                ];
                metadata.extend(facts.map(|(k, v)| (k.to_owned(), v.clone())));
            }
            let id = image_channel(i);
            let topics =
                [(image, schema), ("camera_info", Schema::CameraInfo), ("frame_info", Schema::FrameInfo)];
            for (k, (name, schema)) in topics.into_iter().enumerate() {
                channels.push(Channel {
                    id: id + k as u16,
                    schema: schema.id(),
                    topic: format!("{base}/{name}"),
                    metadata: metadata.clone(),
                });
            }
        }
        for (unit, u) in session.motion.iter().zip(&self.units) {
            channels.extend(unit_channels(rig, unit, u));
        }
        for (i, signal) in session.signals.iter().enumerate() {
            channels.extend(signal_channels(rig, signal, self.signal_channel(i)));
        }
        let facts = [
            ("format", session.format.clone()),
            ("name", session.name.clone()),
            ("rig", rig.clone()),
            ("scene", session.scene.clone()),
            ("operator", session.operator.clone()),
            ("host", session.host.clone()),
            ("started_utc_ns", session.started_utc_ns.to_string()),
            ("depthrig_version", session.depthrig_version.clone()),
            ("segment", segment.to_string()),
            ("session_toml", session.to_toml()?),
        ];
        let time = u64::try_from(session.started_utc_ns).unwrap_or(0);
        let config = session.rig_config.clone().into_bytes();
        Ok(Preamble {
            schemas: Schema::records(!session.motion.is_empty(), !session.signals.is_empty()),
            channels,
            metadata: vec![(SESSION_METADATA.to_owned(), facts.map(|(k, v)| (k.to_owned(), v)).into())],
            attachments: vec![(time, RIG_ATTACHMENT.to_owned(), "application/toml".to_owned(), config)],
        })
    }
}

/// Checks a batch of `n` samples under this header, where a batch has `most` at most; the error in words.
pub(crate) fn check_batch(header: &FrameHeader, n: usize, most: u32) -> Result<(), String> {
    let FrameHeader { width, height, stride, payload_len, format, .. } = *header;
    if PixelFormat::from_code(format) != Some(PixelFormat::Motion) {
        return Err(format!("its format is {format}, motion is {}", PixelFormat::Motion as u32));
    }
    if n == 0 || width as usize != n || height != 1 || width > most {
        return Err(format!(
            "its header says {width} x {height} samples, {n} are there, the session announced at most {most}"
        ));
    }
    let bytes = u64::from(width) * MOTION_SAMPLE_BYTES as u64;
    if u64::from(payload_len) != bytes || u64::from(stride) != bytes {
        return Err(format!(
            "{n} samples are {bytes} bytes, its header says {payload_len} in rows of {stride}"
        ));
    }
    Ok(())
}

/// The three channels of an IMU.
fn unit_channels(rig: &str, unit: &MotionRecord, u: &Unit) -> [Channel; 3] {
    let facts = [
        ("stream", u.name.clone()),
        ("model", unit.model.clone()),
        ("serial", unit.serial.clone()),
        ("format", PixelFormat::Motion.name().to_owned()),
        ("rate_hz", unit.rate_hz.to_string()),
        ("batch", unit.batch.to_string()),
        ("frame_id", u.frame_id.clone()),
        ("parent_frame_id", mount_frame(rig)),
        ("calibration", unit.calibration.clone()),
    ];
    let mut metadata: BTreeMap<_, _> = facts.map(|(k, v)| (k.to_owned(), v)).into();
    metadata.extend([qos(false)]);
    let mut id = u.channel;
    let topics =
        [("frame_info", Schema::FrameInfo), ("samples", Schema::MotionSamples), ("data_raw", Schema::Imu)];
    topics.map(|(name, schema)| {
        let topic = format!("/{rig}/{}/{}/{name}", unit.id.camera, unit.id.stream);
        let channel = Channel { id, schema: schema.id(), topic, metadata: metadata.clone() };
        id += 1;
        channel
    })
}

/// The two channels of a signal.
fn signal_channels(rig: &str, signal: &SignalRecord, id: u16) -> [Channel; 2] {
    let description = &signal.description;
    let form = SignalForm::of(description);
    let facts = [
        ("stream", signal.id.to_string()),
        ("kind", description.kind().name().to_owned()),
        ("frame_id", description.frame().to_owned()),
        ("description", description.json().to_owned()),
    ];
    let mut metadata: BTreeMap<_, _> = facts.map(|(k, v)| (k.to_owned(), v)).into();
    metadata.extend([qos(false)]);
    let topic = |name| format!("/{rig}/{}/{}/{name}", signal.id.camera, signal.id.stream);
    let channel = |id, schema: Schema, name| Channel {
        id,
        schema: schema.id(),
        topic: topic(name),
        metadata: metadata.clone(),
    };
    [channel(id, Schema::SignalSamples, "samples"), channel(id + 1, form.schema(), form.topic())]
}

/// The QoS profile that profile `ros2` demands, as rosbag2 writes it: keep the last ten, reliable, volatile;
/// or transient local, which delivers `/tf_static` to late joiners.
fn qos(latched: bool) -> (String, String) {
    let durability = if latched { 1 } else { 2 };
    let forever = "\n    sec: 9223372036\n    nsec: 854775807\n";
    (
        "offered_qos_profiles".to_owned(),
        format!(
            "- history: 1\n  depth: 10\n  reliability: 1\n  durability: {durability}\n  deadline:{forever}  \
             lifespan:{forever}  liveliness: 1\n  liveliness_lease_duration:{forever}  \
             avoid_ros_namespace_conventions: false\n"
        ),
    )
}
