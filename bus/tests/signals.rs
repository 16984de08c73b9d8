//! Signals between real processes: slow, killed, second and foreign ones.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

#[path = "support/helper.rs"]
mod helper;

use depthrig_bus::signal::{self, MAX_AHEAD, SLOTS};
use depthrig_bus::{
    ErrorKind, FieldType, HostTime, RuntimeDir, SHM_PREFIX, Series, SignalDescription, SignalField,
    SignalFlags, SignalHeader, SignalName, SignalPublisher, SignalSample, Signals, Stamp, Value, shm,
};
use helper::{DIR, Helper, ROLE};
use iceoryx2::prelude::*;
use proptest::prelude::*;
use std::io::Write;
use std::process::Command;
use std::sync::Arc;
use std::time::Duration;

const WAIT: Duration = Duration::from_secs(40);

struct Fixture {
    dir: tempfile::TempDir,
    signals: Signals,
}

fn fixture() -> Fixture {
    let dir = tempfile::tempdir().unwrap();
    let signals = Signals::open(&RuntimeDir::at(dir.path()).unwrap()).unwrap();
    Fixture { dir, signals }
}

fn named(name: &str) -> SignalName {
    name.parse().unwrap()
}

fn arm() -> SignalDescription {
    SignalDescription::joints(named("arm/position"), &["shoulder", "elbow"], "rad").unwrap()
}

/// Sample k of the tests.
fn publish(publisher: &mut SignalPublisher) -> u64 {
    let k = publisher.publish([0.0, 1.0]).unwrap();
    assert!(k > 0);
    k
}

/// Not a test by itself: the other process of the tests below, this same binary started again.
#[test]
fn helper_process() {
    let Ok(role) = std::env::var(ROLE) else { return };
    let Ok(dir) = std::env::var(DIR) else { return };
    let signals = Signals::open(&RuntimeDir::at(dir.as_ref()).unwrap()).unwrap();
    if role == "publisher" {
        let mut publisher = signals.publisher(&arm()).unwrap();
        println!("ready");
        loop {
            publish(&mut publisher);
            std::thread::sleep(Duration::from_millis(2));
        }
    }
    let mut subscriber = signals.subscriber_within(arm().name(), WAIT).unwrap();
    println!("ready");
    if role == "reader" {
        while subscriber.next_timeout(WAIT).unwrap().is_none() {}
        println!("read");
    }
    loop {
        std::thread::park();
    }
}

#[test]
fn samples_arrive_in_order_with_all_that_is_needed_to_read_them() {
    let f = fixture();
    let field = |name: &str, kind| SignalField::new(name, kind, "");
    let fields = vec![
        field("flag", FieldType::Bool),
        field("pair", FieldType::F64).with_count(2),
        field("note", FieldType::Text),
    ];
    let description = SignalDescription::fields(named("arm/state"), fields).unwrap();
    let mut publisher = f.signals.publisher(&description).unwrap();
    let mut subscriber = f.signals.subscriber(description.name()).unwrap();
    assert!(subscriber.try_next().unwrap().is_none());
    let before = HostTime::now().ns();
    let note = "say \"hi\",\n\ttwice 🦾";
    let values = |x: f64| [Value::Bool(true), Value::F64(x), Value::F64(f64::NAN), Value::Text(note)];
    assert_eq!(publisher.publish(values(1.5)).unwrap(), 1);
    let measured = HostTime::now();
    let stamp = Stamp { time: measured, uncertainty_ns: 7, flags: SignalFlags::TIME_UNCERTAIN };
    assert_eq!(publisher.publish_at(&stamp, values(2.5)).unwrap(), 2);
    for (k, x) in [(1, 1.5), (2, 2.5)] {
        let sample = subscriber.next_timeout(WAIT).unwrap().unwrap();
        let header = sample.header();
        assert_eq!((header.sequence, header.session), (k, publisher.session()));
        assert_eq!(**sample.description(), description);
        assert_eq!(header.description_hash, description.hash());
        assert_eq!(sample.field("pair").next(), Some(Value::F64(x)));
        assert!(sample.numbers()[2].is_nan());
        assert_eq!(sample.field("note").next(), Some(Value::Text(note)));
        assert!(before <= header.time_ns && header.time_ns <= header.publish_time_ns);
        assert_eq!(sample.has(SignalFlags::PUBLISH_TIME), k == 1);
        let stated = (header.time_ns, header.uncertainty_ns, header.flags);
        assert!(k == 1 || stated == (measured.ns(), 7, SignalFlags::TIME_UNCERTAIN.0));
    }
    assert_eq!((subscriber.missed(), subscriber.restarts()), (0, 0));
}

#[test]
fn a_slow_subscriber_loses_the_oldest_and_knows_it() {
    let f = fixture();
    let mut publisher = f.signals.publisher(&arm()).unwrap();
    let mut subscriber = f.signals.subscriber(arm().name()).unwrap();
    publish(&mut publisher);
    assert_eq!(subscriber.try_next().unwrap().unwrap().header().sequence, 1);
    for _ in 0..700 {
        publish(&mut publisher);
    }
    let first = subscriber.try_next().unwrap().unwrap();
    assert_eq!((first.header().sequence, subscriber.missed()), (701 - 512 + 1, 700 - 512));
    let mut series = Series::new(Duration::from_secs(1000));
    assert_eq!(series.fill(&mut subscriber).unwrap(), 511);
    assert_eq!(series.latest().unwrap().header().sequence, 701);
}

#[test]
fn a_second_publisher_is_refused_and_the_holder_named() {
    let f = fixture();
    let first = f.signals.publisher(&arm()).unwrap();
    let e = f.signals.publisher(&arm()).unwrap_err();
    let me = format!("signal arm/position is published already, by process {}", std::process::id());
    assert!(e.kind() == ErrorKind::InUse && e.to_string().contains(&me), "{e}");
    let published = f.signals.published();
    assert_eq!(published.len(), 1);
    assert!(published[0].0 == *arm().name() && published[0].1.contains("process"));
    drop(first);
    // A process that another test is just starting has a copy of the lock until it runs its program.
    for _ in 0..1000 {
        if f.signals.published().is_empty() {
            break;
        }
        std::thread::sleep(Duration::from_millis(10));
    }
    assert!(f.signals.published().is_empty());
    f.signals.publisher(&arm()).unwrap();
}

#[test]
fn refused_values_and_times_leave_no_gap() {
    let f = fixture();
    let mut publisher = f.signals.publisher(&arm()).unwrap();
    let mut subscriber = f.signals.subscriber(arm().name()).unwrap();
    let measured = HostTime::now();
    publisher.publish_at(&Stamp::at(measured), [0.0, 0.0]).unwrap();
    let mut refused = |stamp: Stamp, values: &[Value<'_>], why: &str| {
        let e = publisher.publish_at(&stamp, values.iter().copied()).unwrap_err();
        assert!(e.kind() == ErrorKind::Invalid && e.to_string().contains(why), "{e}");
    };
    let good = [Value::F64(0.0), Value::F64(0.0)];
    let late = Stamp::at(measured.plus_ns(1));
    refused(Stamp::at(measured), &good, "is not after that of the sample before");
    refused(Stamp::at(measured.plus_ns(-1)), &good, "is not after that of the sample before");
    let ahead = HostTime::now().plus(2 * MAX_AHEAD + WAIT);
    refused(Stamp::at(ahead), &good, "ahead of the clock, at most 100 ms are possible");
    refused(late, &good[..1], "end before element 0 of field \"elbow\"");
    refused(late, &[good[0], good[0], good[0]], "more values than its fields");
    refused(late, &[good[0], Value::I64(1)], "field \"elbow\" is f64, and the value 1 is i64");
    publisher.publish([0.0, 0.0]).unwrap();
    let sequences: Vec<_> =
        (0..2).map(|_| subscriber.try_next().unwrap().unwrap().header().sequence).collect();
    assert_eq!((sequences, subscriber.missed()), (vec![1, 2], 0));
    // A replay states the times of its recording.
    let old = Stamp { flags: SignalFlags::REPLAYED, ..Stamp::at(HostTime::from_ns(5)) };
    publisher.publish_at(&old, good).unwrap();
    assert_eq!(subscriber.try_next().unwrap().unwrap().time().ns(), 5);
}

#[test]
fn values_of_4_kib_pass_and_more_do_not() {
    let f = fixture();
    let fields = vec![SignalField::new("note", FieldType::Text, "")];
    let description = SignalDescription::fields(named("arm/note"), fields).unwrap();
    let mut publisher = f.signals.publisher(&description).unwrap();
    let mut subscriber = f.signals.subscriber(description.name()).unwrap();
    let text = "x".repeat(4092);
    publisher.publish([text.as_str()]).unwrap();
    assert_eq!(subscriber.try_next().unwrap().unwrap().values().next(), Some(Value::Text(&text)));
    let e = publisher.publish([format!("{text}x").as_str()]).unwrap_err();
    assert!(e.to_string().contains("4097 bytes, 4096 is the most"), "{e}");
}

#[test]
fn a_late_subscriber_gets_the_newest_sample() {
    let f = fixture();
    let mut publisher = f.signals.publisher(&arm()).unwrap();
    publish(&mut publisher);
    publish(&mut publisher);
    let mut late = f.signals.subscriber(arm().name()).unwrap();
    publisher.welcome();
    assert_eq!(late.try_next().unwrap().unwrap().header().sequence, 2);
    assert_eq!(late.missed(), 0);
}

#[test]
fn an_unknown_signal_names_those_there_are() {
    let f = fixture();
    let e = f.signals.subscriber(arm().name()).unwrap_err();
    assert!(e.kind() == ErrorKind::NotFound && e.to_string().contains(": none"), "{e}");
    let _publisher = f.signals.publisher(&arm()).unwrap();
    let e = f.signals.subscriber(&named("arm/velocity")).unwrap_err();
    assert!(e.to_string().contains("signal arm/velocity: nobody publishes it"), "{e}");
    assert!(e.to_string().ends_with(": arm/position"), "{e}");
}

#[test]
fn eight_subscribers_find_room_and_a_ninth_is_refused() {
    let f = fixture();
    let mut publisher = f.signals.publisher(&arm()).unwrap();
    let mut subscribers: Vec<_> = (0..8).map(|_| f.signals.subscriber(arm().name()).unwrap()).collect();
    let e = f.signals.subscriber(arm().name()).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::LimitReached);
    assert!(
        e.to_string().contains("signal arm/position: all of its 8 places for subscribers are taken"),
        "{e}"
    );
    // The slots are enough for all that may wait and be held: nothing is lost but what was replaced.
    for _ in 0..3 * SLOTS {
        publish(&mut publisher);
    }
    for subscriber in &mut subscribers {
        let mut series = Series::new(WAIT);
        assert_eq!(series.fill(subscriber).unwrap(), signal::BUFFER);
        assert_eq!(series.latest().unwrap().header().sequence, 3 * SLOTS as u64);
    }
    drop(subscribers.pop());
    f.signals.subscriber(arm().name()).unwrap();
}

#[test]
fn a_killed_publisher_is_followed_by_another_and_nothing_else_notices() {
    let f = fixture();
    let other = SignalDescription::joints(named("hand/position"), &["thumb"], "rad").unwrap();
    let mut bystander = f.signals.publisher(&other).unwrap();
    let mut beside = f.signals.subscriber(other.name()).unwrap();
    let mut subscriber = None;
    let mut session = 0;
    // More often than the channel has places for publishers.
    let rounds = signal::MAX_PUBLISHERS as u64 + 2;
    for round in 0..rounds {
        let publisher = Helper::start(f.dir.path(), "publisher");
        let subscriber = subscriber.get_or_insert_with(|| f.signals.subscriber(arm().name()).unwrap());
        let mut read = 0;
        while read < 3 {
            bystander.publish([0.5]).unwrap();
            let Some(sample) = subscriber.next_timeout(WAIT).unwrap() else { continue };
            if sample.header().session != session {
                assert!(sample.header().session > session);
                session = sample.header().session;
                assert_eq!(subscriber.restarts(), round);
            }
            read += u64::from(subscriber.restarts() == round);
        }
        publisher.kill();
        while subscriber.next_timeout(Duration::from_millis(50)).unwrap().is_some() {}
        assert!(
            f.signals.published().iter().all(|(name, _)| name == other.name()),
            "the kernel freed the lock"
        );
    }
    let mut last = f.signals.publisher(&arm()).unwrap();
    publish(&mut last);
    let subscriber = subscriber.as_mut().unwrap();
    let sample = subscriber.next_timeout(WAIT).unwrap().unwrap();
    assert_eq!((sample.header().sequence, subscriber.restarts()), (1, rounds));
    let sent = bystander.publish([0.5]).unwrap();
    let mut seen = 0;
    while beside.try_next().unwrap().is_some() {
        seen += 1;
    }
    assert_eq!((seen + beside.missed(), beside.restarts()), (sent, 0));
}

#[test]
fn killed_readers_give_their_places_back_and_cost_nobody_a_sample() {
    let f = fixture();
    let mut publisher = f.signals.publisher(&arm()).unwrap();
    let mut steady = f.signals.subscriber(arm().name()).unwrap();
    let mut series = Series::new(WAIT);
    let mut taken = 0;
    let mut sent = 0;
    for round in 0..signal::MAX_SUBSCRIBERS + 3 {
        // Every other one never reads, so that all that the channel keeps waits for it.
        let mut reader = Helper::start(f.dir.path(), if round % 2 == 0 { "reader" } else { "sleeper" });
        for _ in 0..300 {
            sent = publish(&mut publisher);
            taken += series.fill(&mut steady).unwrap();
        }
        if round % 2 == 0 {
            reader.wait_for("read");
        }
        reader.kill();
        for _ in 0..300 {
            sent = publish(&mut publisher);
            taken += series.fill(&mut steady).unwrap();
        }
    }
    assert_eq!((taken as u64, steady.missed()), (sent, 0));
}

#[test]
fn a_publisher_with_other_fields_is_noticed() {
    let f = fixture();
    let mut first = f.signals.publisher(&arm()).unwrap();
    let mut subscriber = f.signals.subscriber(arm().name()).unwrap();
    let mut series = Series::new(WAIT);
    publish(&mut first);
    series.fill(&mut subscriber).unwrap();
    drop(first);
    let other = SignalDescription::joints(named("arm/position"), &["shoulder"], "rad").unwrap();
    let mut second = f.signals.publisher(&other).unwrap();
    second.publish([1.0]).unwrap();
    let e = series.fill(&mut subscriber).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::Changed);
    second.publish([2.0]).unwrap();
    assert_eq!(series.fill(&mut subscriber).unwrap(), 1);
    assert_eq!(series.latest().unwrap().numbers(), [2.0]);
    assert_eq!((series.window(WAIT).len(), subscriber.restarts()), (2, 1));
}

/// Creates the channel as another version of depthrig would: another schema, or another header.
fn foreign(f: &Fixture, schema: &str) -> (Node<ipc::Service>, Box<dyn core::any::Any>) {
    let root = Path::new(f.dir.path().join("iox2").to_str().unwrap().as_bytes()).unwrap();
    let mut config = Config::default();
    config.global.set_root_path(&root);
    config.global.prefix = FileName::new(SHM_PREFIX.as_bytes()).unwrap();
    let node = NodeBuilder::new().config(&config).create::<ipc::Service>().unwrap();
    let name: ServiceName = format!("{}/{}", signal::PREFIX, arm().name()).as_str().try_into().unwrap();
    let attributes =
        AttributeSpecifier::new().define(&"schema".try_into().unwrap(), &schema.try_into().unwrap()).unwrap();
    let builder = node.service_builder(&name).publish_subscribe::<[u8]>();
    let service: Box<dyn core::any::Any> = if schema == signal::SCHEMA {
        Box::new(builder.create_with_attributes(&attributes).unwrap()) // right schema, no header
    } else {
        Box::new(builder.user_header::<SignalHeader>().create_with_attributes(&attributes).unwrap())
    };
    (node, service)
}

#[test]
fn another_version_is_refused_with_what_to_do() {
    for schema in ["depthrig.signal/2", signal::SCHEMA] {
        let f = fixture();
        let _foreign = foreign(&f, schema);
        let publisher = f.signals.publisher(&arm()).unwrap_err();
        for e in [f.signals.subscriber(arm().name()).unwrap_err(), publisher] {
            assert_eq!(e.kind(), ErrorKind::VersionMismatch, "{e}");
            assert!(e.to_string().contains("with the same version"), "{e}");
        }
    }
}

/// A sample's header and payload.
fn raw() -> (SignalHeader, Vec<u8>) {
    let description = arm();
    let mut payload = description.json().as_bytes().to_vec();
    payload.resize(payload.len().next_multiple_of(8), 0);
    payload.extend([1.0f64, 2.0].iter().flat_map(|x| x.to_le_bytes()));
    let header = SignalHeader {
        description_hash: description.hash(),
        description_len: description.json().len() as u32,
        payload_len: payload.len() as u32,
        ..SignalHeader::default()
    };
    (header, payload)
}

#[test]
fn a_sample_that_breaks_the_contract_is_refused() {
    let (header, payload) = raw();
    let read = |header: &SignalHeader, payload: &[u8]| {
        SignalSample::decode(header, payload, &mut None, "signal arm/position")
    };
    assert_eq!(read(&header, &payload).unwrap().numbers(), [1.0, 2.0]);
    let refused = |header: SignalHeader, payload: &[u8], kind: ErrorKind, why: &str| {
        let e = read(&header, payload).unwrap_err();
        assert!(e.kind() == kind && e.to_string().contains(why), "{e}");
    };
    let version = SignalHeader { version: 2, ..header };
    refused(
        version,
        &payload,
        ErrorKind::VersionMismatch,
        "signal arm/position: a sample has header version 2",
    );
    let invalid = ErrorKind::Invalid;
    refused(header, &payload[1..], invalid, "length");
    refused(SignalHeader { description_len: 5000, ..header }, &payload, invalid, "length");
    refused(SignalHeader { description_len: 4000, ..header }, &payload, invalid, "cut off");
    refused(SignalHeader { description_hash: 1, ..header }, &payload, invalid, "another hash");
    let short = &payload[..payload.len() - 8];
    let stated = SignalHeader { payload_len: short.len() as u32, ..header };
    refused(stated, short, invalid, "its values have 8 bytes, not 16");
}

#[test]
fn a_description_is_parsed_once() {
    let (header, payload) = raw();
    let mut known = None;
    let what = "signal arm/position";
    let first = SignalSample::decode(&header, &payload, &mut known, what).unwrap();
    let second = SignalSample::decode(&header, &payload, &mut known, what).unwrap();
    assert!(Arc::ptr_eq(first.description(), second.description()));
}

proptest! {
    #[test]
    fn no_content_of_a_sample_is_a_panic(
        flips in prop::collection::vec((0..400usize, any::<u8>()), 0..4),
        lengths in any::<Option<(u16, u16)>>(),
        cut in 0..40usize,
    ) {
        let (mut header, mut payload) = raw();
        for (at, byte) in flips {
            let len = payload.len();
            payload[at % len] = byte;
        }
        payload.truncate(payload.len() - cut);
        header.payload_len = payload.len() as u32;
        if let Some((description, whole)) = lengths {
            header.description_len = u32::from(description);
            header.payload_len = u32::from(whole);
        }
        if let Ok(sample) = SignalSample::decode(&header, &payload, &mut None, "signal") {
            prop_assert_eq!(sample.values().count(), 2);
        }
    }
}

/// Runs the test `role` of this file in a process of its own whose `/dev/shm` has so many MiB.
fn with_small_memory(role: &str, mib: u32) {
    let script =
        format!("mount -t tmpfs -o size={mib}m depthrig-test /dev/shm || exit 99; exec \"$0\" \"$@\"");
    let done = Command::new("unshare")
        .args(["--user", "--map-root-user", "--mount", "sh", "-c", &script])
        .arg(std::env::current_exe().unwrap())
        .args(["--exact", role, "--nocapture"])
        .env(ROLE, role)
        .output();
    let said = done.as_ref().map_or_else(ToString::to_string, |done| {
        format!("{}{}", String::from_utf8_lossy(&done.stdout), String::from_utf8_lossy(&done.stderr))
    });
    if done.as_ref().is_ok_and(|d| d.status.code() != Some(99) && !said.contains("unshare: ")) {
        assert!(done.unwrap().status.success() && said.contains("1 passed"), "{role}: {said}");
        return;
    }
    let forbidden = std::env::var_os("DEPTHRIG_REQUIRE_TMPFS").is_some();
    assert!(!forbidden, "a small disk cannot be mounted here, which DEPTHRIG_REQUIRE_TMPFS forbids: {said}");
    println!("skipped: a small /dev/shm cannot be mounted here: {}", said.trim());
}

#[test]
fn with_little_shared_memory_a_signal_is_refused_and_others_go_on() {
    const NAME: &str = "with_little_shared_memory_a_signal_is_refused_and_others_go_on";
    if std::env::var(ROLE).is_err() {
        return with_small_memory(NAME, 6);
    }
    let f = fixture();
    let mut publisher = f.signals.publisher(&arm()).unwrap();
    let mut subscriber = f.signals.subscriber(arm().name()).unwrap();
    let note = vec![SignalField::new("note", FieldType::Text, "")];
    let note = SignalDescription::fields(named("arm/note"), note).unwrap();
    let e = f.signals.publisher(&note).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::NoSpace, "{e}");
    let why = format!("signal arm/note: /dev/shm has no room for its {SLOTS} slots");
    assert!(e.to_string().contains(&why) && e.to_string().contains("enlarge it"), "{e}");
    assert_eq!(f.signals.published().len(), 1, "a refused one is free again");
    let mut filler = std::fs::File::create("/dev/shm/filler").unwrap();
    for size in [1 << 20, 4096] {
        while filler.write_all(&vec![1; size]).is_ok() {}
    }
    assert_eq!(shm::free_bytes(shm::SHM_DIR.as_ref()).unwrap(), 0);
    for _ in 0..3 * SLOTS {
        publish(&mut publisher);
        assert!(subscriber.try_next().unwrap().is_some());
    }
    assert_eq!(subscriber.missed(), 0);
    let e = f.signals.subscriber(arm().name()).unwrap_err();
    assert!(e.to_string().contains("is full"), "{e}");
}
