//! The capture benchmark: our V4L2 path against a bare loop of the crate `v4l` that copies each image once, alternating
//! on one camera.
//!
//! It measures the CPU time of the capture thread: its own instructions, and the kernel's on its behalf. In the virtual
//! machine (`tests/vm`), where time is the number of instructions, that is exact.

use anyhow::{Context, Result, bail};
use core::time::Duration;
use depthrig_bus::clock::thread_cpu_ns;
use depthrig_bus::{
    Bus, DropReason, FrameHeader, HostTime, PixelFormat, Publisher, RigName, RuntimeDir, StreamId, StreamName,
};
use depthrig_driver::clock::ClockQuality;
use depthrig_driver::{
    Backend, FrameMeta, FrameSink, Loan, StreamProfile, StreamRequest, choose_profiles, unpack,
};
use depthrig_v4l2::{ClockChoice, FourCc, MemoryChoice, Node, V4l2Backend, V4l2Config};
use serde::Serialize;
use v4l::buffer::Type;
use v4l::io::traits::CaptureStream;
use v4l::video::Capture as _;

/// CPU of our copying path over that of the bare loop, at most.
pub const CPU_BAR: f64 = 1.2;

/// Plan of the measurement.
#[derive(Debug, Clone)]
pub struct Plan {
    /// The camera, as a rig file names it.
    pub camera: V4l2Config,
    /// Width and height.
    pub size: (u32, u32),
    /// Frame rate.
    pub rate_hz: f64,
    /// Images of each way and round that are counted.
    pub images: u32,
    /// Images of each way and round before those, which fault memory in.
    pub warm_up: u32,
    /// Rounds; every way once in each.
    pub rounds: u32,
}

/// Capture method.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Way {
    /// The crate `v4l`, with one copy into the same buffer each time.
    Bare,
    /// Copied once, into shared memory, and published.
    Mmap,
    /// Written into shared memory by the kernel, and published.
    Userptr,
}

/// One way with one format.
#[derive(Debug, Clone, Serialize)]
pub struct Cost {
    /// The images' format.
    pub format: &'static str,
    /// The way.
    pub way: Way,
    /// CPU of one image in each round, microseconds.
    pub us: Vec<f64>,
    /// The middle one.
    pub median_us: f64,
    /// Its ratio to the bare loop's.
    pub ratio: f64,
    /// Bytes that we copied, over the bytes of the images.
    pub copies: f64,
}

/// The result.
#[derive(Debug, Clone, Serialize)]
pub struct CaptureReport {
    /// The camera.
    pub camera: String,
    /// Width and height.
    pub size: (u32, u32),
    /// Frame rate.
    pub rate_hz: f64,
    /// Images of each way and round.
    pub images: u32,
    /// One entry for each format and way.
    pub costs: Vec<Cost>,
    /// Conditions of the measurement.
    pub conditions: super::conditions::Conditions,
}

/// Measures every format of [16-bit grey or depth, YUYV] that the camera has.
///
/// # Errors
/// When the camera cannot be opened, lacks both formats, or stops sending images.
pub fn run(
    runtime: &RuntimeDir,
    plan: &Plan,
    mut progress: impl FnMut(&str, u64, u64),
) -> Result<CaptureReport> {
    let mut conditions = super::conditions::Conditions::now();
    let device = V4l2Backend::new(plan.camera.clone()).open(None)?;
    let camera = format!("{} at {}", device.info().model, device.info().port);
    let profiles: Vec<StreamProfile> = [PixelFormat::Z16, PixelFormat::Mono16, PixelFormat::Yuyv]
        .into_iter()
        .filter_map(|format| chosen(device.profiles(), plan, format))
        .collect();
    drop(device);
    if profiles.is_empty() {
        bail!("{camera} has neither z16, mono16 nor yuyv at {:?} and {} Hz", plan.size, plan.rate_hz);
    }
    let mut costs = Vec::new();
    let mut done = 0;
    let total = profiles.len() as u64 * 3 * u64::from(plan.rounds);
    for profile in &profiles {
        let mut of: Vec<(Way, Vec<f64>, f64)> =
            [Way::Bare, Way::Mmap, Way::Userptr].into_iter().map(|way| (way, Vec::new(), 0.0)).collect();
        for _ in 0..plan.rounds {
            for (way, us, copies) in &mut of {
                let taken = match way {
                    Way::Bare => bare(plan, profile)?,
                    Way::Mmap => ours(runtime, plan, profile, MemoryChoice::Mmap)?,
                    Way::Userptr => ours(runtime, plan, profile, MemoryChoice::UserPointer)?,
                };
                us.push(taken.0);
                *copies = taken.1;
                done += 1;
                progress("capture", done, total);
            }
        }
        let mut reference = f64::NAN;
        for (way, us, copies) in of {
            let median_us = median(&us);
            if way == Way::Bare {
                reference = median_us;
            }
            let format = profile.format.name();
            let ratio = median_us / reference;
            costs.push(Cost { format, way, us, median_us, ratio, copies });
        }
    }
    conditions.finish();
    Ok(CaptureReport {
        camera,
        size: plan.size,
        rate_hz: plan.rate_hz,
        images: plan.images,
        costs,
        conditions,
    })
}

fn chosen(all: &[StreamProfile], plan: &Plan, format: PixelFormat) -> Option<StreamProfile> {
    let stream = all.iter().find(|p| p.format == format)?.stream.clone();
    choose_profiles("", all, &[request(plan, stream, format)]).ok()?.into_iter().next()
}

fn request(plan: &Plan, stream: StreamName, format: PixelFormat) -> StreamRequest {
    StreamRequest {
        size: Some(plan.size),
        rate_hz: Some(plan.rate_hz),
        format: Some(format),
        ..StreamRequest::any(stream)
    }
}

fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted.get(sorted.len() / 2).copied().unwrap_or(f64::NAN)
}

/// CPU of one image in microseconds, and copies of it, with the crate `v4l` alone.
fn bare(plan: &Plan, profile: &StreamProfile) -> Result<(f64, f64)> {
    let fourcc = match profile.format {
        PixelFormat::Z16 => FourCc::Z16,
        PixelFormat::Mono16 => FourCc::Y16,
        _ => FourCc::YUYV,
    };
    let nodes = V4l2Backend::new(plan.camera.clone()).nodes()?;
    let has = |path: &&std::path::PathBuf| {
        Node::open(path).and_then(|n| n.formats()).is_ok_and(|f| f.contains(&fourcc))
    };
    let node = nodes.iter().find(has).context("the camera's node is gone")?;
    let device = v4l::Device::with_path(node)?;
    let format = v4l::Format::new(profile.width, profile.height, v4l::FourCC::new(&fourcc.0));
    device.set_format(&format)?;
    device.set_params(&v4l::video::capture::Parameters::with_fps(plan.rate_hz.round() as u32))?;
    let mut stream = v4l::io::mmap::Stream::with_buffers(&device, Type::VideoCapture, plan.camera.buffers)?;
    stream.set_timeout(TIMEOUT);
    let frame_bytes = profile.frame_bytes();
    let mut copy = vec![0; frame_bytes];
    let mut before = 0;
    for image in 0..plan.warm_up + plan.images {
        if image == plan.warm_up {
            before = thread_cpu_ns();
        }
        let (bytes, _) = stream.next()?;
        copy.copy_from_slice(bytes.get(..frame_bytes).context("a short image")?);
        core::hint::black_box(&copy);
    }
    Ok(((thread_cpu_ns() - before) as f64 / 1e3 / f64::from(plan.images), 1.0))
}

/// Timeout for an image.
const TIMEOUT: Duration = Duration::from_secs(5);

/// The same through our backend, into shared memory.
fn ours(
    runtime: &RuntimeDir,
    plan: &Plan,
    profile: &StreamProfile,
    memory: MemoryChoice,
) -> Result<(f64, f64)> {
    let config = V4l2Config { memory, clock: ClockChoice::Kernel, ..plan.camera.clone() };
    let device = V4l2Backend::new(config).open(None)?;
    let wanted = request(plan, profile.stream.clone(), profile.format);
    let mut stream = device.start(&[wanted])?;
    let bus = Bus::open(runtime, &RigName::new("bench")?)?;
    let id = StreamId::new("capture", profile.stream.as_str())?;
    let publisher = bus.publisher(&id, profile.frame_bytes(), depthrig_bus::shm::DEFAULT_SLOTS)?;
    let mut header = FrameHeader::default();
    header.set_image(profile.format, profile.width, profile.height);
    let mut sink = Sink { publisher, header, loan: None, published: 0 };
    let mut poll = |sink: &mut Sink, until: u64| -> Result<()> {
        while sink.published < until {
            let last = HostTime::now();
            let before = sink.published;
            while sink.published == before {
                stream.poll(Duration::from_millis(100), sink)?;
                if last.elapsed() > TIMEOUT {
                    bail!("no image for {TIMEOUT:?}");
                }
            }
        }
        Ok(())
    };
    poll(&mut sink, plan.warm_up.into())?;
    let cpu = thread_cpu_ns();
    let copied = unpack::copied_bytes();
    let first = sink.published;
    poll(&mut sink, first + u64::from(plan.images))?;
    let images = (sink.published - first) as f64;
    let us = (thread_cpu_ns() - cpu) as f64 / 1e3 / images;
    let copies = (unpack::copied_bytes() - copied) as f64 / (images * profile.frame_bytes() as f64);
    Ok((us, copies))
}

/// The benchmark's receiver: the work of the daemon's without its accounting.
struct Sink {
    publisher: Publisher,
    header: FrameHeader,
    loan: Option<depthrig_bus::FrameMut>,
    published: u64,
}

impl Sink {
    fn publish(&mut self, mut frame: depthrig_bus::FrameMut, meta: &FrameMeta) {
        let payload_len = frame.header().payload_len;
        *frame.header_mut() = FrameHeader {
            sequence: self.published + 1,
            capture_time_ns: meta.capture_time.ns(),
            arrival_time_ns: meta.arrival.ns(),
            payload_len,
            ..self.header
        };
        self.published += u64::from(self.publisher.send(frame).is_ok());
    }
}

impl FrameSink for Sink {
    fn loan(&mut self, _: usize, len: usize) -> Option<&mut [u8]> {
        let frame = self.publisher.loan(len).ok()?;
        Some(self.loan.insert(frame).pixels_mut())
    }

    fn commit(&mut self, _: usize, meta: &FrameMeta) {
        if let Some(frame) = self.loan.take() {
            self.publish(frame, meta);
        }
    }

    fn discard(&mut self, _: usize) {
        self.loan = None;
    }

    fn lend(&mut self, _: usize, len: usize) -> Option<Loan> {
        self.publisher.loan(len).ok().map(Loan::Slot)
    }

    fn commit_lent(&mut self, _: usize, loan: Loan, meta: &FrameMeta) {
        if let Loan::Slot(frame) = loan {
            self.publish(frame, meta);
        }
    }

    fn dropped(&mut self, _: usize, _: DropReason, _: u64) {}
    fn captured(&mut self, _: usize, _: u64) {}
    fn clock_quality(&mut self, _: usize, _: &ClockQuality) {}
}

/// Checks every promise.
pub fn bars(report: &CaptureReport) -> Vec<super::bus::report::Bar> {
    let of = |way: Way| report.costs.iter().filter(move |c| c.way == way);
    let worst = of(Way::Mmap).map(|c| c.ratio).fold(f64::NAN, f64::max);
    let copies = |way: Way| of(way).map(|c| c.copies).fold(0.0, f64::max);
    let mapped = copies(Way::Mmap);
    let user = copies(Way::Userptr);
    vec![
        super::bus::report::Bar {
            promise: "CPU of an image over a bare v4l loop with one copy: at most 1.2",
            measured: format!("{worst:.3}"),
            kept: worst <= CPU_BAR,
        },
        super::bus::report::Bar {
            promise: "copies of an image from the kernel's buffer: exactly 1",
            measured: format!("{mapped:.3}"),
            kept: mapped == 1.0,
        },
        super::bus::report::Bar {
            promise: "copies of an image that the kernel writes into shared memory: 0",
            measured: format!("{user:.3}"),
            kept: user == 0.0,
        },
    ]
}

/// Formats the report as text.
pub fn text(report: &CaptureReport) -> String {
    let (w, h) = report.size;
    let c = &report.conditions;
    let mut lines = vec![
        format!(
            "{} build, {} x {}, kernel {}, load {:.1} to {:.1}",
            c.build, c.cores, c.cpu, c.kernel, c.load_before, c.load_after
        ),
        format!(
            "{}, {w}x{h} at {} Hz, {} images of each way and round",
            report.camera, report.rate_hz, report.images
        ),
    ];
    for cost in &report.costs {
        let rounds: Vec<_> = cost.us.iter().map(|us| format!("{us:.0}")).collect();
        let way = match cost.way {
            Way::Bare => "bare v4l loop, one copy",
            Way::Mmap => "depthrig, memory = \"mmap\"",
            Way::Userptr => "depthrig, memory = \"userptr\"",
        };
        lines.push(format!(
            "  {:7} {way:28} {:8.1} us of CPU an image ({}), {:.3} x, {:.3} copies",
            cost.format,
            cost.median_us,
            rounds.join(" "),
            cost.ratio,
            cost.copies
        ));
    }
    lines.push("\nPromises".to_owned());
    lines.extend(bars(report).iter().map(super::bus::report::Bar::line));
    lines.join("\n")
}
