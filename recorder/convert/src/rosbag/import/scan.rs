//! The first pass: what streams, frames and facts are in the bag.

use crate::rosbag::bag::{Message, Place};
use crate::rosbag::messages::{Transform, camera_info, float, image, key_value, stream_rate, transform};
use depthrig_bus::{Intrinsics, PixelFormat};
use std::collections::BTreeMap;

/// Frames that are imported from one bag: three weeks at 30 Hz with two streams.
const FRAMES_MAX: usize = 100_000_000;

/// Facts about one frame in the bag.
#[derive(Debug, Clone, Default)]
pub(super) struct Frame {
    pub(super) place: Option<Place>,
    /// Time of its messages in the bag.
    pub(super) bag_ns: i64,
    pub(super) stamp_ns: i64,
    pub(super) counter: Option<u64>,
    pub(super) sensor_us: Option<u64>,
    pub(super) sent_us: Option<u64>,
    pub(super) arrival_ns: Option<i64>,
    pub(super) exposure_us: Option<u64>,
    pub(super) gain: Option<f32>,
    /// Whether its stamp is of the host's clock, where the bag says it.
    pub(super) host_clock: Option<bool>,
    /// Filled in when the clocks are mapped.
    pub(super) capture_ns: i64,
    pub(super) device_us: u64,
    pub(super) uncertainty_ns: u64,
}

/// Content under a topic's prefix `/device_D/sensor_S/Stream_I`.
#[derive(Default)]
pub(super) struct FoundStream {
    pub(super) frames: Vec<Frame>,
    pub(super) size: Option<(u32, u32)>,
    pub(super) format: Option<PixelFormat>,
    pub(super) info: Option<(u32, u32, Intrinsics)>,
    pub(super) to_color: Option<Transform>,
    pub(super) rate_hz: f64,
    pub(super) refused: Option<Refused>,
}

/// Images that cannot be imported.
pub(super) struct Refused {
    pub(super) images: u64,
    /// Description of the first of them.
    pub(super) first: String,
}

/// The first pass.
#[derive(Default)]
pub(super) struct Scan {
    pub(super) streams: BTreeMap<Key, FoundStream>,
    /// Key and value of each device.
    pub(super) devices: BTreeMap<u32, BTreeMap<String, String>>,
    /// Option and value of each sensor, the last one.
    pub(super) options: BTreeMap<(u32, u32), BTreeMap<String, f32>>,
    pub(super) topics: usize,
    pub(super) others: BTreeMap<String, u64>,
}

/// Device, sensor, kind of stream, index.
pub(super) type Key = (u32, u32, String, u32);

/// The parts of a topic of librealsense.
enum Topic<'a> {
    Stream(Key, &'a str),
    Device(u32, &'a str),
    Sensor(u32, u32, &'a str),
}

fn topic(text: &str) -> Option<Topic<'_>> {
    let (device, rest) = text.strip_prefix("/device_")?.split_once('/')?;
    let device = device.parse().ok()?;
    let Some(rest) = rest.strip_prefix("sensor_") else { return Some(Topic::Device(device, rest)) };
    let (sensor, rest) = rest.split_once('/')?;
    let sensor = sensor.parse().ok()?;
    if let Some((stream, what)) = rest.split_once('/')
        && let Some((kind, index)) = stream.rsplit_once('_')
        && let Ok(index) = index.parse()
    {
        return Some(Topic::Stream((device, sensor, kind.to_owned(), index), what));
    }
    Some(Topic::Sensor(device, sensor, rest))
}

impl Scan {
    pub(super) fn message(&mut self, m: &Message<'_>) {
        self.topics += 1;
        match topic(&m.connection.topic) {
            Some(Topic::Stream(key, what)) => self.of_stream(key, what, m),
            Some(Topic::Device(device, "info")) => {
                if let Some((k, v)) = key_value(m.data) {
                    self.devices.entry(device).or_default().insert(k.to_owned(), v.to_owned());
                }
            }
            Some(Topic::Sensor(device, sensor, what)) => {
                let option = what.strip_prefix("option/").and_then(|o| o.strip_suffix("/value"));
                if let (Some(option), Some(v)) = (option, float(m.data)) {
                    self.options.entry((device, sensor)).or_default().insert(option.to_owned(), v);
                }
            }
            _ => {}
        }
    }

    fn of_stream(&mut self, key: Key, what: &str, m: &Message<'_>) {
        let depth = key.2 == "Depth";
        let found = self.streams.entry(key).or_default();
        match what {
            "info" => found.rate_hz = f64::from(stream_rate(m.data).unwrap_or(0)),
            "info/camera_info" => found.info = camera_info(m.data),
            "tf/0" => found.to_color = transform(m.data),
            "image/data" => match image(m.data) {
                Some(i) => match i.format(depth).filter(|_| !i.big_endian) {
                    Some(format) if found.frames.len() < FRAMES_MAX => {
                        found.format.get_or_insert(format);
                        found.size.get_or_insert((i.width, i.height));
                        let place = Some(m.place);
                        let bag_ns = m.time_ns;
                        found.frames.push(Frame { place, bag_ns, stamp_ns: i.stamp_ns, ..Frame::default() });
                    }
                    _ => found.refuse(|| format!("{}x{} {} pixels", i.width, i.height, i.encoding)),
                },
                None => found.refuse(|| "an image that ends too early".to_owned()),
            },
            "image/metadata" => {
                // Written after the image, with the image's time.
                if let (Some(frame), Some((k, v))) = (found.frames.last_mut(), key_value(m.data))
                    && frame.bag_ns == m.time_ns
                {
                    frame.learn(k, v);
                }
            }
            _ if what.starts_with("imu/") || what.starts_with("pose/") => {
                *self.others.entry(m.connection.topic.clone()).or_default() += 1;
            }
            _ => {}
        }
    }
}

impl FoundStream {
    /// Counts an image that cannot be imported; `what` it is, is asked of the first one.
    fn refuse(&mut self, what: impl FnOnce() -> String) {
        self.refused.get_or_insert_with(|| Refused { images: 0, first: what() }).images += 1;
    }
}

impl Frame {
    /// The device's count, microseconds.
    pub(super) fn counted_us(&self) -> Option<u64> {
        self.sensor_us.or(self.sent_us)
    }

    /// The device's count, or without one the image's stamp, microseconds.
    pub(super) fn raw_us(&self) -> u64 {
        self.counted_us().unwrap_or_else(|| self.stamp_ns.max(0).unsigned_abs() / 1000)
    }

    /// The time of the device, nanoseconds.
    pub(super) fn device_ns(&self) -> i64 {
        i64::try_from(self.device_us).unwrap_or(0).saturating_mul(1000)
    }

    fn learn(&mut self, key: &str, value: &str) {
        let whole = || value.parse::<u64>().ok();
        match key {
            "Frame Counter" => self.counter = whole(),
            "Sensor Timestamp" => self.sensor_us = whole(),
            "Frame Timestamp" => self.sent_us = whole(),
            "Actual Exposure" => self.exposure_us = whole(),
            "Gain Level" => self.gain = value.parse().ok(),
            // The same moment twice: to the microsecond, and to the millisecond.
            "system_time" => self.arrival_ns = milliseconds(value),
            "Time Of Arrival" if self.arrival_ns.is_none() => self.arrival_ns = milliseconds(value),
            "timestamp_domain" => self.host_clock = Some(value != "Hardware Clock"),
            _ => {}
        }
    }
}

/// Nanoseconds of a decimal number of milliseconds, exactly: `f64` would lose the last digits.
fn milliseconds(text: &str) -> Option<i64> {
    let (whole, part) = text.split_once('.').unwrap_or((text, ""));
    let whole: i64 = whole.parse().ok()?;
    let digits: String = part.chars().chain(std::iter::repeat('0')).take(6).collect();
    let part: i64 = digits.parse().ok()?;
    whole.checked_mul(1_000_000)?.checked_add(part)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn milliseconds_are_exact() {
        assert_eq!(milliseconds("1534232519732.935547"), Some(1_534_232_519_732_935_547));
        assert_eq!(milliseconds("1534232519732"), Some(1_534_232_519_732_000_000));
        assert_eq!(milliseconds("1.5"), Some(1_500_000));
        for bad in ["", "x", "1.x", "99999999999999999999", "9223372036854775807"] {
            assert_eq!(milliseconds(bad), None, "{bad}");
        }
    }
}
