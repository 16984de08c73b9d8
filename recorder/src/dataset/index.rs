//! Any set of a dataset by its number, by way of the index that each segment ends with.
//!
//! Opening reads the summaries of the segments, which is about a thousandth of a dataset, and no set; it keeps eight
//! bytes per set. Reading a set reads that set.

use super::sets::{Kind, Open, kinds};
use super::{Dataset, DatasetSet, PixelMode, SetRange};
use crate::container::scan::SegmentReader;
use crate::{Error, ErrorKind, Result};
use std::collections::VecDeque;

/// The sets of a dataset, numbered from 0 in the order of their times.
pub struct SetReader {
    dataset: Dataset,
    /// Log time of each set, UTC nanoseconds since 1970; increasing.
    times: Vec<i64>,
    segments: Vec<Place>,
    problems: Vec<String>,
    open: Option<(usize, Open, Vec<Span>)>,
}

/// A segment that has sets.
#[derive(Clone)]
struct Place {
    /// Its index in [`Dataset::segments`].
    segment: usize,
    /// The number of its first set.
    first: usize,
}

/// The chunks of one set: from the first image to the one that ends in the commit mark.
#[derive(Clone, Copy)]
struct Span {
    first: usize,
    last: usize,
}

impl Dataset {
    /// The sets of this dataset for reading in any order.
    ///
    /// A segment that cannot be read, or that was cut, is in [`SetReader::problems`].
    ///
    /// # Errors
    /// [`ErrorKind::Io`] when the disk cannot be read.
    pub fn set_reader(&self) -> Result<SetReader> {
        SetReader::new(self)
    }
}

impl SetReader {
    fn new(dataset: &Dataset) -> Result<Self> {
        let mut reader = Self {
            dataset: dataset.clone(),
            times: Vec::new(),
            segments: Vec::new(),
            problems: Vec::new(),
            open: None,
        };
        for segment in 0..dataset.segments().len() {
            match reader.open_segment(segment) {
                Ok((open, spans)) => {
                    let first = reader.times.len();
                    for span in &spans {
                        // Increasing whatever a damaged index says, because it is searched.
                        let least = reader.times.last().map_or(i64::MIN, |t| t.saturating_add(1));
                        reader.times.push((open.reader.chunks[span.last].end_time as i64).max(least));
                    }
                    if !spans.is_empty() {
                        reader.segments.push(Place { segment, first });
                    }
                    reader.problems.extend(open.cut_error().map(|e| e.to_string()));
                }
                Err(e) if e.kind() == ErrorKind::Io => return Err(e),
                Err(e) => reader.problems.push(e.to_string()),
            }
        }
        Ok(reader)
    }

    /// Log time of each set, UTC nanoseconds since 1970, in the order of the numbers and increasing.
    pub fn times(&self) -> &[i64] {
        &self.times
    }

    /// Segments that cannot be read, one line each.
    pub fn problems(&self) -> &[String] {
        &self.problems
    }

    /// Another reader of the same sets, without reading the indexes again.
    pub fn fork(&self) -> Self {
        Self {
            dataset: self.dataset.clone(),
            times: self.times.clone(),
            segments: self.segments.clone(),
            problems: self.problems.clone(),
            open: None,
        }
    }

    /// The numbers of the sets of each segment that has any.
    pub fn segment_numbers(&self) -> Vec<std::ops::Range<usize>> {
        let ends = self.segments.iter().skip(1).map(|p| p.first).chain([self.times.len()]);
        self.segments.iter().zip(ends).map(|(p, end)| p.first..end).collect()
    }

    /// Reads the set of this number.
    ///
    /// # Errors
    /// [`ErrorKind::NotFound`] beyond the last set, [`ErrorKind::Corrupt`] and the like when the set is damaged,
    /// [`ErrorKind::Io`].
    pub fn read(&mut self, number: usize, mode: PixelMode) -> Result<DatasetSet> {
        let at = self.segments.partition_point(|p| p.first <= number).checked_sub(1);
        let Some(place) = at.map(|i| &self.segments[i]).filter(|_| number < self.times.len()) else {
            let what =
                format!("{} has {} sets, not a set {number}", self.dataset.path.display(), self.times.len());
            return Err(Error::new(ErrorKind::NotFound, what));
        };
        let segment = place.segment;
        let first = place.first;
        if self.open.as_ref().is_none_or(|(open, ..)| *open != segment) {
            self.open = None;
            let (open, spans) = self.open_segment(segment)?;
            self.open = Some((segment, open, spans));
        }
        let Some((_, open, spans)) = &mut self.open else {
            return Err(Error::new(ErrorKind::Io, "a segment was opened and is not there"));
        };
        let span = spans.get(number - first).copied().ok_or_else(|| changed(&open.reader))?;
        read_span(open, span, mode, &self.dataset)
    }

    fn open_segment(&self, segment: usize) -> Result<(Open, Vec<Span>)> {
        let reader = self.dataset.open_segment(segment).ok_or_else(|| {
            Error::new(ErrorKind::NotFound, format!("there is no segment number {segment}"))
        })??;
        let kinds = kinds(&reader);
        let open = Open::new(reader, kinds);
        let spans = spans(&open)?;
        Ok((open, spans))
    }
}

/// Where the sets of a segment lie, from its index alone.
fn spans(open: &Open) -> Result<Vec<Span>> {
    let is_set = |id: &u16| open.kinds.get(id) == Some(&Kind::Set);
    let mut spans = Vec::new();
    let mut first = 0;
    for (i, entry) in open.reader.chunks.iter().enumerate() {
        let mut commits = entry.channels.iter().any(is_set);
        if entry.channels.is_empty() {
            // A chunk without message indexes says nothing of its channels: look into it.
            let looked = open.reader.messages(entry, |m| {
                commits |= is_set(&m.channel);
                Ok(())
            });
            match looked {
                Err(e) if e.kind() == ErrorKind::Io => return Err(e),
                _ => {}
            }
        }
        if commits {
            spans.push(Span { first, last: i });
            first = i + 1;
        }
    }
    Ok(spans)
}

fn read_span(open: &mut Open, span: Span, mode: PixelMode, dataset: &Dataset) -> Result<DatasetSet> {
    open.forget();
    let mut ready = VecDeque::new();
    for i in span.first..=span.last {
        let Some(entry) = open.reader.chunks.get(i).cloned() else { break };
        if open.wants(&entry, mode) {
            open.read_chunk(&entry, mode, dataset, SetRange::ALL, &mut ready)?;
        }
    }
    ready.pop_front().unwrap_or_else(|| Err(changed(&open.reader)))
}

fn changed(reader: &SegmentReader) -> Error {
    let what = format!("{} is not as it was when it was opened: a set is missing", reader.path.display());
    Error::new(ErrorKind::Corrupt, what)
}
