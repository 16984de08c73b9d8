use super::*;
use depthrig_driver::ErrorKind;
use proptest::prelude::*;

/// CRC-32 (IEEE, reflected) bit by bit, so that the tests do not lean on the crate that the code uses.
fn crc(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(!0u32, |crc, b| {
        (0..8).fold(crc ^ u32::from(*b), |c, _| if c & 1 == 1 { (c >> 1) ^ 0xEDB8_8320 } else { c >> 1 })
    })
}

fn f(b: &mut [u8], at: usize, v: f32) {
    b[at..at + 4].copy_from_slice(&v.to_le_bytes());
}

/// Puts the header of table `id` before the payload that is there.
fn seal(b: &mut [u8], id: u8) {
    let size = (b.len() - 16) as u32;
    let sum = crc(&b[16..]);
    b[0..4].copy_from_slice(&[0x03, 0x02, id, 0]); // version 3.2
    b[4..8].copy_from_slice(&size.to_le_bytes());
    b[8..12].copy_from_slice(&[7, 0, 0, 0]);
    b[12..16].copy_from_slice(&sum.to_le_bytes());
}

/// Table 25 by the note's offsets: every field has the number of its offset as value.
pub(crate) fn coefficients_by_hand() -> Vec<u8> {
    let mut b = vec![0u8; 576];
    for at in (16..160).step_by(4) {
        f(&mut b, at, at as f32);
    }
    f(&mut b, 160, -49.96);
    b[164] = 1;
    for at in (256..512).step_by(4) {
        f(&mut b, at, at as f32);
    }
    seal(&mut b, 25);
    b
}

/// Table 32, likewise.
pub(crate) fn rgb_by_hand() -> Vec<u8> {
    let mut b = vec![0u8; 256];
    for at in (16..144).step_by(4) {
        f(&mut b, at, at as f32);
    }
    b[144..148].copy_from_slice(&[0x80, 0x07, 0x38, 0x04]); // 1920x1080
    for at in (148..232).step_by(4) {
        f(&mut b, at, at as f32);
    }
    seal(&mut b, 32);
    b
}

fn run<const N: usize>(from: usize) -> [f32; N] {
    core::array::from_fn(|i| (from + 4 * i) as f32)
}

#[test]
fn the_checksum_is_the_common_one() {
    assert_eq!(crc(b"123456789"), 0xCBF4_3926);
    assert_eq!(crc32fast::hash(b"123456789"), 0xCBF4_3926);
}

#[test]
fn coefficients_field_by_field() {
    let bytes = coefficients_by_hand();
    let t = Coefficients::parse(&bytes).unwrap();
    assert_eq!((t.version, t.param), ([3, 2], 7));
    assert_eq!((t.left, t.right), (run(16), run(52)));
    assert_eq!((t.world_to_left, t.world_to_right), (run(88), run(124)));
    assert_eq!((t.baseline_mm, t.distortion_model), (-49.96, 1));
    for (i, p) in t.rectified.iter().enumerate() {
        assert_eq!([p.fx, p.fy, p.ppx, p.ppy], run(256 + 16 * i), "{i}");
    }
    assert_eq!(t.build(), bytes);
}

#[test]
fn sizes_are_in_the_note_s_order() {
    let t = Coefficients::parse(&coefficients_by_hand()).unwrap();
    let order = [
        (0, (1920, 1080)),
        (1, (1280, 720)),
        (2, (640, 480)),
        (3, (848, 480)),
        (4, (640, 360)),
        (5, (424, 240)),
        (6, (320, 240)),
        (7, (480, 270)),
        (8, (1280, 800)),
        (9, (960, 540)),
        (12, (640, 400)),
        (13, (576, 576)),
        (14, (720, 720)),
        (15, (1152, 1152)),
    ];
    for (i, (w, h)) in order {
        assert_eq!(t.entry(w, h).unwrap().fx, (256 + 16 * i) as f32, "{w}x{h}");
    }
    assert_eq!(t.entry(848, 100), None);
}

#[test]
fn the_colour_table_field_by_field() {
    let bytes = rgb_by_hand();
    let t = RgbTable::parse(&bytes).unwrap();
    assert_eq!((t.version, t.param), ([3, 2], 7));
    assert_eq!((t.k, t.distortion), (run(16), run(52)));
    assert_eq!((t.rotation, t.translation_mm), (run(72), run(84)));
    assert_eq!((t.projection, t.calibrated), (run(96), (1920, 1080)));
    assert_eq!((t.rectified_k, t.rectified_rotation), (run(148), run(184)));
    assert_eq!(t.rectified_translation_mm, run(220));
    assert_eq!(t.build(), bytes);
}

#[test]
fn rectified_items_have_the_focal_lengths_first() {
    let mut b = vec![0u8; 40];
    b[0..4].copy_from_slice(&[0x50, 0x03, 0xE0, 0x01]); // 848x480
    b[20..24].copy_from_slice(&[0x80, 0x02, 0x68, 0x01]); // 640x360
    for (i, v) in [424.5f32, 425.5, 420.0, 240.0].into_iter().enumerate() {
        f(&mut b, 4 + 4 * i, v);
        f(&mut b, 24 + 4 * i, v + 1.0);
    }
    let first = Pinhole { fx: 424.5, fy: 425.5, ppx: 420.0, ppy: 240.0 };
    let second = Pinhole { fx: 425.5, fy: 426.5, ppx: 421.0, ppy: 241.0 };
    let items = [
        RectifiedItem { width: 848, height: 480, pinhole: first },
        RectifiedItem { width: 640, height: 360, pinhole: second },
    ];
    assert_eq!(RectifiedItem::parse_all(&b), items);
    assert_eq!(RectifiedItem::build_all(&items), b);
    for n in 0..40 {
        assert_eq!(RectifiedItem::parse_all(&b[..n]).len(), n / 20);
    }
}

#[test]
fn a_damaged_table_is_refused_wherever_it_is_damaged() {
    for (bytes, id) in [(coefficients_by_hand(), 25), (rgb_by_hand(), 32)] {
        let open = |b: &[u8]| Header::open(b, id).map(|_| ());
        assert!(open(&bytes).is_ok());
        // The header's version, size and format are not under the checksum.
        for at in (2..4).chain(12..bytes.len()) {
            for bit in [0x01, 0x80] {
                let mut damaged = bytes.clone();
                damaged[at] ^= bit;
                let e = open(&damaged).expect_err("undetected");
                assert_eq!(e.kind(), ErrorKind::Protocol);
            }
        }
        let mut damaged = bytes.clone();
        damaged[100] ^= 1;
        let text = open(&damaged).unwrap_err().to_string();
        assert!(
            text.contains("checksum") && text.contains(&id.to_string()) && text.contains("calibration tool")
        );
    }
}

#[test]
fn cut_off_at_every_length() {
    for (bytes, id) in [(coefficients_by_hand(), 25u8), (rgb_by_hand(), 32)] {
        for n in 0..bytes.len() {
            assert!(
                Coefficients::parse(&bytes[..n]).is_err() && RgbTable::parse(&bytes[..n]).is_err(),
                "{n}"
            );
            if n >= 16 {
                // Cut off with a checksum that fits all the same.
                let mut short = bytes[..n].to_vec();
                seal(&mut short, id);
                let parsed = if id == 25 {
                    Coefficients::parse(&short).is_ok()
                } else {
                    RgbTable::parse(&short).is_ok()
                };
                assert_eq!(parsed, n >= if id == 25 { 512 } else { 232 }, "table {id}, {n} bytes");
            }
        }
    }
}

proptest! {
    #[test]
    fn any_bytes(bytes in prop::collection::vec(any::<u8>(), 0..700)) {
        let _ = (Coefficients::parse(&bytes), RgbTable::parse(&bytes), RectifiedItem::parse_all(&bytes));
        let mut sealed = bytes;
        if sealed.len() >= 16 {
            seal(&mut sealed, 25);
            prop_assert_eq!(Coefficients::parse(&sealed).is_ok(), sealed.len() >= 512);
        }
    }
}
