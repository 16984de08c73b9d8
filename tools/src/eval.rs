//! What `depthrig eval` is made of: where pictures come from, how they are read, and the page that shows the result.

pub mod dataset;
pub mod files;
pub mod page;
pub mod read;

use anyhow::Result;
use depthrig_bus::FrameHeader;
use depthrig_cdm::metrics::{
    Dataset, DatasetMetrics, Depth, DepthMetrics, DepthRange, DistanceBin, ErrorHistogram, Measured,
};
use read::Metres;
use serde::Serialize;
use std::collections::BTreeMap;
use std::sync::Mutex;

/// Pictures of each row that are kept to be shown.
const SHOWN: usize = 3;

/// One reference with what was predicted of it.
pub struct Loaded {
    /// Rows of the table are by group and prediction: a camera, or nothing.
    pub group: String,
    /// What to call it.
    pub name: String,
    /// The reference.
    pub truth: Metres,
    /// Predictions by the number of their name; what has none is left out.
    pub predictions: Vec<(usize, Metres)>,
    /// Colour, to be shown.
    pub color: Option<(FrameHeader, Vec<u8>)>,
}

/// Reads what it was made for; runs on any thread.
pub type Job = Box<dyn FnOnce() -> Result<Vec<Loaded>> + Send>;

/// Where pictures come from.
pub trait Source {
    /// What the predictions are called.
    fn names(&self) -> &[String];
    /// How many jobs there will be.
    fn total(&self) -> u64;
    /// The next one; an error does not end it.
    fn next(&mut self) -> Option<Result<Job>>;
    /// References without a prediction, and other things left out, in words.
    fn left_out(&self) -> Vec<String>;
}

/// How to measure.
#[derive(Debug, Clone, Copy)]
pub struct Options {
    /// References that count.
    pub range: DepthRange,
    /// Width of a bin of distance in metres, and their number.
    pub bins: (f64, usize),
    /// Threads.
    pub threads: usize,
}

/// A row of the table.
#[derive(Serialize)]
pub struct Row {
    /// Camera, or nothing.
    pub group: String,
    /// Prediction.
    pub name: String,
    /// Means over pictures, and over all pixels.
    #[serde(flatten)]
    pub metrics: DatasetMetrics,
    /// Share of the pixels of the prediction that have a depth.
    pub fill_rate: f64,
    /// The measures by distance.
    pub by_distance: Vec<Bin>,
    /// Bounds of the classes of errors, metres.
    pub error_bounds_m: Vec<f64>,
    /// How many errors lie where.
    pub errors: ErrorHistogram,
    /// Its worst pictures by strict L1, worst first.
    pub worst: Vec<Worst>,
}

/// [`DistanceBin`] for JSON.
#[derive(Serialize)]
pub struct Bin {
    /// The nearest, metres.
    pub from_m: f64,
    /// The farthest, metres.
    pub to_m: f64,
    /// The measures.
    #[serde(flatten)]
    pub metrics: DepthMetrics,
}

impl From<DistanceBin> for Bin {
    fn from(bin: DistanceBin) -> Self {
        Self { from_m: bin.from_m, to_m: bin.to_m, metrics: bin.metrics }
    }
}

/// A picture that did badly.
#[derive(Serialize)]
pub struct Worst {
    /// What it is called.
    pub name: String,
    /// Its own strict L1, metres.
    pub strict_l1_m: f64,
    /// Elements of the page: colour, reference, prediction, error.
    #[serde(skip)]
    pub html: Vec<(&'static str, String)>,
}

/// Everything that was found.
#[derive(Serialize)]
pub struct Evaluation {
    /// The rows.
    pub rows: Vec<Row>,
    /// What could not be read, in words.
    pub failed: Vec<String>,
    /// What was left out, in words.
    pub left_out: Vec<String>,
}

struct Sum {
    set: Dataset,
    all: Measured,
    worst: Vec<Worst>,
}

/// What a worker hands back of one job.
type Done = Result<Vec<(Loaded, Vec<(usize, Measured)>)>>;

/// Measures everything that `source` has; `go_on` is told how far it is and says whether to go on. Memory does not grow
/// with the number of pictures, and the result does not depend on the number of threads.
pub fn run(
    source: &mut dyn Source,
    options: &Options,
    mut go_on: impl FnMut(u64, u64) -> bool,
) -> Result<Option<Evaluation>> {
    let mut sums: BTreeMap<(String, usize), Sum> = BTreeMap::new();
    let (mut failed, mut done) = (Vec::new(), 0);
    loop {
        if !go_on(done, source.total()) {
            return Ok(None);
        }
        let mut jobs = Vec::new();
        while jobs.len() < options.threads.max(1) {
            match source.next() {
                Some(Ok(job)) => jobs.push(job),
                Some(Err(e)) => failed.push(format!("{e:#}")),
                None => break,
            }
        }
        if jobs.is_empty() {
            break;
        }
        done += jobs.len() as u64;
        for result in all(jobs, options) {
            match result {
                Ok(pictures) => {
                    for (loaded, measured) in pictures {
                        add(&mut sums, &loaded, measured, options)?;
                    }
                }
                Err(e) => failed.push(format!("{e:#}")),
            }
        }
    }
    let names = source.names();
    let rows = sums.into_iter().map(|((group, k), sum)| Row {
        group,
        name: names[k].clone(),
        metrics: sum.set.metrics(),
        fill_rate: sum.all.fill_rate(),
        by_distance: sum.all.by_distance().into_iter().map(Bin::from).collect(),
        error_bounds_m: depthrig_cdm::metrics::ERROR_BOUNDS_M.to_vec(),
        errors: *sum.all.errors(),
        worst: sum.worst,
    });
    Ok(Some(Evaluation { rows: rows.collect(), failed, left_out: source.left_out() }))
}

/// Does the jobs side by side; results are in their order.
fn all(jobs: Vec<Job>, options: &Options) -> Vec<Done> {
    let work = |job: Job| -> Done {
        let measure = |loaded: Loaded| {
            let of = |(k, p): &(usize, Metres)| {
                let (p, t) = (Depth::Metres(&p.pixels), Depth::Metres(&loaded.truth.pixels));
                let m = Measured::of(&p, &t, options.range, options.bins);
                m.map(|m| (*k, m)).map_err(|e| anyhow::Error::new(e).context(loaded.name.clone()))
            };
            let measured = loaded.predictions.iter().map(of).collect::<Result<Vec<_>>>()?;
            Ok((loaded, measured))
        };
        job()?.into_iter().map(measure).collect()
    };
    if jobs.len() == 1 {
        return jobs.into_iter().map(work).collect();
    }
    let results: Vec<Mutex<Option<Done>>> = jobs.iter().map(|_| Mutex::new(None)).collect();
    std::thread::scope(|scope| {
        for (job, result) in jobs.into_iter().zip(&results) {
            let work = &work;
            scope.spawn(move || {
                let done = work(job);
                if let Ok(mut result) = result.lock() {
                    *result = Some(done);
                }
            });
        }
    });
    let taken = results.into_iter().map(|r| r.into_inner().ok().flatten());
    taken
        .map(|r| r.unwrap_or_else(|| Err(anyhow::anyhow!("a thread that compares pictures panicked"))))
        .collect()
}

fn add(
    sums: &mut BTreeMap<(String, usize), Sum>,
    loaded: &Loaded,
    measured: Vec<(usize, Measured)>,
    options: &Options,
) -> Result<()> {
    for (k, m) in measured {
        let sum = sums.entry((loaded.group.clone(), k)).or_insert_with(|| Sum {
            set: Dataset::new(options.range),
            all: Measured::nothing(options.bins.0, options.bins.1),
            worst: Vec::new(),
        });
        let of_picture = sum.set.push(&m);
        sum.all.plus(&m);
        let bad = of_picture.strict_l1_m;
        let place = sum.worst.partition_point(|w| w.strict_l1_m >= bad);
        if bad.is_finite() && place < SHOWN {
            let prediction = loaded.predictions.iter().find(|(p, _)| *p == k);
            let html = match prediction {
                Some((_, p)) => page::pictures(loaded, p)?,
                None => Vec::new(),
            };
            sum.worst.insert(place, Worst { name: loaded.name.clone(), strict_l1_m: bad, html });
            sum.worst.truncate(SHOWN);
        }
    }
    Ok(())
}
