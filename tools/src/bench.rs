//! Benchmarks of the command line, which check the promises about performance.

pub mod bus;
pub mod capture;
pub mod conditions;
pub mod stats;
pub mod stereo;
