//! Publish-to-receive time, against a bare iceoryx2 loop that carries the same bytes.
//!
//! Blocks of both alternate within one run, so that whatever else the machine does hits both.

use super::raw::RawSender;
use super::reader::{Mode, Reader, Timed};
use super::{Channels, FRAME_BYTES, PERIOD, Source};
use crate::bench::stats::{Quantiles, median};
use anyhow::{Result, ensure};
use depthrig_bus::{Bus, HostTime};
use serde::Serialize;

/// Frames of one block of one side.
const BLOCK: u64 = 30;
/// Frames at the start of each block that are not counted: caches and sleep states settle.
const SETTLE: u64 = 3;

/// The result.
#[derive(Debug, Serialize)]
pub struct Latency {
    /// Bytes of a frame.
    pub frame_bytes: usize,
    /// Right before sending to received, through the bus.
    pub ours: Quantiles,
    /// The same through the bare loop.
    pub bare: Quantiles,
    /// Before the slot was lent to received, with the writing of the pixels, through the bus.
    pub ours_total: Quantiles,
    /// The same through the bare loop.
    pub bare_total: Quantiles,
    /// `ours.p50 / bare.p50`.
    pub ratio_p50: f64,
    /// Median over pairs of neighbouring blocks of the ratio of their medians.
    pub ratio_p50_of_blocks: f64,
}

/// Sends `blocks` blocks on each side.
pub fn run(bus: &Bus, blocks: u64, mut progress: impl FnMut(u64)) -> Result<Latency> {
    let id = &Channels::ids()?[0];
    let publisher = bus.publisher(id, FRAME_BYTES, 16)?;
    let bare = RawSender::open(bus.runtime(), FRAME_BYTES)?;
    let reader = Reader::start(bus.runtime(), Mode::Latency, 1)?;
    let mut source = Source::new(FRAME_BYTES, 0);
    let mut tick = HostTime::now();
    for block in 0..2 * blocks {
        let first = block % 2 == 0;
        let is_ours = first == ((block / 2) % 2 == 0); // each side is the first of every other pair
        for i in 0..BLOCK {
            tick = tick.plus(PERIOD);
            std::thread::sleep(tick.from_now());
            let pixels = source.next();
            let sequence = block / 2 * BLOCK + i + 1;
            if is_ours {
                let start_ns = HostTime::now().ns();
                let mut frame = publisher.loan(FRAME_BYTES)?;
                frame.pixels_mut().copy_from_slice(pixels);
                frame.header_mut().sequence = sequence;
                frame.header_mut().device_time = start_ns as u64;
                publisher.send(frame)?;
            } else {
                bare.send(sequence, pixels)?;
            }
        }
        progress(block + 1);
    }
    std::thread::sleep(PERIOD);
    let seen = reader.finish()?;
    summarise(&seen.ours, &seen.bare)
}

fn summarise(ours: &[Timed], bare: &[Timed]) -> Result<Latency> {
    let settled = |t: &&Timed| (t.sequence - 1) % BLOCK >= SETTLE;
    let wire = |all: &[Timed]| all.iter().filter(settled).map(|t| t.wire_ns).collect::<Vec<_>>();
    let total = |all: &[Timed]| all.iter().filter(settled).map(|t| t.total_ns).collect::<Vec<_>>();
    let of_block = |all: &[Timed], block: u64| {
        let times = all.iter().filter(settled).filter(|t| (t.sequence - 1) / BLOCK == block);
        Quantiles::of_ns(&times.map(|t| t.wire_ns).collect::<Vec<_>>())
    };
    let blocks = ours.iter().map(|t| (t.sequence - 1) / BLOCK + 1).max().unwrap_or(0);
    let ratios: Vec<f64> = (0..blocks)
        .map(|b| (of_block(ours, b), of_block(bare, b)))
        .filter(|(o, b)| o.n > 0 && b.n > 0)
        .map(|(o, b)| o.p50_us / b.p50_us)
        .collect();
    ensure!(!ratios.is_empty(), "the subscribing process received nothing to compare");
    let o = Quantiles::of_ns(&wire(ours));
    let b = Quantiles::of_ns(&wire(bare));
    Ok(Latency {
        frame_bytes: FRAME_BYTES,
        ours: o,
        bare: b,
        ours_total: Quantiles::of_ns(&total(ours)),
        bare_total: Quantiles::of_ns(&total(bare)),
        ratio_p50: o.p50_us / b.p50_us,
        ratio_p50_of_blocks: median(&ratios),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frames(wire_us: i64) -> Vec<Timed> {
        let timed = |sequence| Timed { sequence, wire_ns: wire_us * 1000, total_ns: wire_us * 2000 };
        (1..=3 * BLOCK).map(timed).collect()
    }

    #[test]
    fn the_ratio_is_ours_over_bare_without_the_settling_frames() {
        let mut ours = frames(110);
        ours[0].wire_ns = 1_000_000_000;
        let result = summarise(&ours, &frames(100)).unwrap();
        assert!((result.ratio_p50 - 1.1).abs() < 1e-9 && (result.ratio_p50_of_blocks - 1.1).abs() < 1e-9);
        assert_eq!(result.ours.max_us, 110.0);
        assert_eq!(result.ours.n as u64, 3 * (BLOCK - SETTLE));
        assert!(summarise(&ours, &[]).is_err());
    }
}
