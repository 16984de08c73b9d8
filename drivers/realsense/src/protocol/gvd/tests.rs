use super::*;
use depthrig_driver::ErrorKind;
use proptest::prelude::*;

/// A D435 as the note's offsets have it, written out by hand.
fn by_hand() -> Vec<u8> {
    let mut b = vec![0u8; 256];
    b[2] = 5;
    b[12..16].copy_from_slice(&[0x64, 0x0D, 0x0C, 0x05]); // 5.12.13.100
    b[25] = 1;
    b[48..54].copy_from_slice(&[0x01, 0x23, 0x45, 0x67, 0x89, 0xAB]);
    b[64..70].copy_from_slice(&[0x84, 0x12, 0x12, 0x07, 0x07, 0x90]);
    b[166] = 2;
    b[170] = 1;
    b[174] = 1;
    b
}

#[test]
fn a_d400_by_hand() {
    let gvd = Gvd::parse(&by_hand()).unwrap();
    let expected = Gvd {
        version: 5,
        firmware: Firmware::new(5, 12, 13, 100),
        locked: true,
        serial: "0123456789ab".into(),
        asic_serial: "841212070790".into(),
        shutter: Shutter::Global,
        projector: true,
        color: true,
        imu: false,
        accelerometer: 0,
    };
    assert_eq!(gvd, expected);
    assert_eq!(expected.build(), by_hand());
}

#[test]
fn an_l515_by_hand() {
    let mut b = vec![0u8; 256];
    b[6] = 1;
    b[12..16].copy_from_slice(&[2, 1, 5, 1]);
    b[60..64].copy_from_slice(&[0xF0, 0x12, 0x03, 0x45]);
    b[74..80].copy_from_slice(&[1, 2, 3, 4, 5, 0xFF]);
    let expected = L515Gvd {
        firmware: Firmware::new(1, 5, 1, 2),
        locked: true,
        serial: "f0120345".into(),
        asic_serial: "0102030405ff".into(),
    };
    assert_eq!(L515Gvd::parse(&b).unwrap(), expected);
    assert_eq!(expected.build(), b);
}

#[test]
fn cut_off_at_every_length() {
    let whole = by_hand();
    for n in 0..whole.len() {
        match Gvd::parse(&whole[..n]) {
            Ok(gvd) => {
                assert!(n >= 70, "{n}");
                assert_eq!(gvd.serial, "0123456789ab");
                assert_eq!(gvd.shutter == Shutter::Global, n > 166);
            }
            Err(e) => {
                assert!(
                    n < 70 && e.kind() == ErrorKind::Protocol && e.to_string().contains("70"),
                    "{n}: {e}"
                );
            }
        }
        assert_eq!(L515Gvd::parse(&whole[..n]).is_ok(), n >= 80);
    }
}

#[test]
fn a_serial_that_is_none_is_left_out() {
    for wrong in ["", "1", "xx", "é", "+1+2"] {
        assert_eq!(unhex(wrong), [0; 0], "{wrong}");
    }
    assert_eq!(unhex("0aF9"), [0x0A, 0xF9]);
}

proptest! {
    #[test]
    fn any_bytes(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
        let _ = (Gvd::parse(&bytes), L515Gvd::parse(&bytes));
    }
}
