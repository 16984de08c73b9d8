//! The modes of an attached camera as streams: two of each, left and right.

use super::conf::FactoryCalibration;
use super::mode::{Mode as SensorMode, Side};
use depthrig_bus::{ClockDomain, Intrinsics, MetadataLevel, Name, PixelFormat, Pose, StreamName};
use depthrig_driver::motion::IMU;
use depthrig_driver::{DeviceClock, Error, ErrorKind, Result, StreamProfile, StreamRequest, choose_profiles};
use depthrig_v4l2::Mode;

/// Names of the streams, left first.
pub const STREAMS: [&str; 2] = ["left", "right"];

/// The name of the stream of `side`.
///
/// # Errors
/// None that can happen: the names are good ones.
pub fn stream_name(side: Side) -> Result<StreamName> {
    let name = STREAMS[usize::from(side == Side::Right)];
    Name::new(name).map_err(|e| Error::new(ErrorKind::BadInput, format!("stream {name}")).with_source(e))
}

/// The frames' times are the kernel's: the camera sends none that is known.
pub const fn clock(domain: ClockDomain) -> DeviceClock {
    DeviceClock { counter_bits: 64, tick_ps: 1000, domain }
}

/// The streams of `modes` (side by side, YUYV), the default mode first: HD720 at 30 Hz if there is one. Without a
/// calibration for a size, its intrinsics are unknown.
///
/// # Errors
/// [`ErrorKind::Protocol`] when the camera has no mode that can be halved.
pub fn profiles(
    device: &str,
    modes: &[Mode],
    calibration: Option<&FactoryCalibration>,
) -> Result<Vec<StreamProfile>> {
    // Pixels of YUYV come in pairs, so each image has an even number of columns.
    let mut usable: Vec<&Mode> =
        modes.iter().filter(|m| m.width > 0 && m.width.is_multiple_of(4) && m.height > 0).collect();
    let is_default = |m: &Mode| {
        (m.width, m.height) == SensorMode::Hd720.wire_size() && (m.interval.rate_hz() - 30.0).abs() < 0.01
    };
    usable.sort_by_key(|m| !is_default(m));
    if usable.is_empty() {
        let what = format!("{device}: lists no side-by-side YUYV mode; is it in recovery mode?");
        return Err(Error::new(ErrorKind::Protocol, what));
    }
    let mut profiles = Vec::new();
    for side in Side::BOTH {
        let stream = stream_name(side)?;
        for m in &usable {
            let width = m.width / 2;
            let height = m.height;
            let known = SensorMode::of_size(width, height).and_then(|mode| calibration?.at(mode));
            profiles.push(StreamProfile {
                stream: stream.clone(),
                format: PixelFormat::Yuyv,
                width,
                height,
                // As `StreamRequest` names rates: a thirtieth that comes as 333333 of ten millions is 30 Hz.
                rate_hz: (m.interval.rate_hz() * 100.0).round() / 100.0,
                depth_unit_m: 0.0,
                intrinsics: known.map_or_else(Intrinsics::default, |c| c.intrinsics(side)),
                pose_in_device: known.map_or(Pose::IDENTITY, |c| c.pose(side)),
                clock: clock(ClockDomain::Kernel),
                sequence_bits: 64,
                metadata: MetadataLevel::Kernel,
            });
        }
    }
    Ok(profiles)
}

/// The requested profiles. Both images arrive in one frame and so have one mode: a property that one of their
/// requests leaves open is taken from the other.
///
/// # Errors
/// [`ErrorKind::Unsupported`] if there is no such mode, or if the images are requested in different ones.
pub fn choose(
    device: &str,
    available: &[StreamProfile],
    requests: &[StreamRequest],
) -> Result<Vec<StreamProfile>> {
    let is_image = |r: &&StreamRequest| r.stream.as_str() != IMU;
    let size = requests.iter().filter(is_image).find_map(|r| r.size);
    let rate_hz = requests.iter().filter(is_image).find_map(|r| r.rate_hz);
    let fill = |r: &StreamRequest| StreamRequest {
        size: r.size.or(size),
        rate_hz: r.rate_hz.or(rate_hz),
        ..r.clone()
    };
    let filled: Vec<_> = requests.iter().map(|r| if is_image(&r) { fill(r) } else { r.clone() }).collect();
    let chosen = choose_profiles(device, available, &filled)?;
    let images: Vec<_> = chosen.iter().filter(|p| !p.format.is_motion()).collect();
    if let [a, b] = images.as_slice()
        && (a.width, a.height, a.rate_hz) != (b.width, b.height, b.rate_hz)
    {
        let what = format!(
            "{device}: left and right come in one frame and have one mode; requested were {} and {}",
            a.describe(),
            b.describe()
        );
        return Err(Error::new(ErrorKind::Unsupported, what));
    }
    Ok(chosen)
}

#[cfg(test)]
mod tests;
