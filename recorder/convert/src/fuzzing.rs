//! Entry points of the fuzz targets of importers, and the test that runs their corpus: each feeds arbitrary bytes to a
//! reader of files. `docs/fuzzing.md` says how to run them.

use crate::{bytecamera, rosbag as bag};
use depthrig_recorder::fs::{Fs, MemFs};
use std::path::Path;

/// A line of the `frames.csv` of an export; whether it is one.
///
/// # Panics
/// When reading and writing changes a line.
pub fn frames_csv(bytes: &[u8]) -> bool {
    core::str::from_utf8(bytes).is_ok_and(bytecamera::fuzzing::row)
}

/// The `calibration.json` of an export; whether it is one.
pub fn calibration_json(bytes: &[u8]) -> bool {
    bytecamera::fuzzing::calibration(bytes)
}

/// An NPY file; whether it is an array that can be imported.
pub fn npy(bytes: &[u8]) -> bool {
    bytecamera::fuzzing::npy(bytes)
}

/// A rosbag, read to its end; returns the number of frames.
///
/// # Panics
/// When the accounts of the frames do not balance.
pub fn rosbag(bytes: &[u8]) -> u64 {
    let fs = MemFs::new();
    let path = Path::new("/fuzz.bag");
    fs.put(path, bytes.to_vec());
    fs.open(path).map_or(0, bag::fuzzing::fuzz)
}

#[cfg(test)]
mod tests {
    use depthrig_corpus::run;

    #[test]
    fn rosbags() {
        run("rosbag", |bytes| super::rosbag(bytes).saturating_sub(3));
    }

    #[test]
    fn rows_of_frames_csv() {
        run("frames_csv", |bytes| super::frames_csv(bytes).into());
    }

    #[test]
    fn calibrations() {
        run("calibration_json", |bytes| super::calibration_json(bytes).into());
    }

    #[test]
    fn arrays() {
        run("npy", |bytes| super::npy(bytes).into());
    }
}
