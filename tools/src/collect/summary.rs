//! How a session of `collect` ended.

use crate::exit::Exit;
use crate::out;
use depthrig_recorder::{Episode, EpisodeOutcome};
use serde_json::{Value, json};
use std::collections::BTreeMap;

/// How a session ended.
#[derive(Debug)]
pub struct Summary {
    /// Folder of the dataset.
    pub dataset: String,
    /// The recording goes on.
    pub is_joined: bool,
    /// Episodes that were to be kept.
    pub wanted: u32,
    /// Sets that the recording lost meanwhile, by reason.
    pub lost: BTreeMap<String, u64>,
    /// Why it ended early.
    pub error: Option<String>,
    /// All episodes, in order. One without an end was cut off.
    pub episodes: Vec<Episode>,
}

impl Summary {
    fn count(&self, is: impl Fn(&&Episode) -> bool) -> usize {
        self.episodes.iter().filter(is).count()
    }

    fn kept(&self) -> usize {
        self.count(|e| is_kept(e))
    }

    fn discarded(&self) -> usize {
        self.count(|e| e.discarded)
    }

    fn judged(&self, outcome: EpisodeOutcome) -> usize {
        self.count(|e| is_kept(e) && e.outcome == Some(outcome))
    }

    /// Length of the kept episodes together.
    fn seconds(&self) -> f64 {
        self.episodes.iter().filter(|e| is_kept(e)).filter_map(seconds).sum()
    }

    /// It in lines, for people.
    pub fn text(&self) -> String {
        let mut lines = vec![format!(
            "{} of {} kept, {} in all: {} success, {} failure; {} discarded",
            self.kept(),
            out::count(self.wanted, "episode"),
            out::seconds(self.seconds()),
            self.judged(EpisodeOutcome::Success),
            self.judged(EpisodeOutcome::Failure),
            self.discarded(),
        )];
        let dataset = &self.dataset;
        lines.extend(self.episodes.iter().filter(|e| e.is_open()).map(|cut| {
            let n = cut.number;
            format!("episode {n} was cut off; if it is not to be used: depthrig edit {dataset} --episode {n}=discard")
        }));
        if !self.lost.is_empty() {
            lines.push(format!("lost sets: {}", out::reasons(&self.lost)));
        }
        let goes_on = if self.is_joined { ", whose recording goes on" } else { "" };
        lines.push(format!("dataset {dataset}{goes_on}"));
        lines.join("\n")
    }

    /// It for programs.
    pub fn json(&self) -> Value {
        json!({
            "dataset": self.dataset,
            "recording_goes_on": self.is_joined,
            "wanted": self.wanted,
            "kept": self.kept(),
            "discarded": self.discarded(),
            "cut_off": self.count(|e| e.is_open()),
            "success": self.judged(EpisodeOutcome::Success),
            "failure": self.judged(EpisodeOutcome::Failure),
            "seconds": self.seconds(),
            "lost_sets": self.lost,
            "error": self.error,
            "episodes": self.episodes,
        })
    }

    /// The exit code of a session that did not fail.
    pub fn exit(&self) -> Exit {
        if self.lost.is_empty() { Exit::Good } else { Exit::Lost }
    }
}

fn is_kept(episode: &Episode) -> bool {
    !episode.discarded && !episode.is_open()
}

/// Length of an episode that has ended.
pub fn seconds(episode: &Episode) -> Option<f64> {
    Some((episode.end_utc_ns? - episode.start_utc_ns) as f64 / 1e9)
}
