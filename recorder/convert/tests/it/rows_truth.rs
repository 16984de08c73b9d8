//! State in an export against the truth: the simulated arm's joints, published at random rates with random gaps, at random times of sets.

use crate::support::*;
use core::ops::{ControlFlow, Range};
use depthrig_bus::{HostTime, SignalDescription, SignalHeader, SignalName, SignalSample};
use depthrig_convert::{ExportOptions, Gaps, RowOptions, VectorOptions, Zarr, export};
use depthrig_recorder::fs::MemFs;
use depthrig_recorder::{RecordSignal, Recorder, Session, SignalRecord};
use depthrig_sim::synthetic::arm::{Arm, JOINTS};
use proptest::prelude::*;
use std::path::Path;
use std::sync::Arc;

/// The arm goes from end to end in so long, and turns there: its joints have a kink.
const WAY_NS: i64 = 11_000_000_000 / 6;
/// Sets of so long at an end may be left out.
const SECOND_NS: i64 = 1_000_000_000;
/// The truth is computed in 32-bit floats, as the export is.
const ROUNDING: f64 = 3e-6;

fn joints_at(ns: i64) -> [f64; 4] {
    Arm::at(HostTime::from_ns(ns)).joints_rad
}

/// The largest second derivative of each joint within `span`, which the arm passes without a turn, rad/s².
fn curvature(span: &Range<i64>) -> [f64; 4] {
    // Wide enough for 32-bit floats: the joints change slowly.
    let step_ns = 20_000_000;
    let [first, last] = [span.start, span.end].map(|t| t / WAY_NS * WAY_NS);
    let mut most = [0.0_f64; 4];
    for i in 0..=50 {
        let middle = span.start + (span.end - span.start) * i / 50;
        let middle = middle.clamp(first + step_ns, last + WAY_NS - step_ns);
        let around = [middle - step_ns, middle, middle + step_ns].map(joints_at);
        for (joint, most) in most.iter_mut().enumerate() {
            let [a, b, c] = around.map(|joints| joints[joint]);
            let step_s = step_ns as f64 / 1e9;
            *most = most.max((a - 2.0 * b + c).abs() / (step_s * step_s));
        }
    }
    most
}

fn sample(record: &SignalRecord, number: usize, ns: i64) -> SignalSample {
    let header = SignalHeader {
        sequence: number as u64 + 1,
        session: 77,
        time_ns: ns,
        publish_time_ns: ns,
        description_hash: record.description.hash(),
        ..SignalHeader::default()
    };
    let bytes = joints_at(ns).iter().flat_map(|x| x.to_le_bytes()).collect();
    SignalSample::new(header, &record.description, bytes).unwrap()
}

fn session_of(record: &SignalRecord) -> Session {
    let mut session = session();
    session.streams.truncate(1);
    session.motion.clear();
    session.signals = vec![record.clone()];
    session
}

/// Records sets at `ticks`, with the samples at `samples`, each with the first set that is later.
fn recorded(record: &SignalRecord, ticks: &[i64], samples: &[i64]) -> MemFs {
    let fs = MemFs::new();
    let session = session_of(record);
    let r = Recorder::create(Arc::new(fs.clone()), &dir(), session.clone(), options()).unwrap();
    let mut from = 0;
    for (n, tick) in ticks.iter().enumerate() {
        let mut bare = session.clone();
        bare.signals.clear();
        let mut set = set(&bare, n as u64);
        set.tick = HostTime::from_ns(*tick);
        set.frames[0].header.capture_time_ns = *tick;
        let until = if n + 1 == ticks.len() { samples.len() } else { samples.partition_point(|t| t <= tick) };
        let numbered = samples[from..until].iter().enumerate();
        let samples: Vec<_> = numbered.map(|(i, t)| sample(record, from + i, *t)).collect();
        from = until;
        set.signals = if samples.is_empty() { Vec::new() } else { vec![RecordSignal { signal: 0, samples }] };
        r.push(set).unwrap();
        settle(&r);
    }
    assert!(r.finish().unwrap().complete);
    fs
}

/// A chunk of the exported array `name`.
fn chunk(fs: &MemFs, name: &str) -> Vec<u8> {
    let packed = contents(fs, Path::new(&format!("/export/data/{name}")));
    zstd::bulk::decompress(&packed, 1 << 20).unwrap()
}

#[test]
fn a_state_lacks_a_row_if_any_of_its_signals_does_and_is_in_the_order_of_names() {
    let fs = MemFs::new();
    let r = recorder(&fs, options());
    for n in 0..6 {
        let mut set = set(&session(), n);
        if n == 2 {
            set.signals.retain(|part| part.signal == 0);
        }
        r.push(set).unwrap();
        settle(&r);
    }
    r.finish().unwrap();
    let signals = VectorOptions { gaps: Gaps::Mask, ..VectorOptions::default() };
    let mut zarr = Zarr::new(RowOptions { signals, ..RowOptions::default() });
    let on = &mut |_| ControlFlow::Continue(());
    export(&fs, &mut zarr, vec![open(&fs)], Path::new("/export"), ExportOptions { workers: 1 }, on).unwrap();
    assert_eq!(chunk(&fs, "missing_state/0"), [0, 0, 1, 0, 0, 0]);
    let facts: serde_json::Value =
        serde_json::from_slice(&contents(&fs, Path::new("/export/.zattrs"))).unwrap();
    let names = ["gripper.width", "gripper.closed", "joints.shoulder", "joints.elbow"];
    assert_eq!(
        facts["depthrig"]["vectors"][0]["names"],
        serde_json::json!(names.map(|n| format!("arm/{n}")))
    );
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, ..ProptestConfig::default() })]
    #[test]
    fn state_is_the_truth_within_the_stated_bound(
        period_ns in 2_000_000_i64..120_000_000,
        phase_ns in 0_i64..4_000_000_000,
        lost in proptest::collection::vec(any::<prop::sample::Index>(), 0..12),
        steps in proptest::collection::vec(1_000_000_i64..300_000_000, 2..25),
        max_gap_ns in 20_000_000_u64..400_000_000,
        silent_ns in prop_oneof![Just([0, 0]), [0_i64..1_500_000_000, 0_i64..1_500_000_000]],
    ) {
        let ticks: Vec<_> = steps.iter().scan(M0 + phase_ns, |t, step| { *t += step; Some(*t) }).collect();
        let span = ticks[ticks.len() - 1] - ticks[0];
        let count = (span / period_ns + 2) as usize;
        let mut samples: Vec<_> =
            (0..count).map(|i| ticks[0] - period_ns / 3 + i as i64 * period_ns).collect();
        // Sets at either end may lie outside of the samples.
        let heard = ticks[0] + silent_ns[0]..=ticks[ticks.len() - 1] + period_ns - silent_ns[1];
        if samples.iter().filter(|t| heard.contains(t)).count() > 2 {
            samples.retain(|t| silent_ns == [0, 0] || heard.contains(t));
        }
        for lost in &lost {
            if samples.len() > 2 {
                samples.remove(lost.index(samples.len()));
            }
        }
        let name = SignalName::new("arm", "joint_position").unwrap();
        let record = SignalRecord::new(&Arc::new(SignalDescription::joints(name, &JOINTS, "rad").unwrap()));
        let fs = recorded(&record, &ticks, &samples);
        let signals = VectorOptions { max_gap_ns, gaps: Gaps::Mask, ..VectorOptions::default() };
        let mut zarr = Zarr::new(RowOptions { fps: Some(5.0), signals, ..RowOptions::default() });
        let on = &mut |_| ControlFlow::Continue(());
        let out = Path::new("/export");
        if export(&fs, &mut zarr, vec![open(&fs)], out, ExportOptions { workers: 1 }, on).is_err() {
            // All sets are left out as ends without a value.
            return Ok(());
        }
        let values = chunk(&fs, "state/0.0");
        let values: Vec<_> = values.as_chunks().0.iter().map(|b| f64::from(f32::from_le_bytes(*b))).collect();
        let missing = chunk(&fs, "missing_state/0");
        let times: Vec<_> = chunk(&fs, "utc_ns/0").as_chunks().0.iter().map(|b| i64::from_le_bytes(*b) - T0 + M0).collect();
        // Up to a second without a value at either end is left out.
        let [first, last] = [times[0], times[times.len() - 1]];
        for out in [ticks[0]..first, last + 1..ticks[ticks.len() - 1] + 1] {
            let out: Vec<_> = ticks.iter().filter(|t| out.contains(t)).collect();
            if let [begin, .., end] = out[..] {
                prop_assert!(end - begin <= SECOND_NS, "{} ns are left out", end - begin);
            }
        }
        let silent = |missing: &mut dyn Iterator<Item = (&u8, &i64)>| {
            let times: Vec<_> = missing.take_while(|(m, _)| **m != 0).map(|(_, t)| *t).collect();
            times.first().zip(times.last()).map(|(a, b)| (a - b).abs())
        };
        let rows = || missing.iter().zip(&times);
        if missing.contains(&0) {
            for kept in [silent(&mut rows()), silent(&mut rows().rev())].into_iter().flatten() {
                prop_assert!(kept > SECOND_NS, "{} ns at an end are kept without a value", kept);
            }
        }
        for time in &ticks {
            let after = samples.partition_point(|t| t < time);
            let exact = samples.get(after) == Some(time);
            let before = if exact { Some(after) } else { after.checked_sub(1) };
            let around = before.and_then(|b| Some(samples[b]..*samples.get(after)?));
            let gap = around.filter(|span| (span.end - span.start) as u64 <= max_gap_ns);
            let Ok(row) = times.binary_search(time) else {
                prop_assert!(gap.is_none(), "{} is left out", time);
                continue;
            };
            prop_assert_eq!(missing[row] != 0, gap.is_none(), "row {} at {}", row, time);
            let Some(span) = gap else {
                // The last sample before is held.
                let held = samples[..after].last().map_or([0.0; 4], |t| joints_at(*t));
                for (value, held) in values[4 * row..].iter().zip(held) {
                    prop_assert!((value - held).abs() < ROUNDING, "row {} does not hold the last sample", row);
                }
                continue;
            };
            if span.start / WAY_NS != span.end / WAY_NS {
                continue;
            }
            let gap_s = (span.end - span.start) as f64 / 1e9;
            let most = curvature(&span);
            for (joint, truth) in joints_at(*time).into_iter().enumerate() {
                let error = (values[4 * row + joint] - truth).abs();
                let bound = gap_s * gap_s / 8.0 * most[joint] * 1.02 + ROUNDING;
                prop_assert!(error <= bound, "joint {} at {}: {} > {}, gap {} s", joint, time, error, bound, gap_s);
            }
        }
    }
}
