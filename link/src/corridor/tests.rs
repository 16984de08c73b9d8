use super::*;
use proptest::prelude::*;

const MS: i64 = 1_000_000;

/// Two clocks whose truth is known: what the remote one says at a local time.
#[derive(Debug, Clone, Copy)]
struct Clocks {
    offset: i64,
    rate: f64,
}

impl Clocks {
    fn offset_at(&self, local: i64) -> f64 {
        self.offset as f64 + self.rate * local as f64
    }

    /// An exchange with these delays there, in the remote host, and back, nanoseconds.
    fn exchange(&self, t1: i64, there: i64, inside: i64, back: i64) -> Exchange {
        let remote = |local: i64| (local as f64 + self.offset_at(local)).round() as i64;
        let arrives = t1 + there;
        let leaves = arrives + inside;
        Exchange { t1, t2: remote(arrives), t3: remote(leaves), t4: leaves + back }
    }
}

fn check(corridor: &Corridor, truth: f64, local: i64) {
    check_within(corridor, truth, local, 0);
}

fn check_within(corridor: &Corridor, truth: f64, local: i64, at_least_ns: u64) {
    let reading = corridor.at(HostTime::from_ns(local)).unwrap();
    let error = (reading.offset_ns as f64 - truth).abs();
    let bound = reading.uncertainty_ns.max(at_least_ns) as f64 + 1.0;
    assert!(error <= bound, "{error} ns off, {reading:?}");
}

/// The range of offsets at `x` of all lines that fit, the slow way: slope by slope.
fn slow_range(exchanges: &[Exchange], x: i64) -> Option<(f64, f64)> {
    let mut range: Option<(f64, f64)> = None;
    let slopes = 200_000;
    for i in -slopes..=slopes {
        let slope = f64::from(i) / f64::from(slopes) * MAX_RATE;
        let to_x = |t: i64| slope * (x - t) as f64;
        let high = exchanges.iter().map(|e| (e.t2 - e.t1) as f64 + to_x(e.t1)).fold(f64::INFINITY, f64::min);
        let low =
            exchanges.iter().map(|e| (e.t3 - e.t4) as f64 + to_x(e.t4)).fold(f64::NEG_INFINITY, f64::max);
        if low <= high {
            range = Some(range.map_or((low, high), |r| (r.0.min(low), r.1.max(high))));
        }
    }
    range
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn the_truth_is_within_the_uncertainty(
        offset in -1_000_000_000_000i64..1_000_000_000_000,
        rate in -4e-4..4e-4,
        steps in prop::collection::vec((1i64..200, 0i64..3_000_000, 0i64..200_000, 0i64..3_000_000, -40i64..200), 1..400),
    ) {
        let clocks = Clocks { offset, rate };
        let mut corridor = Corridor::default();
        let mut t1 = 0;
        for (wait, there, inside, back, look) in steps {
            t1 += wait * MS;
            let e = clocks.exchange(t1, there, inside, back);
            prop_assume!(e.t3 >= e.t2);
            let taken = corridor.take(e);
            prop_assert!(matches!(taken, Taken::Fits | Taken::Stepped | Taken::Refused));
            let local = e.t4 + look * MS;
            check(&corridor, clocks.offset_at(local), local);
            prop_assert_eq!(corridor.at(HostTime::from_ns(local)).unwrap().epoch, 1);
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(16))]

    #[test]
    fn the_range_is_that_of_all_lines(
        rate in -1e-4..1e-4,
        steps in prop::collection::vec((20i64..90, 0i64..3_000_000, 0i64..200_000, 0i64..3_000_000), 2..30),
    ) {
        let clocks = Clocks { offset: 12_345, rate };
        let mut corridor = Corridor::default();
        let mut exchanges = Vec::new();
        let mut t1 = 0;
        for (wait, there, inside, back) in steps {
            t1 += wait * MS;
            exchanges.push(clocks.exchange(t1, there, inside, back));
            corridor.take(*exchanges.last().unwrap());
        }
        let newest = exchanges.iter().map(|e| e.t4).max().unwrap();
        let (low, high) = slow_range(&exchanges, newest).unwrap();
        let reading = corridor.at(HostTime::from_ns(newest)).unwrap();
        let middle = reading.offset_ns as f64;
        let expected = (high - middle).max(middle - low);
        let off = reading.uncertainty_ns as f64 - expected;
        // The slow way sees slopes 5e-9 apart; the bound at the newest answer is exact.
        prop_assert!((-2.0..50.0).contains(&off), "{} instead of {}", reading.uncertainty_ns, expected);
    }
}

/// Exchanges at 20 Hz for 20 s, with delays that look like a network's; the time after them.
fn run(corridor: &mut Corridor, clocks: &Clocks, from: i64, slewed: bool, taken: &mut Vec<Taken>) -> i64 {
    let seconds = 20;
    let mut seed = 88_172_645_463_325_252u64;
    let mut random = || {
        seed ^= seed << 13;
        seed ^= seed >> 7;
        seed ^= seed << 17;
        (seed % 1000) as i64
    };
    for i in 0..seconds * 20 {
        let queue = if random() < 300 { random() * 3000 } else { random() * 40 };
        let e = clocks.exchange(from + i * 50 * MS, 20_000 + queue, 15_000, 20_000 + random() * 40);
        taken.push(corridor.take(e));
        // Until a slewed clock has bent the line, the newest exchange bounds the offset.
        let slewed = if slewed { e.round_trip_ns().cast_unsigned() } else { 0 };
        check_within(corridor, clocks.offset_at(e.t4), e.t4, slewed);
    }
    from + seconds * 1000 * MS
}

#[test]
fn ten_seconds_know_the_offset_to_some_microseconds() {
    let clocks = Clocks { offset: 1_234_567_890_123, rate: 100e-6 };
    let mut corridor = Corridor::default();
    let mut taken = Vec::new();
    let end = run(&mut corridor, &clocks, 0, false, &mut taken);
    let reading = corridor.at(HostTime::from_ns(end)).unwrap();
    assert!((reading.offset_ns as f64 - clocks.offset_at(end)).abs() < 10_000.0, "{reading:?}");
    assert!(reading.uncertainty_ns < 40_000, "{reading:?}");
    assert!((reading.rate - 100e-6).abs() < 2e-6, "{reading:?}");
    assert!(taken[1..].iter().all(|t| *t == Taken::Fits));
}

#[test]
fn a_step_begins_an_epoch_with_the_first_exchange_after_it() {
    for step in [100 * MS, -100 * MS, 1_000 * MS, -86_400_000 * MS, MS] {
        let clocks = Clocks { offset: 5_000_000_000, rate: 3e-6 };
        let mut corridor = Corridor::default();
        let mut taken = Vec::new();
        let end = run(&mut corridor, &clocks, 0, false, &mut taken);
        let stepped = Clocks { offset: clocks.offset + step, ..clocks };
        taken.clear();
        run(&mut corridor, &stepped, end, false, &mut taken);
        assert_eq!(taken[0], Taken::Stepped, "step of {step} ns");
        assert!(taken[1..].iter().all(|t| *t == Taken::Fits));
        assert_eq!(corridor.at(HostTime::from_ns(end)).unwrap().epoch, 2);
    }
}

#[test]
fn a_clock_that_is_slewed_bends_the_line_without_a_new_epoch() {
    let mut corridor = Corridor::default();
    let mut taken = Vec::new();
    let mut clocks = Clocks { offset: 7, rate: 3e-6 };
    let mut end = run(&mut corridor, &clocks, 0, false, &mut taken);
    for rate in [80e-6, -300e-6, 0.0] {
        let offset = clocks.offset_at(end);
        clocks = Clocks { offset: (offset - rate * end as f64).round() as i64, rate };
        taken.clear();
        end = run(&mut corridor, &clocks, end, true, &mut taken);
        assert!(taken.contains(&Taken::Bent));
        assert!(!taken.contains(&Taken::Stepped));
    }
}

/// A busy computer: the exchange that shows the change has been on its way for longer than the change is large.
#[test]
fn a_step_behind_a_long_exchange_begins_an_epoch_and_a_slewed_clock_does_not() {
    for step in [100 * MS, -100 * MS, 20 * MS] {
        for (there, back) in [(150 * MS, MS), (MS, 150 * MS), (110 * MS, 90 * MS)] {
            let clocks = Clocks { offset: 5_000_000_000, rate: 3e-6 };
            let mut corridor = Corridor::default();
            let end = run(&mut corridor, &clocks, 0, false, &mut Vec::new());
            let stepped = Clocks { offset: clocks.offset + step, ..clocks };
            let mut taken = vec![corridor.take(stepped.exchange(end, there, 15_000, back))];
            run(&mut corridor, &stepped, end + 250 * MS, false, &mut taken);
            assert!(taken[..2].contains(&Taken::Stepped), "{step} ns, {there} + {back}: {taken:?}");
            assert_eq!(corridor.at(HostTime::from_ns(end)).unwrap().epoch, 2);
        }
    }
    for (there, back) in [(3 * MS, 0), (0, 3 * MS), (150 * MS, MS)] {
        let mut clocks = Clocks { offset: 7, rate: 3e-6 };
        let mut corridor = Corridor::default();
        let mut end = run(&mut corridor, &clocks, 0, false, &mut Vec::new());
        let mut taken = Vec::new();
        for rate in [500e-6, -500e-6, 0.0] {
            clocks = Clocks { offset: (clocks.offset_at(end) - rate * end as f64).round() as i64, rate };
            for k in 0..10 {
                taken.push(corridor.take(clocks.exchange(end + k * 250 * MS, there, 15_000, back)));
            }
            end = run(&mut corridor, &clocks, end + 2_750 * MS, true, &mut taken);
        }
        assert!(
            taken.contains(&Taken::Bent) && !taken.contains(&Taken::Stepped),
            "{there} + {back}: {taken:?}"
        );
    }
}

#[test]
fn a_step_soon_after_a_bend_begins_an_epoch() {
    let clocks = Clocks { offset: 0, rate: 0.0 };
    let mut corridor = Corridor::default();
    let end = run(&mut corridor, &clocks, 0, false, &mut Vec::new());
    let offset_at = |local: i64| ((local - end) as f64 * 500e-6).round() as i64;
    let slewed = |local: i64, stepped: i64| {
        let at = Clocks { offset: offset_at(local) + stepped, rate: 0.0 };
        at.exchange(local, 20_000, 15_000, 20_000)
    };
    let bent: Vec<_> = (0..40).map(|k| corridor.take(slewed(end + k * 50 * MS, 0))).collect();
    assert!(bent.contains(&Taken::Bent) && !bent.contains(&Taken::Stepped), "{bent:?}");
    assert_eq!(corridor.take(slewed(end + 2_000 * MS, 2 * MS)), Taken::Stepped);
}

#[test]
fn a_step_while_nothing_came_begins_an_epoch() {
    for (there, back) in [(20_000, 20_000), (150 * MS, MS)] {
        let clocks = Clocks { offset: 0, rate: 0.0 };
        let mut corridor = Corridor::default();
        let end = run(&mut corridor, &clocks, 0, false, &mut Vec::new()) + 60_000 * MS;
        let stepped = Clocks { offset: 100 * MS, ..clocks };
        let mut taken = vec![corridor.take(stepped.exchange(end, there, 15_000, back))];
        run(&mut corridor, &stepped, end + 250 * MS, false, &mut taken);
        assert!(taken[..2].contains(&Taken::Stepped), "{there} + {back}: {taken:?}");
    }
}

#[test]
fn stamps_that_cannot_be_true_change_nothing() {
    let mut corridor = Corridor::default();
    let good = Exchange { t1: 1_000, t2: 5_000, t3: 5_100, t4: 1_400 };
    for bad in [
        Exchange { t4: 900, ..good },
        Exchange { t3: 4_999, ..good },
        Exchange { t3: 5_500, ..good },
        Exchange { t4: 1_000 + 3_000 * MS, ..good },
        Exchange { t2: i64::MIN, t3: i64::MAX, ..good },
        Exchange { t1: i64::MIN, ..good },
    ] {
        assert_eq!(corridor.take(bad), Taken::Refused, "{bad:?}");
        assert_eq!(corridor.at(HostTime::from_ns(1_000)), None);
    }
    assert_eq!(corridor.take(good), Taken::Stepped);
    assert_eq!(corridor.take(good), Taken::Refused);
    check(&corridor, 4_000.0, 1_200);
}

proptest! {
    #[test]
    fn no_stamps_harm_it(
        stamps in prop::collection::vec((any::<i64>(), any::<i64>(), any::<i64>(), any::<i64>(), 0u8..8), 1..80),
    ) {
        let mut corridor = Corridor::default();
        let mut last = 0i64;
        for (a, b, c, d, kind) in stamps {
            // Some of them can be true, as far as one exchange shows.
            let t1 = last.saturating_add(a.rem_euclid(1_000_000_000));
            let (t2, on_way) = (b / i64::from(kind.max(1)), c.rem_euclid(1_000_000_000));
            let e = match kind {
                0 => Exchange { t1: a, t2: b, t3: c, t4: d },
                _ => Exchange { t1, t2, t3: t2, t4: t1.saturating_add(on_way) },
            };
            if corridor.take(e) != Taken::Refused {
                last = e.t1;
            }
            corridor.at(HostTime::from_ns(d));
            corridor.at(HostTime::from_ns(last));
        }
    }
}

#[test]
fn without_answers_the_uncertainty_grows() {
    let clocks = Clocks { offset: 0, rate: 0.0 };
    let mut corridor = Corridor::default();
    let end = run(&mut corridor, &clocks, 0, false, &mut Vec::new());
    let soon = corridor.at(HostTime::from_ns(end)).unwrap();
    let late = corridor.at(HostTime::from_ns(end + 60_000 * MS)).unwrap();
    assert!(late.uncertainty_ns >= soon.uncertainty_ns + 120_000, "{soon:?} {late:?}");
    // Two crystals that part by 2 ppm meanwhile.
    assert!(late.uncertainty_ns as f64 >= (late.offset_ns as f64 - 120_000.0).abs());
}
