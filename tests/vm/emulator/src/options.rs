//! The options of an emulated camera.

use core::time::Duration;

/// How fast the bus is that a camera is plugged into.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Speed {
    /// USB 3, 5 Gb/s.
    Super,
    /// USB 2, 480 Mb/s.
    High,
}

/// Options that differ between two cameras of one model.
#[derive(Debug, Clone)]
pub struct Options {
    /// The serial, in the model's own form: 12 digits for a D400, 8 hexadecimal digits for an L515, decimal for a ZED.
    /// Without one, the next in this process is generated.
    pub serial: Option<String>,
    /// How much its clock gains, in parts per million.
    pub drift_ppm: f64,
    /// Reading of its clock at power-on, in microseconds: near 2^32 for a wrap.
    pub start_ticks: u32,
    /// The largest delay of a frame on its way.
    pub jitter: Duration,
    /// The bus.
    pub speed: Speed,
    /// The virtual host controller that it hangs on, 0 to 7: cameras of one controller are those of one hub.
    pub hub: u32,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            serial: None,
            drift_ppm: 0.0,
            start_ticks: 1_000_000,
            jitter: Duration::from_micros(300),
            speed: Speed::Super,
            hub: 0,
        }
    }
}
