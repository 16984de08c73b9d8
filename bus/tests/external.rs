//! The hand-shake with a camera of another process, both sides: what can be offered, what is wanted, frames.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use depthrig_bus::external::{
    About, Answer, ExternalCamera, ExternalClock, ExternalFrame, ExternalLink, ExternalMode, ExternalReason,
    ExternalState, ExternalWant, Mode, Place,
};
use depthrig_bus::{ErrorKind, Intrinsics, Name, PixelFormat, RuntimeDir};
use proptest::prelude::*;
use std::time::Duration;

const WAIT: Duration = Duration::from_secs(10);

fn place(dir: &tempfile::TempDir) -> Place {
    let runtime = RuntimeDir::at(dir.path()).unwrap();
    Place { runtime, rig: Name::new("rig").unwrap(), camera: Name::new("cam").unwrap() }
}

fn mode(name: &str, format: PixelFormat) -> Mode {
    Mode::new(Name::new(name).unwrap(), format, 32, 24, 30.0)
}

/// A valid record of a mode.
fn record() -> ExternalMode {
    let mut record = ExternalMode {
        rate_hz: 30.0,
        depth_unit_m: 0.001,
        intrinsics: Intrinsics::pinhole(500.0, 501.0, 319.5, 239.5),
        tick_ps: 1_000_000,
        format: PixelFormat::Z16 as u32,
        width: 640,
        height: 480,
        clock: ExternalClock::Device as u32,
        counter_bits: 32,
        sequence_bits: 32,
        ..ExternalMode::default()
    };
    record.stream[..5].copy_from_slice(b"depth");
    record
}

/// A change that makes a record invalid.
type Change = fn(&mut ExternalMode);

#[test]
fn an_invalid_mode_is_refused_by_its_field() {
    let good = Mode::decode(&record()).unwrap();
    assert_eq!((good.describe().as_str(), good.frame_bytes()), ("depth 640x480 z16", 614_400));
    let cases: [(Change, &str); 30] = [
        (|r| r.stream = [b'a'; 32], "`stream` does not end with a zero byte"),
        (|r| r.stream[0] = b'D', "cannot be a name"),
        (|r| r.stream[20] = b'x', "`stream` has bytes after its end"),
        (|r| r.stream[0] = 0xFF, "`stream` is not UTF-8"),
        (|r| r.format = 0, "stream depth: its field `format` is 0"),
        (|r| r.format = 999, "`format` is 999"),
        (
            |r| (r.format, r.depth_unit_m, r.height) = (PixelFormat::Motion as u32, 0.0, 1),
            "stream depth: its field `format` is motion; a camera of another process gives images only",
        ),
        (|r| r.width = 0, "`width` is 0"),
        (|r| r.height = 16_385, "`height` is 16385"),
        (|r| (r.width, r.height) = (16_384, 16_384), "more than 256 MiB"),
        (|r| (r.format, r.depth_unit_m, r.width) = (PixelFormat::Yuyv as u32, 0.0, 641), "yuyv cannot be"),
        (|r| (r.format, r.depth_unit_m, r.height) = (PixelFormat::Nv12 as u32, 0.0, 481), "nv12 cannot be"),
        (|r| r.rate_hz = f64::NAN, "`rate_hz` is NaN"),
        (|r| r.rate_hz = 0.0, "`rate_hz` is 0"),
        (|r| r.rate_hz = f64::INFINITY, "`rate_hz` is inf"),
        (|r| r.depth_unit_m = 0.0, "`depth_unit_m` is 0; it must be above 0"),
        (|r| r.depth_unit_m = f64::NAN, "`depth_unit_m` is NaN"),
        (|r| r.format = PixelFormat::Rgb8 as u32, "it must be 0 for pixels that are no depth"),
        (|r| r.intrinsics.model = 99, "`intrinsics.model` is 99"),
        (|r| r.intrinsics.fx = f64::NAN, "`intrinsics.fx` is NaN"),
        (|r| r.intrinsics.fy = -1.0, "`intrinsics.fy` is -1"),
        (|r| r.intrinsics.cx = f64::INFINITY, "`intrinsics.cx` is inf"),
        (|r| r.intrinsics.coeffs[3] = f64::NAN, "`intrinsics.coeffs` has NaN"),
        (|r| r.pose.translation_m[1] = 1e9, "`pose.translation_m` has 1000000000"),
        (|r| r.pose.rotation_xyzw = [0.0; 4], "`pose.rotation_xyzw` has the length 0"),
        (|r| r.pose.rotation_xyzw[2] = f64::NAN, "`pose.rotation_xyzw` has the length NaN"),
        (|r| r.clock = 17, "`clock` is 17"),
        (|r| r.counter_bits = 65, "`counter_bits` is 65"),
        (|r| r.sequence_bits = 3, "`sequence_bits` is 3"),
        (|r| r.tick_ps = 0, "`tick_ps` is 0"),
    ];
    for (change, said) in cases {
        let mut bad = record();
        change(&mut bad);
        let e = Mode::decode(&bad).unwrap_err().to_string();
        assert!(e.contains(said), "{said}: {e}");
    }
    let host = ExternalMode { clock: ExternalClock::Host as u32, ..record() };
    assert!(Mode::decode(&host).unwrap_err().to_string().contains("on the host's clock it is 1000"));
}

proptest! {
    /// Reading a record with arbitrary content never panics, and an accepted one is usable.
    #[test]
    fn any_record_is_read_or_refused(
        numbers in prop::array::uniform8(any::<f64>()), words in prop::array::uniform8(any::<u32>()), ticks in any::<u64>()
    ) {
        let mut bad = record();
        (bad.rate_hz, bad.depth_unit_m, bad.tick_ps) = (numbers[0], numbers[1], ticks);
        (bad.intrinsics.fx, bad.intrinsics.cx, bad.intrinsics.coeffs[0]) = (numbers[2], numbers[3], numbers[4]);
        (bad.pose.translation_m[0], bad.pose.rotation_xyzw[0]) = (numbers[5], numbers[6]);
        (bad.format, bad.width, bad.height, bad.clock) = (words[0] % 14, words[1] % 20_000, words[2] % 20_000, words[3] % 5);
        (bad.counter_bits, bad.sequence_bits, bad.flags) = (words[4] % 70, words[5] % 70, words[6]);
        if let Ok(mode) = Mode::decode(&bad) {
            prop_assert!(mode.frame_bytes() > 0 && mode.frame_bytes() <= 256 << 20);
            prop_assert!(mode.rate_hz.is_finite() && mode.intrinsics.fx.is_finite() && mode.depth_unit_m.is_finite());
        }
    }
}

#[test]
fn invalid_modes_are_not_offered_at_all() {
    let dir = tempfile::tempdir().unwrap();
    let about = About { model: "Cam".into(), ..About::default() };
    let offer = |about: &About, modes: &[Mode]| {
        ExternalCamera::offer(&place(&dir), about, modes).unwrap_err().to_string()
    };
    assert!(offer(&about, &[]).contains("it has 0 modes"));
    assert!(offer(&about, &vec![mode("color", PixelFormat::Rgb8); 65]).contains("it has 65 modes"));
    let many: Vec<_> = (0..17).map(|i| mode(&format!("s{i}"), PixelFormat::Mono8)).collect();
    assert!(offer(&about, &many).contains("it has 17 streams"));
    let nan = Mode { rate_hz: f64::NAN, ..mode("color", PixelFormat::Rgb8) };
    assert!(offer(&about, &[nan]).contains("stream color: its field `rate_hz` is NaN"));
    assert!(offer(&About::default(), &[mode("color", PixelFormat::Rgb8)]).contains("`model` is empty"));
    let tab = About { model: "a\tb".into(), ..About::default() };
    assert!(offer(&tab, &[mode("color", PixelFormat::Rgb8)]).contains("control characters"));
}

#[test]
fn files_at_their_end_are_taken_to_the_last_frame() {
    let dir = tempfile::tempdir().unwrap();
    let place = place(&dir);
    let about = About { model: "Cam".into(), ..About::default() };
    let mut link = ExternalLink::open(&place).unwrap();
    let mut camera = ExternalCamera::offer(&place, &about, &[mode("color", PixelFormat::Rgb8)]).unwrap();
    let instance = hear(&link, |_| true).beat.instance;
    let reason = ExternalReason::None;
    let text = "";
    let answer = |session, want| Answer { instance, session, want, reason, text, modes: &[1] };
    for (session, confirmed) in [(1, true), (2, false)] {
        let inlet = link.frames(&Name::new("color").unwrap()).unwrap();
        link.answer(&answer(session, ExternalWant::Run)).unwrap();
        let mut running = camera.next_session(WAIT).unwrap().unwrap();
        for _ in 0..3 {
            assert!(running.send_copy(0, &ExternalFrame::default(), &[1; 32 * 24 * 3]).unwrap());
        }
        let finished = std::thread::scope(|s| {
            let timeout = if confirmed { WAIT } else { Duration::from_secs(2) };
            let ending = s.spawn(move || running.finish("that was all", timeout));
            let said = hear(&link, |b| b.state == Some(ExternalState::Refused) && b.session == session);
            assert_eq!(
                (said.beat.reason, said.beat.text().as_str()),
                (ExternalReason::Finished, "that was all")
            );
            // The daemon reads the channel only now.
            let frames = core::iter::from_fn(|| inlet.try_next().unwrap()).count();
            assert_eq!(frames, 3);
            if confirmed {
                link.answer(&answer(session, ExternalWant::Stop)).unwrap();
            }
            ending.join().unwrap()
        });
        assert_eq!(finished, confirmed, "session {session}");
    }
    // An answer that lists other modes than there are is an error, and not a session without modes.
    link.answer(&Answer { modes: &[1, 1], ..answer(3, ExternalWant::Run) }).unwrap();
    let e = camera.next_session(WAIT).unwrap_err();
    assert!(e.to_string().contains("it answers for 2 modes in 2 bytes, and this camera has 1"), "{e}");
}

/// Waits for a message that `wanted` accepts.
fn hear(
    link: &ExternalLink,
    wanted: impl Fn(&depthrig_bus::external::Beat) -> bool,
) -> depthrig_bus::external::OfferMessage {
    let deadline = depthrig_bus::HostTime::now().plus(WAIT);
    loop {
        if let Some(said) = link.newest(&wanted).unwrap() {
            return said;
        }
        assert!(!deadline.from_now().is_zero(), "nothing was heard");
        link.sleep(Duration::from_millis(50)).unwrap();
    }
}

#[test]
fn both_sides_understand_each_other() {
    let dir = tempfile::tempdir().unwrap();
    let place = place(&dir);
    let about = About { model: "Cam".into(), serial: "7".into(), program: "test".into(), ..About::default() };
    let modes =
        [mode("color", PixelFormat::Rgb8), mode("depth", PixelFormat::Z16), mode("ir", PixelFormat::Mono8)];
    let mut link = ExternalLink::open(&place).unwrap(); // the daemon may come first
    let mut camera = ExternalCamera::offer(&place, &about, &modes).unwrap();
    let e = ExternalCamera::offer(&place, &about, &modes).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::InUse);
    assert!(e.to_string().contains(&format!("process {} (test)", std::process::id())), "{e}");

    let said = hear(&link, |_| true);
    let offer = said.offer().unwrap();
    assert_eq!((&offer.about, offer.modes.as_slice()), (&about, &modes[..]));
    assert_eq!((said.beat.state, said.beat.session), (Some(ExternalState::Idle), 0));
    let instance = said.beat.instance;
    let number = said.beat.number;
    hear(&link, |b| b.number > number + 2); // it beats by itself
    assert!(camera.next_session(Duration::from_millis(10)).unwrap().is_none());

    let inlet = link.frames(&modes[1].stream).unwrap();
    let run = |session, want, modes| Answer {
        instance,
        session,
        want,
        reason: ExternalReason::None,
        text: "",
        modes,
    };
    link.answer(&Answer { instance: instance ^ 1, ..run(5, ExternalWant::Run, &[1, 1, 1]) }).unwrap();
    assert!(camera.next_session(Duration::from_millis(300)).unwrap().is_none(), "meant for another");
    link.answer(&run(10, ExternalWant::Run, &[0, 1, 0])).unwrap();
    let mut session = camera.next_session(WAIT).unwrap().unwrap();
    assert_eq!(
        session.modes().map(|(i, m)| (i, m.stream.to_string())).collect::<Vec<_>>(),
        [(1, "depth".to_owned())]
    );
    hear(&link, |b| b.state == Some(ExternalState::Starting) && b.session == 10);
    session.started();
    hear(&link, |b| b.state == Some(ExternalState::Running) && b.session == 10);

    // A frame without free memory counts, and so does a discarded one.
    assert!(session.frame(0, 10).is_err(), "it does not run");
    drop(session.frame(1, 32 * 24 * 2).unwrap().unwrap());
    let facts = ExternalFrame { device_time: 77, gain: 2.0, ..ExternalFrame::default() };
    assert!(session.send_copy(1, &facts, &[9; 32 * 24 * 2]).unwrap());
    assert_eq!(
        session.send_copy(1, &facts, &[9; 32 * 24 * 2 + 1]).unwrap_err().kind(),
        ErrorKind::LimitReached
    );
    let frame = inlet.try_next().unwrap().unwrap();
    let h = frame.header();
    assert_eq!((h.instance, h.session, h.sequence, h.device_time, h.gain), (instance, 10, 2, 77, 2.0));
    assert_eq!((h.format, h.width, h.height, h.payload_len), (PixelFormat::Z16 as u32, 32, 24, 1536));
    assert!(frame.pixels().iter().all(|b| *b == 9) && frame.pixels().len() == 1536);

    // A later session ends this one; an earlier one, such as an abandoned thread's, does not. It has heard from its
    // own just before: silence would end it.
    link.answer(&run(10, ExternalWant::Run, &[0, 1, 0])).unwrap();
    let number = hear(&link, |_| true).beat.number;
    hear(&link, |b| b.number > number + 2);
    link.answer(&run(9, ExternalWant::Stop, &[0, 0, 0])).unwrap();
    std::thread::sleep(Duration::from_millis(300));
    assert!(session.is_wanted());
    link.answer(&Answer { text: "the frames lie", ..run(10, ExternalWant::Refused, &[0, 0, 0]) }).unwrap();
    let deadline = depthrig_bus::HostTime::now().plus(WAIT);
    while session.is_wanted() {
        assert!(!deadline.from_now().is_zero());
        std::thread::sleep(Duration::from_millis(5));
    }
    assert_eq!(session.refusal().as_deref(), Some("the frames lie"));
    drop(session);
    hear(&link, |b| b.state == Some(ExternalState::Idle) && b.session == 10);

    link.answer(&run(11, ExternalWant::Run, &[1, 0, 0])).unwrap();
    let session = camera.next_session(WAIT).unwrap().unwrap();
    session.refuse(ExternalReason::Busy, "somebody has it");
    let said = hear(&link, |b| b.state == Some(ExternalState::Refused));
    assert_eq!(
        (said.beat.reason, said.beat.text().as_str(), said.beat.session),
        (ExternalReason::Busy, "somebody has it", 11)
    );

    // A daemon that is silent for two seconds is gone, and the session with it.
    link.answer(&run(12, ExternalWant::Run, &[1, 0, 0])).unwrap();
    let session = camera.next_session(WAIT).unwrap().unwrap();
    assert!(session.is_wanted());
    let deadline = depthrig_bus::HostTime::now().plus(WAIT);
    while session.is_wanted() {
        assert!(!deadline.from_now().is_zero());
        std::thread::sleep(Duration::from_millis(5));
    }
    drop(session);

    let refused = Answer { text: "no such lens", ..run(0, ExternalWant::Refused, &[0]) };
    link.answer(&refused).unwrap();
    let e = camera.next_session(WAIT).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::Refused);
    assert!(e.to_string().contains("no such lens"), "{e}");
    camera.end(ExternalReason::Disconnected, "unplugged");
    let said = hear(&link, |b| b.state == Some(ExternalState::Ended));
    assert_eq!((said.beat.reason, said.beat.text().as_str()), (ExternalReason::Disconnected, "unplugged"));
    assert_eq!(place.holder(), None);
}
