//! The tables of a terminal.

use super::page::label;
use super::paired::Interval;
use super::summary::{Evaluation, Row};
use crate::out;
use depthrig_cdm::metrics::DepthMetrics;

/// Names of the measures of a table.
pub const MEASURES: [&str; 7] = ["L1", "RMSE", "AbsRel", "δ0.5", "δ1", "δ1.05", "δ1.10"];

/// Values of [`MEASURES`], plain ones or strict ones.
pub const fn measures(m: &DepthMetrics, strict: bool) -> [f64; 7] {
    if strict {
        [
            m.strict_l1_m,
            m.strict_rmse_m,
            m.strict_abs_rel,
            m.strict_delta_05,
            m.strict_delta_1,
            m.strict_delta_105,
            m.strict_delta_110,
        ]
    } else {
        [m.l1_m, m.rmse_m, m.abs_rel, m.delta_05, m.delta_1, m.delta_105, m.delta_110]
    }
}

/// A number of the tables.
pub fn value(v: f64) -> String {
    if v.is_finite() { format!("{v:.4}") } else { "–".to_owned() }
}

/// A difference with its interval.
pub fn interval(i: &Interval) -> String {
    let end = |v: Option<f64>| v.map_or_else(|| "–".to_owned(), |v| format!("{v:+.4}"));
    let mean = if i.mean.is_finite() { format!("{:+.4}", i.mean) } else { "–".to_owned() };
    format!("{mean} [{}, {}]", end(i.low), end(i.high))
}

/// Means over images as tables: strict, plain, and the differences to the first row.
pub fn tables(evaluation: &Evaluation, like_cdm: bool) -> String {
    let rows = &evaluation.rows;
    let mut parts = vec![table(rows, true)];
    if !like_cdm {
        parts.push(table(rows, false));
    }
    let differences: Vec<Vec<String>> = rows.iter().filter_map(difference).collect();
    if !differences.is_empty() {
        let header = ["PREDICTION", "to", "strict L1, 95 %", "L1, 95 %", "images", "sequences"];
        parts.push(out::table(&header, 2, differences));
    }
    let left_out = evaluation.left_out.iter().map(|line| format!("left out  {line}"));
    parts.extend(left_out);
    parts.join("\n\n").replace("\n\nleft out", "\nleft out")
}

fn table(rows: &[Row], strict: bool) -> String {
    let first = if strict { "strict L1" } else { "plain L1" };
    let mut header = vec!["PREDICTION", first];
    header.extend(&MEASURES[1..]);
    header.extend(["missing %", "images"]);
    let row = |r: &Row| {
        let m = &r.metrics.mean_of_images;
        let mut cells = vec![label(r)];
        cells.extend(measures(m, strict).map(value));
        cells.push(format!("{:.2}", m.missing_percent));
        cells.push(r.metrics.images.to_string());
        cells
    };
    out::table(&header, 1, rows.iter().map(row))
}

fn difference(r: &Row) -> Option<Vec<String>> {
    let d = r.difference.as_ref()?;
    Some(vec![
        label(r),
        d.to.clone(),
        interval(&d.strict_l1_m),
        interval(&d.l1_m),
        d.images.to_string(),
        d.sequences.to_string(),
    ])
}
