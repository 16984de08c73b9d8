//! INI text with the line of every value.
//!
//! Not the crate `rust-ini`: it gives a line number for broken syntax only, and a wrong number in a calibration must
//! be found by the person who edits it.

use depthrig_driver::{Error, ErrorKind, Result};

/// Sections and keys in the order of the file; their names are compared without regard to case, as the vendor's
/// own reader does.
pub(super) struct Ini<'t> {
    /// Names the file in messages.
    origin: String,
    sections: Vec<(&'t str, usize)>,
    entries: Vec<Entry<'t>>,
}

struct Entry<'t> {
    section: &'t str,
    key: &'t str,
    value: &'t str,
    line: usize,
}

/// A number and the line it stands on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Number<'t> {
    /// As the file writes it.
    pub(super) key: &'t str,
    pub(super) value: f64,
    pub(super) line: usize,
}

impl<'t> Ini<'t> {
    /// Reads `text`; `origin` is its file.
    pub(super) fn parse(text: &'t str, origin: &str) -> Result<Self> {
        let mut ini = Self { origin: origin.to_owned(), sections: Vec::new(), entries: Vec::new() };
        let mut section = "";
        for (i, raw) in text.trim_start_matches('\u{feff}').lines().enumerate() {
            let line = i + 1;
            let text = raw.trim();
            if text.is_empty() || text.starts_with([';', '#']) {
                continue;
            }
            if let Some(rest) = text.strip_prefix('[') {
                let Some((name, after)) = rest.split_once(']') else {
                    return Err(ini.at(line, format_args!("the section's \"]\" is missing: {text:?}")));
                };
                if !without_comment(after).is_empty() {
                    return Err(ini.at(line, format_args!("something follows the section's name: {text:?}")));
                }
                section = name.trim();
                ini.sections.push((section, line));
                continue;
            }
            let Some((key, value)) = text.split_once('=') else {
                let what = format_args!("neither a section, nor \"key = value\", nor a comment: {text:?}");
                return Err(ini.at(line, what));
            };
            let key = key.trim();
            let value = without_comment(value);
            if let Some(first) = ini.find(section, key)
                && first.value != value
            {
                let what = format_args!(
                    "[{section}] {key} is {value:?} here and {:?} on line {}; keep the right one",
                    first.value, first.line
                );
                return Err(ini.at(line, what));
            }
            ini.entries.push(Entry { section, key, value, line });
        }
        Ok(ini)
    }

    fn find(&self, section: &str, key: &str) -> Option<&Entry<'t>> {
        let same =
            |e: &&Entry<'_>| e.section.eq_ignore_ascii_case(section) && e.key.eq_ignore_ascii_case(key);
        self.entries.iter().find(same)
    }

    /// The line on which `section` begins, if it is there.
    pub(super) fn section(&self, section: &str) -> Option<usize> {
        self.sections.iter().find(|(name, _)| name.eq_ignore_ascii_case(section)).map(|(_, line)| *line)
    }

    /// The number `key` of `section`; `None` when it is not there.
    pub(super) fn number(&self, section: &str, key: &str) -> Result<Option<Number<'t>>> {
        let Some(e) = self.find(section, key) else { return Ok(None) };
        match e.value.parse::<f64>() {
            Ok(value) if value.is_finite() => Ok(Some(Number { key: e.key, value, line: e.line })),
            _ => {
                let hint = if e.value.contains(',') { "; decimals have a point, not a comma" } else { "" };
                let what = format_args!("[{section}] {key} = {:?} is not a number{hint}", e.value);
                Err(self.at(e.line, what))
            }
        }
    }

    /// An error that names the file and the line.
    pub(super) fn at(&self, line: usize, what: impl core::fmt::Display) -> Error {
        Error::new(ErrorKind::BadInput, format!("{}, line {line}: {what}", self.origin))
    }

    /// An error that names the file.
    pub(super) fn problem(&self, what: impl core::fmt::Display) -> Error {
        Error::new(ErrorKind::BadInput, format!("{}: {what}", self.origin))
    }
}

/// The value without a comment behind it. A `#` or `;` inside of a word is not one.
fn without_comment(value: &str) -> &str {
    let end = value
        .char_indices()
        .find(|&(i, c)| matches!(c, ';' | '#') && (i == 0 || value[..i].ends_with(char::is_whitespace)))
        .map_or(value.len(), |(i, _)| i);
    value[..end].trim()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ini(text: &str) -> Ini<'_> {
        Ini::parse(text, "a.conf").unwrap()
    }

    #[test]
    fn spaces_comments_and_case() {
        let i = ini(
            "\u{feff}; head\r\n [ One ] ; first\r\n fx=1.5\r\nFY = -2e-3 # note\n#k=3\n\n[two]\nfx = 7\n",
        );
        assert_eq!(i.number("ONE", "FX").unwrap().unwrap(), Number { key: "fx", value: 1.5, line: 3 });
        assert_eq!(i.number("one", "fy").unwrap().unwrap(), Number { key: "FY", value: -0.002, line: 4 });
        assert_eq!(i.number("two", "fx").unwrap().unwrap(), Number { key: "fx", value: 7.0, line: 8 });
        assert_eq!(i.number("one", "k").unwrap(), None);
        assert_eq!((i.section("Two"), i.section("three")), (Some(7), None));
    }

    #[test]
    fn what_is_wrong_is_said_with_its_line() {
        let message = |text: &str| match Ini::parse(text, "a.conf") {
            Err(e) => e.to_string(),
            Ok(i) => i.number("s", "k").unwrap_err().to_string(),
        };
        for (text, wanted) in [
            ("[s\nk=1", "a.conf, line 1: the section's \"]\" is missing"),
            ("[s] x\nk=1", "a.conf, line 1: something follows"),
            ("[s]\n\nk 1", "a.conf, line 3: neither a section"),
            ("[s]\nk=1,5", "a.conf, line 2: [s] k = \"1,5\" is not a number; decimals have a point"),
            ("[s]\nk=", "a.conf, line 2: [s] k = \"\" is not a number"),
            ("[s]\nk=nan", "is not a number"),
            ("[s]\nk=1e999", "is not a number"),
            ("[s]\nk=1\nK=2", "a.conf, line 3: [s] K is \"2\" here and \"1\" on line 2"),
        ] {
            assert!(message(text).contains(wanted), "{text:?}: {}", message(text));
        }
        assert_eq!(ini("[s]\nk=1\nk=1").number("s", "k").unwrap().unwrap().value, 1.0);
    }
}
