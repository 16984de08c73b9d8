//! The cycle against a slow model, which counts down each moment and keeps the whole history.

use super::*;
use EpisodeOutcome::{Failure, Success};
use proptest::prelude::*;

const PLAN: Plan = Plan { episodes: 2, length_ns: 20, reset_ns: 5 };

fn at(ns: i64) -> HostTime {
    HostTime::from_ns(ns)
}

/// Steps; an episode that the cycle asks for has begun at once.
fn step(cycle: &mut Cycle, ns: i64, input: Input) -> Vec<Action> {
    let actions = cycle.step(at(ns), input);
    if actions.contains(&Action::Begin) {
        assert_eq!(cycle.step(at(ns), Input::Begun), []);
    }
    actions
}

#[test]
fn time_alone_makes_the_episodes() {
    let mut cycle = Cycle::new(PLAN, at(100));
    assert_eq!(cycle.due(), Some(at(105)));
    assert_eq!(step(&mut cycle, 104, Input::Tick), []);
    assert_eq!(step(&mut cycle, 105, Input::Tick), [Action::Begin, Action::Bell]);
    assert_eq!(step(&mut cycle, 124, Input::Tick), []);
    // A tick that is late: the pause is complete all the same.
    assert_eq!(step(&mut cycle, 130, Input::Tick), [Action::Keep(None), Action::Bell]);
    assert_eq!((cycle.kept(), cycle.due()), (1, Some(at(135))));
    assert_eq!(step(&mut cycle, 135, Input::Tick), [Action::Begin, Action::Bell]);
    assert_eq!(step(&mut cycle, 155, Input::Tick), [Action::Keep(None), Action::Bell, Action::Finish]);
    assert_eq!((cycle.phase(), cycle.due()), (Phase::Done, None));
    assert_eq!(step(&mut cycle, 200, Input::Key(Key::Next)), []);
}

#[test]
fn an_episode_has_its_full_length_from_when_the_rig_began_it() {
    let mut cycle = Cycle::new(PLAN, at(0));
    assert_eq!(cycle.step(at(5), Input::Tick), [Action::Begin, Action::Bell]);
    assert_eq!(cycle.step(at(30), Input::Tick), []);
    assert_eq!(cycle.step(at(30), Input::Begun), []);
    assert_eq!(cycle.due(), Some(at(50)));
}

#[test]
fn keys_end_repeat_and_judge() {
    let mut cycle = Cycle::new(PLAN, at(0));
    // Nothing can be repeated or judged yet.
    assert_eq!(step(&mut cycle, 1, Input::Key(Key::Again)), []);
    assert_eq!(step(&mut cycle, 1, Input::Key(Key::Judge(Success))), []);
    assert_eq!(step(&mut cycle, 2, Input::Key(Key::Next)), [Action::Begin, Action::Bell]);
    assert_eq!(step(&mut cycle, 3, Input::Key(Key::Judge(Failure))), []);
    assert_eq!(step(&mut cycle, 4, Input::Key(Key::Judge(Success))), []);
    assert_eq!(step(&mut cycle, 6, Input::Key(Key::Next)), [Action::Keep(Some(Success)), Action::Bell]);
    assert_eq!(step(&mut cycle, 7, Input::Key(Key::Judge(Failure))), [Action::JudgeLast(Failure)]);
    assert_eq!(step(&mut cycle, 8, Input::Key(Key::Again)), [Action::DiscardLast]);
    // Once: it is gone, the one before it is not touched, and the pause goes on.
    assert_eq!(step(&mut cycle, 8, Input::Key(Key::Again)), []);
    assert_eq!(step(&mut cycle, 8, Input::Key(Key::Judge(Success))), []);
    assert_eq!((cycle.kept(), cycle.due()), (0, Some(at(11))));
    step(&mut cycle, 11, Input::Tick);
    assert_eq!(step(&mut cycle, 12, Input::Key(Key::Again)), [Action::Discard, Action::Bell]);
    assert_eq!((cycle.kept(), cycle.due()), (0, Some(at(17))));
    step(&mut cycle, 17, Input::Tick);
    assert_eq!(step(&mut cycle, 18, Input::Key(Key::Stop)), [Action::Discard, Action::Finish]);
}

#[test]
fn a_stop_in_a_pause_discards_nothing() {
    let mut cycle = Cycle::new(PLAN, at(0));
    step(&mut cycle, 1, Input::Key(Key::Next));
    step(&mut cycle, 2, Input::Key(Key::Next));
    assert_eq!(step(&mut cycle, 3, Input::Key(Key::Stop)), [Action::Finish]);
    assert_eq!(cycle.kept(), 1);
}

#[test]
fn an_end_from_elsewhere_counts_as_it_was_meant() {
    let mut cycle = Cycle::new(PLAN, at(0));
    step(&mut cycle, 1, Input::Key(Key::Next));
    assert_eq!(step(&mut cycle, 2, Input::EndedElsewhere { is_discarded: true }), [Action::Bell]);
    assert_eq!((cycle.kept(), step(&mut cycle, 2, Input::Key(Key::Again))), (0, vec![]));
    step(&mut cycle, 3, Input::Key(Key::Next));
    assert_eq!(step(&mut cycle, 4, Input::EndedElsewhere { is_discarded: false }), [Action::Bell]);
    assert_eq!((cycle.kept(), step(&mut cycle, 4, Input::Key(Key::Again))), (1, vec![Action::DiscardLast]));
}

/// An episode in the books of the model or of the rig.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Entry {
    begin: i64,
    end: i64,
    outcome: Option<EpisodeOutcome>,
    is_discarded: bool,
}

/// The books of a rig that does what the cycle asks for. It is asked when it is due and when a key is pressed.
fn carried_out(plan: Plan, keys: &[Vec<Key>]) -> (Vec<Entry>, bool) {
    let mut cycle = Cycle::new(plan, at(0));
    let mut books: Vec<Entry> = Vec::new();
    let mut running: Option<i64> = None;
    let mut is_finished = false;
    for (now, pressed) in keys.iter().enumerate() {
        let now = now as i64;
        let due = cycle.due().is_some_and(|due| due <= at(now)).then_some(Input::Tick);
        for input in due.into_iter().chain(pressed.iter().map(|k| Input::Key(*k))) {
            for action in step(&mut cycle, now, input) {
                assert!(!is_finished, "nothing follows the end");
                match action {
                    Action::Begin => assert_eq!(running.replace(now), None),
                    Action::Keep(outcome) => {
                        let begin = running.take().unwrap();
                        books.push(Entry { begin, end: now, outcome, is_discarded: false });
                    }
                    Action::Discard => {
                        let begin = running.take().unwrap();
                        books.push(Entry { begin, end: now, outcome: None, is_discarded: true });
                    }
                    Action::DiscardLast => books.last_mut().unwrap().is_discarded = true,
                    Action::JudgeLast(outcome) => books.last_mut().unwrap().outcome = Some(outcome),
                    Action::Bell => {}
                    Action::Finish => is_finished = true,
                }
            }
        }
        let kept = books.iter().filter(|e| !e.is_discarded).count();
        assert_eq!(kept as u32, cycle.kept());
        assert_eq!(is_finished, cycle.phase() == Phase::Done);
    }
    (books, is_finished)
}

/// The same books, one moment after the other: a rest that is counted down, and the number of kept episodes counted anew each time.
fn counted_down(plan: Plan, keys: &[Vec<Key>]) -> (Vec<Entry>, bool) {
    let mut books: Vec<Entry> = Vec::new();
    let mut is_running = false;
    let mut is_over = false;
    let mut rest = plan.reset_ns;
    for (now, pressed) in keys.iter().enumerate() {
        let now = now as i64;
        let timeout = (rest == 0).then_some(Key::Next);
        for key in timeout.into_iter().chain(pressed.iter().copied()) {
            if is_over {
                break;
            }
            let is_first = books.is_empty();
            if is_running {
                let ends = matches!(key, Key::Next | Key::Again | Key::Stop);
                let last = books.last_mut().unwrap();
                last.end = now;
                last.is_discarded = matches!(key, Key::Again | Key::Stop);
                if let Key::Judge(outcome) = key {
                    last.outcome = Some(outcome);
                }
                if ends {
                    is_running = false;
                    rest = plan.reset_ns;
                    let kept = books.iter().filter(|e| !e.is_discarded).count() as u32;
                    is_over = key == Key::Stop || kept == plan.episodes;
                }
            } else {
                match key {
                    Key::Next => {
                        books.push(Entry { begin: now, end: now, outcome: None, is_discarded: false });
                        is_running = true;
                        rest = plan.length_ns;
                    }
                    Key::Stop => is_over = true,
                    Key::Again if !is_first => books.last_mut().unwrap().is_discarded = true,
                    Key::Judge(outcome) if !is_first && !books.last().unwrap().is_discarded => {
                        books.last_mut().unwrap().outcome = Some(outcome);
                    }
                    Key::Again | Key::Judge(_) => {}
                }
            }
        }
        rest -= 1;
    }
    if is_running {
        books.pop();
    }
    (books, is_over)
}

fn key() -> impl Strategy<Value = Key> {
    prop_oneof![
        6 => Just(Key::Next),
        4 => Just(Key::Again),
        3 => Just(Key::Judge(Success)),
        3 => Just(Key::Judge(Failure)),
        1 => Just(Key::Stop),
    ]
}

proptest! {
    #[test]
    fn the_cycle_does_what_a_countdown_does(
        episodes in 1_u32..5,
        length_ns in 1_i64..6,
        reset_ns in 1_i64..4,
        keys in prop::collection::vec(prop_oneof![
            4 => Just(Vec::new()),
            1 => prop::collection::vec(key(), 1..4),
        ], 1..80),
    ) {
        let plan = Plan { episodes, length_ns, reset_ns };
        let (mut done, done_over) = carried_out(plan, &keys);
        let (mut expected, expected_over) = counted_down(plan, &keys);
        // A discarded episode's judgement is nobody's concern.
        for entry in done.iter_mut().chain(&mut expected).filter(|e| e.is_discarded) {
            entry.outcome = None;
        }
        prop_assert_eq!(done, expected);
        prop_assert_eq!(done_over, expected_over);
    }
}
