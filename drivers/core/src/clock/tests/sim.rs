//! A simulated camera clock and transport for the tests: frames with a truth to compare against.
//!
//! 30 fps; a crystal with an offset, a thermal drift and a random walk of its rate; a constant base latency with
//! exponential jitter; stalls that hold frames back and deliver them together; a wrapping counter.

/// `SplitMix64`: the tests need their own reproducible numbers, not good ones.
pub struct Rng(u64);

impl Rng {
    pub fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ 0x5851_f42d_4c95_7f2d)
    }

    pub fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// Uniform in [0, 1).
    pub fn uniform(&mut self) -> f64 {
        (self.next() >> 11) as f64 / (1u64 << 53) as f64
    }

    pub fn exponential(&mut self, mean: f64) -> f64 {
        -mean * (1.0 - self.uniform()).ln()
    }

    pub fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.uniform()).sum::<f64>() - 6.0
    }
}

/// Kind of camera and bus.
#[derive(Clone, Copy)]
pub struct Scenario {
    pub seconds: f64,
    pub fps: f64,
    pub rate_ppm: f64,
    pub thermal_ppm: f64,
    /// Time constant of the warming, s; negative: the period of a sine instead.
    pub thermal_s: f64,
    pub walk_ppm_per_sqrt_s: f64,
    pub base_ns: f64,
    pub jitter_ns: f64,
    /// Exponentials that the jitter is the sum of: with two, hardly a frame is as fast as can be.
    pub hops: u32,
    pub stall_share: f64,
    pub counter_bits: u32,
    pub tick_ns: f64,
    /// Counter at the first frame.
    pub counter_start: u64,
}

pub const NOMINAL: Scenario = Scenario {
    seconds: 1800.0,
    fps: 30.0,
    rate_ppm: 50.0,
    thermal_ppm: 2.0,
    thermal_s: 300.0,
    walk_ppm_per_sqrt_s: 0.003,
    base_ns: 3e6,
    jitter_ns: 0.4e6,
    hops: 1,
    stall_share: 0.002,
    counter_bits: 32,
    tick_ns: 1000.0,
    counter_start: 0xc000_0000, // comes round after 18 minutes
};

pub const HEAVY: Scenario = Scenario { jitter_ns: 2e6, stall_share: 0.02, ..NOMINAL };
pub const THERMAL: Scenario = Scenario { thermal_ppm: 10.0, ..NOMINAL };

/// One delivered frame.
#[derive(Clone, Copy)]
pub struct Sample {
    pub raw: u64,
    /// Ticks since the first frame, as a counter without end would show them.
    pub unwrapped: u64,
    pub sequence: u64,
    pub arrival_ns: i64,
    /// True time of the event that the device stamped.
    pub truth_ns: f64,
}

/// All frames of one run.
pub fn generate(s: &Scenario, seed: u64) -> Vec<Sample> {
    let mut rng = Rng::new(seed);
    let period_ns = 1e9 / s.fps;
    let start_ns = 3.6e12; // the host has been up for an hour
    let mut walk = 0.0;
    let mut device_ns = 0.0;
    let mut stalled_until = 0.0;
    let mut last_arrival = 0.0f64;
    let mut out = Vec::new();
    for i in 0..(s.seconds * s.fps) as u64 {
        let t_s = i as f64 / s.fps;
        let truth = start_ns + i as f64 * period_ns;
        let ticks = (device_ns / s.tick_ns) as u64;
        let raw = s.counter_start.wrapping_add(ticks) & (u64::MAX >> (64 - s.counter_bits));
        let thermal = if s.thermal_s > 0.0 {
            1.0 - (-t_s / s.thermal_s).exp()
        } else {
            (t_s / s.thermal_s * core::f64::consts::TAU).sin()
        };
        walk += rng.normal() * s.walk_ppm_per_sqrt_s * (1.0 / s.fps).sqrt();
        device_ns += period_ns * (1.0 + (s.rate_ppm + s.thermal_ppm * thermal + walk) * 1e-6);
        let hops = s.hops.max(1);
        let jitter: f64 = (0..hops).map(|_| rng.exponential(s.jitter_ns / f64::from(hops))).sum();
        let mut arrival = truth + s.base_ns + jitter;
        if rng.uniform() < s.stall_share {
            stalled_until = truth + 20e6 + 180e6 * rng.uniform();
        }
        arrival = arrival.max(stalled_until).max(last_arrival);
        last_arrival = arrival;
        out.push(Sample { raw, unwrapped: ticks, sequence: i, arrival_ns: arrival as i64, truth_ns: truth });
    }
    out
}
