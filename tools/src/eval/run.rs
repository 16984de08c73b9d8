//! The measurement: reads, refines and measures the images of a part, in order.

use super::page::Pictures;
use super::records::{Header, Of, Record, Writer};
use super::refine::Refiners;
use super::summary::Summary;
use super::units::Units;
use super::{Images, Job, Loaded, Source};
use anyhow::Result;
use depthrig_cdm::metrics::{Depth, Measured, Rules};
use std::collections::BTreeMap;
use std::sync::Mutex;

/// A run and its parts.
pub struct Run<'a> {
    /// The images.
    pub source: &'a mut dyn Source,
    /// Refiners of them; their rows come after those of the source.
    pub refiners: Refiners,
    /// The arguments.
    pub header: &'a Header,
    /// Rules of the measurement.
    pub rules: Rules,
    /// Raw depth beyond is a hole, metres.
    pub raw_max_m: Option<f64>,
    /// Threads.
    pub threads: usize,
    /// Images for the report.
    pub pictures: Option<&'a mut Pictures>,
    /// Number of the first image that is not in `summary` already, counted within the part.
    pub done: u64,
}

/// All images of the part were measured.
pub struct Finished {
    /// Number of images of all parts.
    pub images: u64,
    /// Predictions whose unit is in doubt, in words.
    pub doubts: Vec<String>,
}

/// A job that was read and refined.
struct Refined {
    image: u64,
    loaded: Vec<Loaded>,
    failed: Vec<String>,
    omitted: BTreeMap<String, u64>,
}

impl Run<'_> {
    /// Measures all images of the part that are not done, into `summary` and `sums`; `go_on` receives the progress and decides
    /// whether to continue. Returns `None` when it was interrupted. The result does not depend on the number of threads.
    ///
    /// # Errors
    /// When an engine fails, raw depth has a wrong unit, or `sums` cannot be written.
    pub fn measure(
        &mut self,
        summary: &mut Summary,
        sums: &mut Option<Writer>,
        mut go_on: impl FnMut(u64, u64) -> bool,
    ) -> Result<Option<Finished>> {
        let first = self.source.names().len();
        let mut units = Units::default();
        let mut next = 0;
        loop {
            if !go_on(next, self.source.total()) {
                return Ok(None);
            }
            let mut jobs: Vec<(u64, Result<Job>)> = Vec::new();
            while jobs.len() < self.threads.max(1) {
                let Some(job) = self.source.next() else { break };
                let is_ours = self.header.part.has(next);
                if is_ours && self.done > 0 {
                    self.done -= 1;
                } else if is_ours {
                    jobs.push((next, job));
                }
                next += 1;
            }
            if jobs.is_empty() {
                break;
            }
            let read = parallel(jobs, |(image, job)| (image, job.and_then(|job| job())));
            let mut all = Vec::new();
            for (image, read) in read {
                all.push(self.refined(image, read, first, &mut units)?);
            }
            let rules = self.rules;
            for (refined, record) in parallel(all, |refined| measured(refined, &rules)) {
                self.add(summary, &refined, &record)?;
                if let Some(sums) = sums {
                    sums.add(&record)?;
                }
            }
        }
        Ok(Some(Finished { images: next, doubts: units.finish(self.source.names())? }))
    }

    /// Prepares what was read and runs the refiners.
    fn refined(
        &mut self,
        image: u64,
        read: Result<Images>,
        first: usize,
        units: &mut Units,
    ) -> Result<Refined> {
        let mut refined = Refined { image, loaded: Vec::new(), failed: Vec::new(), omitted: BTreeMap::new() };
        let images = match read {
            Ok(images) => images,
            Err(e) => {
                refined.failed.push(format!("{e:#}"));
                return Ok(refined);
            }
        };
        refined.omitted = images.omitted;
        let mut loaded = images.loaded;
        for one in &mut loaded {
            units.look(one)?;
            if let (Some((_, raw)), Some(max_m)) = (&mut one.raw, self.raw_max_m) {
                raw.cut(max_m);
            }
            let raw = one.raw.as_ref().map(|(row, raw)| (*row, raw.metres()));
            one.predictions.extend(raw);
        }
        for result in self.refiners.refine(first, loaded)? {
            match result {
                Ok(mut one) => {
                    one.predictions.sort_by_key(|(k, _)| *k);
                    refined.loaded.push(one);
                }
                Err(e) => refined.failed.push(format!("{e:#}")),
            }
        }
        Ok(refined)
    }

    fn add(&mut self, summary: &mut Summary, refined: &Refined, record: &Record) -> Result<()> {
        summary.add(record, |of, is_worst| {
            let is_it = |l: &&Loaded| l.group == of.group && l.place == of.place;
            match (&mut self.pictures, refined.loaded.iter().find(is_it)) {
                (Some(pictures), Some(loaded)) => pictures.of(loaded, of.row, is_worst, self.header),
                _ => Ok(Vec::new()),
            }
        })
    }
}

fn measured(refined: Refined, rules: &Rules) -> (Refined, Record) {
    let mut record = Record {
        image: refined.image,
        of: Vec::new(),
        failed: refined.failed.clone(),
        omitted: refined.omitted.clone(),
    };
    for loaded in &refined.loaded {
        for (row, prediction) in &loaded.predictions {
            let prediction = Depth::Metres(&prediction.pixels);
            let truth = Depth::Metres(&loaded.truth.pixels);
            let material = loaded.material.as_deref().map(Vec::as_slice);
            match Measured::of(&prediction, &truth, material, rules) {
                Ok(measured) => record.of.push(Of {
                    group: loaded.group.clone(),
                    row: *row,
                    place: loaded.place.clone(),
                    measured,
                }),
                Err(e) => record.failed.push(format!("{}: {e}", loaded.place.name)),
            }
        }
    }
    (refined, record)
}

/// Does `work` on a thread each; results are in the order of the items.
fn parallel<T: Send, R: Send>(items: Vec<T>, work: impl Fn(T) -> R + Sync) -> Vec<R> {
    if items.len() == 1 {
        return items.into_iter().map(work).collect();
    }
    let results: Vec<Mutex<Option<R>>> = items.iter().map(|_| Mutex::new(None)).collect();
    // A thread that panics ends the scope with its panic.
    std::thread::scope(|scope| {
        for (item, result) in items.into_iter().zip(&results) {
            let work = &work;
            scope.spawn(move || {
                let done = work(item);
                *depthrig_bus::sync::lock(result) = Some(done);
            });
        }
    });
    results.into_iter().filter_map(|r| r.into_inner().ok().flatten()).collect()
}
