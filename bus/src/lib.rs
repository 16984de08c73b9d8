//! The frame bus: the vocabulary of depthrig and its channels in shared memory.
//! The lowest layer: every other crate uses its types; it depends on no camera, file or model. Start at [`FrameHeader`]
//! (describes a frame), [`Bus`] (open a rig), [`Publisher`] and [`Subscriber`] (write and read a channel); at [`Signals`] for
//! samples of a robot.
#![cfg_attr(test, allow(clippy::unwrap_used, clippy::expect_used))]

mod channel;
pub mod clock;
mod drops;
mod error;
pub mod external;
pub mod files;
mod format;
mod geometry;
mod header;
mod ids;
mod limits;
mod metadata;
mod motion;
mod node;
mod publisher;
pub mod runtime;
mod sets;
pub mod shm;
pub mod signal;
mod subscriber;
pub mod sync;
mod text;
pub mod umask;

pub use channel::{BUFFER as SUBSCRIBER_BUFFER, MAX_LENT};
pub use clock::{HostTime, UtcPair};
pub use drops::{DropCounts, DropReason};
pub use error::{Error, ErrorKind, Result};
pub use format::{Layout, PixelFormat, Sample};
pub use geometry::{Distortion, Intrinsics, Pose};
pub use header::{
    ClockDomain, FIELDS, Field, FrameFlags, FrameHeader, HEADER_SIZE, HEADER_VERSION, PIXEL_ALIGN, SCHEMA,
    StageStep,
};
pub use ids::{CameraName, Name, RigName, StreamId, StreamName};
pub use metadata::MetadataLevel;
pub use motion::{MOTION_FIELDS, MOTION_SAMPLE_BYTES, MotionFlags, MotionSample};
pub use node::{Bus, IOX_FOLDER};
pub use publisher::{FrameMut, Publisher};
pub use runtime::RuntimeDir;
pub use sets::{MemberRecord, RECORD_BYTES, SetFrame, SetHeader, SetPublisher, SetSubscriber};
pub use shm::SHM_PREFIX;
pub use signal::{
    FieldType, Series, SignalDescription, SignalField, SignalFlags, SignalHeader, SignalKind, SignalName,
    SignalPublisher, SignalSample, SignalSubscriber, Signals, Stamp, Value,
};
pub use subscriber::{Frame, Subscriber};
