//! How often pixels are copied between a driver and a subscriber in another process: the driver's one write.
//!
//! The publishing process notes where in shared memory it wrote each frame, the subscribing one where it reads
//! it. The same file and offset are the same bytes, so nothing was copied in between.

use super::place::{Place, place_of};
use super::reader::{Mode, Reader};
use super::{CAMERA_BYTES, Channels, PERIOD, Source};
use anyhow::{Result, ensure};
use depthrig_bus::Bus;
use serde::Serialize;
use std::collections::BTreeMap;

/// The result.
#[derive(Debug, Serialize)]
pub struct Copies {
    /// Frames compared.
    pub frames: usize,
    /// Frames that the subscriber read at the very place where they were written.
    pub in_place: usize,
    /// Bytes of pixels that the publishing side wrote, per byte of pixels that it published.
    pub writes_per_byte: f64,
}

impl Copies {
    /// Copies of a frame's pixels from driver to subscriber: the driver's write, and one more when the
    /// subscriber reads it elsewhere.
    pub fn count(&self) -> f64 {
        self.writes_per_byte + (self.frames - self.in_place) as f64 / self.frames as f64
    }
}

/// Sends `frames` frames and compares places.
pub fn run(bus: &Bus, frames: u64) -> Result<Copies> {
    let bytes = CAMERA_BYTES[0];
    let publisher = bus.publisher(&Channels::ids()?[0], bytes, 16)?;
    let reader = Reader::start(bus.runtime(), Mode::Place, 1)?;
    let mut source = Source::new(bytes, 1);
    let mut written_at: BTreeMap<u64, Place> = BTreeMap::new();
    let mut written = 0;
    let mut published = 0;
    for sequence in 1..=frames {
        let mut frame = publisher.loan(bytes)?;
        frame.header_mut().sequence = sequence;
        let slot = frame.pixels_mut();
        written += source.write_to(slot);
        written_at.insert(sequence, place_of(slot)?);
        published += slot.len();
        publisher.send(frame)?;
        std::thread::sleep(PERIOD);
    }
    let seen = reader.finish()?;
    ensure!(!seen.places.is_empty(), "the subscribing process received no frame");
    let in_place = seen.places.iter().filter(|(n, place)| written_at.get(n) == Some(place)).count();
    Ok(Copies { frames: seen.places.len(), in_place, writes_per_byte: written as f64 / published as f64 })
}
