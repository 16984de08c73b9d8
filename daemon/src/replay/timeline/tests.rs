//! The timeline against its own rules, stated anew.

use super::*;
use proptest::prelude::*;

const MS: i64 = 1_000_000;
const T0: i64 = 1_700_000_000_000_000_000;

fn id(name: &str) -> StreamId {
    name.parse().unwrap()
}

/// A timeline of datasets given as streams and times in ms; each moment as its time in ms and `dataset.set` names.
fn moments(parts: &[(&[&str], &[i64])]) -> Result<Vec<(i64, String)>> {
    let streams: Vec<Vec<StreamId>> = parts.iter().map(|p| p.0.iter().map(|s| id(s)).collect()).collect();
    let times: Vec<Vec<i64>> = parts.iter().map(|p| p.1.iter().map(|t| T0 + t * MS).collect()).collect();
    let parts: Vec<_> = (0..parts.len())
        .map(|d| Part { name: format!("d{d}"), streams: streams[d].iter().collect(), times: &times[d] })
        .collect();
    let t = Timeline::new(&parts)?;
    let name = |m: &Member| format!("{}.{}", m.dataset, m.set);
    let names = |i| t.members(i).iter().map(name).collect::<Vec<_>>().join("+");
    Ok((0..t.len()).map(|i| (t.times()[i] / MS, names(i))).collect())
}

fn borrowed(moments: &[(i64, String)]) -> Vec<(i64, &str)> {
    moments.iter().map(|(t, names)| (*t, names.as_str())).collect()
}

#[test]
fn cameras_recorded_at_once_are_paired_with_their_nearest() {
    let a: &[&str] = &["left/color", "left/depth"];
    let b: &[&str] = &["right/depth"];
    // 90 ms is nearer than 110 ms; exactly half a period still is.
    let m = moments(&[(a, &[0, 200, 400]), (b, &[90, 290, 500])]).unwrap();
    assert_eq!(borrowed(&m), [(0, "0.0+1.0"), (200, "0.1+1.1"), (400, "0.2+1.2")]);
    let m = moments(&[(a, &[0, 200, 400]), (b, &[110, 310, 510])]).unwrap();
    assert_eq!(borrowed(&m), [(0, "0.0"), (110, "0.1+1.0"), (310, "0.2+1.1"), (510, "1.2")]);
    // Twice as fast: every second one finds nobody.
    let m = moments(&[(a, &[0, 200, 400]), (b, &[10, 110, 210, 310])]).unwrap();
    assert_eq!(borrowed(&m), [(0, "0.0+1.0"), (110, "1.1"), (200, "0.1+1.2"), (310, "1.3"), (400, "0.2")]);
}

#[test]
fn datasets_of_one_rig_follow_each_other_without_the_time_between() {
    let s: &[&str] = &["left/color"];
    let m = moments(&[(s, &[0, 200, 400]), (s, &[3_600_000, 3_600_100, 3_600_200])]).unwrap();
    assert_eq!(
        borrowed(&m),
        [(0, "0.0"), (200, "0.1"), (400, "0.2"), (600, "1.0"), (700, "1.1"), (800, "1.2")]
    );
    // In whatever order they are given; and a gap within a dataset is kept.
    let m = moments(&[(s, &[90_000, 90_200]), (s, &[0, 200, 5200])]).unwrap();
    assert_eq!(
        borrowed(&m),
        [(0, "1.0"), (200, "1.1"), (5200, "1.2"), (10_200 - 4800, "0.0"), (5600, "0.1")]
    );
    // A gap that another dataset covers is no gap.
    let other: &[&str] = &["right/color"];
    let m = moments(&[(s, &[0, 200]), (s, &[1000, 1200]), (other, &[0, 600, 1200])]).unwrap();
    assert_eq!(borrowed(&m), [(0, "0.0+2.0"), (200, "0.1"), (600, "2.1"), (1000, "1.0"), (1200, "1.1+2.2")]);
}

#[test]
fn one_stream_twice_at_one_time_is_refused_with_its_name() {
    let e = moments(&[(&["l/a", "l/b"], &[0, 200, 400]), (&["r/a"], &[0]), (&["l/b"], &[400, 600])]);
    let e = e.unwrap_err();
    assert_eq!(e.kind(), ErrorKind::BadInput);
    for part in ["d0 and d2", "l/b", "0.400 s"] {
        assert!(e.to_string().contains(part), "{e}");
    }
    assert!(moments(&[(&["l/b"], &[0, 200]), (&["l/b"], &[201, 400])]).is_ok());
}

#[test]
fn a_part_of_it_begins_anew() {
    let streams = [id("l/a")];
    let times: Vec<i64> = (0..10).map(|i| T0 + i * 200 * MS).collect();
    let part = Part { name: "d".into(), streams: streams.iter().collect(), times: &times };
    let all = Timeline::new(&[part]).unwrap();
    let cut = all.between(350 * MS, 1000 * MS);
    assert_eq!(cut.times(), [0, 200 * MS, 400 * MS, 600 * MS]);
    assert_eq!(cut.members(0), [Member { dataset: 0, set: 2 }]);
    assert_eq!((cut.moment_of(5), cut.moment_of(1), cut.moment_of(6)), (Some(3), None, None));
    assert_eq!(cut.at_or_after(200 * MS), Some(1));
    assert_eq!(cut.at_or_after(200 * MS + 1), Some(2));
    assert_eq!(cut.at_or_after(600 * MS + 1), None);
    assert_eq!(all.between(5000 * MS, 6000 * MS).len(), 0);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]
    /// Side by side: every set once and in order; a moment's sets lie within the window; and two moments in a row
    /// never hold one set each that belonged together.
    #[test]
    fn every_set_is_in_one_moment_and_near_ones_are_together(
        steps in proptest::collection::vec(proptest::collection::vec(1i64..400, 1..40), 1..5),
        begins in proptest::collection::vec(0i64..3000, 5),
    ) {
        let ids: Vec<StreamId> = (0..steps.len()).map(|d| id(&format!("cam{d}/depth"))).collect();
        let times: Vec<Vec<i64>> = steps.iter().zip(&begins).map(|(gaps, begin)| {
            gaps.iter().scan(T0 + begin * MS, |t, gap| { *t += gap * MS; Some(*t) }).collect()
        }).collect();
        let parts: Vec<_> = (0..steps.len())
            .map(|d| Part { name: String::new(), streams: vec![&ids[d]], times: &times[d] })
            .collect();
        let t = Timeline::new(&parts).unwrap();
        prop_assert!(t.times().is_sorted_by(|a, b| a < b));
        prop_assert_eq!(t.times()[0], 0);
        let mut next = vec![0u32; steps.len()];
        let utc = |m: &Member| times[m.dataset as usize][m.set as usize];
        let window = |a: &Member, b: &Member| {
            median_gap_ns(&times[a.dataset as usize]).min(median_gap_ns(&times[b.dataset as usize])) / 2
        };
        for i in 0..t.len() {
            let members = t.members(i);
            prop_assert!(!members.is_empty());
            let leader = *members.iter().min_by_key(|m| (utc(m), m.dataset)).unwrap();
            for m in members {
                prop_assert_eq!(m.set, next[m.dataset as usize]);
                next[m.dataset as usize] += 1;
                prop_assert!(m == &leader || utc(m) - utc(&leader) <= window(m, &leader));
            }
            // Whoever comes next and was near the leader would have been taken along.
            for d in 0..steps.len() {
                let taken = members.iter().any(|m| m.dataset as usize == d);
                if let (false, Some(late)) = (taken, times[d].get(next[d] as usize)) {
                    let m = Member { dataset: d as u32, set: next[d] };
                    prop_assert!(late - utc(&leader) > window(&m, &leader));
                }
            }
        }
        let all: Vec<u32> = times.iter().map(|t| t.len() as u32).collect();
        prop_assert_eq!(next, all);
    }
}
