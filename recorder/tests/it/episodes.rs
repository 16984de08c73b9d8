//! Episodes: demonstrations within a recording, through a crash, cutting, joining and later judgement.

use crate::support::*;
use depthrig_recorder::fs::{Fs, MemFs};
use depthrig_recorder::{
    Dataset, Edge, Episode, EpisodeEnd, EpisodeOutcome, ErrorKind, NOTE_MAX_BYTES, Recorder, RecoverOptions,
    SESSION_FILE, Session, SessionChanges, SetSpan, SliceOptions, edit, merge, recover_with, trim,
};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

const SUCCESS: EpisodeEnd = EpisodeEnd::Kept(Some(EpisodeOutcome::Success));
const TASK: &str = "put the \"cup\" on\nthe plate \u{1f375}";

fn text(fs: &MemFs) -> String {
    String::from_utf8(contents(fs, &dir().join(SESSION_FILE))).unwrap()
}

/// Waits until `session.toml` has this.
fn saved(fs: &MemFs, what: &str) {
    for _ in 0..2000 {
        if text(fs).contains(what) {
            return;
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    panic!("{what:?} is not in {}", text(fs));
}

fn states(episodes: &[Episode]) -> Vec<(u32, &'static str, bool)> {
    episodes.iter().map(|e| (e.number, e.state(), e.is_used())).collect()
}

#[test]
fn a_killed_recording_keeps_its_episodes_and_the_one_that_ran_is_cut_off() {
    let fs = MemFs::new();
    let r = recorder(&fs, options());
    r.push(set(&session(), 0)).unwrap();
    settle(&r);
    assert_eq!(r.end_episode(SUCCESS).unwrap_err().kind(), ErrorKind::BadInput);
    assert_eq!(r.judge_episode(None, SUCCESS).unwrap_err().kind(), ErrorKind::NotFound);
    let first = r.start_episode(TASK).unwrap();
    let again = r.start_episode("another").unwrap_err();
    assert_eq!(again.kind(), ErrorKind::InUse);
    assert!(again.to_string().contains("episode 1 is running"), "{again}");
    let ended = r.end_episode(SUCCESS).unwrap();
    assert!(ended.end_utc_ns.unwrap() >= first.start_utc_ns);
    assert_eq!((ended.number, ended.task.as_str()), (1, TASK));
    r.start_episode("second").unwrap();
    r.end_episode(EpisodeEnd::Discarded).unwrap();
    let third = r.start_episode("third").unwrap();
    // Spans do not overlap, however fast one follows the other.
    assert!(third.start_utc_ns > ended.end_utc_ns.unwrap());
    saved(&fs, "third");
    drop(r);

    let shared: Arc<dyn Fs> = Arc::new(fs.clone());
    recover_with(&shared, &dir(), &RecoverOptions::default(), &mut |_| ControlFlow::Continue(())).unwrap();
    let episodes = open(&fs).session().episodes.clone();
    let expected = [(1, "success", true), (2, "discarded", false), (3, "running or cut off", false)];
    assert_eq!(states(&episodes), expected);
    assert_eq!(episodes[0].task, TASK);
    assert_eq!(open(&fs).info().unwrap().episodes, episodes);
    // What was cut off is used once somebody has looked at it.
    let changes = SessionChanges { episodes: vec![(3, SUCCESS)], ..SessionChanges::default() };
    edit(&fs, &dir(), &changes).unwrap();
    assert_eq!(states(&open(&fs).session().episodes)[2], (3, "success", true));
}

#[test]
fn the_end_of_a_recording_ends_its_episode_and_judgements_can_change_while_it_goes_on() {
    let fs = MemFs::new();
    let r = recorder(&fs, options());
    let long = "x".repeat(NOTE_MAX_BYTES + 1);
    assert_eq!(r.start_episode(&long).unwrap_err().kind(), ErrorKind::BadInput);
    r.start_episode("").unwrap();
    r.end_episode(EpisodeEnd::Kept(None)).unwrap();
    assert!(r.judge_episode(None, EpisodeEnd::Discarded).unwrap().discarded);
    assert!(!r.judge_episode(Some(1), SUCCESS).unwrap().discarded);
    let unknown = r.judge_episode(Some(7), SUCCESS).unwrap_err();
    assert!(unknown.to_string().contains("episode 7"), "{unknown}");
    r.start_episode("dropped").unwrap();
    assert_eq!(r.judge_episode(Some(2), SUCCESS).unwrap_err().kind(), ErrorKind::InUse);
    let dropped = r.judge_episode(Some(2), EpisodeEnd::Discarded).unwrap();
    assert!(dropped.discarded && !dropped.is_open());
    r.start_episode("").unwrap();
    assert_eq!(r.judge_episode(None, EpisodeEnd::Discarded).unwrap().number, 3);
    r.start_episode("to the end").unwrap();
    let counts = r.progress().episodes;
    assert_eq!((counts.kept, counts.discarded, counts.last.unwrap().number), (1, 2, 4));
    r.push(set(&session(), 0)).unwrap();
    r.finish().unwrap();
    let states = states(&open(&fs).session().episodes);
    assert_eq!((states[0], states[3]), ((1, "success", true), (4, "kept", true)));
    assert!(states[1..3].iter().all(|(_, state, _)| *state == "discarded"));
}

fn episode(number: u32, from: i64, to: i64) -> Episode {
    let at = |n: i64| T0 + n * PERIOD;
    let text =
        format!("number = {number}\ntask = \"t\"\nstart_utc_ns = {}\nend_utc_ns = {}", at(from), at(to));
    toml::from_str(&text).unwrap()
}

/// Ten sets in three episodes.
fn recorded() -> MemFs {
    let fs = MemFs::new();
    let mut session = session();
    session.episodes = vec![episode(1, 0, 2), episode(2, 3, 6), episode(3, 7, 9)];
    let r = Recorder::create(Arc::new(fs.clone()), &dir(), session.clone(), options()).unwrap();
    for n in 0..10 {
        r.push(set(&session, n)).unwrap();
        settle(&r);
    }
    r.finish().unwrap();
    fs
}

fn part(fs: &MemFs, name: &str, from: u64, to: u64) -> Dataset {
    let out = PathBuf::from("/data").join(name);
    let span = SetSpan { from: Some(Edge::Set(from)), to: Some(Edge::Set(to)) };
    trim(fs, &open(fs), &out, span, &SliceOptions::default(), &mut |_, _| ControlFlow::Continue(())).unwrap();
    Dataset::open_with(Arc::new(fs.clone()), &out).unwrap()
}

#[test]
fn a_part_knows_which_episodes_it_has_whole_and_the_parts_together_have_all() {
    let fs = recorded();
    let cuts = |d: &Dataset| -> Vec<_> {
        d.session().episodes.iter().map(|e| (e.number, e.cut_start, e.cut_end)).collect()
    };
    let first = part(&fs, "first", 1, 5);
    assert_eq!(cuts(&first), [(1, false, false), (2, false, true)]);
    let second = part(&fs, "second", 6, 10);
    assert_eq!(cuts(&second), [(2, true, false), (3, false, false)]);
    let middle = part(&fs, "middle", 5, 6);
    assert_eq!(cuts(&middle), [(2, true, true)]);
    assert_eq!(states(&middle.session().episodes), [(2, "cut", false)]);

    let whole = Path::new("/data/whole");
    merge(&fs, &[first, second], whole, &SliceOptions::default(), &mut |_, _| ControlFlow::Continue(()))
        .unwrap();
    let whole = Dataset::open_with(Arc::new(fs.clone()), whole).unwrap();
    assert_eq!(whole.session().episodes, open(&fs).session().episodes);
}

#[test]
fn judgements_of_a_finished_dataset_are_in_its_history() {
    let fs = recorded();
    let judge = |number, end| {
        edit(&fs, &dir(), &SessionChanges { episodes: vec![(number, end)], ..SessionChanges::default() })
    };
    let edits = judge(2, EpisodeEnd::Discarded).unwrap();
    assert_eq!(edits[0].text(), "episode 2: \"kept\" is now \"discarded\"");
    assert!(judge(2, EpisodeEnd::Discarded).unwrap().is_empty());
    judge(3, EpisodeEnd::Kept(Some(EpisodeOutcome::Failure))).unwrap();
    judge(2, SUCCESS).unwrap();
    let session = open(&fs).session().clone();
    let expected = [(1, "kept", true), (2, "success", true), (3, "failure", true)];
    assert_eq!(states(&session.episodes), expected);
    assert_eq!(session.history.len(), 3);
    assert_eq!(judge(4, SUCCESS).unwrap_err().kind(), ErrorKind::NotFound);
}

#[test]
fn sets_belong_to_the_episode_that_their_time_is_in() {
    let e = episode(1, 2, 4);
    let inside: Vec<i64> = (0..7).filter(|n| e.holds(T0 + n * PERIOD)).collect();
    assert_eq!(inside, [2, 3, 4]);
    let open = Episode { end_utc_ns: None, ..e.clone() };
    assert!(open.holds(i64::MAX) && !open.holds(T0));
    // Somebody may have written spans that overlap: what is in a kept one is not discarded.
    let gone = Episode { discarded: true, ..episode(2, 3, 6) };
    let session = Session { episodes: vec![e, gone], ..session() };
    let discarded: Vec<i64> = (0..9).filter(|n| session.is_discarded(T0 + n * PERIOD)).collect();
    assert_eq!(discarded, [5, 6]);
}
