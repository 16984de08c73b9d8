//! The losses of a recovery, in numbers and in words.

use super::{LostBytes, RecoveredSegment};
use crate::container::copy::{Damage, DamageKind};
use depthrig_bus::UtcPair;
use std::collections::BTreeMap;

/// Everything that is not in the copy.
#[derive(Debug, Default)]
pub(super) struct Lost {
    pub(super) bytes: u64,
    pub(super) damage: Vec<Damage>,
    pub(super) missing: Vec<(u64, u64)>,
    /// Sets that the accounts count beyond those that are there, at most.
    pub(super) uncounted: u64,
    /// Whether the file has lost something after its last set.
    pub(super) at_end: bool,
    pub(super) head_rebuilt: bool,
    pub(super) file: String,
}

impl Lost {
    fn tail_bytes(&self) -> u64 {
        self.damage.iter().filter(|d| d.kind == DamageKind::Tail).map(|d| d.to - d.from).sum()
    }

    fn torn_sets(&self) -> u64 {
        self.damage.iter().filter(|d| d.kind == DamageKind::Torn).count() as u64
    }

    /// Sets of which the ids are known.
    fn named(&self) -> u64 {
        self.missing.iter().map(|(a, b)| b - a + 1).sum()
    }

    pub(super) fn sets(&self) -> u64 {
        self.named().max(self.uncounted)
    }

    pub(super) fn words(&self) -> Vec<String> {
        let mut words = Vec::new();
        let file = &self.file;
        if self.head_rebuilt {
            words.push(format!("{file}: its head was damaged and was rebuilt from the session"));
        }
        for d in &self.damage {
            let n = d.to - d.from;
            let why = &d.why;
            words.push(match d.kind {
                DamageKind::Tail => format!("{file}: its last {n} bytes are an incomplete record"),
                DamageKind::Torn => format!("{file}: {n} bytes from byte {} are {why}", d.from),
                DamageKind::Empty => format!("{file}: {why}"),
                DamageKind::Bytes => format!("{file}: {n} bytes from byte {} are damaged: {why}", d.from),
            });
        }
        for (first, last) in &self.missing {
            let n = last - first + 1;
            words.push(match n {
                1 => format!("{file}: set {first} is lost"),
                _ => format!("{file}: sets {first} to {last} are lost, {n} of them at most"),
            });
        }
        match (self.sets() - self.named(), self.named()) {
            (0, _) => {}
            (n, 0) => words.push(format!("{file}: {n} sets are lost, as the recording counted")),
            (n, _) => words.push(format!("{file}: {n} sets more are lost, as the recording counted")),
        }
        // One line each, even with a damaged name quoted: they are compared after being written and read.
        for line in &mut words {
            *line = line.replace(|c: char| c.is_control(), "?");
        }
        words
    }

    pub(super) fn fill_in(&self, segment: &mut RecoveredSegment) {
        segment.bytes = self.bytes;
        segment.tail_bytes = self.tail_bytes();
        segment.torn_sets = self.torn_sets();
        segment.lost_bytes =
            self.damage.iter().map(|d| LostBytes { from: d.from, to: d.to, why: d.why.clone() }).collect();
        segment.sets_missing.clone_from(&self.missing);
        segment.sets_lost = self.sets();
        segment.lost = self.words();
    }

    pub(super) fn metadata(&self) -> BTreeMap<String, String> {
        let list = |parts: Vec<String>| parts.join(" ");
        let bytes = |d: &Damage| format!("{}-{}", d.from, d.to);
        let ids = |(a, b): &(u64, u64)| if a == b { a.to_string() } else { format!("{a}-{b}") };
        let damaged = self.damage.iter().filter(|d| d.kind != DamageKind::Tail).map(bytes).collect();
        [
            ("when_utc_ns", UtcPair::sample().utc_ns.to_string()),
            ("depthrig_version", env!("CARGO_PKG_VERSION").to_owned()),
            ("file", self.file.clone()),
            ("file_bytes", self.bytes.to_string()),
            ("tail_bytes", self.tail_bytes().to_string()),
            ("torn_sets", self.torn_sets().to_string()),
            ("damaged", list(damaged)),
            ("sets_missing", list(self.missing.iter().map(ids).collect())),
            ("sets_lost", self.sets().to_string()),
            ("lost", self.words().join("\n")),
        ]
        .map(|(k, v)| (k.to_owned(), v))
        .into()
    }
}
