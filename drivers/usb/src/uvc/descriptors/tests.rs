//! Against a descriptor like a D435's, written out by hand byte by byte from the specification's tables.

use super::*;
use proptest::prelude::*;

/// Depth (frame-based, two sizes), infrared (continuous intervals), colour with MJPEG (isochronous, two settings), a
/// vendor channel and a motion sensor.
#[rustfmt::skip]
fn d435() -> Vec<u8> {
    let body: &[&[u8]] = &[
        &[8, 0x0B, 0, 3, 0x0E, 3, 0, 0],                                        // interface association
        &[9, 0x04, 0, 0, 1, 0x0E, 1, 0, 0],                                     // interface 0: control
        &[14, 0x24, 1, 0x50, 0x01, 0x5C, 0x00, 0x00, 0x6C, 0xDC, 0x02, 2, 1, 2],// 1.5, 48 MHz, streams 1 and 2
        &[18, 0x24, 2, 1, 0x01, 0x02, 0, 0, 0, 0, 0, 0, 0, 0, 3, 0x0A, 0, 0],   // camera terminal 1
        &[13, 0x24, 5, 2, 1, 0, 0, 3, 0x00, 0x02, 0x00, 0, 0],                  // processing unit 2: gain
        &[29, 0x24, 6, 3,                                                       // extension unit 3, two inputs
            0xCB, 0x6C, 0x60, 0xC9, 0x4C, 0x59, 0x25, 0x4D, 0xAF, 0x47, 0xCC, 0xC4, 0x96, 0x43, 0x59, 0x95,
            17, 2, 1, 2, 3, 0xFF, 0xFF, 0x01, 0],
        &[9, 0x24, 3, 4, 0x01, 0x01, 0, 3, 0],                                  // output terminal 4
        &[7, 0x05, 0x87, 3, 64, 0, 8], &[6, 0x30, 0, 0, 64, 0], &[5, 0x25, 3, 64, 0],
        &[9, 0x04, 1, 0, 1, 0x0E, 2, 0, 0],                                     // interface 1: depth
        &[14, 0x24, 1, 1, 0x8C, 0x00, 0x82, 0, 4, 0, 0, 0, 1, 0],
        &[28, 0x24, 0x10, 1, 2, b'Z', b'1', b'6', b' ', 0, 0, 0x10, 0, 0x80, 0, 0, 0xAA, 0, 0x38, 0x9B, 0x71,
            16, 1, 0, 0, 0, 0, 0],
        &[34, 0x24, 0x11, 1, 0, 0x80, 0x02, 0xE0, 0x01, 1, 0, 0, 0, 2, 0, 0, 0, // 640x480
            0x15, 0x16, 0x05, 0, 2, 0x00, 0x05, 0, 0, 0x15, 0x16, 0x05, 0, 0x2A, 0x2C, 0x0A, 0],
        &[30, 0x24, 0x11, 2, 0, 0x00, 0x05, 0xD0, 0x02, 1, 0, 0, 0, 2, 0, 0, 0, // 1280x720
            0x15, 0x16, 0x05, 0, 1, 0x00, 0x0A, 0, 0, 0x15, 0x16, 0x05, 0],
        &[6, 0x24, 0x0D, 1, 1, 4],
        &[7, 0x05, 0x82, 2, 0x00, 0x04, 0], &[6, 0x30, 15, 0, 0, 0],
        &[9, 0x04, 2, 0, 1, 0x0E, 2, 0, 0],                                     // interface 2: infrared
        &[14, 0x24, 1, 1, 0x8C, 0x00, 0x83, 0, 4, 0, 0, 0, 1, 0],
        &[27, 0x24, 4, 1, 1, 0x32, 0, 0, 0, 0x02, 0, 0x10, 0, 0x80, 0, 0, 0xAA, 0, 0x38, 0x9B, 0x71, 8, 1, 0, 0, 0, 0],
        &[38, 0x24, 5, 1, 0, 0x50, 0x03, 0xE0, 0x01, 1, 0, 0, 0, 2, 0, 0, 0, 0x00, 0x36, 0x06, 0, // 848x480
            0x15, 0x16, 0x05, 0, 0, 0x07, 0xB2, 0x01, 0, 0x0A, 0x8B, 0x1A, 0, 0x05, 0, 0, 0],
        &[7, 0x05, 0x83, 2, 0x00, 0x04, 0], &[6, 0x30, 15, 0, 0, 0],
        &[9, 0x04, 3, 0, 0, 0x0E, 1, 0, 0],                                     // interface 3: control
        &[13, 0x24, 1, 0x50, 0x01, 0x0D, 0x00, 0x00, 0x6C, 0xDC, 0x02, 1, 4],
        &[9, 0x04, 4, 0, 0, 0x0E, 2, 0, 0],                                     // interface 4: colour, setting 0
        &[14, 0x24, 1, 1, 0x8C, 0x00, 0x84, 0, 4, 0, 0, 0, 1, 0],
        &[11, 0x24, 6, 1, 1, 0, 1, 0, 0, 0, 0],
        &[30, 0x24, 7, 1, 0, 0x80, 0x02, 0xE0, 0x01, 1, 0, 0, 0, 2, 0, 0, 0, 0x00, 0x60, 0x09, 0,
            0x15, 0x16, 0x05, 0, 1, 0x15, 0x16, 0x05, 0],
        &[9, 0x04, 4, 1, 1, 0x0E, 2, 0, 0],                                     // setting 1
        &[7, 0x05, 0x84, 5, 0x00, 0x14, 1],                                     // 3 packets of 1024 bytes
        &[9, 0x04, 5, 0, 1, 3, 0, 0, 0], &[9, 0x21, 0x11, 1, 0, 1, 0x22, 0x10, 0], &[7, 0x05, 0x86, 3, 64, 0, 4],
        &[9, 0x04, 6, 0, 2, 0xFF, 0, 0, 0],                                     // interface 6: the vendor's
        &[7, 0x05, 0x01, 2, 0x00, 0x04, 0], &[6, 0x30, 15, 0, 0, 0],
        &[7, 0x05, 0x81, 2, 0x00, 0x04, 0], &[6, 0x30, 15, 0, 0, 0],
    ];
    let body = body.concat();
    let total = (body.len() as u16 + 9).to_le_bytes();
    let mut all = vec![9, 0x02, total[0], total[1], 7, 1, 0, 0x80, 90];
    all.extend_from_slice(&body);
    all
}

#[test]
fn control_units_are_found() {
    let c = Configuration::parse(&d435()).unwrap();
    assert_eq!(c.value, 1);
    let numbers: Vec<_> = c.controls.iter().map(|i| (i.number, i.streams.clone())).collect();
    assert_eq!(numbers, [(0, vec![1, 2]), (3, vec![4])]);
    let depth = &c.controls[0];
    assert_eq!((depth.uvc_version, depth.clock_hz), (0x0150, 48_000_000));
    let units: Vec<_> = depth.units.iter().map(|u| (u.id, u.controls.clone())).collect();
    assert_eq!(units, [(1, vec![0x0A, 0, 0]), (2, vec![0, 2, 0]), (3, vec![0xFF, 0xFF, 1]), (4, vec![])]);
    let UnitKind::Extension { guid } = depth.units[2].kind else { panic!("{:?}", depth.units[2]) };
    assert_eq!(guid.to_string(), "C9606CCB-594C-4D25-AF47-CCC496435995");
    assert_eq!(c.extension(guid).map(|(i, unit)| (i.number, unit)), Some((0, 3)));
    assert_eq!(c.extension(Guid::default()), None);
    assert_eq!(c.control_of(4).map(|i| i.number), Some(3));
    assert_eq!(c.control_of(5), None);
}

#[test]
fn formats_and_sizes_of_every_kind_are_found() {
    let c = Configuration::parse(&d435()).unwrap();
    let depth = c.stream(1).unwrap();
    let (format, size) = depth.find(FourCc::Z16, 640, 480).unwrap();
    assert_eq!((format.kind, format.index, format.bits_per_pixel), (FormatKind::FrameBased, 1, 16));
    assert_eq!((size.index, size.max_bytes, size.bytes_per_line), (1, None, 1280));
    assert_eq!(size.bytes(format), Some(614_400));
    assert_eq!(size.default_interval, Interval(333_333));
    assert_eq!(size.intervals, Intervals::Discrete(vec![Interval(333_333), Interval(666_666)]));
    assert_eq!(size.interval_for(15.0), Some(Interval(666_666)));
    assert_eq!(size.interval_for(60.0), None);
    assert_eq!(depth.find(FourCc::Z16, 1280, 720).map(|(_, s)| s.index), Some(2));
    assert_eq!(depth.find(FourCc::Z16, 1280, 480), None);
    assert_eq!(depth.find(FourCc::GREY, 640, 480), None);

    let infrared = c.stream(2).unwrap();
    let (format, size) = infrared.find(FourCc::GREY, 848, 480).unwrap();
    assert_eq!((format.kind, size.max_bytes), (FormatKind::Uncompressed, Some(407_040)));
    assert_eq!(
        size.intervals,
        Intervals::Continuous { min: Interval(111_111), max: Interval(1_739_530), step: Interval(5) }
    );
    assert_eq!(size.interval_for(30.0), Some(Interval(333_331)));
    assert_eq!(size.interval_for(90.0), Some(Interval(111_111)));
    assert_eq!(size.interval_for(1.0), None);
    assert_eq!(size.interval_for(1e-9), None);

    let color = c.stream(4).unwrap();
    let (format, size) = color.find(FourCc::MJPG, 640, 480).unwrap();
    assert_eq!((format.kind, size.bytes(format)), (FormatKind::Mjpeg, None));
    assert_eq!(size.max_bytes, Some(614_400));
}

#[test]
fn end_points_are_found() {
    let c = Configuration::parse(&d435()).unwrap();
    let (setting, depth) = c.stream(1).unwrap().image_endpoint().unwrap();
    assert_eq!((setting, depth.address, depth.kind), (0, 0x82, TransferKind::Bulk));
    assert_eq!((depth.packet_bytes, depth.packets), (1024, 1));
    assert_eq!(depth.companion, Some(Companion { max_burst: 15, attributes: 0, bytes_per_interval: 0 }));
    let (setting, color) = c.stream(4).unwrap().image_endpoint().unwrap();
    assert_eq!((setting, color.kind), (1, TransferKind::Isochronous));
    assert_eq!((color.packet_bytes, color.packets, color.companion), (1024, 3, None));
    let (number, out, back) = c.vendor_channel().unwrap();
    assert_eq!((number, out.address, back.address), (6, 0x01, 0x81));
    assert_eq!(c.others.iter().map(|i| i.class).collect::<Vec<_>>(), [3, 0xFF]);
}

#[test]
fn a_descriptor_that_is_cut_off_is_refused_at_every_length() {
    let whole = d435();
    for n in 0..whole.len() {
        let e = Configuration::parse(&whole[..n]).unwrap_err();
        assert_eq!(e.kind(), depthrig_driver::ErrorKind::Protocol, "{n} bytes: {e}");
    }
    // The same when its length agrees: everything up to the cut is read, or the descriptor in which it is, refused.
    let mut read = 0;
    for n in 9..whole.len() {
        let mut cut = whole[..n].to_vec();
        cut[2..4].copy_from_slice(&(n as u16).to_le_bytes());
        read += usize::from(Configuration::parse(&cut).is_ok());
    }
    let descriptors = 41;
    assert_eq!(read, descriptors - 1, "readable at the borders between descriptors alone");
}

#[test]
fn a_descriptor_with_too_few_bytes_for_its_fields_is_named() {
    // The count of intervals says three, and the descriptor has room for one.
    let mut bytes = d435();
    let at = bytes.windows(4).position(|w| w == [30, 0x24, 0x11, 2]).unwrap();
    bytes[at + 21] = 3;
    let message = Configuration::parse(&bytes).unwrap_err().to_string();
    assert!(message.contains(&format!("subtype 0x11 at byte {at}")), "{message}");
    // A frame size of JPEG images behind an uncompressed format.
    let mut bytes = d435();
    bytes[at + 2] = 7;
    let message = Configuration::parse(&bytes).unwrap_err().to_string();
    assert!(message.contains("follows no format of its kind"), "{message}");
    // A length of zero would be read for ever.
    let mut bytes = d435();
    bytes[at] = 0;
    assert!(Configuration::parse(&bytes).is_err());
}

#[test]
fn an_unknown_descriptor_is_passed_over() {
    let mut bytes = d435();
    bytes.extend_from_slice(&[5, 0xEE, 1, 2, 3]);
    let n = bytes.len() as u16;
    bytes[2..4].copy_from_slice(&n.to_le_bytes());
    assert_eq!(Configuration::parse(&bytes).unwrap(), Configuration::parse(&d435()).unwrap());
}

proptest! {
    #[test]
    fn any_bytes_are_read_or_refused(bytes in proptest::collection::vec(any::<u8>(), 0..400)) {
        let _ = Configuration::parse(&bytes);
    }

    #[test]
    fn a_damaged_descriptor_is_read_or_refused(
        damage in proptest::collection::vec((9_usize..400, any::<u8>()), 1..8),
        rate in 0.1..1000.0_f64,
    ) {
        let mut bytes = d435();
        for (at, value) in damage {
            if let Some(b) = bytes.get_mut(at) { *b = value; }
        }
        if let Ok(c) = Configuration::parse(&bytes) {
            for stream in &c.streams {
                let _ = stream.image_endpoint();
                for (format, size) in stream.formats.iter().flat_map(|f| f.frames.iter().map(move |s| (f, s))) {
                    let _ = size.bytes(format);
                    if let Some(interval) = size.interval_for(rate) {
                        prop_assert!((interval.rate_hz() / rate - 1.0).abs() < 0.01);
                    }
                }
            }
        }
    }
}
