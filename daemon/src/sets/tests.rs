//! The assembler against a slow model that knows every frame, and the properties that hold for every input.

use super::*;
use model::{Event, Fate, model};
use proptest::prelude::*;
use std::rc::Rc;

mod model;

const MS: i64 = 1_000_000;

fn t(ms: i64) -> HostTime {
    HostTime::from_ns(ms * MS)
}

fn fixed(period_ms: i64, streams_ms: &[i64]) -> AssemblerConfig {
    let streams = streams_ms.iter().map(|p| p * MS).collect();
    AssemblerConfig { phase: PhasePolicy::Fixed, ..AssemblerConfig::new(period_ms * MS, streams) }
}

/// An item that knows whether it is still held.
type Tracked = Rc<()>;

/// Results of the assembler for the events: sets as (tick, stamps), and the accounts.
struct Outcome {
    sets: Vec<(i64, Vec<Option<i64>>)>,
    accounts: Vec<Account>,
    most_held: u64,
}

fn play(config: &AssemblerConfig, events: &[Event]) -> Outcome {
    let alive: Tracked = Rc::new(());
    let mut assembler: Assembler<Tracked> = Assembler::new(config.clone());
    let mut outcome = Outcome { sets: Vec::new(), accounts: Vec::new(), most_held: 0 };
    for event in events {
        match *event {
            Event::Push { stream, stamp } => {
                assembler.push(stream, HostTime::from_ns(stamp), Rc::clone(&alive));
            }
            Event::Active { stream, active } => assembler.set_stream_active(stream, active),
            Event::Poll { now } => {
                while let Some(set) = assembler.poll(HostTime::from_ns(now)) {
                    assert_eq!(set.id, outcome.sets.len() as u64 + 1);
                    check_set(&set);
                    let stamps = set.members.iter().map(|m| m.as_ref().map(|m| m.capture.ns())).collect();
                    outcome.sets.push((set.tick.ns(), stamps));
                }
            }
        }
        let accounts = assembler.accounts();
        for a in accounts {
            assert_eq!(
                a.pushed,
                a.used + a.decimated + a.late + a.out_of_order + a.overflow + a.pending,
                "{a:?}"
            );
            assert!(a.pending <= config.max_pending as u64);
            outcome.most_held = outcome.most_held.max(a.pending);
        }
        let held: u64 = accounts.iter().map(|a| a.pending).sum();
        assert_eq!(Rc::strong_count(&alive) as u64 - 1, held, "frames that are not pending must be let go");
    }
    outcome.accounts = assembler.accounts().to_vec();
    outcome
}

fn check_set(set: &FrameSet<Tracked>) {
    let stamps: Vec<i64> = set.members.iter().flatten().map(|m| m.capture.ns()).collect();
    assert!(!stamps.is_empty());
    assert_eq!(set.spread_ns, stamps.iter().max().unwrap() - stamps.iter().min().unwrap());
    for (i, m) in set.members.iter().enumerate() {
        assert_eq!(set.missing >> i & 1 == 1, m.is_none());
        assert!(m.as_ref().is_none_or(|m| m.skew_ns == m.capture.since_ns(set.tick)));
    }
    assert_eq!(set.is_complete(), set.missing == 0);
}

/// One frame of a generated stream: jitter in percent of the period, what happens to it, its delivery time.
type Shot = (i64, u8, i64);

/// Streams with jitter, losses, repeated and backward stamps, stalls, and cameras lost and found.
fn events() -> impl Strategy<Value = (Vec<i64>, Vec<Event>)> {
    let period = prop_oneof![Just(11), Just(17), Just(33), Just(40), Just(67), Just(200), Just(450)];
    let shot = (-45i64..45, 0u8..40, 0i64..70);
    let stream = (period, -100i64..300, prop::collection::vec(shot, 0..70));
    let polls = prop::collection::vec((0i64..3000, any::<bool>()), 0..60);
    (prop::collection::vec(stream, 1..5), polls, any::<bool>()).prop_map(|(streams, polls, eager)| {
        let mut timed: Vec<(i64, usize, Event)> = Vec::new();
        for (i, (period, phase, shots)) in streams.iter().enumerate() {
            shoot(i, *period, *phase, shots, &mut timed);
        }
        for (at, _) in &polls {
            timed.push((at * MS, usize::MAX, Event::Poll { now: at * MS }));
        }
        timed.sort_by_key(|(at, order, _)| (*at, *order));
        let mut events = Vec::new();
        for (at, _, event) in timed {
            let push = matches!(event, Event::Push { .. });
            events.push(event);
            if eager && push {
                events.push(Event::Poll { now: at });
            }
        }
        (streams.iter().map(|s| s.0 * MS).collect(), events)
    })
}

fn shoot(stream: usize, period: i64, phase: i64, shots: &[Shot], out: &mut Vec<(i64, usize, Event)>) {
    let mut stalled = 0;
    let mut last = 0;
    for (i, &(jitter, kind, delivery)) in shots.iter().enumerate() {
        let mut stamp = (phase + i as i64 * period) * MS + jitter * period * MS / 100;
        let active = |active| Event::Active { stream, active };
        match kind {
            0 | 1 => continue,                                    // lost
            2 => stamp = last,                                    // the same stamp again
            3 => stamp -= 3 * period * MS,                        // back in time
            4 => stalled = stamp + (delivery * 40 + period) * MS, // nothing arrives for a while
            5 => out.push((stamp, stream, active(false))),
            6 => out.push((stamp, stream, active(true))),
            7 => stamp = (stamp + 100 * MS) / (200 * MS) * (200 * MS), // exactly on a tick
            _ => {}
        }
        last = stamp;
        let arrival = (stamp + delivery * MS).max(stalled);
        stalled = stalled.max(arrival); // one stream's frames arrive in the order they were sent
        out.push((arrival, stream, Event::Push { stream, stamp }));
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(1000))]

    #[test]
    fn equals_the_model(
        (streams, events) in events(),
        max_wait in prop_oneof![Just(0), Just(50), Just(150), Just(700)],
        tolerance in prop::option::of(1i64..150),
    ) {
        let mut config = AssemblerConfig {
            max_wait_ns: max_wait * MS,
            max_pending: usize::MAX,
            phase: PhasePolicy::Fixed,
            ..AssemblerConfig::new(200 * MS, streams)
        };
        if let Some(ms) = tolerance {
            config.tolerance_ns = vec![ms * MS];
        }
        let outcome = play(&config, &events);
        let (sets, fates) = model(&config, &events);
        prop_assert_eq!(&outcome.sets, &sets);
        for (i, a) in outcome.accounts.iter().enumerate() {
            let count = |fate| fates.iter().filter(|(s, f)| *s == i && *f == fate).count() as u64;
            let want = Account {
                pushed: fates.iter().filter(|(s, _)| *s == i).count() as u64,
                used: count(Fate::Used),
                decimated: count(Fate::Decimated),
                late: count(Fate::Late),
                out_of_order: count(Fate::OutOfOrder),
                overflow: 0,
                pending: count(Fate::Pending),
            };
            prop_assert_eq!(*a, want, "stream {}", i);
        }
    }

    /// With a moving phase and little room: no reuse, no crossing, no crowding, the books balance (in `play`).
    #[test]
    fn keeps_its_promises_while_the_phase_moves((streams, events) in events(), max_pending in 1usize..4) {
        let config = AssemblerConfig { max_pending, ..AssemblerConfig::new(200 * MS, streams) };
        let outcome = play(&config, &events);
        for pair in outcome.sets.windows(2) {
            prop_assert!(pair[1].0 - pair[0].0 >= 100 * MS, "sets {} and {} ns", pair[0].0, pair[1].0);
        }
        for i in 0..config.stream_period_ns.len() {
            let stamps: Vec<i64> = outcome.sets.iter().filter_map(|(_, s)| s[i]).collect();
            prop_assert!(stamps.windows(2).all(|w| w[1] > w[0]), "stream {i} crosses or is used twice");
            let tolerance = config.stream_period_ns[i] / 2 + MS;
            for (tick, set) in &outcome.sets {
                prop_assert!(set[i].is_none_or(|s| (s - tick).abs() <= tolerance));
            }
        }
        let again = play(&config, &events);
        prop_assert_eq!((outcome.sets, outcome.accounts), (again.sets, again.accounts), "must be deterministic");
    }

    #[test]
    fn absurd_numbers_do_no_harm(
        numbers in prop::collection::vec((0usize..4, any::<i64>(), any::<i64>(), 0u8..8), 1..60),
        period in any::<i64>(),
        streams in prop::collection::vec(any::<i64>(), 0..3),
        max_wait_ns in any::<i64>(),
        auto: bool,
    ) {
        let phase = if auto { PhasePolicy::MinimiseSpread } else { PhasePolicy::Fixed };
        let config = AssemblerConfig { max_wait_ns, phase, ..AssemblerConfig::new(period, streams.clone()) };
        let mut assembler = Assembler::new(config);
        for (stream, a, b, act) in numbers {
            let stamp = if act < 4 { a } else { a % 1_000_000_000 };
            assembler.push(stream, HostTime::from_ns(stamp), ());
            let mut polled = 0;
            while polled < 100 && assembler.poll(HostTime::from_ns(if act % 2 == 0 { b } else { stamp })).is_some() {
                polled += 1;
            }
            prop_assert!(polled < 100, "sets without frames");
            let _ = assembler.next_deadline();
        }
    }
}

#[test]
fn a_set_is_sent_when_no_frame_can_change_it() {
    let mut a = Assembler::new(fixed(200, &[33, 33]));
    a.push(0, t(195), 'a');
    a.push(1, t(190), 'b');
    assert!(a.poll(t(195)).is_none(), "a nearer frame may come");
    a.push(0, t(228), 'c');
    a.push(1, t(208), 'd');
    let set = a.poll(t(229)).unwrap();
    assert_eq!((set.id, set.tick, set.missing, set.spread_ns), (1, t(200), 0, 13 * MS));
    assert_eq!(
        set.members.iter().flatten().map(|m| (m.item, m.skew_ns / MS)).collect::<Vec<_>>(),
        [('a', -5), ('d', 8)]
    );
    assert!(a.poll(t(229)).is_none());
}

#[test]
fn of_two_equally_near_frames_the_earlier_is_taken() {
    let mut a = Assembler::new(fixed(200, &[33]));
    a.push(0, t(190), 'a');
    a.push(0, t(210), 'b');
    assert_eq!(a.poll(t(211)).unwrap().members[0].as_ref().unwrap().item, 'a');
}

#[test]
fn the_deadline_sends_what_there_is_and_late_frames_are_counted() {
    let mut a = Assembler::new(fixed(200, &[33, 33]));
    a.push(0, t(201), ());
    assert_eq!(a.next_deadline(), Some(HostTime::from_ns(400 * MS + 49_500_000)));
    a.push(0, t(401), ());
    assert!(a.poll(t(449)).is_none());
    let set = a.poll(t(450)).unwrap();
    assert_eq!((set.tick, set.missing), (t(400), 0b10));
    a.push(1, t(366), ()); // not near enough to 400
    a.push(1, t(399), ());
    a.push(1, t(432), ());
    a.push(1, t(432), ());
    let want = Account { pushed: 4, decimated: 2, late: 1, out_of_order: 1, ..Account::default() };
    assert_eq!(a.accounts()[1], want);
}

#[test]
fn a_lost_stream_holds_nothing_up() {
    let mut a = Assembler::new(fixed(200, &[33, 33]));
    a.push(0, t(200), ());
    assert!(a.poll(t(201)).is_none());
    a.set_stream_active(1, false);
    let set = a.poll(t(201)).unwrap();
    assert_eq!((set.missing, set.is_complete()), (0b10, false));
    a.set_stream_active(0, false);
    assert_eq!(a.next_deadline(), None);
    assert!(a.poll(t(9000)).is_none(), "no frames, no sets");
    a.set_stream_active(1, true);
    a.push(1, t(9000), ());
    a.push(1, t(9033), ());
    assert_eq!(a.poll(t(9034)).unwrap().missing, 0b01);
}

#[test]
fn hours_without_a_frame_are_passed_over_at_once() {
    let mut a = Assembler::new(AssemblerConfig { tolerance_ns: vec![0, 0], ..fixed(1, &[33, 33]) });
    a.push(0, t(0), ());
    let _ = a.poll(t(50));
    let months = 10_000_000_000; // four months of 1 ms ticks
    assert!(a.poll(t(months)).is_none());
    a.push(0, t(months), ());
    a.push(1, t(months), ());
    assert_eq!(a.poll(t(months + 1)).unwrap().tick, t(months));
}

#[test]
fn more_than_64_streams_are_told_by_members() {
    let mut a = Assembler::new(fixed(200, &[33; 70]));
    (0..69).for_each(|i| a.push(i, t(200), i));
    a.push(99, t(200), 99);
    let set = a.poll(t(300)).unwrap();
    assert_eq!((set.missing, set.is_complete(), set.members.len()), (0, false, 70));
    assert!(set.members[69].is_none());
    assert_eq!(a.strays(), 1);
}

#[test]
fn the_oldest_goes_when_too_many_wait() {
    let mut config = fixed(200, &[33, 33]);
    (config.max_pending, config.tolerance_ns, config.max_wait_ns) = (2, vec![300 * MS; 2], 1000 * MS);
    let mut a = Assembler::new(config);
    for i in 0..12 {
        a.push(0, t(i * 33), ());
    }
    let account = a.accounts()[0];
    assert!(account.overflow > 0 && account.pending == 2, "{account:?}");
}

/// Frames of `rates` with phases from `seed`, one poll after each; sets of the last half: (mean spread, complete).
fn free_running(rates: &[f64], seed: u64, phase: PhasePolicy) -> (f64, u64, Vec<Account>) {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    let mut random = || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 11) as f64 / (1u64 << 53) as f64
    };
    let seconds = 60.0;
    let mut frames = Vec::new();
    for (stream, rate) in rates.iter().enumerate() {
        let period = 1e9 / rate;
        let offset = random();
        let ppm = (random() - 0.5) * 100.0;
        for i in 0..(seconds * rate) as i64 {
            let stamp = (i as f64 + offset) * period * (1.0 + ppm * 1e-6) + random() * 20_000.0;
            frames.push((stamp as i64 + 5 * MS + (random() * 1e6) as i64, stream, stamp as i64));
        }
    }
    frames.sort_unstable();
    let periods = rates.iter().map(|r| (1e9 / r) as i64).collect();
    let mut a = Assembler::new(AssemblerConfig { phase, ..AssemblerConfig::new(200 * MS, periods) });
    let mut spreads = Vec::new();
    let mut most_held = 0;
    for (arrival, stream, stamp) in frames {
        a.push(stream, HostTime::from_ns(stamp), ());
        while let Some(set) = a.poll(HostTime::from_ns(arrival)) {
            if set.tick.ns() as f64 > seconds / 2.0 * 1e9 && (set.tick.ns() as f64) < (seconds - 0.5) * 1e9 {
                assert!(set.is_complete());
                spreads.push(set.spread_ns as f64);
            }
        }
        most_held = most_held.max(a.accounts().iter().map(|a| a.pending).max().unwrap_or(0));
    }
    assert!(spreads.len() >= 145, "{}", spreads.len());
    (spreads.iter().sum::<f64>() / spreads.len() as f64 / 1e6, most_held, a.accounts().to_vec())
}

#[test]
fn a_chosen_phase_gains_four_milliseconds_on_seven_free_cameras() {
    let mean = |rates: &[f64], phase| {
        let runs: Vec<_> = (1..=100).map(|seed| free_running(rates, seed, phase)).collect();
        let held = runs.iter().map(|r| r.1).max().unwrap();
        (runs.iter().map(|r| r.0).sum::<f64>() / 100.0, held)
    };
    let (fixed, held_fixed) = mean(&[30.0; 7], PhasePolicy::Fixed);
    let (chosen, held) = mean(&[30.0; 7], PhasePolicy::MinimiseSpread);
    println!(
        "7 x 30 Hz: fixed {fixed:.2} ms, chosen {chosen:.2} ms; at most {held_fixed} and {held} frames held"
    );
    // T (n-1)/(n+1) = 25.0 ms and T (1 - H_n/n) = 21.0 ms.
    assert!((fixed - 25.0).abs() < 1.0 && (chosen - 21.0).abs() < 1.0);
    assert!(held_fixed <= 2 && held <= 3);
    let mixed = [15.0, 30.0, 30.0, 60.0, 60.0, 30.0, 15.0];
    let (fixed, _) = mean(&mixed, PhasePolicy::Fixed);
    let (chosen, held) = mean(&mixed, PhasePolicy::MinimiseSpread);
    println!("15/30/60 Hz: fixed {fixed:.2} ms, chosen {chosen:.2} ms; at most {held} frames held");
    assert!(chosen < fixed - 4.0 && held <= 3);
}

#[test]
fn no_frame_is_late_or_lost_in_a_quiet_rig() {
    let (_, _, accounts) = free_running(&[30.0, 15.0, 60.0], 3, PhasePolicy::MinimiseSpread);
    for a in accounts {
        assert_eq!((a.late, a.out_of_order, a.overflow), (0, 0, 0));
        assert!(a.used >= 290);
    }
}

/// Sets of two streams at 30 Hz for `seconds`, with the clock of the grid ahead by `offset` at each local time.
fn aligned(seconds: i64, mut offset: impl FnMut(i64) -> (i64, bool)) -> Vec<i64> {
    let config = AssemblerConfig { phase: PhasePolicy::Aligned, ..fixed(200, &[33, 33]) };
    let mut assembler: Assembler<()> = Assembler::new(config);
    let mut ticks = Vec::new();
    for i in 0..seconds * 30 {
        let now = i * 33 * MS;
        let (offset, at_once) = offset(now);
        assembler.align(offset, at_once);
        for stream in 0..2 {
            assembler.push(stream, HostTime::from_ns(now + stream as i64 * 5 * MS), ());
        }
        while let Some(set) = assembler.poll(HostTime::from_ns(now + 10 * MS)) {
            assert!(set.is_complete() || ticks.is_empty(), "{set:?}");
            ticks.push(set.tick.ns());
        }
    }
    assert!(ticks.windows(2).all(|w| w[1] > w[0]));
    ticks
}

/// How far a time of the clock of the grid is from it.
fn from_grid(time: i64) -> i64 {
    let beyond = time.rem_euclid(200 * MS);
    beyond.min(200 * MS - beyond)
}

#[test]
fn ticks_lie_on_the_grid_of_the_other_clock() {
    for offset in [0, 77 * MS, -123_456_789_012_345, 86_400_000 * MS + 1] {
        // It drifts by 100 ppm: in a period, by which the tick is known ahead, 20 us.
        let drifting = |now: i64| offset + now / 10_000;
        let ticks = aligned(20, |now| (drifting(now), false));
        assert!(ticks.len() > 90);
        for tick in ticks {
            assert!(from_grid(tick + drifting(tick)) <= 30_000, "{offset}: {tick}");
        }
    }
}

#[test]
fn a_clock_that_is_known_late_or_steps_moves_the_ticks_at_once() {
    let step_at = 5_000 * MS;
    let stepped = |now: i64| if now < step_at { 0 } else { 60 * MS };
    let mut before = 0;
    let ticks = aligned(12, |now| {
        let offset = stepped(now);
        let at_once = offset != before;
        before = offset;
        (offset, at_once)
    });
    let wrong = ticks.iter().filter(|t| from_grid(**t + stepped(**t)) != 0).count();
    assert!(wrong <= 2, "{wrong}");
    // Without that it takes its time, and sets stay as far apart as before.
    let slow = aligned(12, |now| (stepped(now), false));
    assert!(slow.windows(2).all(|w| (w[1] - w[0] - 200 * MS).abs() <= 2 * MS));
    assert_eq!(from_grid(slow.last().unwrap() + 60 * MS), 0);
}

#[test]
fn the_phase_is_chosen_for_the_streams_of_other_hosts_too() {
    // Two streams here at 0 and 2 ms, two far ones at 20 and 22 ms of 33.3 ms: the widest gap of all four lies between 2 and 20 ms,
    // while that of the own two alone lies opposite 1 ms.
    let third = 33_333_333;
    let run = |far: bool| {
        let config = AssemblerConfig::new(200 * MS, vec![third, third]);
        let mut assembler: Assembler<()> = Assembler::new(config);
        let mut last = 0;
        for i in 0..600 {
            let now = i * third;
            if far {
                let rhythm =
                    |at: i64| Rhythm { newest_ns: now + at * MS, period_ns: 1e9 / 30.0, tolerance_ns: third };
                assembler.set_far(vec![rhythm(20), rhythm(22)]);
            }
            for stream in 0..2 {
                assembler.push(stream, HostTime::from_ns(now + stream as i64 * 2 * MS), ());
            }
            while let Some(set) = assembler.poll(HostTime::from_ns(now + 40 * MS)) {
                last = set.tick.ns();
            }
        }
        (last.rem_euclid(third) as f64 / 1e6, assembler.rhythms().count())
    };
    let (alone, count) = run(false);
    assert_eq!(count, 2);
    // Opposite 17.7 ms, the middle of the gap from 2 to 33.3.
    assert!((alone - 1.0).abs() < 1.0 || (alone - 34.3).abs() < 1.0, "{alone}");
    // Opposite 11 ms, the middle of the gap from 2 to 20.
    let (together, _) = run(true);
    assert!((together - 27.7).abs() < 1.0, "{together}");
}
