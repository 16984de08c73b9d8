//! Both sides on one computer, over a socket as a tunnel would bring it; and peers that do what they should not.

use super::*;
use crate::status::MirrorState;
use crate::wake::Wake;
use core::time::Duration;
use depthrig_bus::{
    Bus, FrameHeader, HEADER_SIZE, HostTime, PixelFormat, Publisher, RigName, RuntimeDir, StreamId,
};
use depthrig_link::Reading;
use std::io::{Read, Write};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::scope;

const TIMEOUT: Duration = Duration::from_secs(20);
const OFFSET_NS: i64 = -5_000_000_000;

/// Ends the threads of a test, also of one that fails.
struct End<'a>(&'a AtomicBool);

impl Drop for End<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

struct Place {
    _folder: tempfile::TempDir,
    runtime: RuntimeDir,
    socket: PathBuf,
    rig: RigName,
    id: StreamId,
}

impl Place {
    fn new() -> Self {
        let folder = tempfile::tempdir_in("/tmp").unwrap();
        let runtime = RuntimeDir::at(&folder.path().join("r")).unwrap();
        let socket = folder.path().join("s");
        Self {
            runtime,
            socket,
            rig: "mount".parse().unwrap(),
            id: "top/depth".parse().unwrap(),
            _folder: folder,
        }
    }

    fn publisher(&self) -> (Bus, Publisher) {
        let bus = Bus::open(&self.runtime, &self.rig).unwrap();
        let publisher = bus.publisher(&self.id, 32 * 24 * 2, 16).unwrap();
        (bus, publisher)
    }

    fn header(&self, n: u64) -> FrameHeader {
        let mut h = FrameHeader { sequence: n, device_sequence: n, captured: n, ..FrameHeader::default() };
        h.set_image(PixelFormat::Z16, 32, 24);
        h.set_names("mount", &self.id);
        h.capture_time_ns = HostTime::now().ns();
        h
    }
}

/// Takes the connection, and leaves HTTP.
fn accept(socket: &Path, status: &str) -> UnixStream {
    let _ = std::fs::remove_file(socket);
    let (mut peer, _) = UnixListener::bind(socket).unwrap().accept().unwrap();
    let mut request = Vec::new();
    while !request.ends_with(b"\r\n\r\n") {
        let mut byte = [0];
        peer.read_exact(&mut byte).unwrap();
        request.push(byte[0]);
    }
    assert!(request.starts_with(b"GET /v1/frames/top/depth HTTP/1.1\r\n"));
    peer.write_all(format!("HTTP/1.1 {status}\r\n\r\n").as_bytes()).unwrap();
    peer
}

/// Waits until the mirror says something of itself.
fn wait_for(mirror: &Mirror, what: impl Fn(&crate::status::MirrorStatus) -> bool) {
    let deadline = HostTime::now().plus(TIMEOUT);
    while !what(&mirror.status()) {
        assert!(!deadline.from_now().is_zero(), "{:?}", mirror.status());
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn frames_of_one_bus_are_on_the_other_with_times_of_the_session() {
    let (there, here) = (Place::new(), Place::new());
    let (_bus, publisher) = there.publisher();
    let mirror = Mirror::new(here.id.clone(), &here.rig, &here.runtime, there.socket.clone());
    let stop = AtomicBool::new(false);
    scope(|s| {
        let _end = End(&stop);
        s.spawn(|| {
            let peer = accept(&there.socket, "101 Switching Protocols");
            let to = Answering {
                peer,
                runtime: there.runtime.clone(),
                rig: there.rig.clone(),
                id: there.id.clone(),
            };
            let clock = |_| Some(Reading { offset_ns: OFFSET_NS, uncertainty_ns: 70, rate: 0.0, epoch: 1 });
            let ended = answer(to, &clock, &|| stop.load(Ordering::Relaxed));
            assert!(ended.is_ok() || stop.load(Ordering::Relaxed), "{ended:?}");
        });
        s.spawn(|| mirror.run(&|| true, &Wake::default(), &stop).unwrap());
        s.spawn(|| {
            let mut n = 0;
            while !stop.load(Ordering::Relaxed) {
                n += 1;
                let mut slot = publisher.loan(32 * 24 * 2).unwrap();
                *slot.header_mut() = FrameHeader { capture_uncertainty_ns: 5, ..there.header(n) };
                slot.pixels_mut().fill(n as u8);
                publisher.send(slot).unwrap();
                std::thread::sleep(Duration::from_millis(4));
            }
        });
        let bus = Bus::open(&here.runtime, &here.rig).unwrap();
        let mut reader = bus.subscriber_within(&here.id, TIMEOUT).unwrap();
        let mut before = 0;
        for _ in 0..100 {
            let frame = reader.next_timeout(TIMEOUT).unwrap().unwrap();
            let h = frame.header();
            assert!(
                h.device_sequence > before && frame.pixels().iter().all(|p| *p == h.device_sequence as u8)
            );
            before = h.device_sequence;
            assert_eq!(h.captured, h.sequence + h.drops().total());
            assert_eq!(h.capture_uncertainty_ns, 75);
            let age_ns = HostTime::now().ns() + OFFSET_NS - h.capture_time_ns;
            assert!((0..TIMEOUT.as_nanos() as i64).contains(&age_ns), "{age_ns}");
        }
        wait_for(&mirror, |m| {
            m.state == MirrorState::Live && m.frames >= 100 && m.coding.as_deref() == Some("raw")
        });
    });
}

#[test]
fn what_a_peer_should_not_send_is_refused_and_named() {
    type Spoil = fn(&Place) -> (Vec<u8>, Vec<u8>);
    fn frame(coding: Coding, len: u32, h: &FrameHeader) -> (Vec<u8>, Vec<u8>) {
        (Head::Frame(coding, len).bytes().to_vec(), h.to_bytes().to_vec())
    }
    let cases: [(Spoil, &str); 9] = [
        (|_| (vec![9; HEAD_BYTES], Vec::new()), "an answer is 9"),
        (|_| (vec![1, 77, 0, 0, 0, 0, 0, 0], Vec::new()), "a coding is 77"),
        (|_| (Head::Frame(Coding::Raw, 1536).bytes().to_vec(), vec![0; HEADER_SIZE]), "headers of version 0"),
        (
            |p| {
                let mut h = p.header(1);
                h.set_names("mount", &"left/color".parse().unwrap());
                frame(Coding::Raw, h.payload_len, &h)
            },
            "a frame of left/color came",
        ),
        (|p| frame(Coding::Raw, u32::MAX, &p.header(1)), "are the most"),
        (|p| frame(Coding::Raw, 100, &p.header(1)), "100 bytes (raw) came for an image of 1536 bytes (z16)"),
        (|p| frame(Coding::Jpeg, 100, &p.header(1)), "100 bytes (jpeg) came"),
        (
            |p| {
                let h = FrameHeader { width: u32::MAX, height: u32::MAX, ..p.header(1) };
                frame(Coding::Raw, h.payload_len, &h)
            },
            "its header says 1536",
        ),
        (
            |p| {
                let h = FrameHeader { format: PixelFormat::Motion as u32, ..p.header(1) };
                frame(Coding::Raw, h.payload_len, &h)
            },
            "IMU",
        ),
    ];
    for (spoil, why) in cases {
        let (there, here) = (Place::new(), Place::new());
        let mirror = Mirror::new(here.id.clone(), &here.rig, &here.runtime, there.socket.clone());
        let stop = AtomicBool::new(false);
        let (head, header) = spoil(&there);
        scope(|s| {
            let _end = End(&stop);
            s.spawn(|| {
                let mut peer = accept(&there.socket, "101 Switching Protocols");
                let _ = peer.write_all(&head).and_then(|()| peer.write_all(&header));
                // Nothing more comes, and the connection stays open until the other side ends it.
                let _ = peer.read_to_end(&mut Vec::new());
            });
            s.spawn(|| mirror.run(&|| true, &Wake::default(), &stop).unwrap());
            wait_for(&mirror, |m| m.why.as_deref().is_some_and(|said| said.contains(why)));
            assert_eq!((mirror.status().state, mirror.status().frames), (MirrorState::Waiting, 0), "{why}");
        });
    }
}

#[test]
fn a_daemon_that_refuses_is_quoted() {
    let (there, here) = (Place::new(), Place::new());
    let mirror = Mirror::new(here.id.clone(), &here.rig, &here.runtime, there.socket.clone());
    let stop = AtomicBool::new(false);
    scope(|s| {
        let _end = End(&stop);
        s.spawn(|| {
            let body = r#"{"error":{"kind":"not_found","message":"unknown path"}}"#;
            let head = format!("404 Not Found\r\nContent-Length: {}", body.len());
            accept(&there.socket, &head).write_all(body.as_bytes()).unwrap();
        });
        s.spawn(|| mirror.run(&|| true, &Wake::default(), &stop).unwrap());
        wait_for(&mirror, |m| m.why.as_deref() == Some("unknown path"));
    });
}
