//! The parts of `depthrig calibrate`: views of a board from images and datasets, and the HTML report.

pub mod dataset;
pub mod images;
pub mod input;
pub mod page;

use anyhow::{Context as _, Result, bail};
use depthrig_bus::Intrinsics;
use depthrig_bus::files;
use depthrig_calib::Error;
use depthrig_calibrate::adjustment::Corner;
use depthrig_calibrate::board::Board;
use depthrig_calibrate::detect::{Detection, Detector, GrayImage};
use depthrig_calibrate::file::{Calibration, Provenance};
use depthrig_calibrate::intrinsics::ImageSize;
use depthrig_calibrate::rig::{RigView, Seen};
use image::RgbImage;
use std::path::Path;

/// A description of a board is no longer than this, bytes.
const BOARD_MAX_BYTES: u64 = 64 << 10;

/// A camera of which views are read.
#[derive(Debug, Clone)]
pub struct ViewedCamera {
    /// Its name.
    pub name: String,
    /// Size of its images.
    pub size: ImageSize,
    /// Its intrinsics as delivered, if the images say.
    pub factory: Option<Intrinsics>,
    /// The stream and the serial number.
    pub provenance: Provenance,
}

/// Views of a board.
#[derive(Debug, Default)]
pub struct Sightings {
    /// The cameras, in the order of their names' first mention.
    pub cameras: Vec<ViewedCamera>,
    /// The views.
    pub views: Vec<RigView>,
    /// Images that were looked at.
    pub images: usize,
    /// Images without a board, and why a board was refused.
    pub refused: Vec<String>,
}

/// Reads a text file.
///
/// # Errors
/// When it cannot be read, is longer than `limit` bytes or is not text; the message names the file.
pub fn text(path: &Path, limit: u64, writer: &str) -> Result<String> {
    let bytes =
        files::read(path, limit).with_context(|| format!("{}: cannot be read{writer}", path.display()))?;
    String::from_utf8(bytes).with_context(|| format!("{}: is not text", path.display()))
}

/// Reads a board's description.
///
/// # Errors
/// When it cannot be read or is wrong; the message names the file.
pub fn board(path: &Path) -> Result<Board> {
    let text = text(path, BOARD_MAX_BYTES, "; `depthrig calibrate board` writes one")?;
    Board::from_toml(&text).map_err(|e: Error| anyhow::anyhow!("{}: {e}", path.display()))
}

/// The grey pixels of an image (Rec. 709 luma).
pub fn grey(image: &RgbImage) -> Vec<u8> {
    image.pixels().map(|p| crate::commands::stereo::luma(p.0.map(u32::from)) as u8).collect()
}

/// Finds a board, as corners in metres.
pub fn seen(
    detector: &dyn Detector,
    board: &Board,
    camera: usize,
    size: ImageSize,
    grey: &[u8],
) -> Result<Looked> {
    let image = GrayImage::new(size.width as usize, size.height as usize, grey)?;
    let Detection { corners, refused } = detector.detect(&image);
    Ok(Looked {
        seen: (!corners.is_empty()).then(|| Seen {
            camera,
            corners: corners.iter().map(|c| Corner { point: board.corner(c.id), pixel: c.pixel }).collect(),
        }),
        refused,
    })
}

/// Result of [`seen`].
pub struct Looked {
    /// The board.
    pub seen: Option<Seen>,
    /// Why a board was refused.
    pub refused: Option<String>,
}

/// A calibration is no longer than this, bytes.
const CALIBRATION_MAX_BYTES: u64 = 4 << 20;

/// Reads a calibration.
///
/// # Errors
/// When it cannot be read or is wrong; the message names the file.
pub fn calibration(path: &Path) -> Result<Calibration> {
    let text = text(path, CALIBRATION_MAX_BYTES, "; `depthrig calibrate solve` writes one")?;
    Calibration::from_toml(&text).map_err(|e: Error| anyhow::anyhow!("{}: {e}", path.display()))
}

/// Refuses views of nothing.
///
/// # Errors
/// When no image shows the board.
pub fn check(views: &Sightings) -> Result<()> {
    if views.views.is_empty() {
        let why = views.refused.first().map(|r| format!("; {r}")).unwrap_or_default();
        bail!("none of {} images shows the board as it is described{why}", views.images);
    }
    Ok(())
}
