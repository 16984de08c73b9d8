//! From the modes of a camera's nodes to the profiles that it offers, the default first.

use super::config::{MjpegChoice, V4l2Config};
use super::node::Mode;
use depthrig_bus::{ClockDomain, Intrinsics, MetadataLevel, PixelFormat, Pose, StreamName};
use depthrig_driver::{DeviceClock, StreamProfile};
use depthrig_usb::uvc::formats::FourCc;

/// A profile, and the node and mode that give it.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Offer {
    pub(super) profile: StreamProfile,
    pub(super) node: usize,
    pub(super) mode: Mode,
}

/// The formats that are offered, in the order in which one is chosen when the rig names none. A decoded image comes
/// before a grey one, and before both what needs no decoding.
const PREFERRED: [FourCc; 8] = [
    FourCc::Z16,
    FourCc::YUYV,
    FourCc::UYVY,
    FourCc::NV12,
    FourCc::MJPG,
    FourCc::JPEG,
    FourCc::Y16,
    FourCc::GREY,
];

/// Pixel format in which an image of `format` is delivered; `None` if unsupported.
pub(super) fn delivered(format: FourCc, mjpeg: MjpegChoice) -> Option<PixelFormat> {
    match format.pixel_format().filter(|_| PREFERRED.contains(&format)) {
        Some(PixelFormat::Mjpeg) if mjpeg == MjpegChoice::Decode => Some(PixelFormat::Rgb8),
        other => other,
    }
}

/// Whether a node's images are of any use to us.
pub(super) fn is_offered(format: FourCc) -> bool {
    PREFERRED.contains(&format)
}

/// A clock of the kernel: host time in nanoseconds.
pub(super) const fn kernel_clock(domain: ClockDomain) -> DeviceClock {
    DeviceClock { counter_bits: 64, tick_ps: 1000, domain }
}

/// Everything that the nodes with these modes can deliver. Nodes are streams: `depth` is one with depth, `ir` one with
/// nothing but grey, `color` any other; a second of a kind is `color_2`, and so on.
pub(super) fn offers(nodes: &[Vec<Mode>], config: &V4l2Config) -> Vec<Offer> {
    let mut all = Vec::new();
    let mut kinds: Vec<&str> = Vec::new();
    for (node, modes) in nodes.iter().enumerate() {
        let mut modes: Vec<Mode> = modes.iter().filter(|m| is_offered(m.format)).copied().collect();
        modes.sort_by(|a, b| rank(a).partial_cmp(&rank(b)).unwrap_or(core::cmp::Ordering::Equal));
        modes.dedup();
        if modes.is_empty() {
            continue;
        }
        let kind = kind_of(&modes);
        kinds.push(kind);
        let number = kinds.iter().filter(|k| **k == kind).count();
        let name = if number == 1 { kind.to_owned() } else { format!("{kind}_{number}") };
        let Ok(stream) = StreamName::new(name) else { continue };
        for mode in modes {
            let Some(format) = delivered(mode.format, config.mjpeg) else { continue };
            let profile = StreamProfile {
                intrinsics: intrinsics(config, &stream, mode.width, mode.height),
                stream: stream.clone(),
                format,
                width: mode.width,
                height: mode.height,
                // As many digits as a rig file has: 333333 / 10000000 s is 30 Hz.
                rate_hz: (mode.interval.rate_hz() * 1000.0).round() / 1000.0,
                depth_unit_m: if format.is_depth() { config.depth_unit_m } else { 0.0 },
                pose_in_device: Pose::IDENTITY,
                clock: kernel_clock(ClockDomain::Kernel),
                // As long as the transport's counter, which is unwrapped.
                sequence_bits: 64,
                metadata: MetadataLevel::Kernel,
            };
            all.push(Offer { profile, node, mode });
        }
    }
    all
}

fn kind_of(modes: &[Mode]) -> &'static str {
    let grey = |m: &Mode| matches!(m.format, FourCc::GREY | FourCc::Y16);
    if modes.iter().any(|m| m.format == FourCc::Z16) {
        "depth"
    } else if modes.iter().all(grey) {
        "ir"
    } else {
        "color"
    }
}

/// Format first, then rates near 30 Hz, then the largest size up to 1280x720, then the smallest above.
fn rank(m: &Mode) -> (usize, f64, bool, i64) {
    let format = PREFERRED.iter().position(|f| *f == m.format).unwrap_or(PREFERRED.len());
    let pixels = i64::from(m.width) * i64::from(m.height);
    let large = pixels > 1280 * 720;
    let from_thirty = (m.interval.rate_hz() - 30.0).abs().round();
    (format, from_thirty, large, if large { pixels } else { -pixels })
}

fn intrinsics(config: &V4l2Config, stream: &StreamName, width: u32, height: u32) -> Intrinsics {
    let given =
        config.intrinsics.iter().find(|g| g.stream == *stream && (g.width, g.height) == (width, height));
    given.map(|g| g.intrinsics).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Interval;
    use crate::config::GivenIntrinsics;

    fn mode(format: FourCc, width: u32, height: u32, hz: u32) -> Mode {
        Mode { format, width, height, interval: Interval { numerator: 1, denominator: hz } }
    }

    fn webcam() -> Vec<Mode> {
        vec![
            mode(FourCc::MJPG, 1920, 1080, 30),
            mode(FourCc::YUYV, 1920, 1080, 5),
            mode(FourCc::YUYV, 640, 480, 15),
            mode(FourCc::YUYV, 640, 480, 30),
            mode(FourCc::YUYV, 320, 240, 30),
            mode(FourCc(*b"H264"), 1920, 1080, 30),
        ]
    }

    #[test]
    fn the_default_is_an_unpacked_mode_at_thirty() {
        let all = offers(&[webcam()], &V4l2Config::default());
        assert_eq!(all[0].profile.describe(), "color 640x480 yuyv 30 Hz");
        assert_eq!(all.len(), 5, "H.264 is not offered");
        assert_eq!(all[4].profile.describe(), "color 1920x1080 rgb8 30 Hz");
        let kept = offers(&[webcam()], &V4l2Config { mjpeg: MjpegChoice::Keep, ..V4l2Config::default() });
        assert_eq!(kept[4].profile.describe(), "color 1920x1080 mjpeg 30 Hz");
    }

    #[test]
    fn nodes_are_named_by_what_they_give() {
        let nodes = [
            vec![mode(FourCc::GREY, 640, 480, 30), mode(FourCc::Z16, 640, 480, 30)],
            vec![mode(FourCc::GREY, 640, 480, 30)],
            webcam(),
            vec![mode(FourCc(*b"H264"), 640, 480, 30)],
            webcam(),
        ];
        let all = offers(&nodes, &V4l2Config { depth_unit_m: 0.000_25, ..V4l2Config::default() });
        let mut names: Vec<_> = all.iter().map(|o| (o.node, o.profile.stream.to_string())).collect();
        names.dedup();
        let names: Vec<_> = names.iter().map(|(n, s)| (*n, s.as_str())).collect();
        assert_eq!(names, [(0, "depth"), (1, "ir"), (2, "color"), (4, "color_2")]);
        assert_eq!((all[0].profile.format, all[0].profile.depth_unit_m), (PixelFormat::Z16, 0.000_25));
        assert_eq!(all[1].profile.depth_unit_m, 0.0, "grey of a depth node");
    }

    #[test]
    fn a_rate_of_a_usb_camera_is_a_round_number() {
        let ntsc = Mode {
            interval: Interval { numerator: 333_333, denominator: 10_000_000 },
            ..mode(FourCc::YUYV, 640, 480, 1)
        };
        assert_eq!(offers(&[vec![ntsc]], &V4l2Config::default())[0].profile.rate_hz, 30.0);
    }

    #[test]
    fn intrinsics_belong_to_one_size() {
        let given = GivenIntrinsics {
            stream: StreamName::new("color").unwrap(),
            width: 640,
            height: 480,
            intrinsics: Intrinsics::pinhole(500.0, 501.0, 320.0, 240.0),
        };
        let config = V4l2Config { intrinsics: vec![given], ..V4l2Config::default() };
        for o in offers(&[webcam()], &config) {
            assert_eq!(o.profile.intrinsics.is_known(), o.profile.width == 640, "{}", o.profile.describe());
        }
    }
}
