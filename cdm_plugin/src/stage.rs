//! The parts of refinement: a camera's settings, the refiner that they select, depth in the view of colour, and the header of the
//! result. The daemon's stage thread and the relabelling of datasets are made of it.

mod engines;
mod header;
pub mod models;
pub mod pixels;
mod settings;
mod view;
mod warm;

pub use engines::{Installed, Opened, Plan, Refiners};
pub use header::derived_header;
pub use settings::{CdmConfig, EngineChoice, RefineConfig, RefineModel};
pub use view::{Correct, View};
pub use warm::warm_up;

/// The name of the stream of refined depth.
pub const REFINED: &str = "depth_refined";
/// The name of the stream of depth in the view of colour.
pub const ALIGNED: &str = "depth_aligned";
