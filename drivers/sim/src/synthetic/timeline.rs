//! When a simulated device exposes its frames, what its clock shows then, and when the bytes arrive.
//!
//! Everything here follows from the configuration and the moment of the boot, so that a test knows the
//! truth of every frame.

use super::config::{ClockSim, SyntheticConfig};
use super::noise::{Rolls, text_seed};
use core::f64::consts::TAU;
use depthrig_bus::HostTime;

/// Counter of a rebooted device at its start, microseconds: its firmware took a moment.
const REBOOT_TICKS: u64 = 250_000;

/// One life of a device, from power to the next loss of it or reset.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Boot {
    /// 0, 1, 2, …
    pub(crate) number: u32,
    /// When it began.
    pub(crate) at: HostTime,
    /// How far the clock was set back since, microseconds.
    pub(crate) set_back_us: u64,
}

/// The clock of a device.
#[derive(Debug, Clone)]
pub(crate) struct Timeline {
    sim: ClockSim,
    seed: u64,
    phase: f64,
}

impl Timeline {
    pub(crate) fn new(config: &SyntheticConfig) -> Self {
        let seed = text_seed(config.seed, &config.serial_or_default());
        Self { sim: config.clock.clone(), seed, phase: config.phase }
    }

    /// The random numbers of frame `k` of `stream`.
    fn rolls(&self, boot: Boot, stream: usize, k: u64) -> Rolls {
        Rolls::new(
            self.seed ^ u64::from(boot.number).rotate_left(32),
            stream as u32,
            k as u32,
            (k >> 32) as u32,
        )
    }

    /// Mid-exposure of frame `k` at `rate_hz`: the device counts the period on its own clock.
    pub(crate) fn capture(&self, boot: Boot, rate_hz: f64, k: u64) -> HostTime {
        let period_ns = 1e9 / rate_hz / (1.0 + self.sim.drift_ppm * 1e-6);
        boot.at.plus_ns(((k as f64 + self.phase) * period_ns).round() as i64)
    }

    /// The first frame that is not exposed before `t`.
    pub(crate) fn first_at_or_after(&self, boot: Boot, rate_hz: f64, t: HostTime) -> u64 {
        let period_ns = 1e9 / rate_hz / (1.0 + self.sim.drift_ppm * 1e-6);
        let mut k = (t.since_ns(boot.at) as f64 / period_ns - self.phase).ceil().max(0.0) as u64;
        while k > 0 && self.capture(boot, rate_hz, k - 1) >= t {
            k -= 1;
        }
        while self.capture(boot, rate_hz, k) < t {
            k += 1;
        }
        k
    }

    /// Value of the device's counter for frame `k` that was exposed at `t`.
    pub(crate) fn ticks(&self, boot: Boot, stream: usize, k: u64, t: HostTime) -> u64 {
        let since_us = t.since_ns(boot.at) as f64 / 1000.0;
        let size = self.sim.thermal_ppm * 1e-6;
        let period_us = self.sim.thermal_period_s * 1e6;
        // The integral of a rate that is off by drift + thermal · sin(2π t / period).
        let wander = size * period_us / TAU * (1.0 - (TAU * since_us / period_us).cos());
        let jitter = f64::from(self.rolls(boot, stream, k).normal(0)) * self.sim.stamp_jitter_us;
        let shown_us = since_us * (1.0 + self.sim.drift_ppm * 1e-6) + wander + jitter;
        let start = if boot.number == 0 { self.sim.start_ticks } else { REBOOT_TICKS };
        let ticks = start.wrapping_add_signed(shown_us.round() as i64).wrapping_sub(boot.set_back_us);
        if self.sim.counter_bits < 64 { ticks & ((1 << self.sim.counter_bits) - 1) } else { ticks }
    }

    /// When the last byte of frame `k` arrives if nothing halts the transport, and for how long the transport
    /// halts at this frame, nanoseconds.
    pub(crate) fn arrival(
        &self,
        boot: Boot,
        stream: usize,
        k: u64,
        t: HostTime,
        exposure_ns: u64,
    ) -> (HostTime, i64) {
        let rolls = self.rolls(boot, stream, k);
        let extra_ms = -self.sim.latency_jitter_ms * (1.0 - rolls.unit_f64(1)).ln();
        let latency_ns = ((self.sim.latency_ms + extra_ms) * 1e6) as i64;
        let (least, most) = self.sim.stall_ms;
        let halts = rolls.unit_f64(2) < self.sim.stall_probability;
        let halt_ms = if halts { least + (most - least) * rolls.unit_f64(3) } else { 0.0 };
        (t.plus_ns(exposure_ns as i64 / 2 + latency_ns), (halt_ms * 1e6) as i64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn boot() -> Boot {
        Boot { number: 0, at: HostTime::from_ns(5_000_000_000), set_back_us: 0 }
    }

    fn timeline(clock: ClockSim) -> Timeline {
        Timeline::new(&SyntheticConfig { clock, phase: 0.5, ..SyntheticConfig::default() })
    }

    #[test]
    fn frames_lie_on_the_device_grid() {
        let t = timeline(ClockSim {
            drift_ppm: 100.0,
            stamp_jitter_us: 0.0,
            counter_bits: 64,
            ..ClockSim::default()
        });
        for k in [0, 1, 1_000_000] {
            let at = t.capture(boot(), 30.0, k);
            assert_eq!(t.first_at_or_after(boot(), 30.0, at), k);
            assert_eq!(t.first_at_or_after(boot(), 30.0, at.plus_ns(1)), k + 1);
            // The device itself sees an exact period of 33 333.3 µs.
            let wanted = 1_000_000.0 + (k as f64 + 0.5) * 1e6 / 30.0;
            assert!((t.ticks(boot(), 0, k, at) as f64 - wanted).abs() <= 1.0);
        }
    }

    #[test]
    fn the_counter_wraps_and_can_be_set_back() {
        let t =
            timeline(ClockSim { start_ticks: (1 << 32) - 1000, stamp_jitter_us: 0.0, ..ClockSim::default() });
        let at = boot().at.plus_ns(1_500_000);
        assert_eq!(t.ticks(boot(), 0, 0, at), 500);
        assert_eq!(t.ticks(Boot { set_back_us: 600, ..boot() }, 0, 0, at), (1 << 32) - 100);
        assert_eq!(t.ticks(Boot { number: 1, ..boot() }, 0, 0, at), REBOOT_TICKS + 1500);
    }

    #[test]
    fn latency_has_a_floor_and_the_configured_mean() {
        let t = timeline(ClockSim::default());
        let waits: Vec<i64> = (0..20_000)
            .map(|k| {
                let at = t.capture(boot(), 30.0, k);
                t.arrival(boot(), 0, k, at, 8_000_000).0.since_ns(at)
            })
            .collect();
        let mean = waits.iter().sum::<i64>() / waits.len() as i64;
        assert!(*waits.iter().min().unwrap() >= 7_000_000 && (mean - 7_400_000).abs() < 20_000, "{mean}");
    }
}
