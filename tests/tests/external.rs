//! Cameras that other processes serve, in a running rig: the processes crash, hang, lie, flood and come back, and the
//! camera beside them loses nothing.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used)]

use depthrig_bus::HostTime;
use depthrig_daemon::rig::Rig;
use depthrig_daemon::status::{CameraState, CameraStatus, RigStatus};
use depthrig_tests::{Home, RigText, all_stream, assert_balanced, assert_undisturbed, camera, wait_until};
use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::{Receiver, sync_channel};
use std::time::Duration;

const PROGRAM: &str = env!("CARGO_BIN_EXE_external_camera");
const WAIT: Duration = Duration::from_secs(20);

/// A process of a test; killed at its end.
struct Process {
    child: Child,
    lines: Receiver<String>,
}

impl Process {
    fn start(home: &Home, behaviour: &str) -> Self {
        let mut child = Command::new(PROGRAM)
            .arg(behaviour)
            .env("DEPTHRIG_RUNTIME_DIR", home.runtime().path())
            .env("DEPTHRIG_RIG", "test")
            .env("DEPTHRIG_CAMERA", "ext")
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let out = BufReader::new(child.stdout.take().unwrap());
        let (sender, lines) = sync_channel(1024);
        std::thread::spawn(move || out.lines().map_while(Result::ok).all(|line| sender.send(line).is_ok()));
        Self { child, lines }
    }

    /// Waits for a line of its output that has `part` in it.
    fn says(&self, part: &str) -> String {
        let deadline = HostTime::now().plus(WAIT);
        let mut all = Vec::new();
        while let Ok(line) = self.lines.recv_timeout(deadline.from_now()) {
            if line.contains(part) {
                return line;
            }
            all.push(line);
        }
        panic!("it never said {part:?}, but: {all:#?}");
    }

    fn signal(&self, name: &str) {
        signal(self.child.id(), name);
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn signal(pid: u32, name: &str) {
    let sent = Command::new("kill").arg(format!("-{name}")).arg(pid.to_string()).status().unwrap();
    assert!(sent.success());
}

/// Whether process `pid` is there and no zombie.
fn lives(pid: u32) -> bool {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).unwrap_or_default();
    stat.rsplit_once(") ").is_some_and(|(_, rest)| !rest.starts_with('Z'))
}

fn text(extra: &str) -> String {
    let external =
        format!("[[camera]]\nname = \"ext\"\nbackend = \"external\"\nheartbeat_timeout_s = 1.0\n{extra}\n");
    RigText::default().camera("good", "").and(&external).text().to_owned()
}

fn command(behaviour: &str) -> String {
    format!("command = [\"{PROGRAM}\", \"{behaviour}\"]")
}

fn ext(status: &RigStatus) -> &CameraStatus {
    camera(status, "ext")
}

fn says(status: &RigStatus, part: &str) -> bool {
    ext(status).message.as_deref().is_some_and(|m| m.contains(part))
}

fn streams(status: &RigStatus) -> bool {
    ext(status).state == CameraState::Streaming
}

fn lost(status: &RigStatus, reason: &str) -> u64 {
    ext(status).streams.iter().map(|s| s.dropped.get(reason).copied().unwrap_or(0)).sum()
}

/// ID of the process that serves the camera, from its port name.
fn pid(status: &RigStatus) -> u32 {
    ext(status).port.strip_prefix("process ").unwrap().parse().unwrap()
}

/// A rig that leaves what it says of a lost camera in its status for long enough to be read.
fn patient(text: &str) -> String {
    text.replace("backoff_max_s = 0.5", "backoff_min_s = 2.0\nbackoff_max_s = 2.0")
}

/// Ends the rig; the camera beside must have lost nothing.
fn stop(rig: Rig) -> RigStatus {
    let status = rig.stop().status;
    assert_undisturbed(camera(&status, "good"));
    assert_balanced(&status);
    status
}

#[test]
fn a_process_may_start_before_or_after_the_daemon() {
    let home = Home::default();
    let process = Process::start(&home, "normal");
    process.says("behaves");
    std::thread::sleep(Duration::from_millis(300));
    let rig = home.start(&text("")).unwrap();
    let status = wait_until(&rig, "streaming", all_stream);
    assert_eq!((ext(&status).model.as_str(), ext(&status).serial.as_str()), ("Fake", "1"));
    stop(rig);

    // The same process serves the next daemon, too.
    let rig = home.start(&text("")).unwrap();
    wait_until(&rig, "streaming again", all_stream);
    drop(process);
    stop(rig);

    let rig = home.start(&text("")).unwrap();
    let status = wait_until(&rig, "word of what is missing", |s| says(s, "no process serves it"));
    assert_eq!(ext(&status).state, CameraState::Reconnecting);
    let _process = Process::start(&home, "normal");
    wait_until(&rig, "streaming", all_stream);
    let status = stop(rig);
    let mut names = ext(&status).streams.iter().map(|s| (s.id.as_str(), s.clock.domain.as_str()));
    assert_eq!(names.next(), Some(("ext/color", "device")));
}

#[test]
fn a_killed_process_is_seen_at_once_and_its_successor_streams_with_a_new_clock() {
    let home = Home::default();
    let process = Process::start(&home, "normal");
    let rig = home.start(&patient(&text(""))).unwrap();
    wait_until(&rig, "streaming", all_stream);
    std::thread::sleep(Duration::from_millis(500));
    process.signal("KILL");
    // Its lock reveals it; its silence would be noticed later, with another message.
    wait_until(&rig, "the loss", |s| says(s, "ended without a word"));
    drop(process);
    let _process = Process::start(&home, "normal");
    wait_until(&rig, "streaming again", all_stream);
    std::thread::sleep(Duration::from_millis(300));
    let status = stop(rig);
    assert_eq!(ext(&status).reconnects, 1);
    assert!(ext(&status).streams.iter().all(|s| s.clock.epoch >= 1), "{:?}", ext(&status).streams);
}

#[test]
fn a_stopped_process_is_hung_and_goes_on_when_it_wakes() {
    let home = Home::default();
    let process = Process::start(&home, "normal");
    let rig = home.start(&patient(&text(""))).unwrap();
    wait_until(&rig, "streaming", all_stream);
    process.signal("STOP");
    let said = format!("its process {} has said nothing for", process.child.id());
    let status = wait_until(&rig, "the silence", |s| says(s, &said));
    assert!(says(&status, "kill -9") || says(&status, "end it"), "{:?}", ext(&status).message);
    // Its last message still lies there, and is not taken for a sign of life.
    wait_until(&rig, "that nobody answers", |s| says(s, "serves it and has said nothing for 1.0 s"));
    process.signal("CONT");
    wait_until(&rig, "streaming again", all_stream);
    assert_eq!(ext(&stop(rig)).reconnects, 1);
}

#[test]
fn a_frame_announced_and_not_sent_ends_the_session_and_both_sides_report_it() {
    let home = Home::default();
    let process = Process::start(&home, "other_size");
    let rig = home.start(&patient(&text(""))).unwrap();
    let status = wait_until(&rig, "the lie", |s| says(s, "does not send what it announced"));
    assert!(says(&status, "160x120"), "{:?}", ext(&status).message);
    process.says("refused: 8 frames in a row are not");
    assert!(lost(&status, "wrong_size") >= 8 || lost(&rig.control().status(), "wrong_size") >= 8);
    drop(process);
    let _process = Process::start(&home, "normal");
    wait_until(&rig, "an honest one", all_stream);
    stop(rig);
}

#[test]
fn single_lies_and_numbers_that_cannot_be_cost_their_frames_alone() {
    for (behaviour, reason, at_least) in
        [("single_lies", "wrong_size", 2), ("says_more", "wrong_size", 8), ("strange_numbers", "", 0)]
    {
        let home = Home::default();
        let _process = Process::start(&home, behaviour);
        let rig = home.start(&text("")).unwrap();
        let status = wait_until(&rig, behaviour, |s| {
            streams(s)
                && ext(s).streams.iter().all(|c| c.delivered > 50)
                && (reason.is_empty() || lost(s, reason) >= at_least)
        });
        assert_eq!(ext(&status).reconnects, 0, "{behaviour}");
        let status = stop(rig);
        if behaviour == "single_lies" {
            // One frame in 64, which a full queue may have dropped before it was looked at.
            let streams = &ext(&status).streams;
            let lies: u64 = streams.iter().map(|s| s.captured / 64 + 1).sum();
            assert!(lost(&status, reason) <= lies, "{streams:?}");
        }
    }
}

#[test]
fn a_flood_is_bounded_and_counted() {
    let home = Home::default();
    let _process = Process::start(&home, "floods");
    let rig = home.start(&text("")).unwrap();
    wait_until(&rig, "the flood", |s| streams(s) && lost(s, "queue_full") > 2000);
    std::thread::sleep(Duration::from_secs(1));
    let before = rig.control().status();
    let began = HostTime::now();
    std::thread::sleep(Duration::from_secs(2));
    let after = rig.control().status();
    let elapsed = began.elapsed().as_secs_f64();
    for (b, a) in ext(&before).streams.iter().zip(&ext(&after).streams) {
        let rate = (a.delivered - b.delivered) as f64 / elapsed;
        assert!(rate > 10.0 && rate < 80.0, "{} delivers {rate} Hz of 30 announced", a.id);
        assert!(a.captured - b.captured > (a.delivered - b.delivered) * 2, "what is lost is counted: {a:?}");
    }
    stop(rig);
}

#[test]
fn a_second_process_for_a_camera_is_refused_and_names_the_first() {
    let home = Home::default();
    let first = Process::start(&home, "normal");
    let rig = home.start(&text("")).unwrap();
    wait_until(&rig, "streaming", all_stream);
    let mut second = Process::start(&home, "normal");
    let line = second.says("is served already");
    assert!(line.contains(&format!("process {}", first.child.id())), "{line}");
    assert_eq!(second.child.wait().unwrap().code(), Some(3));
    std::thread::sleep(Duration::from_millis(500));
    assert_eq!(ext(&stop(rig)).reconnects, 0);
}

#[test]
fn offers_that_cannot_be_are_refused_by_name() {
    for (lie, part) in [
        ("another_version", "it speaks version 2 of the hand-shake"),
        (
            "another_size",
            "it speaks version 1 of the hand-shake (100 bytes), this daemon version 1 (568 bytes)",
        ),
        ("fewer_modes", "it says 1 modes of 320 bytes, and sends 640 bytes"),
        ("no_name", "its field `stream` does not end with a zero byte"),
        ("nan_rate", "stream color: its field `rate_hz` is NaN"),
        ("nan_pose", "stream color: its field `pose.translation_m` has NaN"),
        ("huge_size", "stream color: its field `width` is 4294967295"),
        ("bad_text", "its field `serial` has control characters"),
    ] {
        let home = Home::default();
        let process = Process::start(&home, &format!("offers_{lie}"));
        let rig = home.start(&patient(&text(""))).unwrap();
        let status = wait_until(&rig, lie, |s| says(s, part));
        assert_eq!(ext(&status).state, CameraState::Reconnecting);
        process.says(part);
        stop(rig);
    }
    // The same offer without a lie is good, so each of the above was refused for its error.
    let home = Home::default();
    let _process = Process::start(&home, "offers_nothing_wrong");
    let rig = home.start(&text("")).unwrap();
    wait_until(&rig, "streaming", all_stream);
    stop(rig);
}

#[test]
fn what_the_process_says_is_what_the_status_says() {
    for (behaviour, state, part) in [
        ("absent", CameraState::Reconnecting, "(busy): the SDK says that another program has the sensor"),
        ("locked_and_silent", CameraState::Reconnecting, "serves it and has said nothing for 1.0 s"),
        ("finishes", CameraState::Finished, "at their end"),
        ("refuses", CameraState::Failed, "(unsupported): this sensor has no such mode today"),
    ] {
        let home = Home::default();
        // A camera that has failed by then would fail the start.
        let rig = home.start(&patient(&text(""))).unwrap();
        let process = Process::start(&home, behaviour);
        let status = wait_until(&rig, behaviour, |s| ext(s).state == state && says(s, part));
        if behaviour == "finishes" {
            process.says("the daemon has it all: true");
            assert_eq!(ext(&status).streams.iter().map(|s| s.captured).collect::<Vec<_>>(), [20, 20]);
        }
        stop(rig);
    }
}

#[test]
fn a_process_without_frames_is_stalled_and_opened_again() {
    let home = Home::default();
    let _process = Process::start(&home, "mute");
    let rig = home.start(&patient(&text("start_timeout_s = 0.5"))).unwrap();
    let status = wait_until(&rig, "the silence", |s| says(s, "sent no frame within 0.5 s"));
    assert!(says(&status, "(its state is \"starting\")"), "{:?}", ext(&status).message);
    stop(rig);
}

#[test]
fn the_daemon_starts_the_process_starts_it_again_and_ends_it() {
    let home = Home::default();
    let rig = home.start(&patient(&text(&command("normal")))).unwrap();
    let first = pid(&wait_until(&rig, "streaming", all_stream));
    assert!(lives(first));
    signal(first, "KILL");
    wait_until(&rig, "the loss", |s| !streams(s));
    let second = pid(&wait_until(&rig, "streaming again", all_stream));
    assert!(first != second && lives(second) && !lives(first));
    // One that hangs is killed.
    signal(second, "STOP");
    wait_until(&rig, "the silence", |s| !streams(s));
    let third = pid(&wait_until(&rig, "streaming once more", all_stream));
    assert!(second != third && lives(third) && !lives(second), "{second} {third}");
    let status = stop(rig);
    assert_eq!(ext(&status).reconnects, 2);
    assert!(!lives(third), "it ends with the rig");
}

#[test]
fn a_process_inherits_no_descriptor_of_the_daemon() {
    let home = Home::default();
    let list = home.path("descriptors");
    // Of `ls` itself is the folder that it reads.
    let shell = format!("ls -l /proc/self/fd >{}; exec {PROGRAM} normal", list.display());
    let rig = home.start(&text(&format!("command = [\"sh\", \"-c\", \"{shell}\"]"))).unwrap();
    wait_until(&rig, "streaming", all_stream);
    let listed = std::fs::read_to_string(list).unwrap();
    let open: Vec<_> = listed.lines().filter(|line| line.contains(" -> ")).collect();
    assert_eq!(open.len(), 4, "{open:#?}");
    assert!(open[3].contains("/proc/"), "{open:#?}");
    stop(rig);
}

#[test]
fn a_process_that_does_not_end_when_asked_is_killed() {
    let home = Home::default();
    let rig = home.start(&text(&command("ignores_term"))).unwrap();
    let pid = pid(&wait_until(&rig, "streaming", all_stream));
    signal(pid, "TERM");
    std::thread::sleep(Duration::from_millis(300));
    assert!(lives(pid), "it does not ignore the signal, so this test says nothing");
    stop(rig);
    assert!(!lives(pid));
}

#[test]
fn a_process_that_keeps_ending_is_started_less_and_less_often() {
    let home = Home::default();
    let rig = home.start(&text(&command("crash_at_once"))).unwrap();
    let status =
        wait_until(&rig, "the pause", |s| says(s, "ended with exit code 7; it is started again in 1."));
    assert_eq!(ext(&status).state, CameraState::Reconnecting);
    stop(rig);
    let Err(e) = home.start(&text("command = [\"/nowhere/camera\"]")) else { panic!("it started") };
    assert!(e.to_string().contains("\"/nowhere/camera\" of `command` could not be started"), "{e}");
    // Somebody else's process is not replaced.
    let process = Process::start(&home, "normal");
    process.says("behaves");
    std::thread::sleep(Duration::from_millis(300));
    let rig = home.start(&text(&command("normal"))).unwrap();
    wait_until(&rig, "who has it", |s| {
        says(s, &format!("process {} (external_camera) serves it already", process.child.id()))
    });
    drop(process);
    wait_until(&rig, "streaming", all_stream);
    stop(rig);
}
