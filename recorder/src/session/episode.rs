//! Episodes: demonstrations within a recording.

use super::{NOTE_MAX_BYTES, Session};
use crate::{Error, ErrorKind, Result};
use serde::{Deserialize, Serialize};

/// Most episodes of a dataset: `session.toml` must stay small enough to be read.
const EPISODES_MAX: usize = 4096;
/// Most bytes of all their tasks.
const TASKS_MAX_BYTES: usize = 1 << 20;

/// One demonstration: a span of a recording, in `session.toml` under `[[episodes]]`. A set is in it when the set's log time
/// is.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Episode {
    /// Its number in the recording, from 1.
    pub number: u32,
    /// The task.
    #[serde(default)]
    pub task: String,
    /// Its start, UTC nanoseconds since 1970 on the time axis of the sets.
    pub start_utc_ns: i64,
    /// Its end; `None` while it runs and when the recording was cut off in it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub end_utc_ns: Option<i64>,
    /// A person's or program's judgement.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub outcome: Option<EpisodeOutcome>,
    /// Not to be used. Its sets stay on disk.
    #[serde(default, skip_serializing_if = "core::ops::Not::not")]
    pub discarded: bool,
    /// Its start lies before the first set of this dataset, which was trimmed.
    #[serde(default, skip_serializing_if = "core::ops::Not::not")]
    pub cut_start: bool,
    /// Its end lies after the last set of this dataset, which was trimmed.
    #[serde(default, skip_serializing_if = "core::ops::Not::not")]
    pub cut_end: bool,
}

/// Whether the task of an episode was done.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EpisodeOutcome {
    /// It was.
    Success,
    /// It was not.
    Failure,
}

impl EpisodeOutcome {
    /// The name used in files and JSON.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Success => "success",
            Self::Failure => "failure",
        }
    }
}

/// How many episodes a recording has.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct EpisodeCounts {
    /// Kept ones that have ended.
    pub kept: u32,
    /// Discarded ones.
    pub discarded: u32,
    /// The one that runs, or the last one.
    pub last: Option<Episode>,
}

impl EpisodeCounts {
    /// Those of a recording.
    pub fn of(episodes: &[Episode]) -> Self {
        let count =
            |is: fn(&&Episode) -> bool| u32::try_from(episodes.iter().filter(is).count()).unwrap_or(u32::MAX);
        Self {
            kept: count(|e| !e.discarded && !e.is_open()),
            discarded: count(|e| e.discarded),
            last: episodes.last().cloned(),
        }
    }
}

/// Fate of an episode at its end.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EpisodeEnd {
    /// It is kept, judged or not.
    Kept(Option<EpisodeOutcome>),
    /// It is not to be used.
    Discarded,
}

impl Episode {
    /// Whether a set of this log time is in it.
    pub fn holds(&self, utc_ns: i64) -> bool {
        self.start_utc_ns <= utc_ns && self.end_utc_ns.is_none_or(|end| utc_ns <= end)
    }

    /// Whether it runs, or was running when the recording was cut off.
    pub const fn is_open(&self) -> bool {
        self.end_utc_ns.is_none()
    }

    /// Whether exports have it: it is complete and was not discarded. One that was cut off is left out until somebody judges it.
    pub const fn is_used(&self) -> bool {
        !self.discarded && (self.outcome.is_some() || (!self.is_open() && !self.is_cut()))
    }

    /// Whether a part of it lies outside this dataset.
    pub const fn is_cut(&self) -> bool {
        self.cut_start || self.cut_end
    }

    /// How it stands, for people: `running or cut off`, `discarded`, `success`, `failure`, `cut`, `kept`.
    pub const fn state(&self) -> &'static str {
        match self.outcome {
            _ if self.discarded => "discarded",
            Some(outcome) => outcome.name(),
            None if self.is_open() => "running or cut off",
            None if self.is_cut() => "cut",
            None => "kept",
        }
    }

    /// It in words, such as `3: success, 12.4 s, put the cup on the plate`.
    pub fn text(&self) -> String {
        let mut parts = vec![format!("{}: {}", self.number, self.state())];
        if let Some(end) = self.end_utc_ns {
            parts.push(format!("{:.1} s", (end - self.start_utc_ns) as f64 / 1e9));
        }
        if !self.task.is_empty() {
            parts.push(self.task.clone());
        }
        parts.join(", ")
    }

    fn end(&mut self, end: EpisodeEnd, utc_ns: i64) {
        self.end_utc_ns = Some(utc_ns.max(self.start_utc_ns));
        self.judge(end);
    }

    /// Takes over a judgement; a discarded episode that is judged is kept again.
    pub(crate) const fn judge(&mut self, end: EpisodeEnd) {
        match end {
            EpisodeEnd::Kept(outcome) => {
                self.discarded = false;
                self.outcome = outcome;
            }
            EpisodeEnd::Discarded => self.discarded = true,
        }
    }
}

impl Session {
    /// Whether a set of this log time is in a discarded episode, and in no other.
    pub fn is_discarded(&self, utc_ns: i64) -> bool {
        let mut holding = self.episodes.iter().filter(|e| e.holds(utc_ns)).peekable();
        holding.peek().is_some() && holding.all(|e| e.discarded)
    }

    /// The episode that runs.
    pub(crate) fn running(&mut self) -> Option<&mut Episode> {
        self.episodes.last_mut().filter(|e| e.is_open())
    }

    /// Begins an episode.
    pub(crate) fn start_episode(&mut self, task: &str, utc_ns: i64) -> Result<Episode> {
        let total: usize = self.episodes.iter().map(|e| e.task.len()).sum();
        let running = self.running().map(|e| e.number);
        let (kind, why) = if let Some(number) = running {
            (ErrorKind::InUse, format!("episode {number} is running; stop or discard it first"))
        } else if task.len() > NOTE_MAX_BYTES {
            let bytes = task.len();
            (ErrorKind::BadInput, format!("the task has {bytes} bytes, {NOTE_MAX_BYTES} is the limit"))
        } else if self.episodes.len() >= EPISODES_MAX {
            (
                ErrorKind::BadInput,
                format!("the recording has {EPISODES_MAX} episodes, which is the limit; start another one"),
            )
        } else if total + task.len() > TASKS_MAX_BYTES {
            (
                ErrorKind::BadInput,
                format!("the tasks of the recording have {total} bytes, {TASKS_MAX_BYTES} is the limit"),
            )
        } else {
            let number = self.episodes.last().map_or(1, |e| e.number.saturating_add(1));
            // Spans never overlap, whatever the clock did.
            let before = self.episodes.last().and_then(|e| e.end_utc_ns);
            let start_utc_ns = before.map_or(utc_ns, |end| utc_ns.max(end.saturating_add(1)));
            let episode = Episode {
                number,
                task: task.to_owned(),
                start_utc_ns,
                end_utc_ns: None,
                outcome: None,
                discarded: false,
                cut_start: false,
                cut_end: false,
            };
            self.episodes.push(episode.clone());
            return Ok(episode);
        };
        Err(Error::new(kind, why))
    }

    /// Ends the episode that runs.
    pub(crate) fn end_episode(&mut self, end: EpisodeEnd, utc_ns: i64) -> Result<Episode> {
        let none = || Error::new(ErrorKind::BadInput, "no episode is running");
        let episode = self.running().ok_or_else(none)?;
        episode.end(end, utc_ns);
        Ok(episode.clone())
    }

    /// Judges an episode that has ended; `None`: the last one.
    pub(crate) fn judge_episode(&mut self, number: Option<u32>, end: EpisodeEnd) -> Result<Episode> {
        let found = match number {
            None => self.episodes.iter_mut().rev().find(|e| !e.is_open()),
            Some(number) => self.episodes.iter_mut().find(|e| e.number == number),
        };
        let episode = found.ok_or_else(|| {
            let what = number
                .map_or_else(|| "no episode has ended yet".to_owned(), |n| format!("unknown episode {n}"));
            Error::new(ErrorKind::NotFound, what)
        })?;
        episode.judge(end);
        Ok(episode.clone())
    }

    /// Keeps the episodes with a set in a span of log times; `is_in` knows whether a moment is in it or beside its sets.
    pub(crate) fn cut_episodes(&mut self, span: core::ops::RangeInclusive<i64>, is_in: impl Fn(i64) -> bool) {
        let last = *span.end();
        self.episodes
            .retain(|e| e.start_utc_ns <= last && e.end_utc_ns.is_none_or(|end| end >= *span.start()));
        for episode in &mut self.episodes {
            episode.cut_start |= !is_in(episode.start_utc_ns);
            episode.cut_end |= episode.end_utc_ns.is_some_and(|end| !is_in(end));
        }
    }

    /// Adds the episodes of another part of the same recording.
    pub(crate) fn join_episodes(&mut self, others: &[Episode]) {
        for other in others {
            match self.episodes.iter_mut().find(|e| e.number == other.number) {
                Some(same) => {
                    same.cut_start &= other.cut_start;
                    same.cut_end &= other.cut_end;
                }
                None => self.episodes.push(other.clone()),
            }
        }
        self.episodes.sort_by_key(|e| e.start_utc_ns);
    }
}
