//! LeRobot v3.0: each dataset becomes an episode of one LeRobot dataset, images in Parquet, no video.
//!
//! ```text
//! plan (no image is read) ──▶ a table for each part, in parallel ──▶ data files, an episode in one ──▶ meta/
//! ```
//!
//! `docs/exchange.md` says what LeRobot cannot hold and what becomes of it.

pub(crate) mod encode;
mod finish;
mod part;
pub(crate) mod plan;
pub(crate) mod schema;
mod stats;
mod table;

use super::{EpisodeUse, Exporter, Output, Part, PartOut, PartSets, Parts, Plan, Source, VectorOptions};
use depthrig_bus::StreamId;
use depthrig_recorder::Result;
use serde::Serialize;
use serde_json::{Value, json};

/// Treatment of a set that lacks a frame of some stream: LeRobot wants an image in every cell.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Incomplete {
    /// A blank image (black, no depth) stands in its place, and the column `missing.<camera>_<stream>` says so.
    #[default]
    Mark,
    /// The set is left out, which leaves a gap in the even grid of times.
    LeaveOut,
}

/// How to export to LeRobot.
#[derive(Debug, Clone, Default, Serialize)]
pub struct LerobotOptions {
    /// The task of all episodes; without it, each session's scene.
    pub task: Option<String>,
    /// Sets per second; without it, the rig's configuration or, where that is not what was recorded, the sets' own.
    pub fps: Option<f64>,
    /// Treatment of incomplete sets.
    pub incomplete: Incomplete,
    /// The streams to export; none means all.
    pub streams: Vec<StreamId>,
    /// The signals that become `observation.state` and `action`.
    pub signals: VectorOptions,
}

/// The exporter to LeRobot v3.0.
#[derive(Debug, Default)]
pub struct Lerobot(plan::Planned);

impl Lerobot {
    /// With these options.
    pub const fn new(options: LerobotOptions) -> Self {
        Self(plan::Planned::new(options))
    }
}

impl Exporter for Lerobot {
    fn format(&self) -> &'static str {
        "lerobot"
    }

    fn episodes(&self) -> EpisodeUse {
        EpisodeUse::Each
    }

    fn takes(&self, signal: &StreamId) -> bool {
        self.0.takes(signal)
    }

    fn options(&self) -> Value {
        json!(self.0.options)
    }

    fn plan(&mut self, sources: &[Source]) -> Result<Plan> {
        let plan = self.0.make(sources)?;
        let losses = [plan.schema.losses(), plan.losses.clone()].concat();
        let folders = ["data", "meta", "meta/episodes", "meta/episodes/chunk-000"].map(str::to_owned);
        Ok(Plan { folders: folders.into(), losses, ..Plan::by_segment(sources) })
    }

    fn part(
        &self,
        source: &Source,
        part: &Part,
        sets: &mut PartSets<'_>,
        out: &mut PartOut<'_>,
    ) -> Result<()> {
        part::write(self.0.get()?, source, part, sets, out)
    }

    fn finish(&self, sources: &[Source], parts: &Parts<'_>, out: &Output<'_>) -> Result<()> {
        finish::finish(self.0.get()?, sources, parts, out)
    }
}
