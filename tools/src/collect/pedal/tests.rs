use super::*;
use std::io::Write as _;

fn event(time_us: i64, code: u16, value: i32) -> Vec<u8> {
    typed(time_us, EV_KEY, code, value)
}

fn typed(time_us: i64, kind: u16, code: u16, value: i32) -> Vec<u8> {
    let mut bytes = Vec::new();
    bytes.extend((time_us / 1_000_000).to_ne_bytes());
    bytes.extend((time_us % 1_000_000).to_ne_bytes());
    bytes.extend(kind.to_ne_bytes());
    bytes.extend(code.to_ne_bytes());
    bytes.extend(value.to_ne_bytes());
    bytes
}

/// A pipe, and both of its ends.
struct Pipe {
    _folder: tempfile::TempDir,
    writer: std::fs::File,
    pedal: Pedal,
}

fn pipe() -> Pipe {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("pedal");
    rustix::fs::mknodat(rustix::fs::CWD, &path, FileType::Fifo, Mode::RWXU, 0).unwrap();
    let pedal = Pedal::open(&path).unwrap();
    let writer = std::fs::OpenOptions::new().write(true).open(&path).unwrap();
    Pipe { _folder: folder, writer, pedal }
}

impl Pipe {
    fn send(&mut self, bytes: &[u8]) -> Vec<Press> {
        self.writer.write_all(bytes).unwrap();
        self.pedal.presses().unwrap()
    }
}

#[test]
fn the_first_key_is_next_and_others_repeat() {
    let mut pipe = pipe();
    assert_eq!(pipe.send(&event(5_000_000, 48, 1)), []);
    // Repetitions, the code of the scanner, and reports between events.
    assert_eq!(pipe.send(&event(5_300_000, 48, 2)), []);
    assert_eq!(pipe.send(&typed(5_300_000, 4, 4, 458_757)), []);
    assert_eq!(pipe.send(&typed(5_300_000, 2, 48, 0)), []);
    assert_eq!(pipe.send(&[typed(5_300_000, 0, 0, 0), event(5_400_000, 48, 0)].concat()), [Press::Next]);
    assert_eq!(pipe.send(&[event(6_000_000, 30, 1), event(6_100_000, 30, 0)].concat()), [Press::Again]);
    assert_eq!(pipe.send(&[event(7_000_000, 48, 1), event(7_999_999, 48, 0)].concat()), [Press::Next]);
    assert_eq!(pipe.send(&[event(8_000_000, 48, 1), event(9_000_000, 48, 0)].concat()), [Press::Again]);
    // A release without a press: the pedal was held while it was opened.
    assert_eq!(pipe.send(&event(9_000_000, 48, 0)), []);
    assert_eq!(pipe.send(&[event(10_000_000, 48, 1), event(10_100_000, 30, 0)].concat()), []);
    assert_eq!(pipe.send(&event(10_200_000, 48, 0)), [Press::Next]);
}

#[test]
fn an_event_in_parts_is_one() {
    let mut pipe = pipe();
    let bytes = [event(0, 1, 1), event(1000, 1, 0)].concat();
    assert_eq!(pipe.send(&bytes[..30]), []);
    assert_eq!(pipe.send(&bytes[30..]), [Press::Next]);
}

#[test]
fn a_key_that_is_held_counts_once() {
    let mut keys = Keys::default();
    let down = Event { time_us: 0, code: 7, is_down: true };
    let at = |s: f64| HostTime::from_ns((s * 1e9) as i64);
    assert_eq!(keys.take(down, at(0.0)), None);
    assert_eq!(keys.hold(at(0.9)), None);
    assert_eq!(keys.hold(at(1.0)), Some(Press::Again));
    assert_eq!(keys.hold(at(2.0)), None);
    assert_eq!(keys.take(Event { time_us: 3_000_000, is_down: false, ..down }, at(3.0)), None);
}

#[test]
fn a_pedal_that_is_gone_is_reported_once() {
    let Pipe { writer, mut pedal, _folder } = pipe();
    drop(writer);
    assert!(pedal.presses().unwrap_err().to_string().contains("is gone"));
    assert_eq!(pedal.presses().unwrap(), []);
}

#[test]
fn other_files_are_refused() {
    let refused = |path: &str| Pedal::open(Path::new(path)).unwrap_err().to_string();
    assert!(refused("/dev/null").contains("not an input device"));
    assert!(refused("/dev/input/by-id/none").contains("ls /dev/input/by-id"));
    assert!(refused("/proc/self/status").contains("not an input device"));
}
