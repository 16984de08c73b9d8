//! `bytecameradepth`: the folders of the public ByteCameraDepth dataset, with what those lack.
//!
//! `YYYYMMDD_HHMM/camera_<model>/{depth,color,ir}_N.png` and `raw_depth_N.npy`, one folder for each camera and depth
//! mode. depthrig adds `frames.csv` (every number of every frame's header) and `calibration.json`, so that an
//! import of an export is the dataset again.

mod calibration;
mod export;
mod images;
mod import;
mod names;
mod rows;

pub use export::{ByteCameraExport, CameraNames};
pub use import::{ByteCameraImport, ByteCameraOptions};

/// The name of a camera: that of a known model, else the nearest name to `otherwise`.
pub(super) fn camera_name(model: &str, otherwise: &str) -> depthrig_bus::Name {
    names::name(&names::of_model(model, otherwise, false))
}

/// `plain`, or where that is taken, `plain` with the first number from `n` on that makes a free name of it.
pub(super) fn free_name(
    plain: &depthrig_bus::Name,
    n: u32,
    taken: impl Fn(&str) -> bool,
) -> depthrig_bus::Name {
    names::free(plain, n, taken)
}

/// The name of the layout.
pub const FORMAT: &str = "bytecameradepth";
/// Every number of every frame.
const FRAMES_FILE: &str = "frames.csv";
/// Streams, their calibration and where it comes from.
const CALIBRATION_FILE: &str = "calibration.json";

/// Entry points of the fuzz targets.
#[cfg(any(test, feature = "testing"))]
pub(crate) mod fuzzing {
    /// Whether a `frames.csv` line is one.
    pub(crate) fn row(line: &str) -> bool {
        let Ok(row) = super::rows::Row::parse(line) else { return false };
        let text = row.text();
        let again = super::rows::Row::parse(text.trim_end());
        assert!(again.is_ok_and(|again| again.text() == text), "a row changes by being written and read");
        true
    }

    use super::calibration::Calibration;
    use super::images::{Want, array, read};

    /// Whether a `calibration.json` is one; what it says of the files is used on a small one.
    pub(crate) fn calibration(text: &[u8]) -> bool {
        let parse = |text: &[u8]| Calibration::parse(text, std::path::Path::new("calibration.json"));
        let Ok(calibration) = parse(text) else { return false };
        for s in &calibration.streams {
            let want = Want::Exactly(s.stream.format, s.stream.width, s.stream.height);
            drop(read(NPY_OF_ONE, "npy", want));
        }
        let again = calibration.text().and_then(|text| parse(&text));
        assert!(again.is_ok(), "a calibration that was read and written cannot be read: {again:?}");
        true
    }

    /// An NPY file of one byte.
    const NPY_OF_ONE: &[u8] =
        b"\x93NUMPY\x01\x00\x3c\x00{'descr': '|u1', 'fortran_order': False, 'shape': (1, 1)}  \n\x07";

    /// Whether an NPY file is an array that can be imported; an image has the size that the array has.
    pub(crate) fn npy(bytes: &[u8]) -> bool {
        let Ok(array) = array(bytes) else {
            assert!(read(bytes, "npy", Want::Metres).is_err(), "an image from no array");
            return false;
        };
        if let Ok(image) = read(bytes, "npy", Want::Metres) {
            assert_eq!(
                [image.height as usize, image.width as usize],
                array.shape[..],
                "an image of another size"
            );
            let size = image.format.frame_bytes(image.width, image.height);
            assert_eq!(image.pixels.len(), size, "pixels of another size");
        }
        true
    }
}
