use super::pull::{Pull, Pulled};
use super::session::Sessions;
use super::{Hosts, lock};
use crate::api::{self, ServerHandle};
use crate::client::Client;
use crate::config::{ControlConfig, RigConfig};
use crate::control::{Control, EpisodeRequest, RecordRequest};
use crate::status::{CameraStatus, HostState, JoinState, LinkState, LinkStatus, RecordingStatus, RigStatus};
use crate::{Error, ErrorKind, Result};
use depthrig_bus::runtime::RigLock;
use depthrig_bus::{HostTime, Name, RigName, RuntimeDir};
use depthrig_recorder::{Episode, Outcome, SESSION_FILE, Session};
use proptest::prelude::*;
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

const PART: &str = "kitchen_left";

/// A rig that has recordings and nothing else.
struct Shelf(PathBuf);

fn nothing<T>() -> Result<T> {
    Err(Error::new(ErrorKind::WrongState, "this rig has recordings alone"))
}

impl Control for Shelf {
    fn status(&self) -> RigStatus {
        panic!("recordings do not ask for it")
    }
    fn config_text(&self) -> String {
        String::new()
    }
    fn recordings(&self) -> Result<PathBuf> {
        Ok(self.0.clone())
    }
    fn record_start(&self, _: &RecordRequest) -> Result<RecordingStatus> {
        nothing()
    }
    fn record_stop(&self) -> Result<RecordingStatus> {
        nothing()
    }
    fn record_note(&self, _: &str) -> Result<()> {
        nothing()
    }
    fn episode(&self, _: &EpisodeRequest) -> Result<Episode> {
        nothing()
    }
    fn request_stop(&self) {}
}

/// The recordings of another computer, served, and a place for copies.
struct Two {
    client: Client,
    there: PathBuf,
    here: PathBuf,
    _server: ServerHandle,
    _lock: RigLock,
    _tmp: tempfile::TempDir,
}

impl Two {
    fn new() -> Self {
        let tmp = tempfile::Builder::new().prefix("dh").rand_bytes(4).tempdir_in("/tmp").unwrap();
        let runtime = RuntimeDir::at(&tmp.path().join("r")).unwrap();
        let (rig, host) = (RigName::new("mount").unwrap(), Name::new("left").unwrap());
        let lock = runtime.lock(&rig, "a test").unwrap();
        let [recordings, here] = ["there", "here"].map(|name| tmp.path().join(name));
        let there = recordings.join(PART);
        fs::create_dir_all(&there).unwrap();
        fs::create_dir_all(&here).unwrap();
        let config = ControlConfig { tcp: crate::config::Port::Off, ..ControlConfig::default() };
        let server = api::serve(Arc::new(Shelf(recordings)), &runtime, &rig, config).unwrap();
        std::os::unix::fs::symlink(runtime.socket_path(&rig), runtime.host_socket_path(&rig, &host)).unwrap();
        let client = Client::of_host(&runtime, &rig, &host).unwrap();
        let two = Self { client, there, here, _server: server, _lock: lock, _tmp: tmp };
        two.write_session(false);
        two
    }

    fn write_session(&self, is_closed: bool) {
        let outcome = is_closed.then(|| Outcome {
            ended_utc_ns: 1,
            complete: true,
            sets_offered: 0,
            sets_recorded: 0,
            sets_dropped: BTreeMap::new(),
            lost: Vec::new(),
        });
        let session = Session { outcome, ..Session::new(PART, "mount") };
        fs::write(self.there.join(SESSION_FILE), session.to_toml().unwrap()).unwrap();
    }

    fn copy(&self) -> PathBuf {
        self.here.join(PART)
    }

    fn pull_for(&self, time: Duration, reserve_bytes: u64) -> Result<Pulled> {
        let pull = Pull {
            client: &self.client,
            name: PART,
            folder: self.copy(),
            reserve_bytes,
            until: HostTime::now().plus(time),
            stop: &AtomicBool::new(false),
        };
        pull.run()
    }

    fn pull(&self) -> Result<Pulled> {
        self.pull_for(Duration::from_secs(20), 0)
    }
}

fn files(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let entries = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap());
    entries.map(|e| (e.file_name().into_string().unwrap(), fs::read(e.path()).unwrap())).collect()
}

/// Something that happens to a recording while it is copied.
#[derive(Debug, Clone)]
enum Event {
    /// Bytes are appended to the segment that is written.
    Append(usize),
    /// It is closed, and the next one begun.
    Close,
    /// The computer was switched off, and its recovery writes the last segment anew.
    Recover(usize),
    /// Somebody looks.
    Pull,
    /// The daemon here is killed with the last bytes not on the disk.
    Tear(usize),
}

fn event() -> impl Strategy<Value = Event> {
    prop_oneof![
        4 => (1usize..300_000).prop_map(Event::Append),
        1 => (4_500_000usize..5_000_000).prop_map(Event::Append),
        2 => Just(Event::Close),
        1 => (0usize..200_000).prop_map(Event::Recover),
        4 => Just(Event::Pull),
        1 => (1usize..50_000).prop_map(Event::Tear),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, ..ProptestConfig::default() })]

    /// However a recording grows, is closed and recovered between looks at it, and whatever a kill leaves of the copy, the copy has
    /// at last the bytes of the recording.
    #[test]
    fn a_copy_has_at_last_every_byte(events in prop::collection::vec(event(), 1..24), seed in any::<u8>()) {
        let two = Two::new();
        let mut number = 0;
        let mut next = seed;
        let mut noise = move |length: usize| -> Vec<u8> {
            (0..length).map(|_| { next = next.wrapping_mul(141).wrapping_add(43); next }).collect()
        };
        let part = |number: u32| two.there.join(format!("seg_{number:04}.mcap.part"));
        let closed = |number: u32| two.there.join(format!("seg_{number:04}.mcap"));
        let append = |path: &Path, bytes: &[u8]| {
            let mut have = fs::read(path).unwrap_or_default();
            have.extend(bytes);
            fs::write(path, have).unwrap();
        };
        for event in events {
            match event {
                Event::Append(length) => append(&part(number), &noise(length)),
                Event::Close => {
                    append(&part(number), &noise(7));
                    fs::rename(part(number), closed(number)).unwrap();
                    number += 1;
                }
                Event::Recover(length) => {
                    // It may write a segment that is shorter, as long or longer, with other bytes.
                    fs::write(part(number), noise(length)).unwrap();
                    fs::rename(part(number), closed(number)).unwrap();
                    number += 1;
                }
                Event::Pull => {
                    // A copy that turns out to differ is an error once, and pulled again.
                    let _ = two.pull();
                }
                Event::Tear(bytes) => {
                    let torn = two.here.join(".pulling").join(PART).join(format!("seg_{number:04}.mcap.part"));
                    if let Ok(mut have) = fs::read(&torn) {
                        let keep = have.len().saturating_sub(bytes);
                        have[keep..].fill(0);
                        fs::write(&torn, have).unwrap();
                    }
                }
            }
            prop_assert!(!two.copy().exists(), "a recording that goes on has no complete copy");
        }
        if part(number).exists() {
            fs::rename(part(number), closed(number)).unwrap();
        }
        two.write_session(true);
        let mut pulled = two.pull();
        for _ in 0..=number {
            if pulled.as_ref().is_ok_and(|p| p.is_complete) {
                break;
            }
            pulled = two.pull();
        }
        let pulled = pulled.unwrap();
        prop_assert!(pulled.is_complete, "{pulled:?}");
        prop_assert_eq!(files(&two.copy()), files(&two.there));
        prop_assert!(!two.here.join(".pulling").exists());
    }
}

#[test]
fn a_pull_ends_in_time_and_goes_on_where_it_ended() {
    let two = Two::new();
    let bytes: Vec<u8> = (0..9_000_000u32).map(|i| (i % 253) as u8).collect();
    fs::write(two.there.join("seg_0000.mcap"), &bytes).unwrap();
    two.write_session(true);
    let first = two.pull_for(Duration::ZERO, 0).unwrap();
    assert!(first.is_busy && !first.is_complete, "{first:?}");
    assert_eq!((first.bytes, first.copied), (9_000_000, 0));
    let growing = two.here.join(".pulling").join(PART).join("seg_0000.mcap.part");
    fs::write(&growing, &bytes[..5_000_000]).unwrap();
    // What is here is not asked for again: a change of it is found at the end.
    assert!(two.pull().unwrap().is_complete);
    assert_eq!(fs::read(two.copy().join("seg_0000.mcap")).unwrap(), bytes);
    // It is not pulled again.
    assert_eq!(two.pull().unwrap(), Pulled { is_complete: true, ..Pulled::default() });
}

#[test]
fn recordings_of_this_computer_come_first_on_its_disk() {
    let two = Two::new();
    fs::write(two.there.join("seg_0000.mcap.part"), [7; 100]).unwrap();
    let error = two.pull_for(Duration::from_secs(5), u64::MAX).unwrap_err();
    assert_eq!(error.kind(), ErrorKind::NoSpace);
    assert!(error.to_string().contains("stays where it was recorded until there is room"), "{error}");
    assert!(two.pull().is_ok());
}

#[test]
fn nothing_that_exists_is_overwritten() {
    let two = Two::new();
    fs::write(two.there.join("seg_0000.mcap"), [7; 100]).unwrap();
    two.write_session(true);
    fs::create_dir(two.copy()).unwrap();
    fs::write(two.copy().join("mine"), b"mine").unwrap();
    let error = two.pull().unwrap_err();
    assert_eq!(error.kind(), ErrorKind::InUse);
    assert!(error.to_string().contains("is there already"), "{error}");
    assert_eq!(files(&two.copy()), [("mine".to_owned(), b"mine".to_vec())].into());
    fs::remove_dir_all(two.copy()).unwrap();
    assert!(two.pull().unwrap().is_complete);
}

#[test]
fn other_files_of_a_recording_are_not_copied_and_not_served() {
    let two = Two::new();
    fs::write(two.there.join("seg_0000.mcap"), [7; 100]).unwrap();
    fs::write(two.there.join("secret"), b"secret").unwrap();
    two.write_session(true);
    assert!(two.pull().unwrap().is_complete);
    assert_eq!(files(&two.copy()).into_keys().collect::<Vec<_>>(), ["seg_0000.mcap", SESSION_FILE]);
    for (name, file, kind) in [
        (PART, "secret", ErrorKind::BadInput),
        (PART, "../kitchen_left/seg_0000.mcap", ErrorKind::BadInput),
        ("../here/kitchen_left", "seg_0000.mcap", ErrorKind::NotFound),
        (".", "seg_0000.mcap", ErrorKind::NotFound),
        ("other", "seg_0000.mcap", ErrorKind::NotFound),
        (PART, "seg_0001.mcap", ErrorKind::NotFound),
    ] {
        let request = api::BytesRequest { name: name.into(), file: file.into(), offset: 0, length: 10 };
        assert_eq!(two.client.recording_bytes(&request).unwrap_err().kind(), kind, "{name} {file}");
    }
    // Beyond the end there is nothing, and of a large range a part.
    let request = |offset, length| api::BytesRequest {
        name: PART.into(),
        file: "seg_0000.mcap".into(),
        offset,
        length,
    };
    assert_eq!(two.client.recording_bytes(&request(100, 10)).unwrap(), b"");
    assert_eq!(
        two.client.recording_bytes(&request(u64::MAX, 10)).map_err(|e| e.kind()),
        Err(ErrorKind::Other)
    );
    assert_eq!(two.client.recording_bytes(&request(98, u64::MAX)).unwrap(), [7, 7]);
}

fn recording(folder: &Path, name: &str) -> RecordingStatus {
    let path = folder.join(name);
    fs::create_dir_all(&path).unwrap();
    RecordingStatus { name: name.to_owned(), path: path.display().to_string(), ..RecordingStatus::default() }
}

#[test]
fn parts_are_known_again_after_a_restart_until_they_are_joined() {
    let tmp = tempfile::tempdir().unwrap();
    let left = Name::new("left").unwrap();
    let mut sessions = Sessions::default();
    let request = RecordRequest { scene: "kitchen".into(), force: true, ..RecordRequest::default() };
    sessions.begin(&recording(tmp.path(), "one"), &request);
    let begun = sessions.newest().unwrap().part_request(&left);
    assert_eq!((begun.name.as_deref(), begun.scene.as_str()), (Some("one_left"), "kitchen"));
    assert!(begun.force && begun.directory.is_none());
    sessions.add("one", &left, "one_left");
    // One more after a restart of the host.
    assert_eq!(sessions.newest().unwrap().part_request(&left).name.as_deref(), Some("one_left_2"));
    assert!(!sessions.is_over("one_left"));

    let mut found = Sessions::left_in(tmp.path());
    assert!(found.is_over("one_left"), "what an earlier daemon recorded has ended");
    assert_eq!(found.of(&left).len(), 1);
    assert!(found.due(|_| true).is_none(), "its part is not here");
    found.change("one", "one_left", |part| part.is_complete = true);
    assert!(found.due(|_| false).is_none(), "the recording here is not recovered yet");
    let due = found.due(|_| true).unwrap();
    assert_eq!(due.joined_folder(), tmp.path().join("one_joined"));
    assert_eq!(due.part_folders().collect::<Vec<_>>(), [tmp.path().join("one_left")]);
    found.joined("one", JoinState::Joining, None);
    assert!(found.due(|_| true).is_none());
    // It was not done when the daemon ended.
    let mut found = Sessions::left_in(tmp.path());
    assert!(found.due(|_| true).is_some());
    found.joined("one", JoinState::Done, None);
    assert!(Sessions::left_in(tmp.path()).newest().is_none());
}

#[test]
fn a_file_that_names_a_folder_elsewhere_is_not_believed() {
    let tmp = tempfile::tempdir().unwrap();
    let folder = tmp.path().join("one");
    fs::create_dir(&folder).unwrap();
    for (text, is_read) in [
        ("[[part]]\nhost = \"left\"\nname = \"one_left\"\n", true),
        ("[[part]]\nhost = \"left\"\nname = \"../../etc\"\n", false),
        ("[[part]]\nhost = \"LEFT!\"\nname = \"one_left\"\n", false),
        ("not toml", false),
    ] {
        fs::write(folder.join("hosts.toml"), text).unwrap();
        assert_eq!(Sessions::left_in(tmp.path()).newest().is_some(), is_read, "{text}");
    }
}

#[test]
fn a_recording_that_ends_by_itself_ends_its_parts() {
    let tmp = tempfile::tempdir().unwrap();
    let left = Name::new("left").unwrap();
    let mut sessions = Sessions::default();
    let here = recording(tmp.path(), "one");
    let request = RecordRequest { max_duration_s: Some(60.0), ..RecordRequest::default() };
    sessions.begin(&here, &request);
    let seconds = sessions.newest().unwrap().part_request(&left).max_duration_s.unwrap();
    assert!((59.0..=60.0).contains(&seconds), "{seconds}");
    sessions.add("one", &left, "one_left");
    sessions.follow(Some(Path::new(&here.path)));
    assert!(!sessions.is_over("one_left"));
    sessions.follow(None);
    assert!(sessions.is_over("one_left"));
    assert!(!sessions.is_over("two_left"), "whatever else a host records is its own");
}

const THREE: &str = "rig = \"mount\"\n[link]\nhost = \"right\"\nlisten = \"127.0.0.1:7447\"\n[[link.hosts]]\nname = \"left\"\n\
                     socket = \"/left.sock\"\n[[link.hosts]]\nname = \"top\"\nsocket = \"/top.sock\"\n\
                     [[camera]]\nname = \"a\"\nbackend = \"synthetic\"\nmodel = \"generic\"\n";

/// This computer, and two others that are not asked.
fn three(tmp: &Path) -> Hosts {
    let runtime = RuntimeDir::at(&tmp.join("r")).unwrap();
    let config = RigConfig::parse(THREE, None).unwrap();
    Hosts::new(&config, &runtime, None, Arc::default(), None).unwrap().unwrap()
}

/// Status of a daemon that calls itself `host` and has `camera`.
fn said_by(host: &str, camera: &str) -> RigStatus {
    let link = LinkStatus {
        host: host.to_owned(),
        insecure: true,
        recorder: Some("127.0.0.1:7447".to_owned()),
        state: LinkState::Live,
        offset_s: Some(0.0),
        uncertainty_us: Some(10.0),
        rate_ppm: Some(0.0),
        epoch: Some(1),
        round_trip_us: Some(20.0),
        age_s: Some(0.0),
        exchanges: 1,
        refused: 0,
    };
    let camera = CameraStatus { name: camera.to_owned(), ..CameraStatus::default() };
    RigStatus { rig: "mount".to_owned(), link: Some(link), cameras: vec![camera], ..RigStatus::default() }
}

#[test]
fn a_computer_is_refused_for_cameras_of_those_that_are_part_of_the_rig_alone() {
    let tmp = tempfile::Builder::new().prefix("dh").rand_bytes(4).tempdir_in("/tmp").unwrap();
    let hosts = three(tmp.path());
    let state = |number: usize, looked: Result<&RigStatus, &Error>| {
        let host = &hosts.others[number];
        hosts.note(host, looked, None);
        let seen = host.status();
        (seen.state, seen.why.unwrap_or_default())
    };
    let left = said_by("left", "wrist");
    assert_eq!(state(0, Ok(&left)).0, HostState::Connected);
    // The rig file of left on the other computer: it is refused, and left goes on.
    let (refused, why) = state(1, Ok(&left));
    assert!(refused == HostState::Refused && why.contains("its name is \"left\""), "{why}");
    assert_eq!(state(0, Ok(&left)).0, HostState::Connected);
    let top = said_by("top", "wrist");
    let (refused, why) = state(1, Ok(&top));
    assert!(refused == HostState::Refused && why.contains("on host left"), "{why}");
    assert_eq!(state(0, Ok(&left)).0, HostState::Connected, "it was there first");
    // Its camera moved while it is away.
    let away = Error::new(ErrorKind::Unreachable, "switched off");
    assert_eq!(state(0, Err(&away)).0, HostState::Absent);
    assert_eq!(state(1, Ok(&top)).0, HostState::Connected);
    assert!(state(0, Ok(&left)).1.contains("on host top"));
}

#[test]
fn a_part_that_never_began_does_not_hold_up_the_others() {
    let tmp = tempfile::Builder::new().prefix("dh").rand_bytes(4).tempdir_in("/tmp").unwrap();
    let hosts = three(tmp.path());
    let left = &hosts.others[0];
    let name = &left.config.name;
    lock(&hosts.sessions).begin(&recording(tmp.path(), "one"), &RecordRequest::default());
    let is_there = |name: &str| {
        let error = Error::new(ErrorKind::NotFound, "no such recording");
        let session = lock(&hosts.sessions).newest().unwrap().clone();
        hosts.pulled(left, &session, name, Err(error));
        lock(&hosts.sessions).newest().unwrap().parts.iter().any(|part| part.name == name)
    };
    let long_ago = || HostTime::now().plus_ns(-40_000_000_000);
    lock(&hosts.sessions).add("one", name, "one_left");
    assert!(is_there("one_left"), "it may be about to begin");
    lock(&hosts.sessions).change("one", "one_left", |part| part.since = long_ago());
    lock(&left.seen).recording = Some("one_left".to_owned());
    assert!(is_there("one_left"), "it is recorded");
    lock(&left.seen).recording = Some("one_left_2".to_owned());
    let growing = tmp.path().join(".pulling/one_left");
    fs::create_dir_all(&growing).unwrap();
    assert!(is_there("one_left"), "some of it came");
    fs::remove_dir(&growing).unwrap();
    // What is known to have begun has its images somewhere, also after a restart.
    lock(&hosts.sessions).change("one", "one_left", |part| part.is_asked = false);
    assert!(is_there("one_left"));
    let read = || Sessions::left_in(tmp.path()).newest().unwrap().parts[0].is_asked;
    assert!(!read());
    lock(&hosts.sessions).change("one", "one_left", |part| part.is_asked = true);
    assert!(read());
    assert!(!is_there("one_left"));
    assert!(lock(&hosts.sessions).excuse(name).unwrap().contains("one_left never began"));
}

#[test]
fn a_folder_without_room_for_joining_is_refused_at_the_start() {
    let text = "rig = \"mount\"\n[link]\nhost = \"right\"\nlisten = \"127.0.0.1:7447\"\n[[link.hosts]]\nname = \"left\"\nsocket = \"/left.sock\"\n\
                [[camera]]\nname = \"a\"\nbackend = \"synthetic\"\nmodel = \"generic\"\n";
    let config = RigConfig::parse(text, None).unwrap();
    let tmp = tempfile::Builder::new().prefix("dh").rand_bytes(4).tempdir_in("/tmp").unwrap();
    let new = |len: usize| {
        let name = "r".repeat(len - tmp.path().as_os_str().len() - 1);
        let runtime = RuntimeDir::at(&tmp.path().join(name)).unwrap();
        Hosts::new(&config, &runtime, None, Arc::default(), None).map(|hosts| hosts.map(|h| h.count()))
    };
    assert_eq!(new(32).unwrap(), Some(1));
    let refused = new(33).unwrap_err().to_string();
    assert!(refused.contains("/joining: the path is longer than 40 bytes"), "{refused}");
}
