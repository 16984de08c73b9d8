use super::*;
use proptest::prelude::*;

fn u32_to(b: &mut [u8], at: usize, v: u32) {
    b[at..at + 4].copy_from_slice(&v.to_le_bytes());
}

/// A depth frame's header of 232 bytes by the note's offsets from the start of the header.
fn depth_by_hand() -> Vec<u8> {
    let mut b = vec![0u8; 232];
    b[0] = 232;
    b[1] = 0x8F;
    u32_to(&mut b, 2, 100_000);
    u32_to(&mut b, 6, 123_456);
    b[10..12].copy_from_slice(&[0x34, 0x12]);
    // Capture timing at 12.
    u32_to(&mut b, 12, 0x8000_0001);
    u32_to(&mut b, 16, 40);
    u32_to(&mut b, 20, 3);
    u32_to(&mut b, 24, 0x3F);
    for (i, v) in [4711, 8_500, 11_000, 16_000, 33_333, 5_000].into_iter().enumerate() {
        u32_to(&mut b, 28 + 4 * i, v);
    }
    // Capture statistics at 52.
    u32_to(&mut b, 52, 0x0000_0003);
    u32_to(&mut b, 56, 80);
    u32_to(&mut b, 60, 1);
    u32_to(&mut b, 64, 99_999);
    u32_to(&mut b, 68, 160);
    u32_to(&mut b, 100, 4600);
    // Depth control at 132.
    u32_to(&mut b, 132, 0x8000_0000);
    u32_to(&mut b, 136, 60);
    u32_to(&mut b, 140, 1);
    u32_to(&mut b, 144, 0x1FF);
    for (i, v) in [16, 15_999, 150, 1, 7, 10, 838, 20, 460, 3].into_iter().enumerate() {
        u32_to(&mut b, 148 + 4 * i, v);
    }
    b[188] = 2;
    b[190..192].copy_from_slice(&[0x2C, 0x01]);
    // Configuration at 192.
    u32_to(&mut b, 192, 0x8000_0002);
    u32_to(&mut b, 196, 40);
    u32_to(&mut b, 200, 2);
    u32_to(&mut b, 204, 0x4FB);
    (b[208], b[209]) = (6, 9);
    b[214..216].copy_from_slice(&[5, 0]);
    b[216..218].copy_from_slice(&848u16.to_le_bytes());
    b[218..220].copy_from_slice(&480u16.to_le_bytes());
    b[220..222].copy_from_slice(&30u16.to_le_bytes());
    b[222..224].copy_from_slice(&[2, 1]);
    u32_to(&mut b, 227, 0xAABB_CCDD);
    b
}

#[test]
fn a_depth_frame_field_by_field() {
    let bytes = depth_by_hand();
    let all = Metadata::parse(&bytes).unwrap();
    assert_eq!(
        all.header,
        PayloadHeader { length: 232, flags: 0x8F, pts: Some(100_000), scr: Some((123_456, 0x1234)) }
    );
    let timing = CaptureTiming {
        version: 3,
        frame_counter: Some(4711),
        sensor_timestamp_us: Some(8_500),
        readout_us: Some(11_000),
        exposure_us: Some(16_000),
        interval_us: Some(33_333),
        latency_us: Some(5_000),
    };
    assert_eq!(all.timing, Some(timing));
    let stats = CaptureStats { flags: 1, hw_timestamp: 99_999, exposure: 160, white_balance_k: 4600 };
    assert_eq!(all.stats, Some(stats));
    let depth = DepthControl {
        version: 1,
        gain: Some(16),
        exposure_us: Some(15_999),
        laser_power_mw: Some(150),
        auto_exposure: Some(true),
        exposure_priority: Some(7),
        roi: Some([10, 838, 20, 460]),
        preset: Some(3),
        emitter: Some(2),
        led_power: Some(300),
    };
    assert_eq!(all.depth, Some(depth));
    let configuration = Configuration {
        version: 2,
        hw_type: Some(6),
        sku: Some(9),
        format: Some(5),
        width: Some(848),
        height: Some(480),
        rate_hz: Some(30),
        trigger: Some(0x0102),
        sub_preset: Some(0xAABB_CCDD),
    };
    assert_eq!(all.configuration, Some(configuration));
    assert_eq!(configuration.trigger(), Some(Trigger::External));
    assert_eq!(all.color, None);
    assert_eq!(all.frame_counter(), Some(4711));
    assert_eq!(all.mid_exposure_us(), Some(91_500));
    assert_eq!((all.exposure_us(), all.gain()), (Some(15_999), Some(16)));

    let vendor = [timing.build(), stats.build(), depth.build(), configuration.build()].concat();
    assert_eq!(all.header.build(&vendor).unwrap(), bytes);
}

#[test]
fn a_colour_frame_field_by_field() {
    let timing =
        CaptureTiming { frame_counter: Some(1), exposure_us: Some(3_100), ..CaptureTiming::default() };
    let mut control = vec![0u8; 72];
    u32_to(&mut control, 0, 0x8000_0005);
    u32_to(&mut control, 4, 72);
    u32_to(&mut control, 8, 4);
    u32_to(&mut control, 12, 0x1C70);
    for (i, v) in [(4, 8), (5, 5200), (6, 64), (10, 156), (11, 4600), (12, 3)] {
        u32_to(&mut control, 16 + 4 * i, v);
    }
    let header = PayloadHeader { pts: Some(50), scr: Some((0, 0)), flags: EOH | EOF, length: 0 };
    let vendor = [timing.build(), CaptureStats::default().build(), control.clone()].concat();
    let bytes = header.build(&vendor).unwrap();
    assert_eq!(bytes[..2], [204, 0x8E], "as the note has a colour frame up to its configuration");
    let all = Metadata::parse(&bytes).unwrap();
    let color = ColorControl {
        version: 4,
        auto_exposure: Some(true),
        auto_white_balance_k: Some(5200),
        gain: Some(64),
        manual_exposure_100us: Some(156),
        manual_white_balance_k: Some(4600),
        power_line: Some(3),
    };
    assert_eq!(all.color, Some(color));
    assert_eq!(color.build(), control);
    assert_eq!((all.exposure_us(), all.gain(), all.mid_exposure_us()), (Some(3_100), Some(64), None));
    u32_to(&mut control, 32, 1);
    let manual = header.build(&control).unwrap();
    assert_eq!(Metadata::parse(&manual).unwrap().color.unwrap().auto_exposure, Some(false));
}

#[test]
fn an_l515_by_hand() {
    let mut control = vec![0u8; 28];
    u32_to(&mut control, 0, 0x8000_0012);
    u32_to(&mut control, 4, 28);
    u32_to(&mut control, 12, 7);
    for (i, v) in [9, 5, 1].into_iter().enumerate() {
        u32_to(&mut control, 16 + 4 * i, v);
    }
    let l515 = L515DepthControl { version: 0, laser_power: Some(9), preset: Some(5), laser_mode: Some(1) };
    let mut timing = CaptureTiming { frame_counter: Some(3), ..CaptureTiming::default() }.build();
    timing[0] = 0x10; // id 0x80000010
    let header = PayloadHeader { pts: Some(1), ..PayloadHeader::default() };
    let all = Metadata::parse(&header.build(&[timing, control.clone()].concat()).unwrap()).unwrap();
    assert_eq!(all.l515_depth, Some(l515));
    assert_eq!(all.frame_counter(), Some(3));
    assert_eq!(l515.build(), control);
}

#[test]
fn mid_exposure_wraps_with_the_clock() {
    let mut b = depth_by_hand();
    u32_to(&mut b, 2, 500);
    assert_eq!(Metadata::parse(&b).unwrap().mid_exposure_us(), Some(500u32.wrapping_sub(8_500)));
}

#[test]
fn fields_without_their_flag_are_not_there() {
    let mut b = depth_by_hand();
    for at in [24, 144, 204] {
        u32_to(&mut b, at, 0);
    }
    let all = Metadata::parse(&b).unwrap();
    assert_eq!(all.timing, Some(CaptureTiming { version: 3, ..CaptureTiming::default() }));
    assert_eq!(all.depth, Some(DepthControl { version: 1, ..DepthControl::default() }));
    assert_eq!(all.configuration, Some(Configuration { version: 2, ..Configuration::default() }));
    for bit in 0..11 {
        u32_to(&mut b, 144, 1 << bit);
        u32_to(&mut b, 24, 1 << bit);
        let all = Metadata::parse(&b).unwrap();
        let t = all.timing.unwrap();
        let d = all.depth.unwrap();
        assert_eq!(
            [
                t.frame_counter,
                t.sensor_timestamp_us,
                t.readout_us,
                t.exposure_us,
                t.interval_us,
                t.latency_us
            ]
            .map(|f| f.is_some()),
            core::array::from_fn(|i| i == bit)
        );
        assert_eq!(
            [
                d.gain.is_some(),
                d.exposure_us.is_some(),
                d.laser_power_mw.is_some(),
                d.auto_exposure.is_some(),
                d.exposure_priority.is_some(),
                d.roi.is_some(),
                d.preset.is_some(),
                d.emitter.is_some(),
                d.led_power.is_some()
            ],
            core::array::from_fn(|i| i == bit)
        );
    }
}

#[test]
fn the_standard_part_alone() {
    let bytes = [12, 0x8E, 1, 0, 0, 0, 2, 0, 0, 0, 3, 0];
    let (header, vendor) = PayloadHeader::parse(&bytes).unwrap();
    assert_eq!((header.pts, header.scr, vendor), (Some(1), Some((2, 3)), &[][..]));
    assert_eq!(header.build(&[]).unwrap(), bytes);
    // Without clock sample, without time, and as the kernel's UVCH has it: cut behind the standard part.
    assert_eq!(PayloadHeader::parse(&[6, 0x84, 9, 0, 0, 0]).unwrap().0.pts, Some(9));
    assert_eq!(PayloadHeader::parse(&[2, 0x80]).unwrap().0.pts, None);
    let cut = [232, 0x8E, 1, 0, 0, 0, 2, 0, 0, 0, 3, 0];
    assert_eq!(PayloadHeader::parse(&cut).unwrap().1, [0; 0]);
    // It says that it is shorter than its own standard part.
    assert_eq!(PayloadHeader::parse(&[11, 0x8E, 1, 0, 0, 0, 2, 0, 0, 0, 3, 0]), None);
    for n in 0..12 {
        assert_eq!(PayloadHeader::parse(&bytes[..n]), None, "{n}");
    }
    assert_eq!(PayloadHeader::default().build(&[0; 254]), None);
}

#[test]
fn cut_off_at_every_length_gives_the_complete_blocks() {
    let bytes = depth_by_hand();
    for n in 0..=bytes.len() {
        let Some(all) = Metadata::parse(&bytes[..n]) else {
            assert!(n < 12, "{n}");
            continue;
        };
        let there =
            [all.timing.is_some(), all.stats.is_some(), all.depth.is_some(), all.configuration.is_some()];
        assert_eq!(there, [n >= 52, n >= 132, n >= 192, n >= 232], "{n}");
    }
}

#[test]
fn sizes_that_lie_end_the_walk() {
    for size in [0, 1, 7, 221, 10_000, u32::MAX] {
        let mut b = depth_by_hand();
        u32_to(&mut b, 56, size);
        let all = Metadata::parse(&b).unwrap();
        assert!(all.timing.is_some() && all.depth.is_none() && all.configuration.is_none(), "{size}");
    }
    // An unknown block, and one that is shorter than its kind, are skipped.
    let mut b = depth_by_hand();
    u32_to(&mut b, 52, 0x1234_5678);
    assert!(Metadata::parse(&b).unwrap().configuration.is_some());
    let mut short = vec![0u8; 8 + 40];
    u32_to(&mut short, 0, 0x8000_0001);
    u32_to(&mut short, 4, 8);
    short[8..].copy_from_slice(&Configuration { width: Some(3), ..Configuration::default() }.build());
    let all = Metadata::parse(&PayloadHeader::default().build(&short).unwrap()).unwrap();
    assert_eq!((all.timing, all.configuration.unwrap().width), (None, Some(3)));
}

#[test]
fn kernel_records_by_hand() {
    let header = depth_by_hand();
    let mut b = 0x0102_0304_0506_0708u64.to_le_bytes().to_vec();
    b.extend([0xCD, 0x07]);
    b.extend(&header);
    assert_eq!(build_record(0x0102_0304_0506_0708, 0x07CD, &header), b);
    // The note's 22 bytes: the stamp and the standard part.
    assert_eq!(b[12..16], 100_000u32.to_le_bytes());
    assert_eq!(b[22..26], 0x8000_0001u32.to_le_bytes());

    let twice = [b.clone(), b.clone()].concat();
    let whole: Vec<_> = records(&twice, RecordFormat::Whole).collect();
    let record = Record { system_ns: 0x0102_0304_0506_0708, host_sof: 0x07CD, header: &header };
    assert_eq!(whole, [record, record]);

    // UVCH keeps the length of the whole header and 12 bytes of it.
    let cut = [&b[..22], &b[..22]].concat();
    let standard: Vec<_> = records(&cut, RecordFormat::Standard).collect();
    assert_eq!(standard.len(), 2);
    for r in standard {
        assert_eq!(r.header, &header[..12]);
        assert_eq!(Metadata::parse(r.header).unwrap().header.pts, Some(100_000));
    }
    for n in 0..=twice.len() {
        assert_eq!(records(&twice[..n], RecordFormat::Whole).count(), n / 242, "{n}");
    }
    for n in 0..=cut.len() {
        assert_eq!(records(&cut[..n], RecordFormat::Standard).count(), n / 22, "{n}");
    }
    // A header that says it is shorter than its flags need.
    let mut lie = b;
    lie[10] = 5;
    assert_eq!(records(&lie, RecordFormat::Whole).count(), 0);
}

proptest! {
    #[test]
    fn any_bytes(bytes in prop::collection::vec(any::<u8>(), 0..600)) {
        let _ = Metadata::parse(&bytes);
        for format in [RecordFormat::Standard, RecordFormat::Whole] {
            for record in records(&bytes, format) {
                let _ = Metadata::parse(record.header);
            }
        }
    }

    /// Any change of a real header leaves a walk that ends, and blocks that build what they were read from.
    #[test]
    fn damaged_headers(at in 0usize..232, value in any::<u8>(), at2 in 0usize..232, value2 in any::<u8>()) {
        let mut b = depth_by_hand();
        (b[at], b[at2]) = (value, value2);
        if let Some(all) = Metadata::parse(&b)
            && let Some(timing) = all.timing
        {
            let again = Metadata::parse(&all.header.build(&timing.build()).unwrap()).unwrap();
            prop_assert_eq!(again.timing, Some(timing));
        }
    }
}
