//! Datasets to and from the layouts of others: `docs/exchange.md` says what each layout holds and loses.
//!
//! An [`Exporter`] writes one layout and is driven by [`export`], which cuts the datasets into [`Part`]s, works on
//! several at once and keeps in the folder what is done, so that an export that was killed goes on where it was.
//! A kill at any point is safe: a file has its final name only once it is complete and durable, and a resumed export
//! ends with the same bytes as one that was never interrupted. Memory is bounded by one set for each thread and the
//! rows of one part.
//!
//! An [`Importer`] reads one layout and is driven by [`import`], which records a dataset and verifies it.

mod bytecamera;
mod export;
mod folder;
mod import;
pub mod lerobot;
mod report;
mod rosbag;
mod source;

pub use bytecamera::{ByteCameraExport, ByteCameraImport, ByteCameraOptions, CameraNames};
pub use export::{ExportOptions, ExportProgress, Exporter, PartOut, PartSets, Parts, Plan, export};
pub use folder::{OutFile, Output};
pub use import::{ImportFacts, ImportProgress, ImportReport, Importer, import};
pub use report::{DatasetIdentity, ExportReport, PartRecord, REPORT_FILE, SegmentIdentity, StreamCount};
pub use rosbag::RosbagImport;
pub use source::{PART_SETS, Part, Source};

/// Entry points of the fuzz targets.
pub(crate) mod fuzzing {
    pub(crate) use super::bytecamera::fuzzing::{calibration, npy, row};
    pub(crate) use super::rosbag::fuzzing::fuzz as rosbag;
}
