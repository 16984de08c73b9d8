//! Logs on the standard error output: text for people, or JSON lines for machines.

use crate::args::{Global, LogFormat};
use crate::context::wants_color;
use core::fmt::Debug;
use std::io::{self, IsTerminal};
use tracing::field::Field;
use tracing::level_filters::LevelFilter;
use tracing_subscriber::field::MakeExt;
use tracing_subscriber::filter::filter_fn;
use tracing_subscriber::fmt;
use tracing_subscriber::fmt::format::{Writer, debug_fn};
use tracing_subscriber::layer::SubscriberExt;
use tracing_subscriber::util::SubscriberInitExt;

/// Starts logging with the options of `global`, at `loudness` levels above the default.
pub fn start(global: &Global, loudness: i32) {
    let level = level(i32::from(global.verbose) - i32::from(global.quiet) + loudness);
    let no_color = std::env::var_os("NO_COLOR").is_some_and(|v| !v.is_empty());
    let color = wants_color(global.color, no_color, std::io::stderr().is_terminal());
    // To that library a board that is partly out of the image is worth a warning; depthrig says itself where a board was found.
    let is_ours = filter_fn(move |m| level >= LevelFilter::DEBUG || !m.target().starts_with("calib_targets"));
    let logs = fmt().with_max_level(level).with_writer(io::stderr).with_target(global.verbose > 1);
    match global.log_format {
        LogFormat::Text => {
            let text = logs.with_ansi(color).fmt_fields(debug_fn(field).delimited(" "));
            text.finish().with(is_ours).init();
        }
        LogFormat::Json => logs.json().flatten_event(true).finish().with(is_ours).init(),
    }
}

/// Writes the fields of an event so that untrusted texts (the API, datasets, file names) neither look like events nor
/// reach the terminal as control sequences.
fn field(writer: &mut Writer<'_>, field: &Field, value: &dyn Debug) -> core::fmt::Result {
    let value = escaped(&format!("{value:?}"));
    match field.name() {
        "message" => write!(writer, "{value}"),
        name => write!(writer, "{name}={value}"),
    }
}

/// The text with line breaks and other control characters as escapes.
fn escaped(text: &str) -> String {
    let breaks = |c: char| c.is_control() || ['\u{2028}', '\u{2029}'].contains(&c);
    let mut line = String::with_capacity(text.len());
    for c in text.chars() {
        if breaks(c) { line.extend(c.escape_default()) } else { line.push(c) }
    }
    line
}

/// Warnings without an option; more with each `-v`, less with each `-q`.
const fn level(loudness: i32) -> LevelFilter {
    match loudness {
        ..=-2 => LevelFilter::OFF,
        -1 => LevelFilter::ERROR,
        0 => LevelFilter::WARN,
        1 => LevelFilter::INFO,
        2 => LevelFilter::DEBUG,
        3.. => LevelFilter::TRACE,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write;

    /// Formats an event that quotes untrusted text, with colours and without.
    fn logged(quoted: &str, color: bool) -> String {
        use std::sync::{Arc, Mutex};
        #[derive(Clone, Default)]
        struct Kept(Arc<Mutex<Vec<u8>>>);
        impl Write for Kept {
            fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
                self.0.lock().unwrap().extend_from_slice(bytes);
                Ok(bytes.len())
            }

            fn flush(&mut self) -> io::Result<()> {
                Ok(())
            }
        }
        let kept = Kept::default();
        let writer = kept.clone();
        let logs = fmt().with_writer(move || writer.clone()).with_ansi(color);
        let logs = logs.fmt_fields(debug_fn(field).delimited(" ")).finish();
        tracing::subscriber::with_default(logs, || tracing::info!(path = %quoted, "recording {quoted}"));
        let bytes = kept.0.lock().unwrap().clone();
        String::from_utf8(bytes).unwrap()
    }

    #[test]
    fn no_text_forges_a_line_or_reaches_the_terminal() {
        let forged = "/data\n2026-11-21T10:00:00Z ERROR forged\r\u{85}\u{2028}\u{1b}[2J\u{7}\u{9b}31m";
        for color in [false, true] {
            let said = logged(forged, color);
            assert_eq!(said.matches('\n').count(), 1, "{said:?}");
            assert!(
                said.ends_with('\n') && said.contains("recording /data") && said.contains("forged"),
                "{said:?}"
            );
            assert!(!said.contains(['\r', '\u{85}', '\u{2028}', '\u{7}', '\u{9b}']), "{said:?}");
            assert!(!said.contains("\u{1b}[2J"), "{said:?}");
            assert_eq!(said.contains('\u{1b}'), color, "{said:?}");
        }
        assert_eq!(escaped("plain \u{e4} \"quoted\""), "plain \u{e4} \"quoted\"");
    }

    #[test]
    fn levels() {
        assert_eq!(level(0), LevelFilter::WARN);
        assert_eq!(level(1), LevelFilter::INFO);
        assert_eq!(level(9), LevelFilter::TRACE);
        assert_eq!(level(-1), LevelFilter::ERROR);
        assert_eq!(level(-5), LevelFilter::OFF);
    }
}
