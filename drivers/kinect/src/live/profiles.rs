//! The modes of a Kinect as streams, and which of them can run together.

use super::config::LiveConfig;
use super::ffi::DeviceConfiguration;
use crate::calibration::Calibration;
use crate::modes::{ColorFormat, ColorResolution, DepthMode, WiredSync};
use crate::motion;
use depthrig_bus::{Intrinsics, MetadataLevel, Name, PixelFormat, Pose, StreamName};
use depthrig_driver::motion::IMU;
use depthrig_driver::{DeviceClock, Error, ErrorKind, Result, StreamProfile, StreamRequest, choose_profiles};

/// Names of the streams.
pub const STREAMS: [&str; 4] = ["color", "depth", "ir", IMU];

/// Rates, with `k4a_fps_t`; the default first, as of the other depth cameras: it is enough for 5 sets a second, and
/// leaves room on the bus.
const RATES: [(u32, u32); 3] = [(15, 1), (30, 2), (5, 0)];

/// Depth modes, the default first.
const DEPTH_MODES: [DepthMode; 4] =
    [DepthMode::NfovUnbinned, DepthMode::Nfov2x2Binned, DepthMode::Wfov2x2Binned, DepthMode::WfovUnbinned];

/// How colour may be delivered, the default first, and what libk4a is asked for. YUYV and NV12 exist at 720p alone;
/// `bgr8` is JPEG that libk4a decodes.
const COLOR: [(PixelFormat, ColorFormat); 5] = [
    (PixelFormat::Yuyv, ColorFormat::Yuy2),
    (PixelFormat::Rgb8, ColorFormat::Mjpg),
    (PixelFormat::Mjpeg, ColorFormat::Mjpg),
    (PixelFormat::Nv12, ColorFormat::Nv12),
    (PixelFormat::Bgr8, ColorFormat::Bgra),
];

/// The plan of what to start.
#[derive(Debug, Clone)]
pub struct Plan {
    /// The streams, in the order that they were asked for.
    pub profiles: Vec<StreamProfile>,
    /// The configuration for libk4a.
    pub configuration: DeviceConfiguration,
}

/// Every mode of a camera with this calibration, that of each stream's default first. Without a calibration intrinsics
/// are unknown.
///
/// # Errors
/// None that can happen: the names are good ones.
pub fn profiles(config: &LiveConfig, calibration: Option<&Calibration>) -> Result<Vec<StreamProfile>> {
    let mut all = Vec::new();
    let [color, depth, ir, _] = STREAMS.map(stream_name);
    let color = color?;
    let depth = depth?;
    let ir = ir?;
    for resolution in ColorResolution::ALL {
        for (format, wire) in COLOR {
            let is_raw = matches!(wire, ColorFormat::Nv12 | ColorFormat::Yuy2);
            if is_raw && resolution != ColorResolution::P720 {
                continue;
            }
            let (width, height) = resolution.size();
            for (rate, _) in RATES.into_iter().filter(|(rate, _)| *rate <= resolution.max_rate_hz()) {
                all.push(StreamProfile {
                    intrinsics: calibration
                        .map_or_else(Intrinsics::default, |c| c.color_intrinsics(resolution)),
                    pose_in_device: calibration.map_or(Pose::IDENTITY, Calibration::color_in_device),
                    ..profile(color.clone(), format, width, height, rate)
                });
            }
        }
    }
    // Infrared without depth is its own mode, which is asked for by name: its size is also that of another.
    let passive = config.depth_mode == Some(DepthMode::PassiveIr);
    let modes = DEPTH_MODES.into_iter().filter(|m| config.depth_mode.is_none_or(|wanted| wanted == *m));
    let modes: Vec<_> = if passive { vec![DepthMode::PassiveIr] } else { modes.collect() };
    for (stream, format) in [(&depth, PixelFormat::Z16), (&ir, PixelFormat::Mono16)] {
        for mode in modes.iter().filter(|m| m.has_depth() || stream == &ir) {
            let (width, height) = mode.size();
            for (rate, _) in RATES.into_iter().filter(|(rate, _)| *rate <= mode.max_rate_hz()) {
                all.push(StreamProfile {
                    depth_unit_m: if format == PixelFormat::Z16 { 0.001 } else { 0.0 },
                    intrinsics: calibration.map_or_else(Intrinsics::default, |c| c.depth_intrinsics(*mode)),
                    pose_in_device: calibration.map_or(Pose::IDENTITY, Calibration::depth_in_device),
                    ..profile(stream.clone(), format, width, height, rate)
                });
            }
        }
    }
    let clock = DeviceClock::microseconds(64);
    all.push(motion::profile(calibration, 1.0, clock, MetadataLevel::Full)?);
    Ok(all)
}

fn stream_name(name: &str) -> Result<StreamName> {
    Name::new(name).map_err(|e| Error::new(ErrorKind::BadInput, format!("stream {name}")).with_source(e))
}

fn profile(stream: StreamName, format: PixelFormat, width: u32, height: u32, rate_hz: u32) -> StreamProfile {
    StreamProfile {
        stream,
        format,
        width,
        height,
        rate_hz: f64::from(rate_hz),
        depth_unit_m: 0.0,
        intrinsics: Intrinsics::default(),
        pose_in_device: Pose::IDENTITY,
        clock: DeviceClock::microseconds(64),
        // Derived from the device's times: see `counter`.
        sequence_bits: 64,
        metadata: MetadataLevel::Full,
    }
}

/// Plans the streams for `requests`: all have one rate, depth and infrared one size; a request takes what it leaves
/// open from the others. `name` is the camera's, for messages. Without a request depth, colour and the IMU are started.
///
/// # Errors
/// [`ErrorKind::Unsupported`] when there is no such mode, when streams do not go together, and when the part in a wired
/// group cannot be played like this.
pub fn plan(
    name: &str,
    config: &LiveConfig,
    available: &[StreamProfile],
    requests: &[StreamRequest],
) -> Result<Plan> {
    let refuse = |what: String| Error::new(ErrorKind::Unsupported, format!("{name}: {what}"));
    let has = |stream: &str| available.iter().any(|p| p.stream.as_str() == stream);
    let default = || {
        let wanted = if has("depth") { ["color", "depth", IMU] } else { ["color", "ir", IMU] };
        wanted.into_iter().map(|s| stream_name(s).map(StreamRequest::any)).collect::<Result<Vec<_>>>()
    };
    let requests = if requests.is_empty() { default()? } else { requests.to_vec() };
    let order: Vec<_> = requests.iter().map(|r| r.stream.clone()).collect();
    // The IMU has a mode of its own.
    let (units, requests): (Vec<_>, Vec<_>) = requests.into_iter().partition(|r| r.stream.as_str() == IMU);
    let units = if units.is_empty() { Vec::new() } else { choose_profiles(name, available, &units)? };
    if requests.is_empty() {
        return Err(refuse(
            "the IMU runs only while a camera does: ask for color, depth or ir too".to_owned(),
        ));
    }
    let is_color = |r: &StreamRequest| r.stream.as_str() == "color";
    let rate_hz = requests.iter().find_map(|r| r.rate_hz);
    let size = requests.iter().filter(|r| !is_color(r)).find_map(|r| r.size);
    let mut wishes: Vec<_> = requests
        .into_iter()
        .map(|r| {
            let size = if is_color(&r) { r.size } else { r.size.or(size) };
            StreamRequest { rate_hz: r.rate_hz.or(rate_hz), size, ..r }
        })
        .collect();
    if rate_hz.is_none() {
        // The slowest default: 3072p and the unbinned wide view have no more than that.
        let first = choose_profiles(name, available, &wishes)?;
        let slowest = first.iter().map(|p| p.rate_hz).fold(f64::INFINITY, f64::min);
        for wish in &mut wishes {
            wish.rate_hz = Some(slowest);
        }
    }
    let mut profiles = choose_profiles(name, available, &wishes)?;
    let Some(first) = profiles.first() else { return Err(refuse("no stream was asked for".to_owned())) };
    if let Some(other) = profiles.iter().find(|p| p.rate_hz != first.rate_hz) {
        let a = first.describe();
        let b = other.describe();
        return Err(refuse(format!("its cameras have one rate; asked for {a} and {b}")));
    }
    let find = |stream: &str| profiles.iter().find(|p| p.stream.as_str() == stream);
    if let (Some(depth), Some(ir)) = (find("depth"), find("ir"))
        && (depth.width, depth.height) != (ir.width, ir.height)
    {
        let a = depth.describe();
        let b = ir.describe();
        return Err(refuse(format!("depth and infrared come from one sensor; asked for {a} and {b}")));
    }
    let period_us = 1_000_000 / first.rate_hz as u32;
    let configuration = configuration(config, find("color"), find("depth").or(find("ir")), first.rate_hz)
        .ok_or_else(|| refuse("it has no such mode".to_owned()))?;
    check_sync(config, &configuration, period_us).map_err(refuse)?;
    profiles.extend(units);
    profiles.sort_by_key(|p| order.iter().position(|s| *s == p.stream));
    Ok(Plan { profiles, configuration })
}

fn configuration(
    config: &LiveConfig,
    color: Option<&StreamProfile>,
    depth: Option<&StreamProfile>,
    rate_hz: f64,
) -> Option<DeviceConfiguration> {
    let (color_format, color_resolution) = match color {
        None => (ColorFormat::Mjpg.code(), 0),
        Some(p) => {
            let (_, wire) = COLOR.into_iter().find(|(format, _)| *format == p.format)?;
            (wire.code(), ColorResolution::from_size(p.width, p.height)?.code())
        }
    };
    let depth_mode = match depth {
        None => 0,
        Some(_) if config.depth_mode == Some(DepthMode::PassiveIr) => DepthMode::PassiveIr.code(),
        Some(p) => DEPTH_MODES.into_iter().find(|m| m.size() == (p.width, p.height))?.code(),
    };
    let (_, camera_fps) = RATES.into_iter().find(|(rate, _)| f64::from(*rate) == rate_hz)?;
    Some(DeviceConfiguration {
        color_format,
        color_resolution,
        depth_mode,
        camera_fps,
        // Sets are formed by their consumers; an image whose partner was lost is delivered.
        synchronized_images_only: false,
        depth_delay_off_color_usec: config.depth_delay_us,
        wired_sync_mode: config.sync.code(),
        subordinate_delay_off_master_usec: config.subordinate_delay_us,
        disable_streaming_indicator: config.dark,
    })
}

/// Refuses what libk4a would refuse without naming the key of the rig file (`k4a.c`, `validate_configuration`).
fn check_sync(
    config: &LiveConfig,
    started: &DeviceConfiguration,
    period_us: u32,
) -> core::result::Result<(), String> {
    let has_color = started.color_resolution != 0;
    let has_depth = started.depth_mode != 0;
    if config.sync == WiredSync::Master && !has_color {
        return Err("a master drives the others by its colour camera: add a color stream".to_owned());
    }
    if config.sync != WiredSync::Subordinate && config.subordinate_delay_us != 0 {
        return Err("subordinate_delay_us is for sync = \"subordinate\" alone".to_owned());
    }
    if config.subordinate_delay_us > period_us {
        return Err(format!(
            "subordinate_delay_us = {} is more than a period, {period_us}",
            config.subordinate_delay_us
        ));
    }
    if config.depth_delay_us != 0 && !(has_color && has_depth) {
        return Err("depth_delay_us is between colour and depth: ask for both".to_owned());
    }
    if config.depth_delay_us.unsigned_abs() > period_us {
        return Err(format!("depth_delay_us = {} is more than a period, {period_us}", config.depth_delay_us));
    }
    Ok(())
}

/// USB bandwidth of a Kinect's stream, bits a second: the depth camera sends raw phases, of which depth
/// and infrared are made on the host, and colour that is delivered decoded comes as JPEG.
pub fn wire_bits_per_s(profile: &StreamProfile, with_depth: bool) -> f64 {
    // Bytes of a raw frame: K4A `depth_mcu.h`, as listed for each sensor mode.
    let raw_bytes = match (profile.stream.as_str(), profile.width) {
        ("ir", _) if with_depth => 0.0,
        ("depth" | "ir", 512) => 3_777_232.0,
        // Passive infrared and the unbinned wide view have one size; this is the larger of both.
        ("depth" | "ir", 1024) => 9_438_664.0,
        ("depth" | "ir", _) => 5_310_760.0,
        (_, width) => {
            let bits = match profile.format {
                PixelFormat::Yuyv => 16.0,
                PixelFormat::Nv12 => 12.0,
                _ => 4.0,
            };
            f64::from(width) * f64::from(profile.height) * bits / 8.0
        }
    };
    raw_bytes * 8.0 * profile.rate_hz
}

#[cfg(test)]
mod tests;
