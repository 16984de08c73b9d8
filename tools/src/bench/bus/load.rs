//! The load of a mount: seven threads, each a camera with a colour and a depth stream, 30 times a second.
//!
//! The same threads at the same rate either publish or only copy the same bytes between their own buffers, so that
//! the difference is the cost of publishing.

use super::{CAMERA_BYTES, Channels, PERIOD, Source};
use anyhow::{Result, anyhow};
use core::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};
use core::time::Duration;
use depthrig_bus::clock::{process_cpu_ns, thread_cpu_ns};
use depthrig_bus::{Bus, ErrorKind, HostTime, Publisher};
use std::sync::Arc;
use std::thread::JoinHandle;

/// Work of the threads.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Work {
    /// Lend a slot, write it, send it.
    Publish,
    /// Copy into their own buffer.
    Copy,
}

/// One camera's frame pair.
#[derive(Debug, Clone, Copy)]
struct Sample {
    phase: u32,
    wall_ns: i64,
    cpu_ns: i64,
}

#[derive(Debug, Default)]
struct Shared {
    /// Number of the phase being measured; 0 while settling.
    phase: AtomicU32,
    copying: AtomicBool,
    stop: AtomicBool,
    sent: AtomicU64,
    refused: AtomicU64,
}

/// The running load.
pub struct Load {
    shared: Arc<Shared>,
    cameras: Vec<JoinHandle<Result<Vec<Sample>>>>,
    phases: u32,
}

/// A phase that has been measured.
#[derive(Debug, Clone, Copy)]
pub struct Phase {
    number: u32,
    /// CPU of the whole process over the phase, in cores.
    pub cores: f64,
}

/// Counts of a finished load.
pub struct Done {
    samples: Vec<Sample>,
    /// Frames sent.
    pub sent: u64,
    /// Frames dropped for lack of a free slot.
    pub refused: u64,
}

impl Load {
    /// Opens the channels of all cameras; the frames begin with [`Ready::start`].
    pub fn prepare(bus: &Bus, slots: usize) -> Result<Ready> {
        let mut cameras = Vec::new();
        for pair in Channels::ids()?.chunks_exact(2) {
            let open = |i: usize| bus.publisher(&pair[i], CAMERA_BYTES[i], slots);
            cameras.push([open(0)?, open(1)?]);
        }
        Ok(Ready { cameras })
    }

    /// Lets the threads settle in `work` for `settle`, then measures them for `length`. `every_tick` is called
    /// ten times a second.
    pub fn phase(
        &mut self,
        work: Work,
        settle: Duration,
        length: Duration,
        mut every_tick: impl FnMut() -> Result<()>,
    ) -> Result<Phase> {
        let mut pause = |length: Duration| -> Result<()> {
            let end = HostTime::now().plus(length);
            while !end.from_now().is_zero() {
                std::thread::sleep(end.from_now().min(Duration::from_millis(100)));
                every_tick()?;
            }
            Ok(())
        };
        self.shared.copying.store(work == Work::Copy, Ordering::Relaxed);
        pause(settle)?;
        self.phases += 1;
        let cpu = process_cpu_ns();
        let start = HostTime::now();
        self.shared.phase.store(self.phases, Ordering::Relaxed);
        pause(length)?;
        self.shared.phase.store(0, Ordering::Relaxed);
        let cpu = process_cpu_ns() - cpu;
        let wall = HostTime::now().since_ns(start);
        Ok(Phase { number: self.phases, cores: cpu as f64 / wall as f64 })
    }

    /// Stops the threads.
    pub fn finish(self) -> Result<Done> {
        self.shared.stop.store(true, Ordering::Relaxed);
        let mut samples = Vec::new();
        for camera in self.cameras {
            samples.extend(camera.join().map_err(|_| anyhow!("a camera thread panicked"))??);
        }
        let count = |n: &AtomicU64| n.load(Ordering::Relaxed);
        Ok(Done { samples, sent: count(&self.shared.sent), refused: count(&self.shared.refused) })
    }
}

/// Channels that are open and silent.
pub struct Ready {
    cameras: Vec<[Publisher; 2]>,
}

impl Ready {
    /// Starts the threads.
    pub fn start(self) -> Load {
        let shared = Arc::new(Shared::default());
        let spawn = |(index, publishers)| {
            let shared = shared.clone();
            std::thread::spawn(move || Camera::new(index, publishers).run(&shared))
        };
        let cameras = self.cameras.into_iter().enumerate().map(spawn).collect();
        Load { shared, cameras, phases: 0 }
    }
}

impl Done {
    /// Wall-clock times of the frame pairs of a phase, nanoseconds: loan, one write, send, both streams.
    pub fn wall_ns(&self, phase: Phase) -> Vec<i64> {
        self.of(phase).map(|s| s.wall_ns).collect()
    }

    /// CPU times of the same.
    pub fn cpu_ns(&self, phase: Phase) -> Vec<i64> {
        self.of(phase).map(|s| s.cpu_ns).collect()
    }

    fn of(&self, phase: Phase) -> impl Iterator<Item = &Sample> {
        self.samples.iter().filter(move |s| s.phase == phase.number)
    }
}

struct Camera {
    publishers: [Publisher; 2],
    sources: [Source; 2],
    /// Targets of the bare copies: as many buffers as publishing used slots.
    targets: [Vec<Vec<u8>>; 2],
    slots_seen: [Vec<usize>; 2],
    phase_of_tick: Duration,
    sequence: u64,
}

impl Camera {
    fn new(index: usize, publishers: [Publisher; 2]) -> Self {
        Self {
            publishers,
            sources: CAMERA_BYTES.map(|bytes| Source::new(bytes, index as u8)),
            targets: [Vec::new(), Vec::new()],
            slots_seen: [Vec::new(), Vec::new()],
            phase_of_tick: PERIOD * index as u32 / Channels::CAMERAS as u32,
            sequence: 0,
        }
    }

    fn run(mut self, shared: &Shared) -> Result<Vec<Sample>> {
        let mut samples = Vec::new();
        let mut tick = HostTime::now().plus(self.phase_of_tick);
        while !shared.stop.load(Ordering::Relaxed) {
            tick = tick.plus(PERIOD);
            std::thread::sleep(tick.from_now());
            let phase = shared.phase.load(Ordering::Relaxed);
            let wall = HostTime::now();
            let cpu = thread_cpu_ns();
            self.sequence += 1;
            for stream in 0..2 {
                if shared.copying.load(Ordering::Relaxed) {
                    self.copy(stream);
                } else {
                    self.publish(stream, shared)?;
                }
            }
            let wall_ns = HostTime::now().since_ns(wall);
            samples.push(Sample { phase, wall_ns, cpu_ns: thread_cpu_ns() - cpu });
        }
        Ok(samples)
    }

    fn publish(&mut self, stream: usize, shared: &Shared) -> Result<()> {
        let pixels = self.sources[stream].next();
        let mut frame = match self.publishers[stream].loan(pixels.len()) {
            Ok(frame) => frame,
            Err(e) if e.kind() == ErrorKind::NoSpace => {
                shared.refused.fetch_add(1, Ordering::Relaxed);
                return Ok(());
            }
            Err(e) => return Err(e.into()),
        };
        let slot = frame.pixels_mut();
        slot.copy_from_slice(pixels);
        let seen = &mut self.slots_seen[stream];
        let address = slot.as_ptr().addr();
        if !seen.contains(&address) {
            seen.push(address);
        }
        frame.header_mut().sequence = self.sequence;
        self.publishers[stream].send(frame)?;
        shared.sent.fetch_add(1, Ordering::Relaxed);
        Ok(())
    }

    fn copy(&mut self, stream: usize) {
        let buffers = self.slots_seen[stream].len().max(1);
        let targets = &mut self.targets[stream];
        targets.resize_with(buffers, || vec![0; CAMERA_BYTES[stream]]);
        let target = &mut targets[self.sequence as usize % buffers];
        target.copy_from_slice(self.sources[stream].next());
        core::hint::black_box(&*target);
    }
}
