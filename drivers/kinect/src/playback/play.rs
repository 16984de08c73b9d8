//! Playing a recording: each image when it is due, written once into the receiver's memory.

use super::PlaybackConfig;
use super::ahead::Ahead;
use super::cursor::{Cursor, Next};
use crate::live::counter::FrameCounter;
use crate::motion::{self, Measured, Unit, is_plausible};
use crate::recording::{Pixels, Recording, motion_samples};
use core::time::Duration;
use depthrig_bus::{DropReason, FrameFlags, HostTime, PixelFormat};
use depthrig_driver::playback_clock::Attendance;
use depthrig_driver::{FrameSink, Gate, Poll, RawFrame, Result, Stream, StreamProfile, unpack};

/// A recording that plays.
pub(super) struct Player {
    profiles: Vec<StreamProfile>,
    streams: Vec<StreamState>,
    cursor: Cursor,
    /// The next block of the streams that `ahead` does not serve.
    next: Option<Next>,
    /// Decoded colour and its stream.
    ahead: Option<(usize, Ahead)>,
    /// The IMU, with samples that were read and are not due.
    motion: Option<Motion>,
    clock: RecordingClock,
}

/// The IMU of a recording.
struct Motion {
    track: usize,
    unit: Unit,
    /// Samples in the order of the file, this round's shift included.
    waiting: Vec<Measured>,
    /// Time of the last one that was read.
    newest_ns: u64,
}

/// The next event of the playback.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Event {
    /// The image that was read.
    Image,
    /// The image that was decoded.
    Decoded,
    /// This many IMU samples.
    Motion(usize),
}

/// Limit of samples that are read ahead while no image comes.
const MOST_WAITING: usize = 8 * motion::BATCH as usize;

/// One stream.
struct StreamState {
    track: usize,
    gate: Gate,
    counter: FrameCounter,
    how: How,
    flags: FrameFlags,
}

/// How an image gets into lent memory.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum How {
    Copy,
    Swap,
    WithoutAlpha {
        row: usize,
    },
    Keep,
    /// By [`Ahead`].
    Decode,
}

impl Player {
    pub(super) fn new(
        name: String,
        profiles: Vec<StreamProfile>,
        tracks: &[usize],
        is_triggered: bool,
        recording: Recording,
        config: &PlaybackConfig,
    ) -> Result<Self> {
        let flags = if is_triggered { FrameFlags::HARDWARE_TRIGGERED } else { FrameFlags(0) };
        let mut streams = Vec::new();
        let mut ahead = None;
        let mut motion = None;
        for (i, (profile, track)) in profiles.iter().zip(tracks).enumerate() {
            if profile.format.is_motion() {
                let speed = if config.rate.is_finite() { config.rate } else { 1.0 };
                let unit = Unit::new(i, profile, speed);
                let waiting = Vec::with_capacity(2 * MOST_WAITING);
                motion = Some(Motion { track: *track, unit, waiting, newest_ns: 0 });
                continue;
            }
            let pixels = recording.tracks().get(*track).and_then(|t| t.pixels);
            let how = How::of(pixels, profile);
            if how == How::Decode {
                let again = Recording::open(&config.recording)?;
                ahead = Some((
                    streams.len(),
                    Ahead::new(again, config.looped, *track, profile.width, profile.height)?,
                ));
            }
            let period_us =
                recording.tracks().get(*track).and_then(|t| t.period_ns).unwrap_or(super::PERIOD_NS) / 1000;
            let gate = Gate::new(i, profile);
            let counter = FrameCounter::new(period_us);
            streams.push(StreamState { track: *track, gate, counter, how, flags });
        }
        let clock = RecordingClock::new(name, config.rate, &profiles);
        let cursor = Cursor::new(recording, config.looped);
        Ok(Self { profiles, streams, cursor, next: None, ahead, motion, clock })
    }

    /// Reads on until the next image is known, keeping IMU samples that come before it.
    fn read(&mut self) -> Result<()> {
        if self.motion.is_none() && self.streams.iter().all(|s| s.how == How::Decode) {
            // Nothing is wanted of this pass over the file, which would go on to the end.
            return Ok(());
        }
        while self.next.is_none() && self.motion.as_ref().is_none_or(|m| m.waiting.len() < MOST_WAITING) {
            let streams = &self.streams;
            let motion_track = self.motion.as_ref().map(|m| m.track);
            let is_image = |track| streams.iter().any(|s| s.track == track && s.how != How::Decode);
            let Some(next) = self.cursor.next(|track| Some(track) == motion_track || is_image(track))? else {
                break;
            };
            match &mut self.motion {
                Some(motion) if motion.track == next.block.track => {
                    motion.read(&self.cursor.recording, &next);
                }
                _ => self.next = Some(next),
            }
        }
        Ok(())
    }

    /// The time of the next event, and which it is; `None` at the end.
    fn peek(&mut self) -> Result<Option<(u64, Event)>> {
        self.read()?;
        let ahead = match &mut self.ahead {
            Some((_, ahead)) => ahead.peek()?,
            None => None,
        };
        let image = match (self.next.map(|n| n.at_us), ahead) {
            (Some(a), Some(b)) if b > a => Some((a, Event::Image)),
            (_, Some(b)) => Some((b, Event::Decoded)),
            (a, None) => a.map(|a| (a, Event::Image)),
        };
        // Samples go with the image after them, or as a batch that is full when that comes sooner.
        let full = self.motion.as_ref().and_then(|m| m.full(image.is_none()));
        Ok(match (image, full) {
            (Some((at, _)), Some((full, n))) if full < at => Some((full, Event::Motion(n))),
            (None, Some((full, n))) => Some((full, Event::Motion(n))),
            (image, _) => image,
        })
    }

    /// Hands on the samples that were measured until `at_us`, or the first `n`. Whether a batch went.
    fn play_motion(&mut self, at_us: u64, n: Option<usize>, now: HostTime, sink: &mut dyn FrameSink) -> bool {
        let (Some(motion), clock) = (&mut self.motion, &self.clock) else { return false };
        let due = motion.waiting.iter().take_while(|m| m.gyroscope_ns / 1000 <= at_us).count();
        let n = n.unwrap_or(due).min(motion.waiting.len());
        for m in &mut motion.waiting[..n] {
            m.gyroscope_ns = m.gyroscope_ns.saturating_add(clock.stopped_us * 1000);
            m.accelerometer_ns = m.accelerometer_ns.saturating_add(clock.stopped_us * 1000);
        }
        let went = motion.unit.take(
            motion.waiting.get(..n).unwrap_or_default(),
            now,
            |us| clock.ticks(us, now),
            sink,
        );
        motion.waiting.drain(..n);
        went
    }
}

impl Motion {
    /// Keeps the samples of a block.
    fn read(&mut self, recording: &Recording, next: &Next) {
        let shift_ns = next.at_us.saturating_sub(next.block.device_us).saturating_mul(1000);
        for s in recording.frames(&next.block).flat_map(motion_samples) {
            if !is_plausible(s.gyroscope_ns, next.block.device_us) {
                continue;
            }
            let mut m = Measured::from(s);
            m.gyroscope_ns = m.gyroscope_ns.saturating_add(shift_ns);
            m.accelerometer_ns = m.accelerometer_ns.saturating_add(shift_ns);
            // A round is as long as its images; samples beyond that give way to those of the next.
            if shift_ns > 0 && m.gyroscope_ns <= self.newest_ns {
                continue;
            }
            self.newest_ns = m.gyroscope_ns;
            self.waiting.push(m);
        }
    }

    /// The time of the sample that fills a batch, and how many they are; of what there is when nothing else comes.
    fn full(&self, is_all: bool) -> Option<(u64, usize)> {
        let n = self.waiting.len().min(motion::BATCH as usize);
        let newest = self.waiting.get(n.checked_sub(1)?)?;
        (n == motion::BATCH as usize || is_all).then_some((newest.gyroscope_ns / 1000, n))
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
        let Some((at_us, event)) = self.peek()? else {
            let went = self.motion.as_mut().is_some_and(|m| m.unit.end(sink));
            return Ok(if went { Poll::Frame } else { Poll::End });
        };
        let now = HostTime::now();
        let due = self.clock.due(at_us, now);
        if due > now {
            std::thread::sleep(due.min(deadline).from_now());
            if due > deadline.max(now) {
                return Ok(Poll::Idle);
            }
        }
        let now = HostTime::now();
        self.clock.attendance.delivered();
        if let Event::Motion(n) = event {
            self.play_motion(at_us, Some(n), now, sink);
            return Ok(Poll::Frame);
        }
        self.play_motion(at_us, None, now, sink);
        let device_us = self.clock.device_us(at_us);
        let ticks = self.clock.ticks(device_us, now);
        if event == Event::Decoded {
            let Some((i, ahead)) = &mut self.ahead else { return Ok(Poll::End) };
            let stream = self.streams.get_mut(*i);
            ahead.take(|job| {
                let Some(stream) = stream else { return };
                stream.deliver(device_us, ticks, now, job.pixels.len(), sink, |to| {
                    job.outcome?;
                    unpack::copy_rows(&job.pixels, to.len(), to.len(), to)
                });
            })?;
            return Ok(Poll::Frame);
        }
        let Some(next) = self.next.take() else { return Ok(Poll::End) };
        for data in self.cursor.recording.frames(&next.block) {
            for stream in self.streams.iter_mut().filter(|s| s.track == next.block.track) {
                let how = stream.how;
                let (data, bytes) = how.measure(data);
                stream.deliver(device_us, ticks, now, bytes, sink, |to| how.fill(data, to));
            }
        }
        Ok(Poll::Frame)
    }
}

impl StreamState {
    fn deliver(
        &mut self,
        device_us: u64,
        ticks: u64,
        now: HostTime,
        bytes: usize,
        sink: &mut dyn FrameSink,
        fill: impl FnOnce(&mut [u8]) -> core::result::Result<(), DropReason>,
    ) {
        let mut raw = RawFrame::new(self.counter.number(device_us), ticks, now, bytes);
        raw.flags = self.flags;
        self.gate.deliver(&raw, sink, fill);
    }
}

impl How {
    fn of(pixels: Option<Pixels>, profile: &StreamProfile) -> Self {
        match (pixels, profile.format) {
            (Some(Pixels::Mjpg), PixelFormat::Mjpeg) => Self::Keep,
            (Some(Pixels::Mjpg), _) => Self::Decode,
            (Some(Pixels::Gray16Be), _) => Self::Swap,
            (Some(Pixels::Bgra), _) => Self::WithoutAlpha { row: profile.width as usize },
            _ => Self::Copy,
        }
    }

    /// The bytes that are the image, and how many bytes of a delivered frame they stand for.
    fn measure(self, data: &[u8]) -> (&[u8], usize) {
        match self {
            Self::Copy | Self::Swap | Self::Decode => (data, data.len()),
            Self::WithoutAlpha { .. } => (data, data.len() / 4 * 3 + data.len() % 4),
            Self::Keep => match unpack::jpeg_span(data) {
                Ok(image) => (image, image.len()),
                Err(DropReason::Incomplete) => (&[], 0),
                // Not a JPEG at all.
                Err(_) => (&[], usize::MAX),
            },
        }
    }

    fn fill(self, data: &[u8], to: &mut [u8]) -> core::result::Result<(), DropReason> {
        match self {
            Self::Copy | Self::Decode => unpack::copy_rows(data, to.len(), to.len(), to),
            Self::Swap => unpack::copy_swapped(data, to),
            Self::WithoutAlpha { row } => unpack::drop_alpha(data, row * 4, row, to),
            Self::Keep => unpack::keep_jpeg(data, to),
        }
    }
}

/// Schedule of the frames.
struct RecordingClock {
    name: String,
    rate: f64,
    /// The longest period, nanoseconds: how late the host may be before the times of all that follows move.
    period_ns: i64,
    /// Time of the first frame on the device's clock.
    first_us: Option<u64>,
    /// A moment, and the time of the frame that is due then.
    origin: Option<(HostTime, u64)>,
    moved: u64,
    attendance: Attendance,
    /// Time of the device's clock that passed while the player was stopped, as it would have on a camera.
    stopped_us: u64,
}

impl RecordingClock {
    fn new(name: String, rate: f64, profiles: &[StreamProfile]) -> Self {
        let period_ns =
            profiles.iter().map(StreamProfile::period_ns).max().unwrap_or(super::PERIOD_NS) as i64;
        Self {
            name,
            rate,
            period_ns,
            first_us: None,
            origin: None,
            moved: 0,
            attendance: Attendance::default(),
            stopped_us: 0,
        }
    }

    /// When the frame of `at_us` is due. A host that is more than a period late moves what follows rather than send it
    /// in a burst.
    fn due(&mut self, at_us: u64, now: HostTime) -> HostTime {
        self.first_us.get_or_insert(at_us);
        if !self.rate.is_finite() {
            return now;
        }
        let (origin, from_us) = *self.origin.get_or_insert((now, at_us));
        // A stream that is late in the file may be earlier than the first.
        let after_us = at_us as i64 - from_us as i64;
        let due = origin.plus_ns((after_us as f64 * 1000.0 / self.rate).round() as i64);
        if now.since_ns(due) <= self.period_ns {
            return due;
        }
        let stopped_ns = self.attendance.stopped_ns(now.since_ns(due));
        if stopped_ns > 0 {
            self.stopped_us += (stopped_ns as f64 / 1000.0 * self.rate).round() as u64;
            self.origin = Some((now, at_us));
            tracing::warn!(
                "{}: did not run for {:.1} s; the frames of that time are counted as lost",
                self.name,
                stopped_ns as f64 / 1e9
            );
            return now;
        }
        self.moved += 1;
        if self.moved.is_power_of_two() {
            let late_ms = now.since_ns(due) as f64 / 1e6;
            tracing::warn!(
                "{}: plays {late_ms:.1} ms late (the {}. time); a lower rate helps",
                self.name,
                self.moved
            );
        }
        self.origin = Some((now, at_us));
        now
    }

    /// The device's own time of what the recording has at `at_us`.
    const fn device_us(&self, at_us: u64) -> u64 {
        at_us.saturating_add(self.stopped_us)
    }

    /// The device's clock at `at_us` of the device's time: stretched when it plays at another rate; that of the host
    /// when it plays as fast as it can.
    fn ticks(&self, at_us: u64, now: HostTime) -> u64 {
        if !self.rate.is_finite() {
            return u64::try_from(now.ns()).unwrap_or(0);
        }
        if self.rate == 1.0 {
            return at_us;
        }
        let first_us = self.first_us.unwrap_or(at_us);
        let after_us = (at_us as i64).saturating_sub(first_us as i64) as f64 / self.rate;
        first_us.saturating_add_signed(after_us.round() as i64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const T0: HostTime = HostTime::from_ns(1_000_000_000);

    fn clock(rate: f64) -> RecordingClock {
        RecordingClock { period_ns: 33_333_333, ..RecordingClock::new(String::new(), rate, &[]) }
    }

    #[test]
    fn frames_are_due_by_the_recordings_clock() {
        let mut p = clock(1.0);
        assert_eq!(p.due(800_000, T0), T0);
        assert_eq!(p.due(833_340, T0), T0.plus_ns(33_340_000));
        assert_eq!(p.due(799_840, T0), T0.plus_ns(-160_000), "depth before colour");
        assert_eq!(p.ticks(833_340, T0), 833_340);
        assert_eq!(p.moved, 0);
    }

    #[test]
    fn another_rate_stretches_the_clock() {
        let mut p = clock(2.0);
        assert_eq!(p.due(800_000, T0), T0);
        assert_eq!(p.due(900_000, T0), T0.plus_ns(50_000_000));
        assert_eq!((p.ticks(800_000, T0), p.ticks(900_000, T0)), (800_000, 850_000));
        let mut p = clock(f64::INFINITY);
        assert_eq!((p.due(800_000, T0), p.ticks(800_000, T0)), (T0, 1_000_000_000));
    }

    #[test]
    fn a_late_host_moves_what_follows() {
        let mut p = clock(1.0);
        p.due(0, T0);
        let late = T0.plus_ns(500_000_000);
        assert_eq!(p.due(33_333, late), late);
        assert_eq!(p.due(66_666, late), late.plus_ns(33_333_000));
        assert_eq!((p.moved, p.stopped_us), (1, 0));
    }

    /// The device's clock goes on while the process is stopped, at every rate, so that frames are numbered and timed as
    /// those of an attached camera.
    #[test]
    fn a_stopped_process_is_a_gap_in_the_devices_time() {
        for rate in [1.0, 2.0, 0.5] {
            let mut p = clock(rate);
            let mut counter = FrameCounter::new(33_333);
            p.due(0, T0);
            assert_eq!(counter.number(p.device_us(0)), 0);
            let now = T0.plus_ns(10_000_000_000);
            p.due(33_333, now);
            let exact = 10e6 * rate / 33_333.0;
            let number = counter.number(p.device_us(33_333));
            assert!((number as f64 - exact).abs() <= 1.0, "{rate}: {number} of {exact}");
            let passed = p.ticks(p.device_us(33_333), now) - p.ticks(0, now);
            assert!(passed.abs_diff(10_000_000) <= 2, "{rate}: {passed}");
        }
    }
}
