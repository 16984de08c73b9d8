//! Windows and interpolation against a slow model, and against a signal of known curvature.

use super::*;
use crate::signal::field::{FieldType, SignalField};
use crate::signal::header::{SignalFlags, SignalHeader};
use crate::signal::value::{self, Value};
use crate::signal::{SignalDescription, SignalName};
use proptest::prelude::*;
use std::sync::Arc;

const MS: i64 = 1_000_000;

fn name() -> SignalName {
    "arm/x".parse().unwrap()
}

fn mixed() -> Arc<SignalDescription> {
    let field = |name: &str, kind| SignalField::new(name, kind, "");
    let fields = vec![
        field("flag", FieldType::Bool),
        field("pair", FieldType::F64).with_count(2),
        field("single", FieldType::F32),
        field("count", FieldType::I64),
        field("note", FieldType::Text),
    ];
    Arc::new(SignalDescription::fields(name(), fields).unwrap())
}

fn one() -> Arc<SignalDescription> {
    Arc::new(SignalDescription::joints(name(), &["x"], "rad").unwrap())
}

fn sample(
    description: &Arc<SignalDescription>,
    session: u64,
    time_ns: i64,
    values: &[Value<'_>],
) -> SignalSample {
    let header = SignalHeader { session, time_ns, sequence: 1, ..SignalHeader::default() };
    let mut bytes = Vec::new();
    value::encode(description, values.iter().copied(), &mut bytes).unwrap();
    SignalSample::new(header, description, bytes).unwrap()
}

fn of(points: &[(i64, f64)]) -> Series {
    let description = one();
    let mut series = Series::new(Duration::from_secs(1000));
    for (time, x) in points {
        series.push(sample(&description, 1, *time, &[Value::F64(*x)])).unwrap();
    }
    series
}

fn at(series: &Series, time: i64, max_gap_ns: i64) -> Result<f64, ErrorKind> {
    let found = series.at(HostTime::from_ns(time), Duration::from_nanos(max_gap_ns as u64));
    found.map(|s| s.numbers()[0]).map_err(|e| e.kind())
}

/// The same by looking at each pair of neighbours, without a search.
fn slow(points: &[(i64, f64)], time: i64, max_gap_ns: i64) -> Result<f64, ErrorKind> {
    if let Some((_, x)) = points.iter().find(|(t, _)| *t == time) {
        return Ok(*x);
    }
    for pair in points.windows(2) {
        let [(t, x), (u, y)] = [pair[0], pair[1]];
        if t < time && time < u {
            if u - t > max_gap_ns {
                return Err(ErrorKind::Gap);
            }
            return Ok(x + (y - x) * ((time - t) as f64 / (u - t) as f64));
        }
    }
    Err(ErrorKind::Outside)
}

proptest! {
    #[test]
    fn a_value_between_two_samples_is_that_of_the_slow_model(
        steps in prop::collection::vec((1..20i64, -10.0..10.0f64), 0..40),
        asked in prop::collection::vec((-10..500i64, 0..25i64), 1..40),
    ) {
        let mut time = 0;
        let points: Vec<_> = steps.iter().map(|(step, x)| { time += step; (time, *x) }).collect();
        let series = of(&points);
        for (time, gap) in asked {
            match (at(&series, time, gap), slow(&points, time, gap)) {
                (Ok(a), Ok(b)) => prop_assert!((a - b).abs() < 1e-12, "{a} {b}"),
                (a, b) => prop_assert_eq!(a, b),
            }
        }
    }

    #[test]
    fn a_window_has_the_samples_of_its_length(
        steps in prop::collection::vec(1..20i64, 1..60),
        length in 0..600u64,
        keep in 0..600u64,
    ) {
        let description = one();
        let mut series = Series::new(Duration::from_nanos(keep));
        let mut time = 0;
        let mut times = Vec::new();
        for step in steps {
            time += step;
            times.push(time);
            series.push(sample(&description, 1, time, &[Value::F64(0.0)])).unwrap();
        }
        let got: Vec<_> = series.window(Duration::from_nanos(length)).map(|s| s.time().ns()).collect();
        let from = time - length.min(keep) as i64;
        times.retain(|t| *t >= from);
        prop_assert_eq!(got, times);
    }

    /// With |x''| <= a the line between two samples that are g apart is off by at most a g² / 8.
    #[test]
    fn a_sine_is_met_within_the_bound_of_its_curvature(
        frequency_hz in 0.1..5.0f64,
        phase in 0.0..6.0f64,
        steps in prop::collection::vec(1..50 * MS, 10..60),
        shares in prop::collection::vec(0.0..1.0f64, 20),
    ) {
        let turn = core::f64::consts::TAU * frequency_hz;
        let x = |time: i64| (turn * time as f64 / 1e9 + phase).sin();
        let mut time = 0;
        let points: Vec<_> = steps.iter().map(|step| { time += step; (time, x(time)) }).collect();
        let series = of(&points);
        let gap = *steps.iter().max().unwrap();
        let bound = turn * turn * (gap as f64 / 1e9).powi(2) / 8.0 + 1e-12;
        for share in shares {
            let first = points[0].0;
            let asked = first + ((time - first) as f64 * share) as i64;
            let off = (at(&series, asked, gap).unwrap() - x(asked)).abs();
            prop_assert!(off <= bound, "off by {off}, bound {bound}");
        }
    }
}

/// The middle of a gap over the top of a parabola is where the bound is reached: no smaller one holds.
#[test]
fn the_bound_is_reached() {
    let half = 10 * MS;
    let x = |time: i64| (time as f64 / 1e9).powi(2) / 2.0; // x'' = 1
    let series = of(&[(-half, x(-half)), (half, x(half))]);
    let gap_s = 2.0 * half as f64 / 1e9;
    let off = (at(&series, 0, 2 * half).unwrap() - x(0)).abs();
    assert!((off - gap_s * gap_s / 8.0).abs() < 1e-15, "{off}");
}

#[test]
fn nothing_is_extrapolated_and_errors_say_how_far() {
    let none = Series::new(Duration::from_secs(1));
    let e = none.at(HostTime::from_ns(0), Duration::from_secs(1)).unwrap_err();
    assert_eq!((e.kind(), e.to_string().as_str()), (ErrorKind::Outside, "no sample has come yet"));
    let series = of(&[(10 * MS, 1.0), (30 * MS, 2.0)]);
    let said = |time: i64, gap: i64| {
        series.at(HostTime::from_ns(time), Duration::from_nanos(gap as u64)).unwrap_err().to_string()
    };
    assert!(said(9 * MS, 50 * MS).contains("1.000 ms before the first sample"));
    assert!(said(31 * MS, 50 * MS).contains("1.000 ms after the newest sample"));
    assert!(
        said(20 * MS, 20 * MS - 1).contains("20.000 ms apart, at most 20.000 ms"),
        "{}",
        said(20 * MS, 20 * MS - 1)
    );
    assert_eq!(at(&series, 20 * MS, 20 * MS), Ok(1.5));
    assert_eq!(at(&series, 30 * MS, 0), Ok(2.0), "a sample needs no neighbours");
}

#[test]
fn floats_are_interpolated_and_everything_else_holds() {
    let description = mixed();
    let mut series = Series::new(Duration::from_secs(1));
    let values = |flag: bool, x: f64, note: &'static str| {
        [
            Value::Bool(flag),
            Value::F64(x),
            Value::F64(f64::NAN),
            Value::F32(x as f32),
            Value::I64(x as i64),
            Value::Text(note),
        ]
    };
    series.push(sample(&description, 1, 0, &values(true, 1.0, "pick \"it\"\n🦾"))).unwrap();
    series.push(sample(&description, 1, 10, &values(false, 5.0, ""))).unwrap();
    let got = series.at(HostTime::from_ns(5), Duration::from_nanos(10)).unwrap();
    assert!(got.has(SignalFlags::INTERPOLATED));
    let shown: Vec<_> = got.values().map(|v| v.to_string()).collect();
    assert_eq!(shown, ["true", "3", "NaN", "3", "1", "\"pick \\\"it\\\"\\n🦾\""]);
    assert_eq!(got.field("note").next(), Some(Value::Text("pick \"it\"\n🦾")));
    assert_eq!(got.field("pair").count(), 2);
    assert_eq!(got.field("none").count(), 0);
    let exact = series.at(HostTime::from_ns(10), Duration::ZERO).unwrap();
    assert!(!exact.has(SignalFlags::INTERPOLATED));
    assert_eq!(exact.field("note").next(), Some(Value::Text("")));
}

#[test]
fn infinities_stay() {
    let series = of(&[(0, f64::INFINITY), (10, f64::INFINITY), (20, 0.0)]);
    assert_eq!(at(&series, 5, 10), Ok(f64::INFINITY));
    assert_eq!(at(&series, 15, 10), Ok(f64::INFINITY));
}

#[test]
fn nothing_is_interpolated_across_a_restart() {
    let description = one();
    let mut series = of(&[(0, 1.0), (10, 2.0)]);
    series.push(sample(&description, 2, 20, &[Value::F64(9.0)])).unwrap();
    assert_eq!(at(&series, 15, 100), Err(ErrorKind::Outside));
    assert_eq!(series.window(Duration::from_secs(1)).len(), 1);
}

#[test]
fn a_replay_that_goes_back_begins_anew() {
    let description = one();
    let mut series = of(&[(0, 1.0), (10, 2.0)]);
    series.push(sample(&description, 1, 5, &[Value::F64(9.0)])).unwrap();
    assert_eq!(series.latest().unwrap().time().ns(), 5);
    assert_eq!(series.window(Duration::from_secs(1)).len(), 1);
}

#[test]
fn other_fields_are_reported_once_and_then_read() {
    let mut series = of(&[(0, 1.0)]);
    let other = Arc::new(SignalDescription::joints(name(), &["y", "z"], "rad").unwrap());
    let e = series.push(sample(&other, 2, 10, &[Value::F64(1.0), Value::F64(2.0)])).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::Changed);
    assert!(e.to_string().contains("y, z (joints); before: x (joints)"), "{e}");
    series.push(sample(&other, 2, 20, &[Value::F64(3.0), Value::F64(4.0)])).unwrap();
    assert_eq!(at(&series, 15, 10), Ok(2.0));
}

#[test]
fn memory_is_bounded() {
    let fields = vec![SignalField::new("x", FieldType::F64, "").with_count(512)];
    let description = Arc::new(SignalDescription::fields(name(), fields).unwrap());
    let mut series = Series::new(Duration::MAX);
    let values = [Value::F64(0.0); 512];
    let one = sample(&description, 1, 1, &values);
    for time in 1..20_000 {
        let header = SignalHeader { time_ns: time, ..*one.header() };
        series.push(SignalSample::new(header, &description, one.bytes().to_vec()).unwrap()).unwrap();
    }
    let kept = series.window(Duration::MAX).len();
    assert!(kept * 4096 < MAX_BYTES && (kept + 1) * (4096 + size_of::<SignalSample>()) > MAX_BYTES, "{kept}");
}
