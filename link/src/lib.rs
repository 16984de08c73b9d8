//! Several computers as one rig: what passes between their daemons.
//!
//! **Clock.** Each host has a `CLOCK_MONOTONIC` of its own, and frames of two hosts can only be in one set if it is
//! known what one clock says when the other says `t`, and how wrong that may be. A host asks another one twenty times a second
//! over UDP ([`asker`]), which answers with two stamps of its clock ([`answerer`]); [`corridor`] makes an offset and a
//! bound of its error from these stamps. A [`key`] signs the packets; the hosts get it on the way of *Control and data*.
//!
//! **Control and data.** The host that records reaches the control socket of each other one through a [`tunnel`], so that whatever speaks to a
//! daemon speaks to that of another host in the same way.

pub mod answerer;
pub mod asker;
pub mod corridor;
pub mod identity;
pub mod key;
pub mod rates;
mod stamped;
pub mod tunnel;
mod wire;
mod worker;

pub use answerer::Answerer;
pub use asker::Asker;
pub use corridor::{Corridor, Estimate, Exchange, Reading};
pub use key::{Key, Trust};
pub use tunnel::{Remote, Tunnel};
