//! `bytecameradepth`: the folders of the public ByteCameraDepth dataset, with what those lack.
//!
//! `YYYYMMDD_HHMM/camera_<model>/{depth,color,ir}_N.png` and `raw_depth_N.npy`, one folder for each camera and depth
//! mode. depthrig adds `frames.csv` (every number of every frame's header) and `calibration.json`, so that an
//! import of an export is the dataset again.

mod calibration;
mod export;
mod import;
mod names;
mod pictures;
mod rows;

pub use export::{ByteCameraExport, CameraNames};
pub use import::{ByteCameraImport, ByteCameraOptions};

/// The name of a camera: that of a known model, else the nearest name to `otherwise`.
pub(super) fn camera_name(model: &str, otherwise: &str) -> depthrig_bus::Name {
    names::name(&names::of_model(model, otherwise, false))
}

/// The name of the layout.
pub const FORMAT: &str = "bytecameradepth";
/// Every number of every frame.
const FRAMES_FILE: &str = "frames.csv";
/// Streams, their calibration and where it comes from.
const CALIBRATION_FILE: &str = "calibration.json";

/// What the fuzz targets reach.
pub(crate) mod fuzzing {
    /// Whether a `frames.csv` line is one.
    pub(crate) fn row(line: &str) -> bool {
        let Ok(row) = super::rows::Row::parse(line) else { return false };
        let text = row.text();
        let again = super::rows::Row::parse(text.trim_end());
        assert!(again.is_ok_and(|again| again.text() == text), "a row changes by being written and read");
        true
    }

    /// Whether a `calibration.json` is one.
    pub(crate) fn calibration(text: &[u8]) -> bool {
        super::calibration::Calibration::parse(text, std::path::Path::new("calibration.json")).is_ok()
    }

    /// Whether an NPY file is an array that can be imported.
    pub(crate) fn npy(bytes: &[u8]) -> bool {
        super::pictures::npy(bytes).is_ok()
    }
}
