//! A sample between two samples: floats on a straight line, rotations on the shortest arc, everything else as it was.

use super::description::{SignalDescription, SignalKind};
use super::field::FieldType;
use super::header::{SignalFlags, SignalHeader};
use super::sample::SignalSample;
use crate::{HostTime, Result};

/// Above this cosine of half the angle between two rotations the arc is a straight line within 1e-6 of its length.
const NEARLY_EQUAL: f64 = 0.999_999;

/// The sample at `time`, which is after that of `before` and before that of `after`. Header and description are those of
/// `before`, with the time, the larger uncertainty, and the flags of both.
///
/// # Errors
/// As [`SignalSample::new`].
pub(super) fn between(before: &SignalSample, after: &SignalSample, time: HostTime) -> Result<SignalSample> {
    let length = after.time().since_ns(before.time());
    let share = time.since_ns(before.time()) as f64 / length as f64;
    let mut values = before.bytes().to_vec();
    let description = before.description();
    for (index, field) in description.all_fields().iter().enumerate() {
        let start = description.offset(index).unwrap_or_default();
        let end = start + field.kind.bytes() * field.count as usize;
        if let (true, Some(out), Some(from), Some(to)) = (
            field.kind.is_float(),
            values.get_mut(start..end),
            before.bytes().get(start..end),
            after.bytes().get(start..end),
        ) {
            floats(field.kind, out, from, to, share);
        }
    }
    if description.kind() == SignalKind::Pose {
        rotation(description, &mut values, before, after, share);
    }
    let [first, second] = [before.header(), after.header()];
    let header = SignalHeader {
        time_ns: time.ns(),
        uncertainty_ns: first.uncertainty_ns.max(second.uncertainty_ns),
        flags: first.flags | second.flags | SignalFlags::INTERPOLATED.0,
        ..*first
    };
    SignalSample::new(header, description, values)
}

fn floats(kind: FieldType, out: &mut [u8], from: &[u8], to: &[u8], share: f64) {
    if kind == FieldType::F64 {
        let pairs = from.as_chunks().0.iter().zip(to.as_chunks().0);
        for (out, (from, to)) in out.as_chunks_mut().0.iter_mut().zip(pairs) {
            *out = linear(f64::from_le_bytes(*from), f64::from_le_bytes(*to), share).to_le_bytes();
        }
    } else {
        let pairs = from.as_chunks().0.iter().zip(to.as_chunks().0);
        for (out, (from, to)) in out.as_chunks_mut().0.iter_mut().zip(pairs) {
            let value =
                linear(f64::from(f32::from_le_bytes(*from)), f64::from(f32::from_le_bytes(*to)), share);
            *out = (value as f32).to_le_bytes();
        }
    }
}

/// The point `share` of the way from `from` to `to`.
fn linear(from: f64, to: f64, share: f64) -> f64 {
    // Equal ones also where a difference would be NaN, as of two infinities.
    if from == to { from } else { (1.0 - share) * from + share * to }
}

fn rotation(
    description: &SignalDescription,
    values: &mut [u8],
    before: &SignalSample,
    after: &SignalSample,
    share: f64,
) {
    let Some((index, _)) = description.field("rotation_xyzw") else { return };
    let at = description.offset(index).unwrap_or_default();
    let read = |bytes: &[u8]| -> [f64; 4] {
        let numbers = bytes.get(at..).unwrap_or_default().as_chunks().0;
        core::array::from_fn(|i| numbers.get(i).map_or(f64::NAN, |n| f64::from_le_bytes(*n)))
    };
    let arc = slerp(read(before.bytes()), read(after.bytes()), share);
    for (out, part) in values.get_mut(at..).unwrap_or_default().as_chunks_mut().0.iter_mut().zip(arc) {
        *out = part.to_le_bytes();
    }
}

/// The rotation `share` of the way from `from` to `to` on the shorter arc (Shoemake, Animating Rotation with Quaternion
/// Curves, 1985), as a unit quaternion x, y, z, w. NaN when one of them has no length.
pub(super) fn slerp(from: [f64; 4], to: [f64; 4], share: f64) -> [f64; 4] {
    let from = unit(from);
    let to = unit(to);
    let dot: f64 = from.iter().zip(to).map(|(a, b)| a * b).sum();
    // A quaternion and its negative are one rotation.
    let sign = if dot < 0.0 { -1.0 } else { 1.0 };
    let cosine = dot.abs();
    let [a, b] = if cosine > NEARLY_EQUAL {
        [1.0 - share, share]
    } else {
        let angle = cosine.acos();
        [((1.0 - share) * angle).sin() / angle.sin(), (share * angle).sin() / angle.sin()]
    };
    unit(core::array::from_fn(|i| a * from[i] + sign * b * to[i]))
}

fn unit(q: [f64; 4]) -> [f64; 4] {
    let length = q.iter().map(|x| x * x).sum::<f64>().sqrt();
    q.map(|x| x / length)
}

#[cfg(test)]
mod tests;
