//! Shared memory that runs out: others fill it, rigs compete for it, killed subscribers keep it. Nothing dies of it, and
//! what is missing is said.
//!
//! Full memory needs a `/dev/shm` of its own: this binary starts itself again in a mount namespace with a small one. Where
//! that is not permitted the test does nothing, and tools/test.sh counts it.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use depthrig_bus::{Bus, ErrorKind, HostTime, RigName, RuntimeDir, StreamId, shm};
use depthrig_daemon::status::RigStatus;
use depthrig_tests::disk::without_a_small_disk;
use depthrig_tests::{Home, RigText, all_stream, camera, wait_until};
use std::io::{BufRead, BufReader, Write};
use std::os::unix::fs::MetadataExt;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

const ROLE: &str = "DEPTHRIG_SHM_TEST_ROLE";
const DIR: &str = "DEPTHRIG_SHM_TEST_DIR";
const WAIT: Duration = Duration::from_secs(20);

fn delivered(status: &RigStatus, camera_name: &str) -> u64 {
    camera(status, camera_name).streams.iter().map(|s| s.delivered).min().unwrap()
}

fn no_slot(status: &RigStatus) -> u64 {
    status.cameras.iter().flat_map(|c| &c.streams).filter_map(|s| s.dropped.get("no_slot")).sum()
}

/// Runs the test `role` of this file in a process of its own whose `/dev/shm` has so many MiB, and expects it to end well.
fn with_small_memory(role: &str, mib: u32) {
    let script =
        format!("mount -t tmpfs -o size={mib}m depthrig-test /dev/shm || exit 99; exec \"$0\" \"$@\"");
    let done = Command::new("unshare")
        .args(["--user", "--map-root-user", "--mount", "sh", "-c", &script])
        .arg(std::env::current_exe().unwrap())
        .args(["--exact", role, "--nocapture"])
        .env(ROLE, role)
        .output();
    let done = match done {
        Ok(done) => done,
        Err(e) => return without_a_small_disk(&format!("there is no unshare command: {e}")),
    };
    let said = format!("{}{}", String::from_utf8_lossy(&done.stdout), String::from_utf8_lossy(&done.stderr));
    if done.status.code() == Some(99) || said.contains("unshare: ") {
        return without_a_small_disk(said.trim());
    }
    assert!(done.status.success(), "{role} ended with {}: {said}", done.status);
    assert!(said.contains("1 passed"), "{role} did not run: {said}");
}

fn is_role(role: &str) -> bool {
    std::env::var(ROLE).is_ok_and(|r| r == role)
}

/// Takes all that is left of `/dev/shm`, as another program would; freed when dropped.
struct Filler(&'static str);

impl Filler {
    fn fill() -> Self {
        let filler = Self("/dev/shm/filler");
        let mut file = std::fs::File::create(filler.0).unwrap();
        for size in [1 << 20, 4096] {
            while file.write_all(&vec![1; size]).is_ok() {}
        }
        assert_eq!(shm::free_bytes(shm::SHM_DIR.as_ref()).unwrap(), 0);
        filler
    }
}

impl Drop for Filler {
    fn drop(&mut self) {
        std::fs::remove_file(self.0).unwrap();
    }
}

/// Bytes of the slots of all channels, and how many of them have memory.
fn backed() -> (u64, u64) {
    let files = std::fs::read_dir(shm::SHM_DIR).unwrap().map(|e| e.unwrap().path());
    let data = files.filter(|p| p.extension().is_some_and(|e| e == "data"));
    data.map(|p| std::fs::metadata(p).unwrap())
        .fold((0, 0), |(bytes, had), m| (bytes + m.size(), had + (m.blocks() * 512).min(m.size())))
}

#[test]
fn a_daemon_and_its_subscribers_outlive_a_full_shared_memory() {
    with_small_memory("inside_full_memory", 24);
}

/// Not a test by itself: see [`with_small_memory`].
#[test]
fn inside_full_memory() {
    if !is_role("inside_full_memory") {
        return;
    }
    let home = Home::default();
    let rig = home.start(RigText::default().camera("cam", "").text()).unwrap();
    let bus = Bus::open(&home.runtime(), &RigName::new("test").unwrap()).unwrap();
    let id: StreamId = "cam/color".parse().unwrap();
    let mut readers: Vec<_> = (0..4).map(|_| bus.subscriber_within(&id, WAIT).unwrap()).collect();
    for reader in &mut readers {
        reader.next_timeout(WAIT).unwrap().expect("a frame");
    }
    let (bytes, had) = backed();
    assert_eq!(bytes, had, "slots without memory");
    let filler = Filler::fill();
    // Every slot is written: four readers may hold 64 frames, one after the other, for what they share is one slot.
    let mut held = Vec::new();
    wait_until(&rig, "every slot in use", |s| {
        let reader = &mut readers[(held.len() / 16).min(3)];
        held.extend(reader.try_next().ok().flatten());
        no_slot(s) > 0
    });
    drop(held);
    let before = delivered(&rig.control().status(), "cam");
    wait_until(&rig, "frames while the memory is full", |s| delivered(s, "cam") > before + 30);
    // New channels are refused.
    for e in [
        bus.subscriber(&id).unwrap_err(),
        bus.publisher(&"other/color".parse().unwrap(), 1000, 16).unwrap_err(),
        Bus::open(&home.runtime(), &RigName::new("second").unwrap()).unwrap_err(),
    ] {
        assert_eq!(e.kind(), ErrorKind::NoSpace, "{e}");
        assert!(e.to_string().contains("/dev/shm is full"), "{e}");
    }
    let e = home.start(RigText::default().camera("cam", "").text().replace("test", "second").as_str());
    assert!(e.is_err_and(|e| e.to_string().contains("/dev/shm")), "a second rig started");
    drop(filler);
    let mut late = bus.subscriber(&id).unwrap();
    assert!(late.next_timeout(WAIT).unwrap().is_some());
    rig.stop();
}

#[test]
fn rigs_that_start_at_once_share_the_memory_or_say_what_is_missing() {
    with_small_memory("inside_scarce_memory", 20);
}

/// Not a test by itself: see [`with_small_memory`].
#[test]
fn inside_scarce_memory() {
    if !is_role("inside_scarce_memory") {
        return;
    }
    // Each of the four finds all of the memory free, and wants a third of it.
    let homes: Vec<_> = (0..4).map(|_| Home::default()).collect();
    let started: Vec<_> = std::thread::scope(|scope| {
        let start =
            |home| scope.spawn(move || Home::start(home, RigText::default().camera("cam", "").text()));
        let threads: Vec<_> = homes.iter().map(start).collect();
        threads.into_iter().map(|t| t.join().unwrap()).collect()
    });
    let (bytes, had) = backed();
    assert_eq!(bytes, had, "slots without memory");
    let mut running = 0;
    for rig in started {
        match rig {
            Ok(rig) => {
                let status = wait_until(&rig, "frames", |s| delivered(s, "cam") > 20);
                let slots = status.shared_memory.slots;
                assert!((shm::MIN_SLOTS..=shm::DEFAULT_SLOTS).contains(&slots), "{slots}");
                running += 1;
                rig.stop();
            }
            Err(e) => assert!(e.to_string().contains("/dev/shm"), "{e}"),
        }
    }
    assert!(running >= 1, "none of them started");
    // One that can never fit is refused with what would.
    let bus = Bus::open(&homes[0].runtime(), &RigName::new("test").unwrap()).unwrap();
    let e = bus.publisher(&"cam/large".parse().unwrap(), 2 << 20, 48).unwrap_err();
    assert_eq!(e.kind(), ErrorKind::NoSpace);
    assert!(e.to_string().contains("48 slots (97 MiB), 6 would fit; enlarge it"), "{e}");
    assert_eq!(backed().0, 0, "what was refused is gone");
}

/// Not a test by itself: a process that holds all the frames of `cam/color` that it gets.
#[test]
fn holding_process() {
    let Ok(dir) = std::env::var(DIR) else { return };
    let runtime = RuntimeDir::at(dir.as_ref()).unwrap();
    let bus = Bus::open(&runtime, &RigName::new("test").unwrap()).unwrap();
    let mut subscriber = bus.subscriber_within(&"cam/color".parse().unwrap(), WAIT).unwrap();
    println!("ready");
    let mut held = Vec::new();
    loop {
        match subscriber.next_timeout(WAIT) {
            Ok(frame) => held.extend(frame),
            Err(_) => std::thread::sleep(Duration::from_millis(20)),
        }
    }
}

struct Holder(Child);

impl Holder {
    fn start(home: &Home) -> Self {
        let mut command = Command::new(std::env::current_exe().unwrap());
        let command = command.args(["--exact", "holding_process", "--nocapture"]);
        let mut holder =
            Self(command.env(DIR, home.runtime().path()).stdout(Stdio::piped()).spawn().unwrap());
        let out = BufReader::new(holder.0.stdout.take().unwrap());
        assert!(out.lines().any(|line| line.unwrap().contains("ready")), "it ended before it was ready");
        holder
    }
}

impl Drop for Holder {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[test]
fn a_stream_is_back_when_the_subscriber_that_held_every_slot_is_killed() {
    let kills = if std::env::var_os("DEPTHRIG_LONG").is_some() { 200 } else { 4 };
    let home = Home::default();
    let rig = home.start(RigText::default().and("[bus]\nslots = 16\n").camera("cam", "").text()).unwrap();
    wait_until(&rig, "streaming", all_stream);
    let nodes = home.runtime().path().join("iox2/nodes");
    let count = || std::fs::read_dir(&nodes).unwrap().count();
    let own = count();
    let mut worst = Duration::ZERO;
    for _ in 0..kills {
        let lost = no_slot(&rig.control().status());
        let holder = Holder::start(&home);
        wait_until(&rig, "no free slot", |s| no_slot(s) > lost + 2);
        let before = delivered(&rig.control().status(), "cam");
        drop(holder);
        let killed = HostTime::now();
        wait_until(&rig, "frames again", |s| delivered(s, "cam") > before + 2);
        worst = worst.max(killed.elapsed());
    }
    println!("{kills} kills, back after at most {worst:?}");
    wait_until(&rig, "the killed are gone", |_| count() <= own);
    rig.stop();
}
