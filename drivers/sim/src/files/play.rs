//! Playing the images: decode ahead, wait for the moment, copy once into the sink's memory.

use super::source::{Playing, SourceStream};
use core::time::Duration;
use depthrig_bus::{DropReason, HostTime};
use depthrig_driver::image_file::{Info, decode};
use depthrig_driver::playback_clock::PlaybackClock;
use depthrig_driver::{Error, ErrorKind, FrameSink, Gate, Poll, RawFrame, Result, Stream, StreamProfile};
use rayon::prelude::*;
use std::path::PathBuf;

/// A playing folder.
pub(super) struct Player {
    name: String,
    profiles: Vec<StreamProfile>,
    tracks: Vec<Track>,
    /// Images per stream.
    count: usize,
    looped: bool,
    /// Bytes that may still be kept decoded.
    cache_left: u64,
    /// Running number of the next frame.
    next: u64,
    /// Its images are decoded.
    ready: bool,
    clock: PlaybackClock,
}

/// One stream of it.
struct Track {
    image: Info,
    paths: Vec<PathBuf>,
    /// Decoded images that are kept.
    kept: Vec<Option<Box<[u8]>>>,
    /// The decoded next image, when it is not kept.
    passing: Vec<u8>,
    gate: Gate,
}

impl Track {
    /// Decodes image `i`, for good or for once.
    fn decode(&mut self, i: usize, keep: bool) -> Result<()> {
        let bytes = self.image.bytes() as usize;
        if keep {
            let mut pixels = vec![0; bytes].into_boxed_slice();
            decode(&self.paths[i], &self.image, &mut pixels)?;
            self.kept[i] = Some(pixels);
            Ok(())
        } else {
            self.passing.resize(bytes, 0);
            decode(&self.paths[i], &self.image, &mut self.passing)
        }
    }
}

impl Player {
    /// A player at its first image, which is decoded already.
    pub(super) fn new(name: String, streams: Vec<SourceStream>, playing: Playing) -> Result<Self> {
        let count = streams.first().map_or(0, |s| s.paths.len());
        let profiles: Vec<_> = streams.iter().map(|s| s.profile.clone()).collect();
        let tracks = streams.into_iter().enumerate().map(|(i, s)| Track {
            gate: Gate::new(i, &s.profile),
            image: s.image,
            kept: s.paths.iter().map(|_| None).collect(),
            paths: s.paths,
            passing: Vec::new(),
        });
        let mut player = Self {
            name,
            profiles,
            tracks: tracks.collect(),
            count,
            looped: playing.looped,
            cache_left: playing.cache_bytes,
            next: 0,
            ready: false,
            clock: PlaybackClock::new(playing.rate_hz),
        };
        player.prepare()?;
        Ok(player)
    }

    fn image(&self) -> usize {
        (self.next % (self.count as u64).max(1)) as usize
    }

    /// Decodes the images of the next frame, unless they are kept.
    fn prepare(&mut self) -> Result<()> {
        let i = self.image();
        if !self.ready && self.tracks.iter().any(|t| t.kept[i].is_none()) {
            let bytes = self.tracks.iter().map(|t| t.image.bytes()).sum();
            let left = self.cache_left.checked_sub(bytes);
            self.tracks.par_iter_mut().try_for_each(|t| t.decode(i, left.is_some())).map_err(|e| {
                // A file that was there on opening and is not now: no other camera could be meant.
                let kind = if e.kind() == ErrorKind::BadInput { ErrorKind::BadInput } else { ErrorKind::Io };
                Error::new(kind, format!("{}: {e}", self.name)).with_source(e)
            })?;
            self.cache_left = left.unwrap_or(self.cache_left);
        }
        self.ready = true;
        Ok(())
    }
}

impl Stream for Player {
    fn profiles(&self) -> &[StreamProfile] {
        &self.profiles
    }

    fn poll(&mut self, timeout: Duration, sink: &mut dyn FrameSink) -> Result<Poll> {
        self.clock.attendance.enter(HostTime::now());
        let polled = self.play(timeout, sink);
        self.clock.attendance.leave(HostTime::now());
        polled
    }
}

impl Player {
    fn play(&mut self, timeout: Duration, sink: &mut dyn FrameSink) -> Result<Poll> {
        if !self.looped && self.next >= self.count as u64 {
            return Ok(Poll::End);
        }
        let deadline = HostTime::now().plus(timeout);
        self.prepare()?;
        let now = HostTime::now();
        let due = self.clock.due(self.next, now);
        std::thread::sleep(due.min(deadline).from_now());
        if due > deadline.max(now) {
            return Ok(Poll::Idle);
        }
        self.clock.attendance.delivered();
        let i = self.image();
        let number = self.next + self.clock.missed();
        for track in &mut self.tracks {
            let pixels: &[u8] = track.kept[i].as_deref().unwrap_or(&track.passing);
            let ticks = u64::try_from(due.ns()).unwrap_or(0);
            let raw = RawFrame::new(number, ticks, HostTime::now(), pixels.len());
            track.gate.deliver(&raw, sink, |memory| {
                if memory.len() != pixels.len() {
                    return Err(DropReason::WrongSize);
                }
                memory.copy_from_slice(pixels);
                Ok(())
            });
        }
        self.next += 1;
        self.ready = false;
        Ok(Poll::Frame)
    }
}
