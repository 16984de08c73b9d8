//! Sightings of a moving board from a recorded dataset, with their times.

use super::dataset::{self, DatasetOptions};
use super::{ViewedCamera, grey, seen};
use crate::image_file;
use anyhow::Result;
use depthrig_bus::{FrameFlags, FrameHeader};
use depthrig_calibrate::board::Board;
use depthrig_calibrate::detect::detector;
use depthrig_calibrate::latency::{Subtracted, TimedFrame};
use depthrig_recorder::{Dataset, PixelMode, SetRange};
use std::path::Path;

/// Frames whose time is not known well yet, or not at all.
const UNTIMED: FrameFlags =
    FrameFlags::TIME_UNCERTAIN.with(FrameFlags::CLOCK_WARMUP).with(FrameFlags::METADATA_LOST);
/// Frames whose capture time may be off by more are not used, nanoseconds: the clock map of a camera that was just opened is not settled.
const UNSETTLED_NS: u64 = 1_000_000;
/// A calibrated latency may add this much at the most, nanoseconds: three of the largest standard deviation that is accepted.
const LATENCY_BOUND_NS: u64 = 1_000_000;
/// A frame's uncertainty holds the truth for 99 % of frames: so many standard deviations of a normal distribution.
pub const CLAIMED_SIGMAS: f64 = 2.576;

/// A camera whose frames were read.
#[derive(Debug, Clone)]
pub struct TimedCamera {
    /// The camera.
    pub viewed: ViewedCamera,
    /// Latency that its capture times are free of: the median over its frames.
    pub subtracted: Subtracted,
    /// Frames that were looked at.
    pub images: usize,
    /// Frames that were not, because their clock map was not settled.
    pub untimed: usize,
}

/// A dataset opened for the sightings of a moving board.
#[derive(Debug)]
pub struct TimedDataset {
    dataset: Dataset,
    /// Index of each camera's stream in the dataset.
    streams: Vec<usize>,
    /// The cameras.
    pub cameras: Vec<TimedCamera>,
}

/// Opens a dataset of which one stream of each camera will be looked at.
///
/// # Errors
/// When the dataset cannot be read or has no stream to look at.
pub fn open(path: &Path, options: &DatasetOptions) -> Result<TimedDataset> {
    let dataset = Dataset::open(path)?;
    let streams = dataset::chosen(&dataset, path, options)?;
    let camera = |stream: &usize| TimedCamera {
        viewed: dataset::viewed(&dataset.session().streams[*stream]),
        subtracted: Subtracted::default(),
        images: 0,
        untimed: 0,
    };
    let cameras = streams.iter().map(camera).collect();
    Ok(TimedDataset { dataset, streams, cameras })
}

impl TimedDataset {
    /// Its name.
    pub fn name(&self) -> &str {
        &self.dataset.session().name
    }

    /// Finds the board; returns the frames that show it, and completes `cameras`. `progress` gets frame sets done and in all, and ends the
    /// reading with `false`; then it returns `None`.
    ///
    /// # Errors
    /// When the dataset cannot be read.
    pub fn read(
        &mut self,
        board: &Board,
        mut progress: impl FnMut(u64, u64) -> bool,
    ) -> Result<Option<Vec<TimedFrame>>> {
        let Self { dataset, streams, cameras } = self;
        let detector = detector(board)?;
        let total = dataset.session().outcome.as_ref().map_or(0, |o| o.sets_recorded);
        let mut frames = Vec::new();
        let mut latencies: Vec<Vec<u64>> = vec![Vec::new(); streams.len()];
        for (done, set) in dataset.sets_with(SetRange::ALL, PixelMode::Stored).enumerate() {
            if !progress((done as u64).min(total), total.max(done as u64)) {
                return Ok(None);
            }
            let set = set?;
            for (index, stream) in streams.iter().enumerate() {
                let Some(frame) = set.frames.iter().find(|f| f.stream == *stream) else { continue };
                let camera = &mut cameras[index];
                if !is_settled(&frame.header) {
                    camera.untimed += 1;
                    continue;
                }
                camera.images += 1;
                camera.subtracted.is_measured |= frame.header.has(FrameFlags::LATENCY_MEASURED);
                latencies[index].push(frame.header.latency_ns);
                let image = image_file::to_rgb(&frame.header, &frame.decoded()?)?;
                let looked = seen(detector.as_ref(), board, index, camera.viewed.size, &grey(&image))?;
                frames.extend(looked.seen.map(|seen| TimedFrame {
                    camera: index,
                    time_s: frame.header.capture_time_ns as f64 * 1e-9,
                    uncertainty_s: uncertainty_s(&frame.header),
                    corners: seen.corners,
                }));
            }
        }
        for (camera, of_camera) in cameras.iter_mut().zip(&mut latencies) {
            let middle = of_camera.len() / 2;
            if !of_camera.is_empty() {
                let median = *of_camera.select_nth_unstable(middle).1;
                camera.subtracted.latency_s = median as f64 * 1e-9;
            }
        }
        Ok(Some(frames))
    }
}

/// Whether the capture time is known well enough.
fn is_settled(header: &FrameHeader) -> bool {
    let of_latency_ns = if header.has(FrameFlags::LATENCY_CALIBRATED) { LATENCY_BOUND_NS } else { 0 };
    header.flags & UNTIMED.0 == 0 && header.capture_uncertainty_ns <= UNSETTLED_NS + of_latency_ns
}

/// Standard deviation of a capture time, seconds.
fn uncertainty_s(header: &FrameHeader) -> f64 {
    header.capture_uncertainty_ns as f64 * 1e-9 / CLAIMED_SIGMAS
}
