use super::*;
use proptest::prelude::*;
use std::collections::BTreeMap;

/// Bytes written out by hand from the note's table and the open code, not by [`Command::block`].
#[test]
fn blocks_are_byte_by_byte_as_documented() {
    let cases: [(Command, &[u8]); 8] = [
        (
            Command::ReadFlash { address: 0x18000, length: 64 },
            &[0x51, 0xA1, 0x03, 0, 0, 0x00, 0x01, 0x80, 0x00, 0x90, 0x40, 0x00, 0x40],
        ),
        (
            Command::ReadSystem { address: 0x8018_1033 },
            &[0x51, 0xA2, 0, 4, 1, 0x80, 0x18, 0x10, 0x33, 0, 1, 0, 1],
        ),
        (
            Command::WriteSystem { address: 0x8018_1833, value: 0xAB },
            &[0x50, 0xA2, 0, 4, 1, 0x80, 0x18, 0x18, 0x33, 0, 1, 0, 1, 0, 0, 0, 0xAB],
        ),
        (
            Command::ReadSensor { side: Side::Left, address: 0x3500 },
            &[0x51, 0xA3, 0x6C, 2, 1, 0, 0, 0x35, 0x00, 0x90, 1, 0, 1],
        ),
        (
            Command::WriteSensor { side: Side::Right, address: 0x3509, value: 0xCD },
            &[0x50, 0xA5, 0x6C, 2, 1, 0, 0, 0x35, 0x09, 0x90, 1, 0, 1, 0, 0, 0, 0xCD],
        ),
        (Command::PinDirection { pin: 2, output: true }, &[0x50, 0x10, 2, 0]),
        (Command::SetPin { pin: 2, high: true }, &[0x50, 0x12, 2, 1]),
        (Command::GetPin { pin: 2 }, &[0x51, 0x13, 2]),
    ];
    for (command, bytes) in cases {
        let block = command.block();
        assert_eq!(&block[..bytes.len()], bytes, "{command:?}");
        assert!(block[bytes.len()..].iter().all(|b| *b == 0), "{command:?}");
        assert_eq!(Command::parse(&block[..64]), Some(command));
    }
    assert_eq!(Command::parse(&[0x51; 16]), None);
    assert_eq!(Command::parse(&[0x52; 64]), None);
}

/// A fake camera of registers: reads return what was written.
struct Registers {
    length: usize,
    flash: [u8; 6],
    system: BTreeMap<u32, u8>,
    sensors: [BTreeMap<u16, u8>; 2],
    pins: [u8; 5],
    answer: Vec<u8>,
    /// Registers that cannot be written.
    stuck: bool,
}

impl Registers {
    fn new(length: usize) -> Self {
        let flash = serial_bytes("31234").unwrap();
        let system = BTreeMap::from([(0x8018_1033, 0xF2), (0x8018_1833, 0x52)]);
        Self {
            length,
            flash,
            system,
            sensors: [BTreeMap::new(), BTreeMap::new()],
            pins: [0; 5],
            answer: vec![],
            stuck: false,
        }
    }
}

impl ControlPort for &mut Registers {
    fn query(&mut self, unit: u8, selector: u8, query: Query, data: &mut [u8]) -> Result<()> {
        assert_eq!((unit, selector), (4, 2));
        match query {
            Query::GetLen => data.copy_from_slice(&(self.length as u16).to_le_bytes()),
            Query::SetCur => {
                assert_eq!(data.len(), self.length);
                let get = |value: Option<&u8>| vec![value.copied().unwrap_or_default()];
                self.answer = match Command::parse(data).expect("a known command") {
                    Command::ReadFlash { address: 0x18000, length } => {
                        let mut bytes = self.flash.to_vec();
                        bytes.resize(length.into(), 0xFF);
                        bytes
                    }
                    Command::ReadFlash { .. } => vec![0xFF; 6],
                    Command::ReadSystem { address } => get(self.system.get(&address)),
                    Command::ReadSensor { side, address } => get(self.sensors[side as usize].get(&address)),
                    Command::GetPin { pin } => vec![self.pins[usize::from(pin)]],
                    _ if self.stuck => vec![],
                    Command::WriteSystem { address, value } => {
                        self.system.insert(address, value);
                        vec![]
                    }
                    Command::WriteSensor { side, address, value } => {
                        self.sensors[side as usize].insert(address, value);
                        vec![]
                    }
                    Command::SetPin { pin, high } => {
                        self.pins[usize::from(pin)] = high.into();
                        vec![]
                    }
                    Command::PinDirection { output, .. } => {
                        assert!(output);
                        vec![]
                    }
                };
            }
            Query::GetCur => answer(data, &self.answer),
            other => panic!("{other:?}"),
        }
        Ok(())
    }
}

#[test]
fn the_serial_is_in_the_flash_on_either_bus() {
    for length in [384, 64] {
        let mut camera = Registers::new(length);
        let mut vendor = Vendor::new(&mut camera, "ZED").unwrap();
        assert_eq!(vendor.is_usb2(), length == 64);
        assert_eq!(vendor.serial().unwrap(), "31234");
    }
    let e = Vendor::new(&mut Registers::new(100), "ZED 1-2").err().unwrap();
    assert_eq!(e.kind(), ErrorKind::Protocol);
    assert!(e.to_string().contains("ZED 1-2: command blocks of 100 bytes"), "{e}");
}

#[test]
fn serials_are_decimal_digits() {
    assert_eq!(parse_serial(&[b'O', b'V', 0x00, 0x03, 0x12, 0x34]).unwrap(), "31234");
    assert_eq!(parse_serial(&[b'O', b'V', 0x33, 0x12, 0x34, 0x56, 0xFF]).unwrap(), "33123456");
    for bad in [&[0xFF; 6][..], &[b'O', b'V', 0, 0, 0, 0], &[b'O', b'V', 0, 0, 0, 0x1A], b"OV", b""] {
        assert_eq!(parse_serial(bad).unwrap_err().kind(), ErrorKind::Protocol);
    }
    assert_eq!(serial_bytes("33123456").unwrap(), [b'O', b'V', 0x33, 0x12, 0x34, 0x56]);
    assert!(serial_bytes("123456789").is_err() && serial_bytes("12a").is_err() && serial_bytes("").is_err());
}

#[test]
fn exposure_gain_and_regulation_are_set_and_read_back() {
    let mut camera = Registers::new(384);
    let mut vendor = Vendor::new(&mut camera, "ZED").unwrap();
    assert!(vendor.auto_exposure().unwrap());
    vendor.set_auto_exposure(false).unwrap();
    assert!(!vendor.auto_exposure().unwrap());
    vendor.set_exposure(Side::Right, 37, 30.0).unwrap();
    vendor.set_gain(Side::Right, 80).unwrap();
    assert_eq!(vendor.exposure(Side::Right, 30.0).unwrap(), 37);
    assert_eq!(vendor.gain(Side::Right).unwrap(), Some(80));
    assert_eq!(vendor.exposure(Side::Left, 30.0).unwrap(), 0, "the other side is as it was");
    vendor.set_led(true).unwrap();
    // Only the switch's own bit changes, and 37 % of 1100 lines is 407 = 0x197, in sixteenths.
    assert_eq!(camera.system, BTreeMap::from([(0x8018_1033, 0xF0), (0x8018_1833, 0x50)]));
    assert_eq!([0x3500, 0x3501, 0x3502].map(|a| camera.sensors[1][&a]), [0x00, 0x19, 0x70]);
    assert_eq!(camera.pins, [0, 0, 1, 0, 0]);
}

#[test]
fn a_camera_that_takes_nothing_is_named() {
    let mut camera = Registers::new(384);
    camera.stuck = true;
    let mut vendor = Vendor::new(&mut camera, "ZED 31234 at 4-1").unwrap();
    let e = vendor.set_exposure(Side::Left, 50, 15.0).unwrap_err().to_string();
    assert!(
        e.contains("ZED 31234 at 4-1: the camera does not take the exposure of its Left image sensor"),
        "{e}"
    );
    assert_eq!(vendor.set_auto_exposure(false).unwrap_err().kind(), ErrorKind::Protocol);
}

#[test]
fn exposures_and_gains_by_hand() {
    assert_eq!([10.0, 15.0, 30.0, 60.0, 100.0].map(longest_exposure), [1550, 1550, 1100, 880, 720]);
    assert_eq!([0, 50, 100, 200].map(|p| raw_exposure(p, 60.0)), [2, 440, 880, 880]);
    // 654 steps in all: 255 and three times 133.
    assert_eq!(
        [0, 38, 39, 40, 59, 60, 79, 80, 100].map(raw_gain),
        [0, 249, 255, 385, 509, 894, 1019, 1916, 2047]
    );
    assert_eq!(
        [0, 255, 300, 378, 2047, 2048].map(gain_percent),
        [Some(0), Some(39), None, Some(39), Some(100), None]
    );
}

proptest! {
    #[test]
    fn percent_and_back(percent in 0u8..=100, rate in prop::sample::select(vec![15.0, 30.0, 60.0, 100.0])) {
        prop_assert_eq!(exposure_percent(raw_exposure(percent, rate), rate), percent);
        prop_assert_eq!(gain_percent(raw_gain(percent)), Some(percent));
    }

    #[test]
    fn no_block_makes_it_panic(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
        let _ = (Command::parse(&bytes), parse_serial(&bytes));
    }
}
