//! The last samples of a signal: the newest one, a window of them, and the value at any time between two of them.

use super::interpolation;
use super::sample::SignalSample;
use super::subscriber::SignalSubscriber;
use crate::{Error, ErrorKind, HostTime, Result};
use core::time::Duration;
use std::collections::VecDeque;

/// Bytes that a series takes at most.
const MAX_BYTES: usize = 64 << 20;

/// The last samples of one publisher of a signal, in the order of their times.
///
/// A new publisher begins a new series: nothing is interpolated across a restart.
#[derive(Debug)]
pub struct Series {
    keep: Duration,
    samples: VecDeque<SignalSample>,
    bytes: usize,
}

impl Series {
    /// A series that keeps the samples of the last `keep` before the newest one, and 64 MiB of them at most.
    pub const fn new(keep: Duration) -> Self {
        Self { keep, samples: VecDeque::new(), bytes: 0 }
    }

    /// Takes in all unread samples of `subscriber`; returns how many. Call it at least every 512 samples, the most that wait
    /// unread.
    ///
    /// # Errors
    /// As [`Self::push`] and [`SignalSubscriber::try_next`]; the next call goes on behind it.
    pub fn fill(&mut self, subscriber: &mut SignalSubscriber) -> Result<usize> {
        let mut taken = 0;
        while let Some(sample) = subscriber.try_next()? {
            self.push(sample)?;
            taken += 1;
        }
        Ok(taken)
    }

    /// Takes in a sample. One of another publisher, or with a time that is not after the one before (a replay that went
    /// back), begins the series anew.
    ///
    /// # Errors
    /// [`ErrorKind::Changed`] when its description is another one than before, naming both lists of fields. The series
    /// then holds this sample alone, and goes on with it.
    pub fn push(&mut self, sample: SignalSample) -> Result<()> {
        let mut changed = None;
        if let Some(newest) = self.samples.back() {
            if newest.description() != sample.description() {
                changed = Some(change(newest, &sample));
            }
            if changed.is_some()
                || newest.header().session != sample.header().session
                || sample.time() <= newest.time()
            {
                self.samples.clear();
                self.bytes = 0;
            }
        }
        let oldest = sample.time().plus_ns(-nanoseconds(self.keep));
        self.bytes += size(&sample);
        self.samples.push_back(sample);
        while self.samples.len() > 1
            && (self.bytes > MAX_BYTES || self.samples.front().is_some_and(|s| s.time() < oldest))
        {
            self.bytes -= self.samples.pop_front().map_or(0, |s| size(&s));
        }
        changed.map_or(Ok(()), Err)
    }

    /// The newest sample.
    pub fn latest(&self) -> Option<&SignalSample> {
        self.samples.back()
    }

    /// The samples of the last `length` before the newest one, which is the last of them.
    pub fn window(
        &self,
        length: Duration,
    ) -> impl DoubleEndedIterator<Item = &SignalSample> + ExactSizeIterator {
        let newest = self.samples.back().map_or(HostTime::from_ns(0), SignalSample::time);
        let from = newest.plus_ns(-nanoseconds(length));
        let first = self.samples.partition_point(|s| s.time() < from);
        self.samples.range(first..)
    }

    /// The sample at `time`: one that was published, or else one between its neighbours, which are at most `max_gap`
    /// apart. Floats are linear, the rotation of a pose follows the shorter arc, and integers, booleans and texts are those
    /// of the sample before. A signal whose second derivative is at most a is then off by at most a · `max_gap`² / 8.
    ///
    /// # Errors
    /// [`ErrorKind::Outside`] when `time` is before the first or after the newest sample: nothing is extrapolated.
    /// [`ErrorKind::Gap`] when the neighbours are further apart.
    pub fn at(&self, time: HostTime, max_gap: Duration) -> Result<SignalSample> {
        let next = self.samples.partition_point(|s| s.time() < time);
        let after = self.samples.get(next);
        if let Some(exact) = after.filter(|s| s.time() == time) {
            return Ok(exact.clone());
        }
        let before = next.checked_sub(1).and_then(|i| self.samples.get(i));
        let [Some(before), Some(after)] = [before, after] else { return Err(self.outside(time)) };
        let gap_ns = after.time().since_ns(before.time());
        if gap_ns > nanoseconds(max_gap) {
            let name = before.description().name();
            let gap_ms = gap_ns as f64 / 1e6;
            let most_ms = max_gap.as_secs_f64() * 1e3;
            return Err(Error::new(
                ErrorKind::Gap,
                format!(
                    "signal {name}: the samples around {} ns are {gap_ms:.3} ms apart, at most {most_ms:.3} ms are allowed",
                    time.ns()
                ),
            ));
        }
        interpolation::between(before, after, time)
    }

    fn outside(&self, time: HostTime) -> Error {
        let time_ns = time.ns();
        let ms = |ns: i64| ns as f64 / 1e6;
        let why = match [self.samples.front(), self.samples.back()] {
            [Some(first), Some(newest)] => {
                let name = first.description().name();
                if time < first.time() {
                    let before = ms(first.time().since_ns(time));
                    format!(
                        "signal {name}: {time_ns} ns is {before:.3} ms before the first sample that is kept"
                    )
                } else {
                    let after = ms(time.since_ns(newest.time()));
                    format!("signal {name}: {time_ns} ns is {after:.3} ms after the newest sample")
                }
            }
            _ => "no sample has come yet".to_owned(),
        };
        Error::new(ErrorKind::Outside, why)
    }
}

fn nanoseconds(duration: Duration) -> i64 {
    i64::try_from(duration.as_nanos()).unwrap_or(i64::MAX)
}

fn size(sample: &SignalSample) -> usize {
    size_of::<SignalSample>() + sample.bytes().len()
}

fn change(before: &SignalSample, after: &SignalSample) -> Error {
    let fields = |sample: &SignalSample| {
        let names: Vec<_> = sample.description().all_fields().iter().map(|f| f.name.as_str()).collect();
        format!("{} ({})", names.join(", "), sample.description().kind().name())
    };
    Error::new(
        ErrorKind::Changed,
        format!(
            "signal {}: another publisher took over with a different description: {}; before: {}; read on to go on with it",
            after.description().name(),
            fields(after),
            fields(before)
        ),
    )
}

#[cfg(test)]
mod tests;
