//! Metadata changed after the recording: what changes, what stays, and what the history says.

use crate::support::*;
use depthrig_recorder::fs::{Fault, Fs, MemFs, RealFs};
use depthrig_recorder::{
    Dataset, Edit, ErrorKind, Mark, NOTE_MAX_BYTES, SESSION_FILE, Session, SessionChanges, check_name, edit,
    look_at, rename,
};
use proptest::prelude::*;
use std::path::PathBuf;
use std::sync::Arc;

fn file() -> PathBuf {
    dir().join(SESSION_FILE)
}

fn recorded() -> MemFs {
    static DATASET: std::sync::OnceLock<MemFs> = std::sync::OnceLock::new();
    copy(DATASET.get_or_init(|| {
        let fs = MemFs::new();
        record(&fs, 2, options());
        fs
    }))
}

fn text(fs: &MemFs) -> String {
    String::from_utf8(contents(fs, &file())).unwrap()
}

fn scene(value: &str) -> SessionChanges {
    SessionChanges { scene: Some(value.to_owned()), ..SessionChanges::default() }
}

/// Field, old and new value of a change, without time and version.
fn change(e: &Edit) -> (&str, &str, &str) {
    (&e.field, &e.before, &e.after)
}

#[test]
fn an_edit_changes_the_session_file_alone_and_is_in_the_history() {
    let fs = recorded();
    let segments = contents(&fs, &segment(0));
    let changes = SessionChanges {
        scene: Some("a \"kitchen\"\nwith two lines".into()),
        operator: Some(String::new()),
        notes: vec!["the cup was moved".into()],
        mark: Some(Some(Mark::Bad)),
        episodes: Vec::new(),
    };
    let edits = edit(&fs, &dir(), &changes).unwrap();
    let expected = [
        ("scene", "a table", "a \"kitchen\"\nwith two lines"),
        ("operator", "nobody", ""),
        ("notes", "", "the cup was moved"),
        ("mark", "", "bad"),
    ];
    assert_eq!(edits.iter().map(change).collect::<Vec<_>>(), expected);
    let session = open(&fs).session().clone();
    assert_eq!(session.history, edits);
    assert_eq!((session.scene.as_str(), session.operator.as_str()), (expected[0].2, ""));
    assert_eq!(session.notes.last().unwrap().text, "the cup was moved");
    assert!(session.history.iter().all(|e| e.utc_ns > T0 && e.depthrig_version == session.depthrig_version));
    assert_eq!(contents(&fs, &segment(0)), segments, "segments keep what was true when they were recorded");
    let alone = Dataset::open_with(Arc::new(fs.clone()), &segment(0)).unwrap();
    assert_eq!(alone.session().scene, "a table");
    let info = open(&fs).info().unwrap();
    assert_eq!(info.scene, session.scene, "info shows the present value");
}

#[test]
fn undone_is_not_forgotten_and_the_same_again_is_no_change() {
    let fs = recorded();
    let before = text(&fs);
    assert_eq!(edit(&fs, &dir(), &scene("a table")).unwrap(), []);
    assert_eq!(text(&fs), before);
    edit(&fs, &dir(), &scene("a chair")).unwrap();
    edit(&fs, &dir(), &scene("a table")).unwrap();
    let session = open(&fs).session().clone();
    assert_eq!(session.scene, "a table");
    let history: Vec<_> = session.history.iter().map(change).collect();
    assert_eq!(history, [("scene", "a table", "a chair"), ("scene", "a chair", "a table")]);
}

#[test]
fn a_mark_is_in_the_catalog_and_can_be_taken_back() {
    let fs = recorded();
    let before = text(&fs);
    let mark = |mark| edit(&fs, &dir(), &SessionChanges { mark: Some(mark), ..Default::default() }).unwrap();
    assert_eq!(mark(None), []);
    assert_eq!(text(&fs), before);
    mark(Some(Mark::Good));
    assert_eq!(look_at(&fs, &dir()).mark, Some(Mark::Good));
    assert!(text(&fs).contains("\nmark = \"good\"\n"), "{}", text(&fs));
    mark(Some(Mark::Bad));
    assert_eq!(look_at(&fs, &dir()).mark, Some(Mark::Bad));
    let edits = mark(None);
    assert_eq!(edits.iter().map(Edit::text).collect::<Vec<_>>(), ["mark bad removed"]);
    assert_eq!(look_at(&fs, &dir()).mark, None);
    assert!(!text(&fs).contains("\nmark = "));
    let session = open(&fs).session().clone();
    assert_eq!(session.history.iter().filter(|e| e.field == "mark").count(), 3);
}

#[test]
fn what_is_not_finished_is_refused() {
    let fs = MemFs::new();
    let r = recorder(&fs, options());
    r.push(set(&session(), 0)).unwrap();
    settle(&r);
    let before = text(&fs);
    let e = edit(&fs, &dir(), &scene("x")).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::BadInput);
    assert!(e.to_string().contains("depthrig record stop") || e.to_string().contains("stop"), "{e}");
    assert!(rename(&fs, &dir(), "other").is_err());
    assert_eq!(text(&fs), before);
    drop(r); // as a crash leaves it
    let e = edit(&fs, &dir(), &scene("x")).unwrap_err().to_string();
    assert!(e.contains("depthrig recover"), "{e}");
}

#[test]
fn a_damaged_or_missing_session_file_is_left_alone() {
    let fs = recorded();
    fs.put(&file(), b"name = ".to_vec());
    assert_eq!(edit(&fs, &dir(), &scene("x")).unwrap_err().kind(), ErrorKind::Corrupt);
    assert_eq!(text(&fs), "name = ");
    fs.remove_file(&file()).unwrap();
    assert_eq!(edit(&fs, &dir(), &scene("x")).unwrap_err().kind(), ErrorKind::NotADataset);
    let gone = edit(&fs, &dir().join("not/there"), &scene("x")).unwrap_err();
    assert_eq!(gone.kind(), ErrorKind::NotFound);
    let e = edit(&recorded(), &dir(), &SessionChanges { notes: vec![" ".into()], ..Default::default() });
    assert_eq!(e.unwrap_err().kind(), ErrorKind::BadInput);
}

/// The file is the old one or the new one whatever operation fails, and the edit can be made afterwards.
#[test]
fn an_edit_that_fails_changes_nothing() {
    let mut failed = 0;
    for n in 0..12 {
        let fs = recorded().with_fault(Fault::FailOnce(n, std::io::ErrorKind::Other));
        let before = text(&fs);
        let result = edit(&fs, &dir(), &scene("new"));
        failed += u32::from(result.is_err());
        let fs = copy(&fs);
        let now = open(&fs).session().scene.clone();
        assert!(text(&fs) == before || now == "new", "operation {n} left something else");
        assert!(result.is_err() || now == "new");
        edit(&fs, &dir(), &scene("newer")).unwrap();
        assert_eq!(open(&fs).session().scene, "newer");
    }
    assert!(failed >= 4, "only {failed} operations could fail");
}

#[test]
fn renaming_moves_folder_and_name_and_never_onto_something() {
    let home = tempfile::tempdir().unwrap();
    let dir = home.path().join("old");
    let mut session = session();
    session.name = "old".into();
    let r = depthrig_recorder::Recorder::create(Arc::new(RealFs), &dir, session.clone(), options()).unwrap();
    r.push(set(&session, 0)).unwrap();
    settle(&r);
    r.finish().unwrap();
    std::fs::create_dir(home.path().join("taken")).unwrap();
    for (bad, kind) in [("taken", ErrorKind::AlreadyExists), ("../up", ErrorKind::BadInput)] {
        assert_eq!(rename(&RealFs, &dir, bad).unwrap_err().kind(), kind, "{bad}");
        assert_eq!(Dataset::open(&dir).unwrap().session().name, "old");
    }
    let (target, edits) = rename(&RealFs, &dir, "Küche 2").unwrap();
    assert_eq!(target, home.path().join("Küche 2"));
    assert_eq!(edits.iter().map(change).collect::<Vec<_>>(), [("name", "old", "Küche 2")]);
    assert!(!dir.exists());
    assert_eq!(Dataset::open(&target).unwrap().session().name, "Küche 2");
}

#[test]
fn what_another_process_has_locked_is_not_edited() {
    let home = tempfile::tempdir().unwrap();
    let dir = home.path().join("held");
    let r = depthrig_recorder::Recorder::create(Arc::new(RealFs), &dir, session(), options()).unwrap();
    r.push(set(&session(), 0)).unwrap();
    settle(&r);
    let e = edit(&RealFs, &dir, &scene("x")).unwrap_err().to_string();
    assert!(e.contains("is being recorded") && e.contains("record note"), "{e}");
    r.finish().unwrap();
    let before = std::fs::read(dir.join(SESSION_FILE)).unwrap();
    let lock = RealFs.lock(&dir).unwrap();
    for e in [edit(&RealFs, &dir, &scene("x")).err(), rename(&RealFs, &dir, "other").err()] {
        let e = e.expect("it is locked");
        assert_eq!(e.kind(), ErrorKind::InUse);
        assert!(e.to_string().contains("is in use") && e.to_string().contains("held"), "{e}");
    }
    assert_eq!(std::fs::read(dir.join(SESSION_FILE)).unwrap(), before);
    assert!(dir.exists());
    drop(lock);
    // Each lets go of it at its end.
    for value in ["x", "y"] {
        edit(&RealFs, &dir, &scene(value)).unwrap();
    }
    rename(&RealFs, &dir, "other").unwrap();
}

#[test]
fn names_that_are_no_names() {
    for good in ["a", "20260314_1512_kitchen", "Küche 2", &"x".repeat(240)] {
        assert!(check_name(good).is_ok(), "{good}");
    }
    for bad in ["", " ", ".", "..", ".hidden", "a/b", "a\0b", "a\nb", &"é".repeat(121)] {
        assert_eq!(check_name(bad).unwrap_err().kind(), ErrorKind::BadInput, "{bad:?}");
    }
}

/// Lines that a user or a later version may have put in: before the tables, and as tables at the end.
const KEYS: [&str; 5] = [
    "# do not touch: shown to the customer",
    "robot_arm = \"left\"   # with the long gripper",
    "\"quoted key\" = [1, 2.5, nan]",
    "calibrated_on = 2026-03-14T15:12:00Z",
    "later = { feature = true, level = 3 }",
];
const TABLES: [&str; 4] = [
    "[robot]\nmodel = 'UR5e' # bolted\nq0 = [0.0, -1.57, 1.57]",
    "[robot_tool.gripper]\nwidth_m = 0.085",
    "[[trials]]\nid = 1\n\n[[trials]]\nid = 2 # repeated",
    "[history_of_this_lab]\nbefore = \"x\"",
];

fn any_text() -> impl Strategy<Value = String> {
    prop_oneof!["[ -~]{0,12}", Just("\"\"\"\n\\".to_owned()), Just("Küche\u{1f600}\t'".to_owned())]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(150))]
    /// Against a model: a list of edits and two texts. Keys of others stay to the letter.
    #[test]
    fn what_others_wrote_survives_every_edit(
        keys in proptest::sample::subsequence(KEYS.to_vec(), 0..=KEYS.len()),
        tables in proptest::sample::subsequence(TABLES.to_vec(), 0..=TABLES.len()),
        edits in proptest::collection::vec((0u8..3, any_text()), 1..5),
    ) {
        let fs = recorded();
        let original = text(&fs);
        fs.put(&file(), format!("{}\n{original}\n{}\n", keys.join("\n"), tables.join("\n\n")).into_bytes());
        let unknown = open(&fs).session().extra.to_string();
        let mut model = open(&fs).session().clone();
        for (what, value) in edits {
            let mut changes = SessionChanges::default();
            let before = match what {
                0 => { changes.scene = Some(value.clone()); std::mem::replace(&mut model.scene, value.clone()) }
                1 => { changes.operator = Some(value.clone()); std::mem::replace(&mut model.operator, value.clone()) }
                _ => { changes.notes.push(value.clone()); String::new() }
            };
            let result = edit(&fs, &dir(), &changes);
            if what == 2 && value.trim().is_empty() {
                prop_assert!(result.is_err());
                continue;
            }
            for e in result.unwrap() {
                prop_assert_eq!((&e.before, &e.after), (&before, &value));
                model.history.push(e);
            }
        }
        let session = open(&fs).session().clone();
        prop_assert_eq!((&session.scene, &session.operator), (&model.scene, &model.operator));
        prop_assert_eq!(&session.history, &model.history);
        prop_assert_eq!(session.extra.to_string(), unknown.clone());
        let now = text(&fs);
        for line in keys.iter().chain(&tables) {
            prop_assert!(now.contains(line), "{} is gone from\n{}", line, now);
        }
        for line in original.lines().filter(|l| !l.starts_with("scene") && !l.starts_with("operator")) {
            prop_assert!(now.lines().any(|l| l == line), "{} is gone from\n{}", line, now);
        }
        // And through the form in which the recorder and `recover` write it.
        let again: Session = toml::from_str(&session.to_toml().unwrap()).unwrap();
        prop_assert_eq!(again.to_toml().unwrap(), session.to_toml().unwrap());
        prop_assert_eq!(again.extra.to_string(), unknown);
    }
}

/// Accepted notes can be read again: a note is short, and so are all of them together. The longest to write are
/// characters that TOML escapes.
#[test]
fn a_dataset_has_4096_notes_at_most() {
    let fs = recorded();
    let notes = |n: usize| SessionChanges { notes: vec!["n".to_owned(); n], ..SessionChanges::default() };
    edit(&fs, &dir(), &notes(4096)).unwrap();
    let before = text(&fs);
    let e = edit(&fs, &dir(), &notes(1)).unwrap_err();
    assert!(e.kind() == ErrorKind::BadInput && e.to_string().contains("has 4096 notes already"), "{e}");
    assert_eq!(text(&fs), before, "nothing was changed");
}

#[test]
fn notes_have_a_limit_each_and_all_together() {
    let longest = "\u{1}".repeat(NOTE_MAX_BYTES);
    let note = |text: &str| SessionChanges { notes: vec![text.to_owned()], ..SessionChanges::default() };
    let fs = recorded();
    let before = text(&fs);
    let too_long = format!("{longest}x");
    for bad in [note(&too_long), scene(&too_long)] {
        let e = edit(&fs, &dir(), &bad).unwrap_err();
        assert_eq!(e.kind(), ErrorKind::BadInput);
        assert!(e.to_string().contains("4097 bytes, 4096 is the limit"), "{e}");
        assert_eq!(text(&fs), before, "nothing was changed");
    }
    let fs = MemFs::new();
    let r = recorder(&fs, options());
    r.push(set(&session(), 0)).unwrap();
    let mut taken = 0;
    let e = loop {
        match r.add_note(longest.as_str()) {
            Ok(()) => taken += 1,
            // The writer takes them once a second.
            Err(e) if e.to_string().contains("wait to be written") => {
                std::thread::sleep(std::time::Duration::from_millis(10));
            }
            Err(e) => break e,
        }
        assert!(taken < 1000, "no end of notes");
    };
    assert!(e.kind() == ErrorKind::BadInput && e.to_string().contains("is the limit"), "{e}");
    assert_eq!(r.add_note(too_long.as_str()).unwrap_err().kind(), ErrorKind::BadInput);
    let summary = r.finish().unwrap();
    assert!(summary.complete, "{:?}", summary.lost);
    let dataset = open(&fs);
    assert_eq!(dataset.session().notes.len(), taken);
    assert!(dataset.session().notes.iter().all(|n| n.text == longest));
    let e = edit(&fs, &dir(), &note(&longest)).unwrap_err();
    assert!(e.to_string().contains("is the limit"), "the limit is one of the dataset: {e}");
}
