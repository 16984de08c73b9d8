//! Cameras that another process serves: the hand-shake between that process and the daemon.
//!
//! Start at [`ExternalCamera`], the side of the process, or at [`ExternalLink`], the side of the daemon.
//! docs/external.md is the contract; [`ExternalOffer`], [`ExternalMode`], [`ExternalAnswer`] and [`ExternalFrame`] are its
//! bytes. Whatever comes from the other side is checked before it is believed.

mod camera;
mod codes;
mod fields;
#[cfg(any(test, feature = "testing"))]
pub mod fuzzing;
mod layout;
mod link;
mod lock;
mod mode;
mod place;
mod plain;
mod session;

pub use camera::ExternalCamera;
pub use codes::{
    ExternalClock, ExternalFrameFlags, ExternalModeFlags, ExternalReason, ExternalState, ExternalWant,
};
pub use fields::{ANSWER_FIELDS, FRAME_FIELDS, MODE_FIELDS, OFFER_FIELDS};
pub use layout::{ExternalAnswer, ExternalFrame, ExternalMode, ExternalOffer};
pub use link::{Answer, Beat, ExternalLink, FrameInlet, Offer, OfferMessage, SentFrame};
pub use lock::{ExternalLock, holder, lock_camera};
pub use mode::{About, Mode};
pub use place::{Place, served};
pub use session::{FrameSlot, Session};

use core::time::Duration;

/// Version of the hand-shake.
pub const VERSION: u16 = 1;
/// The value of the channels' attribute `schema`, checked on open.
pub const SCHEMA: &str = "depthrig.external/1";
/// First part of the channels' names.
pub const PREFIX: &str = "depthrig.external";
/// Suffix of a camera's lock file.
pub const LOCK_SUFFIX: &str = ".external";
/// First bytes of an [`ExternalOffer`].
pub const OFFER_MAGIC: [u8; 4] = *b"DREO";
/// First bytes of an [`ExternalAnswer`].
pub const ANSWER_MAGIC: [u8; 4] = *b"DREA";
/// First bytes of an [`ExternalFrame`].
pub const FRAME_MAGIC: [u8; 4] = *b"DREF";
/// Heartbeat interval of both sides.
pub const HEARTBEAT: Duration = Duration::from_millis(200);
/// Silence after which the daemon counts as gone.
pub const SILENCE: Duration = Duration::from_secs(2);
/// Modes of one camera at most.
pub const MAX_MODES: usize = 64;
/// Streams of one camera at most.
pub const MAX_STREAMS: usize = 16;
/// Bytes of one frame at most.
pub const MAX_FRAME_BYTES: usize = 256 << 20;
/// Bytes of the text of a refusal.
pub const TEXT_BYTES: usize = 256;
/// Bytes of an [`ExternalMode`] in the payload of an offer.
pub const MODE_BYTES: usize = size_of::<ExternalMode>();
/// Slots of a stream's channel from the process to the daemon: four that wait unread, one that is being copied, and
/// three to write into.
pub const FRAME_SLOTS: usize = 8;
/// Ports that send at most: a camera's own, and those of killed processes that nobody has cleaned up yet.
pub const MAX_PUBLISHERS: usize = 4;
/// Subscribers of a channel at most.
pub const MAX_SUBSCRIBERS: usize = 4;
/// Unread samples that a channel keeps per subscriber.
pub const BUFFER: usize = 4;
/// Samples that one subscriber may hold.
pub const MAX_HELD: usize = 4;
/// Processes that may have a channel open.
pub const MAX_NODES: usize = 16;
/// Notifiers, and listeners, of an event.
pub const MAX_EVENT_PORTS: usize = 8;
/// The event that both sides raise.
pub const EVENT_ID: usize = 1;
/// The environment variable that names the rig to a process that the daemon starts.
pub const RIG_VARIABLE: &str = "DEPTHRIG_RIG";
/// The environment variable that names the camera to a process that the daemon starts.
pub const CAMERA_VARIABLE: &str = "DEPTHRIG_CAMERA";
