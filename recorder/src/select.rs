//! Selects sets of a dataset: by time, by the time after the first set, or by id.

use crate::dataset::{PixelMode, SetReader};
use crate::{Error, ErrorKind, Result};
use std::ops::Range;
use std::str::FromStr;
use time::OffsetDateTime;
use time::format_description::well_known::Rfc3339;

/// A moment of a dataset.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Moment {
    /// This long after the first set, nanoseconds.
    AfterFirst(i64),
    /// UTC, nanoseconds since 1970.
    Utc(i64),
}

impl FromStr for Moment {
    type Err = Error;

    /// Reads `12.5` (seconds after the first set) or an RFC 3339 time such as `2026-11-21T10:15:03.2Z`.
    fn from_str(text: &str) -> Result<Self> {
        if let Ok(s) = text.parse::<f64>() {
            // Beyond this a float cannot resolve single nanoseconds.
            return if (0.0..9e6).contains(&s) {
                Ok(Self::AfterFirst((s * 1e9).round() as i64))
            } else {
                Err(not_a_moment(text))
            };
        }
        let utc = OffsetDateTime::parse(text, &Rfc3339).map_err(|e| not_a_moment(text).with_source(e))?;
        i64::try_from(utc.unix_timestamp_nanos())
            .map(Self::Utc)
            .map_err(|e| not_a_moment(text).with_source(e))
    }
}

fn not_a_moment(text: &str) -> Error {
    Error::new(
        ErrorKind::BadInput,
        format!(
            "invalid moment \"{text}\"; write seconds after the first set (12.5) or a time with its zone \
             (2026-11-21T10:15:03.2Z)"
        ),
    )
}

/// One end of a span of sets; it is part of the span.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Edge {
    /// The set at this moment, or the next one inside.
    Moment(Moment),
    /// The set of this id, or the next one inside.
    Set(u64),
}

/// The sets from one edge to another; without an edge, from the first or to the last set.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct SetSpan {
    /// The first set.
    pub from: Option<Edge>,
    /// The last set.
    pub to: Option<Edge>,
}

impl SetSpan {
    /// The numbers of the sets in the span; at least one.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] when no set is in it, [`ErrorKind::Io`].
    pub fn numbers(&self, sets: &mut SetReader) -> Result<Range<usize>> {
        let from = self.from.map_or(Ok(0), |edge| lower(sets, edge, false))?;
        let to = self.to.map_or(Ok(sets.times().len()), |edge| lower(sets, edge, true))?;
        if from < to {
            return Ok(from..to);
        }
        Err(Error::new(ErrorKind::BadInput, format!("no set is between these; {}", extent(sets))))
    }
}

/// The number of sets before `edge`, or with `after` the number up to and including it.
fn lower(sets: &mut SetReader, edge: Edge, after: bool) -> Result<usize> {
    match edge {
        Edge::Moment(m) => {
            let t = utc_of(sets, m);
            Ok(sets.times().partition_point(|s| if after { *s <= t } else { *s < t }))
        }
        Edge::Set(id) => before_id(sets, if after { id.saturating_add(1) } else { id }),
    }
}

fn utc_of(sets: &SetReader, moment: Moment) -> i64 {
    match moment {
        Moment::Utc(t) => t,
        Moment::AfterFirst(ns) => sets.times().first().map_or(ns, |first| first.saturating_add(ns)),
    }
}

/// The number of sets with an id below `id`: a binary search, which reads a few sets and no image. Unreadable sets
/// are skipped.
fn before_id(sets: &mut SetReader, id: u64) -> Result<usize> {
    let mut low = 0;
    let mut high = sets.times().len();
    while low < high {
        let middle = low + (high - low) / 2;
        match readable(sets, middle..high)? {
            Some((at, found)) if found < id => low = at + 1,
            _ => high = middle,
        }
    }
    Ok(low)
}

/// Number and id of the first set among `numbers` that can be read.
fn readable(sets: &mut SetReader, numbers: Range<usize>) -> Result<Option<(usize, u64)>> {
    for n in numbers {
        match sets.read(n, PixelMode::None) {
            Ok(set) => return Ok(Some((n, set.id))),
            Err(e) if e.kind() == ErrorKind::Io => return Err(e),
            Err(_) => {}
        }
    }
    Ok(None)
}

/// The number of the set with this id.
///
/// # Errors
/// [`ErrorKind::NotFound`] when no set has it, [`ErrorKind::Io`].
pub(crate) fn by_id(sets: &mut SetReader, id: u64) -> Result<usize> {
    let at = before_id(sets, id)?;
    let all = sets.times().len();
    match readable(sets, at..all)? {
        Some((n, found)) if found == id => Ok(n),
        _ => Err(Error::new(ErrorKind::NotFound, format!("there is no set {id}; {}", extent(sets)))),
    }
}

/// The id of the last set that can be read, 0 without one.
///
/// # Errors
/// [`ErrorKind::Io`].
pub(crate) fn last_id(sets: &mut SetReader) -> Result<u64> {
    for n in (0..sets.times().len()).rev() {
        if let Some((_, id)) = readable(sets, n..n + 1)? {
            return Ok(id);
        }
    }
    Ok(0)
}

/// The number of the set whose log time is nearest to `moment`.
///
/// # Errors
/// [`ErrorKind::NotFound`] when the dataset has no sets.
pub(crate) fn nearest(sets: &SetReader, moment: Moment) -> Result<usize> {
    let times = sets.times();
    let t = utc_of(sets, moment);
    let at = times.partition_point(|s| *s < t);
    let found = [at.checked_sub(1), Some(at)].into_iter().flatten().filter(|n| *n < times.len());
    found
        .min_by_key(|n| times[*n].abs_diff(t))
        .ok_or_else(|| Error::new(ErrorKind::NotFound, "the dataset has no sets"))
}

/// The sets of the dataset, for the message of a failed request.
fn extent(sets: &mut SetReader) -> String {
    let all = sets.times().len();
    let first = readable(sets, 0..all).ok().flatten().map(|(_, id)| id);
    let length = sets.times().last().zip(sets.times().first()).map_or(0, |(b, a)| b.saturating_sub(*a));
    let length = length as f64 / 1e9;
    let mut text = match (first, last_id(sets)) {
        (Some(first), Ok(last)) => format!("the dataset has sets {first} to {last} over {length:.3} s"),
        _ => format!("the dataset has {all} sets over {length:.3} s"),
    };
    for problem in sets.problems() {
        text.push_str("; ");
        text.push_str(problem);
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moments_are_read() {
        let read = |t: &str| t.parse::<Moment>();
        assert_eq!(read("12.5").unwrap(), Moment::AfterFirst(12_500_000_000));
        assert_eq!(read("0").unwrap(), Moment::AfterFirst(0));
        assert_eq!(read("0.200000001").unwrap(), Moment::AfterFirst(200_000_001));
        assert_eq!(read("1970-01-01T00:00:01.5Z").unwrap(), Moment::Utc(1_500_000_000));
        assert_eq!(read("2024-02-29T14:34:56.789+02:00").unwrap(), Moment::Utc(1_709_210_096_789_000_000));
        for bad in [
            "",
            "-1",
            "nan",
            "inf",
            "1e9",
            "ten",
            "2024-02-29",
            "2024-02-29T12:00:00",
            "9999-01-01T00:00:00Z",
        ] {
            let e = read(bad).unwrap_err();
            assert_eq!(e.kind(), ErrorKind::BadInput, "{bad}");
            assert!(e.to_string().contains("2026-11-21T10:15:03.2Z"), "{e}");
        }
    }
}
