//! Description of one frame: a line of `frames.csv`, or a JSON object with the same names.

use crate::dataset::{DatasetFrame, DatasetSet};
use depthrig_bus::{FrameFlags, PixelFormat};
use serde::Serialize;

/// The columns of `frames.csv`.
pub(super) const COLUMNS: [&str; 25] = [
    "set",
    "tick_ns",
    "set_utc_ns",
    "stream",
    "file",
    "format",
    "width",
    "height",
    "depth_unit_m",
    "codec",
    "stored_bytes",
    "sequence",
    "device_sequence",
    "device_time",
    "device_tick_ns",
    "capture_time_ns",
    "capture_utc_ns",
    "capture_uncertainty_ns",
    "arrival_time_ns",
    "publish_time_ns",
    "exposure_ns",
    "gain",
    "temperature_c",
    "dropped",
    "flags",
];

/// One frame. Times end in `_ns`; `utc` ones count from 1970, the others are the host's `CLOCK_MONOTONIC`.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[non_exhaustive]
pub struct FrameRow {
    /// Id of its set.
    pub set: u64,
    /// The moment that the set stands for.
    pub tick_ns: i64,
    /// The same as UTC, made strictly increasing: the log time of the set's messages.
    pub set_utc_ns: i64,
    /// `camera/stream`.
    pub stream: String,
    /// The file of its image, below the folder of `frames.csv`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub file: Option<String>,
    /// Pixel format on the camera's channel.
    pub format: &'static str,
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Metres per unit of depth; 0 without depth.
    pub depth_unit_m: f64,
    /// How it is stored in the dataset.
    pub codec: &'static str,
    /// Bytes of the stored message.
    pub stored_bytes: u64,
    /// Number of the frame on its channel.
    pub sequence: u64,
    /// The device's own frame counter.
    pub device_sequence: u64,
    /// Raw device time, ticks.
    pub device_time: u64,
    /// Nanoseconds per tick of the device.
    pub device_tick_ns: f64,
    /// Middle of the exposure.
    pub capture_time_ns: i64,
    /// Middle of the exposure as UTC.
    pub capture_utc_ns: i64,
    /// The capture time is right within this much.
    pub capture_uncertainty_ns: u64,
    /// When the last byte of the frame had arrived.
    pub arrival_time_ns: i64,
    /// When the frame was published.
    pub publish_time_ns: i64,
    /// Exposure time; 0 when unknown.
    pub exposure_ns: u64,
    /// Sensor gain; 0 when unknown.
    pub gain: f32,
    /// Sensor temperature, °C.
    pub temperature_c: Option<f32>,
    /// Frames that the stream lost so far.
    pub dropped: u64,
    /// The header's flags, by name.
    pub flags: Vec<&'static str>,
}

impl FrameRow {
    pub(super) fn new(stream: String, set: &DatasetSet, frame: &DatasetFrame, file: Option<String>) -> Self {
        let h = &frame.header;
        let flags = FrameFlags::ALL.into_iter().filter(|(_, flag)| h.has(*flag)).map(|(name, _)| name);
        Self {
            set: set.id,
            tick_ns: set.tick.ns(),
            set_utc_ns: set.utc_ns,
            stream,
            file,
            format: h.pixel_format().map_or("unknown", PixelFormat::name),
            width: h.width,
            height: h.height,
            depth_unit_m: h.depth_unit_m,
            codec: frame.codec,
            stored_bytes: frame.stored_bytes,
            sequence: h.sequence,
            device_sequence: h.device_sequence,
            device_time: h.device_time,
            device_tick_ns: h.device_tick_ns,
            capture_time_ns: h.capture_time_ns,
            capture_utc_ns: h.capture_time_ns.saturating_add(set.utc_offset_ns),
            capture_uncertainty_ns: h.capture_uncertainty_ns,
            arrival_time_ns: h.arrival_time_ns,
            publish_time_ns: h.publish_time_ns,
            exposure_ns: h.exposure_ns,
            gain: h.gain,
            temperature_c: h.temperature_c.is_finite().then_some(h.temperature_c),
            dropped: h.drops().total(),
            flags: flags.collect(),
        }
    }

    /// The row as a line; no text in it can hold a comma or a quote.
    pub(super) fn csv(&self) -> String {
        let texts: [String; COLUMNS.len()] = [
            self.set.to_string(),
            self.tick_ns.to_string(),
            self.set_utc_ns.to_string(),
            self.stream.clone(),
            self.file.clone().unwrap_or_default(),
            self.format.to_owned(),
            self.width.to_string(),
            self.height.to_string(),
            self.depth_unit_m.to_string(),
            self.codec.to_owned(),
            self.stored_bytes.to_string(),
            self.sequence.to_string(),
            self.device_sequence.to_string(),
            self.device_time.to_string(),
            self.device_tick_ns.to_string(),
            self.capture_time_ns.to_string(),
            self.capture_utc_ns.to_string(),
            self.capture_uncertainty_ns.to_string(),
            self.arrival_time_ns.to_string(),
            self.publish_time_ns.to_string(),
            self.exposure_ns.to_string(),
            self.gain.to_string(),
            self.temperature_c.map_or_else(String::new, |t| t.to_string()),
            self.dropped.to_string(),
            self.flags.join("|"),
        ];
        texts.join(",")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use depthrig_bus::{FrameHeader, HostTime};

    #[test]
    fn a_line_and_json_say_the_same_under_the_same_names() {
        let mut header = FrameHeader {
            sequence: 3,
            device_sequence: 4,
            device_time: 5,
            gain: 1.5,
            ..FrameHeader::default()
        };
        header.set_image(PixelFormat::Z16, 6, 7);
        header.capture_time_ns = -8;
        header.capture_uncertainty_ns = 9;
        (header.arrival_time_ns, header.publish_time_ns, header.exposure_ns) = (10, 11, 12);
        (header.depth_unit_m, header.device_tick_ns, header.temperature_c) = (0.0001, 0.5, 21.5);
        header.dropped = [1, 0, 2, 0, 0, 0, 0, 0];
        header.flags = FrameFlags::REPLAYED.with(FrameFlags::LATE).0;
        let frame = DatasetFrame {
            stream: 0,
            header,
            codec: "raw",
            stored_bytes: 13,
            pixels: Vec::new(),
            stored: None,
            filter: None,
        };
        let set = DatasetSet {
            id: 14,
            tick: HostTime::from_ns(15),
            utc_ns: 16,
            utc_offset_ns: 17,
            spread_ns: 18,
            frames: Vec::new(),
            missing: Vec::new(),
            motion: Vec::new(),
            signals: Vec::new(),
        };
        let row = FrameRow::new("a/b".into(), &set, &frame, Some("a/b/000014.png".into()));
        let json = serde_json::to_value(&row).unwrap();
        let json = json.as_object().unwrap();
        assert_eq!(json.len(), COLUMNS.len());
        let line = row.csv();
        let texts: Vec<_> = line.split(',').collect();
        assert_eq!(texts.len(), COLUMNS.len());
        for (name, text) in COLUMNS.iter().zip(texts) {
            let value = match &json[*name] {
                serde_json::Value::String(s) => s.clone(),
                serde_json::Value::Array(flags) => {
                    flags.iter().map(|f| f.as_str().unwrap()).collect::<Vec<_>>().join("|")
                }
                number => number.to_string(),
            };
            assert_eq!(text, value, "{name}");
        }
        assert_eq!((row.capture_utc_ns, row.dropped, row.flags.len()), (9, 3, 2));
    }
}
