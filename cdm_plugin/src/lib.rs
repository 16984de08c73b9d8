//! Camera depth models: what refines the depth of a camera, and how good depth is.
//!
//! Floor 3. **What is here today: [`metrics`]**, the measures by which depth is compared with a reference, over
//! raw 16-bit or float depth. There is no model, no engine and no training yet; nothing in this crate pretends to
//! be one.
#![cfg_attr(test, allow(clippy::unwrap_used, clippy::expect_used))]

mod error;
pub mod metrics;

pub use error::{Error, ErrorKind, Result};
