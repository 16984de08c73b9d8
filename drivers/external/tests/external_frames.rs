//! Frames of another process that are not the running session's, or no frames at all. The process is a thread here.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use depthrig_bus::external::{
    About, ExternalCamera, ExternalFrame, ExternalFrameFlags, ExternalReason, Mode, Place, Session,
};
use depthrig_bus::{DropReason, HostTime, Name, PixelFormat, RuntimeDir};
use depthrig_driver::{Backend, ErrorKind, MemorySink, Poll, Stream};
use depthrig_external::{ExternalBackend, ExternalConfig};
use std::sync::mpsc::sync_channel;
use std::time::Duration;

const WAIT: Duration = Duration::from_secs(20);

fn place(dir: &tempfile::TempDir) -> Place {
    let runtime = RuntimeDir::at(dir.path()).unwrap();
    Place { runtime, rig: Name::new("rig").unwrap(), camera: Name::new("cam").unwrap() }
}

/// Serves sessions in a thread: `play` is called for each.
fn serve(place: &Place, play: impl Fn(&mut Session<'_>) + Send + 'static) -> std::thread::JoinHandle<()> {
    let mode = Mode::new(Name::new("color").unwrap(), PixelFormat::Mono8, 8, 6, 100.0);
    let about = About { model: "Bench".into(), ..About::default() };
    let mut camera =
        ExternalCamera::offer(place, &about, &[mode.with_device_clock(32, 1_000_000, 32)]).unwrap();
    std::thread::spawn(move || {
        while let Some(mut session) = camera.next_session(Duration::from_secs(2)).unwrap() {
            play(&mut session);
            while session.is_wanted() {
                std::thread::sleep(Duration::from_millis(2));
            }
        }
    })
}

/// Sends a frame of `value` whose header `lie` has changed.
fn send(session: &mut Session<'_>, value: u8, lie: impl FnOnce(&mut ExternalFrame)) {
    send_at_once(session, value, lie);
    std::thread::sleep(Duration::from_millis(8));
}

fn send_at_once(session: &mut Session<'_>, value: u8, lie: impl FnOnce(&mut ExternalFrame)) {
    let now = HostTime::now().ns();
    let mut slot = session.frame(0, 48).unwrap().unwrap();
    slot.set_facts(&ExternalFrame {
        device_sequence: u64::from(value),
        device_time: (now.cast_unsigned() / 1000) & 0xFFFF_FFFF,
        arrival_time_ns: now,
        ..ExternalFrame::default()
    });
    slot.pixels_mut().fill(value);
    lie(slot.header_mut());
    session.send(slot).unwrap();
}

fn open(place: &Place) -> Box<dyn Stream> {
    ExternalBackend::new(ExternalConfig::default(), place.clone()).open(None).unwrap().start(&[]).unwrap()
}

/// Polls until `frames` came.
fn take(stream: &mut Box<dyn Stream>, sink: &mut MemorySink, frames: usize) {
    let deadline = HostTime::now().plus(WAIT);
    while sink.frames.len() < frames {
        assert!(!deadline.from_now().is_zero(), "{} frames of {frames}", sink.frames.len());
        assert_ne!(stream.poll(Duration::from_millis(20), sink).unwrap(), Poll::End);
    }
}

#[test]
fn frames_of_another_session_or_process_are_passed_over() {
    let dir = tempfile::tempdir().unwrap();
    // The channel keeps four frames for a reader that a busy computer makes late.
    let (taken, wait) = sync_channel(1);
    let process = serve(&place(&dir), move |session| {
        for value in 1..=6 {
            send(session, value, |_| ());
            send(session, 100 + value, |h| h.session -= 1);
            send(session, 200 + value, |h| h.instance ^= 2);
            wait.recv().unwrap();
        }
    });
    let mut stream = open(&place(&dir));
    let mut sink = MemorySink::default();
    for frames in 1..=6 {
        take(&mut stream, &mut sink, frames);
        taken.send(()).unwrap();
    }
    drop(stream);
    assert_eq!(sink.frames.iter().map(|f| f.2[0]).collect::<Vec<_>>(), [1, 2, 3, 4, 5, 6]);
    process.join().unwrap();
}

#[test]
fn what_the_process_had_and_did_not_send_is_counted() {
    let dir = tempfile::tempdir().unwrap();
    let process = serve(&place(&dir), |session| {
        send(session, 1, |_| ());
        drop(session.frame(0, 48).unwrap()); // given up
        session.lost(0, 2);
        send(session, 5, |_| ());
        send(session, 7, |h| h.device_sequence = 7); // one that the device lost
    });
    let mut stream = open(&place(&dir));
    let mut sink = MemorySink::default();
    take(&mut stream, &mut sink, 3);
    drop(stream);
    let drops = sink.drops[0];
    assert_eq!((drops.get(DropReason::QueueFull), drops.get(DropReason::DeviceGap)), (3, 1));
    assert_eq!(sink.captured[0], 7);
    process.join().unwrap();
}

#[test]
fn headers_that_are_none_end_the_session() {
    let dir = tempfile::tempdir().unwrap();
    let (taken, wait) = sync_channel(1);
    let process = serve(&place(&dir), move |session| {
        send(session, 1, |_| ());
        wait.recv().unwrap();
        while session.is_wanted() {
            send(session, 2, |h| h.version = 9);
        }
        assert!(session.refusal().unwrap().contains("8 frames in a row are not color 8x6"));
    });
    let mut stream = open(&place(&dir));
    let mut sink = MemorySink::default();
    take(&mut stream, &mut sink, 1);
    taken.send(()).unwrap();
    let e = end_of(&mut stream, &mut sink);
    assert_eq!((e.kind(), sink.frames.len()), (ErrorKind::Protocol, 1));
    assert!(e.to_string().contains("does not send what it announced"), "{e}");
    drop(stream);
    process.join().unwrap();
}

/// The error that the stream ends with.
fn end_of(stream: &mut Box<dyn Stream>, sink: &mut MemorySink) -> depthrig_driver::Error {
    let deadline = HostTime::now().plus(WAIT);
    loop {
        assert!(!deadline.from_now().is_zero(), "nothing was noticed");
        if let Err(e) = stream.poll(Duration::from_millis(20), sink) {
            return e;
        }
    }
}

#[test]
fn damaged_and_half_frames_are_counted_and_end_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let (taken, wait) = sync_channel(1);
    let process = serve(&place(&dir), move |session| {
        for value in 1..=22 {
            send(session, value, |h| match value {
                2..=11 => h.flags |= ExternalFrameFlags::DAMAGED.0,
                12..=21 => h.payload_len /= 2,
                _ => (),
            });
            wait.recv().unwrap();
        }
    });
    let mut stream = open(&place(&dir));
    let mut sink = MemorySink::default();
    let deadline = HostTime::now().plus(WAIT);
    for frames in 1..=22 {
        while sink.delivered(0) + sink.drops_of(0).total() < frames {
            assert!(!deadline.from_now().is_zero(), "{} frames, {:?}", sink.frames.len(), sink.drops);
            stream.poll(Duration::from_millis(20), &mut sink).unwrap();
        }
        taken.send(()).unwrap();
    }
    drop(stream);
    assert_eq!(sink.frames.iter().map(|f| f.2[0]).collect::<Vec<_>>(), [1, 22]);
    let drops = sink.drops[0];
    assert_eq!((drops.get(DropReason::DeviceError), drops.get(DropReason::Incomplete)), (10, 10));
    process.join().unwrap();
}

#[test]
fn a_flood_is_dropped_as_too_much_for_the_queue() {
    const SENT: u8 = 200;
    let dir = tempfile::tempdir().unwrap();
    let process = serve(&place(&dir), |session| {
        for value in 1..SENT {
            send_at_once(session, value, |_| ());
            std::thread::sleep(Duration::from_micros(500));
        }
        // The last one is in time again.
        std::thread::sleep(Duration::from_millis(200));
        send_at_once(session, SENT, |_| ());
    });
    let mut stream = open(&place(&dir));
    let mut sink = MemorySink::default();
    let deadline = HostTime::now().plus(WAIT);
    while sink.frames.last().is_none_or(|f| f.2[0] != SENT) {
        assert!(!deadline.from_now().is_zero(), "{} frames, {:?}", sink.frames.len(), sink.drops[0]);
        stream.poll(Duration::from_millis(20), &mut sink).unwrap();
    }
    drop(stream);
    let frames = sink.frames.len() as u64;
    let lost = sink.drops[0].get(DropReason::QueueFull);
    assert_eq!((frames + lost, sink.captured[0]), (SENT.into(), SENT.into()), "{:?}", sink.drops[0]);
    assert!(lost > 50, "{frames} frames at 2 kHz where 100 Hz were announced");
    process.join().unwrap();
}

#[test]
fn a_process_that_ends_because_it_is_done_is_no_failure() {
    let dir = tempfile::tempdir().unwrap();
    let place = place(&dir);
    let mode = Mode::new(Name::new("color").unwrap(), PixelFormat::Mono8, 8, 6, 100.0);
    let about = About { model: "Bench".into(), ..About::default() };
    let mut camera = ExternalCamera::offer(&place, &about, &[mode]).unwrap();
    let process = std::thread::spawn(move || {
        let mut session = camera.next_session(WAIT).unwrap().unwrap();
        send(&mut session, 1, |_| ());
        drop(session);
        camera.end(ExternalReason::Finished, "that was all");
    });
    let mut stream = open(&place);
    let mut sink = MemorySink::default();
    process.join().unwrap();
    while stream.poll(Duration::from_millis(20), &mut sink).unwrap() != Poll::End {}
    assert_eq!(sink.frames.len(), 1);
}

#[test]
fn frames_at_the_end_of_files_are_taken_and_the_process_hears_it() {
    let dir = tempfile::tempdir().unwrap();
    let place = place(&dir);
    let mode = Mode::new(Name::new("color").unwrap(), PixelFormat::Mono8, 8, 6, 100.0);
    let about = About { model: "Bench".into(), ..About::default() };
    let mut camera = ExternalCamera::offer(&place, &about, &[mode]).unwrap();
    let process = std::thread::spawn(move || {
        let mut session = camera.next_session(WAIT).unwrap().unwrap();
        for value in 1..=4 {
            send(&mut session, value, |_| ());
        }
        session.finish("that was all", WAIT)
    });
    let mut stream = open(&place);
    let mut sink = MemorySink::default();
    std::thread::sleep(Duration::from_millis(100));
    while stream.poll(Duration::from_millis(20), &mut sink).unwrap() != Poll::End {}
    assert_eq!(sink.frames.iter().map(|f| f.2[0]).collect::<Vec<_>>(), [1, 2, 3, 4]);
    drop(stream);
    assert!(process.join().unwrap());
}

#[test]
fn a_process_that_stops_by_itself_is_disconnected() {
    let dir = tempfile::tempdir().unwrap();
    let place = place(&dir);
    let mode = Mode::new(Name::new("color").unwrap(), PixelFormat::Mono8, 8, 6, 100.0);
    let about = About { model: "Bench".into(), ..About::default() };
    let mut camera = ExternalCamera::offer(&place, &about, &[mode]).unwrap();
    let (done, wait) = sync_channel::<()>(1);
    let process = std::thread::spawn(move || {
        let mut session = camera.next_session(WAIT).unwrap().unwrap();
        send(&mut session, 1, |_| ());
        drop(session);
        let _ = wait.recv(); // it goes on offering
    });
    let mut stream = open(&place);
    let mut sink = MemorySink::default();
    let e = end_of(&mut stream, &mut sink);
    assert_eq!((e.kind(), sink.frames.len()), (ErrorKind::Disconnected, 1));
    assert!(e.to_string().contains("stopped the camera by itself"), "{e}");
    drop(done);
    process.join().unwrap();
}
