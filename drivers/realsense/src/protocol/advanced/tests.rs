use super::*;
use crate::protocol::fake::{self, Fake};
use crate::protocol::hwm::Code;

#[test]
fn groups_have_the_numbers_and_lengths_of_the_note() {
    let bytes: Vec<_> = Group::ALL.iter().map(|g| (*g as u32, g.bytes())).collect();
    let must = [40, 16, 32, 20, 12, 12, 24, 12, 48, 20, 4, 8, 4];
    assert_eq!(bytes, (0..13).zip(must).collect::<Vec<_>>());
    for g in Group::ALL {
        assert_eq!(Group::from_name(g.name()), Some(g));
    }
    assert_eq!(Group::from_name("depth"), None);
}

#[test]
fn the_depth_table_by_hand() {
    let bytes = [0x10, 0x27, 0, 0, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0, 0, 1, 0, 0, 0, 0x2D, 0, 0, 0];
    let table = DepthTable {
        unit_um: 10_000,
        clamp_min: -1,
        clamp_max: 65_535,
        disparity_mode: 1,
        disparity_shift: 45,
    };
    assert_eq!(DepthTable::parse(&bytes), Some(table));
    assert_eq!(table.build(), bytes);
    for n in 0..20 {
        assert_eq!(DepthTable::parse(&bytes[..n]), None);
    }
}

#[test]
fn the_depth_unit_is_the_camera_s_or_the_model_s() {
    let mut camera = fake::advanced(true);
    let (unit, origin) = depth_unit_m(&mut camera, 0x0B07).unwrap();
    assert!((unit - 0.001).abs() < 1e-12 && origin == UnitOrigin::Camera);
    assert_eq!(camera.asked, [(0x30, [0; 4]), (0x2C, [9, 0, 0, 0])]);

    assert_eq!(depth_unit_m(&mut fake::advanced(false), 0x0B07).unwrap(), (0.001, UnitOrigin::Model));
    assert_eq!(depth_unit_m(&mut fake::advanced(false), 0x0B5B).unwrap(), (0.0001, UnitOrigin::Model));

    for wrong in [0u32, 1_000_001] {
        let mut camera = Fake::new(|r| match r.opcode {
            0x30 => Ok(vec![1]),
            _ => Ok([wrong.to_le_bytes().to_vec(), vec![0; 16]].concat()),
        });
        assert_eq!(depth_unit_m(&mut camera, 0x0B07).unwrap_err().kind(), ErrorKind::Protocol);
    }
}

#[test]
fn setting_the_depth_unit_leaves_the_rest_of_the_table() {
    let mut camera = fake::advanced(true);
    let before = set_depth_unit_m(&mut camera, 0.0005).unwrap();
    assert!((before - 0.001).abs() < 1e-12);
    let table = DepthTable::parse(&get(&mut camera, Group::DepthTable, Bound::Current).unwrap()).unwrap();
    assert_eq!((table.unit_um, table.clamp_max, table.disparity_shift), (500, 65_535, 9));
    for wrong in [0.0, -1.0, 0.000_05, 0.02, f64::NAN] {
        let e = set_depth_unit_m(&mut camera, wrong).unwrap_err();
        assert!(e.kind() == ErrorKind::BadInput && e.to_string().contains("100 to 10000"), "{e}");
    }
    let e = set_depth_unit_m(&mut fake::advanced(false), 0.001).unwrap_err();
    assert!(e.kind() == ErrorKind::Unsupported && e.to_string().contains("viewer"), "{e}");
}

#[test]
fn short_replies_and_wrong_lengths() {
    let mut short = Fake::new(|_| Ok(vec![1; 19]));
    assert_eq!(get(&mut short, Group::DepthTable, Bound::Current).unwrap_err().kind(), ErrorKind::Protocol);
    let mut empty = Fake::new(|_| Ok(vec![]));
    assert_eq!(is_on(&mut empty).unwrap_err().kind(), ErrorKind::Protocol);
    let mut never = Fake::new(|_| Err(Code::WRONG_COMMAND));
    assert_eq!(set(&mut never, Group::Rsm, &[0; 15]).unwrap_err().kind(), ErrorKind::BadInput);
    assert_eq!(never.asked, []);
}
