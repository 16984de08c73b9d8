//! From the modes of the device's descriptors to the streams that it offers, and from chosen streams to what has to be
//! started for them.
//!
//! `depth` is Z16, `color` YUYV or UYVY, `ir_left` the grey image of the left imager. With `ir_right` both imagers
//! come interleaved (Y8I) and are taken apart, so they have one mode. Y12I is not offered: it is not rectified and made
//! for the vendor's calibration tools.

use super::account::Account;
use super::calibration::{Calibration, Geometry, View};
use super::models::{Model, RATES_HZ, SIZES};
use super::stream::{Source, Unpack};
use super::transport::{HeaderPart, Mode, Sensor};
use depthrig_bus::{ClockDomain, MetadataLevel, Name, PixelFormat, StreamName};
use depthrig_driver::{DeviceClock, Error, ErrorKind, Result, StreamProfile, StreamRequest, choose_profiles};

/// The streams, in the order in which they are listed.
const STREAMS: [(&str, Sensor, View); 4] = [
    ("depth", Sensor::Depth, View::Left),
    ("color", Sensor::Color, View::Color),
    ("ir_left", Sensor::Infrared, View::Left),
    ("ir_right", Sensor::Infrared, View::Right),
];

/// The inputs for the profiles of a device.
pub(super) struct Basis<'a> {
    pub(super) model: &'a Model,
    pub(super) modes: &'a [Mode],
    pub(super) calibration: Option<&'a Calibration>,
    pub(super) depth_unit_m: f64,
}

/// Every mode of every stream, each stream's default first. A size that the calibration says nothing about is not
/// offered.
///
/// # Errors
/// [`ErrorKind::Protocol`] when nothing is left.
pub(super) fn offered(basis: &Basis<'_>) -> Result<Vec<StreamProfile>> {
    let mut all: Vec<StreamProfile> = Vec::new();
    for (name, sensor, view) in STREAMS {
        let stream = stream_name(name)?;
        let mut fitting: Vec<_> =
            basis.modes.iter().filter(|m| m.sensor == sensor && format_of(name, m).is_some()).collect();
        let preferred = if sensor == Sensor::Color { basis.model.color_size } else { basis.model.depth_size };
        fitting.sort_by_key(|m| (size_rank(m.width, m.height, preferred), rate_rank(m.rate_hz)));
        for mode in fitting {
            let Some(format) = format_of(name, mode) else { continue };
            let geometry = match basis.calibration {
                None => Geometry::UNKNOWN,
                Some(c) => match c.geometry(view, mode.width, mode.height) {
                    Ok(geometry) => geometry,
                    Err(_) => continue,
                },
            };
            let profile = StreamProfile {
                stream: stream.clone(),
                format,
                width: mode.width,
                height: mode.height,
                rate_hz: mode.rate_hz,
                depth_unit_m: if format == PixelFormat::Z16 { basis.depth_unit_m } else { 0.0 },
                intrinsics: geometry.intrinsics,
                pose_in_device: geometry.pose_in_device,
                clock: DeviceClock::microseconds(32),
                sequence_bits: Account::sequence_bits(MetadataLevel::Full),
                metadata: MetadataLevel::Full,
            };
            // The left imager has one mode for its own image and for the left half of both.
            if !all.iter().any(|p| p.describe() == profile.describe()) {
                all.push(profile);
            }
        }
    }
    if all.is_empty() {
        return Err(Error::new(
            ErrorKind::Protocol,
            "it offers no mode that can be used; write its firmware again with the vendor's tool",
        ));
    }
    Ok(all)
}

/// The requests with the gaps filled that the device itself fills: without any request depth and colour are started,
/// and the imagers follow depth, whose size and rate they share.
pub(super) fn completed(requests: &[StreamRequest], offered: &[StreamProfile]) -> Result<Vec<StreamRequest>> {
    if requests.is_empty() {
        let there = |name: &&str| offered.iter().any(|p| p.stream.as_str() == *name);
        return ["depth", "color"]
            .iter()
            .filter(|name| there(name))
            .map(|name| stream_name(name).map(StreamRequest::any))
            .collect();
    }
    let stereo = |r: &&StreamRequest| r.stream.as_str() != "color" && r.size.is_some();
    let size = requests.iter().find(stereo).and_then(|r| r.size);
    let paced = |r: &&StreamRequest| r.stream.as_str() != "color" && r.rate_hz.is_some();
    let rate_hz = requests.iter().find(paced).and_then(|r| r.rate_hz);
    Ok(requests
        .iter()
        .map(|r| match r.stream.as_str() {
            "color" => r.clone(),
            _ => StreamRequest { size: r.size.or(size), rate_hz: r.rate_hz.or(rate_hz), ..r.clone() },
        })
        .collect())
}

/// The modes to start for the chosen streams; none by default.
#[derive(Debug, PartialEq, Default)]
pub(super) struct Plan {
    /// One mode for each sensor.
    pub(super) modes: Vec<Mode>,
    /// For each chosen profile the index of its mode, and how it is made from it.
    pub(super) streams: Vec<(usize, Unpack)>,
}

/// Chooses among `offered` and plans what has to be started.
///
/// # Errors
/// [`ErrorKind::Unsupported`] naming `label` and the modes there are, also when the two imagers are to have two modes.
pub(super) fn plan(
    label: &str,
    offered: &[StreamProfile],
    modes: &[Mode],
    requests: &[StreamRequest],
) -> Result<(Vec<StreamProfile>, Plan)> {
    let chosen = choose_profiles(label, offered, &completed(requests, offered)?)?;
    let both = chosen.iter().any(|p| p.stream.as_str() == "ir_right");
    let mut plan = Plan { modes: Vec::new(), streams: Vec::new() };
    for p in &chosen {
        let (_, sensor, _) = STREAMS
            .into_iter()
            .find(|(name, ..)| *name == p.stream.as_str())
            .ok_or_else(|| unsupported(format!("{label} has no stream \"{}\"", p.stream)))?;
        let fits = |m: &&Mode| {
            m.sensor == sensor
                && (m.width, m.height) == (p.width, p.height)
                && (m.rate_hz - p.rate_hz).abs() < 0.01
                && format_of(p.stream.as_str(), m) == Some(p.format)
                && !(sensor == Sensor::Infrared && both && m.fourcc != *b"Y8I ")
        };
        // Of the left imager alone its own image is half the bytes.
        let mode = modes.iter().filter(fits).min_by_key(|m| m.wire_bytes()).ok_or_else(|| {
            unsupported(format!("{label} cannot send {} together with the right imager", p.describe()))
        })?;
        let at = if let Some(at) = plan.modes.iter().position(|m| m.sensor == sensor) {
            at
        } else {
            plan.modes.push(*mode);
            plan.modes.len() - 1
        };
        if plan.modes.get(at) != Some(mode) {
            return Err(unsupported(format!(
                "{label}: ir_left and ir_right are two halves of one image; give them the same size and rate"
            )));
        }
        let unpack = match (&mode.fourcc, p.stream.as_str()) {
            (b"Y8I ", "ir_right") => Unpack::Right,
            (b"Y8I ", _) => Unpack::Left,
            _ => Unpack::Copy,
        };
        plan.streams.push((at, unpack));
    }
    let pace = |sensor: Sensor| plan.modes.iter().find(|m| m.sensor == sensor);
    if let (Some(d), Some(i)) = (pace(Sensor::Depth), pace(Sensor::Infrared))
        && ((d.width, d.height) != (i.width, i.height) || (d.rate_hz - i.rate_hz).abs() > 0.01)
    {
        return Err(unsupported(format!(
            "{label}: depth and infrared come from the same imagers; give them the same size and rate"
        )));
    }
    Ok((chosen, plan))
}

/// Puts what was really granted of the header into the profiles, and makes the sources.
pub(super) fn granted(profiles: &mut [StreamProfile], plan: &Plan, headers: &[HeaderPart]) -> Vec<Source> {
    let level = |at: usize| match headers.get(at) {
        Some(HeaderPart::Whole) => MetadataLevel::Full,
        Some(HeaderPart::Standard) => MetadataLevel::Header,
        _ => MetadataLevel::Kernel,
    };
    for (p, (at, _)) in profiles.iter_mut().zip(&plan.streams) {
        p.metadata = level(*at);
        p.sequence_bits = Account::sequence_bits(p.metadata);
        if p.metadata == MetadataLevel::Kernel {
            p.clock = DeviceClock { counter_bits: 64, tick_ps: 1000, domain: ClockDomain::Kernel };
        }
    }
    let source = |(at, mode): (usize, &Mode)| Source {
        account: Account::new(level(at)),
        wire_bytes: mode.wire_bytes().unwrap_or(0),
    };
    plan.modes.iter().enumerate().map(source).collect()
}

/// The pixel format of stream `name` in `mode`; `None` if the mode cannot deliver it.
fn format_of(name: &str, mode: &Mode) -> Option<PixelFormat> {
    Some(match (name, &mode.fourcc) {
        ("depth", b"Z16 ") => PixelFormat::Z16,
        ("color", b"YUYV") => PixelFormat::Yuyv,
        ("color", b"UYVY") => PixelFormat::Uyvy,
        ("ir_left", b"GREY" | b"Y8I ") | ("ir_right", b"Y8I ") => PixelFormat::Mono8,
        _ => return None,
    })
}

fn size_rank(width: u32, height: u32, preferred: (u32, u32)) -> u32 {
    if (width, height) == preferred {
        return 0;
    }
    // Unlisted sizes come last, the smaller the later.
    let listed = SIZES.iter().position(|s| *s == (width, height)).map(|at| at as u32 + 1);
    listed.unwrap_or_else(|| u32::MAX - (width * height).min(u32::MAX / 2))
}

fn rate_rank(rate_hz: f64) -> u32 {
    let listed = RATES_HZ.iter().position(|r| (r - rate_hz).abs() < 0.01).map(|at| at as u32);
    listed.unwrap_or_else(|| 1000 + rate_hz as u32)
}

fn stream_name(name: &str) -> Result<StreamName> {
    Name::new(name).map_err(|e| {
        Error::new(ErrorKind::BadInput, format!("the stream name \"{name}\" breaks the rule of names"))
            .with_source(e)
    })
}

fn unsupported(text: String) -> Error {
    Error::new(ErrorKind::Unsupported, text)
}

#[cfg(test)]
mod tests;
