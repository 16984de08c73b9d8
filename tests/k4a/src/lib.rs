//! A fake `libk4a.so`: the C functions of Azure-Kinect-Sensor-SDK 1.4 over cameras that a test commands.
//!
//! It is built as a library of its own and loaded by the driver under test as the real one would be, so that both sides
//! meet in the C interface alone. Types and values are declared here once more, from the public header (`k4a.h`,
//! `k4atypes.h`, MIT), and not shared with the driver: a mistake in one of them shows. What the functions do follows
//! `src/sdk/k4a.c`, as far as a caller can see it.
//!
//! A handle is a number and not an address, so that using one that was given back is noticed and counted instead of
//! being undefined. Beside the functions of the header there are those of [`script`], by which a test makes cameras
//! fail and asks what they did. A process that has no test to command it gets the cameras whose serial numbers
//! the variable `DEPTHRIG_FAKE_K4A` lists.

// The other side calls these functions through C, and C calls back.
#![allow(unsafe_code)]

pub mod abi;
mod calibration;
mod camera;
pub use camera::motion;
mod exports;
pub mod images;
mod script;
mod world;
