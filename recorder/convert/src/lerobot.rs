//! LeRobot v3.0: each dataset becomes an episode of one LeRobot dataset, images in Parquet, no video.
//!
//! ```text
//! plan (no image is read) ──▶ a table for each part, in parallel ──▶ data files, an episode in one ──▶ meta/
//! ```
//!
//! `docs/exchange.md` says what LeRobot cannot hold and what becomes of it.

mod columns;
mod encode;
mod finish;
mod part;
mod stats;
mod table;

use crate::rows::plan;
use crate::{EpisodeUse, Exporter, Output, Part, PartOut, PartSets, Parts, Plan, RowOptions, Source};
use depthrig_bus::StreamId;
use depthrig_recorder::Result;
use serde_json::{Value, json};

/// The exporter to LeRobot v3.0.
#[derive(Debug, Default)]
pub struct Lerobot(plan::Planned);

impl Lerobot {
    /// With these options.
    pub const fn new(options: RowOptions) -> Self {
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
        let losses = [columns::losses(&plan.schema, sources), plan.losses.clone()].concat();
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
