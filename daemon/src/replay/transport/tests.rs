//! The controls against a model that moves its needle every millisecond.

use super::super::timeline::{Part, Timeline};
use super::*;
use depthrig_bus::StreamId;
use proptest::prelude::*;

const MS: i64 = 1_000_000;

fn timeline(times_ms: &[i64]) -> Arc<Timeline> {
    let id: StreamId = "cam/depth".parse().unwrap();
    let times: Vec<i64> = times_ms.iter().map(|t| t * MS).collect();
    let part = Part { name: String::new(), streams: vec![&id], times: &times };
    Arc::new(Timeline::new(&[part]).unwrap())
}

fn at(ms: i64) -> HostTime {
    HostTime::from_ns(77_000_000_000 + ms * MS)
}

const PLAY: Begin = Begin { by_clock: true, rate: 1.0, looped: false, hold: false, paused: false };

/// Runs a player that takes no time at `ms`; returns the moments that were published.
fn play(t: &mut Transport, ms: i64) -> Vec<usize> {
    let mut published = Vec::new();
    while let Order::Publish { moment, due, turn } = t.order(at(ms)) {
        if due > at(ms) {
            break;
        }
        published.push(moment);
        t.published(moment, turn, at(ms));
        assert!(published.len() < 1000, "it never ends");
    }
    published
}

/// Plays every millisecond from `from` to before `to`; returns when each moment was published.
fn run(t: &mut Transport, from: i64, to: i64) -> Vec<(i64, usize)> {
    (from..to).flat_map(|ms| play(t, ms).into_iter().map(move |m| (ms, m))).collect()
}

#[test]
fn a_pause_shifts_and_bunches_nothing() {
    let mut t = Transport::new(timeline(&[0, 200, 400, 600]), PLAY, at(0));
    assert_eq!(run(&mut t, 0, 250), [(0, 0), (200, 1)]);
    t.pause(at(250));
    assert_eq!(run(&mut t, 250, 9000), []);
    t.resume(at(9000)).unwrap();
    // 150 ms were left to the next one.
    assert_eq!(run(&mut t, 9000, 10_000), [(9150, 2), (9350, 3)]);
    assert_eq!(t.order(at(10_000)), Order::End);
    assert!(t.resume(at(10_000)).is_ok(), "it is not paused");
}

#[test]
fn a_new_rate_holds_from_where_it_is() {
    let mut t = Transport::new(timeline(&[0, 1000, 2000, 3000]), PLAY, at(0));
    assert_eq!(run(&mut t, 0, 500), [(0, 0)]);
    t.set_rate(10.0, at(500)).unwrap();
    assert_eq!(run(&mut t, 500, 600), [(550, 1)]);
    t.set_rate(0.1, at(600)).unwrap();
    // At 600 it is at 1500: half a second of the dataset is five seconds now.
    assert_eq!(run(&mut t, 600, 20_000), [(5600, 2), (15_600, 3)]);
    for bad in [0.09, 10.1, 0.0, -1.0, f64::NAN, f64::INFINITY] {
        let e = t.set_rate(bad, at(0)).unwrap_err();
        assert_eq!(e.kind(), ErrorKind::BadInput);
        assert!(e.to_string().contains("from 0.1 to 10"), "{e}");
    }
    let mut t = Transport::new(timeline(&[0, 1000]), Begin { by_clock: false, ..PLAY }, at(0));
    assert_eq!(t.set_rate(2.0, at(0)).unwrap_err().kind(), ErrorKind::WrongState);
    assert_eq!(play(&mut t, 0), [0, 1], "nothing is waited for");
}

#[test]
fn a_slow_disk_moves_what_follows_and_a_hiccup_does_not() {
    let mut t = Transport::new(timeline(&[0, 200, 400, 600, 800, 1000]), PLAY, at(0));
    assert_eq!(play(&mut t, 0), [0]);
    // The set due at 200 is there at 250, within the slack: the next one is on time.
    assert_eq!(run(&mut t, 250, 401), [(250, 1), (400, 2)]);
    // The one due at 600 is there at 1700: no burst, everything a second later.
    assert_eq!(run(&mut t, 1700, 3000), [(1700, 3), (1900, 4), (2100, 5)]);
}

#[test]
fn seeking_shows_at_once_and_plays_on_from_there() {
    let mut t = Transport::new(timeline(&[0, 200, 400, 600, 800]), PLAY, at(0));
    assert_eq!(run(&mut t, 0, 50), [(0, 0)]);
    t.seek(3);
    assert_eq!(run(&mut t, 50, 2000), [(50, 3), (250, 4)]);
    t.seek(1);
    assert_eq!(run(&mut t, 2000, 2100), [(2000, 1)]);
    t.pause(at(2100));
    t.seek(4);
    assert!(t.is_showing());
    assert_eq!(run(&mut t, 2100, 5000), [(2100, 4)]);
    assert!(!t.is_showing() && t.is_paused());
    assert_eq!(t.order(at(5000)), Order::Idle, "paused at the end is not the end");
    assert_eq!(t.resume(at(5000)).unwrap_err().kind(), ErrorKind::WrongState);
    // A seek while a set is being published: that set does not count as the place.
    t.seek(0);
    let Order::Publish { moment, turn, .. } = t.order(at(5000)) else { panic!() };
    t.seek(2);
    t.published(moment, turn, at(5001));
    assert_eq!(run(&mut t, 5001, 5100), [(5001, 2)]);
}

#[test]
fn steps_go_forward_and_back() {
    let mut t = Transport::new(timeline(&[0, 200, 400, 600]), Begin { paused: true, ..PLAY }, at(0));
    assert_eq!(run(&mut t, 0, 1000), []);
    assert_eq!(t.step(-1).unwrap_err().kind(), ErrorKind::WrongState);
    assert_eq!(t.step(0).unwrap_err().kind(), ErrorKind::BadInput);
    t.step(1).unwrap();
    assert_eq!(run(&mut t, 1000, 2000), [(1000, 0)]);
    t.step(2).unwrap();
    assert!(t.is_paused());
    assert_eq!(run(&mut t, 2000, 4000), [(2000, 1), (2200, 2)]);
    t.step(-1).unwrap();
    assert_eq!(run(&mut t, 4000, 5000), [(4000, 1)]);
    t.step(-7).unwrap();
    assert_eq!(run(&mut t, 5000, 6000), [(5000, 0)]);
    // More than there are: to the end, which is then no end.
    t.step(9).unwrap();
    assert_eq!(run(&mut t, 6000, 9000), [(6000, 1), (6200, 2), (6400, 3)]);
    assert_eq!(t.order(at(9000)), Order::Idle);
    assert_eq!(t.step(1).unwrap_err().kind(), ErrorKind::WrongState);
    t.set_loop(true);
    t.step(2).unwrap();
    assert_eq!(run(&mut t, 9000, 9900), [(9000, 0), (9200, 1)]);
    assert_eq!(t.rounds(), 2);
}

#[test]
fn rounds_are_apart_like_sets() {
    let mut t = Transport::new(timeline(&[0, 200, 400]), Begin { looped: true, ..PLAY }, at(0));
    assert_eq!(run(&mut t, 0, 1001), [(0, 0), (200, 1), (400, 2), (600, 0), (800, 1), (1000, 2)]);
    assert_eq!(t.rounds(), 2);
    t.set_loop(false);
    assert_eq!(t.order(at(1001)), Order::End);
    let mut t = Transport::new(timeline(&[0]), Begin { looped: true, ..PLAY }, at(0));
    assert_eq!(run(&mut t, 0, 401), [(0, 0), (200, 0), (400, 0)]);
    let mut t = Transport::new(timeline(&[0, 200]), Begin { hold: true, ..PLAY }, at(0));
    assert_eq!(run(&mut t, 0, 900), [(0, 0), (200, 1)]);
    assert_eq!((t.order(at(900)), t.is_paused()), (Order::Idle, true));
}

#[derive(Debug, Clone, Copy)]
enum Command {
    Pause,
    Resume,
    Rate(i64),
    Seek(usize),
    Step(i64),
}

/// Obviously right: a needle in tenths of a nanosecond that moves every millisecond.
struct Model {
    times: Vec<i64>,
    needle: i64,
    rate_tenths: i64,
    paused: bool,
    steps: i64,
    next: usize,
}

impl Model {
    fn publish(&mut self, out: &mut Vec<usize>) {
        out.push(self.next);
        self.next += 1;
        if self.steps > 0 {
            self.steps -= 1;
            if self.steps == 0 {
                self.paused = true;
                self.needle = self.times[self.next - 1] * 10;
            }
        }
    }

    fn show(&mut self, moment: usize, out: &mut Vec<usize>) {
        self.next = moment;
        self.needle = self.times[moment] * 10;
        self.publish(out);
    }

    fn command(&mut self, c: Command, out: &mut Vec<usize>) {
        let end = self.next >= self.times.len();
        match c {
            Command::Pause => (self.paused, self.steps) = (true, 0),
            Command::Resume if self.paused && end => {}
            Command::Resume => (self.paused, self.steps) = (false, 0),
            Command::Rate(tenths) => self.rate_tenths = tenths,
            Command::Seek(to) => {
                if std::mem::take(&mut self.steps) > 0 {
                    self.paused = true;
                }
                self.show(to % self.times.len(), out);
            }
            Command::Step(n) if n > 0 && !end => {
                (self.paused, self.steps) = (false, n);
                self.show(self.next, out);
            }
            Command::Step(n) if n < 0 && self.next > 1 => {
                self.steps = 0;
                self.show((self.next - 1).saturating_sub(-n as usize), out);
                self.paused = true;
            }
            Command::Step(_) => {}
        }
    }

    fn tick(&mut self, out: &mut Vec<usize>) {
        loop {
            if self.next >= self.times.len() {
                if self.steps > 0 {
                    (self.paused, self.steps) = (true, 0);
                }
                return;
            }
            if self.paused || self.times[self.next] * 10 > self.needle {
                return;
            }
            self.publish(out);
        }
    }
}

fn commands() -> impl Strategy<Value = Vec<(i64, Command)>> {
    let command = prop_oneof![
        Just(Command::Pause),
        Just(Command::Resume),
        prop::sample::select(vec![1, 5, 10, 20, 50, 100]).prop_map(Command::Rate),
        (0usize..40).prop_map(Command::Seek),
        prop_oneof![1i64..5, -4i64..0].prop_map(Command::Step),
    ];
    proptest::collection::vec((1i64..700, command), 0..14)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]
    #[test]
    fn any_sequence_of_commands_does_as_the_needle_does(
        gaps in proptest::collection::vec(1i64..300, 1..25),
        commands in commands(),
    ) {
        let times: Vec<i64> = std::iter::once(0)
            .chain(gaps.iter().scan(0, |t, g| { *t += g; Some(*t) }))
            .collect();
        let mut t = Transport::new(timeline(&times), PLAY, at(0));
        let mut model = Model {
            times: times.iter().map(|t| t * MS).collect(),
            needle: 0, rate_tenths: 10, paused: false, steps: 0, next: 0,
        };
        let mut commands = commands.into_iter();
        let mut coming = commands.next();
        let mut wait = coming.map_or(i64::MAX, |c| c.0);
        for ms in 0..12_000 {
            let mut expected = Vec::new();
            let mut got = Vec::new();
            model.tick(&mut expected);
            got.extend(play(&mut t, ms));
            if let (Some((_, c)), 0) = (coming, wait) {
                match c {
                    Command::Pause => t.pause(at(ms)),
                    Command::Resume => drop(t.resume(at(ms))),
                    Command::Rate(tenths) => t.set_rate(tenths as f64 / 10.0, at(ms)).unwrap(),
                    Command::Seek(to) => t.seek(to % times.len()),
                    Command::Step(n) => drop(t.step(n)),
                }
                model.command(c, &mut expected);
                got.extend(play(&mut t, ms));
                coming = commands.next();
                wait = coming.map_or(i64::MAX, |c| c.0);
            }
            prop_assert_eq!(&got, &expected, "at {} ms", ms);
            wait -= 1;
            if !model.paused {
                model.needle += model.rate_tenths * MS;
            }
        }
    }
}
