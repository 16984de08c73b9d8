//! The side that has the camera.

use super::{Ask, Head};
use core::time::Duration;
use depthrig_bus::{Bus, ErrorKind, Frame, FrameHeader, HostTime, RigName, RuntimeDir, StreamId, Subscriber};
use depthrig_link::Reading;
use depthrig_recorder::transit::{Coding, TransitEncoder};
use std::io::{self, Read, Write};
use std::os::unix::net::UnixStream;

/// A question is answered after so long, with or without a frame.
const QUIET: Duration = Duration::from_millis(400);
/// From one look for a channel to the next.
const LOOK: Duration = Duration::from_millis(50);
/// A peer that reads nothing for so long has gone.
const STALLED: Duration = Duration::from_secs(20);

/// The question and who asks it.
pub(crate) struct Answering {
    /// The connection, blocking.
    pub(crate) peer: UnixStream,
    /// Where the rig lives.
    pub(crate) runtime: RuntimeDir,
    /// The rig.
    pub(crate) rig: RigName,
    /// The stream that is asked for.
    pub(crate) id: StreamId,
}

/// Answers until the peer goes or `is_over`. `clock` is the session's at a time of this computer's.
///
/// # Errors
/// Those of the connection, of the stream's channel, and of encoding a frame.
pub(crate) fn answer(
    to: Answering,
    clock: &dyn Fn(HostTime) -> Option<Reading>,
    is_over: &dyn Fn() -> bool,
) -> io::Result<()> {
    let Answering { mut peer, runtime, rig, id } = to;
    let bus = Bus::open(&runtime, &rig).map_err(io::Error::other)?;
    peer.set_read_timeout(Some(QUIET))?;
    peer.set_write_timeout(Some(STALLED))?;
    let mut source = Source { bus, id, frames: None };
    let mut encoder = TransitEncoder::default();
    let mut small = Vec::new();
    while let Some(ask) = asked(&mut peer, is_over)? {
        let frame = match source.newest().map_err(io::Error::other)? {
            Newest::Frame(frame) => frame,
            Newest::None(head) => {
                peer.write_all(&head.bytes())?;
                continue;
            }
        };
        let mut header = *frame.header();
        let Some(reading) = clock(HostTime::from_ns(header.capture_time_ns)) else {
            peer.write_all(&Head::NoClock.bytes())?;
            continue;
        };
        on_session(&mut header, reading);
        let pixels = &frame.pixels()[..(header.payload_len as usize).min(frame.pixels().len())];
        let coding = match ask {
            Ask::Raw => Coding::Raw,
            Ask::Small => encoder.encode(&header, pixels, &mut small).map_err(io::Error::other)?,
        };
        let image = if coding == Coding::Raw { pixels } else { &small };
        let mut begin = Head::Frame(coding, image.len() as u32).bytes().to_vec();
        begin.extend_from_slice(&header.to_bytes());
        peer.write_all(&begin)?;
        peer.write_all(image)?;
    }
    Ok(())
}

/// The next question; `None` at the end.
fn asked(peer: &mut UnixStream, is_over: &dyn Fn() -> bool) -> io::Result<Option<Ask>> {
    let mut byte = [0];
    while !is_over() {
        match peer.read(&mut byte) {
            Ok(0) => return Ok(None),
            Ok(_) => return Ask::from_byte(byte[0]).map(Some),
            Err(e) if matches!(e.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::Interrupted) => {}
            Err(e) => return Err(e),
        }
    }
    Ok(None)
}

/// Moves the times of a frame to the session's clock.
fn on_session(h: &mut FrameHeader, clock: Reading) {
    let mut times = vec![&mut h.capture_time_ns, &mut h.arrival_time_ns, &mut h.publish_time_ns];
    if h.source_color_capture_time_ns != 0 {
        times.push(&mut h.source_color_capture_time_ns);
    }
    for time in times {
        *time = time.saturating_add(clock.offset_ns);
    }
    h.capture_uncertainty_ns = h.capture_uncertainty_ns.saturating_add(clock.uncertainty_ns);
}

/// The stream's channel, which comes and goes with its camera.
struct Source {
    bus: Bus,
    id: StreamId,
    frames: Option<Subscriber>,
}

enum Newest {
    Frame(Frame),
    None(Head),
}

impl Source {
    /// The newest frame that was not sent yet, or the first that comes.
    fn newest(&mut self) -> depthrig_bus::Result<Newest> {
        let deadline = HostTime::now().plus(QUIET);
        loop {
            if self.frames.is_none() {
                self.frames = match self.bus.subscriber(&self.id) {
                    Ok(subscriber) => Some(subscriber),
                    Err(e) if e.kind() == ErrorKind::NotFound => None,
                    Err(e) => return Err(e),
                };
            }
            let left = deadline.from_now();
            let Some(frames) = &mut self.frames else {
                if left.is_zero() {
                    return Ok(Newest::None(Head::Absent));
                }
                std::thread::sleep(LOOK);
                continue;
            };
            if let Some(frame) = frames.latest()? {
                return Ok(Newest::Frame(frame));
            }
            if left.is_zero() {
                let is_live = frames.is_live();
                if !is_live {
                    self.frames = None;
                }
                return Ok(Newest::None(if is_live { Head::Quiet } else { Head::Absent }));
            }
            if let Some(frame) = frames.next_timeout(left)? {
                return Ok(Newest::Frame(frame));
            }
        }
    }
}
