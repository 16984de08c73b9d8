use super::*;
use crate::protocol::fake::Fake;
use crate::protocol::hwm::Code;
use depthrig_calib::PoseExt;
use proptest::prelude::*;

fn f(b: &mut Vec<u8>, values: &[f32]) {
    b.extend(values.iter().flat_map(|v| v.to_le_bytes()));
}

fn n(b: &mut Vec<u8>, values: &[u32]) {
    b.extend(values.iter().flat_map(|v| v.to_le_bytes()));
}

/// Two sizes by the note, written one field after the other; the raw half has 1 added to every number.
fn depth_by_hand() -> Vec<u8> {
    let mut b = vec![1, 2, 0, 0];
    n(&mut b, &[0]);
    f(&mut b, &[-3.5]);
    b.extend([0, 0, 0, 2]);
    for (w, h) in [(1024, 768), (640, 480)] {
        for plus in [1.0, 0.0] {
            n(&mut b, &[w, h]);
            f(&mut b, &[700.0 + plus, 701.0 + plus, w as f32 / 2.0 + plus, h as f32 / 2.0 + plus]);
            f(&mut b, &[0.1, 0.2, 0.3, 0.4, 0.5]);
            f(&mut b, &[500.0 + plus, 380.0 + plus, 4.0 + plus]);
        }
    }
    assert_eq!(b.len(), 16 + 2 * 112);
    b
}

fn color_by_hand() -> Vec<u8> {
    let mut b = Vec::new();
    f(&mut b, &[0.25]);
    n(&mut b, &[0]);
    b.extend([0, 0, 0, 2]);
    for (w, h) in [(1920, 1080), (1280, 720)] {
        n(&mut b, &[w, h]);
        f(&mut b, &[w as f32 * 0.7, w as f32 * 0.71, w as f32 * 0.51, h as f32 * 0.49]);
        f(&mut b, &[0.125, -0.25, 0.5, -0.0625, 0.75]);
    }
    assert_eq!(b.len(), 12 + 2 * 44);
    b
}

#[test]
fn depth_field_by_field() {
    let bytes = depth_by_hand();
    let t = DepthIntrinsics::parse(&bytes).unwrap();
    assert_eq!((t.scan, t.offset, t.sizes.len()), ([1, 2], -3.5, 2));
    let raw = t.sizes[1].raw;
    let world = t.sizes[1].world;
    let lens = Lens {
        width: 640,
        height: 480,
        fx: 700.0,
        fy: 701.0,
        ppx: 320.0,
        ppy: 240.0,
        distortion: [0.1, 0.2, 0.3, 0.4, 0.5],
    };
    assert_eq!(world, DepthPart { lens, zero_order: [500.0, 380.0], z_norm: 4.0 });
    assert_eq!((raw.lens.fx, raw.z_norm), (701.0, 5.0));
    assert_eq!(t.build(), bytes);
    // The world's entry counts, not the raw one; and without its distortion.
    assert_eq!(t.at(640, 480).unwrap(), Intrinsics::pinhole(700.0, 701.0, 320.0, 240.0));
    assert!((t.unit_m().unwrap() - 0.000_25).abs() < 1e-15);
    let e = t.at(480, 640).unwrap_err();
    assert!(e.kind() == ErrorKind::Unsupported && e.to_string().contains("1024x768, 640x480"), "{e}");
}

#[test]
fn colour_field_by_field() {
    let bytes = color_by_hand();
    let t = ColorIntrinsics::parse(&bytes).unwrap();
    assert_eq!(t.shear, 0.25);
    assert_eq!(t.build(), bytes);
    let i = t.at(1280, 720).unwrap();
    assert_eq!((i.fx, i.fy), (f64::from(1280.0f32 * 0.7), f64::from(1280.0f32 * 0.71)));
    assert_eq!((i.cx, i.cy), (f64::from(1280.0f32 * 0.51), f64::from(720.0f32 * 0.49)));
    assert_eq!(i.distortion(), Distortion::BrownConrady);
    assert_eq!(i.coeffs[..5], [0.125, -0.25, 0.5, -0.0625, 0.75]);
    assert!(t.at(640, 480).is_err());
}

#[test]
fn cut_off_at_every_length_and_more_than_needed() {
    let depth = depth_by_hand();
    let color = color_by_hand();
    for n in 0..depth.len() {
        assert_eq!(DepthIntrinsics::parse(&depth[..n]).unwrap_err().kind(), ErrorKind::Protocol, "{n}");
    }
    for n in 0..color.len() {
        assert_eq!(ColorIntrinsics::parse(&color[..n]).unwrap_err().kind(), ErrorKind::Protocol, "{n}");
    }
    let more = [&depth[..], &[7; 50]].concat();
    assert_eq!(DepthIntrinsics::parse(&more).unwrap(), DepthIntrinsics::parse(&depth).unwrap());
    for wrong in [0, 6, 255] {
        let mut d = depth.clone();
        let mut c = color.clone();
        (d[15], c[11]) = (wrong, wrong);
        d.resize(70_000, 0);
        c.resize(70_000, 0);
        assert!(DepthIntrinsics::parse(&d).is_err() && ColorIntrinsics::parse(&c).is_err(), "{wrong}");
    }
}

#[test]
fn what_was_never_calibrated_is_refused() {
    let mut t = DepthIntrinsics::parse(&depth_by_hand()).unwrap();
    for (fx, fy) in [(0.0, 700.0), (700.0, f32::NAN), (-1.0, 700.0), (f32::INFINITY, 700.0)] {
        (t.sizes[0].world.lens.fx, t.sizes[0].world.lens.fy) = (fx, fy);
        assert_eq!(t.at(1024, 768).unwrap_err().kind(), ErrorKind::Unsupported);
    }
    for z_norm in [0.0, -4.0, f32::NAN, f32::INFINITY, 1e-30] {
        t.sizes[0].world.z_norm = z_norm;
        assert_eq!(t.unit_m().unwrap_err().kind(), ErrorKind::Protocol, "{z_norm}");
    }
}

#[test]
fn the_pose_of_colour_is_the_inverse() {
    // 90° about y: x → -z, z → x; row after row.
    let rotation = [0.0, 0.0, 1.0, 0.0, 1.0, 0.0, -1.0, 0.0, 0.0];
    let e = ColorExtrinsics { rotation, translation_mm: [10.0, -20.0, 5.0] };
    let mut bytes = Vec::new();
    f(&mut bytes, &rotation);
    f(&mut bytes, &[10.0, -20.0, 5.0]);
    assert_eq!(ColorExtrinsics::parse(&bytes).unwrap(), e);
    assert_eq!(e.build(), bytes);
    for n in 0..48 {
        assert!(ColorExtrinsics::parse(&bytes[..n]).is_err());
    }
    let pose = e.color_in_depth().unwrap();
    let p_depth = DVec3::new(0.3, 0.2, 1.5);
    // p_color = R p + t, written out.
    let p_color = DVec3::new(p_depth.z + 0.01, p_depth.y - 0.02, -p_depth.x + 0.005);
    assert!((pose.transform_point(p_color) - p_depth).length() < 1e-12);
    let bad = ColorExtrinsics { rotation: [0.5; 9], ..e };
    assert_eq!(bad.color_in_depth().unwrap_err().kind(), ErrorKind::Protocol);
    let far = ColorExtrinsics { translation_mm: [0.0, 0.0, 2000.0], ..e };
    assert!(far.color_in_depth().is_err());
}

#[test]
fn controls_are_checked_against_the_camera_s_range() {
    let mut value = 50i32;
    let mut camera = Fake::new(move |r| match (r.opcode, r.params) {
        (0x2C, [5, what @ 0..=3, 0, 0]) => Ok([value, 10, 100, 5][what as usize].to_le_bytes().to_vec()),
        (0x2B, [5, v, 0, 0]) => {
            value = v as i32;
            Ok(vec![])
        }
        _ => Err(Code::WRONG_PARAMETER),
    });
    assert_eq!(Control::LaserPower.get(&mut camera).unwrap(), 50);
    assert_eq!(Control::LaserPower.set(&mut camera, 75).unwrap(), 75);
    for wrong in [9, 101, -1] {
        let e = Control::LaserPower.set(&mut camera, wrong).unwrap_err();
        assert!(e.kind() == ErrorKind::BadInput && e.to_string().contains("10 to 100"), "{e}");
    }
    assert!(Control::NoiseFilter.get(&mut camera).is_err());
    let numbers: Vec<_> = Control::ALL.iter().map(|c| *c as u32).collect();
    assert_eq!(numbers, (0..9).collect::<Vec<_>>());
    assert!(Control::ALL.iter().all(|c| Control::from_name(c.name()) == Some(*c)));
}

#[test]
fn temperatures_and_errors() {
    let mut b = Vec::new();
    b.extend([41.5f64, 40.0, 39.0, 38.0, 30.0, 41.0].iter().flat_map(|v| v.to_le_bytes()));
    let t = Temperatures::parse(&b).unwrap();
    assert_eq!(
        (t.laser_c, t.processor_c, t.mirror_c, t.receiver_c, t.humidity_c),
        (41.5, 40.0, 39.0, 38.0, 30.0)
    );
    for n in 0..40 {
        assert_eq!(Temperatures::parse(&b[..n]), None);
    }
    assert_eq!(error_report(0), None);
    assert!(error_report(12).unwrap().contains("fall"));
    assert!(error_report(200).unwrap().contains("200"));
}

proptest! {
    #[test]
    fn any_bytes(bytes in prop::collection::vec(any::<u8>(), 0..700), w in any::<u32>(), h in any::<u32>()) {
        if let Ok(t) = DepthIntrinsics::parse(&bytes) {
            let _ = (t.at(w, h), t.unit_m());
            let again = t.build();
            prop_assert_eq!(&again[16..], &bytes[16..again.len()]);
        }
        let _ = ColorIntrinsics::parse(&bytes).map(|t| t.at(w, h));
        let _ = ColorExtrinsics::parse(&bytes).map(|e| e.color_in_depth());
        let _ = Temperatures::parse(&bytes);
    }
}
