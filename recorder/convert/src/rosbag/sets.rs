//! Frames of several streams become sets by their capture times.
//!
//! The stream with the most frames gives the ticks; every frame of another stream goes to the nearest tick, if that is
//! within half a period and no nearer frame of its stream wants it. Frames that find none are sets of their own, so that
//! nothing is left out. Within each stream the order is kept: a later frame is never in an earlier set.

/// A set: its tick, and for each stream the index of its frame.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Set {
    pub tick_ns: i64,
    pub frames: Vec<Option<usize>>,
}

/// Groups `times`, the increasing capture times of each stream.
pub(super) fn group(times: &[Vec<i64>]) -> Vec<Set> {
    let streams = times.len();
    // The first of those with the most frames: depth comes before colour.
    let Some(reference) = (0..streams).rev().max_by_key(|i| times[*i].len()) else { return Vec::new() };
    let ticks = &times[reference];
    let mut steps: Vec<i64> = ticks.windows(2).map(|w| w[1].saturating_sub(w[0])).collect();
    let middle = steps.len() / 2;
    // One frame says nothing of a period: a tenth of a second is that of the slowest camera in use.
    let period = if steps.is_empty() { 100_000_000 } else { *steps.select_nth_unstable(middle).1 };
    let mut sets: Vec<Set> = ticks
        .iter()
        .enumerate()
        .map(|(i, t)| {
            let mut frames = vec![None; streams];
            frames[reference] = Some(i);
            Set { tick_ns: *t, frames }
        })
        .collect();
    let mut alone = Vec::new();
    for (stream, of_stream) in times.iter().enumerate().filter(|(i, _)| *i != reference) {
        let lone = |frame: usize| {
            let mut frames = vec![None; streams];
            frames[stream] = Some(frame);
            Set { tick_ns: of_stream[frame], frames }
        };
        for (frame, t) in of_stream.iter().enumerate() {
            let after = ticks.partition_point(|tick| tick < t);
            let near = [after.checked_sub(1), Some(after)].into_iter().flatten().filter(|i| *i < ticks.len());
            let nearest = near.min_by_key(|i| ticks[*i].abs_diff(*t));
            let nearest = nearest.filter(|i| ticks[*i].abs_diff(*t) <= period.unsigned_abs() / 2);
            let Some(at) = nearest else {
                alone.push(lone(frame));
                continue;
            };
            let place = &mut sets[at].frames[stream];
            match *place {
                Some(other) if of_stream[other].abs_diff(ticks[at]) <= t.abs_diff(ticks[at]) => {
                    alone.push(lone(frame));
                }
                Some(other) => {
                    alone.push(lone(other));
                    *place = Some(frame);
                }
                None => *place = Some(frame),
            }
        }
    }
    sets.append(&mut alone);
    sets.sort_by_key(|s| s.tick_ns);
    sets
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn nearest_frames_share_a_set() {
        let sets = group(&[vec![0, 100, 200], vec![10, 140, 195, 400], vec![]]);
        // The second stream has the most frames and gives the ticks.
        let placed: Vec<_> = sets.iter().map(|s| (s.tick_ns, s.frames.clone())).collect();
        assert_eq!(
            placed,
            [
                (10, vec![Some(0), Some(0), None]),
                (140, vec![Some(1), Some(1), None]),
                (195, vec![Some(2), Some(2), None]),
                (400, vec![None, Some(3), None]),
            ]
        );
        assert_eq!(group(&[]), []);
    }

    proptest! {
        /// Every frame is in one set, streams keep their order, and who shares a set is within half a period.
        #[test]
        fn nothing_is_lost_and_nothing_crosses(mut times in proptest::collection::vec(
            proptest::collection::btree_set(0i64..2000, 0..40), 1..4))
        {
            let times: Vec<Vec<i64>> = times.drain(..).map(|s| s.into_iter().collect()).collect();
            let sets = group(&times);
            prop_assert!(sets.windows(2).all(|w| w[0].tick_ns <= w[1].tick_ns));
            for (stream, of_stream) in times.iter().enumerate() {
                let order: Vec<usize> = sets.iter().filter_map(|s| s.frames[stream]).collect();
                prop_assert_eq!(order, (0..of_stream.len()).collect::<Vec<_>>());
            }
            let most = times.iter().map(Vec::len).max().unwrap_or(0);
            let reference = times.iter().position(|t| t.len() == most).unwrap();
            let ticks = &times[reference];
            let mut steps: Vec<i64> = ticks.windows(2).map(|w| w[1] - w[0]).collect();
            steps.sort_unstable();
            let half = steps.get(steps.len() / 2).unwrap_or(&100_000_000) / 2;
            for s in sets.iter().filter(|s| s.frames[reference].is_none()) {
                let all: Vec<usize> = (0..times.len()).filter(|i| s.frames[*i].is_some()).collect();
                prop_assert_eq!(all.len(), 1);
                // Who is alone has no tick near, or a frame of its stream that is as near has it.
                let far = |tick: i64| (tick - s.tick_ns).abs();
                let least = ticks.iter().map(|tick| far(*tick)).min().unwrap();
                let taken = sets.iter().filter(|o| o.frames[reference].is_some() && far(o.tick_ns) == least);
                let nearer = |o: &Set| {
                    o.frames[all[0]].is_some_and(|f| (times[all[0]][f] - o.tick_ns).abs() <= least)
                };
                prop_assert!(least > half || taken.clone().any(nearer), "{:?} of {:?}", s, sets);
            }
            for s in sets.iter().filter(|s| s.frames[reference].is_some()) {
                let near = |(stream, f): (usize, &Option<usize>)| {
                    f.is_none_or(|f| (times[stream][f] - s.tick_ns).abs() <= half)
                };
                prop_assert!(s.frames.iter().enumerate().all(near), "{:?}", s);
            }
        }
    }
}
