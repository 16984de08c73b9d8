//! Sensors behind the kernel's industrial I/O (IIO): found by the USB device that they are part of, switched on through
//! sysfs, read from their nodes.
//!
//! Sources: the kernel's `Documentation/ABI/testing/sysfs-bus-iio` for the files and
//! `Documentation/driver-api/iio/buffers.rst` for how a scan lies in memory.

mod find;
mod scan;
mod sensor;

pub use find::{FoundSensor, on_port};
pub use scan::{Element, Layout, Scan};
pub use sensor::{Sensor, Switch};
