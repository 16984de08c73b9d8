//! Reads the finished segments of a recording whose recorder was killed.

use super::RESERVE_FILE;
use super::topics::{SEGMENT_METADATA, SampleNumber};
use crate::dataset::{Dataset, PixelMode, SetRange, segment_number};
use crate::fs::Fs;
use crate::session::SESSION_TMP;
use crate::{Error, ErrorKind, Result, Session};
use depthrig_bus::{HostTime, UtcPair};
use std::path::Path;
use std::sync::Arc;

/// The part of a recording that was there when it was resumed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Resumed {
    /// Sets in the finished segments.
    pub sets: u64,
    /// Their frames.
    pub frames: u64,
    /// Id of the last of them; the next set must have a greater one.
    pub last_set: Option<u64>,
}

/// The same as the recorder needs it.
pub(super) struct Past {
    pub(super) session: Session,
    /// Finished segments.
    pub(super) segments: u32,
    pub(super) sets: u64,
    pub(super) frames: u64,
    pub(super) bytes: u64,
    pub(super) last_id: Option<u64>,
    /// Number of the last batch of each IMU.
    pub(super) last_batches: Vec<Option<u64>>,
    /// The last sample of each signal.
    pub(super) last_samples: Vec<Option<SampleNumber>>,
    pub(super) anchor: Option<UtcPair>,
    pub(super) last_log_time: i64,
    pub(super) first_tick: Option<HostTime>,
    pub(super) last_tick: Option<HostTime>,
}

impl Past {
    /// The empty past of a new dataset.
    pub(super) fn new(session: Session) -> Self {
        Self {
            last_batches: vec![None; session.motion.len()],
            last_samples: vec![None; session.signals.len()],
            session,
            segments: 0,
            sets: 0,
            frames: 0,
            bytes: 0,
            last_id: None,
            anchor: None,
            last_log_time: i64::MIN,
            first_tick: None,
            last_tick: None,
        }
    }

    fn read(&mut self, dataset: &Dataset) -> Result<()> {
        for set in dataset.sets_with(SetRange::ALL, PixelMode::None) {
            let set = set?;
            self.sets += 1;
            self.frames += set.frames.len() as u64;
            self.last_id = Some(set.id);
            for batch in &set.motion {
                self.last_batches[batch.unit] = Some(batch.header.sequence);
            }
            for part in &set.signals {
                let last = part.samples.last().map(|s| (s.header().session, s.header().sequence));
                self.last_samples[part.signal] = last.or(self.last_samples[part.signal]);
            }
            self.last_log_time = set.utc_ns;
            let offset = set.tick.ns().saturating_add(set.utc_offset_ns);
            self.anchor.get_or_insert(UtcPair { mono: set.tick, utc_ns: offset, width_ns: 0 });
            self.first_tick.get_or_insert(set.tick);
            self.last_tick = Some(set.tick);
        }
        Ok(())
    }

    pub(super) const fn resumed(&self) -> Resumed {
        Resumed { sets: self.sets, frames: self.frames, last_set: self.last_id }
    }
}

/// Removes unfinished files of a killed recorder from `dir` and reads the finished segments, without images.
pub(super) fn past(fs: &Arc<dyn Fs>, dir: &Path) -> Result<Past> {
    let session = Session::load(&**fs, dir)?;
    if session.outcome.is_some() {
        let message = format!("{} is already complete; nothing can be recorded into it", dir.display());
        return Err(Error::new(ErrorKind::AlreadyExists, message));
    }
    let entries = fs.read_dir(dir).map_err(|e| Error::reading("read the folder", dir, e))?;
    let mut numbers = Vec::new();
    let mut bytes = 0;
    for entry in entries {
        let number = segment_number(&entry.name);
        let unfinished = number.is_some() && Path::new(&entry.name).extension().is_some_and(|e| e == "part");
        if unfinished || entry.name == RESERVE_FILE || entry.name == SESSION_TMP {
            let path = dir.join(&entry.name);
            fs.remove_file(&path).map_err(|e| Error::io("remove", &path, e))?;
        } else if let Some(number) = number {
            numbers.push(number);
            bytes += entry.len;
        }
    }
    numbers.sort_unstable();
    if let Some(missing) = (0u32..).zip(&numbers).find(|(i, n)| i != *n).map(|(i, _)| i) {
        return Err(Error::new(
            ErrorKind::Corrupt,
            format!("{} has no segment number {missing}, but later ones; start over", dir.display()),
        ));
    }
    let mut past = Past { segments: numbers.len() as u32, bytes, ..Past::new(session) };
    if numbers.is_empty() {
        return Ok(past);
    }
    let dataset = loop {
        let dataset = Dataset::open_with(Arc::clone(fs), dir)?;
        // A recording that ended because the disk was full or failed closed its last segment and counted there what it
        // could not write: that is recorded again.
        let Some(last) = dataset.segments().last().filter(|_| loses(&dataset)) else { break dataset };
        let size = fs.open(last).and_then(|f| f.size()).unwrap_or(0);
        fs.remove_file(last).map_err(|e| Error::io("remove", last, e))?;
        past.segments -= 1;
        past.bytes -= size.min(past.bytes);
        if past.segments == 0 {
            return Ok(past);
        }
    };
    past.read(&dataset)?;
    Ok(past)
}

/// Reads all segments of a dataset, without images; its session is then that of an unfinished one.
pub(super) fn all(fs: &Arc<dyn Fs>, dir: &Path) -> Result<Past> {
    let dataset = Dataset::open_with(Arc::clone(fs), dir)?;
    let session = Session { outcome: None, ..Session::load(&**fs, dir)? };
    let mut past = Past { segments: dataset.segments().len() as u32, ..Past::new(session) };
    for path in dataset.segments() {
        if path.extension().is_some_and(|e| e == "part") {
            let message =
                format!("{} was not finished; run: depthrig recover {}", path.display(), dir.display());
            return Err(Error::new(ErrorKind::Truncated, message));
        }
        past.bytes += fs.open(path).and_then(|f| f.size()).unwrap_or(0);
    }
    past.read(&dataset)?;
    Ok(past)
}

/// Whether the last segment records sets as dropped.
fn loses(dataset: &Dataset) -> bool {
    let last = dataset.segments().len().checked_sub(1).and_then(|n| dataset.open_segment(n));
    let Some(Ok(last)) = last else { return false };
    last.metadata(SEGMENT_METADATA).is_some_and(|facts| facts.keys().any(|k| k.starts_with("sets_dropped_")))
}
