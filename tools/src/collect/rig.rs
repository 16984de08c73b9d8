//! The recording of `collect`, and the books of its episodes.

use super::summary::Summary;
use anyhow::{Result, anyhow, bail};
use depthrig_daemon::client::Client;
use depthrig_daemon::control::{EpisodeRequest, RecordRequest};
use depthrig_daemon::status::{CameraState, RecordingStatus, RigStatus};
use depthrig_recorder::{Episode, EpisodeOutcome};
use std::collections::BTreeMap;

/// A recording of a running rig, in which episodes are begun and ended.
#[derive(Debug)]
pub struct Rig {
    client: Client,
    task: String,
    path: String,
    is_joined: bool,
    /// Those of this session.
    episodes: Vec<Episode>,
    lost: Losses,
}

/// Sets that the recording lost, by reason.
#[derive(Debug, Default)]
struct Losses {
    at_start: BTreeMap<String, u64>,
    at_begin: u64,
    now: BTreeMap<String, u64>,
}

/// How the rig stands.
#[derive(Debug, Default)]
pub struct Look {
    /// The episode that ran, if somebody else ended it.
    pub ended: Option<Episode>,
    /// Troubles that need attention, such as a camera that does not stream.
    pub troubles: Vec<String>,
}

impl Rig {
    /// Starts a recording, or joins the one that goes on.
    ///
    /// # Errors
    /// When the daemon refuses, and when an episode runs already.
    pub fn open(client: Client, request: &RecordRequest, task: String) -> Result<Self> {
        let going_on = client.record_status()?.filter(|status| status.active && !status.closing);
        let is_joined = going_on.is_some();
        if let Some(running) = going_on.as_ref().and_then(|s| s.episode.as_ref()).filter(|e| e.is_open()) {
            bail!(
                "episode {} is running; end it first: depthrig episode stop, or depthrig episode discard",
                running.number
            );
        }
        let status = going_on.map_or_else(|| client.record_start(request), Ok)?;
        let lost = Losses { at_start: status.dropped.clone(), now: status.dropped, at_begin: 0 };
        Ok(Self { client, task, path: status.path, is_joined, episodes: Vec::new(), lost })
    }

    /// The dataset's folder.
    pub fn path(&self) -> &str {
        &self.path
    }

    /// The task of the episodes.
    pub fn task(&self) -> &str {
        &self.task
    }

    /// Whether the recording was going on before, and will afterwards.
    pub const fn is_joined(&self) -> bool {
        self.is_joined
    }

    /// The episode that runs, or the last one.
    pub fn last(&self) -> Option<&Episode> {
        self.episodes.last()
    }

    /// How many episodes were discarded.
    pub fn discarded(&self) -> usize {
        self.episodes.iter().filter(|e| e.discarded).count()
    }

    /// Begins an episode.
    ///
    /// # Errors
    /// When the daemon refuses.
    pub fn begin(&mut self) -> Result<()> {
        let episode = self.client.episode(&EpisodeRequest::Start { task: self.task.clone() })?;
        self.episodes.push(episode);
        self.lost.at_begin = self.lost.now.values().sum();
        Ok(())
    }

    /// Ends the episode that runs, and keeps it.
    ///
    /// # Errors
    /// When the daemon refuses.
    pub fn keep(&mut self, outcome: Option<EpisodeOutcome>) -> Result<()> {
        self.send(&EpisodeRequest::Stop { outcome })
    }

    /// Discards the episode that runs, else the last one.
    ///
    /// # Errors
    /// When the daemon refuses.
    pub fn discard(&mut self) -> Result<()> {
        self.send(&EpisodeRequest::Discard { number: self.number() })
    }

    /// Judges the last episode.
    ///
    /// # Errors
    /// When the daemon refuses.
    pub fn judge(&mut self, outcome: EpisodeOutcome) -> Result<()> {
        self.send(&EpisodeRequest::Mark { outcome: Some(outcome), number: self.number() })
    }

    fn number(&self) -> Option<u32> {
        self.last().map(|e| e.number)
    }

    fn send(&mut self, request: &EpisodeRequest) -> Result<()> {
        let episode = self.client.episode(request)?;
        self.note(&episode);
        Ok(())
    }

    /// Takes over how an episode of this session stands.
    fn note(&mut self, now: &Episode) -> bool {
        match self.episodes.iter_mut().find(|e| e.number == now.number) {
            Some(episode) if *episode != *now => {
                *episode = now.clone();
                true
            }
            _ => false,
        }
    }

    /// Asks the daemon how the rig and the recording stand.
    ///
    /// # Errors
    /// When the rig or the recording has ended.
    pub fn look(&mut self) -> Result<Look> {
        let rig = self.client.status()?;
        let recording = self.recording(&rig)?;
        self.lost.now.clone_from(&recording.dropped);
        let running = self.last().filter(|e| e.is_open()).map(|e| e.number);
        if let (Some(ours), Some(other)) = (running, recording.episode.as_ref().map(|e| e.number))
            && ours < other
        {
            bail!("episode {ours} was ended by somebody else, and episode {other} begun");
        }
        let is_new = recording.episode.as_ref().is_some_and(|e| self.note(e));
        let ended = recording.episode.clone().filter(|e| running.is_some() && is_new && !e.is_open());
        Ok(Look { ended, troubles: self.troubles(&rig, recording) })
    }

    /// This session's recording, which goes on.
    fn recording<'a>(&mut self, rig: &'a RigStatus) -> Result<&'a RecordingStatus> {
        let Some(recording) = rig.recording.as_ref().filter(|r| r.path == self.path) else {
            bail!("the recording {} was ended by somebody else, and another one begun", self.path);
        };
        if recording.active && !recording.closing {
            return Ok(recording);
        }
        self.lost.now.clone_from(&recording.dropped);
        match &recording.error {
            Some(why) => bail!("the recording {} ended: {why}", self.path),
            None => bail!("the recording {} was ended by somebody else", self.path),
        }
    }

    fn troubles(&self, rig: &RigStatus, recording: &RecordingStatus) -> Vec<String> {
        let away = rig.cameras.iter().filter(|c| c.state != CameraState::Streaming);
        let cameras = away.map(|c| {
            let why = c.message.as_ref().map_or_else(String::new, |m| format!(": {m}"));
            format!("camera {} is {}{why}", c.name, c.state.name())
        });
        let lost = self.lost.now.values().sum::<u64>().saturating_sub(self.lost.at_begin);
        let is_running = self.last().is_some_and(Episode::is_open);
        let sets =
            (is_running && lost > 0).then(|| format!("this episode lost {}", crate::out::count(lost, "set")));
        cameras.chain(sets).chain(recording.warning.clone()).chain(recording.error.clone()).collect()
    }

    /// Ends the recording, unless it was joined or is over, and says how the session ended. An end that fails is the session's failure
    /// if there was none before.
    pub fn finish(mut self, wanted: u32, failure: Option<anyhow::Error>) -> (Summary, Option<anyhow::Error>) {
        let stopped = if self.is_joined { Ok(None) } else { self.stop() };
        let failure = match stopped {
            Err(e) => failure.or(Some(e)),
            Ok(status) => {
                failure.or_else(|| Some(anyhow!("the recording {} ended: {}", self.path, status?.error?)))
            }
        };
        let lost = self.lost.now.iter().map(|(why, n)| {
            (why.clone(), n.saturating_sub(self.lost.at_start.get(why).copied().unwrap_or(0)))
        });
        let summary = Summary {
            dataset: self.path,
            is_joined: self.is_joined,
            wanted,
            lost: lost.filter(|(_, n)| *n > 0).collect(),
            error: failure.as_ref().map(ToString::to_string),
            episodes: self.episodes,
        };
        (summary, failure)
    }

    /// Ends this session's recording; not one that somebody else has begun since.
    fn stop(&mut self) -> Result<Option<RecordingStatus>> {
        let is_ours = |status: &RecordingStatus| status.active && status.path == self.path;
        if !self.client.record_status()?.is_some_and(|status| is_ours(&status)) {
            return Ok(None);
        }
        let status = self.client.record_stop()?;
        self.lost.now.clone_from(&status.dropped);
        Ok(Some(status))
    }
}
