//! Images of the running rig, one round of new ones at a time.

use crate::context::Context;
use crate::signals::Stop;
use anyhow::{Result, bail};
use core::time::Duration;
use depthrig_bus::{Bus, Frame, FrameHeader, HostTime, RigName, RuntimeDir, StreamId, Subscriber};
use depthrig_daemon::client::Client;
use depthrig_daemon::config::RigConfig;
use depthrig_daemon::status::{CameraState, CameraStatus, MirrorState, MirrorStatus};
use std::path::{Path, PathBuf};

/// A stream without a new frame for this long is not waited for.
const SILENCE: Duration = Duration::from_secs(1);
/// Time that a channel gets to appear.
const APPEAR: Duration = Duration::from_secs(3);
const POLL: Duration = Duration::from_millis(4);
/// Time that cameras get to be opened.
const OPEN: Duration = Duration::from_secs(20);

/// Where images come from.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Source {
    /// A dataset.
    Dataset(PathBuf),
    /// A running rig.
    Rig(RigName),
}

/// Finds out what `named` is: a dataset, a rig's file, or the name of a running rig; without it the only running rig.
///
/// # Errors
/// When it is something else, and as [`Context::running_rig`].
pub fn source(named: Option<&Path>, context: &Context) -> Result<Source> {
    let Some(path) = named else {
        return Ok(Source::Rig(context.running_rig(&context.runtime()?)?));
    };
    let is_config = path.extension().is_some_and(|e| e == "toml") && path.is_file();
    if is_config {
        return Ok(Source::Rig(running(&RigConfig::load(path)?.rig, context)?));
    }
    let name = path.to_str().and_then(|text| RigName::new(text).ok());
    match name {
        Some(name) if !path.exists() => Ok(Source::Rig(running(&name, context)?)),
        // A folder that only happens to have the name of the rig.
        Some(name) if !path.join(depthrig_recorder::SESSION_FILE).exists() && path.is_dir() => {
            Ok(running(&name, context).map_or_else(|_| Source::Dataset(path.to_owned()), Source::Rig))
        }
        _ => Ok(Source::Dataset(path.to_owned())),
    }
}

/// The name, if that rig runs.
fn running(name: &RigName, context: &Context) -> Result<RigName> {
    let runtime = context.runtime()?;
    let all = runtime.running_rigs();
    if all.contains(name) {
        return Ok(name.clone());
    }
    let others: Vec<String> = all.iter().map(ToString::to_string).collect();
    let others = if others.is_empty() { "no rig".to_owned() } else { others.join(", ") };
    bail!(
        "{name}: no such dataset, and no rig of this name is running in {} ({others} is); start it with `depthrig run RIG.toml`",
        runtime.path().display()
    )
}

/// A frame, copied out of shared memory.
#[derive(Debug, Clone)]
pub struct Shot {
    /// Its header.
    pub header: FrameHeader,
    /// Its pixels.
    pub pixels: Vec<u8>,
}

impl Shot {
    fn of(frame: &Frame) -> Self {
        Self { header: *frame.header(), pixels: frame.pixels().to_vec() }
    }
}

/// Streams of a running rig.
#[derive(Debug)]
pub struct LiveStreams {
    runtime: RuntimeDir,
    rig: RigName,
    streams: Vec<LiveStream>,
    last_round: HostTime,
}

#[derive(Debug)]
struct LiveStream {
    subscriber: Subscriber,
    /// Capture time of the frame of the last round.
    last_ns: Option<i64>,
    fresh: Option<Frame>,
    heard: HostTime,
}

impl LiveStreams {
    /// Subscribes to streams of a running rig.
    ///
    /// # Errors
    /// When a channel does not exist or takes no more subscribers.
    pub fn open(rig: &RigName, streams: &[StreamId], context: &Context) -> Result<Self> {
        let runtime = context.runtime()?;
        let bus = Bus::open(&runtime, rig)?;
        let mut all = Vec::with_capacity(streams.len());
        for id in streams {
            let subscriber = bus.subscriber_within(id, APPEAR)?;
            let heard = HostTime::now();
            all.push(LiveStream { subscriber, last_ns: None, fresh: None, heard });
        }
        Ok(Self { runtime, rig: rig.clone(), streams: all, last_round: HostTime::now() })
    }

    /// Waits for a new frame of every stream that delivers, and for `interval` since the last round; `None` for a stream that is silent. Returns
    /// `None` when the end is asked for.
    ///
    /// # Errors
    /// When the rig ended or a stream cannot be read.
    pub fn round(&mut self, interval: Duration, stop: &Stop) -> Result<Option<Vec<Option<Shot>>>> {
        // Frames may always be ready, for one who looks at them for long.
        while !stop.is_asked() {
            for stream in &mut self.streams {
                if let Some(frame) = stream.subscriber.latest()?
                    && Some(frame.header().capture_time_ns) != stream.last_ns
                {
                    stream.fresh = Some(frame);
                    stream.heard = HostTime::now();
                }
            }
            let mut delivering = self.streams.iter().filter(|s| s.heard.elapsed() < SILENCE).peekable();
            let has_some = delivering.peek().is_some() && delivering.all(|s| s.fresh.is_some());
            if has_some && self.last_round.elapsed() >= interval {
                self.last_round = HostTime::now();
                return Ok(Some(self.streams.iter_mut().map(LiveStream::take).collect()));
            }
            if self.streams.iter().all(|s| !s.subscriber.is_live()) || self.is_abandoned() {
                bail!("rig {} has ended", self.rig);
            }
            stop.wait(POLL);
        }
        Ok(None)
    }
}

impl LiveStreams {
    /// Whether nothing comes any more and nobody holds the rig: its daemon was killed.
    fn is_abandoned(&self) -> bool {
        let is_silent = self.streams.iter().all(|s| s.heard.elapsed() >= 2 * SILENCE);
        is_silent && self.runtime.holder(&self.rig).is_none()
    }
}

impl LiveStream {
    fn take(&mut self) -> Option<Shot> {
        let frame = self.fresh.take()?;
        self.last_ns = Some(frame.header().capture_time_ns);
        Some(Shot::of(&frame))
    }
}

/// The streams of a rig that are images, with what its daemon says of them, and those of its other computers that are mirrored here. Cameras
/// that are being opened are waited for; `None` when the end is asked for meanwhile.
///
/// # Errors
/// When the daemon does not answer, or that of a computer whose streams are mirrored.
pub fn streams(rig: &RigName, stop: &Stop, context: &Context) -> Result<Option<Vec<StreamFacts>>> {
    let runtime = context.runtime()?;
    let client = Client::connect(&runtime, Some(rig))?;
    let began = HostTime::now();
    let status = loop {
        let status = client.status()?;
        let is_opening = status.cameras.iter().any(|c| c.state == CameraState::Opening);
        if !is_opening || began.elapsed() > OPEN {
            break status;
        }
        if stop.wait(OPEN / 200) {
            return Ok(None);
        }
    };
    let mut all = facts(&status.cameras, |_| true)?;
    for host in status.hosts.iter().flat_map(|hosts| &hosts.hosts) {
        let is_here =
            |mirror: &&MirrorStatus| matches!(mirror.state, MirrorState::Live | MirrorState::Unread);
        let here: Vec<&str> =
            host.mirrors.iter().filter(is_here).map(|mirror| mirror.stream.as_str()).collect();
        if !here.is_empty() {
            let there = Client::of_host(&runtime, rig, &host.host.parse()?)?.status()?;
            all.extend(facts(&there.cameras, |id| here.contains(&id))?);
        }
    }
    Ok(Some(all))
}

fn facts(cameras: &[CameraStatus], is_wanted: impl Fn(&str) -> bool) -> Result<Vec<StreamFacts>> {
    let mut all = Vec::new();
    for camera in cameras {
        for stream in camera.streams.iter().filter(|s| s.samples_hz.is_none() && is_wanted(&s.id)) {
            all.push(StreamFacts {
                id: stream.id.parse()?,
                rate_hz: stream.nominal_hz,
                calibration: camera.calibration.clone(),
                model: camera.model.clone(),
                serial: camera.serial.clone(),
            });
        }
    }
    Ok(all)
}

/// Facts about a stream, from the daemon.
#[derive(Debug, Clone, PartialEq)]
pub struct StreamFacts {
    /// Its name.
    pub id: StreamId,
    /// Its nominal rate, Hz.
    pub rate_hz: f64,
    /// Where its calibration comes from.
    pub calibration: String,
    /// Model of its camera.
    pub model: String,
    /// Serial number of its camera.
    pub serial: String,
}
