use super::*;
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use std::fs::OpenOptions;
use std::io::Read;
use std::os::unix::fs::OpenOptionsExt;
use std::process::Command;

/// Set for the process that takes its terminal and panics.
const CHILD: &str = "DEPTHRIG_TEST_SCREEN_CHILD";

#[test]
fn a_panic_gives_the_terminal_back_and_its_message_is_seen() {
    if std::env::var_os(CHILD).is_some() {
        let _screen = Screen::enter().unwrap();
        panic!("the cause");
    }
    let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
    grantpt(&master).unwrap();
    unlockpt(&master).unwrap();
    let name = ptsname(&master, Vec::new()).unwrap();
    // Of a process that leads a session it would become the terminal, whose end would end the process.
    let flags = rustix::fs::OFlags::NOCTTY.bits() as i32;
    let mut options = OpenOptions::new();
    options.read(true).write(true).custom_flags(flags);
    let slave = options.open(name.to_str().unwrap()).unwrap();
    let before = termios::tcgetattr(&slave).unwrap();
    let test = "screen::tests::a_panic_gives_the_terminal_back_and_its_message_is_seen";
    let mut child = Command::new(std::env::current_exe().unwrap())
        .args([test, "--exact", "--nocapture"])
        .env(CHILD, "1")
        .stdin(slave.try_clone().unwrap())
        .stdout(slave.try_clone().unwrap())
        .stderr(slave.try_clone().unwrap())
        .spawn()
        .unwrap();
    assert!(!child.wait().unwrap().success());
    let after = termios::tcgetattr(&slave).unwrap();
    assert_eq!((after.local_modes, after.input_modes), (before.local_modes, before.input_modes));
    drop(slave);
    let mut output = Vec::new();
    // With the last writer gone a terminal's other end reports an error.
    let _ = std::fs::File::from(master).read_to_end(&mut output);
    let output = String::from_utf8_lossy(&output);
    let taken = output.find("\x1b[?1049h").unwrap();
    let given_back = output.find("\x1b[?1049l").unwrap();
    let cause = output.find("the cause").unwrap();
    assert!(taken < given_back && given_back < cause, "{output:?}");
}
