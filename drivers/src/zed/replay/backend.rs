//! A recording as a camera of the rig: the same streams as a camera that is attached, at the recording's pace.

use super::super::profiles::{clock, stream_name};
use super::{Next, OpenOptions, Pair, Source, SourceInfo, open};
use crate::pace::Pace;
use crate::zed::CalibrationFile;
use crate::zed::mode::Eye;
use crate::{
    Backend, Device, DeviceInfo, Error, ErrorKind, FrameSink, Gate, Poll, RawFrame, Result, Stream,
    StreamProfile, StreamRequest, choose_profiles,
};
use core::time::Duration;
use depthrig_bus::{ClockDomain, DropReason, HostTime, Intrinsics, MetadataLevel, Pose};
use std::path::PathBuf;

/// Which recording to play, and how.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ReplayConfig {
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

/// The backend `zed` with an input that is a recording.
#[derive(Debug, Clone)]
pub struct ReplayBackend {
    config: ReplayConfig,
}

impl ReplayBackend {
    /// A backend for the one camera of `config`. Nothing is read before it is opened.
    pub const fn new(config: ReplayConfig) -> Self {
        Self { config }
    }

    fn device(&self) -> Result<ReplayDevice> {
        let ReplayConfig { input, serial, calibration, rate_hz, looped } = self.config.clone();
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
        let profiles = Eye::BOTH.into_iter().map(|eye| profile(s, eye)).collect::<Result<_>>()?;
        Ok(ReplayDevice { info, profiles, source, looped, on_grid: given })
    }
}

impl Backend for ReplayBackend {
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

fn profile(s: &SourceInfo, eye: Eye) -> Result<StreamProfile> {
    Ok(StreamProfile {
        stream: stream_name(eye)?,
        format: s.format,
        width: s.width,
        height: s.height,
        rate_hz: s.rate_hz,
        depth_unit_m: 0.0,
        intrinsics: s.calibration.as_ref().map_or_else(Intrinsics::default, |c| c.intrinsics(eye)),
        pose_in_device: s.calibration.as_ref().map_or(Pose::IDENTITY, |c| c.pose(eye)),
        // The schedule is kept on the host's clock, as that of the backend `files`.
        clock: clock(ClockDomain::Kernel),
        sequence_bits: 64,
        metadata: MetadataLevel::Kernel,
    })
}

/// A recording that was opened.
struct ReplayDevice {
    info: DeviceInfo,
    profiles: Vec<StreamProfile>,
    source: Box<dyn Source>,
    looped: bool,
    on_grid: bool,
}

impl Device for ReplayDevice {
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
        let right = stream_name(Eye::Right)?;
        let eye_of = |p: &StreamProfile| if p.stream == right { Eye::Right } else { Eye::Left };
        let ports = chosen.iter().enumerate().map(|(i, p)| (eye_of(p), Gate::new(i, p))).collect();
        Ok(Box::new(Player {
            name,
            profiles: chosen,
            ports,
            pace: Pace::new(s.rate_hz),
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
    /// What the time within this round is added to.
    begins: i64,
    /// The newest pair's time since the first one.
    newest: i64,
}

/// A recording that plays.
struct Player {
    name: String,
    profiles: Vec<StreamProfile>,
    ports: Vec<(Eye, Gate)>,
    source: Box<dyn Source>,
    looped: bool,
    on_grid: bool,
    pace: Pace,
    period_ns: i64,
    pair: Pair,
    /// The next pair is read, and whether it is whole.
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
                    let (pair, times) = (self.pair.index, self.damaged);
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
            return self.pace.due(self.count, now);
        }
        let time = self.pair.capture_time_ns;
        let since = time.saturating_sub(*self.round.first.get_or_insert(time)).max(0);
        self.round.newest = since.max(self.round.newest);
        self.pace.due_at(self.round.begins.saturating_add(since), now)
    }
}

impl Stream for Player {
    fn profiles(&self) -> &[StreamProfile] {
        &self.profiles
    }

    fn poll(&mut self, timeout: Duration, sink: &mut dyn FrameSink) -> Result<Poll> {
        self.pace.attendance.enter(HostTime::now());
        let polled = self.play(timeout, sink);
        self.pace.attendance.leave(HostTime::now());
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
        self.pace.attendance.delivered();
        let whole = self.ready.take().unwrap_or(false);
        let number = self.count + self.pace.missed();
        let ticks = u64::try_from(due.ns()).unwrap_or(0);
        for (eye, gate) in &mut self.ports {
            let picture = self.pair.eye(*eye);
            let mut raw = RawFrame::new(number, ticks, HostTime::now(), picture.len().max(1));
            raw.damaged = !whole;
            gate.deliver(&raw, sink, |memory| {
                if memory.len() != picture.len() {
                    return Err(DropReason::WrongSize);
                }
                memory.copy_from_slice(picture);
                Ok(())
            });
        }
        self.count += 1;
        Ok(Poll::Frame)
    }
}
