use super::*;
use core::time::Duration;
use depthrig_usb::uvc::control::{ControlPort, Query};
use proptest::prelude::*;
use std::collections::VecDeque;

fn hex(text: &str) -> Vec<u8> {
    text.split_whitespace().map(|b| u8::from_str_radix(b, 16).unwrap()).collect()
}

/// Every request that can be made from outside of this module, the private ones by the modules that make them.
fn every_request() -> Vec<Request> {
    let mut all = vec![
        Request::device_info(),
        Request::reset(),
        Request::clock(),
        Request::l515_clock(),
        Request::rectified_params(),
        Request::temperature(),
        Request::advanced_status(),
        Request::sync(),
        Request::imu_memory(),
        Request::l515_imu_table(),
        Request::l515_temperatures(),
        Request::l515_depth_intrinsics(),
        Request::l515_color_intrinsics(),
        Request::l515_color_extrinsics(),
    ];
    for n in [0, 1, 25, 32, 0x7FFF, u16::MAX] {
        all.push(Request::calibration_table(n));
        all.push(Request::get_advanced(n.into(), n.into()));
        all.push(Request::set_advanced(n.into(), &[0x1E; 20]).unwrap());
        all.push(Request::set_sync(n.into()));
        all.push(Request::l515_control(n.into(), n.into(), n.into()));
        all.push(Request::set_l515_control(n.into(), -1, n.into()));
    }
    all
}

#[test]
fn requests_are_the_published_bytes() {
    let zeros = |n| vec![0; n];
    assert_eq!(Request::device_info().to_bytes(), [hex("14 00 AB CD 10 00 00 00"), zeros(16)].concat());
    assert_eq!(
        Request::calibration_table(32).to_bytes(),
        [hex("14 00 AB CD 15 00 00 00 20 00 00 00"), zeros(12)].concat()
    );
    assert_eq!(
        Request::clock().to_bytes(),
        [hex("14 00 AB CD 01 00 00 00 3C 61 01 00 40 61 01 00"), zeros(8)].concat()
    );
    assert_eq!(
        Request::l515_clock().to_bytes(),
        [hex("14 00 AB CD 01 00 00 00 1C 02 03 90 20 02 03 90"), zeros(8)].concat()
    );
    assert_eq!(
        Request::set_advanced(9, &[0xE8, 3, 0, 0]).unwrap().to_bytes(),
        [hex("18 00 AB CD 2B 00 00 00 09 00 00 00"), zeros(12), hex("E8 03 00 00")].concat()
    );
    assert_eq!(
        Request::set_l515_control(5, -2, 1).to_bytes(),
        hex("14 00 AB CD 2B 00 00 00 05 00 00 00 FE FF FF FF 01 00 00 00 00 00 00 00")
    );
}

#[test]
fn at_the_unit_a_request_is_padded_to_1024() {
    let frame = Request::calibration_table(25).to_unit_frame();
    assert_eq!(frame.len(), 1024);
    assert_eq!(frame[..24], Request::calibration_table(25).to_bytes());
    assert!(frame[24..].iter().all(|b| *b == 0));
}

#[test]
fn nothing_that_writes_calibration_flash_or_firmware_can_be_sent() {
    // librealsense's fw_cmd of both families: what writes or erases flash, tables or fuses, and what starts an
    // update. 0x44 writes a table on an L515 (on a D400 it is the region of auto-exposure).
    let writing = [
        0x02, 0x0A, 0x0B, 0x0C, 0x0D, 0x0E, 0x16, 0x1D, 0x1E, 0x29, 0x2D, 0x2E, 0x2F, 0x35, 0x36, 0x3B, 0x44,
        0x51, 0x5B, 0x61, 0x62, 0x80, 0x83, 0xA6, 0xA8,
    ];
    for opcode in D4xxOpcode::ALL.iter().map(|o| o.code()).chain(L515Opcode::ALL.iter().map(|o| o.code())) {
        assert!(!writing.contains(&opcode), "{opcode:#x}");
    }
    for request in every_request() {
        let bytes = request.to_bytes();
        let opcode = u32::from_le_bytes(bytes[4..8].try_into().unwrap());
        assert!(!writing.contains(&opcode), "{request}");
        assert!(
            D4xxOpcode::from_code(opcode).is_some() || L515Opcode::from_code(opcode).is_some(),
            "{request}"
        );
    }
    // This test knows every constructor.
    let source = include_str!("request.rs");
    let made = source.matches("-> Self {").count() + source.matches("-> Result<Self> {").count();
    assert_eq!(made, 20 + 3, "a new constructor of Request belongs into every_request()");
}

#[test]
fn a_request_is_read_as_it_was_made() {
    for request in every_request() {
        let frame = request.to_unit_frame();
        for bytes in [&request.to_bytes()[..], &frame[..]] {
            let received = Received::parse(bytes).unwrap();
            assert_eq!(received.opcode, request.opcode());
            assert_eq!(received.params, request.params());
            assert_eq!(received.data, request.data());
        }
    }
    assert!(Request::set_advanced(9, &[0; 1001]).is_err());
    assert!(Received::parse(&hex("14 00 AB CE")).is_err());
    let mut wrong = Request::device_info().to_bytes();
    wrong[3] = 0xCE;
    assert!(Received::parse(&wrong).is_err(), "another magic number");
    let mut short = Request::device_info().to_bytes();
    short[0] = 0x13;
    assert!(Received::parse(&short).is_err(), "less than the header");
}

#[test]
fn a_reply_is_its_data_behind_the_echo() {
    let request = Request::clock();
    assert_eq!(reply_data(&request, &hex("01 00 00 00 11 22 33 44")).unwrap(), hex("11 22 33 44"));
    let mut frame = [0; 1024];
    frame[..8].copy_from_slice(&hex("01 00 00 00 11 22 33 44"));
    frame[1020] = 4;
    assert_eq!(reply_data(&request, unit_reply(&frame).unwrap()).unwrap(), hex("11 22 33 44"));
    assert_eq!(frame, build_unit_frame(&build_reply(1, &hex("11 22 33 44"))).unwrap());
    frame[1020..].copy_from_slice(&1016u32.to_le_bytes());
    assert_eq!(unit_reply(&frame).unwrap().len(), 1020);
    for too_long in [1017, 1020, 5000, u32::MAX] {
        frame[1020..].copy_from_slice(&u32::to_le_bytes(too_long));
        assert_eq!(unit_reply(&frame).unwrap_err().kind(), ErrorKind::Protocol, "{too_long}");
    }
    assert!(unit_reply(&frame[..1023]).is_err());
    assert!(build_unit_frame(&[0; 3]).is_err());
    assert!(build_unit_frame(&[0; 1021]).is_err());
}

#[test]
fn refusals_say_what_and_why() {
    let request = Request::calibration_table(32);
    let refused = |code: i32| reply_data(&request, &code.to_le_bytes()).unwrap_err();
    for (code, kind, text) in [
        (-1, ErrorKind::Unsupported, "does not know"),
        (-6, ErrorKind::Protocol, "parameter"),
        (-7, ErrorKind::Busy, "not ready"),
        (-21, ErrorKind::NotFound, "no data"),
        (-25, ErrorKind::NotFound, "empty"),
        (-27, ErrorKind::Protocol, "locked"),
        (-32, ErrorKind::Busy, "in time"),
        (-58, ErrorKind::Unsupported, "support"),
        (-99, ErrorKind::Protocol, "-99"),
        (0, ErrorKind::Protocol, "code 0"),
    ] {
        let e = refused(code);
        assert_eq!(e.kind(), kind, "{code}");
        assert!(e.to_string().contains(text) && e.to_string().contains("GETINTCAL"), "{e}");
    }
    let other = reply_data(&request, &hex("10 00 00 00 01")).unwrap_err();
    assert_eq!(other.kind(), ErrorKind::Protocol);
    assert!(other.to_string().contains("0x10"), "{other}");
    assert_eq!(build_refusal(Code::TABLE_IS_EMPTY), hex("E7 FF FF FF"));
}

/// A camera at a control port that follows a script: what each query is answered with.
#[derive(Default)]
struct Script {
    sets: Vec<Vec<u8>>,
    gets: VecDeque<Result<Vec<u8>>>,
    refuse_sets: VecDeque<ErrorKind>,
}

impl ControlPort for Script {
    fn query(&mut self, unit: u8, selector: u8, query: Query, data: &mut [u8]) -> Result<()> {
        assert_eq!((unit, selector, data.len()), (3, 1, 1024));
        match query {
            Query::SetCur => {
                if let Some(kind) = self.refuse_sets.pop_front() {
                    return Err(Error::new(kind, "script"));
                }
                self.sets.push(data.to_vec());
                Ok(())
            }
            Query::GetCur => {
                let reply = self.gets.pop_front().expect("asked once more than the script knows")?;
                data.copy_from_slice(&build_unit_frame(&reply)?);
                Ok(())
            }
            other => panic!("{other:?}"),
        }
    }
}

const FAST: Retry = Retry { pause: Duration::from_millis(1), limit: Duration::from_secs(20) };

fn run(script: Script, request: &Request, retry: Retry) -> (Result<Vec<u8>>, Script) {
    let mut monitor = UnitMonitor::new(script, UNIT_ID, retry);
    let result = monitor.command(request);
    (result, monitor.into_port())
}

#[test]
fn a_busy_camera_is_asked_again() {
    let io = |text| Err(Error::new(ErrorKind::Io, text));
    let busy = |text| Err(Error::new(ErrorKind::Busy, text));
    let script = Script {
        gets: [io("EIO"), busy("EAGAIN"), Ok(build_reply(1, &[7; 4]))].into(),
        refuse_sets: [ErrorKind::Busy, ErrorKind::Io].into(),
        ..Script::default()
    };
    let (result, script) = run(script, &Request::clock(), FAST);
    assert_eq!(result.unwrap(), [7; 4]);
    assert_eq!(script.sets, [Request::clock().to_unit_frame().to_vec()], "the request itself arrived once");
    assert!(script.gets.is_empty());
}

#[test]
fn a_camera_that_is_not_ready_is_sent_the_request_again() {
    let gets = [Ok(build_refusal(Code::NOT_READY)), Ok(build_reply(0x15, &[1, 2]))].into();
    let (result, script) = run(Script { gets, ..Script::default() }, &Request::calibration_table(25), FAST);
    assert_eq!(result.unwrap(), [1, 2]);
    assert_eq!(script.sets.len(), 2);
}

#[test]
fn a_reply_to_another_request_is_not_taken() {
    let gets = [Ok(build_reply(0x10, &[9; 30])), Ok(build_reply(0x15, &[1, 2]))].into();
    let (result, script) = run(Script { gets, ..Script::default() }, &Request::calibration_table(25), FAST);
    assert_eq!(result.unwrap(), [1, 2]);
    assert_eq!(script.sets.len(), 2);
    let gets = [0; 3].map(|_| Ok(build_reply(0x10, &[9; 30]))).into();
    let (result, script) = run(Script { gets, ..Script::default() }, &Request::calibration_table(25), FAST);
    assert_eq!(result.unwrap_err().kind(), ErrorKind::Protocol);
    assert_eq!(script.sets.len(), 3);
}

#[test]
fn timeout_has_an_end_and_a_refusal_needs_none() {
    let gets = (0..10_000).map(|_| Err(Error::new(ErrorKind::Io, "EIO"))).collect();
    let retry = Retry { pause: Duration::from_millis(1), limit: Duration::from_millis(30) };
    let (result, script) = run(Script { gets, ..Script::default() }, &Request::clock(), retry);
    assert_eq!(result.unwrap_err().kind(), ErrorKind::Io);
    let tries = 10_000 - script.gets.len();
    assert!((2..100).contains(&tries), "{tries}");

    let gets = [Ok(build_refusal(Code::TABLE_IS_EMPTY))].into();
    let (result, script) = run(Script { gets, ..Script::default() }, &Request::calibration_table(32), FAST);
    assert_eq!(result.unwrap_err().kind(), ErrorKind::NotFound);
    assert_eq!(script.sets.len(), 1);

    let gone = [ErrorKind::Disconnected].into();
    let (result, _) = run(Script { refuse_sets: gone, ..Script::default() }, &Request::clock(), FAST);
    assert_eq!(result.unwrap_err().kind(), ErrorKind::Disconnected);
}

#[test]
fn a_reset_has_no_reply_and_is_sent_once() {
    let (result, script) = run(Script::default(), &Request::reset(), FAST);
    assert_eq!(result.unwrap(), [0; 0]);
    assert_eq!(script.sets.len(), 1);
    for leaves in [ErrorKind::Disconnected, ErrorKind::Io] {
        let script = Script { refuse_sets: [leaves].into(), ..Script::default() };
        let (result, script) = run(script, &Request::reset(), FAST);
        assert!(result.is_ok());
        assert!(script.sets.is_empty());
    }
    let script = Script { refuse_sets: [ErrorKind::PermissionDenied].into(), ..Script::default() };
    assert!(run(script, &Request::reset(), FAST).0.is_err());
}

#[test]
fn threads_that_share_a_monitor_get_their_own_replies() {
    /// Answers to the last request, as firmware does: two requests in a row lose a reply.
    struct Echo(Option<u32>);
    impl ControlPort for Echo {
        fn query(&mut self, _: u8, _: u8, query: Query, data: &mut [u8]) -> Result<()> {
            if query == Query::SetCur {
                self.0 = Some(Received::parse(data)?.params[0]);
            } else {
                let id = self.0.take().expect("a reply without a request");
                data.copy_from_slice(&build_unit_frame(&build_reply(0x15, &id.to_le_bytes()))?);
            }
            Ok(())
        }
    }
    let shared = Arc::new(Mutex::new(UnitMonitor::new(Echo(None), UNIT_ID, FAST)));
    let threads: Vec<_> = (0..4u16)
        .map(|n| {
            let mut monitor = Arc::clone(&shared);
            std::thread::spawn(move || {
                for _ in 0..200 {
                    let reply = monitor.command(&Request::calibration_table(n)).unwrap();
                    assert_eq!(reply, u32::from(n).to_le_bytes());
                }
            })
        })
        .collect();
    for t in threads {
        t.join().unwrap();
    }
}

proptest! {
    #[test]
    fn any_bytes_are_a_reply_or_an_error(mut bytes in prop::collection::vec(any::<u8>(), 0..1100)) {
        let _ = reply_data(&Request::clock(), &bytes);
        let _ = unit_reply(&bytes);
        let _ = Received::parse(&bytes);
        bytes.resize(1024, 0);
        if let Ok(reply) = unit_reply(&bytes) {
            prop_assert!(reply.len() >= 4 && reply.len() <= 1020);
        }
    }

    #[test]
    fn every_reply_survives_the_unit(data in prop::collection::vec(any::<u8>(), 0..=1016)) {
        let reply = build_reply(0x15, &data);
        let frame = build_unit_frame(&reply).unwrap();
        prop_assert_eq!(reply_data(&Request::calibration_table(25), unit_reply(&frame).unwrap()).unwrap(), data);
    }
}
