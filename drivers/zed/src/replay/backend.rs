//! Plays a recording as a camera of the rig: the same streams as an attached camera, at the recording's rate.

use super::super::profiles::{clock, stream_name};
use super::{Next, OpenOptions, Pair, Source, SourceInfo, open};
use crate::CalibrationFile;
use crate::mode::Side;
use core::time::Duration;
use depthrig_bus::{ClockDomain, DropReason, HostTime, Intrinsics, MetadataLevel, Pose};
use depthrig_driver::playback_clock::PlaybackClock;
use depthrig_driver::{
    Backend, Device, DeviceInfo, Error, ErrorKind, FrameSink, Gate, Poll, RawFrame, Result, Stream,
    StreamProfile, StreamRequest, choose_profiles,
};
use std::path::PathBuf;

/// Which recording to play, and how.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ZedPlaybackConfig {
    /// The folder or file.
    pub input: PathBuf,
    /// Serial number of the camera, when neither the recording nor the calibration's name says it.
    pub serial: Option<String>,
    /// Where the factory calibration is; with [`CalibrationFile::Known`], beside the recording as well.
    pub calibration: CalibrationFile,
    /// Pairs a second, instead of the recording's own times.
    pub rate_hz: Option<f64>,
    /// Begin again at the end.
    pub looped: bool,
}

/// The backend `zed` with a recording as its input.
#[derive(Debug, Clone)]
pub struct ZedPlaybackBackend {
    config: ZedPlaybackConfig,
}

impl ZedPlaybackBackend {
    /// A backend for the one camera of `config`. Nothing is read before it is opened.
    pub const fn new(config: ZedPlaybackConfig) -> Self {
        Self { config }
    }

    fn device(&self) -> Result<PlaybackDevice> {
        let ZedPlaybackConfig { input, serial, calibration, rate_hz, looped } = self.config.clone();
        let source = open(&input, &OpenOptions { calibration, serial, rate_hz })?;
        let given = rate_hz.is_some();
        let s = source.info();
        let info = DeviceInfo {
            backend: "zed",
            model: s.model.clone(),
            serial: s.serial.clone(),
            firmware: String::new(),
            port: s.path.display().to_string(),
            calibration: s.calibration_origin.clone(),
            motion: String::new(),
        };
        let profiles = Side::BOTH.into_iter().map(|side| profile(s, side)).collect::<Result<_>>()?;
        Ok(PlaybackDevice { info, profiles, source, looped, on_grid: given })
    }
}

impl Backend for ZedPlaybackBackend {
    fn name(&self) -> &'static str {
        "zed"
    }

    /// The one camera, checked as if it were opened.
    ///
    /// # Errors
    /// Those of [`open`]: a recording that was named and cannot be played is worth saying.
    fn discover(&self) -> Result<Vec<DeviceInfo>> {
        Ok(vec![self.device()?.info])
    }

    fn open(&self, serial: Option<&str>) -> Result<Box<dyn Device>> {
        let device = self.device()?;
        match serial {
            Some(wanted) if wanted != device.info.serial => Err(Error::new(
                ErrorKind::NotFound,
                format!(
                    "{} was taken with the camera \"{}\", not \"{wanted}\"",
                    device.info.port, device.info.serial
                ),
            )),
            _ => Ok(Box::new(device)),
        }
    }
}

fn profile(s: &SourceInfo, side: Side) -> Result<StreamProfile> {
    Ok(StreamProfile {
        stream: stream_name(side)?,
        format: s.format,
        width: s.width,
        height: s.height,
        rate_hz: s.rate_hz,
        depth_unit_m: 0.0,
        intrinsics: s.calibration.as_ref().map_or_else(Intrinsics::default, |c| c.intrinsics(side)),
        pose_in_device: s.calibration.as_ref().map_or(Pose::IDENTITY, |c| c.pose(side)),
        // The schedule runs on the host's clock, as that of the backend `files`.
        clock: clock(ClockDomain::Kernel),
        sequence_bits: 64,
        metadata: MetadataLevel::Kernel,
    })
}

/// A recording that was opened.
struct PlaybackDevice {
    info: DeviceInfo,
    profiles: Vec<StreamProfile>,
    source: Box<dyn Source>,
    looped: bool,
    on_grid: bool,
}

impl Device for PlaybackDevice {
    fn info(&self) -> &DeviceInfo {
        &self.info
    }

    fn profiles(&self) -> &[StreamProfile] {
        &self.profiles
    }

    fn start(self: Box<Self>, requests: &[StreamRequest]) -> Result<Box<dyn Stream>> {
        let Self { profiles, source, looped, on_grid, .. } = *self;
        let s = source.info();
        let name = format!("the recording {}", s.path.display());
        let chosen = choose_profiles(&name, &profiles, requests)?;
        let right = stream_name(Side::Right)?;
        let side_of = |p: &StreamProfile| if p.stream == right { Side::Right } else { Side::Left };
        let ports = chosen.iter().enumerate().map(|(i, p)| (side_of(p), Gate::new(i, p))).collect();
        Ok(Box::new(Player {
            name,
            profiles: chosen,
            ports,
            clock: PlaybackClock::new(s.rate_hz),
            period_ns: (1e9 / s.rate_hz) as i64,
            on_grid: on_grid || !s.timed,
            source,
            looped,
            pair: Pair::default(),
            ready: None,
            count: 0,
            round: Round::default(),
            damaged: 0,
        }))
    }
}

/// Where a round through the recording lies in time, nanoseconds.
#[derive(Debug, Clone, Copy, Default)]
struct Round {
    /// Time of the recording's first pair.
    first: Option<i64>,
    /// Offset that is added to times within this round.
    begins: i64,
    /// The newest pair's time since the first one.
    newest: i64,
}

/// A recording that plays.
struct Player {
    name: String,
    profiles: Vec<StreamProfile>,
    ports: Vec<(Side, Gate)>,
    source: Box<dyn Source>,
    looped: bool,
    on_grid: bool,
    clock: PlaybackClock,
    period_ns: i64,
    pair: Pair,
    /// `None` until the next pair has been read; then whether it is complete.
    ready: Option<bool>,
    /// Running number of the next pair.
    count: u64,
    round: Round,
    damaged: u64,
}

impl Player {
    /// Reads the next pair ahead; `false` at the end.
    fn prepare(&mut self) -> Result<bool> {
        if self.ready.is_some() {
            return Ok(true);
        }
        let mut next = self.source.next(&mut self.pair)?;
        if next == Next::End && self.looped && self.count > 0 {
            self.source.seek(0)?;
            self.round.begins += self.round.newest + self.period_ns;
            next = self.source.next(&mut self.pair)?;
        }
        self.ready = match next {
            Next::Pair => Some(true),
            Next::Damaged(why) => {
                self.damaged += 1;
                if self.damaged.is_power_of_two() {
                    let pair = self.pair.index;
                    let times = self.damaged;
                    tracing::warn!(
                        recording = self.name,
                        pair,
                        times,
                        why,
                        "a pair is damaged and is left out"
                    );
                }
                Some(false)
            }
            Next::End => None,
        };
        Ok(self.ready.is_some())
    }

    /// When the pair that was read is due.
    fn due(&mut self, now: HostTime) -> HostTime {
        if self.on_grid {
            return self.clock.due(self.count, now);
        }
        let time = self.pair.capture_time_ns;
        let since = time.saturating_sub(*self.round.first.get_or_insert(time)).max(0);
        self.round.newest = since.max(self.round.newest);
        self.clock.due_at(self.round.begins.saturating_add(since), now)
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
        let deadline = HostTime::now().plus(timeout);
        if !self.prepare()? {
            return Ok(Poll::End);
        }
        let now = HostTime::now();
        let due = self.due(now);
        std::thread::sleep(due.min(deadline).from_now());
        if due > deadline.max(now) {
            return Ok(Poll::Idle);
        }
        self.clock.attendance.delivered();
        let whole = self.ready.take().unwrap_or(false);
        let number = self.count + self.clock.missed();
        let ticks = u64::try_from(due.ns()).unwrap_or(0);
        for (side, gate) in &mut self.ports {
            let image = self.pair.image(*side);
            let mut raw = RawFrame::new(number, ticks, HostTime::now(), image.len().max(1));
            raw.damaged = !whole;
            gate.deliver(&raw, sink, |memory| {
                if memory.len() != image.len() {
                    return Err(DropReason::WrongSize);
                }
                memory.copy_from_slice(image);
                Ok(())
            });
        }
        self.count += 1;
        Ok(Poll::Frame)
    }
}
