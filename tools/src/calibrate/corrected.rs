//! Datasets whose depth is read as a calibration corrects it.

use crate::exit::UsageError;
use crate::out;
use anyhow::Result;
use depthrig_calibrate::depth::Correction;
use depthrig_calibrate::file::Calibration;
use depthrig_recorder::{Dataset, PixelFilter};
use std::path::{Path, PathBuf};

/// Options of commands that give depth out.
#[derive(Debug, Clone, clap::Args)]
pub struct Corrected {
    /// Correct depth as the calibration says; the dataset stays as it is
    #[arg(long, requires = "calibration")]
    corrected: bool,
    /// Calibration with the corrections of `depthrig calibrate depth`
    #[arg(long, value_name = "FILE", requires = "corrected")]
    calibration: Option<PathBuf>,
}

impl Corrected {
    /// Whether depth is to be corrected.
    pub const fn is_asked(&self) -> bool {
        self.corrected
    }

    /// The dataset, read with corrected depth if that was asked for.
    ///
    /// # Errors
    /// As [`corrected`], and when the calibration cannot be read.
    pub fn of(&self, dataset: Dataset) -> Result<Dataset> {
        match &self.calibration {
            Some(path) if self.corrected => corrected(dataset, &super::calibration(path)?, path),
            _ => Ok(dataset),
        }
    }
}

/// The correction of a stream.
struct Entry {
    camera: String,
    stream: String,
    correction: Correction,
}

/// The dataset as it is read with corrected depth. Depth streams without a correction are named on stderr and stay as they are.
///
/// # Errors
/// A usage error when the calibration has none for any stream, or one of another device or size.
pub fn corrected(dataset: Dataset, calibration: &Calibration, path: &Path) -> Result<Dataset> {
    let shown = path.display();
    let mut entries = Vec::new();
    let mut without = Vec::new();
    for record in dataset.session().streams.iter().filter(|r| r.format.is_depth()) {
        let camera = record.id.camera.as_str();
        let stream = record.id.stream.as_str();
        let Some(found) = calibration.depth_of(camera, stream) else {
            without.push(record.id.to_string());
            continue;
        };
        found
            .check_fits(&record.serial, record.width, record.height)
            .map_err(|e| UsageError(format!("{shown}: {e}")))?;
        entries.push(Entry {
            camera: camera.to_owned(),
            stream: stream.to_owned(),
            correction: found.correction(),
        });
    }
    if entries.is_empty() {
        return Err(UsageError(format!(
            "{shown}: has no correction of a depth stream of {}; `depthrig calibrate depth` makes one",
            dataset.path().display()
        ))
        .into());
    }
    if !without.is_empty() {
        out::note(format_args!(
            "as recorded, because {shown} has no correction for it: {}",
            without.join(", ")
        ));
    }
    let names: Vec<String> =
        entries.iter().map(|e| format!("{}/{} {:?}", e.camera, e.stream, e.correction)).collect();
    let name = format!("depth corrected: {}", names.join("; "));
    Ok(dataset.filtered(PixelFilter::new(&name, move |header, pixels| {
        let entry = entries.iter().find(|e| e.camera == header.camera() && e.stream == header.stream());
        match (entry, header.pixel_format()) {
            (Some(entry), Some(format)) => entry
                .correction
                .apply_to_pixels(format, header.depth_unit_m, pixels)
                .map_err(|e| e.to_string()),
            _ => Ok(()),
        }
    })))
}
