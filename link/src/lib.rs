//! Several computers as one rig: what passes between their daemons.
//!
//! So far it is the clock. Each host has a `CLOCK_MONOTONIC` of its own, and frames of two hosts can only be in one set if it is
//! known what one clock says when the other says `t`, and how wrong that may be. A host asks another one twenty times a second
//! over UDP ([`asker`]), which answers with two stamps of its clock ([`answerer`]); [`corridor`] makes an offset and a
//! bound of its error from these stamps.

pub mod answerer;
pub mod asker;
pub mod corridor;
pub mod identity;
mod stamped;
mod wire;
mod worker;

pub use answerer::Answerer;
pub use asker::Asker;
pub use corridor::{Corridor, Estimate, Exchange, Reading};
