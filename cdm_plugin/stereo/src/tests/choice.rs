//! Selection of the pairs to match when time does not suffice for all of them, or only some are wanted.

use super::*;
use std::collections::BTreeSet;

/// Six pairs of the fake camera from one set to the next.
const SETS_NS: i64 = 6 * 33_333_333;

/// Capture times of the frames that came of a stream.
fn times(sink: &MemorySink, stream: usize) -> Vec<HostTime> {
    sink.frames.iter().filter(|f| f.0 == stream).map(|f| f.1.capture_time).collect()
}

#[test]
fn a_slow_mode_takes_the_pair_of_the_newest_set_and_not_the_newest_pair() {
    let (slow, release) = waits("slow");
    let mut camera = FakeCamera::new(PixelFormat::Yuyv, &[Shot::Wall(3); 60]);
    camera.pause = Duration::from_millis(2);
    let options = StereoOptions { every_pair: false, ..options(vec![slow, scripted("quick", || || Ok(()))]) };
    let sets = Arc::clone(&options.sets);
    let mut stream = wrap(Box::new(camera), options).unwrap().start(&[]).unwrap();
    let profiles = stream.profiles().to_vec();
    let [left, quick, slow] = ["left", "depth_quick", "depth_slow"].map(|name| index(&profiles, name));
    let mut sink = Strict::default();
    let limit = HostTime::now().plus(Duration::from_mins(1));
    while sink.0.captured.get(quick).is_none_or(|n| *n < 60) {
        let _ = stream.poll(Duration::from_millis(5), &mut sink).unwrap();
        assert!(!limit.from_now().is_zero());
        if let (Some(tenth), None) = (times(&sink.0, left).get(9), sets.newest()) {
            sets.note(*tenth, SETS_NS);
        }
    }
    drop(release);
    while stream.poll(Duration::from_millis(5), &mut sink).unwrap() != Poll::End {}
    let pairs = times(&sink.0, left);
    let matched = times(&sink.0, slow);
    // It was at its first pair all the time; sets are of the pairs 9, 15 ... 57, and 59 is the newest.
    assert_eq!(matched.len(), 2, "the first, and one that waited");
    assert_eq!(matched[1], pairs[57]);
    assert_eq!(sink.0.captured[slow], 60);
}

#[test]
fn at_a_rate_pairs_of_sets_are_matched_the_others_count_nowhere_and_colour_is_of_all() {
    let camera = FakeCamera::new(PixelFormat::Yuyv, &[Shot::Wall(3); 60]);
    let options = StereoOptions { rate_hz: 5.0, ..options(vec![scripted("some", || || Ok(()))]) };
    let sets = Arc::clone(&options.sets);
    let mut stream = wrap(Box::new(camera), options).unwrap().start(&[]).unwrap();
    let profiles = stream.profiles().to_vec();
    let [left, color, depth] = ["left", "color", "depth_some"].map(|name| index(&profiles, name));
    let rates = [left, color, depth].map(|i| profiles[i].rate_hz);
    assert_eq!(rates, [30.0, 30.0, 5.0]);
    let mut sink = Strict::default();
    while stream.poll(Duration::from_millis(20), &mut sink).unwrap() != Poll::End {
        if let (Some(third), None) = (times(&sink.0, left).get(2), sets.newest()) {
            sets.note(*third, SETS_NS);
        }
    }
    let sink = sink.0;
    let pairs = times(&sink, left);
    let matched = times(&sink, depth);
    assert_eq!((sink.delivered(color), pairs.len()), (60, 60));
    assert_eq!((sink.captured[depth], sink.drops_of(depth).total()), (matched.len() as u64, 0));
    let number: Vec<_> = matched.iter().map(|t| pairs.iter().position(|p| p == t).unwrap()).collect();
    // The first before a set was known, then those of sets.
    assert_eq!(number[number.len() - 8..], [14, 20, 26, 32, 38, 44, 50, 56], "{number:?}");
    assert!((10..=11).contains(&number.len()), "{number:?}");
}

#[test]
fn at_a_rate_a_lost_pair_is_made_up_for_by_the_next() {
    let mut shots = vec![Shot::Wall(3); 30];
    shots[12] = Shot::Only(0);
    let options = StereoOptions { rate_hz: 5.0, ..options(vec![scripted("some", || || Ok(()))]) };
    let (sink, profiles) = play(FakeCamera::new(PixelFormat::Yuyv, &shots), options, &[]);
    let [left, color, depth] = ["left", "color", "depth_some"].map(|name| index(&profiles, name));
    assert_eq!(sink.drops_of(color).get(DropReason::Incomplete), 1);
    assert_eq!((sink.delivered(depth), sink.captured[depth]), (5, 5));
    let pairs = times(&sink, left);
    let at: BTreeSet<_> =
        times(&sink, depth).iter().map(|t| pairs.iter().position(|p| p == t).unwrap()).collect();
    assert_eq!(at, [0, 6, 13, 18, 24].into());
}

#[test]
fn a_rate_that_is_none_is_refused() {
    for rate_hz in [-1.0, f64::NAN, f64::INFINITY] {
        let options = StereoOptions { rate_hz, ..options(presets()) };
        let e = wrap(Box::new(FakeCamera::new(PixelFormat::Yuyv, &[])), options).err().unwrap();
        assert!(e.kind() == ErrorKind::BadInput && e.to_string().contains("invalid stereo rate"), "{e}");
    }
}
