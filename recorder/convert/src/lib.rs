//! Datasets to and from the layouts of others: `docs/exchange.md` says what each layout holds and loses.
//!
//! An [`Exporter`] writes one layout and is driven by [`export`], which cuts the datasets into [`Part`]s, works on
//! several at once and keeps in the folder what is done, so that an export that was killed goes on where it was.
//! A kill at any point is safe: a file has its final name only once it is complete and durable, and a resumed export
//! ends with the same bytes as one that was never interrupted. Memory is bounded by one set for each thread and the
//! rows of one part.
//!
//! An [`Importer`] reads one layout and is driven by [`import`], which records a dataset and verifies it.
//!
//! Layer 4. [`kinect`] reads recordings of an Azure Kinect; [`recalibrate`] plans another calibration of a dataset; [`relabel`](mod@relabel) and [`zed_replay`](mod@zed_replay) add
//! depth to datasets; [`scenes`] writes random scenes as training data. [`store`] is where work of many
//! machines lies.
#![cfg_attr(test, allow(clippy::unwrap_used, clippy::expect_used))]

mod bytecamera;
mod export;
mod folder;
#[cfg(any(test, feature = "testing"))]
pub mod fuzzing;
mod hdf5;
mod import;
pub mod kinect;
pub mod lerobot;
mod part_file;
pub mod recalibrate;
pub mod relabel;
mod report;
mod rosbag;
mod rows;
mod run_part;
pub mod scenes;
mod source;
pub mod store;
mod vectors;
mod zarr;
pub mod zed_replay;

pub use bytecamera::{ByteCameraExport, ByteCameraImport, ByteCameraOptions, CameraNames};
pub use export::{ExportOptions, ExportProgress, Exporter, PartOut, PartSets, Parts, Plan, export};
pub use folder::{OutFile, Output};
pub use hdf5::Hdf5;
pub use import::{ImportFacts, ImportProgress, ImportReport, Importer, import};
pub use part_file::open_part;
pub use report::{DatasetIdentity, ExportReport, PartRecord, REPORT_FILE, SegmentIdentity, StreamCount};
pub use rosbag::RosbagImport;
pub use rows::{Incomplete, RowOptions};
pub use run_part::RunPart;
pub use source::{EpisodeUse, PART_SETS, Part, Source};
pub use vectors::{Gaps, VectorOptions};
pub use zarr::Zarr;
