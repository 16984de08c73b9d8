//! The parts of `depthrig calibrate`: views of a board from images and datasets, depth of a wall, and the HTML report.

pub mod arm;
pub mod baseline;
pub mod capture;
pub mod corrected;
pub mod dataset;
pub mod images;
pub mod input;
pub mod known;
pub mod page;
pub mod robot;
pub mod timed;
pub mod wall;

use anyhow::{Context as _, Result, bail};
use depthrig_bus::Intrinsics;
use depthrig_bus::files;
use depthrig_calib::Error;
use depthrig_calibrate::adjustment::Corner;
use depthrig_calibrate::board::{Board, Pattern};
use depthrig_calibrate::detect::{Detection, Detector, GrayImage};
use depthrig_calibrate::file::{CalibratedCamera, Calibration, Conditions, Provenance};
use depthrig_calibrate::intrinsics::ImageSize;
use depthrig_calibrate::rig::{RigView, Seen};
use image::RgbImage;
use std::collections::BTreeMap;
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
    /// State that cameras reported, by name, where anything is known.
    pub conditions: BTreeMap<String, Conditions>,
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

/// Images of a camera without a board that are looked at in a mirror, before it is said that none shows one.
pub const MIRROR_TRIES: usize = 5;

/// Whether an image shows the board mirrored. A chessboard looks the same in a mirror.
///
/// # Errors
/// As [`seen`].
pub fn is_mirrored(detector: &dyn Detector, board: &Board, size: ImageSize, grey: &[u8]) -> Result<bool> {
    if board.pattern == Pattern::Chessboard {
        return Ok(false);
    }
    let mut mirrored = grey.to_vec();
    mirrored.chunks_exact_mut(size.width as usize).for_each(<[u8]>::reverse);
    Ok(seen(detector, board, 0, size, &mirrored)?.seen.is_some())
}

/// The error for a camera whose images are mirrored.
pub fn mirrored(camera: &str) -> anyhow::Error {
    anyhow::anyhow!(
        "camera {camera}: its images are mirrored: the board is in them only when they are flipped; turn mirroring off in the camera or in the          program that took them, or flip them"
    )
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

/// Reads a calibration's text.
///
/// # Errors
/// When it cannot be read or is not text; the message names the file.
pub fn calibration_text(path: &Path) -> Result<String> {
    text(path, CALIBRATION_MAX_BYTES, "; `depthrig calibrate solve` writes one")
}

/// Reads a calibration.
///
/// # Errors
/// When it cannot be read or is wrong; the message names the file.
pub fn calibration(path: &Path) -> Result<Calibration> {
    let text = calibration_text(path)?;
    Calibration::from_toml(&text).map_err(|e: Error| anyhow::anyhow!("{}: {e}", path.display()))
}

/// Reads a camera of a calibration.
///
/// # Errors
/// As [`calibration`], and when it has no such camera.
pub fn camera(path: &Path, name: &str) -> Result<CalibratedCamera> {
    let calibration = calibration(path)?;
    let found = calibration.of_camera(name).next().cloned();
    found.with_context(|| {
        let all: Vec<&str> = calibration.cameras.iter().map(|c| c.name.as_str()).collect();
        format!("{}: has no camera {name}; it has {}", path.display(), all.join(", "))
    })
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
