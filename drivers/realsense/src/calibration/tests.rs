//! A camera's own tables become intrinsics and poses, and one without them is refused.

use super::*;
use crate::models;
use crate::protocol::hwm::{D4xxOpcode, Request};
use crate::protocol::tables::Pinhole;

/// A camera that answers with these tables, whole.
#[derive(Clone)]
struct FakeCamera {
    stereo: Vec<u8>,
    rgb: Vec<u8>,
    sizes: Option<Vec<u8>>,
    gone: bool,
    /// This reading is refused: with which kind of error.
    refusal: Option<(usize, ErrorKind)>,
    /// Damaged replies in a row before an intact one.
    bad_replies: usize,
    asked: usize,
}

impl HardwareMonitor for FakeCamera {
    fn command(&mut self, request: &Request) -> Result<Vec<u8>> {
        if self.gone {
            return Err(Error::new(ErrorKind::Disconnected, "gone"));
        }
        self.asked += 1;
        if let Some((_, kind)) = self.refusal.filter(|(at, _)| *at == self.asked) {
            return Err(Error::new(kind, "refused once"));
        }
        let bad = !self.asked.is_multiple_of(self.bad_replies + 1);
        let spoiled = |mut table: Vec<u8>| {
            if let Some(last) = table.last_mut() {
                *last ^= u8::from(bad);
            }
            table
        };
        match (D4xxOpcode::from_code(request.opcode()), request.params()[0]) {
            (Some(D4xxOpcode::CalibrationTable), 25) => Ok(spoiled(self.stereo.clone())),
            (Some(D4xxOpcode::CalibrationTable), 32) => Ok(spoiled(self.rgb.clone())),
            (Some(D4xxOpcode::RectifiedParams), _) => self
                .sizes
                .clone()
                .map(spoiled)
                .ok_or_else(|| Error::new(ErrorKind::Unsupported, "old firmware")),
            other => panic!("{other:?}"),
        }
    }
}

fn fake() -> FakeCamera {
    let mut stereo = Coefficients { baseline_mm: -50.1, ..Coefficients::default() };
    // 1280x720, then 848x480.
    stereo.rectified[1] = Pinhole { fx: 640.5, fy: 640.25, ppx: 639.0, ppy: 361.0 };
    stereo.rectified[3] = Pinhole { fx: 424.5, fy: 424.25, ppx: 423.0, ppy: 241.0 };
    let rgb = RgbTable {
        k: [1.2, 0.0, 0.01, 0.0, 2.1, -0.02, 0.0, 0.0, 1.0],
        calibrated: (1920, 1080),
        rectified_rotation: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        rectified_translation_mm: [14.7, 0.1, 0.2],
        ..RgbTable::default()
    };
    FakeCamera {
        stereo: stereo.build(),
        rgb: rgb.build(),
        sizes: None,
        gone: false,
        refusal: None,
        bad_replies: 0,
        asked: 0,
    }
}

fn read(mut camera: FakeCamera, config: &RealsenseConfig) -> Result<Option<Calibration>> {
    Calibration::read(&mut camera, models::of_product(0x0B07).unwrap(), config, "D435 1")
}

fn allowed() -> RealsenseConfig {
    RealsenseConfig { allow_uncalibrated: true, ..RealsenseConfig::default() }
}

#[test]
fn each_view_has_its_own_place() {
    let c = read(fake(), &RealsenseConfig::default()).unwrap().unwrap();
    let at = |view| c.geometry(view, 848, 480).unwrap();
    assert!((at(View::Left).intrinsics.fx - 424.5).abs() < 1e-6);
    assert_eq!(at(View::Left).pose_in_device, Pose::IDENTITY);
    // The right imager sees with the left one's intrinsics, 50.1 mm to the right of it.
    assert_eq!(at(View::Right).intrinsics, at(View::Left).intrinsics);
    assert!((at(View::Right).pose_in_device.translation_m[0] - 0.0501).abs() < 1e-8);
    assert!((at(View::Color).pose_in_device.translation_m[0] + 0.0147).abs() < 1e-8);
    assert!(at(View::Color).intrinsics.fx > 400.0);
}

#[test]
fn newer_firmware_lists_sizes_by_itself() {
    let p = Pinhole { fx: 400.0, fy: 401.0, ppx: 420.0, ppy: 240.0 };
    let items = RectifiedItem::build_all(&[RectifiedItem { width: 848, height: 480, pinhole: p }]);
    let c = read(FakeCamera { sizes: Some(items), ..fake() }, &RealsenseConfig::default()).unwrap().unwrap();
    assert!((c.geometry(View::Left, 848, 480).unwrap().intrinsics.fx - 400.0).abs() < 1e-6);
}

#[test]
fn a_camera_without_calibration_is_refused_unless_the_rig_allows_it() {
    let mut damaged = fake();
    damaged.rgb[40] ^= 1;
    let blank = FakeCamera { stereo: Coefficients::default().build(), ..fake() };
    for (camera, why) in [(damaged, "checksum"), (blank, "not calibrated")] {
        let e = read(camera.clone(), &RealsenseConfig::default()).unwrap_err();
        assert_eq!(e.kind(), ErrorKind::Unsupported);
        assert!(e.to_string().contains(why) && e.to_string().contains("allow_uncalibrated = true"), "{e}");
        assert!(read(camera, &allowed()).unwrap().is_none());
    }
}

#[test]
fn a_camera_that_went_away_is_no_uncalibrated_one() {
    let e = read(FakeCamera { gone: true, ..fake() }, &allowed()).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::Disconnected);
}

#[test]
fn a_damaged_reply_is_asked_for_again_and_a_damaged_table_is_not_for_ever() {
    // Two replies of three are damaged: the first table comes whole the third time, the other one the second time.
    let camera = |bad_replies| FakeCamera { bad_replies, sizes: None, ..fake() };
    let whole = read(camera(0), &RealsenseConfig::default()).unwrap().unwrap();
    let read_back = read(camera(2), &RealsenseConfig::default());
    assert_eq!(
        read_back.unwrap().unwrap().geometry(View::Left, 848, 480).unwrap(),
        whole.geometry(View::Left, 848, 480).unwrap()
    );
    let mut damaged = camera(usize::MAX - 1);
    let e = Calibration::read(
        &mut damaged,
        models::of_product(0x0B07).unwrap(),
        &RealsenseConfig::default(),
        "it",
    )
    .unwrap_err();
    assert!(e.to_string().contains("checksum") && e.to_string().contains("asked 3 times"), "{e}");
    assert_eq!(damaged.asked, READINGS);
}

#[test]
fn one_refusal_of_a_table_does_not_make_a_camera_uncalibrated() {
    // The first request is for the stereo table; the last of five, after three for the sizes that it has not, for
    // colour.
    for at in [1, 5] {
        for kind in [ErrorKind::Unsupported, ErrorKind::NotFound, ErrorKind::Protocol] {
            let camera = FakeCamera { refusal: Some((at, kind)), ..fake() };
            assert!(read(camera, &RealsenseConfig::default()).unwrap().is_some(), "{kind:?} at {at}");
        }
    }
    let camera = FakeCamera { refusal: Some((1, ErrorKind::Busy)), ..fake() };
    assert_eq!(read(camera, &RealsenseConfig::default()).unwrap_err().kind(), ErrorKind::Busy, "that passes");
}
