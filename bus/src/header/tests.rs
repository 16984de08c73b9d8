//! The header's layout is a contract: these tests fail when a byte moves.

use super::*;

#[test]
fn fields_cover_every_byte_once() {
    let mut end = 0;
    for f in FIELDS {
        assert_eq!(f.offset, end, "{} does not follow its predecessor", f.name);
        end += f.bytes();
    }
    assert_eq!(end, HEADER_SIZE);
}

#[test]
fn offsets_of_version_1_never_move() {
    let at = |name: &str| FIELDS.iter().find(|f| f.name == name).unwrap().offset;
    let seen: Vec<_> =
        ["sequence", "capture_time_ns", "dropped", "intrinsics.fx", "pose.translation_m", "format", "rig"]
            .iter()
            .map(|n| at(n))
            .collect();
    assert_eq!(seen, [8, 48, 96, 176, 280, 348, 376]);
    let derived: Vec<_> =
        ["source_color_sequence", "stage_ns", "refiner", "refiner_model", "latency_ns", "reserved"]
            .map(at)
            .into();
    assert_eq!(derived, [536, 552, 600, 632, 664, 672]);
}

#[test]
fn text_fields_are_cut_at_a_character() {
    let mut h = FrameHeader::default();
    h.set_device(&"é".repeat(20), "SN");
    assert_eq!(h.model(), "é".repeat(15));
    assert_eq!(h.serial(), "SN");
    h.set_refiner(&"é".repeat(20), "cdm-d435@1f2e3d4c");
    assert_eq!((h.refiner(), h.refiner_model()), ("é".repeat(15).as_str(), "cdm-d435@1f2e3d4c"));
    h.model = [0xff; 32];
    assert_eq!(h.model(), "");
}

#[test]
fn a_default_header_is_valid_and_another_version_is_not() {
    let mut h = FrameHeader::default();
    assert!(h.is_valid());
    h.version = 2;
    assert!(!h.is_valid());
}

#[test]
fn image_sizes() {
    let mut h = FrameHeader::default();
    h.set_image(PixelFormat::Rgb8, 640, 480);
    assert_eq!((h.stride, h.payload_len), (1920, 921_600));
    assert_eq!(h.pixel_format(), Some(PixelFormat::Rgb8));
}

#[test]
fn steps_are_in_the_order_of_their_place() {
    let h = FrameHeader { stage_ns: [10, 11, 12, 13, 14, 15], ..FrameHeader::default() };
    for (i, step) in StageStep::ALL.into_iter().enumerate() {
        assert_eq!(h.step_ns(step), 10 + i as u64, "{}", step.name());
    }
}
