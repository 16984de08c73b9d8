//! Benches of the command line: what a promise about speed is measured with.

pub mod bus;
pub mod capture;
pub mod conditions;
pub mod stats;
pub mod stereo;
