//! Reading a TOML table key by key, gathering every problem with its place instead of stopping at the first.

use super::Problem;
use std::cell::RefCell;
use std::collections::BTreeSet;
use std::ops::Range;
use toml::de::{DeTable, DeValue};

/// Problems and known keys, gathered while a text is read.
pub(crate) struct Report<'t> {
    text: &'t str,
    problems: RefCell<Vec<Problem>>,
    unknown: RefCell<Vec<Unknown>>,
    /// Every key that was asked for, as (table, key): the keys that the configuration knows.
    asked: RefCell<BTreeSet<(&'static str, &'static str)>>,
}

struct Unknown {
    at: usize,
    key: String,
    table: &'static str,
    shown: String,
    known: Vec<&'static str>,
}

impl<'t> Report<'t> {
    pub(crate) fn new(text: &'t str) -> Self {
        let (problems, unknown, asked) = <_>::default();
        Self { text, problems, unknown, asked }
    }

    /// Notes a problem at byte `at`.
    pub(crate) fn problem(&self, at: usize, message: impl Into<String>) {
        let before = self.text.get(..at).unwrap_or(self.text);
        let line_start = before.rfind('\n').map_or(0, |i| i + 1);
        self.problems.borrow_mut().push(Problem {
            line: 1 + before.matches('\n').count(),
            column: 1 + before[line_start..].chars().count(),
            message: message.into(),
        });
    }

    /// Every problem, once all tables were read: only now is known where an unknown key would have belonged.
    pub(crate) fn into_problems(self) -> Vec<Problem> {
        for u in self.unknown.take() {
            let asked = self.asked.borrow();
            let elsewhere = asked.iter().find(|(_, key)| *key == u.key).map(|(table, _)| *table);
            let advice = match (nearest(&u.key, u.known.iter().copied()), elsewhere) {
                (_, Some("")) => "it belongs to the top of the file".to_owned(),
                (_, Some(table)) if table == u.table => "only another backend has it".to_owned(),
                (_, Some(table)) => format!("it belongs to {table}"),
                (Some(near), None) => format!("did you mean \"{near}\"?"),
                (None, None) => format!("it has: {}", u.known.join(", ")),
            };
            let place =
                if u.shown.is_empty() { "at the top of the file".into() } else { format!("in {}", u.shown) };
            self.problem(u.at, format!("unknown key \"{}\" {place}; {advice}", u.key));
        }
        self.problems.into_inner()
    }

    /// Every key that was asked for so far, as (table, key).
    #[cfg(test)]
    pub(crate) fn asked(&self) -> BTreeSet<(&'static str, &'static str)> {
        self.asked.borrow().clone()
    }
}

/// The candidate that `word` most likely was to be, if any is near.
pub(crate) fn nearest<'c>(word: &str, candidates: impl Iterator<Item = &'c str>) -> Option<&'c str> {
    candidates
        .map(|c| (strsim::jaro_winkler(word, c), c))
        .filter(|(likeness, _)| *likeness > 0.8)
        .max_by(|a, b| a.0.total_cmp(&b.0))
        .map(|(_, c)| c)
}

/// A value and where it stands, in bytes.
pub(crate) struct Located<T> {
    pub(crate) value: T,
    pub(crate) at: usize,
}

/// A table of the file, or one that is absent and has its defaults.
pub(crate) struct Section<'r, 't> {
    report: &'r Report<'t>,
    table: Option<&'r DeTable<'t>>,
    /// Where problems of the table as a whole are reported.
    pub(crate) at: usize,
    /// Its kind: `[[camera]]`.
    kind: &'static str,
    /// How messages name it: `[[camera]] "d435"`.
    shown: String,
    known: RefCell<Vec<&'static str>>,
}

impl<'r, 't> Section<'r, 't> {
    pub(crate) fn top(report: &'r Report<'t>, table: &'r DeTable<'t>) -> Self {
        Self { report, table: Some(table), at: 0, kind: "", shown: String::new(), known: <_>::default() }
    }

    fn inner(&self, table: Option<&'r DeTable<'t>>, at: usize, kind: &'static str) -> Self {
        let of =
            self.shown.strip_prefix("[[camera]]").map(|name| format!(" of camera{name}")).unwrap_or_default();
        Section { report: self.report, table, at, kind, shown: format!("{kind}{of}"), known: <_>::default() }
    }

    /// Adds the table's name to how messages name it.
    pub(crate) fn set_name(&mut self, name: &str) {
        self.shown = format!("{} \"{name}\"", self.kind);
    }

    fn find(&self, key: &'static str) -> Option<(Range<usize>, &'r toml::Spanned<DeValue<'t>>)> {
        if !self.known.borrow().contains(&key) {
            self.known.borrow_mut().push(key);
        }
        self.report.asked.borrow_mut().insert((self.kind, key));
        self.table?.iter().find(|(k, _)| k.get_ref() == key).map(|(k, v)| (k.span(), v))
    }

    /// Notes a problem at byte `at`.
    pub(crate) fn problem(&self, at: usize, message: impl Into<String>) {
        self.report.problem(at, message);
    }

    /// How messages name `key` of this table.
    pub(crate) fn key_of(&self, key: &str) -> String {
        if self.shown.is_empty() { format!("\"{key}\"") } else { format!("\"{key}\" in {}", self.shown) }
    }

    /// The value of `key`, if it is there and of its type.
    pub(crate) fn get<T: FromToml>(&self, key: &'static str) -> Option<Located<T>> {
        let (_, value) = self.find(key)?;
        let at = value.span().start;
        match T::from_toml(value.get_ref()) {
            Ok(value) => Some(Located { value, at }),
            Err(why) => {
                self.problem(at, format!("{} {why}", self.key_of(key)));
                None
            }
        }
    }

    /// As [`Self::get`]; that the key is missing is a problem. `example` shows what to write.
    pub(crate) fn required<T: FromToml>(&self, key: &'static str, example: &str) -> Option<Located<T>> {
        let missing = self.table.is_none_or(|t| t.keys().all(|k| k.get_ref() != key));
        if missing {
            let place = if self.shown.is_empty() { "the top of the file" } else { &self.shown };
            self.problem(
                self.at,
                format!("\"{key}\" is missing in {place}; write, for example, {key} = {example}"),
            );
        }
        self.get(key)
    }

    /// The value of `key` when it passes `check`, else `default`; `check` returns the problem.
    pub(crate) fn or<T: FromToml>(
        &self,
        key: &'static str,
        default: T,
        check: impl FnOnce(&T) -> Result<(), String>,
    ) -> T {
        let Some(found) = self.get(key) else { return default };
        match check(&found.value) {
            Ok(()) => found.value,
            Err(why) => {
                self.problem(found.at, format!("{} {why}", self.key_of(key)));
                default
            }
        }
    }

    /// The value of `key` out of `choices`, else `default`.
    pub(crate) fn choice<T: Copy>(&self, key: &'static str, choices: &[(&str, T)], default: T) -> T {
        self.choose(key, choices).unwrap_or(default)
    }

    /// The value of `key` out of `choices`.
    pub(crate) fn choose<T: Copy>(&self, key: &'static str, choices: &[(&str, T)]) -> Option<T> {
        let Located { value, at } = self.get::<String>(key)?;
        let chosen = choices.iter().find(|(name, _)| *name == value).map(|(_, v)| *v);
        if chosen.is_none() {
            let names = || choices.iter().map(|(name, _)| *name);
            let advice = match nearest(&value, names()) {
                Some(near) => format!("did you mean \"{near}\"?"),
                None => format!("it is one of: {}", names().collect::<Vec<_>>().join(", ")),
            };
            self.problem(at, format!("{} has the invalid value \"{value}\"; {advice}", self.key_of(key)));
        }
        chosen
    }

    /// The table `key`; an absent one is read as empty.
    pub(crate) fn table(&self, key: &'static str, kind: &'static str) -> Self {
        let Some((_, value)) = self.find(key) else { return self.inner(None, self.at, kind) };
        let at = value.span().start;
        let table = value.get_ref().as_table();
        if table.is_none() {
            let is = describe(value.get_ref());
            self.problem(at, format!("{} must be a table, {kind}; it is {is}", self.key_of(key)));
        }
        self.inner(table, at, kind)
    }

    /// The entries of the table `key`, whose keys may be any; those with another value than `T` are noted and left out.
    pub(crate) fn entries<T: FromToml>(
        &self,
        key: &'static str,
        kind: &'static str,
    ) -> Vec<(String, Located<T>)> {
        let Some((_, value)) = self.find(key) else { return Vec::new() };
        let Some(table) = value.get_ref().as_table() else {
            let is = describe(value.get_ref());
            let what = format!("{} must be a table, {kind}; it is {is}", self.key_of(key));
            self.problem(value.span().start, what);
            return Vec::new();
        };
        let mut entries = Vec::new();
        for (name, value) in table {
            let at = value.span().start;
            match T::from_toml(value.get_ref()) {
                Ok(value) => entries.push((name.get_ref().to_string(), Located { value, at })),
                Err(why) => {
                    self.problem(at, format!("\"{}\" of {} {why}", name.get_ref(), self.key_of(key)));
                }
            }
        }
        entries
    }

    /// Where the value of `key` stands; the table itself when it is absent.
    pub(crate) fn at_key(&self, key: &'static str) -> usize {
        self.find(key).map_or(self.at, |(_, value)| value.span().start)
    }

    /// Whether `key` is there, whatever it is.
    pub(crate) fn has(&self, key: &'static str) -> bool {
        self.find(key).is_some()
    }

    /// The tables `[[key]]`, none when the key is absent; `None` when it is something else, which is noted.
    pub(crate) fn tables(&self, key: &'static str, kind: &'static str) -> Option<Vec<Self>> {
        let Some((_, value)) = self.find(key) else { return Some(Vec::new()) };
        let wrong = |v: &toml::Spanned<DeValue<'t>>| {
            let is = describe(v.get_ref());
            let what =
                format!("{} must be written as tables, each headed {kind}; it is {is}", self.key_of(key));
            self.problem(v.span().start, what);
        };
        let Some(array) = value.get_ref().as_array() else {
            wrong(value);
            return None;
        };
        let mut sections = Vec::new();
        for item in array {
            match item.get_ref().as_table() {
                Some(table) => sections.push(self.inner(Some(table), item.span().start, kind)),
                None => wrong(item),
            }
        }
        (sections.len() == array.len()).then_some(sections)
    }

    /// Notes every key that nobody asked for.
    pub(crate) fn finish(self) {
        let known = self.known.into_inner();
        for (key, _) in self.table.into_iter().flatten() {
            if !known.iter().any(|k| k == key.get_ref()) {
                let at = key.span().start;
                let name = key.get_ref().to_string();
                let table = self.kind;
                let shown = self.shown.clone();
                let known = known.clone();
                let unknown = Unknown { at, key: name, table, shown, known };
                self.report.unknown.borrow_mut().push(unknown);
            }
        }
    }
}

pub(crate) fn describe(value: &DeValue<'_>) -> String {
    match value {
        DeValue::String(s) => format!("the string \"{s}\""),
        DeValue::Integer(i) => format!("the number {i}"),
        DeValue::Float(x) => format!("the number {x}"),
        DeValue::Boolean(b) => format!("{b}"),
        DeValue::Datetime(d) => format!("the date {d}"),
        DeValue::Array(a) => format!("a list of {} values", a.len()),
        DeValue::Table(_) => "a table".to_owned(),
    }
}

/// A type that a TOML value can be.
pub(crate) trait FromToml: Sized {
    /// The value, or the problem as the end of a sentence that begins with the key.
    fn from_toml(value: &DeValue<'_>) -> Result<Self, String>;
}

fn wanted<T>(what: &str, value: &DeValue<'_>) -> Result<T, String> {
    Err(format!("must be {what}; it is {}", describe(value)))
}

impl FromToml for String {
    fn from_toml(value: &DeValue<'_>) -> Result<Self, String> {
        value.as_str().map_or_else(|| wanted("a string in quotes", value), |s| Ok(s.to_owned()))
    }
}

impl FromToml for bool {
    fn from_toml(value: &DeValue<'_>) -> Result<Self, String> {
        value.as_bool().map_or_else(|| wanted("true or false", value), Ok)
    }
}

impl FromToml for f64 {
    fn from_toml(value: &DeValue<'_>) -> Result<Self, String> {
        let number = match value {
            DeValue::Integer(i) => i128::from_str_radix(i.as_str(), i.radix()).ok().map(|n| n as Self),
            DeValue::Float(x) => x.as_str().parse().ok(),
            _ => None,
        };
        match number {
            Some(n) if n.is_finite() => Ok(n),
            _ => wanted("a finite number", value),
        }
    }
}

macro_rules! integers {
    ($($int:ty),*) => {$(
        impl FromToml for $int {
            fn from_toml(value: &DeValue<'_>) -> Result<Self, String> {
                let DeValue::Integer(i) = value else { return wanted("a whole number", value) };
                let least = <$int>::MIN;
                let most = <$int>::MAX;
                let number = <$int>::from_str_radix(i.as_str(), i.radix()).ok();
                number.map_or_else(|| wanted(&format!("a whole number within {least}..={most}"), value), Ok)
            }
        }
    )*};
}
integers!(u8, u16, u32, u64, usize, i32);

impl FromToml for depthrig_bus::StreamId {
    fn from_toml(value: &DeValue<'_>) -> Result<Self, String> {
        String::from_toml(value)?.parse().map_err(|e: depthrig_bus::Error| format!("must name a stream: {e}"))
    }
}

impl FromToml for depthrig_bus::Name {
    fn from_toml(value: &DeValue<'_>) -> Result<Self, String> {
        Self::new(String::from_toml(value)?).map_err(|e| format!("is not a valid name: {e}"))
    }
}

impl<T: FromToml> FromToml for Vec<T> {
    fn from_toml(value: &DeValue<'_>) -> Result<Self, String> {
        let Some(array) = value.as_array() else { return wanted("a list in [ ]", value) };
        let item = |(i, v): (usize, &toml::Spanned<DeValue<'_>>)| {
            T::from_toml(v.get_ref()).map_err(|why| format!("value {} {why}", i + 1))
        };
        array.iter().enumerate().map(item).collect()
    }
}

impl<T: FromToml, const N: usize> FromToml for [T; N] {
    fn from_toml(value: &DeValue<'_>) -> Result<Self, String> {
        let Some(array) = value.as_array() else {
            return wanted(&format!("a list of {N} values in [ ]"), value);
        };
        let count = array.len();
        let list = Vec::<T>::from_toml(value)?;
        list.try_into().map_err(|_| format!("must have {N} values; it has {count}"))
    }
}
