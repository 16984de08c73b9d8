//! The plan made before an image is read: how many rows there will be, at which rate, of which tasks.

use super::schema::Schema;
use super::{Incomplete, RowOptions};
use crate::Source;
use crate::vectors::Moments;
use depthrig_bus::StreamId;
use depthrig_recorder::{EpisodeOutcome, PixelMode};
use depthrig_recorder::{Error, ErrorKind, Result};
use std::collections::BTreeMap;

/// Everything that is decided before an image is read.
#[derive(Debug, Clone)]
pub(crate) struct Plan {
    pub(crate) schema: Schema,
    pub(crate) fps: f64,
    pub(crate) episodes: Vec<Episode>,
    /// The tasks in the order of their indices.
    pub(crate) tasks: Vec<String>,
    /// Changes and omissions by the format, in words.
    pub(crate) losses: Vec<String>,
}

/// A dataset, or one of its episodes, as an episode of the export.
#[derive(Debug, Clone)]
pub(crate) struct Episode {
    pub(crate) task: usize,
    pub(crate) first_row: u64,
    pub(crate) rows: u64,
    /// Number of its first set.
    first: usize,
    /// Numbers of its sets that are left out, in order.
    left_out: Vec<usize>,
    /// State and action at its sets.
    pub(crate) moments: Moments,
    /// Somebody judged that its task was done.
    pub(crate) is_success: bool,
}

impl Episode {
    /// The row within the episode of the set with this number; `None` when it is left out.
    pub(crate) fn row_of(&self, number: usize) -> Option<u64> {
        match self.left_out.binary_search(&number) {
            Ok(_) => None,
            Err(before) => Some((number - self.first - before) as u64),
        }
    }
}

/// Resolution of the distances between sets: fine enough for a rate, coarse enough that there are few different ones.
const STEP_NS: i64 = 100_000;

/// How often two rows that follow each other were this far apart, in steps of [`STEP_NS`].
type Steps = BTreeMap<i64, u64>;

fn steps(times: impl Iterator<Item = i64>) -> Steps {
    let mut steps = Steps::new();
    let mut last = None;
    for t in times {
        if let Some(last) = last.replace(t) {
            *steps.entry((t - last) / STEP_NS).or_default() += 1;
        }
    }
    steps
}

/// The rate of the rig's configuration, or the one that the sets have where that is another one, Hz.
fn rate(source: &Source, steps: &Steps) -> Option<f64> {
    let total: u64 = steps.values().sum();
    let mut seen = 0;
    let median = steps.iter().find(|(_, n)| {
        seen += **n;
        2 * seen >= total
    });
    let measured = median.map(|(step, _)| 1e9 / ((*step as f64 + 0.5) * STEP_NS as f64));
    let nominal = toml::from_str::<toml::Table>(&source.session().rig_config).ok();
    let nominal = nominal.as_ref().and_then(|t| t.get("sets")?.as_table()?.get("rate_hz"));
    let nominal = nominal.and_then(|v| v.as_float().or_else(|| v.as_integer().map(|i| i as f64)));
    match (nominal.filter(|n| *n > 0.0), measured) {
        // A recording may have been thinned since: then the configuration says nothing of it.
        (Some(n), Some(m)) if (m / n - 1.0).abs() < 0.1 => Some(n),
        (_, Some(m)) if (m / m.round() - 1.0).abs() < 0.02 => Some(m.round()),
        (_, Some(m)) => Some((m * 1e2).round() / 1e2),
        (n, None) => n,
    }
}

/// Places where the next row came later than one and a half periods, and how many rows would have been there.
fn gaps(steps: &Steps, fps: f64) -> (u64, u64) {
    let periods = |step: i64| (step as f64 + 0.5) * STEP_NS as f64 * fps / 1e9;
    let late = steps.iter().map(|(step, n)| (periods(*step), n)).filter(|(periods, _)| *periods > 1.5);
    late.fold((0, 0), |(gaps, rows), (periods, n)| (gaps + n, rows + n * (periods.round() as u64 - 1)))
}

/// Numbers of the sets that lack a frame of an exported stream, or that cannot be read at all.
fn incomplete(source: &Source, schema: &Schema) -> Result<Vec<usize>> {
    let place = schema.places(source);
    let mut reader = source.reader();
    let mut found = Vec::new();
    for number in source.numbers() {
        match reader.read(number, PixelMode::None) {
            Err(e) if e.kind() == ErrorKind::Io => return Err(e),
            Ok(set) if !set.missing.iter().any(|s| place.get(*s).copied().flatten().is_some()) => {}
            _ => found.push(number),
        }
    }
    Ok(found)
}

/// The options of an exporter with these rows, and its plan once it is made.
#[derive(Debug, Default)]
pub(crate) struct Planned {
    pub(crate) options: RowOptions,
    plan: Option<Plan>,
}

impl Planned {
    pub(crate) const fn new(options: RowOptions) -> Self {
        Self { options, plan: None }
    }

    /// Makes the plan.
    pub(crate) fn make(&mut self, sources: &[Source]) -> Result<&Plan> {
        Ok(self.plan.insert(Plan::make(sources, &self.options)?))
    }

    /// The plan.
    pub(crate) fn get(&self) -> Result<&Plan> {
        let missing = || Error::new(ErrorKind::BadInput, "an export must be planned before it is worked on");
        self.plan.as_ref().ok_or_else(missing)
    }

    /// Says whether state or action has this signal.
    pub(crate) fn takes(&self, signal: &StreamId) -> bool {
        self.plan.iter().flat_map(|p| &p.schema.vectors).any(|v| v.signals().any(|s| s.id == *signal))
    }
}

impl Plan {
    /// Decides how `sources` are exported; reads sets, without images, only where incomplete ones are left out.
    pub(crate) fn make(sources: &[Source], options: &RowOptions) -> Result<Self> {
        let bad = |message: String| Error::new(ErrorKind::BadInput, message);
        let wanted = |id: &StreamId| options.streams.is_empty() || options.streams.contains(id);
        for id in &options.streams {
            if sources.iter().any(|s| s.session().streams.iter().all(|s| s.id != *id)) {
                return Err(bad(format!("there is no stream {id} to export, at least not in every dataset")));
            }
        }
        let schema = Schema::of(sources, &wanted, &options.signals)?;
        let losses = schema.vector_losses();
        let mut plan = Self { schema, fps: 0.0, episodes: Vec::new(), tasks: Vec::new(), losses };
        let mut fps = None;
        let mut first_row = 0;
        for source in sources {
            let name = source.dataset().path().display();
            let session = named(source);
            let moments = Moments::read(source, &plan.schema.vectors, &options.signals)?;
            let mut left_out = match options.incomplete {
                Incomplete::Mark => Vec::new(),
                Incomplete::LeaveOut => incomplete(source, &plan.schema)?,
            };
            if !left_out.is_empty() {
                let n = left_out.len();
                plan.losses.push(format!("{session}: {n} sets that lack a frame are left out"));
            }
            if !moments.left_out.is_empty() {
                let n = moments.left_out.len();
                plan.losses.push(format!(
                    "{session}: {n} sets at its ends without a value of each signal are left out"
                ));
                left_out.extend(&moments.left_out);
                left_out.sort_unstable();
                left_out.dedup();
            }
            let rows = (source.numbers().count() - left_out.len()) as u64;
            if rows == 0 {
                return Err(bad(format!("{name}: there is no set to export in it")));
            }
            let task = options.task.clone().unwrap_or_else(|| task_of(source));
            let task = plan.tasks.iter().position(|t| *t == task).unwrap_or_else(|| {
                plan.tasks.push(task);
                plan.tasks.len() - 1
            });
            let first = source.numbers().next().unwrap_or_default();
            let is_success = source.episode().is_some_and(|e| e.outcome == Some(EpisodeOutcome::Success));
            let episode = Episode { task, first_row, rows, first, left_out, moments, is_success };
            let times = source.times();
            let kept = steps(source.numbers().filter(|n| episode.row_of(*n).is_some()).map(|n| times[n]));
            // An episode may have too few sets to know a rate from.
            let of_rate = if source.episode().is_some() { &steps(times.iter().copied()) } else { &kept };
            let here = options.fps.or_else(|| rate(source, of_rate)).unwrap_or(1.0);
            let fps = *fps.get_or_insert(here);
            if (here / fps - 1.0).abs() > 1e-3 {
                return Err(bad(format!(
                    "{name} has {here} sets per second, the first dataset {fps}: all episodes of an export have one \
                     rate; export them separately or give the rate"
                )));
            }
            let (gaps, missing) = gaps(&kept, fps);
            if gaps > 0 {
                plan.losses.push(format!(
                    "{session}: {gaps} gaps in time ({missing} sets) are closed by the even grid of rows; \
                     capture.utc_ns (utc_ns) has the true times"
                ));
            }
            first_row += rows;
            plan.fps = fps;
            plan.episodes.push(episode);
        }
        Ok(plan)
    }

    /// Rows of all episodes.
    pub(crate) fn rows(&self) -> u64 {
        self.episodes.iter().map(|e| e.rows).sum()
    }
}

/// The name of a source for a person.
fn named(source: &Source) -> String {
    let number = source.episode().map(|e| format!(" episode {}", e.number)).unwrap_or_default();
    format!("{}{number}", source.session().name)
}

/// The task is a sentence: that of the episode; else the scene is the nearest that a session has.
fn task_of(source: &Source) -> String {
    if let Some(task) = source.episode().map(|e| e.task.trim()).filter(|t| !t.is_empty()) {
        return task.to_owned();
    }
    let session = source.session();
    let scene = session.scene.trim();
    if scene.is_empty() { session.name.clone() } else { scene.to_owned() }
}
