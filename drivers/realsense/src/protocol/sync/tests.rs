use super::*;
use crate::protocol::fake::Fake;

const D415: u16 = 0x0AD3;
const D435: u16 = 0x0B07;

fn every_mode() -> Vec<SyncMode> {
    let mut all = vec![SyncMode::Free, SyncMode::Master, SyncMode::Slave, SyncMode::FullSlave];
    all.extend((1..=255).map(SyncMode::Genlock));
    all.extend([SyncMode::GenlockLaserOnOff, SyncMode::GenlockLaserOffOn]);
    all
}

#[test]
fn codes_are_the_note_s() {
    assert_eq!([0, 1, 2, 3].map(|i| every_mode()[i].code()), [0, 1, 2, 3]);
    // The vendor's value v = 4…258 is 4 | (v - 3) << 8.
    assert_eq!(SyncMode::Genlock(1).code(), 4 | (4 - 3) << 8);
    assert_eq!(SyncMode::Genlock(255).code(), 4 | (258 - 3) << 8);
    assert_eq!(SyncMode::GenlockLaserOnOff.code(), 0x0001_0204);
    assert_eq!(SyncMode::GenlockLaserOffOn.code(), 0x0003_0204);
}

#[test]
fn every_mode_is_read_as_it_was_written() {
    for mode in every_mode() {
        let mut now = 0;
        let mut camera = Fake::new(move |r| {
            if r.opcode == 0x69 {
                now = r.params[0];
            }
            Ok(now.to_le_bytes().to_vec())
        });
        mode.write(&mut camera).unwrap();
        assert_eq!(camera.asked, [(0x69, [mode.code(), 0, 0, 0]), (0x6A, [0; 4])]);
        assert_eq!(SyncMode::read(&mut camera).unwrap(), mode);
    }
    assert_eq!(SyncMode::from_reply(&[2]), Some(SyncMode::Slave), "early firmware sends one byte");
    for unknown in [&[][..], &[4], &[4, 0], &[4, 2, 2], &[5, 0, 0]] {
        assert_eq!(SyncMode::from_reply(unknown), None, "{unknown:?}");
    }
}

#[test]
fn a_camera_that_keeps_its_mode_is_noticed() {
    let mut stubborn = Fake::new(|_| Ok(vec![0, 0, 0, 0]));
    let e = SyncMode::Master.write(&mut stubborn).unwrap_err();
    assert!(e.to_string().contains("master") && e.to_string().contains("free"), "{e}");
}

#[test]
fn modes_need_their_firmware_and_shutter() {
    let check = |mode: SyncMode, pid, firmware, shutter| mode.check(pid, firmware, shutter);
    for (mode, first) in [
        (SyncMode::Master, Firmware::new(5, 9, 15, 1)),
        (SyncMode::Slave, Firmware::new(5, 9, 15, 1)),
        (SyncMode::FullSlave, Firmware::new(5, 12, 4, 0)),
        (SyncMode::Genlock(1), Firmware::new(5, 12, 4, 0)),
        (SyncMode::GenlockLaserOnOff, Firmware::new(5, 12, 12, 100)),
    ] {
        assert!(check(mode, D435, first, Shutter::Global).is_ok(), "{mode}");
        let Firmware([a, b, c, d]) = first;
        let older = if d > 0 { Firmware::new(a, b, c, d - 1) } else { Firmware::new(a, b, c - 1, 255) };
        let e = check(mode, D435, older, Shutter::Global).unwrap_err();
        assert!(e.kind() == ErrorKind::Unsupported && e.to_string().contains(&first.to_string()), "{e}");
    }
    let new = Firmware::new(5, 16, 0, 1);
    assert!(check(SyncMode::Slave, D415, new, Shutter::Rolling).is_ok());
    assert!(check(SyncMode::FullSlave, D415, new, Shutter::Rolling).is_err());
    assert!(
        check(SyncMode::Master, D405, new, Shutter::Global).unwrap_err().to_string().contains("connector")
    );
    assert_eq!(
        check(SyncMode::Genlock(0), D435, new, Shutter::Global).unwrap_err().kind(),
        ErrorKind::BadInput
    );
}
