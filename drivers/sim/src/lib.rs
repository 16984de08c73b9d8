//! Cameras without a device: simulated ones, folders of images, and the suite that every driver has to pass.
#![cfg_attr(test, allow(clippy::unwrap_used, clippy::expect_used))]

#[cfg(any(test, feature = "testing"))]
pub mod conformance;
pub mod files;
pub mod synthetic;
