//! Copies a process's output into the daemon's log: lines of bounded length, and no more of them than a log can use.

use depthrig_bus::HostTime;
use std::io::Read;

/// Bytes of a line at most; a longer one is cut.
const MAX_LINE: usize = 1000;
/// Lines at once, and lines a second.
const BURST: f64 = 200.0;
const PER_SECOND: f64 = 50.0;

/// Reads `from` to its end and gives each line to `write`, those that are too many as one line that says how many.
pub(super) fn copy(mut from: impl Read, mut write: impl FnMut(&str)) {
    let mut line = Line::default();
    let mut buffer = [0; 4096];
    loop {
        let n = match from.read(&mut buffer) {
            Ok(0) => break,
            Ok(n) => n,
            Err(e) if e.kind() == std::io::ErrorKind::Interrupted => continue,
            Err(_) => break,
        };
        for byte in buffer.get(..n).unwrap_or_default() {
            if *byte == b'\n' {
                line.end(HostTime::now(), &mut write);
            } else {
                line.push(*byte);
            }
        }
    }
    if !line.bytes.is_empty() {
        line.end(HostTime::now(), &mut write);
    }
    line.say_left_out(&mut write);
}

/// A line that is being read, and the allowance for more.
#[derive(Debug)]
struct Line {
    bytes: Vec<u8>,
    cut: bool,
    allowed: f64,
    at: HostTime,
    left_out: u64,
}

impl Default for Line {
    fn default() -> Self {
        Self { bytes: Vec::new(), cut: false, allowed: BURST, at: HostTime::now(), left_out: 0 }
    }
}

impl Line {
    fn push(&mut self, byte: u8) {
        if self.bytes.len() < MAX_LINE {
            self.bytes.push(byte);
        } else {
            self.cut = true;
        }
    }

    fn end(&mut self, now: HostTime, write: &mut impl FnMut(&str)) {
        let since_s = now.since_ns(self.at).max(0) as f64 / 1e9;
        self.at = now;
        self.allowed = (self.allowed + since_s * PER_SECOND).min(BURST);
        if self.allowed < 1.0 {
            self.left_out += 1;
        } else {
            self.allowed -= 1.0;
            self.say_left_out(write);
            // Escapes of a terminal have no place in a log.
            let text = String::from_utf8_lossy(&self.bytes);
            let text: String = text.chars().filter(|c| !c.is_control() || *c == '\t').collect();
            if self.cut {
                write(&format!("{text} …"));
            } else if !text.is_empty() {
                write(&text);
            }
        }
        self.bytes.clear();
        self.cut = false;
    }

    fn say_left_out(&mut self, write: &mut impl FnMut(&str)) {
        let n = core::mem::take(&mut self.left_out);
        if n > 0 {
            write(&format!("({n} lines left out)"));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn lines(text: &[u8]) -> Vec<String> {
        let mut lines = Vec::new();
        copy(text, |line| lines.push(line.to_owned()));
        lines
    }

    #[test]
    fn lines_come_out_as_they_went_in_without_what_spoils_a_log() {
        assert_eq!(lines(b"one\n\ntwo \x1b[31mred\r\nno end"), ["one", "two [31mred", "no end"]);
        assert_eq!(lines(b"\xff\xfe\n"), ["\u{fffd}\u{fffd}"]);
    }

    #[test]
    fn what_is_too_much_is_cut_and_counted() {
        let long = vec![b'x'; 1 << 20];
        let got = lines(&long);
        assert_eq!((got.len(), got[0].len()), (1, MAX_LINE + " …".len()));
        let many = "line\n".repeat(100_000);
        let got = lines(many.as_bytes());
        assert!(got.len() < 1000, "{}", got.len());
        let left_out: u64 =
            got.iter().filter_map(|l| l.strip_prefix('(')?.split(' ').next()?.parse::<u64>().ok()).sum();
        let shown = got.iter().filter(|l| *l == "line").count() as u64;
        assert_eq!(left_out + shown, 100_000);
    }
}
