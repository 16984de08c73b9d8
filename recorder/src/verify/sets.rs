//! Checks that span segments: the order of sets, the accounts, and the frame headers of each stream.

use super::images::{Images, Job};
use super::motion::Units;
use super::seen::{Image, MESSAGE_HEAD, Proof, Seen};
use super::signals::Signals;
use super::{Findings, Severity, VerifyOptions};
use crate::clock::step_ns;
use crate::container::record::{op, put_le};
use crate::dataset::Removed;
use crate::encode::Codec;
use crate::msgs::frame_info::Extra;
use crate::msgs::frame_set::{FrameSetMsg, Member};
use crate::msgs::{accounts, frame_info};
use crate::{Result, Session, StreamAccount};
use depthrig_bus::{FrameFlags, FrameHeader, StreamId, UtcPair};
use std::collections::{BTreeMap, BTreeSet};

/// A reading of the clocks lies within this of the recorded time that it was written at, nanoseconds: a writer that
/// waits for its disk is behind.
const CLOCK_AROUND_NS: i64 = 60_000_000_000;

/// State kept from segment to segment.
#[derive(Clone)]
pub(super) struct Walk {
    pub(super) options: VerifyOptions,
    max_spread_ns: Option<i64>,
    streams: BTreeSet<String>,
    pub(super) sets: u64,
    pub(super) frames: u64,
    pub(super) bytes: u64,
    last: Option<Last>,
    /// Whether the segments before the first one are not checked: accounts count their sets.
    pub(super) lone: bool,
    /// Whether single samples of IMUs are compared with their batches.
    pub(super) compares_singles: bool,
    /// Sets counted by the accounts minus those seen, fixed at the first account of a lone segment.
    account_base: Option<u64>,
    /// Sets that recoveries say they lost at most; the accounts, which are older, count them.
    pub(super) lost: u64,
    dropped: Option<crate::SetCounts>,
    accounts: BTreeMap<StreamId, StreamAccount>,
    /// Captured and lost frames, by the last frame of each stream.
    frame_accounts: BTreeMap<StreamId, FrameAccount>,
    pub(super) units: Units,
    pub(super) signals: Signals,
    pub(super) removed: Removed,
    /// The first and the last reading of the host's clocks.
    clocks: Option<(UtcPair, UtcPair)>,
}

/// The set before.
#[derive(Clone)]
struct Last {
    id: u64,
    log_time: u64,
    tick_ns: i64,
}

/// A frame's own account.
#[derive(Clone, Copy)]
struct FrameAccount {
    sequence: u64,
    captured: u64,
    dropped: [u64; 8],
}

impl Walk {
    pub(super) fn new(session: &Session, options: VerifyOptions) -> Self {
        Self {
            options,
            max_spread_ns: options.max_spread_ns.or(session.max_spread_ns),
            streams: session.streams.iter().map(|s| s.id.to_string()).collect(),
            sets: 0,
            frames: 0,
            bytes: 0,
            last: None,
            lone: false,
            compares_singles: options.decode,
            account_base: None,
            lost: 0,
            dropped: None,
            accounts: BTreeMap::new(),
            frame_accounts: BTreeMap::new(),
            units: Units::new(session),
            signals: Signals::new(session),
            removed: Removed::of(session),
            clocks: None,
        }
    }

    /// Takes a set by its mark, which lies in the chunk at `offset`.
    pub(super) fn set(
        &mut self,
        seen: &mut Seen<'_>,
        set: &FrameSetMsg,
        log_time: u64,
        offset: u64,
        images: &mut Images<'_>,
    ) {
        let mut problems = self.order(set, log_time);
        let mut named: BTreeSet<&str> = set.missing.iter().map(String::as_str).collect();
        if named.len() != set.missing.len() {
            problems.push("a stream is missing twice".to_owned());
        }
        let mut captures = Vec::new();
        for member in &set.members {
            let name = &member.stream;
            if !named.insert(name) {
                problems.push(format!("{name} is in it twice"));
            }
            captures.push(member.capture_time_ns);
            let Ok(id) = name.parse::<StreamId>() else {
                problems.push(format!("invalid stream \"{name}\""));
                continue;
            };
            self.member(seen, set, member, &id, log_time, images, &mut problems);
        }
        let spread =
            captures.iter().max().zip(captures.iter().min()).map_or(0, |(a, b)| a.saturating_sub(*b));
        if spread != set.spread_ns {
            problems.push(format!("its frames are {spread} ns apart, it says {}", set.spread_ns));
        }
        for stream in &self.streams {
            if !named.contains(stream.as_str()) {
                problems.push(format!("{stream} is neither in it nor marked missing"));
            }
        }
        if let Some(stranger) = named.iter().find(|n| !self.streams.contains(**n)) {
            problems.push(format!("{stranger} is not in the session"));
        }
        self.sets += 1;
        self.frames += set.members.len() as u64;
        for problem in problems {
            seen.broken(Some(offset), format!("set {}: {problem}", set.id));
        }
        if let Some(max) = self.max_spread_ns.filter(|max| spread.max(set.spread_ns) > *max) {
            let what = format!("set {}: its frames are {spread} ns apart, {max} is the limit", set.id);
            seen.findings.add(Severity::Lost, &seen.file, Some(offset), what);
        }
    }

    /// Checks the place of a set among the others; the problems in words.
    fn order(&mut self, set: &FrameSetMsg, log_time: u64) -> Vec<String> {
        let mut problems = Vec::new();
        if let Some(last) = &self.last {
            if set.id <= last.id {
                problems.push(format!("it follows set {}", last.id));
            }
            if log_time <= last.log_time {
                problems.push("its log time is not later than that of the set before".to_owned());
            }
            if set.tick_ns <= last.tick_ns {
                problems.push("its tick is not later than that of the set before".to_owned());
            }
        }
        self.last = Some(Last { id: set.id, log_time, tick_ns: set.tick_ns });
        problems
    }

    #[allow(clippy::too_many_arguments)] // one call; a struct of them would be named once and never again
    fn member(
        &mut self,
        seen: &Seen<'_>,
        set: &FrameSetMsg,
        member: &Member,
        id: &StreamId,
        log_time: u64,
        images: &mut Images<'_>,
        problems: &mut Vec<String>,
    ) {
        let name = &member.stream;
        if !seen.calibrated.contains(id) {
            problems.push(format!("{name} has no camera_info"));
        }
        let info = seen.infos.get(id).filter(|(t, _)| *t == log_time).map(|(_, m)| frame_info::read(m));
        let info = match info {
            None => {
                problems.push(format!("{name} has no frame_info"));
                None
            }
            Some(Err(e)) => {
                problems.push(format!("{name}: {e}"));
                None
            }
            Some(Ok((h, extra))) => {
                let same = h.sequence == member.sequence
                    && h.capture_time_ns == member.capture_time_ns
                    && h.set_id == set.id;
                if !same {
                    problems.push(format!("{name}: its frame_info is that of another frame"));
                }
                problems.extend(self.header(id, &h).map(|what| format!("{name}: {what}")));
                Some((h, extra))
            }
        };
        let Some(image) = seen.images.get(id).filter(|p| p.log_time == log_time) else {
            problems.push(format!("{name} has no image"));
            return;
        };
        let same = image.len == member.message_bytes
            && match image.proof {
                Proof::Crc(crc) => crc == member.message_crc32,
                // The rest is checked when it is unpacked.
                Proof::Packed(_) => true,
            };
        if !same {
            problems.push(format!("{name}: its image is another one"));
            return;
        }
        let decode = match &info {
            Some((h, extra)) if self.options.decode => {
                let codec = Codec::from_name(extra.codec);
                if codec.is_none() {
                    problems.push(format!("{name}: unknown codec {}", extra.codec));
                }
                codec.map(|codec| (codec, Box::new(*h)))
            }
            _ => None,
        };
        let unseen = match image.proof {
            Proof::Crc(_) => false,
            Proof::Packed(crc) => {
                image.offset >= seen.unproven
                    || info.as_ref().is_none_or(|(_, extra)| expected(image, member, extra) != crc)
            }
        };
        if unseen || decode.is_some() {
            images.look_into(Job {
                offset: image.offset,
                channel: image.channel,
                log_time,
                len: member.message_bytes,
                crc: member.message_crc32,
                set: set.id,
                stream: name.clone(),
                decode,
            });
        }
    }

    /// Checks the account in a frame's header: `captured = sequence + Σ dropped`, and no number decreases.
    pub(super) fn header(&mut self, id: &StreamId, h: &FrameHeader) -> Option<String> {
        let now = FrameAccount { sequence: h.sequence, captured: h.captured, dropped: h.dropped };
        let lost = h.dropped.iter().fold(0u64, |sum, n| sum.saturating_add(*n));
        let before = self.frame_accounts.insert(id.clone(), now);
        if h.captured != h.sequence.saturating_add(lost) {
            let captured = h.captured;
            let sequence = h.sequence;
            return Some(format!(
                "its header does not balance: {captured} captured, {sequence} delivered, {lost} dropped"
            ));
        }
        // A recorded replay may begin again at any frame.
        let before = before.filter(|_| h.flags & FrameFlags::REPLAYED.0 == 0)?;
        let fell = h.sequence <= before.sequence
            || h.captured <= before.captured
            || h.dropped.iter().zip(&before.dropped).any(|(now, before)| now < before);
        fell.then(|| "the account in its header goes backwards".to_owned())
    }

    /// Takes a reading of the host's clocks from the chunk at `offset`.
    pub(super) fn clock(&mut self, seen: &mut Seen<'_>, pair: UtcPair, log_time: u64, offset: u64) {
        let (first, last) = self.clocks.get_or_insert((pair, pair));
        let passed_ns = pair.mono.since_ns(first.mono);
        let log_time = i64::try_from(log_time).unwrap_or(i64::MAX);
        let behind_ns = first.utc_ns.saturating_add(passed_ns).saturating_sub(log_time);
        // Each segment begins with the first reading again; and a derived dataset may have readings of the computer
        // that derived it, of another time.
        if pair.mono <= last.mono || behind_ns.saturating_abs() > CLOCK_AROUND_NS {
            return;
        }
        let before = std::mem::replace(last, pair);
        if let Some(by_ns) = step_ns(&before, &pair) {
            let what = format!(
                "the wall clock was set by {:+.1} ms, seen {:.1} s after its first reading; the recorded times do not \
                 jump",
                by_ns as f64 / 1e6,
                passed_ns as f64 / 1e9
            );
            seen.findings.add(Severity::Note, &seen.file, Some(offset), what);
        }
    }

    /// Takes an account from the chunk at `offset`.
    pub(super) fn account(&mut self, seen: &mut Seen<'_>, message: &[u8], offset: u64) -> Result<()> {
        let (sets, streams) = accounts::read(message)?;
        if !sets.balances() {
            let what = format!(
                "the account of sets does not balance: {} offered, {} recorded, {} dropped",
                sets.offered,
                sets.recorded,
                sets.dropped_total()
            );
            seen.broken(Some(offset), what);
        }
        // A segment on its own begins in the middle of the account.
        let first_is_zero =
            !self.lone && self.last.as_ref().is_none_or(|_| seen.file.starts_with("seg_0000."));
        let base = *self
            .account_base
            .get_or_insert_with(|| if first_is_zero { 0 } else { sets.recorded.saturating_sub(self.sets) });
        let there = base.saturating_add(self.sets);
        if !(there..=there.saturating_add(self.lost)).contains(&sets.recorded) {
            let what = format!("the account says {} sets were recorded, {there} are there", sets.recorded);
            seen.broken(Some(offset), what);
        }
        let fell = |b: &crate::SetCounts| {
            sets.offered < b.offered || sets.dropped.iter().zip(&b.dropped).any(|(now, before)| now < before)
        };
        if self.dropped.as_ref().is_some_and(fell) {
            seen.broken(Some(offset), "the account of sets goes backwards");
        }
        self.dropped = Some(sets);
        for a in streams {
            if !a.balances() {
                let what = format!(
                    "the account of {} does not balance: {} captured, {} delivered, {} dropped",
                    a.stream,
                    a.captured,
                    a.delivered,
                    a.dropped.total()
                );
                seen.broken(Some(offset), what);
            }
            let fell = |b: &StreamAccount| a.captured < b.captured || a.delivered < b.delivered;
            if self.accounts.get(&a.stream).is_some_and(fell) {
                seen.broken(Some(offset), format!("the account of {} goes backwards", a.stream));
            }
            self.accounts.insert(a.stream.clone(), a);
        }
        Ok(())
    }

    /// Checks the totals against the outcome in the session.
    pub(super) fn finish(&self, whole: Option<&Session>, findings: &mut Findings) {
        for (reason, n) in self.dropped.iter().flat_map(crate::SetCounts::dropped_by_reason) {
            let what = format!("{n} sets were not recorded: {}", reason.name());
            findings.add(Severity::Lost, "accounts", None, what);
        }
        for a in self.accounts.values().filter(|a| a.dropped.total() > 0) {
            let reasons: Vec<_> = a.dropped.nonzero().map(|(r, n)| format!("{n} {}", r.name())).collect();
            let items = if self.signals.has(&a.stream) { "samples" } else { "frames" };
            let what = format!(
                "{} of {} {items} of {} were lost live: {}",
                a.dropped.total(),
                a.captured,
                a.stream,
                reasons.join(", ")
            );
            findings.add(Severity::Note, "accounts", None, what);
        }
        self.units.finish(findings);
        self.signals.finish(self.last.as_ref().map(|last| last.tick_ns), findings);
        let Some(session) = whole else { return };
        let file = crate::SESSION_FILE;
        let Some(o) = &session.outcome else {
            findings.add(Severity::Broken, file, None, "the recording was not closed: no outcome is there");
            return;
        };
        if o.sets_recorded != self.sets {
            let what = format!("it says {} sets were recorded, {} are there", o.sets_recorded, self.sets);
            findings.add(Severity::Broken, file, None, what);
        }
        for lost in session.import_losses() {
            findings.add(Severity::Lost, file, None, lost);
        }
        // Losses that its segments record themselves were reported at their place.
        let said: BTreeSet<String> = findings.kept.iter().map(|f| f.message.clone()).collect();
        for lost in o.lost.iter().filter(|l| !said.contains(*l)) {
            findings.add(Severity::Lost, file, None, lost.clone());
        }
    }
}

/// The CRC-32 that the message record of this image must have, by its set's mark and its frame's information.
fn expected(image: &Image, member: &Member, extra: &Extra<'_>) -> u32 {
    let mut head = Vec::with_capacity(MESSAGE_HEAD as usize);
    head.push(op::MESSAGE);
    put_le!(head, member.message_bytes + MESSAGE_HEAD - crate::container::scan::HEAD, image.channel);
    put_le!(head, member.sequence as u32, image.log_time, u64::try_from(extra.stamp_utc_ns).unwrap_or(0));
    let mut crc = crc32fast::Hasher::new();
    crc.update(&head);
    crc.combine(&crc32fast::Hasher::new_with_initial_len(member.message_crc32, member.message_bytes));
    crc.finalize()
}
