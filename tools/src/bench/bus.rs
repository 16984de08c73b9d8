//! The bus benchmark: the cost of sending a frame, against the bare transport and against bare memory copies.
//!
//! Compared measurements alternate within one run, so that both sides see the same machine load.

pub mod copies;
pub mod latency;
pub mod load;
pub mod place;
pub mod raw;
pub mod reader;
pub mod report;

use super::conditions::Conditions;
use super::stats::{Quantiles, median};
use anyhow::Result;
use copies::Copies;
use core::time::Duration;
use depthrig_bus::{Bus, HostTime, PixelFormat, RuntimeDir, shm};
use latency::Latency;
use load::{Done, Load, Phase, Work};
use reader::{Mode, Reader};
use serde::Serialize;

/// The rig of the bench.
pub const RIG: &str = "bench";
const WIDTH: u32 = 1280;
const HEIGHT: u32 = 720;
/// Bytes of a camera's colour and depth image.
pub const CAMERA_BYTES: [usize; 2] =
    [PixelFormat::Rgb8.frame_bytes(WIDTH, HEIGHT), PixelFormat::Z16.frame_bytes(WIDTH, HEIGHT)];
/// Bytes of both together.
pub const FRAME_BYTES: usize = CAMERA_BYTES[0] + CAMERA_BYTES[1];
/// 30 Hz.
pub const PERIOD: Duration = Duration::from_nanos(33_333_333);

/// The channels of the bench.
pub struct Channels;

impl Channels {
    /// Cameras of the mount.
    pub const CAMERAS: usize = 7;
}

/// A driver that owns its buffers: a few images that take turns.
pub struct Source {
    images: Vec<Vec<u8>>,
    turn: usize,
}

impl Source {
    /// Images of `bytes` bytes; `seed` makes them differ.
    pub fn new(bytes: usize, seed: u8) -> Self {
        let image = |i: u8| (0..bytes).map(|at| (at as u8).wrapping_mul(31) ^ seed.wrapping_add(i)).collect();
        Self { images: (0..4).map(image).collect(), turn: 0 }
    }

    /// The next image.
    pub fn next(&mut self) -> &[u8] {
        self.turn = (self.turn + 1) % self.images.len();
        &self.images[self.turn]
    }

    /// Writes the next image to `slot`; returns how many bytes it wrote.
    pub fn write_to(&mut self, slot: &mut [u8]) -> usize {
        let image = self.next();
        slot.copy_from_slice(image);
        image.len()
    }
}

/// Amount of measurements.
#[derive(Debug, Clone, Copy)]
pub struct Plan {
    /// Pairs of latency blocks of one second.
    pub blocks: u64,
    /// Rounds of the seven-camera load.
    pub rounds: u32,
    /// Length of a phase of a round.
    pub phase: Duration,
    /// How long the load settles before a phase.
    pub settle: Duration,
}

/// The result of the bench.
#[derive(Debug, Serialize)]
pub struct BusReport {
    /// Conditions of the measurement.
    pub conditions: Conditions,
    /// Publish-to-receive against a bare loop.
    pub latency: Latency,
    /// Copies of the pixels.
    pub copies: Copies,
    /// Seven cameras.
    pub load: LoadReport,
}

/// Result of the seven-camera load. Times are of one camera's pair of frames: two loans, writes and sends.
#[derive(Debug, Serialize)]
pub struct LoadReport {
    /// Frames sent over the whole load.
    pub sent: u64,
    /// Frames that the subscriber did not get, for whatever reason.
    pub lost: u64,
    /// Slots of each channel.
    pub slots: usize,
    /// CPU of the publishing process, cores, one value a round.
    pub publish_cores: Vec<f64>,
    /// CPU of the same process copying the same bytes at the same rate.
    pub copy_cores: Vec<f64>,
    /// Median over the rounds of publishing over copying.
    pub cpu_ratio: f64,
    /// Publisher times with one subscriber that keeps up.
    pub normal: Disturbed,
    /// With another one that holds every frame it may.
    pub holding: Disturbed,
    /// With another one that is killed with SIGKILL and started again once a second.
    pub killed: Disturbed,
    /// How often it was killed.
    pub kills: u64,
}

/// Publisher times in one circumstance.
#[derive(Debug, Serialize)]
pub struct Disturbed {
    /// Wall clock, all rounds together.
    pub wall: Quantiles,
    /// CPU time of the publishing thread, all rounds together.
    pub cpu: Quantiles,
    /// Wall-clock p99 over that of the normal phases, all rounds together: one round has too few frames in its
    /// slowest hundredth to resolve a tenth.
    pub p99_ratio: f64,
    /// The same of CPU time, which other processes of the machine disturb less.
    pub cpu_p99_ratio: f64,
    /// Median over the rounds of the wall-clock p99 over that of the normal phase of the same round.
    pub p99_ratio_of_rounds: f64,
}

/// Runs the benchmark with its channels in `runtime`, which no other rig may use.
pub fn run(runtime: &RuntimeDir, plan: Plan, mut progress: impl FnMut(&str, u64, u64)) -> Result<BusReport> {
    let bus = Bus::open(runtime, &depthrig_bus::RigName::new(RIG)?)?;
    let mut conditions = Conditions::now();
    let copies = copies::run(&bus, 30)?;
    let latency =
        latency::run(&bus, plan.blocks, |done| progress("publish to receive", done, 2 * plan.blocks))?;
    let load = run_load(&bus, plan, &mut progress)?;
    conditions.finish();
    Ok(BusReport { conditions, latency, copies, load })
}

/// Measurements of one round.
struct Round {
    normal: Phase,
    copy: Phase,
    holding: Phase,
    killed: Phase,
}

fn run_load(bus: &Bus, plan: Plan, progress: &mut impl FnMut(&str, u64, u64)) -> Result<LoadReport> {
    let runtime = bus.runtime();
    let streams = 2 * Channels::CAMERAS;
    let free = shm::free_bytes(std::path::Path::new(shm::SHM_DIR))?;
    let slots = shm::slots_that_fit(shm::DEFAULT_SLOTS, (FRAME_BYTES * Channels::CAMERAS) as u64, free)?;
    let ready = Load::prepare(bus, slots)?;
    let reader = Reader::start(runtime, Mode::Count, streams)?;
    let mut load = ready.start();
    let mut rounds = Vec::new();
    let mut kills = 0;
    let mut cleaned = HostTime::now();
    let mut housekeeping = || {
        if cleaned.elapsed() >= Duration::from_secs(1) {
            bus.clean_dead(); // as the daemon does
            cleaned = HostTime::now();
        }
    };
    for round in 0..plan.rounds {
        let mut step = |i| progress("seven cameras", u64::from(round) * 4 + i, u64::from(plan.rounds) * 4);
        let mut quiet = || {
            housekeeping();
            Ok(())
        };
        let normal = load.phase(Work::Publish, plan.settle, plan.phase, &mut quiet)?;
        step(1);
        let copy = load.phase(Work::Copy, plan.settle, plan.phase, &mut quiet)?;
        step(2);
        let holder = Reader::start(runtime, Mode::Hold, streams)?;
        let holding = load.phase(Work::Publish, plan.settle, plan.phase, &mut quiet)?;
        holder.finish()?;
        step(3);
        let mut victim = Some((Reader::start_at_once(runtime, Mode::Count, streams)?, HostTime::now()));
        let killed = load.phase(Work::Publish, plan.settle, plan.phase, || {
            if let Some((reader, _)) = victim.take_if(|(_, since)| since.elapsed() >= Duration::from_secs(1))
            {
                reader.kill()?;
                kills += 1;
                victim = Some((Reader::start_at_once(runtime, Mode::Count, streams)?, HostTime::now()));
            }
            housekeeping();
            Ok(())
        })?;
        drop(victim);
        step(4);
        rounds.push(Round { normal, copy, holding, killed });
    }
    let done = load.finish()?;
    std::thread::sleep(PERIOD * 3);
    let seen = reader.finish()?;
    let lost = done.refused + done.sent.saturating_sub(seen.received);
    Ok(summarise(&done, &rounds, slots, lost, kills))
}

fn summarise(done: &Done, rounds: &[Round], slots: usize, lost: u64, kills: u64) -> LoadReport {
    let cores = |phase: fn(&Round) -> Phase| rounds.iter().map(|r| phase(r).cores).collect::<Vec<_>>();
    let publish_cores = cores(|r| r.normal);
    let copy_cores = cores(|r| r.copy);
    let ratios: Vec<f64> = publish_cores.iter().zip(&copy_cores).map(|(p, c)| p / c).collect();
    let all = |phase: fn(&Round) -> Phase, of: fn(&Done, Phase) -> Vec<i64>| {
        Quantiles::of_ns(&rounds.iter().flat_map(|r| of(done, phase(r))).collect::<Vec<_>>())
    };
    let disturbed = |phase: fn(&Round) -> Phase| {
        let wall = all(phase, Done::wall_ns);
        let cpu = all(phase, Done::cpu_ns);
        let p99 = |phase| Quantiles::of_ns(&done.wall_ns(phase)).p99_us;
        Disturbed {
            p99_ratio: wall.p99_us / all(|r| r.normal, Done::wall_ns).p99_us,
            cpu_p99_ratio: cpu.p99_us / all(|r| r.normal, Done::cpu_ns).p99_us,
            p99_ratio_of_rounds: median(
                &rounds.iter().map(|r| p99(phase(r)) / p99(r.normal)).collect::<Vec<_>>(),
            ),
            wall,
            cpu,
        }
    };
    LoadReport {
        sent: done.sent,
        lost,
        slots,
        cpu_ratio: median(&ratios),
        publish_cores,
        copy_cores,
        normal: disturbed(|r| r.normal),
        holding: disturbed(|r| r.holding),
        killed: disturbed(|r| r.killed),
        kills,
    }
}
