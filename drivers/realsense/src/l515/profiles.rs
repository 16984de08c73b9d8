//! From the modes of an L515's descriptors to its streams, and from chosen streams to what has to be started.
//!
//! `depth`, `ir` and `confidence` come turned, so a mode of 480x640 is an image of 640x480. They share the sensor's
//! frame and rate. Depth and confidence are computed with the infrared image: the camera sends them right only while
//! infrared is streamed too, so it is started with them even if it is not requested, and then discarded.

use crate::account::Account;
use crate::profiles::{Plan, completed};
use crate::protocol::hwm::HardwareMonitor;
use crate::protocol::l515::{ColorExtrinsics, ColorIntrinsics, DepthIntrinsics};
use crate::stream::Unpack;
use crate::transport::{Mode, Sensor};
use depthrig_bus::{MetadataLevel, Name, PixelFormat, Pose, StreamName};
use depthrig_driver::{DeviceClock, Error, ErrorKind, Result, StreamProfile, StreamRequest, choose_profiles};

/// The streams in the order in which they are listed, with the size that is taken when none is asked for.
const STREAMS: [(&str, Sensor, (u32, u32)); 4] = [
    ("depth", Sensor::Depth, (640, 480)),
    ("color", Sensor::Color, (1280, 720)),
    ("ir", Sensor::Infrared, (640, 480)),
    ("confidence", Sensor::Confidence, (640, 480)),
];

/// The factory calibration.
#[derive(Debug, Clone)]
pub(super) struct Tables {
    pub(super) depth: DepthIntrinsics,
    pub(super) color: ColorIntrinsics,
    pub(super) color_in_depth: Pose,
    pub(super) depth_unit_m: f64,
}

impl Tables {
    /// Reads all of it from a camera.
    ///
    /// # Errors
    /// [`ErrorKind::Protocol`] when a table is damaged; those of the hardware monitor.
    pub(super) fn read(monitor: &mut dyn HardwareMonitor) -> Result<Self> {
        let depth = DepthIntrinsics::read(monitor)?;
        let depth_unit_m = depth.unit_m()?;
        let color = ColorIntrinsics::read(monitor)?;
        let color_in_depth = ColorExtrinsics::read(monitor)?.color_in_depth()?;
        Ok(Self { depth, color, color_in_depth, depth_unit_m })
    }
}

/// The delivered format and size of a mode, and how to unpack it.
fn made_of(mode: &Mode) -> Option<(PixelFormat, (u32, u32), Unpack)> {
    let w = mode.width;
    let h = mode.height;
    Some(match (mode.sensor, &mode.fourcc) {
        (Sensor::Depth, b"Z16 ") => (PixelFormat::Z16, (h, w), Unpack::Turn16(w as usize)),
        (Sensor::Infrared, b"GREY") => (PixelFormat::Mono8, (h, w), Unpack::Turn8(w as usize)),
        // Its pixels are bytes with two pixels of the image, one below the other.
        (Sensor::Confidence, b"CNF4") => {
            (PixelFormat::Confidence8, (h, w.checked_mul(2)?), Unpack::Confidence(w as usize))
        }
        (Sensor::Color, b"YUYV") => (PixelFormat::Yuyv, (w, h), Unpack::Copy),
        (Sensor::Color, b"NV12") => (PixelFormat::Nv12, (w, h), Unpack::Y411(w as usize)),
        _ => return None,
    })
}

/// Every mode of every stream, each stream's default first: its size at 30 Hz, YUYV before NV12. A size that the
/// calibration says nothing about is not offered.
///
/// # Errors
/// [`ErrorKind::Protocol`] when nothing is left.
pub(super) fn offered(tables: &Tables, modes: &[Mode]) -> Result<Vec<StreamProfile>> {
    let mut all: Vec<StreamProfile> = Vec::new();
    for (name, sensor, preferred) in STREAMS {
        let mut of_stream = Vec::new();
        for mode in modes.iter().filter(|m| m.sensor == sensor) {
            let Some((format, (width, height), _)) = made_of(mode) else { continue };
            let (intrinsics, pose_in_device) = match sensor {
                Sensor::Color => (tables.color.at(width, height), tables.color_in_depth),
                _ => (tables.depth.at(width, height), Pose::IDENTITY),
            };
            let Ok(intrinsics) = intrinsics else { continue };
            of_stream.push(StreamProfile {
                stream: stream_name(name)?,
                format,
                width,
                height,
                rate_hz: mode.rate_hz,
                depth_unit_m: if format == PixelFormat::Z16 { tables.depth_unit_m } else { 0.0 },
                intrinsics,
                pose_in_device,
                clock: DeviceClock::microseconds(32),
                sequence_bits: Account::sequence_bits(MetadataLevel::Full),
                metadata: MetadataLevel::Full,
            });
        }
        of_stream.sort_by_key(|p| {
            let other = ((p.width, p.height) != preferred, (p.rate_hz - 30.0).abs() > 0.01);
            (other, p.format == PixelFormat::Nv12)
        });
        all.append(&mut of_stream);
    }
    if all.is_empty() {
        let text = "it offers no mode that its calibration knows; restart it, or try another USB 3 port";
        return Err(Error::new(ErrorKind::Protocol, text));
    }
    Ok(all)
}

/// Chooses among `offered` and plans what has to be started.
///
/// # Errors
/// [`ErrorKind::Unsupported`] naming `label` and the modes there are, also when streams of the sensor are to have
/// different modes.
pub(super) fn plan(
    label: &str,
    offered: &[StreamProfile],
    modes: &[Mode],
    requests: &[StreamRequest],
) -> Result<(Vec<StreamProfile>, Plan)> {
    let unsupported = |text: String| Error::new(ErrorKind::Unsupported, format!("{label}: {text}"));
    let chosen = choose_profiles(label, offered, &completed(requests, offered)?)?;
    let mut plan = Plan { modes: Vec::new(), streams: Vec::new() };
    for p in &chosen {
        let fits = |m: &&Mode| {
            let sensor =
                STREAMS.iter().find(|(name, ..)| *name == p.stream.as_str()).map(|(_, sensor, _)| *sensor);
            let made = made_of(m).map(|(format, size, _)| (format, size));
            sensor == Some(m.sensor)
                && made == Some((p.format, (p.width, p.height)))
                && (m.rate_hz - p.rate_hz).abs() < 0.01
        };
        let mode =
            modes.iter().find(fits).ok_or_else(|| unsupported(format!("it has no {}", p.describe())))?;
        let (_, _, unpack) =
            made_of(mode).ok_or_else(|| unsupported(format!("it has no {}", p.describe())))?;
        plan.streams.push((plan.modes.len(), unpack));
        plan.modes.push(*mode);
    }
    let mut sensor = chosen.iter().filter(|p| p.stream.as_str() != "color");
    if let Some(first) = sensor.next() {
        let same = |p: &StreamProfile| {
            (p.width, p.height) == (first.width, first.height) && (p.rate_hz - first.rate_hz).abs() < 0.01
        };
        if !sensor.all(same) {
            let text = "depth, ir and confidence come from one sensor; give them the same size and rate";
            return Err(unsupported(text.into()));
        }
        if !plan.modes.iter().any(|m| m.sensor == Sensor::Infrared) {
            let goes_along = |m: &&Mode| {
                m.sensor == Sensor::Infrared
                    && made_of(m).is_some_and(|(_, size, _)| size == (first.width, first.height))
                    && (m.rate_hz - first.rate_hz).abs() < 0.01
            };
            let infrared = modes.iter().find(goes_along).ok_or_else(|| {
                unsupported(format!("it has no infrared that goes along with {}", first.describe()))
            })?;
            plan.modes.push(*infrared);
        }
    }
    Ok((chosen, plan))
}

fn stream_name(name: &str) -> Result<StreamName> {
    Name::new(name).map_err(|e| {
        Error::new(ErrorKind::BadInput, format!("the stream name \"{name}\" breaks the rule of names"))
            .with_source(e)
    })
}

#[cfg(test)]
mod tests;
