//! The messages of a dataset: standard ROS 2 ones for every viewer, and depthrig's own for what those cannot
//! say. Each has its encoder here, next to the schema that is stored in the file.

pub(crate) mod accounts;
pub(crate) mod diagnostics;
pub(crate) mod frame_info;
pub(crate) mod frame_set;
pub(crate) mod image;
pub(crate) mod motion;
pub(crate) mod schemas;
pub(crate) mod signal;
pub(crate) mod tf;

pub use accounts::{SetCounts, StreamAccount};
pub use diagnostics::{Diagnostic, Level};
