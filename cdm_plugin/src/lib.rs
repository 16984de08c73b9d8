//! Camera depth models: what refines the depth of a camera, and how good depth is.
//!
//! Layer 3. Start at [`Refiner`]: colour and raw depth of one view in, clean metric depth out. A camera depth model is
//! one network ([`Encoder`] says which size of it) with its [`Weights`]; a [`Network`] runs it. [`metrics`] are the
//! measures by which depth is compared with a reference.
#![cfg_attr(test, allow(clippy::unwrap_used, clippy::expect_used))]

pub mod arch;
mod durable;
mod error;
mod factory;
pub mod fetch;
mod fill;
#[cfg(any(test, feature = "testing"))]
pub mod fuzzing;
pub mod metrics;
mod model;
mod network;
mod onnx;
mod onnxruntime;
mod options;
pub mod prep;
pub mod published;
mod refine;
mod refiner;
pub mod stage;
mod stereo_network;
pub mod store;
pub mod tiny;
pub mod weights;
mod workers;

pub use arch::Encoder;
pub use error::{Error, ErrorKind, Result};
pub use factory::refiner;
pub use fill::FillRefiner;
pub use model::{ChannelOrder, INPUT_SIZE, MAX_DEPTH_M, Model};
pub use network::{NetShape, Network, PositionEmbeddings};
pub use onnxruntime::{OnnxNetwork, find_library};
pub use options::{EngineKind, Precision, RefinerOptions};
pub use refine::{Color, ColorFormat, Description, Job, Output, RawDepth, Refiner, StepTimes};
pub use refiner::CdmRefiner;
#[cfg(any(test, feature = "testing"))]
pub use stereo_network::FakeNetwork;
pub use stereo_network::{NetworkPixels, StereoNetwork, StereoNetworkOptions};
pub use store::ModelStore;
pub use tiny::TinyRefiner;
pub use weights::Weights;
