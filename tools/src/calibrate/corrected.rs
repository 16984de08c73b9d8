//! Datasets whose depth is read as a calibration corrects it.

use crate::exit::UsageError;
use crate::out;
use anyhow::{Context as _, Result};
use depthrig_calibrate::depth::Correction;
use depthrig_calibrate::file::Calibration;
use depthrig_recorder::{Dataset, PixelFilter};
use std::path::{Path, PathBuf};

/// Options of commands that give depth out.
#[derive(Debug, Clone, clap::Args)]
pub struct Corrected {
    /// Correct depth as the dataset's calibration says; the dataset stays as it is
    #[arg(long)]
    corrected: bool,
    /// Another calibration for --corrected
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
    /// As [`corrected`].
    pub fn of(&self, dataset: Dataset) -> Result<Dataset> {
        if self.corrected { corrected(dataset, self.calibration.as_deref()) } else { Ok(dataset) }
    }
}

/// A dataset's own calibration, and what to call it in messages.
fn own(dataset: &Dataset) -> Result<(Calibration, String)> {
    let text = &dataset.session().calibration;
    let path = dataset.path().display();
    if text.is_empty() {
        return Err(UsageError(format!(
            "{path}: has no calibration to correct depth by; name one with --calibration FILE, or attach it for good with `depthrig edit \
             --calibration FILE`"
        ))
        .into());
    }
    let shown = format!("the calibration of {path}");
    let calibration = Calibration::from_toml(text).with_context(|| shown.clone())?;
    Ok((calibration, shown))
}

/// The correction of a stream.
struct Entry {
    camera: String,
    stream: String,
    correction: Correction,
}

/// The dataset as it is read with depth corrected by the calibration in `file`, or by its own. Depth streams without a correction are
/// named on stderr and stay as they are.
///
/// # Errors
/// When the calibration cannot be read; a usage error when the dataset has no calibration, when no stream is corrected by it, and when it
/// is of another device or size.
pub fn corrected(dataset: Dataset, file: Option<&Path>) -> Result<Dataset> {
    let (calibration, shown) = match file {
        Some(file) => (super::calibration(file)?, file.display().to_string()),
        None => own(&dataset)?,
    };
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
