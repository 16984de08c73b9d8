//! Places of a board on a wall from a recorded dataset, with the depth frames of each.

use super::dataset::{DatasetOptions, chosen};
use super::{Looked, grey, seen};
use crate::image_file;
use anyhow::{Result, bail};
use depthrig_bus::{FrameHeader, Intrinsics, PixelFormat, Pose, StreamId};
use depthrig_calib::PoseExt;
use depthrig_calibrate::adjustment::Corner;
use depthrig_calibrate::board::Board;
use depthrig_calibrate::detect::{Detector, detector};
use depthrig_calibrate::intrinsics::ImageSize;
use depthrig_recorder::{Dataset, DatasetFrame, DatasetSet, PixelMode, SetRange};
use glam::DVec2;
use std::path::Path;

/// A board rests while its corners are this near to where they were first, root mean square, pixels.
const STILL_PX: f64 = 0.3;
/// Sets of a place at least.
const MIN_SETS: usize = 3;
/// Depth frames of a place that are kept: more do not average what stays from frame to frame.
const FRAMES: usize = 5;
/// Corners of a view at least: a few squares of something else may look like the board.
const MIN_CORNERS: usize = 12;

/// A camera that sees the board and the wall's depth.
#[derive(Debug)]
pub struct WallCamera {
    /// Its name.
    pub name: String,
    /// Index of the stream that shows the board.
    pub look: usize,
    /// Indices of its depth streams.
    pub depth: Vec<usize>,
    /// Where the board rested.
    pub places: Vec<Place>,
    /// Images that show the board.
    pub seen: usize,
    current: Option<Place>,
}

/// A place at which the board rests.
#[derive(Debug)]
pub struct Place {
    /// Its first set.
    pub set: u64,
    /// Corners, each the mean of all sets.
    pub corners: Vec<Corner>,
    /// Header of the image that shows the board.
    pub look: FrameHeader,
    /// Depth of each depth stream of the camera.
    pub depth: Vec<Option<PlaceDepth>>,
    sets: usize,
    sums: Vec<DVec2>,
    counts: Vec<f64>,
}

/// Depth of one stream at a place.
#[derive(Debug)]
pub struct PlaceDepth {
    /// Intrinsics of depth.
    pub intrinsics: Intrinsics,
    /// From the image that shows the board to depth.
    pub depth_from_look: Pose,
    /// Metres, frame by frame.
    pub frames: Vec<Vec<f32>>,
}

/// Result of [`read`].
#[derive(Debug)]
pub struct Wall {
    /// The cameras with depth.
    pub cameras: Vec<WallCamera>,
    /// Images that were looked at.
    pub images: usize,
}

/// Reads a dataset. `streams` names streams to look at and depth streams, of cameras that are not named all; `progress` is
/// called with sets done and all and returns whether to go on.
///
/// # Errors
/// When the dataset cannot be read, or has no camera with depth and an image.
pub fn read(
    dataset: &Dataset,
    path: &Path,
    board: &Board,
    streams: &[StreamId],
    mut progress: impl FnMut(u64, u64) -> bool,
) -> Result<Option<Wall>> {
    let mut cameras = cameras(dataset, path, streams)?;
    let detector = detector(board)?;
    let total = dataset.session().outcome.as_ref().map_or(0, |o| o.sets_recorded);
    let mut images = 0;
    for (done, set) in dataset.sets_with(SetRange::ALL, PixelMode::Stored).enumerate() {
        if !progress((done as u64).min(total), total.max(done as u64)) {
            return Ok(None);
        }
        let set = set?;
        for camera in &mut cameras {
            images += usize::from(camera.look_at(&set, detector.as_ref(), board)?);
        }
    }
    for camera in &mut cameras {
        camera.leave();
    }
    Ok(Some(Wall { cameras, images }))
}

fn cameras(dataset: &Dataset, path: &Path, named: &[StreamId]) -> Result<Vec<WallCamera>> {
    let records = &dataset.session().streams;
    let is_depth = |id: &StreamId| records.iter().any(|r| r.id == *id && r.format.is_depth());
    let options = DatasetOptions {
        streams: named.iter().filter(|id| !is_depth(id)).cloned().collect(),
        ..DatasetOptions::default()
    };
    let mut cameras = Vec::new();
    for look in chosen(dataset, path, &options)? {
        let id = &records[look].id;
        let asked = |depth: &StreamId| {
            if named.iter().any(|n| n.camera == id.camera && is_depth(n)) {
                return named.contains(depth);
            }
            // Computed depth is as wrong as what it is computed from.
            ![depthrig_cdm::stage::REFINED, depthrig_cdm::stage::ALIGNED].contains(&depth.stream.as_str())
        };
        let depth: Vec<usize> = (0..records.len())
            .filter(|i| {
                records[*i].id.camera == id.camera && records[*i].format.is_depth() && asked(&records[*i].id)
            })
            .collect();
        if !depth.is_empty() {
            cameras.push(WallCamera {
                name: id.camera.to_string(),
                look,
                depth,
                places: Vec::new(),
                seen: 0,
                current: None,
            });
        }
    }
    if cameras.is_empty() {
        bail!("{}: has no camera with depth and an image that can show the board", path.display());
    }
    Ok(cameras)
}

impl WallCamera {
    /// Takes in one set; whether it has an image.
    fn look_at(&mut self, set: &DatasetSet, detector: &dyn Detector, board: &Board) -> Result<bool> {
        let Some(frame) = set.frames.iter().find(|f| f.stream == self.look) else { return Ok(false) };
        let image = image_file::to_rgb(&frame.header, &frame.decoded()?)?;
        let size = ImageSize { width: frame.header.width, height: frame.header.height };
        let Looked { seen, .. } = seen(detector, board, 0, size, &grey(&image))?;
        let Some(seen) = seen.filter(|s| s.corners.len() >= MIN_CORNERS) else {
            self.leave();
            return Ok(true);
        };
        self.seen += 1;
        if self.current.as_ref().is_none_or(|p| !p.rests(&seen.corners)) {
            self.leave();
            self.current = Some(Place::new(set.id, &frame.header, self.depth.len()));
        }
        if let Some(place) = &mut self.current {
            place.add(&seen.corners);
            for (depth, stream) in place.depth.iter_mut().zip(&self.depth) {
                let Some(of_set) = set.frames.iter().find(|f| f.stream == *stream) else { continue };
                add_depth(depth, of_set, &place.look)?;
            }
        }
        Ok(true)
    }

    /// The board has left its place.
    fn leave(&mut self) {
        if let Some(place) = self.current.take().filter(|p| p.sets >= MIN_SETS) {
            self.places.push(place.mean());
        }
    }
}

fn add_depth(depth: &mut Option<PlaceDepth>, frame: &DatasetFrame, look: &FrameHeader) -> Result<()> {
    let of = depth.get_or_insert_with(|| PlaceDepth {
        intrinsics: frame.header.intrinsics,
        depth_from_look: frame.header.pose.inverse().compose(&look.pose),
        frames: Vec::new(),
    });
    if of.frames.len() < FRAMES && frame.header.pixel_format().is_some_and(PixelFormat::is_depth) {
        of.frames.extend(image_file::depth_m(&frame.header, &frame.decoded()?)?);
    }
    Ok(())
}

impl Place {
    fn new(set: u64, look: &FrameHeader, depth: usize) -> Self {
        Self {
            set,
            corners: Vec::new(),
            look: *look,
            depth: (0..depth).map(|_| None).collect(),
            sets: 0,
            sums: Vec::new(),
            counts: Vec::new(),
        }
    }

    /// Whether the corners are where they were first.
    fn rests(&self, corners: &[Corner]) -> bool {
        let squares: Vec<f64> = corners
            .iter()
            .filter_map(|c| {
                let first = self.corners.iter().find(|f| f.point == c.point)?;
                Some((first.pixel - c.pixel).length_squared())
            })
            .collect();
        let mean = squares.iter().sum::<f64>() / squares.len().max(1) as f64;
        squares.len() >= MIN_CORNERS && mean.sqrt() <= STILL_PX
    }

    fn add(&mut self, corners: &[Corner]) {
        self.sets += 1;
        for corner in corners {
            let known = self.corners.iter().position(|c| c.point == corner.point);
            let at = known.unwrap_or_else(|| {
                self.corners.push(*corner);
                self.sums.push(DVec2::ZERO);
                self.counts.push(0.0);
                self.corners.len() - 1
            });
            self.sums[at] += corner.pixel;
            self.counts[at] += 1.0;
        }
    }

    /// With each corner at its mean, and without those that were seen in less than half of the sets.
    fn mean(mut self) -> Self {
        let half = self.sets as f64 / 2.0;
        let means = self.corners.iter().zip(self.sums.iter().zip(&self.counts));
        self.corners = means
            .filter(|(_, (_, count))| **count >= half)
            .map(|(corner, (sum, count))| Corner { point: corner.point, pixel: *sum / *count })
            .collect();
        self
    }
}
