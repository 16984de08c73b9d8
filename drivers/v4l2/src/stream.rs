//! A streaming camera: each image through its stream's gate, into shared memory.

use super::config::{ClockChoice, MemoryChoice, V4l2Config};
use super::lent::{Filled, LentSource, Refused};
use super::metadata::MetadataFormat;
use super::node::{Layout, Mode, Node};
use super::offer::{Offer, kernel_clock};
use super::panel::Panel;
use super::source::{Source, Stamp, Wanted};
use super::tick::{self, Sample};
use core::time::Duration;
use depthrig_bus::{ClockDomain, DropReason, FrameFlags, HostTime, MetadataLevel, PixelFormat};
use depthrig_driver::controls::ControlPanel;
use depthrig_driver::{
    DeviceClock, FrameSink, Gate, Loan, Outcome, Poll, RawFrame, Result, Stream, StreamProfile, unpack,
};
use depthrig_usb::uvc::payload::PayloadHeader;
use depthrig_usb::video::{Image, ImageSource};
use std::path::PathBuf;
use std::sync::{Arc, Weak};

/// How long the images for [`tick`] may take to come, together.
const TICK_TIMEOUT: Duration = Duration::from_secs(1);

/// A node with the mode that was set on it.
pub(super) struct Ready {
    pub(super) video: Node,
    pub(super) metadata: Option<Node>,
    pub(super) offer: Offer,
    pub(super) layout: Layout,
}

/// A streaming camera.
pub(super) struct V4l2Stream {
    name: String,
    profiles: Vec<StreamProfile>,
    streams: Vec<StreamState>,
    way: Way,
    buffers: u32,
    panel: Arc<dyn ControlPanel>,
}

/// How images are received.
enum Way {
    /// In the kernel's buffers.
    Mapped(Source),
    /// In the receiver's memory; the nodes to reopen if the first poll shows that this is unsupported.
    Lent(LentSource, Vec<Spot>),
}

/// A node to be opened again.
struct Spot {
    path: PathBuf,
    mode: Mode,
}

/// One stream.
struct StreamState {
    name: String,
    gate: Gate,
    unpack: Unpack,
    clock: StreamClock,
}

/// How the images of a stream get into the receiver's memory.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Unpack {
    /// Rows that may be padded.
    Rows { stride: usize, row: usize, rows: usize },
    /// A JPEG image as it came.
    Keep,
    /// A JPEG image, decoded.
    Decode { width: u32, height: u32 },
}

/// Where the times of a stream come from.
enum StreamClock {
    /// The stamps of the kernel; whether one ahead of us was seen and said.
    Kernel { said: bool },
    /// When we got the image.
    Arrival,
    /// The device's counter, which ticks so often a second; its last stamp and the host's.
    Device { hz: u32, last: Option<(u32, HostTime)> },
}

impl V4l2Stream {
    /// Starts all of `ready` together. `clock_hz` is what the camera says of its clock.
    pub(super) fn start(
        name: String,
        ready: Vec<Ready>,
        config: &V4l2Config,
        clock_hz: Option<u32>,
        nodes: Vec<PathBuf>,
    ) -> Result<Self> {
        let mut profiles: Vec<StreamProfile> = ready.iter().map(|r| r.offer.profile.clone()).collect();
        let unpacks: Vec<Unpack> = ready.iter().map(|r| Unpack::of(&r.offer.profile, r.layout)).collect();
        let (way, clocks) = match config.memory {
            MemoryChoice::Mmap => mapped(&name, ready, &profiles, config, clock_hz)?,
            MemoryChoice::UserPointer => lent(&name, ready, &profiles, config)?,
        };
        let mut streams = Vec::new();
        for (i, (profile, clock)) in profiles.iter_mut().zip(clocks).enumerate() {
            (profile.clock, profile.metadata) = clock.of_profile();
            let unpack = unpacks.get(i).copied().unwrap_or(Unpack::Keep);
            let stream = &profile.stream;
            let times = profile.metadata.name();
            tracing::info!(camera = name, %stream, times, memory = way.name(), "streaming from the kernel's node");
            streams.push(StreamState {
                name: format!("{name}, {stream}"),
                gate: Gate::new(i, profile),
                unpack,
                clock,
            });
        }
        let panel = Arc::new(Panel { nodes });
        Ok(Self { name, profiles, streams, way, buffers: config.buffers, panel })
    }

    /// Goes over to the kernel's buffers, for the reason given.
    fn fall_back(&mut self, why: &str) -> Result<()> {
        say_fall_back(&self.name, why);
        let Way::Lent(source, spots) = &mut self.way else { return Ok(()) };
        let spots = core::mem::take(spots);
        // The nodes must be closed before they can be asked for other buffers.
        *source = LentSource::none();
        self.way = Way::Mapped(reopen(&spots, self.buffers)?);
        Ok(())
    }
}

impl Way {
    const fn name(&self) -> &'static str {
        match self {
            Self::Mapped(_) => "mmap",
            Self::Lent(..) => "userptr",
        }
    }
}

fn say_fall_back(name: &str, why: &str) {
    tracing::warn!(
        camera = name,
        "images are copied once, because the kernel cannot write them itself: {why}"
    );
}

fn reopen(spots: &[Spot], buffers: u32) -> Result<Source> {
    let mut wanted = Vec::new();
    for spot in spots {
        let node = Node::open(&spot.path)?;
        node.set_mode(&spot.mode)?;
        wanted.push(Wanted::plain(node));
    }
    Source::start(wanted, buffers)
}

/// Starts in the kernel's buffers, and finds out which clock each stream has.
fn mapped(
    name: &str,
    ready: Vec<Ready>,
    profiles: &[StreamProfile],
    config: &V4l2Config,
    clock_hz: Option<u32>,
) -> Result<(Way, Vec<StreamClock>)> {
    let wants_headers = config.clock == ClockChoice::Auto;
    let wanted = ready.into_iter().map(|r| Wanted {
        video: r.video,
        metadata: r.metadata.filter(|_| wants_headers).map(|node| (node, MetadataFormat::Uvch)),
    });
    let mut source = Source::start(wanted.collect(), config.buffers)?;
    let samples = if (0..profiles.len()).any(|i| source.metadata(i) != MetadataFormat::None) {
        first_stamps(&mut source, profiles.len(), clock_hz)?
    } else {
        Vec::new()
    };
    let clock = |i: usize| {
        let seen = samples.get(i).map(Vec::as_slice).unwrap_or_default();
        match tick::frequency_hz(seen, clock_hz) {
            Some(hz) => StreamClock::Device { hz, last: None },
            None => StreamClock::of_host(source.stamp(i)),
        }
    };
    let clocks: Vec<StreamClock> = (0..profiles.len()).map(clock).collect();
    let is_unused =
        |(c, s): &(&StreamClock, &Vec<Sample>)| !matches!(c, StreamClock::Device { .. }) && !s.is_empty();
    if let Some((_, seen)) = clocks.iter().zip(&samples).find(is_unused) {
        let measured_hz = tick::measured_hz(seen).unwrap_or(f64::NAN).round();
        tracing::info!(
            camera = name,
            measured_hz,
            "the clock in its payload headers ticks neither as its descriptor says nor in microseconds; the kernel's \
             stamps are used (device_clock_hz in the rig file names its frequency)"
        );
    }
    Ok((Way::Mapped(source), clocks))
}

/// The time stamps in the first payload headers of each stream. The images themselves are not captured yet.
fn first_stamps(source: &mut Source, streams: usize, clock_hz: Option<u32>) -> Result<Vec<Vec<Sample>>> {
    let mut samples: Vec<Vec<Sample>> = vec![Vec::new(); streams];
    let until = HostTime::now().plus(TICK_TIMEOUT);
    while !samples.iter().all(|s| tick::is_settled(s, clock_hz)) && !until.from_now().is_zero() {
        source.poll(until.from_now(), &mut |p| {
            let sample = pts(p).map(|ticks| Sample { ticks, host: p.kernel_time.unwrap_or(p.arrival) });
            if let Some(of) = samples.get_mut(p.source).filter(|s| !tick::is_settled(s, clock_hz)) {
                of.extend(sample);
            }
        })?;
    }
    Ok(samples)
}

/// The presentation time stamp in the payload header of an image.
fn pts(p: &Image<'_>) -> Option<u32> {
    PayloadHeader::parse(p.header?).ok()?.pts
}

/// Prepares streaming into the receiver's memory, or starts in the kernel's buffers when that is refused.
fn lent(
    name: &str,
    ready: Vec<Ready>,
    profiles: &[StreamProfile],
    config: &V4l2Config,
) -> Result<(Way, Vec<StreamClock>)> {
    let spots: Vec<Spot> =
        ready.iter().map(|r| Spot { path: r.video.path().to_owned(), mode: r.offer.mode }).collect();
    let varies = |p: &StreamProfile| matches!(p.format, PixelFormat::Mjpeg | PixelFormat::Rgb8);
    let prepared = if profiles.iter().any(varies) {
        Err(Refused { why: "Motion JPEG is of another length each time".to_owned() })
    } else {
        let nodes = ready.into_iter().zip(profiles).map(|(r, p)| (r.video, r.layout, p.frame_bytes()));
        LentSource::new(nodes.collect(), config.buffers)
    };
    match prepared {
        Ok(source) => {
            let clocks = (0..profiles.len()).map(|i| StreamClock::of_host(source.stamp(i))).collect();
            Ok((Way::Lent(source, spots), clocks))
        }
        Err(Refused { why }) => {
            say_fall_back(name, &why);
            let source = reopen(&spots, config.buffers)?;
            let clocks = (0..profiles.len()).map(|i| StreamClock::of_host(source.stamp(i))).collect();
            Ok((Way::Mapped(source), clocks))
        }
    }
}

impl Stream for V4l2Stream {
    fn profiles(&self) -> &[StreamProfile] {
        &self.profiles
    }

    fn poll(&mut self, timeout: Duration, sink: &mut dyn FrameSink) -> Result<Poll> {
        // Only here is there a sink that could lend.
        if let Way::Lent(source, _) = &mut self.way
            && let Err(Refused { why }) = source.start(sink)
        {
            self.fall_back(&why)?;
        }
        let streams = &mut self.streams;
        let any = match &mut self.way {
            Way::Mapped(source) => source.poll(timeout, &mut |p| {
                if let Some(stream) = streams.get_mut(p.source) {
                    stream.copy(p, sink);
                }
            })?,
            Way::Lent(source, _) => source.poll(timeout, sink, &mut |index, filled, loan, sink| {
                streams.get_mut(index).and_then(|stream| stream.publish(filled, loan, sink))
            })?,
        };
        Ok(if any { Poll::Frame } else { Poll::Idle })
    }

    fn controls(&self) -> Option<Weak<dyn ControlPanel>> {
        Some(Arc::downgrade(&self.panel))
    }
}

impl StreamState {
    /// An image in the kernel's buffer: copied once.
    fn copy(&mut self, p: &Image<'_>, sink: &mut dyn FrameSink) {
        let Self { gate, unpack, clock, name } = self;
        let (bytes, arrived) = unpack.measure(p.bytes);
        let mut raw = RawFrame::new(p.sequence, 0, p.arrival, arrived);
        raw.damaged = p.damaged;
        clock.stamp(&mut raw, p.kernel_time, pts(p), name);
        gate.deliver(&raw, sink, |to| unpack.fill(bytes, to));
    }

    /// An image in the receiver's memory already. The loan comes back when it is not published.
    fn publish(&mut self, filled: &Filled, loan: Loan, sink: &mut dyn FrameSink) -> Option<Loan> {
        let Self { gate, clock, name, .. } = self;
        let mut raw = RawFrame::new(filled.sequence, 0, filled.arrival, filled.bytes);
        raw.damaged = filled.damaged;
        clock.stamp(&mut raw, filled.kernel_time, None, name);
        let (outcome, loan) = gate.deliver_lent(&raw, sink, loan);
        debug_assert_eq!(outcome == Outcome::Delivered, loan.is_none());
        loan
    }
}

impl Unpack {
    fn of(profile: &StreamProfile, layout: Layout) -> Self {
        let &StreamProfile { format, width, height, .. } = profile;
        match format {
            PixelFormat::Mjpeg => Self::Keep,
            PixelFormat::Rgb8 => Self::Decode { width, height },
            _ => {
                let row = format.row_bytes(width) as usize;
                let rows = profile.frame_bytes().checked_div(row).unwrap_or(0);
                // A driver that says nothing of its rows does not pad them.
                let stride = (layout.bytes_per_line as usize).max(row);
                Self::Rows { stride, row, rows }
            }
        }
    }

    /// The image within `bytes`, and how many bytes of a delivered frame it stands for.
    fn measure(self, bytes: &[u8]) -> (&[u8], usize) {
        match self {
            Self::Rows { stride, row, rows } => {
                let needed = rows.checked_sub(1).map_or(0, |before| before * stride + row);
                let whole = rows * row;
                let arrived =
                    if bytes.len() >= needed { whole } else { bytes.len().min(whole.saturating_sub(1)) };
                (bytes, arrived)
            }
            Self::Keep => {
                let image = unpack::jpeg_span(bytes).unwrap_or_default();
                (image, image.len())
            }
            Self::Decode { width, height } => {
                let image = unpack::jpeg_span(bytes).unwrap_or_default();
                let whole = PixelFormat::Rgb8.frame_bytes(width, height);
                (image, if image.is_empty() { 0 } else { whole })
            }
        }
    }

    fn fill(self, image: &[u8], to: &mut [u8]) -> Result<(), DropReason> {
        match self {
            Self::Rows { stride, row, .. } => unpack::copy_rows(image, stride, row, to),
            Self::Keep => unpack::keep_jpeg(image, to),
            Self::Decode { width, height } => unpack::decode_jpeg(image, width, height, to),
        }
    }
}

impl StreamClock {
    const fn of_host(stamp: Stamp) -> Self {
        match stamp {
            Stamp::Start | Stamp::End => Self::Kernel { said: false },
            Stamp::Unknown => Self::Arrival,
        }
    }

    const fn of_profile(&self) -> (DeviceClock, MetadataLevel) {
        match self {
            Self::Kernel { .. } => (kernel_clock(ClockDomain::Kernel), MetadataLevel::Kernel),
            Self::Arrival => (kernel_clock(ClockDomain::Arrival), MetadataLevel::Arrival),
            Self::Device { hz, .. } => {
                let tick_ps = 1_000_000_000_000 / *hz as u64;
                let clock = DeviceClock { counter_bits: 32, tick_ps, domain: ClockDomain::Device };
                (clock, MetadataLevel::Header)
            }
        }
    }

    /// Puts the time of an image into `raw`.
    fn stamp(&mut self, raw: &mut RawFrame, kernel: Option<HostTime>, pts: Option<u32>, name: &str) {
        let uncertain = |raw: &mut RawFrame| raw.flags = raw.flags.with(FrameFlags::TIME_UNCERTAIN);
        match self {
            Self::Arrival => raw.device_ticks = raw.arrival.ns().cast_unsigned(),
            Self::Kernel { said } => {
                let stamp = kernel.unwrap_or(raw.arrival);
                raw.device_ticks = stamp.ns().cast_unsigned();
                if kernel.is_none() {
                    uncertain(raw);
                } else if stamp > raw.arrival {
                    // The gate takes the arrival instead.
                    uncertain(raw);
                    if !core::mem::replace(said, true) {
                        let ahead_ms = stamp.since_ns(raw.arrival) as f64 / 1e6;
                        tracing::warn!(
                            stream = name,
                            ahead_ms,
                            "the driver stamps frames ahead of time; the time of arrival is used"
                        );
                    }
                }
            }
            Self::Device { hz, last } => {
                let host = kernel.unwrap_or(raw.arrival);
                let ticks = pts.unwrap_or_else(|| {
                    raw.flags = raw.flags.with(FrameFlags::METADATA_LOST);
                    reckoned(*last, host, *hz)
                });
                raw.device_ticks = ticks.into();
                *last = Some((ticks, host));
            }
        }
    }
}

/// The device's counter at `host`, from its last stamp: for an image whose header was lost.
fn reckoned(last: Option<(u32, HostTime)>, host: HostTime, hz: u32) -> u32 {
    let Some((ticks, then)) = last else { return 0 };
    let since = i128::from(host.since_ns(then)) * i128::from(hz) / 1_000_000_000;
    ticks.wrapping_add(since as u32)
}

#[cfg(test)]
mod tests;
