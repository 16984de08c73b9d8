//! Entry points of the fuzz targets in `fuzz/` and of the test that runs their corpus: bytes that may be anything,
//! through the ways in that a device has. `docs/fuzzing.md` says how they are run.
//!
//! A panic is a finding; so is a broken promise, which is why there are assertions here. Each function returns how
//! far its input came, so that a corpus which no longer reaches anything is noticed.

pub mod external;
pub mod kinect;
pub mod realsense;
