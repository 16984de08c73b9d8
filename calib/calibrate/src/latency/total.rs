//! From what stamps are late by now to what must be subtracted from them in all.

use super::CameraLatency;

/// Latency that the clock map has subtracted from the stamps of a camera already.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Subtracted {
    /// Seconds.
    pub latency_s: f64,
    /// Whether the device was asked for its clock, so that its stamps are right whatever the other cameras' are.
    pub is_measured: bool,
}

/// All that must be subtracted from a camera's stamps.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Total {
    /// Index of the camera.
    pub camera: usize,
    /// Seconds, at least 0. Of a camera that is measured, what is subtracted now.
    pub latency_s: f64,
    /// As [`Subtracted::is_measured`].
    pub is_measured: bool,
    /// How much below zero the latency would have been, seconds: the camera is faster than those that are measured, which none can be.
    pub below_zero_s: f64,
}

/// Adds what was found to what was subtracted while recording. A waved board shows differences alone: where devices were asked for their clocks, these
/// fix the zero; else the fastest camera has none.
pub fn totals(found: &[CameraLatency], subtracted: &[Subtracted]) -> Vec<Total> {
    let all = |latency: &CameraLatency| latency.latency_s + subtracted[latency.camera].latency_s;
    let measured: Vec<f64> =
        found.iter().filter(|l| subtracted[l.camera].is_measured).map(|l| l.latency_s).collect();
    let zero_s = if measured.is_empty() {
        found.iter().map(all).fold(f64::INFINITY, f64::min)
    } else {
        measured.iter().sum::<f64>() / measured.len() as f64
    };
    found
        .iter()
        .map(|latency| {
            let before = subtracted[latency.camera];
            let wanted_s = all(latency) - zero_s;
            Total {
                camera: latency.camera,
                latency_s: if before.is_measured { before.latency_s } else { wanted_s.max(0.0) },
                is_measured: before.is_measured,
                below_zero_s: if before.is_measured { 0.0 } else { (-wanted_s).max(0.0) },
            }
        })
        .collect()
}
