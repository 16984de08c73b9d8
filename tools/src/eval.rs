//! The parts of `depthrig eval`: sources of images, their readers, and the HTML report.

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

/// Number of worst images of each row that the report shows.
const SHOWN: usize = 3;

/// One reference with its predictions.
pub struct Loaded {
    /// Rows of the table are by group and prediction: a camera, or nothing.
    pub group: String,
    /// Name of the image.
    pub name: String,
    /// The reference.
    pub truth: Metres,
    /// Predictions by the index of their name; missing ones are left out.
    pub predictions: Vec<(usize, Metres)>,
    /// Colour image for the report.
    pub color: Option<(FrameHeader, Vec<u8>)>,
}

/// Reads the images of one job; runs on any thread.
pub type Job = Box<dyn FnOnce() -> Result<Vec<Loaded>> + Send>;

/// A source of images.
pub trait Source {
    /// Names of the predictions.
    fn names(&self) -> &[String];
    /// Number of jobs.
    fn total(&self) -> u64;
    /// Returns the next job; an error does not end the iteration.
    fn next(&mut self) -> Option<Result<Job>>;
    /// Describes references without a prediction and other omissions.
    fn left_out(&self) -> Vec<String>;
}

/// Options of the measurement.
#[derive(Debug, Clone, Copy)]
pub struct Options {
    /// Range of valid references.
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
    /// Means over images, and over all pixels.
    #[serde(flatten)]
    pub metrics: DatasetMetrics,
    /// Share of the pixels of the prediction that have a depth.
    pub fill_rate: f64,
    /// The measures by distance.
    pub by_distance: Vec<Bin>,
    /// Bounds of the classes of errors, metres.
    pub error_bounds_m: Vec<f64>,
    /// Histogram of the errors.
    pub errors: ErrorHistogram,
    /// Its worst images by strict L1, worst first.
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

/// One of the worst images.
#[derive(Serialize)]
pub struct Worst {
    /// Name of the image.
    pub name: String,
    /// Its own strict L1, metres.
    pub strict_l1_m: f64,
    /// Elements of the HTML report: colour, reference, prediction, error.
    #[serde(skip)]
    pub html: Vec<(&'static str, String)>,
}

/// Result of the evaluation.
#[derive(Serialize)]
pub struct Evaluation {
    /// The rows.
    pub rows: Vec<Row>,
    /// Descriptions of unreadable images.
    pub failed: Vec<String>,
    /// Descriptions of omissions.
    pub left_out: Vec<String>,
}

struct Sum {
    set: Dataset,
    all: Measured,
    worst: Vec<Worst>,
}

/// Result of one job.
type Done = Result<Vec<(Loaded, Vec<(usize, Measured)>)>>;

/// Measures all images of `source`; `go_on` receives the progress and decides whether to continue. Memory does not grow
/// with the number of images, and the result does not depend on the number of threads.
pub fn run(
    source: &mut dyn Source,
    options: &Options,
    mut go_on: impl FnMut(u64, u64) -> bool,
) -> Result<Option<Evaluation>> {
    let mut sums: BTreeMap<(String, usize), Sum> = BTreeMap::new();
    let mut failed = Vec::new();
    let mut done = 0;
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
                Ok(images) => {
                    for (loaded, measured) in images {
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

/// Runs the jobs in parallel; results are in the order of the jobs.
fn all(jobs: Vec<Job>, options: &Options) -> Vec<Done> {
    let work = |job: Job| -> Done {
        let measure = |loaded: Loaded| {
            let of = |(k, p): &(usize, Metres)| {
                let p = Depth::Metres(&p.pixels);
                let t = Depth::Metres(&loaded.truth.pixels);
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
        .map(|r| r.unwrap_or_else(|| Err(anyhow::anyhow!("a thread that compares images panicked"))))
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
        let of_image = sum.set.push(&m);
        sum.all.plus(&m);
        let bad = of_image.strict_l1_m;
        let place = sum.worst.partition_point(|w| w.strict_l1_m >= bad);
        if bad.is_finite() && place < SHOWN {
            let prediction = loaded.predictions.iter().find(|(p, _)| *p == k);
            let html = match prediction {
                Some((_, p)) => page::images(loaded, p)?,
                None => Vec::new(),
            };
            sum.worst.insert(place, Worst { name: loaded.name.clone(), strict_l1_m: bad, html });
            sum.worst.truncate(SHOWN);
        }
    }
    Ok(())
}
