//! The IMU batches of one set.

use super::{Messages, Single, Waiting};
use crate::msgs::frame_set::FrameSetMsg;
use crate::msgs::motion::Imu;
use crate::recorder::topics::check_batch;
use crate::verify::seen::Seen;
use crate::verify::sets::Walk;
use depthrig_bus::StreamId;
use std::collections::BTreeMap;

/// Takes the IMU batches of a set by its mark, which lies in the chunk at `offset`.
pub(in crate::verify) fn set(
    walk: &mut Walk,
    seen: &mut Seen<'_>,
    set: &FrameSetMsg,
    log_time: u64,
    offset: u64,
) {
    let Messages { batches, stray, mut single } = std::mem::take(&mut seen.motion);
    let mut problems = Vec::new();
    for (unit, n) in stray {
        problems.push(format!("{n} batches of {unit} have no frame_info"));
    }
    let mut expected: BTreeMap<StreamId, Vec<Imu>> = BTreeMap::new();
    let set_utc_ns = i64::try_from(log_time).unwrap_or(i64::MAX);
    for batch in batches {
        let Waiting { unit: id, log_time: at, header, stamp_utc_ns, is_named, samples } = batch;
        let mut say = |what: &str| problems.push(format!("batch {} of {id}: {what}", header.sequence));
        if at != log_time {
            say("it has another log time than its set");
            continue;
        }
        if !is_named {
            say("its frame_info names another frame or codec than an IMU's");
        }
        if header.set_id != set.id {
            say("its frame_info is of another set");
        }
        let stamp = header.capture_time_ns.saturating_add(set.utc_offset_ns);
        if stamp_utc_ns != stamp || samples.as_ref().is_some_and(|s| s.stamp_utc_ns != stamp) {
            say("its stamp is not its time");
        }
        if let Some(what) = walk.header(&id, &header) {
            say(&what);
        }
        let Some(samples) = samples else {
            say("it has no samples");
            continue;
        };
        // Its channels have that finding already.
        let Some(unit) = walk.units.0.get_mut(&id) else { continue };
        if samples.sequence != header.sequence {
            say(&format!("its samples are those of batch {}", samples.sequence));
        }
        if let Err(what) = check_batch(&header, samples.samples.len(), unit.most) {
            say(&what);
        }
        let single = samples.samples.iter().map(|s| Imu::of(s, set.utc_offset_ns));
        expected.entry(id.clone()).or_default().extend(single);
        let found = unit.follow(&header, samples, set_utc_ns, &walk.removed);
        for what in &found {
            say(what);
        }
    }
    for (id, expected) in expected {
        let got = single.remove(&id).unwrap_or_default();
        problems.extend(differing(&id, &expected, &got, walk.compares_singles));
    }
    for (id, got) in single {
        problems.push(format!("{} single samples of {id} belong to no batch", got.count));
    }
    for problem in problems {
        seen.broken(Some(offset), format!("set {}: {problem}", set.id));
    }
}

/// Compares the single samples of an IMU in a set with its batches; the first difference in words.
fn differing(id: &StreamId, expected: &[Imu], got: &Single, decode: bool) -> Option<String> {
    if got.count != expected.len() as u64 {
        return Some(format!(
            "{id} has {} samples in its batches, {} single ones",
            expected.len(),
            got.count
        ));
    }
    if !decode {
        return None;
    }
    let frame_id = crate::msgs::tf::unit_frame(id);
    if got.frames_differ || got.frame_id != frame_id {
        return Some(format!("a single sample of {id} is of another frame than {frame_id}"));
    }
    let mut pairs = expected.iter().zip(&got.values);
    let at = pairs.position(|(e, (g, time))| {
        let same_time =
            e.stamp_utc_ns == g.stamp_utc_ns && u64::try_from(e.stamp_utc_ns).unwrap_or(0) == *time;
        !(same_time && e.same_values(g))
    });
    at.map(|at| format!("single sample {} of {id} differs from its batch", at + 1))
}
