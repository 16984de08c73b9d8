//! The samples of signals of one set.

use super::{Messages, Part, Single};
use crate::msgs::frame_set::FrameSetMsg;
use crate::msgs::signal::{SignalForm, read_samples};
use crate::verify::seen::Seen;
use crate::verify::sets::Walk;
use depthrig_bus::{SignalSample, StreamId};
use std::collections::BTreeMap;

/// Takes the samples of a set by its mark, which lies in the chunk at `offset`.
pub(in crate::verify) fn set(
    walk: &mut Walk,
    seen: &mut Seen<'_>,
    set: &FrameSetMsg,
    log_time: u64,
    offset: u64,
) {
    let Messages { parts, mut single } = std::mem::take(&mut seen.signals);
    let mut problems = Vec::new();
    let mut expected: BTreeMap<StreamId, Vec<Single>> = BTreeMap::new();
    let compares = walk.compares_singles;
    let mut message = Vec::new();
    let set_utc_ns = i64::try_from(log_time).unwrap_or(i64::MAX);
    for Part { signal: id, log_time: at, message: stored } in parts {
        // Its channels have that finding already.
        let Some(signal) = walk.signals.0.get_mut(&id) else { continue };
        if at != log_time {
            problems.push(format!("samples of {id} have another log time than their set"));
            continue;
        }
        let samples = match read_samples(&stored, &signal.record.description) {
            Ok(samples) => samples,
            Err(e) => {
                problems.push(format!("samples of {id} cannot be read: {e}"));
                continue;
            }
        };
        let utc = |s: &SignalSample| s.header().time_ns.saturating_add(set.utc_offset_ns);
        match samples.samples.last() {
            None => problems.push(format!("a message of {id} has no samples")),
            Some(newest) if utc(newest) != samples.stamp_utc_ns => {
                problems.push(format!("the stamp of samples of {id} is not the time of the newest"));
            }
            Some(_) => {}
        }
        let form = SignalForm::of(&signal.record.description);
        let single = samples.samples.iter().map(|sample| {
            message.clear();
            if compares {
                form.write(&mut message, sample, set.utc_offset_ns);
            }
            let publish_time = u64::try_from(utc(sample)).unwrap_or(0);
            Single { publish_time, crc32: crc32fast::hash(&message) }
        });
        expected.entry(id.clone()).or_default().extend(single);
        let found = signal.follow(&samples.samples, set_utc_ns, &walk.removed);
        problems.extend(found.into_iter().map(|what| format!("signal {id}: {what}")));
    }
    for (id, expected) in expected {
        let got = single.remove(&id).unwrap_or_default();
        if got.len() != expected.len() {
            problems.push(format!("{id} has {} samples, {} single ones", expected.len(), got.len()));
        } else if compares && let Some(at) = got.iter().zip(&expected).position(|(a, b)| a != b) {
            problems.push(format!("single sample {} of {id} differs from its values", at + 1));
        }
    }
    for (id, got) in single {
        problems.push(format!("{} single samples of {id} belong to no samples", got.len()));
    }
    for problem in problems {
        seen.broken(Some(offset), format!("set {}: {problem}", set.id));
    }
}
