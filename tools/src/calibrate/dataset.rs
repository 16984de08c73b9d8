//! Sightings of a board from a recorded dataset: moments at which the board stands still.

use super::{Looked, MIRROR_TRIES, Sightings, ViewedCamera, grey, is_mirrored, mirrored, seen};
use crate::image_file;
use anyhow::{Result, bail};
use depthrig_bus::{Distortion, StreamId};
use depthrig_calibrate::board::Board;
use depthrig_calibrate::detect::{Detector, detector};
use depthrig_calibrate::file::{Conditions, Provenance, lens_position};
use depthrig_calibrate::intrinsics::ImageSize;
use depthrig_calibrate::rig::{RigView, Seen};
use depthrig_recorder::{Dataset, DatasetSet, PixelMode, Session, SetRange, StreamRecord};
use std::path::Path;

/// Table of a session whose every set is a view: `depthrig calibrate capture` took them.
pub const VIEWS_TABLE: &str = "calibration_views";
/// Streams that are looked at, best first.
pub const STREAMS: [&str; 5] = ["color", "left", "infrared", "infrared_left", "ir"];
/// A board stands still while no corner moves further than this from set to set, pixels.
const STILL_PX: f64 = 0.3;
/// Sets in a row without motion.
const STILL_SETS: usize = 3;
/// A view is new when corners moved further than this since the last one, of the image's width.
const NEW_VIEW: f64 = 0.03;

/// Settings of [`read`].
#[derive(Debug, Clone, Default)]
pub struct DatasetOptions {
    /// Streams to look at; of a camera that is not named the usual one.
    pub streams: Vec<StreamId>,
    /// Take sets in which the board moves, too.
    pub moving: bool,
}

/// Reads a dataset and finds the board in one stream of each camera. `progress` as for images.
///
/// # Errors
/// When the dataset cannot be read or has no stream to look at.
pub fn read(
    path: &Path,
    board: &Board,
    options: &DatasetOptions,
    mut progress: impl FnMut(u64, u64) -> bool,
) -> Result<Option<Sightings>> {
    let dataset = Dataset::open(path)?;
    let streams = chosen(&dataset, path, options)?;
    let detector = detector(board)?;
    let total = dataset.session().outcome.as_ref().map_or(0, |o| o.sets_recorded);
    let mut views = Sightings::default();
    for stream in &streams {
        views.cameras.push(viewed(&dataset.session().streams[*stream]));
    }
    let width = views.cameras.iter().map(|c| c.size.width).max().unwrap_or(1);
    let mut still = Still::default();
    let every = options.moving || dataset.session().extra.contains_key(VIEWS_TABLE);
    let mut mirrors = vec![Mirror::default(); streams.len()];
    let mut temperatures = vec![Vec::new(); streams.len()];
    for (done, set) in dataset.sets_with(SetRange::ALL, PixelMode::Stored).enumerate() {
        if !progress((done as u64).min(total), total.max(done as u64)) {
            return Ok(None);
        }
        let set = set?;
        let seen = look(detector.as_ref(), board, &streams, &set, &mut views, &mut mirrors)?;
        for (of_camera, stream) in temperatures.iter_mut().zip(&streams) {
            let frames = set.frames.iter().filter(|f| f.stream == *stream);
            of_camera.extend(frames.map(|f| f.header.temperature_c).filter(|t| t.is_finite()));
        }
        let is_new = still.is_new(&seen, width);
        if !seen.is_empty() && (every || is_new) {
            views.views.push(RigView { name: set.id.to_string(), seen });
        }
    }
    for (camera, mirror) in views.cameras.iter().zip(&mirrors) {
        if mirror.is_seen && !mirror.is_board_seen {
            return Err(mirrored(&camera.name));
        }
    }
    for (camera, temperatures) in views.cameras.iter().zip(&temperatures) {
        let conditions = conditions(dataset.session(), &camera.name, temperatures);
        views.conditions.insert(camera.name.clone(), conditions);
    }
    Ok(Some(views))
}

/// State of a camera as a recording has it.
fn conditions(session: &Session, camera: &str, temperatures: &[f32]) -> Conditions {
    let sum: f64 = temperatures.iter().copied().map(f64::from).sum();
    Conditions {
        firmware: session.firmware.get(camera).cloned().unwrap_or_default(),
        temperature_c: (!temperatures.is_empty()).then(|| sum / temperatures.len() as f64),
        lens_position: lens_position(&session.rig_config, camera),
    }
}

/// Whether a camera sees the board in a mirror alone.
#[derive(Debug, Clone, Copy, Default)]
struct Mirror {
    is_board_seen: bool,
    is_seen: bool,
    tries: usize,
}

/// The camera of a recorded stream.
pub(super) fn viewed(record: &StreamRecord) -> ViewedCamera {
    let calibrated = record.intrinsics.distortion() != Distortion::Unknown;
    ViewedCamera {
        name: record.id.camera.to_string(),
        size: ImageSize { width: record.width, height: record.height },
        factory: calibrated.then_some(record.intrinsics),
        provenance: Provenance { stream: record.id.stream.to_string(), serial: record.serial.clone() },
    }
}

/// Indices of the streams to look at: one for each camera, sorted by its name.
///
/// # Errors
/// When a stream that was named is not there, or no camera has one to look at.
pub fn chosen(dataset: &Dataset, path: &Path, options: &DatasetOptions) -> Result<Vec<usize>> {
    let records = &dataset.session().streams;
    let all = || records.iter().map(|r| r.id.to_string()).collect::<Vec<_>>().join(", ");
    if let Some(id) = options.streams.iter().find(|id| records.iter().all(|r| r.id != **id)) {
        bail!("{}: has no stream {id}; it has {}", path.display(), all());
    }
    let mut cameras: Vec<_> = records.iter().map(|r| r.id.camera.clone()).collect();
    cameras.sort();
    cameras.dedup();
    let mut streams = Vec::new();
    for camera in cameras {
        let named = options.streams.iter().find(|id| id.camera == camera);
        let position = |stream: &str| {
            records.iter().position(|r| r.id.camera == camera && r.id.stream.as_str() == stream)
        };
        streams.extend(match named {
            Some(id) => position(id.stream.as_str()),
            None => STREAMS.iter().find_map(|s| position(s)),
        });
    }
    if streams.is_empty() {
        bail!(
            "{}: has none of the streams {}; name one with --stream; it has {}",
            path.display(),
            STREAMS.join(", "),
            all()
        );
    }
    Ok(streams)
}

fn look(
    detector: &dyn Detector,
    board: &Board,
    streams: &[usize],
    set: &DatasetSet,
    views: &mut Sightings,
    mirrors: &mut [Mirror],
) -> Result<Vec<Seen>> {
    let mut all = Vec::new();
    for (camera, stream) in streams.iter().enumerate() {
        let Some(frame) = set.frames.iter().find(|f| f.stream == *stream) else { continue };
        let image = image_file::to_rgb(&frame.header, &frame.decoded()?)?;
        views.images += 1;
        let size = views.cameras[camera].size;
        let grey = grey(&image);
        let Looked { seen, refused } = seen(detector, board, camera, size, &grey)?;
        let mirror = &mut mirrors[camera];
        mirror.is_board_seen |= seen.is_some() || refused.is_some();
        if !mirror.is_board_seen && mirror.tries < MIRROR_TRIES {
            mirror.tries += 1;
            mirror.is_seen |= is_mirrored(detector, board, size, &grey)?;
        }
        if let Some(why) = refused {
            views.refused.push(format!("set {}, {}: {why}", set.id, views.cameras[camera].name));
        }
        all.extend(seen);
    }
    Ok(all)
}

/// Follows the board from set to set.
#[derive(Default)]
struct Still {
    last: Vec<Seen>,
    taken: Vec<Seen>,
    unmoved: usize,
}

impl Still {
    /// Whether the board has stood still long enough, elsewhere than at the last view.
    fn is_new(&mut self, seen: &[Seen], width: u32) -> bool {
        let moved = motion(&self.last, seen);
        self.unmoved = if moved.is_some_and(|m| m <= STILL_PX) { self.unmoved + 1 } else { 1 };
        self.last = seen.to_vec();
        let elsewhere = motion(&self.taken, seen).is_none_or(|m| m > NEW_VIEW * f64::from(width));
        let is_new = self.unmoved >= STILL_SETS && elsewhere && !seen.is_empty();
        if is_new {
            self.taken = seen.to_vec();
        }
        is_new
    }
}

/// How far the corner that moved furthest moved, over all cameras; `None` where nothing can be compared.
fn motion(before: &[Seen], after: &[Seen]) -> Option<f64> {
    let distances = before.iter().flat_map(|b| {
        let now = after.iter().find(|a| a.camera == b.camera).map_or(&[][..], |a| &a.corners);
        b.corners.iter().filter_map(|corner| {
            let same = now.iter().find(|c| c.point == corner.point)?;
            Some((same.pixel - corner.pixel).length())
        })
    });
    distances.max_by(f64::total_cmp)
}
