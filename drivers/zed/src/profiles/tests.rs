use super::*;
use depthrig_v4l2::{FourCc, Interval};

/// As the camera lists them: rates as multiples of 100 ns.
fn modes() -> Vec<Mode> {
    let mode = |width, height, interval| Mode {
        format: FourCc(*b"YUYV"),
        width,
        height,
        interval: Interval { numerator: interval, denominator: 10_000_000 },
    };
    vec![
        mode(4416, 1242, 666_666),
        mode(2560, 720, 166_666),
        mode(2560, 720, 333_333),
        mode(1344, 376, 100_000),
        mode(1346, 376, 100_000),
    ]
}

fn wanted(stream: &str, size: Option<(u32, u32)>, rate_hz: Option<f64>) -> StreamRequest {
    StreamRequest { size, rate_hz, ..StreamRequest::any(Name::new(stream).unwrap()) }
}

fn described(list: &[StreamProfile]) -> Vec<String> {
    list.iter().map(StreamProfile::describe).collect()
}

#[test]
fn each_mode_is_two_streams_and_the_default_is_hd720_at_30() {
    let all = profiles("ZED", &modes(), None).unwrap();
    let left: Vec<_> = described(&all[..4]);
    assert_eq!(
        left,
        [
            "left 1280x720 yuyv 30 Hz",
            "left 2208x1242 yuyv 15 Hz",
            "left 1280x720 yuyv 60 Hz",
            "left 672x376 yuyv 100 Hz"
        ],
        "a mode whose halves split a pixel pair is left out"
    );
    assert_eq!(described(&all[4..]), left.iter().map(|l| l.replace("left", "right")).collect::<Vec<_>>());
    assert!(all.iter().all(|p| !p.intrinsics.is_known() && p.metadata == MetadataLevel::Kernel));
    assert_eq!(all[0].frame_bytes() * 2, 3_686_400, "that of the side-by-side image");
    let e = profiles("ZED 2i 1 at USB port 1-1", &[], None).unwrap_err();
    assert!(e.to_string().contains("ZED 2i 1 at USB port 1-1: lists no side-by-side"), "{e}");
}

#[test]
fn the_calibration_is_that_of_the_size() {
    let calibration = FactoryCalibration::parse(include_str!("../conf/sample.conf"), "sample").unwrap();
    let all = profiles("ZED", &modes(), Some(&calibration)).unwrap();
    let of =
        |stream: &str, width| all.iter().find(|p| p.stream.as_str() == stream && p.width == width).unwrap();
    assert_eq!(of("left", 1280).intrinsics.fx, 532.41);
    assert_eq!(of("right", 1280).intrinsics.fx, 532.63);
    assert_eq!(of("left", 672).intrinsics.fx, 266.205);
    assert_eq!(of("left", 2208).pose_in_device, Pose::IDENTITY);
    assert!((of("right", 2208).pose_in_device.translation_m[0] - 0.12014).abs() < 1e-5);
}

#[test]
fn both_eyes_have_one_mode() {
    let all = profiles("ZED", &modes(), None).unwrap();
    let chosen = |r: &[StreamRequest]| choose("ZED", &all, r).map(|c| described(&c));
    let vga = Some((672, 376));
    assert_eq!(chosen(&[]).unwrap(), ["left 1280x720 yuyv 30 Hz", "right 1280x720 yuyv 30 Hz"]);
    assert_eq!(chosen(&[wanted("right", vga, None)]).unwrap(), ["right 672x376 yuyv 100 Hz"]);
    // A property that one leaves open is taken from the other.
    assert_eq!(
        chosen(&[wanted("right", None, None), wanted("left", Some((1280, 720)), Some(60.0))]).unwrap(),
        ["right 1280x720 yuyv 60 Hz", "left 1280x720 yuyv 60 Hz"]
    );
    let e = chosen(&[wanted("left", vga, None), wanted("right", Some((1280, 720)), None)]).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::Unsupported);
    assert!(e.to_string().contains("left and right come in one frame"), "{e}");
    assert!(
        chosen(&[wanted("depth", None, None)]).unwrap_err().to_string().contains("it has: left 1280x720")
    );
}

/// The IMU has a mode of its own, which no request for an image changes, and the other way round.
#[test]
fn the_imu_is_chosen_beside_the_images() {
    let mut all = profiles("ZED", &modes(), None).unwrap();
    all.push(crate::imu::profile().unwrap());
    let chosen = |r: &[StreamRequest]| choose("ZED", &all, r).map(|c| described(&c));
    let imu = || wanted("imu", None, None);
    let small = Some((672, 376));
    let unit = "imu motion 400 Hz in batches of up to 16";
    assert_eq!(
        chosen(&[wanted("left", small, None), imu(), wanted("right", None, None)]).unwrap(),
        ["left 672x376 yuyv 100 Hz", unit, "right 672x376 yuyv 100 Hz"]
    );
    assert_eq!(chosen(&[imu()]).unwrap(), [unit]);
    assert_eq!(
        chosen(&[]).unwrap(),
        ["left 1280x720 yuyv 30 Hz", "right 1280x720 yuyv 30 Hz", unit],
        "by default it is delivered"
    );
    let apart = [wanted("left", small, None), wanted("right", Some((1280, 720)), None), imu()];
    assert_eq!(chosen(&apart).unwrap_err().kind(), ErrorKind::Unsupported);
}
