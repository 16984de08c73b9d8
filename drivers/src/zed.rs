//! Stereolabs ZED 2i as a camera of USB video, without the vendor's SDK.
//!
//! The camera sends both eyes side by side in one YUYV picture, not rectified. What its bytes mean, and where that
//! is known from, is in [`conf`] (factory calibration), [`command`] (vendor commands) and [`sensors`] (the motion
//! unit). Source of all three unless said otherwise: the facts in `zed-open-capture` (stereolabs, BSD-3-Clause).

pub mod command;
pub mod conf;
mod ini;
pub mod mode;
pub mod sensors;
