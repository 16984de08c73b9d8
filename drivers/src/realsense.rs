//! The `realsense` back end: Intel RealSense D400 cameras, without the vendor's SDK.
//!
//! Layouts and constants: librealsense 2.58 (Apache-2.0), `src/ds` and `src/ds/d400`, unless a line says otherwise.

pub mod config;
mod find;
mod models;
pub mod protocol;
pub mod transport;

pub use config::RealsenseConfig;
pub use transport::Transport;
