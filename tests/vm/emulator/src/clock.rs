//! The clock of an emulated camera: microseconds in 32 bits, with a drift, a start and jumps.

use depthrig_bus::HostTime;

/// A device clock. Its schedule runs evenly; its *reading* may jump.
#[derive(Debug, Clone, Copy)]
pub struct DeviceClock {
    powered: HostTime,
    /// Device seconds per host second.
    rate: f64,
    /// Its reading at power-on plus all jumps since, microseconds.
    offset_us: i64,
}

impl DeviceClock {
    /// A clock that shows `start_us` at `powered` and gains `drift_ppm` microseconds in each second.
    pub fn new(powered: HostTime, start_us: u32, drift_ppm: f64) -> Self {
        Self { powered, rate: 1.0 + drift_ppm * 1e-6, offset_us: start_us.into() }
    }

    /// Nanoseconds of the device since power-on.
    pub fn running_ns(&self, host: HostTime) -> i64 {
        (host.since_ns(self.powered) as f64 * self.rate).round() as i64
    }

    /// The host time at which the device had run for `running_ns`.
    pub fn host(&self, running_ns: i64) -> HostTime {
        self.powered.plus_ns((running_ns as f64 / self.rate).round() as i64)
    }

    /// The clock's reading after `running_ns` of operation: microseconds, wrapping at 2^32.
    pub fn shown_us(&self, running_ns: i64) -> u32 {
        (running_ns.div_euclid(1000) + self.offset_us) as u32
    }

    /// Makes its reading jump by `us` microseconds.
    pub fn jump(&mut self, us: i64) {
        self.offset_us += us;
    }

    /// Makes it show 0 at `host`.
    pub fn zero(&mut self, host: HostTime) {
        self.offset_us = -self.running_ns(host).div_euclid(1000);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_drifts_wraps_and_jumps() {
        let t0 = HostTime::from_ns(5_000_000_000);
        let mut clock = DeviceClock::new(t0, u32::MAX - 999_999, 100.0);
        assert_eq!(clock.shown_us(clock.running_ns(t0)), u32::MAX - 999_999);
        let later = t0.plus_ns(1_000_000_000);
        assert_eq!(clock.running_ns(later), 1_000_100_000, "100 ppm fast");
        assert_eq!(clock.shown_us(clock.running_ns(later)), 100, "it wrapped after one second less 1 tick");
        assert_eq!(clock.host(clock.running_ns(later)).since_ns(later), 0);
        clock.jump(-50);
        assert_eq!(clock.shown_us(clock.running_ns(later)), 50);
        clock.zero(later);
        assert_eq!(clock.shown_us(clock.running_ns(later)), 0);
    }
}
