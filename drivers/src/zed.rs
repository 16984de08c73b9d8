//! Stereolabs ZED 2i as a camera of USB video, without the vendor's SDK.
//!
//! **What it is here.** A camera of two streams, `left` and `right`, YUYV, each half of the side-by-side picture as it
//! comes, *not rectified*; the camera's frame is that of the left eye. Intrinsics and the right eye's pose are those of
//! the factory calibration, a file that must be there already: nothing is ever downloaded. Without it the camera
//! streams, its calibration is `none` and its intrinsics are unknown. Its motion unit is a stream `imu` ([`imu`]), where it
//! can be read.
//!
//! **Time.** The camera sends no time that is known, so the frames' time is the kernel's stamp, taken when a picture's
//! first bytes came ([`depthrig_bus::ClockDomain::Kernel`]). That is later than the middle of the exposure by half of
//! the exposure and the sensor's readout, which the camera does not tell.
//!
//! The camera sends both eyes side by side in one YUYV picture, not rectified. What its bytes mean, and where that
//! is known from, is in [`conf`] (factory calibration), [`command`] (vendor commands) and [`sensors`] (the motion
//! unit). Source of all three unless said otherwise: the facts in `zed-open-capture` (stereolabs, BSD-3-Clause).

pub mod command;
pub mod conf;
mod config;
mod device;
pub mod find;
#[doc(hidden)]
pub mod fuzzing;
pub mod hid;
pub mod imu;
mod ini;
pub mod mode;
pub mod motion;
mod profiles;
pub mod replay;
pub mod sensors;
mod settings;
mod stream;

pub use config::{CalibrationFile, ZedConfig};
pub use device::ZedBackend;
pub use profiles::STREAMS;
pub use stream::ZedStream;
