//! The emulator without a kernel: a test plays the host at the other end of the socket.
// Helpers of tests are not themselves tests, so `allow-unwrap-in-tests` does not cover them.
#![allow(clippy::unwrap_used)]

mod usb;

use depthrig_emulator::model::Size;
use depthrig_emulator::usbip;
use depthrig_emulator::{Camera, Damage, Fault, Model, Options, Speed, Stamp};
use depthrig_realsense::protocol::gvd::Gvd;
use depthrig_realsense::protocol::tables::{Coefficients, RgbTable};
use depthrig_usb::uvc::descriptors::{Configuration, TransferKind};
use std::sync::Arc;
use std::time::Duration;
use usb::Host;

fn camera(model: &str, options: Options) -> (Camera, Host) {
    let camera = Camera::unplugged(Arc::new(Model::named(model).unwrap()), options).unwrap();
    let (host, line) = Host::new();
    camera.serve(line).unwrap();
    (camera, host)
}

/// The parser that the libusb path uses reads every model at both speeds, and finds the contents of the model's file.
#[test]
fn descriptors_are_what_a_driver_reads() {
    for name in Model::names() {
        for speed in [Speed::Super, Speed::High] {
            let (camera, mut host) = camera(name, Options { speed, ..Options::default() });
            let device = host.control_in([0x80, 6, 0, 1, 0, 0, 18, 0]).unwrap();
            let usb = u16::from_le_bytes([device[2], device[3]]);
            assert_eq!(usb, if speed == Speed::Super { 0x0320 } else { 0x0210 }, "{name}");
            let head = host.control_in([0x80, 6, 0, 2, 0, 0, 9, 0]).unwrap();
            let all = host.control_in([0x80, 6, 0, 2, 0, 0, 0xFF, 0xFF]).unwrap();
            assert_eq!(
                usize::from(u16::from_le_bytes([head[2], head[3]])),
                all.len(),
                "{name}: wTotalLength"
            );
            well_formed(name, &all);
            let parsed = Configuration::parse(&all).unwrap();
            assert_eq!(parsed.streams.len(), camera.model().streams().count(), "{name}");
            for (seen, stream) in parsed.streams.iter().zip(camera.model().streams()) {
                assert_eq!((seen.number, seen.endpoint), (stream.interface, stream.endpoint), "{name}");
                assert_eq!(seen.settings.len(), 1, "{name}: bulk streams have one setting");
                let endpoint = seen.settings[0].endpoints[0];
                assert_eq!(endpoint.kind, TransferKind::Bulk);
                assert_eq!(endpoint.packet_bytes, if speed == Speed::Super { 1024 } else { 512 });
                assert_eq!(endpoint.companion.map(|c| c.max_burst), (speed == Speed::Super).then_some(15));
                let offered: Vec<(u16, u16)> = stream
                    .formats
                    .iter()
                    .flat_map(|f| if speed == Speed::High { &f.usb2 } else { &f.usb3 })
                    .map(|text| Size::parse(text).map(|s| (s.width, s.height)).unwrap())
                    .collect();
                let read: Vec<(u16, u16)> =
                    seen.formats.iter().flat_map(|f| &f.frames).map(|f| (f.width, f.height)).collect();
                assert_eq!(read, offered, "{name} {}", stream.name);
            }
        }
    }
}

/// Rules that hold for every configuration: lengths add up, interfaces are numbered without a gap, no endpoint is
/// used twice.
fn well_formed(name: &str, all: &[u8]) {
    let mut at = 0;
    let mut interfaces = Vec::new();
    let mut endpoints = Vec::new();
    while at < all.len() {
        let length = usize::from(all[at]);
        assert!(length >= 2 && at + length <= all.len(), "{name}: a descriptor of {length} bytes at {at}");
        match all[at + 1] {
            4 => interfaces.push(all[at + 2]),
            5 => endpoints.push(all[at + 2]),
            _ => {}
        }
        at += length;
    }
    assert_eq!(interfaces, (0..all[4]).collect::<Vec<u8>>(), "{name}: bNumInterfaces");
    let count = endpoints.len();
    endpoints.sort_unstable();
    endpoints.dedup();
    assert_eq!(endpoints.len(), count, "{name}: an endpoint is used twice");
}

/// Facts of a public `lsusb -v` of a D435i (librealsense issue 13589) and of a D435 on USB 2 (issue 4042).
#[test]
fn descriptors_agree_with_public_dumps() {
    let (_camera, mut host) = camera("d435i", Options::default());
    let device = host.control_in([0x80, 6, 0, 1, 0, 0, 18, 0]).unwrap();
    assert_eq!(
        device[..8],
        [18, 1, 0x20, 3, 239, 2, 1, 9],
        "3.20, miscellaneous, interface association, 512 bytes"
    );
    assert_eq!(device[8..12], [0x86, 0x80, 0x3A, 0x0B]);
    assert_eq!(device[14..18], [1, 2, 3, 1], "the strings and one configuration");
    let all = host.control_in([0x80, 6, 0, 2, 0, 0, 0xFF, 0xFF]).unwrap();
    assert_eq!(all[7..9], [0xC0, 55], "self-powered, 440 mA");
    assert_eq!(all[9..17], [8, 11, 0, 3, 14, 3, 0, all[16]], "the depth function has three interfaces");
    let parsed = Configuration::parse(&all).unwrap();
    let ir = &parsed.streams[1].formats[0];
    assert_eq!(
        ir.guid.0[..4],
        [0x32, 0, 0, 0],
        "infrared is format 0x32 with descriptors of frame-based payloads"
    );
    let first = &ir.frames[0];
    assert_eq!((first.width, first.height), (256, 144));
    assert_eq!((first.min_bit_rate, first.max_bit_rate), (26_542_080, 88_473_600), "90 and 300 Hz");
    let (_camera, mut host) = camera("d435", Options { speed: Speed::High, ..Options::default() });
    let device = host.control_in([0x80, 6, 0, 1, 0, 0, 18, 0]).unwrap();
    assert_eq!(device[..8], [18, 1, 0x10, 2, 239, 2, 1, 64], "2.10 with packets of 64 bytes");
}

fn request(opcode: u32, params: [u32; 4]) -> Vec<u8> {
    let mut bytes = vec![0x14, 0, 0xAB, 0xCD];
    for value in [opcode].iter().chain(&params) {
        bytes.extend(value.to_le_bytes());
    }
    bytes
}

#[test]
fn both_ways_to_the_hardware_monitor_answer_the_same() {
    let (camera, mut host) = camera("d435", Options::default());
    for (opcode, p1) in [(0x10, 0), (0x15, 25), (0x15, 32), (0x7E, 0), (0x2C, 9), (0x15, 31), (0x99, 0)] {
        let message = request(opcode, [p1, 0, 0, 0]);
        let by_unit = host.monitor(&message).unwrap();
        host.bulk_out(1, &message);
        assert_eq!(host.bulk_in(1, 1024).1, by_unit, "opcode {opcode:#x} {p1}");
    }
    let gvd = Gvd::parse(&host.monitor(&request(0x10, [0; 4])).unwrap()[4..]).unwrap();
    assert_eq!((gvd.serial.as_str(), gvd.asic_serial), (camera.serial(), camera.usb_serial()));
    let table = host.monitor(&request(0x15, [25, 0, 0, 0])).unwrap();
    assert_eq!(Coefficients::parse(&table[4..]).ok(), camera.calibration().coefficients);
    let table = host.monitor(&request(0x15, [32, 0, 0, 0])).unwrap();
    assert_eq!(RgbTable::parse(&table[4..]).ok(), camera.calibration().rgb);
    assert_eq!(host.monitor(&request(0x99, [0; 4])).unwrap(), (-1i32).to_le_bytes());
}

#[test]
fn faults_of_the_flash_and_of_replies() {
    let (camera, mut host) = camera("d455", Options::default());
    let ask = request(0x15, [25, 0, 0, 0]);
    let good = host.monitor(&ask).unwrap();
    camera.fault(Fault::DamagedTable(25)).unwrap();
    assert!(Coefficients::parse(&host.monitor(&ask).unwrap()[4..]).is_err(), "the checksum does not fit");
    camera.fault(Fault::Clear).unwrap();
    camera.fault("reply opcode 1".parse().unwrap()).unwrap();
    assert_ne!(host.monitor(&ask).unwrap()[0], 0x15);
    assert_eq!(host.monitor(&ask).unwrap(), good, "one wrong reply, no more");
    camera.fault("reply truncated 1".parse().unwrap()).unwrap();
    assert_eq!(host.monitor(&ask).unwrap(), good[..good.len() / 2]);
    camera.fault("reply code -7 1".parse().unwrap()).unwrap();
    assert_eq!(host.monitor(&ask).unwrap(), (-7i32).to_le_bytes());
    camera.fault(Fault::ControlStall { times: 1 }).unwrap();
    assert!(host.monitor(&ask).is_none(), "STALL");
    assert_eq!(host.monitor(&ask).unwrap(), good);
    assert_eq!(camera.faults().values().sum::<u64>(), 6);
}

/// One frame at a time: its contents and the accounts.
#[test]
fn frames_and_damage() {
    let (camera, mut host) = camera("d435", Options::default());
    let mode = (1, 4); // 640x480 in the list of the first format
    host.commit(1, mode.0, mode.1 + 1, 333_333);
    let mut last = None;
    for _ in 0..3 {
        let (header, body) = host.frame(2);
        assert_eq!((header.len(), header[1] & 0xFE), (232, 0x8E));
        let stamp = Stamp::read(&body).unwrap();
        assert_eq!(body, camera.expected("depth", stamp.index).unwrap());
        // A host that a busy computer holds up misses some.
        assert!(last.is_none_or(|last| stamp.index > last));
        last = Some(stamp.index);
    }
    let length = 640 * 480 * 2;
    for (damage, bytes) in
        [(Damage::ErrorBit, length), (Damage::Short, length / 3), (Damage::Long, length + 512)]
    {
        camera.fault(Fault::Frames { stream: "depth".into(), damage, frames: 1 }).unwrap();
        // The fault may come behind a frame that is on its way.
        let damaged = (0..3).map(|_| host.frame(2)).find(|(h, b)| h[1] & 0x40 != 0 || b.len() != length);
        assert_eq!(damaged.unwrap().1.len(), bytes, "{damage:?}");
    }
    // A frame is counted when its last transfer is answered, which the host may see first.
    let settled = || {
        let accounts = camera.accounts("depth").unwrap();
        let damaged = accounts.error_bit + accounts.short + accounts.long;
        (damaged >= 3 && accounts.good + damaged == accounts.sent).then_some(accounts)
    };
    let waits = core::iter::repeat_n(Duration::from_millis(5), 1000);
    let accounts = waits.map(std::thread::sleep).find_map(|()| settled()).expect("three damaged frames");
    assert_eq!((accounts.error_bit, accounts.short, accounts.long), (1, 1, 1));
}

/// The kernel takes a frame whose bit has not changed for more of the one before, and drops it.
#[test]
fn the_frame_bit_changes_with_every_frame_that_is_sent() {
    let (camera, mut host) = camera("d435", Options::default());
    host.commit(1, 1, 1, 33_333);
    let mut bit = host.frame(2).0[1] & 1;
    for damage in [Damage::Skip, Damage::Repeat, Damage::Skip] {
        camera.fault(Fault::Frames { stream: "depth".into(), damage, frames: 1 }).unwrap();
        for _ in 0..5 {
            let next = host.frame(2).0[1] & 1;
            assert_ne!(next, bit, "around {damage:?}");
            bit = next;
        }
    }
    let accounts = camera.accounts("depth").unwrap();
    assert_eq!((accounts.skipped, accounts.repeated), (2, 1));
}

/// USB/IP's own rule: a transfer that is taken backends with ECONNRESET, one that had ended before with 0.
#[test]
fn a_transfer_that_is_taken_back_is_answered_once() {
    let (_camera, mut host) = camera("d435", Options::default());
    let waiting = host.submit(1, true, 512, [0; 8], &[]);
    assert_eq!(host.unlink(waiting), usbip::UNLINKED);
    host.bulk_out(1, &request(0x10, [0; 4]));
    let (seq, bytes) = host.bulk_in(1, 1024);
    assert_eq!(bytes[0], 0x10);
    assert_eq!(host.unlink(seq), 0);
}

/// While controls are held back, streams go on, and the answer comes at the end.
#[test]
fn a_control_that_times_out_does_not_stop_streams() {
    let (camera, mut host) = camera("d435", Options::default());
    host.commit(1, 1, 1, 33_333);
    camera.fault(Fault::ControlTimeout(Duration::from_millis(300))).unwrap();
    camera.fault(Fault::Clear).unwrap();
    assert!(host.monitor(&request(0x10, [0; 4])).is_some(), "it was cleared");
    camera.fault(Fault::ControlTimeout(Duration::from_millis(300))).unwrap();
    let held = host.submit(0, true, 8, [0xA1, 0x81, 0, 3, 0, 3, 4, 0], &[]);
    for _ in 0..3 {
        host.frame(2);
    }
    assert!(!host.has_ended(held), "the control is still held back");
    assert_eq!(host.wait(held).1.len(), 4);
}

#[test]
fn an_imu_reports_while_it_hears_from_the_host() {
    let (_camera, mut host) = camera("zed2i-mcu", Options { speed: Speed::High, ..Options::default() });
    host.control_out([0x21, 9, 0x32, 3, 0, 0, 2, 0], &[0x32, 1]).unwrap();
    let mut last = 0;
    for _ in 0..20 {
        let (_, report) = host.bulk_in(1, 64);
        let record = depthrig_zed::sensors::Record::parse(&report).unwrap();
        assert!(record.ticks > last && record.motion_valid);
        last = record.ticks;
    }
    host.control_out([0x21, 9, 0x32, 3, 0, 0, 2, 0], &[0x32, 0]).unwrap();
    let waiting = host.submit(1, true, 64, [0; 8], &[]);
    std::thread::sleep(Duration::from_millis(50));
    assert!(!host.has_ended(waiting), "it was asked to stop");
}

#[test]
fn a_zed_has_its_serial_in_its_flash() {
    use depthrig_zed::command::{Command, parse_serial};
    let (camera, mut host) = camera("zed2i", Options::default());
    assert!(camera.companion().is_some_and(|mcu| mcu.usb_serial() == camera.serial()));
    let block = Command::ReadFlash { address: 0x1_8000, length: 6 }.block();
    host.control_out([0x21, 1, 0, 2, 0, 4, 0x80, 1], &block).unwrap();
    let reply = host.control_in([0xA1, 0x81, 0, 2, 0, 4, 0x80, 1]).unwrap();
    assert_eq!(parse_serial(&reply[17..]).unwrap(), camera.serial());
}
