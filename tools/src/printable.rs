//! Makes untrusted text printable: text from a dataset, a daemon or a file name may hold escape
//! sequences that move the cursor, change the terminal's title or hide what follows.
//!
//! Everything that is printed for people passes here: [`crate::out`] on the standard output, [`crate::exit`] and
//! [`crate::out::note`] on the standard error output.

use core::fmt::Write as _;
use std::path::Path;

/// The escape sequences of depthrig's own: bold, three colours, and back to plain.
pub const BOLD: &str = "\x1b[1m";
/// Something is wrong.
pub const RED: &str = "\x1b[31m";
/// Something may be wrong.
pub const YELLOW: &str = "\x1b[33m";
/// It ended as it should.
pub const GREEN: &str = "\x1b[32m";
/// Plain again.
pub const RESET: &str = "\x1b[0m";

/// `text` on one line: each control character, and each that changes the direction or the line, as an escape of Rust's,
/// such as `\u{1b}` or `\n`.
pub fn line(text: &str) -> String {
    escaped(text, |_| false)
}

/// A path on one line.
pub fn path(path: &Path) -> String {
    line(&path.display().to_string())
}

/// The same of a text of several lines.
pub fn lines(text: &str) -> String {
    escaped(text, |c| c == '\n')
}

/// The same of a text of several lines with depthrig's own escape sequences in it, which are kept.
pub fn styled(text: &str) -> String {
    const KEPT: [&str; 5] = [BOLD, RED, YELLOW, GREEN, RESET];
    let mut clean = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(at) = rest.find('\x1b') {
        let (before, escape) = rest.split_at(at);
        clean.push_str(&lines(before));
        let known = KEPT.iter().find(|code| escape.starts_with(**code)).map_or(1, |code| code.len());
        let (code, after) = escape.split_at(known);
        clean.push_str(&if known > 1 { code.to_owned() } else { line(code) });
        rest = after;
    }
    clean.push_str(&lines(rest));
    clean
}

/// A text of JSON with the control characters escaped that JSON lets pass.
pub fn json(text: &str) -> String {
    let mut clean = String::with_capacity(text.len());
    for c in text.chars() {
        if matches!(c, '\u{7f}'..='\u{9f}') {
            // They are nowhere but in strings. Writing to a string cannot fail.
            let _ = write!(clean, "\\u{:04x}", u32::from(c));
        } else {
            clean.push(c);
        }
    }
    clean
}

fn escaped(text: &str, keep: impl Fn(char) -> bool) -> String {
    let mut clean = String::with_capacity(text.len());
    for c in text.chars() {
        if keep(c) || !is_hidden(c) {
            clean.push(c);
        } else {
            // Writing to a string cannot fail.
            let _ = write!(clean, "{}", c.escape_default());
        }
    }
    clean
}

/// Control characters, line and paragraph separators, and what turns the direction of writing (Unicode's `Bidi_Control`).
fn is_hidden(c: char) -> bool {
    c.is_control()
        || matches!(c, '\u{61c}' | '\u{200e}' | '\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_that_would_steer_a_terminal_is_shown() {
        assert_eq!(line("a\x1b]0;evil\x07b\r\n\tc"), "a\\u{1b}]0;evil\\u{7}b\\r\\n\\tc");
        assert_eq!(line("\u{9b}31m \u{202e}gnp.exe"), "\\u{9b}31m \\u{202e}gnp.exe");
        assert_eq!(line("Küche, 厨房, 🍳"), "Küche, 厨房, 🍳");
        assert_eq!(lines("a\nb\r"), "a\nb\\r");
        let own = format!("{RED}x\x1b[0m\x1b[2J");
        assert_eq!(styled(&own), format!("{RED}x\x1b[0m\\u{{1b}}[2J"));
    }

    #[test]
    fn nothing_hidden_is_left() {
        for c in '\0'..='\u{2fff}' {
            let text = format!("a{c}{RED}b{c}");
            assert!(!line(&text).chars().any(is_hidden), "{c:?}");
            assert!(!lines(&text).chars().any(|c| c != '\n' && is_hidden(c)), "{c:?}");
            let colored = styled(&text);
            assert!(!colored.replace(RED, "").chars().any(|c| c != '\n' && is_hidden(c)), "{c:?}");
            let text = serde_json::to_string_pretty(&[&text]).unwrap();
            assert!(!json(&text).chars().any(|c| c != '\n' && c.is_control()), "{c:?}");
            assert_eq!(
                serde_json::from_str::<[String; 1]>(&json(&text)).unwrap(),
                serde_json::from_str::<[String; 1]>(&text).unwrap()
            );
        }
    }
}
