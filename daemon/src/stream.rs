//! State of one stream that the daemon keeps for as long as it lives, whatever happens to its camera.
//!
//! The books are double-entry: `captured` is the number of frames that the device announced, `delivered` and `dropped`
//! are their fates, and [`Books::close`] balances them when a hung thread is given up with a frame in its hands.

use crate::status::{ClockStatus, SetAccount, StreamStatus};
use depthrig_bus::sync::lock;
use depthrig_bus::{
    ClockDomain, DropCounts, DropReason, FrameFlags, FrameHeader, HostTime, MetadataLevel, PixelFormat,
    Publisher, StreamId, StreamName, Subscriber,
};
use depthrig_cdm::stage::{ALIGNED, REFINED};
use depthrig_driver::StreamProfile;
use depthrig_driver::clock::ClockQuality;
use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard};

/// Frames over which latency and rate are measured.
const WINDOW: usize = 256;
/// How long frames of a computed stream are superseded until the rate that is reached is reported.
const SETTLED_NS: i64 = 10_000_000_000;

/// One stream of a rig.
#[derive(Debug)]
pub struct Stream {
    /// Which.
    pub id: StreamId,
    /// Its mode; a camera that comes back with another one is refused.
    pub profile: StreamProfile,
    /// Whether its frames belong into recordings.
    pub record: bool,
    /// Slots that its channel shall have.
    pub slots: usize,
    books: Mutex<Books>,
}

/// The books of a stream.
#[derive(Debug, Default)]
pub struct Books {
    /// Frames the device announced.
    pub captured: u64,
    /// Frames published; also the sequence number of the newest.
    pub delivered: u64,
    /// Frames lost.
    pub dropped: DropCounts,
    /// Which opening of the camera may write here; an abandoned thread's is over.
    pub session: u64,
    /// The channel; it outlives the camera's sessions so that subscribers need not come back.
    pub publisher: Option<Arc<Publisher>>,
    /// The set thread's end of the channel until that thread takes it. It is created before the first frame: a
    /// publisher that sends while a subscriber is half made waits for it, half a second at worst.
    pub reader: Option<Subscriber>,
    /// When the newest frame was published.
    pub last_frame: Option<HostTime>,
    /// Clock epochs of earlier sessions.
    pub epoch_base: u32,
    /// Epoch of the newest frame.
    pub epoch: u32,
    /// Temperature of the device at the newest frame that states one, °C.
    pub temperature_c: Option<f32>,
    /// Stated uncertainty of the newest capture time.
    pub uncertainty_ns: u64,
    /// Frames flagged as uncertain in time.
    pub uncertain: u64,
    /// Source of the times of the newest frame that had its metadata.
    pub metadata: Option<MetadataLevel>,
    /// Frames whose metadata did not come.
    pub metadata_lost: u64,
    /// The clock map's own word.
    pub clock: Option<ClockQuality>,
    /// When the newest frames were published, how long after their capture, and how many samples each has.
    recent: VecDeque<(HostTime, i64, u32)>,
    loss_logged: Option<HostTime>,
    superseding: Superseding,
}

/// Of a computed stream: since when newer frames supersede others, and whether that was reported.
#[derive(Debug, Clone, Copy, Default)]
enum Superseding {
    /// None did.
    #[default]
    Never,
    /// Since this moment, when so many frames were captured and delivered.
    Since(HostTime, u64, u64),
    /// It was said.
    Reported,
}

/// How many frames of a computed stream are delivered, of how many that could be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reached {
    /// Delivered, frames a second.
    pub reached_hz: f64,
    /// Captured, frames a second.
    pub of_hz: f64,
}

impl Stream {
    /// A stream without a frame yet.
    pub fn new(id: StreamId, profile: StreamProfile, record: bool, slots: usize) -> Self {
        Self { id, profile, record, slots, books: Mutex::default() }
    }

    /// Slots that its channel has; fewer than it should when memory was short.
    pub fn slots(&self) -> usize {
        self.books().publisher.as_ref().map_or(self.slots, |publisher| publisher.slots())
    }

    /// The books, for reading or writing.
    pub fn books(&self) -> MutexGuard<'_, Books> {
        lock(&self.books)
    }

    /// The stream in numbers.
    pub fn status(&self, in_sets: SetAccount, now: HostTime) -> StreamStatus {
        let p = &self.profile;
        let books = self.books();
        let clock = books.clock.as_ref();
        let us = |ns: i64| ns as f64 / 1e3;
        StreamStatus {
            id: self.id.to_string(),
            derived: is_derived(&self.id.stream),
            format: p.format.name().to_owned(),
            width: p.width,
            height: p.height,
            nominal_hz: p.rate_hz,
            rate_hz: books.rate_hz(now),
            samples_hz: p.format.is_motion().then(|| books.samples_hz(now)),
            captured: books.captured,
            delivered: books.delivered,
            dropped: books.dropped.nonzero().map(|(r, n)| (r.name().to_owned(), n)).collect(),
            last_frame_age_ms: books.last_frame.map(|t| now.since_ns(t) as f64 / 1e6),
            latency_p50_ms: books.latency_ms(0.5),
            latency_p99_ms: books.latency_ms(0.99),
            clock: ClockStatus {
                domain: match p.clock.domain {
                    ClockDomain::Device => "device",
                    ClockDomain::Kernel => "kernel",
                    _ => "arrival",
                }
                .to_owned(),
                metadata: books.metadata.unwrap_or(p.metadata).name().to_owned(),
                metadata_lost: books.metadata_lost,
                epoch: books.epoch,
                rate_ppm: clock.map_or(0.0, |c| c.rate_ppm),
                uncertainty_us: books.uncertainty_ns as f64 / 1e3,
                residual_p50_us: clock.map_or(0.0, |c| us(c.residual_p50_ns)),
                residual_p99_us: clock.map_or(0.0, |c| us(c.residual_p99_ns)),
                uncertain_frames: books.uncertain,
            },
            in_sets,
        }
    }
}

/// True for the name of a stream that is computed from others.
pub fn is_derived(stream: &StreamName) -> bool {
    [REFINED, ALIGNED].contains(&stream.as_str())
}

impl Books {
    /// Begins a new opening of the camera and returns its number.
    pub fn begin_session(&mut self) -> u64 {
        self.session += 1;
        if let Superseding::Since(..) = self.superseding {
            // The time without a camera must not count.
            self.superseding = Superseding::Never;
        }
        if self.session > 1 {
            self.epoch_base = self.epoch + 1;
        }
        self.session
    }

    /// Ends the present session against the will of its thread: the frame it was writing is lost, and its
    /// later reports are ignored. Its publisher stays with it.
    pub fn close(&mut self) {
        let pending = self.captured - self.delivered - self.dropped.total();
        self.dropped.add(DropReason::Abandoned, pending);
        self.session += 1;
        self.publisher = None;
    }

    /// Whether a loss may be logged now: once a second.
    pub fn may_log_loss(&mut self, now: HostTime) -> bool {
        let may = self.loss_logged.is_none_or(|t| now.since_ns(t) > 1_000_000_000);
        if may {
            self.loss_logged = Some(now);
        }
        may
    }

    /// Notes that a frame of this computed stream was superseded by a newer one at `now`. Returns the report, once:
    /// the rate that was reached over the ten seconds since the first one, or a little more.
    pub fn superseded(&mut self, now: HostTime) -> Option<Reached> {
        match self.superseding {
            Superseding::Never => self.superseding = Superseding::Since(now, self.captured, self.delivered),
            Superseding::Since(since, captured, delivered) if now.since_ns(since) >= SETTLED_NS => {
                self.superseding = Superseding::Reported;
                let hz = |n: u64| n as f64 * 1e9 / now.since_ns(since) as f64;
                return Some(Reached {
                    reached_hz: hz(self.delivered - delivered),
                    of_hz: hz(self.captured - captured),
                });
            }
            Superseding::Since(..) | Superseding::Reported => {}
        }
        None
    }

    /// Notes a published frame; a batch of an IMU has more than one sample.
    fn note(&mut self, published: HostTime, latency_ns: i64, samples: u32) {
        if self.recent.len() == WINDOW {
            self.recent.pop_front();
        }
        self.recent.push_back((published, latency_ns, samples));
        self.last_frame = Some(published);
    }

    /// Accounts for a frame that was published under this header, `latency_ns` after it was captured.
    pub fn published(&mut self, header: &FrameHeader, latency_ns: i64) {
        self.delivered += 1;
        self.epoch = header.clock_epoch;
        self.uncertainty_ns = header.capture_uncertainty_ns;
        if header.temperature_c.is_finite() {
            self.temperature_c = Some(header.temperature_c);
        }
        self.uncertain += u64::from(header.has(FrameFlags::TIME_UNCERTAIN));
        self.note_metadata(header.metadata_level(), FrameFlags(header.flags));
        let is_motion = header.pixel_format().is_some_and(PixelFormat::is_motion);
        self.note(HostTime::now(), latency_ns, if is_motion { header.width } else { 1 });
    }

    /// Notes the source of the times of a published frame.
    const fn note_metadata(&mut self, level: MetadataLevel, flags: FrameFlags) {
        if flags.has(FrameFlags::METADATA_LOST) {
            self.metadata_lost += 1;
        } else {
            self.metadata = Some(level);
        }
    }

    /// Frames per second over the last two seconds or the last 256 frames.
    pub fn rate_hz(&self, now: HostTime) -> f64 {
        self.per_second(now, |_| 1)
    }

    /// Samples per second over the same time.
    pub fn samples_hz(&self, now: HostTime) -> f64 {
        self.per_second(now, |samples| samples)
    }

    fn per_second(&self, now: HostTime, weight: impl Fn(u32) -> u32) -> f64 {
        let from = now.plus_ns(-2_000_000_000);
        let mut recent = self.recent.iter().filter(|r| r.0 >= from);
        let (Some((first, ..)), Some((last, ..))) = (recent.next(), self.recent.back()) else { return 0.0 };
        // The samples of the first frame were taken before it.
        let mut intervals = 0.0_f64;
        let mut samples_sum = 0.0;
        for (_, _, samples) in recent {
            intervals += 1.0;
            samples_sum += f64::from(weight(*samples));
        }
        let span_ns = last.since_ns(*first) as f64;
        // A stream that just stopped must not look alive: from two missing frames on the silence counts.
        let silent = now.since_ns(*last) as f64 > 3.0 * span_ns / intervals.max(1.0);
        let span_ns = if silent { now.since_ns(*first) as f64 } else { span_ns };
        if span_ns > 0.0 { samples_sum * 1e9 / span_ns } else { 0.0 }
    }

    /// The latency from capture to publish that a share of `quantile` of the last frames stayed below, ms.
    pub fn latency_ms(&self, quantile: f64) -> f64 {
        let mut latencies: Vec<_> = self.recent.iter().map(|r| r.1).collect();
        if latencies.is_empty() {
            return 0.0;
        }
        let at = ((latencies.len() - 1) as f64 * quantile).round() as usize;
        *latencies.select_nth_unstable(at).1 as f64 / 1e6
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn closing_balances_the_books() {
        let mut books = Books { captured: 10, delivered: 7, ..Books::default() };
        books.dropped.add(DropReason::DeviceGap, 2);
        let session = books.begin_session();
        books.close();
        assert_eq!(books.captured, books.delivered + books.dropped.total());
        assert_eq!(books.dropped.get(DropReason::Abandoned), 1);
        assert_ne!(books.session, session);
    }

    #[test]
    fn superseded_computed_frames_are_reported_once_with_the_rate() {
        let mut books = Books::default();
        let at = |ms: i64| HostTime::from_ns(1_000_000_000 + ms * 1_000_000);
        assert_eq!(books.superseded(at(0)), None);
        // The camera goes away for an hour, which is no time of computing.
        books.begin_session();
        let hour = 3_600_000;
        let mut reports = Vec::new();
        for i in 0..600 {
            books.captured += 1;
            if i % 4 == 3 {
                books.delivered += 1;
                continue;
            }
            books.dropped.add(DropReason::QueueFull, 1);
            reports.extend(books.superseded(at(hour + i * 100 / 3)).map(|r| (i, r)));
        }
        let [(300, Reached { reached_hz, of_hz })] = reports[..] else { panic!("{reports:?}") };
        assert!((reached_hz - 7.5).abs() < 0.1 && (of_hz - 30.0).abs() < 0.1, "{reports:?}");
        assert!(books.may_log_loss(at(hour)), "no loss was logged");
    }

    #[test]
    fn a_frame_without_its_metadata_does_not_change_the_level() {
        let mut books = Books::default();
        books.note_metadata(MetadataLevel::Header, FrameFlags::HEADER_TIME);
        books.note_metadata(MetadataLevel::Arrival, FrameFlags::METADATA_LOST);
        assert_eq!((books.metadata, books.metadata_lost), (Some(MetadataLevel::Header), 1));
    }

    #[test]
    fn rate_counts_until_now() {
        let mut books = Books::default();
        let at = |ms: i64| HostTime::from_ns(10_000_000_000 + ms * 1_000_000);
        for i in 0..30 {
            books.note(at(i * 33), 5_000_000, 8);
        }
        for late in [0, 10, 33, 66] {
            assert!((books.rate_hz(at(29 * 33 + late)) - 1000.0 / 33.0).abs() < 0.01, "{late}");
            assert!((books.samples_hz(at(29 * 33 + late)) - 8000.0 / 33.0).abs() < 0.01, "{late}");
        }
        assert!(books.rate_hz(at(29 * 33 + 500)) < 21.0);
        assert!(books.rate_hz(at(5000)).abs() < 1e-9);
        assert!((books.latency_ms(0.5) - 5.0).abs() < 1e-9);
    }
}
