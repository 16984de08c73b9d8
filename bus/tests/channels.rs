//! The bus between real processes: slow, holding, killed and foreign ones.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

#[path = "support/helper.rs"]
mod helper;

use depthrig_bus::{
    Bus, ErrorKind, Frame, HostTime, MemberRecord, PixelFormat, Publisher, RigName, RuntimeDir, SHM_PREFIX,
    SetHeader, StreamId, shm,
};
use helper::{DIR, Helper, ROLE};
use iceoryx2::prelude::*;
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use std::collections::BTreeSet;
use std::os::unix::fs::MetadataExt;
use std::path::PathBuf;
use std::time::Duration;

const LEN: usize = 64 * 48 * 2;
const WAIT: Duration = Duration::from_secs(10);

struct Fixture {
    dir: tempfile::TempDir,
    bus: Bus,
    id: StreamId,
}

fn rig() -> RigName {
    RigName::new("test").unwrap()
}

fn fixture() -> Fixture {
    let dir = tempfile::tempdir().unwrap();
    let bus = Bus::open(&RuntimeDir::at(dir.path()).unwrap(), &rig()).unwrap();
    Fixture { dir, bus, id: StreamId::new("cam", "depth").unwrap() }
}

fn publish(publisher: &Publisher, sequence: u64) -> usize {
    let mut frame = publisher.loan(LEN).unwrap();
    frame.pixels_mut().fill(sequence as u8);
    frame.header_mut().set_image(PixelFormat::Z16, 64, 48);
    frame.header_mut().sequence = sequence;
    publisher.send(frame).unwrap()
}

fn whole(frame: &Frame) -> u64 {
    let sequence = frame.header().sequence;
    assert_eq!(frame.pixels().len(), LEN);
    assert!(frame.pixels().iter().all(|b| *b == sequence as u8), "frame {sequence} was overwritten");
    sequence
}

#[test]
fn frames_arrive_in_order_with_their_header() {
    let f = fixture();
    let publisher = f.bus.publisher(&f.id, LEN, 16).unwrap();
    let mut subscriber = f.bus.subscriber(&f.id).unwrap();
    assert!(subscriber.try_next().unwrap().is_none());
    let before = HostTime::now().ns();
    for sequence in 1..=3 {
        assert_eq!(publish(&publisher, sequence), 1);
    }
    for sequence in 1..=3 {
        let frame = subscriber.next_timeout(WAIT).unwrap().unwrap();
        assert_eq!(whole(&frame), sequence);
        assert!(frame.header().publish_time_ns >= before && frame.header().is_valid());
    }
    assert!(subscriber.next_timeout(Duration::from_millis(20)).unwrap().is_none());
    assert_eq!(f.bus.streams().unwrap(), vec![f.id]);
}

#[test]
fn a_slow_subscriber_loses_the_oldest_and_knows_it() {
    let f = fixture();
    let publisher = f.bus.publisher(&f.id, LEN, 16).unwrap();
    let mut subscriber = f.bus.subscriber(&f.id).unwrap();
    publish(&publisher, 1);
    assert_eq!(whole(&subscriber.try_next().unwrap().unwrap()), 1);
    for sequence in 2..=20 {
        publish(&publisher, sequence);
    }
    assert_eq!(whole(&subscriber.try_next().unwrap().unwrap()), 17);
    assert_eq!(subscriber.missed(), 15);
    assert_eq!(whole(&subscriber.latest().unwrap().unwrap()), 20);
    assert!(subscriber.latest().unwrap().is_none());
}

#[test]
fn held_frames_keep_their_pixels_and_only_their_slots() {
    let f = fixture();
    let publisher = f.bus.publisher(&f.id, LEN, 48).unwrap();
    let mut hog = f.bus.subscriber(&f.id).unwrap();
    let mut other = f.bus.subscriber(&f.id).unwrap();
    let mut held = Vec::new();
    for sequence in 1..=16 {
        publish(&publisher, sequence);
        held.push(hog.next_timeout(WAIT).unwrap().unwrap());
    }
    for sequence in 17..=200 {
        publish(&publisher, sequence);
        assert_eq!(whole(&other.latest().unwrap().unwrap()), sequence);
    }
    let e = hog.try_next().unwrap_err();
    assert_eq!(e.kind(), ErrorKind::LimitReached);
    assert!(e.to_string().contains("16 frames are held"), "{e}");
    for (i, frame) in held.iter().enumerate() {
        assert_eq!(whole(frame), i as u64 + 1);
    }
    held.remove(0);
    assert_eq!(whole(&hog.try_next().unwrap().unwrap()), 197);
}

#[test]
fn when_every_slot_is_held_the_publisher_is_told_and_goes_on_later() {
    let f = fixture();
    let publisher = f.bus.publisher(&f.id, LEN, 8).unwrap();
    let mut hog = f.bus.subscriber(&f.id).unwrap();
    let mut held = Vec::new();
    let refused = (1..=20).find_map(|sequence| match publisher.loan(LEN) {
        Err(e) => Some(e),
        Ok(mut frame) => {
            frame.header_mut().sequence = sequence;
            publisher.send(frame).unwrap();
            held.extend(hog.try_next().unwrap());
            None
        }
    });
    let e = refused.expect("eight slots cannot hold twenty frames");
    assert_eq!(e.kind(), ErrorKind::NoSpace);
    assert!(f.bus.starved(), "the process that cleans up after dead subscribers learns of it at once");
    assert!(!f.bus.starved());
    assert!(e.to_string().contains("subscribers hold every slot"), "{e}");
    held.clear();
    publish(&publisher, 21);
}

#[test]
fn a_late_subscriber_gets_the_newest_frame_at_the_next_publish() {
    let f = fixture();
    let publisher = f.bus.publisher(&f.id, LEN, 16).unwrap();
    publish(&publisher, 1);
    publish(&publisher, 2);
    let mut late = f.bus.subscriber(&f.id).unwrap();
    publish(&publisher, 3);
    assert_eq!(whole(&late.try_next().unwrap().unwrap()), 2);
    assert_eq!(whole(&late.try_next().unwrap().unwrap()), 3);
}

#[test]
fn a_frame_too_large_for_its_channel_is_refused() {
    let f = fixture();
    let publisher = f.bus.publisher(&f.id, LEN, 16).unwrap();
    let e = publisher.loan(LEN + 1).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::LimitReached);
    assert!(e.to_string().contains("stream cam/depth of rig \"test\""), "{e}");
}

#[test]
fn an_unknown_stream_names_those_there_are() {
    let f = fixture();
    let none = f.bus.subscriber(&f.id).unwrap_err();
    assert!(none.to_string().contains("no rig \"test\" runs in"), "{none}");
    let _publisher = f.bus.publisher(&f.id, LEN, 16).unwrap();
    let e = f.bus.subscriber(&StreamId::new("cam", "colour").unwrap()).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::NotFound);
    assert!(e.to_string().contains("the rig has: cam/depth"), "{e}");
}

/// Creates the channel as another version of depthrig would: another schema, or another header.
fn foreign_service(f: &Fixture, schema: &str) -> (Node<ipc::Service>, Box<dyn core::any::Any>) {
    let root = Path::new(f.dir.path().join("iox2").to_str().unwrap().as_bytes()).unwrap();
    let mut config = Config::default();
    config.global.set_root_path(&root);
    config.global.prefix = FileName::new(b"depthrig_").unwrap();
    let node = NodeBuilder::new().config(&config).create::<ipc::Service>().unwrap();
    let name: ServiceName = format!("depthrig/test/{}", f.id).as_str().try_into().unwrap();
    let attributes =
        AttributeSpecifier::new().define(&"schema".try_into().unwrap(), &schema.try_into().unwrap()).unwrap();
    let builder = node.service_builder(&name).publish_subscribe::<[u8]>();
    let service: Box<dyn core::any::Any> = if schema == depthrig_bus::SCHEMA {
        Box::new(builder.create_with_attributes(&attributes).unwrap()) // right schema, no header
    } else {
        let builder = builder.user_header::<depthrig_bus::FrameHeader>();
        Box::new(builder.create_with_attributes(&attributes).unwrap())
    };
    (node, service)
}

#[test]
fn another_version_is_refused_with_what_to_do() {
    for schema in ["depthrig.frame/2", depthrig_bus::SCHEMA] {
        let f = fixture();
        let _foreign = foreign_service(&f, schema);
        for e in [f.bus.subscriber(&f.id).unwrap_err(), f.bus.publisher(&f.id, LEN, 16).unwrap_err()] {
            assert_eq!(e.kind(), ErrorKind::VersionMismatch, "{e}");
            assert!(e.to_string().contains("with the same version"), "{e}");
        }
    }
}

#[test]
fn sets_travel() {
    let f = fixture();
    let publisher = f.bus.set_publisher().unwrap();
    let mut subscriber = f.bus.set_subscriber().unwrap();
    let member = |stream: &str, sequence| MemberRecord {
        id: StreamId::new("cam", stream).unwrap(),
        sequence,
        capture_time_ns: 5,
    };
    let members = vec![member("color", Some(9)), member("depth", None)];
    publisher.send(SetHeader { set_id: 3, tick_ns: 7, ..SetHeader::default() }, &members).unwrap();
    let set = subscriber.next_timeout(WAIT).unwrap().unwrap();
    assert_eq!((set.header().set_id, set.header().members, set.header().present), (3, 2, 1));
    assert_eq!(set.members().unwrap(), members);
    assert!(f.bus.streams().unwrap().is_empty(), "the set channel is not a stream");
}

/// Cleans up after one dead process, trying again as the daemon's timer does.
fn clean(bus: &Bus) {
    let deadline = HostTime::now().plus(WAIT);
    while bus.clean_dead() == 0 {
        assert!(!deadline.from_now().is_zero(), "the dead process was never cleaned up");
        std::thread::sleep(Duration::from_millis(10));
    }
}

/// Not a test by itself: the other process of the tests below, this same binary started again.
#[test]
fn helper_process() {
    let Ok(role) = std::env::var(ROLE) else { return };
    let dir = std::env::var(DIR).unwrap();
    let bus = Bus::open(&RuntimeDir::at(dir.as_ref()).unwrap(), &rig()).unwrap();
    let id = StreamId::new("cam", "depth").unwrap();
    if role == "out of descriptors" {
        // All but four are taken: how many are open says nothing, because inherited ones have any number. An ordinary user
        // may not raise the hard limit.
        let maximum = getrlimit(Resource::Nofile).maximum;
        setrlimit(Resource::Nofile, Rlimit { current: Some(maximum.map_or(256, |m| m.min(256))), maximum })
            .unwrap();
        let mut taken: Vec<_> = std::iter::from_fn(|| std::fs::File::open("/dev/null").ok()).collect();
        taken.truncate(taken.len().saturating_sub(4));
        println!("ready");
        println!("refused: {}", bus.subscriber(&id).map(drop).unwrap_err());
    } else if role == "publisher" {
        let publisher = bus.publisher(&id, LEN, 16).unwrap();
        println!("ready");
        for sequence in 1.. {
            publish(&publisher, sequence);
            std::thread::sleep(Duration::from_millis(5));
        }
    } else {
        let mut subscriber = bus.subscriber_within(&id, WAIT).unwrap();
        println!("ready");
        let mut held = Vec::new();
        while held.len() < 3 {
            held.extend(subscriber.next_timeout(WAIT).unwrap());
        }
        println!("holding");
        loop {
            std::thread::park(); // until it is killed; making a listener may have left a wake-up behind
        }
    }
}

#[test]
fn a_killed_publisher_is_noticed_and_its_successor_is_heard() {
    let f = fixture();
    let first = Helper::start(f.dir.path(), "publisher");
    let mut subscriber = f.bus.subscriber_within(&f.id, WAIT).unwrap();
    subscriber.next_timeout(WAIT).unwrap().unwrap();
    first.kill();
    while subscriber.next_timeout(Duration::from_millis(100)).unwrap().is_some() {}
    clean(&f.bus);
    assert!(!subscriber.is_live());
    assert_eq!(subscriber.next().unwrap_err().kind(), ErrorKind::NotFound);
    let _second = Helper::start(f.dir.path(), "publisher");
    assert_eq!(whole(&subscriber.next_timeout(WAIT).unwrap().expect("the successor's frame")) % 256, {
        let next = subscriber.next_timeout(WAIT).unwrap().unwrap();
        (next.header().sequence - 1) % 256
    });
}

#[test]
fn a_killed_subscriber_gives_its_slots_back() {
    let f = fixture();
    let publisher = f.bus.publisher(&f.id, LEN, 8).unwrap();
    for round in 0..4u64 {
        let mut reader = Helper::start(f.dir.path(), "subscriber");
        let mut sequence = round * 100;
        let stop = std::thread::scope(|s| {
            let waiting = s.spawn(|| drop(reader.wait_for("holding")));
            while !waiting.is_finished() {
                sequence += 1;
                publish(&publisher, sequence);
                std::thread::sleep(Duration::from_millis(5));
            }
            waiting.join()
        });
        stop.unwrap();
        reader.kill();
        clean(&f.bus);
        // Three held and four unread slots of eight came back, or these loans would fail.
        for i in 1..=20 {
            publish(&publisher, sequence + i);
        }
    }
}

/// As it is left when the process that removes a dead one is killed over it.
#[test]
fn a_dead_process_whose_description_is_gone_is_removed_and_counted_once() {
    let f = fixture();
    let _publisher = f.bus.publisher(&f.id, LEN, 16).unwrap();
    let nodes = f.dir.path().join("iox2/nodes");
    let folders = || -> Vec<_> {
        let entries = std::fs::read_dir(&nodes).unwrap().map(|e| e.unwrap().path());
        entries.filter(|path| path.is_dir()).collect()
    };
    let own = folders();
    let reader = Helper::start(f.dir.path(), "subscriber");
    let dead: Vec<_> = folders().into_iter().filter(|folder| !own.contains(folder)).collect();
    assert_eq!(dead.len(), 1);
    reader.kill();
    std::fs::remove_file(dead[0].join("depthrig_node.details")).unwrap();
    clean(&f.bus);
    assert_eq!(f.bus.clean_dead(), 0, "what is gone is not cleaned up again");
    assert_eq!(folders(), own);
    let left = std::fs::read_dir(&nodes).unwrap().count();
    assert_eq!(left, 4, "this process's folder and its three files");
    // Its slot is free again.
    let all: Vec<_> = (0..17).map(|_| f.bus.subscriber(&f.id).unwrap()).collect();
    drop(all);
}

#[test]
fn sixteen_subscribers_find_room_beside_the_daemons_own() {
    let f = fixture();
    let publisher = f.bus.publisher(&f.id, LEN, 48).unwrap();
    let daemon = f.bus.subscriber(&f.id).unwrap();
    let mut subscribers: Vec<_> = (0..16).map(|_| f.bus.subscriber(&f.id).unwrap()).collect();
    assert_eq!(publish(&publisher, 1), 17);
    for subscriber in &mut subscribers {
        assert_eq!(whole(&subscriber.next_timeout(WAIT).unwrap().unwrap()), 1);
    }
    let e = f.bus.subscriber(&f.id).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::LimitReached);
    assert!(e.to_string().contains("all of its 17 places for subscribers are taken"), "{e}");
    drop(daemon);
    f.bus.subscriber(&f.id).unwrap();
}

#[test]
fn a_process_without_descriptors_is_told_so() {
    let f = fixture();
    let _publisher = f.bus.publisher(&f.id, LEN, 16).unwrap();
    let said = Helper::start(f.dir.path(), "out of descriptors").wait_for("refused");
    assert!(said.contains("file descriptors open") && said.contains("ulimit -n"), "{said}");
}

#[test]
fn every_slot_has_memory_and_what_has_none_is_refused() {
    // A size that no other test has, for they run at the same time.
    const ODD: usize = 54_321;
    let f = fixture();
    let data = || -> Vec<_> {
        let files = std::fs::read_dir(shm::SHM_DIR).unwrap().map(|e| e.unwrap().path());
        files.filter(|path| path.extension().is_some_and(|e| e == "data")).collect()
    };
    let publisher = f.bus.publisher(&f.id, ODD, 16).unwrap();
    assert_eq!(publisher.slots(), 16);
    let sizes = data().into_iter().filter_map(|path| std::fs::metadata(path).ok());
    let ours: Vec<_> = sizes.filter(|m| (16 * ODD as u64..18 * ODD as u64).contains(&m.size())).collect();
    assert!(!ours.is_empty());
    assert!(ours.iter().all(|m| m.blocks() * 512 >= m.size()), "{ours:?}");
    let too_large = shm::free_bytes(shm::SHM_DIR.as_ref()).unwrap() as usize / 10;
    let e = f.bus.publisher(&StreamId::new("cam", "large").unwrap(), too_large, 48).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::NoSpace);
    assert!(
        e.to_string().contains("has no room for its 48 slots") && e.to_string().contains("7 would fit"),
        "{e}"
    );
}

/// Files of shared memory that are larger than the memory behind them.
fn without_memory() -> BTreeSet<PathBuf> {
    let files = std::fs::read_dir(shm::SHM_DIR).unwrap().flatten().map(|e| e.path());
    let of_depthrig = files.filter(|p| p.file_name().unwrap().to_string_lossy().starts_with(SHM_PREFIX));
    of_depthrig.filter(|p| std::fs::metadata(p).is_ok_and(|m| m.blocks() * 512 < m.len())).collect()
}

#[test]
fn nothing_of_a_channel_gets_its_memory_later() {
    let f = fixture();
    let publisher = f.bus.publisher(&f.id, LEN, 16).unwrap();
    let mut subscriber = f.bus.subscriber(&f.id).unwrap();
    publish(&publisher, 1);
    assert_eq!(whole(&subscriber.next_timeout(WAIT).unwrap().unwrap()), 1);
    // Other tests are creating channels: an unfinished one is soon complete, or gone.
    let lacking = without_memory();
    std::thread::sleep(Duration::from_secs(1));
    let still: Vec<_> = without_memory().intersection(&lacking).cloned().collect();
    assert_eq!(still, Vec::<PathBuf>::new());
}

#[test]
fn free_shared_memory_is_seen() {
    assert!(shm::free_bytes(shm::SHM_DIR.as_ref()).unwrap() > 0);
    assert_eq!(shm::free_bytes("/nowhere".as_ref()).unwrap_err().kind(), ErrorKind::Other);
}

/// The files of services: in the folder of a bus, and those in shared memory, of every bus.
fn service_files(root: &std::path::Path) -> Vec<PathBuf> {
    let of = |folder: &std::path::Path, extension: &str| -> Vec<PathBuf> {
        let files = std::fs::read_dir(folder).into_iter().flatten().map(|entry| entry.unwrap().path());
        files.filter(|path| path.extension().is_some_and(|e| e == extension)).collect()
    };
    [of(&root.join("iox2/services"), "service"), of(shm::SHM_DIR.as_ref(), "dynamic")].concat()
}

/// The last one to leave a service locks it, forgets it, and then removes its files; here it is killed before the last step.
#[test]
fn a_channel_that_was_half_removed_is_made_anew() {
    let f = fixture();
    let before = service_files(f.dir.path());
    let publisher = f.bus.publisher(&f.id, LEN, 16).unwrap();
    let links = tempfile::tempdir_in(shm::SHM_DIR).unwrap();
    let own = tempfile::tempdir_in(f.dir.path()).unwrap();
    // Files of other tests may be among them; restoring them does no harm.
    let mut kept = Vec::new();
    for (i, file) in service_files(f.dir.path()).into_iter().filter(|file| !before.contains(file)).enumerate()
    {
        let at = if file.starts_with(shm::SHM_DIR) { links.path() } else { own.path() };
        let link = at.join(i.to_string());
        if std::fs::hard_link(&file, &link).is_ok() {
            kept.push((link, file));
        }
    }
    assert!(kept.len() >= 4, "two services, two files each: {kept:#?}");
    drop(publisher);
    for (link, file) in kept.into_iter().filter(|(_, file)| !file.exists()) {
        std::fs::rename(link, file).unwrap();
    }
    let publisher = f.bus.publisher(&f.id, LEN, 16).unwrap();
    let mut subscriber = f.bus.subscriber(&f.id).unwrap();
    publish(&publisher, 1);
    assert_eq!(whole(&subscriber.next_timeout(WAIT).unwrap().unwrap()), 1);
}
