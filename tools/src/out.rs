//! Output on stdout: lines, JSON, tables, and human-readable numbers.

use crate::printable;
use anyhow::Result;
use comfy_table::{CellAlignment, ContentArrangement, Table, presets};
use serde::Serialize;
use std::io::Write;

/// Writes `text`, which may have several lines, and a newline; control sequences are escaped.
///
/// # Errors
/// When the output is closed; a closed pipe ends a command quietly (see [`crate::exit`]).
pub fn line(text: impl core::fmt::Display) -> Result<()> {
    raw(&printable::lines(&text.to_string()))
}

/// Like [`line`], for text with depthrig's own colours.
///
/// # Errors
/// As [`line`].
pub fn styled(text: impl core::fmt::Display) -> Result<()> {
    raw(&printable::styled(&text.to_string()))
}

/// Writes `text` and a newline to the standard error output, as [`line`]; a closed stream is ignored.
pub fn note(text: impl core::fmt::Display) {
    let text = printable::lines(&text.to_string());
    let _ = writeln!(std::io::stderr().lock(), "{text}");
}

fn raw(text: &str) -> Result<()> {
    writeln!(std::io::stdout().lock(), "{text}")?;
    Ok(())
}

/// Writes `value` as indented JSON.
///
/// # Errors
/// As [`line`].
pub fn json(value: &impl Serialize) -> Result<()> {
    raw(&printable::json(&serde_json::to_string_pretty(value)?))
}

/// Writes `value` as JSON on one line, as streams of JSON want it.
///
/// # Errors
/// As [`line`].
pub fn json_line(value: &impl Serialize) -> Result<()> {
    raw(&printable::json(&serde_json::to_string(value)?))
}

/// `n` of `what`, which takes an `s` unless there is one: `1 set`, `2 sets`.
pub fn count(n: impl core::fmt::Display + TryInto<u64> + Copy, what: &str) -> String {
    let one = n.try_into().is_ok_and(|n| n == 1);
    format!("{n} {what}{}", if one { "" } else { "s" })
}

/// A table without borders; the columns from `first_number` on are aligned to the right.
pub fn table(header: &[&str], first_number: usize, rows: impl IntoIterator<Item = Vec<String>>) -> String {
    let mut table = Table::new();
    table.load_style(presets::NOTHING);
    table.set_content_arrangement(ContentArrangement::Disabled);
    table.set_header(header.to_vec());
    for row in rows {
        table.add_row(row.iter().map(|cell| printable::line(cell)));
    }
    for (i, column) in table.column_iter_mut().enumerate() {
        column.set_padding((0, 2));
        if i >= first_number {
            column.set_cell_alignment(CellAlignment::Right);
        }
    }
    table.trim_fmt()
}

/// `text` behind `mark`, indented by two and wrapped at `width` columns; words longer than a line stay whole.
pub fn item(mark: &str, text: &str, width: usize) -> Vec<String> {
    let room = width.saturating_sub(4).max(20);
    let mut lines = vec![String::new()];
    for word in text.split_whitespace() {
        let line =
            lines.last_mut().filter(|l| l.is_empty() || l.chars().count() + 1 + word.chars().count() <= room);
        match line {
            Some(line) if line.is_empty() => line.push_str(word),
            Some(line) => {
                line.push(' ');
                line.push_str(word);
            }
            None => lines.push(word.to_owned()),
        }
    }
    lines.iter().enumerate().map(|(i, l)| format!("  {} {l}", if i == 0 { mark } else { " " })).collect()
}

/// Bytes with a binary unit: `1.5 GiB`.
pub fn bytes(n: u64) -> String {
    const UNITS: [&str; 5] = ["B", "KiB", "MiB", "GiB", "TiB"];
    let mut value = n as f64;
    let mut unit = 0;
    while value >= 1024.0 && unit < UNITS.len() - 1 {
        value /= 1024.0;
        unit += 1;
    }
    if unit == 0 { format!("{n} B") } else { format!("{value:.1} {}", UNITS[unit]) }
}

/// A length of time: `8.2 s`, `4 min 09 s`, `3 h 05 min`.
pub fn seconds(s: f64) -> String {
    if s < 0.0 || !s.is_finite() {
        return "-".to_owned();
    }
    let whole = s as u64;
    match whole {
        0..60 => format!("{s:.1} s"),
        60..3600 => format!("{} min {:02} s", whole / 60, whole % 60),
        _ => format!("{} h {:02} min", whole / 3600, whole / 60 % 60),
    }
}

/// Reasons and counts: `device_gap 3, no_slot 1`; `0` when nothing was lost.
pub fn reasons(counts: &std::collections::BTreeMap<String, u64>) -> String {
    let parts: Vec<_> = counts.iter().filter(|(_, n)| **n > 0).map(|(why, n)| format!("{why} {n}")).collect();
    if parts.is_empty() { "0".to_owned() } else { parts.join(", ") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_read_well() {
        assert_eq!(
            [bytes(0), bytes(1023), bytes(1536), bytes(3 << 30)],
            ["0 B", "1023 B", "1.5 KiB", "3.0 GiB"]
        );
        assert_eq!(bytes(u64::MAX), "16777216.0 TiB");
        assert_eq!([seconds(8.24), seconds(249.0), seconds(11_105.0)], ["8.2 s", "4 min 09 s", "3 h 05 min"]);
        assert_eq!(seconds(f64::NAN), "-");
        let counts = [("no_slot".to_owned(), 1), ("device_gap".to_owned(), 3), ("late".to_owned(), 0)].into();
        assert_eq!(reasons(&counts), "device_gap 3, no_slot 1");
    }

    #[test]
    fn items_are_wrapped_at_words() {
        let said = item("!", "one two  three four five six seven", 24);
        assert_eq!(said, ["  ! one two three four", "    five six seven"]);
        assert_eq!(item("-", &"x".repeat(30), 10), [format!("  - {}", "x".repeat(30))]);
        assert_eq!(item("-", "", 80), ["  - "]);
    }

    #[test]
    fn tables_align_numbers_to_the_right() {
        let text = table(
            &["camera", "Hz"],
            1,
            [vec!["d435".into(), "30.0".into()], vec!["l515".into(), "5".into()]],
        );
        assert_eq!(text, "camera    Hz\nd435    30.0\nl515       5");
    }
}
