//! The rows that layouts for training share: a row for each set, an episode for each episode or dataset, the robot's state and action.
//!
//! Decisions before an image is read are in [`plan`], streams and vectors in [`schema`], pixels in [`images`], facts without an array in [`facts`].

pub(crate) mod facts;
pub(crate) mod images;
pub(crate) mod plan;
pub(crate) mod schema;

use crate::VectorOptions;
use depthrig_bus::StreamId;
use serde::Serialize;

/// Treatment of a set that lacks a frame of some stream: each row needs an image of each.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Incomplete {
    /// A blank image (black, no depth) stands in its place, and a mark of the row says so.
    #[default]
    Mark,
    /// The set is left out, which leaves a gap in the even grid of times.
    LeaveOut,
}

/// How to export rows: the options of every layout that has them.
#[derive(Debug, Clone, Default, Serialize)]
pub struct RowOptions {
    /// The task of all episodes; without it, each session's scene.
    pub task: Option<String>,
    /// Sets per second; without it, the rig's configuration or, where that is not what was recorded, the sets' own.
    pub fps: Option<f64>,
    /// Treatment of incomplete sets.
    pub incomplete: Incomplete,
    /// The streams to export; none means all.
    pub streams: Vec<StreamId>,
    /// The signals that become state and action.
    pub signals: VectorOptions,
}
