//! A camera's latency in `calibration.toml`, with where it comes from.

use depthrig_calib::{Error, ErrorKind, Result};
use serde::{Deserialize, Serialize};

/// Largest latency that is believed, milliseconds.
const MAX_MS: f64 = 10_000.0;
/// Standard deviations that a frame's stated uncertainty includes: 99.7 % of a normal distribution.
const BOUND_SIGMAS: f64 = 3.0;

/// The constant part of the time from a frame's mid-exposure to its arrival, compared with the fastest camera.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FileLatency {
    /// Milliseconds that are subtracted from the capture times; 0 of the fastest camera.
    pub latency_ms: f64,
    /// Standard deviation of `latency_ms` less that of the reference, milliseconds; 0 of the reference itself.
    pub sigma_ms: f64,
    /// The camera that this one was compared with.
    pub reference: String,
    /// When it was found, RFC 3339 in UTC.
    pub created: String,
    /// Name of the dataset that shows the board.
    pub dataset: String,
    /// The board, in words.
    pub board: String,
}

impl FileLatency {
    /// Nanoseconds.
    pub fn latency_ns(&self) -> i64 {
        (self.latency_ms * 1e6).round() as i64
    }

    /// Half-width of the interval around it that holds the truth, nanoseconds.
    pub fn bound_ns(&self) -> i64 {
        (BOUND_SIGMAS * self.sigma_ms * 1e6).round() as i64
    }

    /// In words, for the calibration of a dataset's stream.
    pub fn describe(&self) -> String {
        format!("latency {:.2} ms ± {:.2} of {}", self.latency_ms, self.sigma_ms, self.created)
    }

    /// Refuses values that cannot be a latency.
    pub(super) fn check(&self) -> Result<()> {
        let is_time = |ms: f64| (0.0..=MAX_MS).contains(&ms);
        if is_time(self.latency_ms) && is_time(self.sigma_ms) {
            return Ok(());
        }
        let why = format!(
            "latency_ms = {} with sigma_ms = {} is out of range 0..={MAX_MS}",
            self.latency_ms, self.sigma_ms
        );
        Err(Error::new(ErrorKind::BadInput, why))
    }
}
