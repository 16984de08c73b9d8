//! Whether a segment is complete, and the facts that it records about itself.

use crate::container::scan::SegmentReader;
use crate::fs::Fs;
use crate::msgs::accounts;
use crate::msgs::frame_set::FrameSetMsg;
use crate::msgs::schemas::Schema;
use crate::recorder::topics::{SEGMENT_METADATA, SESSION_METADATA};
use crate::recovered::{RECOVERED_METADATA, sets_lost};
use crate::{Result, SetCounts};
use std::collections::BTreeMap;
use std::path::Path;

/// The facts that a complete segment records about itself.
#[derive(Debug, Clone, Default)]
pub(super) struct Facts {
    pub(super) bytes: u64,
    pub(super) sets: u64,
    pub(super) first_set: Option<u64>,
    pub(super) last_set: Option<u64>,
    pub(super) last_log_time: Option<u64>,
    /// Sets handed to the recorder, as the last mark says.
    pub(super) offered: u64,
    /// The last account of the sets.
    pub(super) counts: Option<SetCounts>,
    /// Whether the recording was closed with this segment.
    pub(super) last: bool,
    /// The error that ended the recording before its time.
    pub(super) error: Option<String>,
    /// Losses that recoveries found in it.
    pub(super) lost: Vec<String>,
    /// Sets that recoveries found lost in it, at most.
    pub(super) sets_lost: u64,
}

impl Facts {
    pub(super) fn set(&mut self, mark: &FrameSetMsg, log_time: u64) {
        self.sets += 1;
        self.first_set.get_or_insert(mark.id);
        self.last_set = Some(mark.id);
        self.last_log_time = Some(log_time);
        self.offered = mark.sets_offered;
    }

    pub(super) fn metadata(&mut self, facts: &BTreeMap<String, String>) {
        self.last = facts.get("final").is_some_and(|v| v == "true");
        self.error = facts.get("error").cloned();
    }

    pub(super) fn recovered(&mut self, facts: &BTreeMap<String, String>) {
        self.lost.extend(facts.get("lost").into_iter().flat_map(|l| l.lines()).map(str::to_owned));
        self.sets_lost = self.sets_lost.saturating_add(sets_lost(facts));
    }
}

/// The facts of a segment by its index; `None` if it is unfinished or its index is damaged.
pub(super) fn indexed(fs: &dyn Fs, path: &Path) -> Result<Option<Facts>> {
    let found = (|| {
        let mut reader = SegmentReader::open_bare(fs, path)?;
        reader.load_index()?;
        if !reader.finished || reader.metadata(SESSION_METADATA).is_none() {
            return Ok(None);
        }
        facts_of(&reader).map(Some)
    })();
    match found {
        Err(e) if e.is_damage() => Ok(None),
        found => found,
    }
}

/// The facts of a finished segment, from its index and its last few chunks.
fn facts_of(reader: &SegmentReader) -> Result<Facts> {
    let channel = |s: Schema| reader.channels.iter().find(|(_, c)| c.schema == s.name()).map(|(id, _)| *id);
    let mut facts = Facts { bytes: reader.size, ..Facts::default() };
    let marks = channel(Schema::FrameSet);
    let counts = channel(Schema::Accounts);
    let with =
        |id: Option<u16>| reader.chunks.iter().filter(move |c| id.is_some_and(|id| c.channels.contains(&id)));
    facts.sets = with(marks).count() as u64;
    for (entry, first) in
        with(marks).take(1).map(|c| (c, true)).chain(with(marks).next_back().map(|c| (c, false)))
    {
        reader.messages(entry, |m| {
            if Some(m.channel) == marks {
                let mark = FrameSetMsg::read(m.data)?;
                if first {
                    facts.first_set = Some(mark.id);
                }
                facts.last_set = Some(mark.id);
                facts.offered = mark.sets_offered;
                facts.last_log_time = Some(m.log_time);
            }
            Ok(())
        })?;
    }
    // An unreadable account counts as missing; `verify` reports it.
    for entry in with(counts).rev() {
        reader.messages(entry, |m| {
            if Some(m.channel) == counts
                && let Ok((said, _)) = accounts::read(m.data)
            {
                facts.counts = Some(said);
            }
            Ok(())
        })?;
        if facts.counts.is_some() {
            break;
        }
    }
    for (name, map) in &reader.metadata {
        match name.as_str() {
            SEGMENT_METADATA => facts.metadata(map),
            RECOVERED_METADATA => facts.recovered(map),
            _ => {}
        }
    }
    Ok(facts)
}
