//! The side that has the subscribers.

use super::connect::connect;
use super::numbers::Numbers;
use super::pace::{Journey, Pace};
use super::{HEAD_BYTES, Head};
use crate::status::{MirrorState, MirrorStatus};
use crate::wake::Wake;
use core::time::Duration;
use depthrig_bus::sync::lock;
use depthrig_bus::{
    Bus, DropReason, ErrorKind, FrameHeader, FrameMut, HEADER_SIZE, HostTime, PixelFormat, Publisher,
    RigName, RuntimeDir, StreamId,
};
use depthrig_recorder::transit::{self, Coding};
use std::io::{self, Read, Write};
use std::os::unix::net::UnixStream;
use std::path::PathBuf;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};

/// Slots of a mirrored stream: those that a subscriber may hold, those that wait for it unread, and a few to write.
const SLOTS: usize = 24;
/// The largest image that is taken, bytes.
const MAX_IMAGE_BYTES: u32 = 128 << 20;
/// Without a byte for so long the connection is lost: an answer comes after 0.4 s at the latest.
const SILENCE: Duration = Duration::from_secs(2);
/// From one look at the end of the rig to the next.
const LOOK: Duration = Duration::from_millis(100);
/// From one look for a subscriber to the next.
const UNREAD: Duration = Duration::from_millis(10);
/// The pause before a lost connection is made again.
const PAUSE: Duration = Duration::from_millis(300);
/// Rates are counted over so long.
const COUNTED: Duration = Duration::from_secs(1);

/// A stream of another computer that subscribers of this one read.
#[derive(Debug)]
pub(crate) struct Mirror {
    id: StreamId,
    rig: RigName,
    runtime: RuntimeDir,
    socket: PathBuf,
    seen: Mutex<MirrorStatus>,
}

impl Mirror {
    /// The stream `id` of the rig's daemon behind `socket`.
    pub(crate) fn new(id: StreamId, rig: &RigName, runtime: &RuntimeDir, socket: PathBuf) -> Self {
        let seen = MirrorStatus {
            stream: id.to_string(),
            state: MirrorState::Waiting,
            why: None,
            coding: None,
            rate_hz: 0.0,
            frames: 0,
            skipped: 0,
        };
        Self { id, rig: rig.clone(), runtime: runtime.clone(), socket, seen: Mutex::new(seen) }
    }

    /// Its state.
    pub(crate) fn status(&self) -> MirrorStatus {
        lock(&self.seen).clone()
    }

    /// Publishes the stream's frames while `is_there` and until `stop`, and raises `wake` for each.
    ///
    /// # Errors
    /// When this rig's bus cannot be opened.
    pub(crate) fn run(
        &self,
        is_there: &dyn Fn() -> bool,
        wake: &Wake,
        stop: &AtomicBool,
    ) -> crate::Result<()> {
        let bus = Bus::open(&self.runtime, &self.rig)?;
        let mut stream =
            Stream { mirror: self, bus: &bus, wake, publisher: None, numbers: Numbers::default() };
        let mut why = String::new();
        while !stop.load(Ordering::Relaxed) {
            if is_there() {
                let ended = stream.carry(is_there, stop);
                let now = ended.err().map(|e| e.to_string()).unwrap_or_default();
                if now != why && !now.is_empty() {
                    tracing::warn!("stream {} is not mirrored: {now}", self.id);
                }
                why.clone_from(&now);
                self.rest(MirrorState::Waiting, Some(now).filter(|why| !why.is_empty()));
            } else {
                self.rest(MirrorState::Waiting, None);
            }
            std::thread::sleep(PAUSE);
        }
        Ok(())
    }

    /// Writes down that no frames come.
    fn rest(&self, state: MirrorState, why: Option<String>) {
        let mut seen = lock(&self.seen);
        (seen.state, seen.why, seen.rate_hz) = (state, why, 0.0);
    }
}

/// The stream on this computer's bus.
struct Stream<'a> {
    mirror: &'a Mirror,
    bus: &'a Bus,
    wake: &'a Wake,
    /// With the largest image that its slots hold.
    publisher: Option<(Publisher, usize)>,
    numbers: Numbers,
}

impl Stream<'_> {
    /// One connection, to its end.
    fn carry(&mut self, is_there: &dyn Fn() -> bool, stop: &AtomicBool) -> io::Result<()> {
        let read = |peer: &mut UnixStream, bytes: &mut [u8]| read_all(peer, bytes, stop);
        let mut peer = connect(&self.mirror.socket, &self.mirror.id, &read)?;
        let mut pace = Pace::default();
        let mut small = Vec::new();
        let mut counted = (HostTime::now(), self.numbers.published());
        while is_there() && !stop.load(Ordering::Relaxed) {
            if self.is_unread()? {
                std::thread::sleep(UNREAD);
                continue;
            }
            peer.write_all(&[pace.ask().byte()])?;
            let mut head = [0; HEAD_BYTES];
            read(&mut peer, &mut head)?;
            let begun = HostTime::now();
            let (coding, len) = match Head::from_bytes(head)? {
                Head::Frame(coding, len) => (coding, len),
                none => {
                    self.mirror.rest(MirrorState::Waiting, Some(none.why().to_owned()));
                    continue;
                }
            };
            let mut bytes = [0; HEADER_SIZE];
            read(&mut peer, &mut bytes)?;
            let header = FrameHeader::from_bytes(&bytes);
            self.check(&header, coding, len)?;
            let is_last = self.numbers.is_last(&header);
            let slot = if is_last { None } else { self.slot(&header)? };
            let raw_bytes = header.payload_len as usize;
            let mut slot = match slot {
                Some(mut slot) if coding == Coding::Raw => {
                    read(&mut peer, slot.pixels_mut())?;
                    Some(slot)
                }
                slot => {
                    small.resize(len as usize, 0);
                    read(&mut peer, &mut small)?;
                    slot
                }
            };
            // Only now: of a frame that is cut off the next one says that it is missing.
            let period_ns = if is_last { None } else { self.numbers.came(&header) };
            if slot.is_none() && !is_last {
                self.numbers.lost(DropReason::NoSlot);
            }
            if let Some(period_ns) = period_ns.and_then(|ns| u64::try_from(ns).ok()) {
                let at = HostTime::now();
                let took = Duration::from_nanos(at.since_ns(begun).unsigned_abs());
                let period = Duration::from_nanos(period_ns);
                pace.learn(&Journey { at, bytes: len as usize, raw_bytes, took, period });
            }
            if let Some(slot) = &mut slot
                && coding != Coding::Raw
            {
                transit::arrived(coding, &header, &small, slot.pixels_mut()).map_err(|e| {
                    self.numbers.lost(DropReason::WrongSize);
                    io::Error::other(e)
                })?;
            }
            if let Some(slot) = slot {
                self.publish(slot, &header)?;
            }
            self.note(coding, &mut counted);
        }
        Ok(())
    }

    /// True while nobody here reads the stream. It stays on the bus for the next subscriber, which gets no frame of before: the publisher is another
    /// one, because each keeps its last frame for those that come late.
    fn is_unread(&mut self) -> io::Result<bool> {
        let Some((publisher, room)) = &self.publisher else { return Ok(false) };
        let is_unread = publisher.subscribers() == 0;
        if is_unread && self.mirror.status().state != MirrorState::Unread {
            let room = *room;
            self.publisher = None;
            self.publish_with(room)?;
            self.numbers.rest();
            self.mirror.rest(MirrorState::Unread, None);
        }
        Ok(is_unread)
    }

    /// Makes the stream's channel, for images of `room` bytes at most.
    fn publish_with(&mut self, room: usize) -> io::Result<()> {
        let publisher = self.bus.publisher(&self.mirror.id, room, SLOTS).map_err(io::Error::other)?;
        self.publisher = Some((publisher, room));
        Ok(())
    }

    /// Refuses a frame of another stream, and one that contradicts itself.
    fn check(&self, h: &FrameHeader, coding: Coding, len: u32) -> io::Result<()> {
        let wrong = |what: String| Err(io::Error::new(io::ErrorKind::InvalidData, what));
        if !h.is_valid() {
            return wrong(format!(
                "its frames have headers of version {}, this program reads version {}; run the same version of depthrig on both \
                 computers",
                h.version,
                depthrig_bus::HEADER_VERSION
            ));
        }
        if h.rig() != self.mirror.rig.as_str() || h.stream_id().as_ref() != Some(&self.mirror.id) {
            return wrong(format!("a frame of {}/{} came", h.camera(), h.stream()));
        }
        if h.pixel_format() == Some(PixelFormat::Motion) {
            return wrong(
                "streams of an IMU are not mirrored, because none of their samples may be left out"
                    .to_owned(),
            );
        }
        if h.payload_len > MAX_IMAGE_BYTES || len > MAX_IMAGE_BYTES {
            return wrong(format!(
                "an image of {} bytes came; {MAX_IMAGE_BYTES} are the most",
                h.payload_len.max(len)
            ));
        }
        transit::check(coding, h, len).map_err(io::Error::other)
    }

    /// A slot for its image; `None` if subscribers hold all.
    fn slot(&mut self, h: &FrameHeader) -> io::Result<Option<FrameMut>> {
        let len = h.payload_len as usize;
        if self.publisher.as_ref().is_none_or(|(_, room)| *room < len) {
            self.publisher = None;
            // JPEG images of a camera differ in length; none is as long as its pixels.
            let pixels = 3 * h.width as usize * h.height as usize;
            let room = if h.pixel_format() == Some(PixelFormat::Mjpeg) { len.max(pixels) } else { len };
            self.publish_with(room)?;
        }
        let Some((publisher, _)) = &self.publisher else { return Ok(None) };
        match publisher.loan(len) {
            Ok(slot) => Ok(Some(slot)),
            Err(e) if e.kind() == ErrorKind::NoSpace => Ok(None),
            Err(e) => Err(io::Error::other(e)),
        }
    }

    fn publish(&mut self, mut slot: FrameMut, header: &FrameHeader) -> io::Result<()> {
        *slot.header_mut() = *header;
        self.numbers.number(slot.header_mut());
        let Some((publisher, _)) = &self.publisher else { return Ok(()) };
        publisher.send(slot).map_err(io::Error::other)?;
        self.wake.raise();
        Ok(())
    }

    /// Writes down that a frame came; `counted` is when the rate was last counted, and the frames until then.
    fn note(&self, coding: Coding, counted: &mut (HostTime, u64)) {
        let now = HostTime::now();
        let frames = self.numbers.published();
        let mut seen = lock(&self.mirror.seen);
        (seen.state, seen.why, seen.coding) = (MirrorState::Live, None, Some(coding.name().to_owned()));
        (seen.frames, seen.skipped) = (frames, self.numbers.skipped());
        let (since, before) = *counted;
        if now >= since.plus(COUNTED) {
            seen.rate_hz = (frames - before) as f64 * 1e9 / now.since_ns(since) as f64;
            *counted = (now, frames);
        }
    }
}

/// Fills `bytes`, unless nothing comes for too long or the rig ends.
fn read_all(peer: &mut UnixStream, mut bytes: &mut [u8], stop: &AtomicBool) -> io::Result<()> {
    peer.set_read_timeout(Some(LOOK))?;
    let mut heard = HostTime::now();
    while !bytes.is_empty() {
        match peer.read(bytes) {
            Ok(0) => return Err(io::Error::new(io::ErrorKind::UnexpectedEof, "the connection ended")),
            Ok(n) => {
                bytes = &mut bytes[n..];
                heard = HostTime::now();
            }
            Err(e) if matches!(e.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::Interrupted) => {
                if stop.load(Ordering::Relaxed) {
                    return Err(io::Error::new(io::ErrorKind::Interrupted, "the rig ends"));
                }
                if heard.elapsed() > SILENCE {
                    let what = format!("nothing came for {} s", SILENCE.as_secs());
                    return Err(io::Error::new(io::ErrorKind::TimedOut, what));
                }
            }
            Err(e) => return Err(e),
        }
    }
    Ok(())
}
