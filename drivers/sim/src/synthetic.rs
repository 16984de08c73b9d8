//! Simulated cameras: a rig without a camera, and the truth to compare everything with.
//!
//! All cameras of a [`SyntheticBackend`] see one world, ray-cast from where they sit on a moving mount with the optics
//! of the model they imitate ([`models`]); depth comes with the faults of its principle, and true depth as a stream of
//! its own. A loop of poses is rendered once ([`prepare`], or [`Drawing`] while they stream) into a cache file, so that
//! streaming costs one memory copy per frame. Clocks, transport and faults are simulated as [`SyntheticConfig`] says
//! and pass through the same [`depthrig_driver::Gate`] as those of a real device; [`SimTruth`] knows what really happened.

pub mod arm;
mod backend;
pub mod board;
mod cache;
mod color;
mod config;
mod depth;
mod drawing;
mod gain;
pub mod imu;
pub mod models;
mod motion;
mod noise;
pub mod overlay;
mod pattern;
mod profiles;
mod queue;
mod random;
mod render;
mod scene;
pub mod scenes;
mod shape;
mod texture;
mod timeline;
mod unit;
mod view;

pub use backend::SyntheticBackend;
pub use config::{ClockSim, FaultKind, ScheduledFault, StreamOverride, SyntheticConfig, default_cache_dir};
pub use drawing::{Drawing, DrawingProgress};
pub use pattern::Pattern;
pub use profiles::profiles;
pub use render::{Progress, prepare, prepare_all};
pub use unit::{Ledger, SimFrame, SimTruth};

/// Name of the backend in rig configurations.
pub const NAME: &str = "synthetic";
