//! From records to rows: every number of the reports, from the records in the order of the images.

use super::material_name;
use super::paired::{Difference, Paired};
use super::records::{Header, Of, Record};
use super::refine::RowInfo;
use anyhow::Result;
use depthrig_cdm::metrics::{
    Dataset, DatasetMetrics, DepthMetrics, ERROR_BOUNDS_M, ErrorHistogram, Measured, Rules,
};
use serde::Serialize;
use std::collections::BTreeMap;

/// Number of worst images of each row.
pub const SHOWN: usize = 3;

/// A row of the table.
#[derive(Serialize)]
pub struct Row {
    /// Camera or sensor, or nothing.
    pub group: String,
    /// Prediction, its input and engine.
    #[serde(flatten)]
    pub info: RowInfo,
    /// Means over images, and over all pixels.
    #[serde(flatten)]
    pub metrics: DatasetMetrics,
    /// Share of the pixels of the prediction that have a depth.
    pub fill_rate: f64,
    /// Pixels with a valid reference whose prediction is NaN or infinite.
    pub not_finite: u64,
    /// Paired difference to the first row of the group; none for that row itself.
    pub difference: Option<Difference>,
    /// The measures by distance.
    pub by_distance: Vec<Bin>,
    /// The measures by material of all pixels together.
    pub by_material: Vec<Material>,
    /// The measures by scene.
    pub by_scene: Vec<Scene>,
    /// Bounds of the classes of errors, metres.
    pub error_bounds_m: Vec<f64>,
    /// Histogram of the errors.
    pub errors: ErrorHistogram,
    /// Its worst images by strict L1, worst first.
    pub worst: Vec<Worst>,
}

/// A range of distance.
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

/// A material.
#[derive(Serialize)]
pub struct Material {
    /// Its name.
    pub material: String,
    /// The measures.
    #[serde(flatten)]
    pub metrics: DepthMetrics,
}

/// A scene.
#[derive(Serialize)]
pub struct Scene {
    /// Its name.
    pub scene: String,
    /// The measures.
    #[serde(flatten)]
    pub metrics: DatasetMetrics,
}

/// One of the worst images.
#[derive(Serialize)]
pub struct Worst {
    /// Name of the image.
    pub name: String,
    /// Its own strict L1, metres.
    pub strict_l1_m: f64,
    /// Elements of the HTML report: colour, reference, raw depth, prediction, error.
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
    scenes: BTreeMap<String, Dataset>,
    worst: Vec<Worst>,
}

/// Key of a row: its group and number.
type Key = (String, usize);

/// Collects records; memory does not grow with the number of images.
pub struct Summary {
    rules: Rules,
    rows: BTreeMap<Key, Sum>,
    /// Differences of a row to another one of its group.
    paired: BTreeMap<(Key, usize), Paired>,
    failed: Vec<String>,
    omitted: BTreeMap<String, u64>,
}

impl Summary {
    /// Nothing yet.
    pub const fn new(rules: Rules) -> Self {
        Self {
            rules,
            rows: BTreeMap::new(),
            paired: BTreeMap::new(),
            failed: Vec::new(),
            omitted: BTreeMap::new(),
        }
    }

    /// Adds a record; `shown` makes the images of one that is among the worst of its row, and gets whether it is the worst.
    pub fn add(
        &mut self,
        record: &Record,
        mut shown: impl FnMut(&Of, bool) -> Result<Vec<(&'static str, String)>>,
    ) -> Result<()> {
        self.failed.extend(record.failed.iter().cloned());
        for (why, n) in &record.omitted {
            *self.omitted.entry(why.clone()).or_default() += n;
        }
        for of in &record.of {
            let range = self.rules.range;
            let sum = self.rows.entry((of.group.clone(), of.row)).or_insert_with(|| Sum {
                set: Dataset::new(range),
                all: Measured::nothing(),
                scenes: BTreeMap::new(),
                worst: Vec::new(),
            });
            let own = sum.set.push(&of.measured);
            sum.all.plus(&of.measured);
            sum.scenes
                .entry(of.place.scene.clone())
                .or_insert_with(|| Dataset::new(range))
                .push(&of.measured);
            let bad = own.strict_l1_m;
            let place = sum.worst.partition_point(|w| w.strict_l1_m >= bad);
            if bad.is_finite() && place < SHOWN {
                let html = shown(of, place == 0)?;
                sum.worst.insert(place, Worst { name: of.place.name.clone(), strict_l1_m: bad, html });
                sum.worst.truncate(SHOWN);
            }
        }
        for of in &record.of {
            let beside = record.of.iter().filter(|o| o.group == of.group && o.place == of.place);
            let Some(first) = beside.min_by_key(|o| o.row).filter(|o| o.row < of.row) else { continue };
            let key = ((of.group.clone(), of.row), first.row);
            let paired = self.paired.entry(key).or_default();
            paired.add(&of.place.sequence, &of.measured.metrics(), &first.measured.metrics());
        }
        Ok(())
    }

    /// The rows, and what was left out.
    pub fn finish(mut self, header: &Header) -> Evaluation {
        let mut first: BTreeMap<String, usize> = BTreeMap::new();
        for (group, k) in self.rows.keys() {
            first.entry(group.clone()).or_insert(*k);
        }
        let name = |k: usize| header.rows.get(k).cloned().unwrap_or_default();
        let rules = self.rules;
        let rows = std::mem::take(&mut self.rows).into_iter().map(|((group, k), sum)| {
            let to = first.get(&group).copied().unwrap_or(k);
            let paired = self.paired.get(&((group.clone(), k), to));
            let bins = sum.all.by_distance(&rules).into_iter();
            let materials = sum.all.by_material().into_iter();
            let scenes = sum.scenes.into_iter();
            Row {
                info: name(k),
                metrics: sum.set.metrics(),
                fill_rate: sum.all.fill_rate(),
                not_finite: sum.all.not_finite(),
                difference: paired.and_then(|p| p.difference(&name(to).name)),
                by_distance: bins
                    .map(|b| Bin { from_m: b.from_m, to_m: b.to_m, metrics: b.metrics })
                    .collect(),
                by_material: materials
                    .map(|(n, metrics)| Material { material: material_name(n), metrics })
                    .collect(),
                by_scene: scenes.map(|(scene, set)| Scene { scene, metrics: set.metrics() }).collect(),
                error_bounds_m: ERROR_BOUNDS_M.to_vec(),
                errors: *sum.all.errors(),
                worst: sum.worst,
                group,
            }
        });
        let rows = rows.collect();
        let omitted = self.omitted.iter().map(|(why, n)| format!("{n} images {why}"));
        let left_out = header.left_out.iter().cloned().chain(omitted).collect();
        Evaluation { rows, failed: self.failed, left_out }
    }
}
