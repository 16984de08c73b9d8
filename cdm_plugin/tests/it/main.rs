//! The network, and everything around it, against the numbers of the official code.
//!
//! These numbers are not in the repository (`DEPTHRIG_TEST_DATA` names the folder that holds them); without them the
//! tests fail and say where they look.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

mod onnxruntime;
mod prep;
mod support;
