//! Input and output types of the clock map.

use depthrig_bus::{FrameFlags, HostTime};

/// Properties of a device that the map needs.
///
/// Values out of range are moved into it by [`ClockMap::new`](super::ClockMap::new); [`ClockMap::config`] shows the
/// result.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClockConfig {
    /// Bits of the device's counter, 8 to 64.
    pub counter_bits: u32,
    /// Nanoseconds per tick; above 0.
    pub tick_ns: f64,
    /// Nominal time between frames, nanoseconds; at least 1.
    pub period_ns: u64,
    /// How much past the map rests on, nanoseconds of device time; 10 s to 120 s.
    pub window_ns: i64,
    /// Least time from the device's stamp to the arrival, when it is known from elsewhere, nanoseconds; 0 when it
    /// is not.
    pub latency_ns: i64,
    /// Half-width of the interval around `latency_ns` that holds the truth, nanoseconds.
    pub latency_bound_ns: i64,
    /// How many frames commonly come together, of which the newest alone is observed; 1 to 4096. What is late, and how
    /// far the line may move from one to the next, is reckoned by so many periods.
    pub bunch: u32,
}

impl ClockConfig {
    /// A window of 60 s, frames that come one by one, and an unknown latency.
    pub fn new(counter_bits: u32, tick_ns: f64, period_ns: u64) -> Self {
        Self {
            counter_bits,
            tick_ns,
            period_ns,
            window_ns: 60_000_000_000,
            latency_ns: 0,
            latency_bound_ns: 0,
            bunch: 1,
        }
    }

    /// The same with each value in its range.
    pub(super) fn in_range(mut self) -> Self {
        self.counter_bits = self.counter_bits.clamp(8, 64);
        self.tick_ns = if self.tick_ns.is_finite() { self.tick_ns.clamp(1e-3, 1e9) } else { 1.0 };
        self.period_ns = self.period_ns.clamp(1, 3_600_000_000_000);
        self.window_ns = self.window_ns.clamp(10_000_000_000, 120_000_000_000);
        self.latency_ns = self.latency_ns.clamp(0, 10_000_000_000);
        self.latency_bound_ns = self.latency_bound_ns.clamp(0, 10_000_000_000);
        self.bunch = self.bunch.clamp(1, 4096);
        self
    }
}

/// A stream's constant latency as a calibration of the mount found it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CalibratedLatency {
    /// Nanoseconds; 0 of the camera that the others are compared with.
    pub ns: i64,
    /// Half-width of the interval that holds the truth, nanoseconds.
    pub bound_ns: i64,
}

/// One frame's time on the host's clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Mapped {
    /// Device ticks since the counter's zero, never wrapping; comparable within an epoch.
    pub device_time: u64,
    /// The device's stamp on the host's clock.
    pub capture_time: HostTime,
    /// Half-width of the interval around `capture_time` that holds the truth for 99 % of frames, nanoseconds; the
    /// constant least latency is left out until it is known.
    pub uncertainty_ns: u64,
    /// Number of the clock map in force.
    pub epoch: u32,
    /// Any of `TIME_UNCERTAIN`, `CLOCK_WARMUP`, `EPOCH_CHANGED`, `LATE`, `LATENCY_MEASURED`, `LATENCY_CALIBRATED`.
    pub flags: FrameFlags,
    /// Constant latency that `capture_time` is free of, nanoseconds; 0 when none is known.
    pub latency_ns: u64,
}

/// How the map of one device is doing.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClockQuality {
    /// Host rate over device rate, minus one, in parts per million: above 0 when the device's clock is slow.
    pub rate_ppm: f64,
    /// Vertices of the hull.
    pub hull_points: usize,
    /// Device time that the hull rests on, nanoseconds.
    pub span_ns: i64,
    /// Median lateness of frames against the fastest, nanoseconds.
    pub residual_p50_ns: i64,
    /// Lateness that 99 % of frames stay below, nanoseconds.
    pub residual_p99_ns: i64,
    /// The uncertainty that frames claim now, nanoseconds.
    pub uncertainty_ns: u64,
    /// Epochs so far; 0 before the first frame.
    pub epochs: u32,
    /// Frames that arrived more than two periods after their capture.
    pub late: u64,
    /// Frames flagged `TIME_UNCERTAIN`.
    pub uncertain: u64,
    /// Whether capture times are free of the constant latency.
    pub latency_known: bool,
    /// The constant latency that is subtracted, nanoseconds.
    pub latency_ns: i64,
}
