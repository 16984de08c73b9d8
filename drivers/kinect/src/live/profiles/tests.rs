//! Which modes there are and which go together.

use super::*;

fn available(config: &LiveConfig) -> Vec<StreamProfile> {
    profiles(config, None).unwrap()
}

fn wish(
    stream: &str,
    size: Option<(u32, u32)>,
    rate_hz: Option<f64>,
    format: Option<PixelFormat>,
) -> StreamRequest {
    StreamRequest { stream: Name::new(stream).unwrap(), size, rate_hz, format }
}

fn planned(config: &LiveConfig, requests: &[StreamRequest]) -> core::result::Result<Plan, String> {
    plan("kinect", config, &available(config), requests).map_err(|e| {
        assert_eq!(e.kind(), ErrorKind::Unsupported);
        e.to_string()
    })
}

fn described(plan: &Plan) -> Vec<String> {
    plan.profiles.iter().map(StreamProfile::describe).collect()
}

/// The IMU, which streams beside whatever else does unless it is not wished for.
const IMU: &str = "imu motion 1600 Hz in batches of up to 64";

#[test]
fn without_wishes_colour_depth_and_motion_start_at_15_hz() {
    let config = LiveConfig::default();
    let plan = planned(&config, &[]).unwrap();
    assert_eq!(described(&plan), ["color 1280x720 yuyv 15 Hz", "depth 640x576 z16 15 Hz", IMU]);
    let c = plan.configuration;
    assert_eq!((c.color_format, c.color_resolution, c.depth_mode, c.camera_fps), (2, 1, 2, 1));
    assert!(!c.synchronized_images_only && !c.disable_streaming_indicator);
    assert_eq!(
        (c.wired_sync_mode, c.depth_delay_off_color_usec, c.subordinate_delay_off_master_usec),
        (0, 0, 0)
    );
}

#[test]
fn what_one_leaves_open_it_takes_from_the_others() {
    let config = LiveConfig::default();
    let wide = wish("depth", Some((1024, 1024)), None, None);
    let plan = planned(
        &config,
        &[wish("ir", None, None, None), wide, wish("color", Some((1920, 1080)), None, None)],
    );
    let plan = plan.unwrap();
    assert_eq!(
        described(&plan),
        ["ir 1024x1024 mono16 15 Hz", "depth 1024x1024 z16 15 Hz", "color 1920x1080 rgb8 15 Hz"]
    );
    assert_eq!((plan.configuration.depth_mode, plan.configuration.color_resolution), (4, 2));
    let fast = [wish("color", None, Some(30.0), Some(PixelFormat::Mjpeg)), wish("depth", None, None, None)];
    let plan = planned(&config, &fast).unwrap();
    assert_eq!(described(&plan), ["color 1280x720 mjpeg 30 Hz", "depth 640x576 z16 30 Hz"]);
    assert_eq!((plan.configuration.color_format, plan.configuration.camera_fps), (0, 2));
    let alone =
        planned(&config, &[wish("color", Some((4096, 3072)), None, Some(PixelFormat::Bgr8))]).unwrap();
    let c = alone.configuration;
    assert_eq!((c.color_format, c.color_resolution, c.depth_mode), (3, 6, 0));
}

#[test]
fn what_does_not_go_together_is_refused() {
    let config = LiveConfig::default();
    let says = |requests: &[StreamRequest], part: &str| {
        let e = planned(&config, requests).unwrap_err();
        assert!(e.contains(part), "{e}");
    };
    says(&[wish("color", None, Some(30.0), None), wish("depth", None, Some(15.0), None)], "one rate");
    let small = Some((320, 288));
    let large = Some((512, 512));
    says(&[wish("depth", small, None, None), wish("ir", large, None, None)], "one sensor");
    says(&[wish("depth", Some((1024, 1024)), Some(30.0), None)], "depth 1024x1024 z16 15, 5 Hz");
    says(&[wish("color", Some((1920, 1080)), None, Some(PixelFormat::Nv12))], "color 1280x720 nv12");
    says(&[wish("left", None, None, None)], "left");
}

#[test]
fn passive_infrared_is_asked_for_by_name() {
    let config = LiveConfig { depth_mode: Some(DepthMode::PassiveIr), ..LiveConfig::default() };
    let plan = planned(&config, &[]).unwrap();
    assert_eq!(described(&plan), ["color 1280x720 yuyv 15 Hz", "ir 1024x1024 mono16 15 Hz", IMU]);
    assert_eq!(plan.configuration.depth_mode, 5);
    assert!(planned(&config, &[wish("depth", None, None, None)]).unwrap_err().contains("depth"));
    let fast = planned(&config, &[wish("ir", None, Some(30.0), None)]).unwrap();
    assert_eq!((fast.configuration.depth_mode, fast.configuration.color_resolution), (5, 0));
    let narrow = LiveConfig { depth_mode: Some(DepthMode::Nfov2x2Binned), ..LiveConfig::default() };
    assert_eq!(described(&planned(&narrow, &[]).unwrap())[1], "depth 320x288 z16 15 Hz");
}

#[test]
fn parts_in_a_wired_group_are_checked() {
    let (depth, both) =
        (wish("depth", None, None, None), [wish("color", None, None, None), wish("depth", None, None, None)]);
    let refused = |config: LiveConfig, requests: &[StreamRequest], part: &str| {
        let e = planned(&config, requests).unwrap_err();
        assert!(e.contains(part), "{e}");
    };
    let d = LiveConfig::default;
    let master = LiveConfig { sync: WiredSync::Master, ..d() };
    refused(master, core::slice::from_ref(&depth), "colour camera");
    refused(LiveConfig { subordinate_delay_us: 160, ..d() }, &both, "alone");
    let late = LiveConfig { sync: WiredSync::Subordinate, subordinate_delay_us: 66_667, ..d() };
    refused(late.clone(), &both, "more than a period, 66666");
    let ok = LiveConfig { subordinate_delay_us: 66_666, depth_delay_us: -66_666, ..late };
    let plan = planned(&ok, &both).unwrap();
    let c = plan.configuration;
    assert_eq!(
        (c.wired_sync_mode, c.subordinate_delay_off_master_usec, c.depth_delay_off_color_usec),
        (2, 66_666, -66_666)
    );
    refused(LiveConfig { depth_delay_us: 160, ..d() }, core::slice::from_ref(&depth), "ask for both");
    refused(LiveConfig { depth_delay_us: -66_667, ..d() }, &both, "more than a period");
}

#[test]
fn every_mode_can_be_started_alone() {
    let config = LiveConfig::default();
    let all = available(&config);
    let of = |stream: &str| all.iter().filter(|p| p.stream.as_str() == stream).count();
    // Three rates each, two where 30 Hz is too fast; five formats at 720p, else three.
    assert_eq!((of("depth"), of("ir"), of("color")), (3 * 3 + 2, 3 * 3 + 2, 5 * 3 + 4 * 3 * 3 + 3 * 2));
    let unit = all.iter().filter(|p| p.format.is_motion()).map(StreamProfile::describe).collect::<Vec<_>>();
    assert_eq!(unit, [IMU]);
    assert!(
        planned(&config, &[wish("imu", None, None, None)]).unwrap_err().contains("only while a camera does")
    );
    for p in all.iter().filter(|p| !p.format.is_motion()) {
        let one = wish(p.stream.as_str(), Some((p.width, p.height)), Some(p.rate_hz), Some(p.format));
        let plan = planned(&config, &[one]).unwrap();
        assert_eq!(described(&plan), [p.describe()]);
    }
}

#[test]
fn the_bus_carries_raw_phases() {
    let config = LiveConfig::default();
    let plan =
        planned(&config, &[wish("depth", None, Some(30.0), None), wish("ir", None, None, None)]).unwrap();
    let bits: Vec<_> = plan.profiles.iter().map(|p| wire_bits_per_s(p, true)).collect();
    assert_eq!(bits, [5_310_760.0 * 8.0 * 30.0, 0.0]);
    let color = planned(&config, &[wish("color", None, Some(30.0), Some(PixelFormat::Rgb8))]).unwrap();
    assert_eq!(wire_bits_per_s(&color.profiles[0], false), 1280.0 * 720.0 * 4.0 * 30.0);
}
