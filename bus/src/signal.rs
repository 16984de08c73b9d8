//! Signals: small typed samples beside the images, such as the state and the actions of a robot.
//!
//! Any process publishes one, without a rig and without configuration; up to eight others read it.
//!
//! ```no_run
//! use depthrig_bus::{RuntimeDir, Series, SignalDescription, Signals};
//! use std::time::Duration;
//!
//! # fn main() -> depthrig_bus::Result<()> {
//! let signals = Signals::open(&RuntimeDir::of_user()?)?;
//! let tool = SignalDescription::pose("arm/tool_pose".parse()?, "base")?;
//! let mut publisher = signals.publisher(&tool)?;
//! publisher.publish([0.4, 0.0, 0.3, 0.0, 0.0, 0.0, 1.0])?;
//!
//! let mut subscriber = signals.subscriber(tool.name())?;
//! let mut series = Series::new(Duration::from_secs(10));
//! series.fill(&mut subscriber)?;
//! let newest = series.latest();
//! # Ok(())
//! # }
//! ```
//! The channel of a signal is `depthrig.signal/DEVICE/SIGNAL`. Each sample is a [`SignalHeader`], the description
//! as JSON, and the values, so that a sample alone says all about itself. A `sequence` that jumps within a `session` is
//! samples that this subscriber lost; another `session` is another publisher.

mod description;
mod field;
mod header;
mod interpolation;
mod name;
mod place;
mod publisher;
mod sample;
mod series;
mod subscriber;
mod value;

pub use description::{DESCRIPTION_VERSION, SignalDescription, SignalKind};
pub use field::{FieldType, SignalField};
pub use header::{
    SIGNAL_FIELDS, SIGNAL_HEADER_SIZE, SIGNAL_MAGIC, SIGNAL_VERSION, SignalFlags, SignalHeader,
};
pub use name::SignalName;
pub use place::Signals;
pub use publisher::{SignalPublisher, Stamp};
pub use sample::SignalSample;
pub use series::Series;
pub use subscriber::SignalSubscriber;
pub use value::Value;

use core::time::Duration;

/// The value of the channels' attribute `schema`, checked on open.
pub const SCHEMA: &str = "depthrig.signal/1";
/// First part of the channels' names. No rig can have it, since names of rigs have no dot.
pub const PREFIX: &str = "depthrig.signal";
/// Second part of the name of the signal by which a daemon states the clock of a session of several computers. Exports leave it out.
pub const LINK_CLOCK: &str = "link_clock";
/// Suffix of a signal's lock file, which its publisher holds.
pub const LOCK_SUFFIX: &str = ".signal";
/// Bytes of a description at most, as JSON.
pub const MAX_DESCRIPTION_BYTES: usize = 4096;
/// Bytes of the values of a sample at most.
pub const MAX_VALUES_BYTES: usize = 4096;
/// Unread samples that the channel keeps per subscriber; older ones are replaced.
pub const BUFFER: usize = 512;
/// Subscribers of a signal at most.
pub const MAX_SUBSCRIBERS: usize = 8;
/// Samples that one subscriber may hold. Readers copy them at once.
pub const MAX_HELD: usize = 2;
/// Publishers of a channel at most: the one that holds the lock, and killed ones that nobody has cleaned up yet.
pub const MAX_PUBLISHERS: usize = 4;
/// Processes that may have the channel open.
pub const MAX_NODES: usize = 16;
/// The most that a sample's time may lie ahead of the clock: more is a time of another clock.
pub const MAX_AHEAD: Duration = Duration::from_millis(100);
/// Slots of a channel. All unread samples are among the last [`BUFFER`], whoever reads them; besides these there are the
/// ones that subscribers hold, the one for late joiners, the one that is written, and some to spare.
pub const SLOTS: usize = BUFFER + MAX_SUBSCRIBERS * MAX_HELD + 16;
