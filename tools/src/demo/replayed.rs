//! A subscriber of the replay: every frame must be the recorded one, and depth must be the live one bit by bit.

use super::{Checksums, checksum, is_depth};
use anyhow::Result;
use core::time::Duration;
use depthrig_bus::{Bus, FrameFlags, RuntimeDir, StreamId, Subscriber};
use depthrig_daemon::replay::{Replay, ReplayOptions};
use serde::Serialize;
use std::path::Path;

const TIMEOUT: Duration = Duration::from_secs(10);
/// Silence after the end that counts as the end of the stream.
const SILENCE: Duration = Duration::from_millis(300);

/// Result of the replay.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Replayed {
    /// Sets that the replay published.
    pub sets: u64,
    /// Frames that it published.
    pub published: u64,
    /// Frames that the subscriber read.
    pub received: u64,
    /// Depth images that are bit by bit those of the live rig.
    pub depth_equal: u64,
    /// Depth images that are not.
    pub depth_different: u64,
    /// Depth images that the subscriber of the live rig missed.
    pub depth_unknown: u64,
    /// Frames without the flag `replayed` or with times that go backwards.
    pub wrong_headers: u64,
    /// Descriptions of everything that could not be read or published.
    pub lost: Vec<String>,
}

impl Replayed {
    /// Returns whether the replay equals the recording, as far as it was observed.
    pub const fn is_right(&self) -> bool {
        self.depth_different == 0 && self.wrong_headers == 0 && self.depth_equal > 0
    }
}

/// Replays `dataset` as fast as it goes and checks what arrives.
pub fn run(
    dataset: &Path,
    runtime: &RuntimeDir,
    rig: &depthrig_bus::RigName,
    live: &Checksums,
) -> Result<Replayed> {
    // Paused until the subscriber is attached, so that it sees every frame.
    let options = ReplayOptions { as_fast_as_possible: true, paused: true, ..ReplayOptions::default() };
    let streams: Vec<StreamId> =
        depthrig_recorder::Dataset::open(dataset)?.session().streams.iter().map(|s| s.id.clone()).collect();
    let replay = Replay::start(&[dataset.to_owned()], runtime, Some(rig.clone()), options)?;
    let bus = Bus::open(runtime, rig)?;
    let mut inputs = Vec::new();
    for id in streams {
        let subscriber = bus.subscriber_within(&id, TIMEOUT)?;
        inputs.push(Input { id, subscriber, last_ns: i64::MIN });
    }
    if let Some(replay) = replay.control().replay() {
        replay.resume()?;
    }
    let mut seen = Replayed::default();
    let mut quiet_since = None;
    loop {
        let mut came = 0;
        for input in &mut inputs {
            came += input.pump(live, &mut seen)?;
        }
        let now = depthrig_bus::HostTime::now();
        if came > 0 || !replay.progress().done {
            quiet_since = None;
        } else if now.since_ns(*quiet_since.get_or_insert(now)) > SILENCE.as_nanos() as i64 {
            break;
        }
        if came == 0 {
            std::thread::sleep(Duration::from_millis(2));
        }
    }
    let progress = replay.stop().status;
    (seen.sets, seen.published, seen.lost) = (progress.sets, progress.frames, progress.lost);
    Ok(seen)
}

struct Input {
    id: StreamId,
    subscriber: Subscriber,
    last_ns: i64,
}

impl Input {
    fn pump(&mut self, live: &Checksums, seen: &mut Replayed) -> Result<u64> {
        let mut came = 0;
        while let Some(frame) = self.subscriber.try_next()? {
            came += 1;
            let header = frame.header();
            let is_right = header.has(FrameFlags::REPLAYED)
                && header.capture_time_ns > self.last_ns
                && header.stream_id().as_ref() == Some(&self.id);
            seen.wrong_headers += u64::from(!is_right);
            self.last_ns = header.capture_time_ns;
            if is_depth(self.id.stream.as_str()) {
                match live.get(&(self.id.clone(), header.capture_time_ns)) {
                    Some(sum) if *sum == checksum(frame.pixels()) => seen.depth_equal += 1,
                    Some(_) => seen.depth_different += 1,
                    None => seen.depth_unknown += 1,
                }
            }
        }
        seen.received += came;
        Ok(came)
    }
}
