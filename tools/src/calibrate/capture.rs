//! The parts of `depthrig calibrate capture`: images in, views stored, progress shown.

pub mod display;
pub mod events;
pub mod live_views;
pub mod rounds;
pub mod store;
