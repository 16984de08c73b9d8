//! `collect`: demonstration after demonstration, with a pause before each.
//!
//! [`cycle`] decides, from times and keys alone; [`rig`] does what it decides over the control API; [`pedal`] and the terminal give the
//! keys; [`display`] and [`summary`] say how it stands and how it ended.

pub mod cycle;
pub mod display;
pub mod pedal;
pub mod rig;
pub mod summary;
