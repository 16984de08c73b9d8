//! The HTML report of an evaluation: metrics table, error over distance, error histogram, and the worst images.

use super::read::Metres;
use super::{Evaluation, Loaded, Options, Row};
use anyhow::Result;
use depthrig_bus::{FrameHeader, PixelFormat};
use depthrig_cdm::metrics::{DepthMetrics, ERROR_BOUNDS_M};
use depthrig_recorder::report::curves::{Series, bars, curves};
use depthrig_recorder::report::page::{self, END_TABLE, Thumbnail, escape};
use std::fmt::Write;

/// The error that has the strongest colour, metres.
const STRONG_M: f32 = 0.1;

/// The names and values of the measures of a table, in the paper's order; plain ones or strict ones.
pub fn measures(m: &DepthMetrics, strict: bool) -> [(&'static str, f64); 5] {
    if strict {
        [
            ("L1", m.strict_l1_m),
            ("RMSE", m.strict_rmse_m),
            ("AbsRel", m.strict_abs_rel),
            ("δ0.5", m.strict_delta_05),
            ("δ1", m.strict_delta_1),
        ]
    } else {
        [("L1", m.l1_m), ("RMSE", m.rmse_m), ("AbsRel", m.abs_rel), ("δ0.5", m.delta_05), ("δ1", m.delta_1)]
    }
}

/// A number of the tables.
pub fn value(v: f64) -> String {
    if v.is_finite() { format!("{v:.4}") } else { "–".to_owned() }
}

/// Label of a row.
pub fn label(row: &Row) -> String {
    if row.group.is_empty() { row.name.clone() } else { format!("{} {}", row.group, row.name) }
}

/// Colour, reference, prediction and error, as elements of the page.
pub fn images(loaded: &Loaded, prediction: &Metres) -> Result<Vec<(&'static str, String)>> {
    let depth = |m: &Metres| -> Result<Thumbnail> {
        let bytes: Vec<u8> = m.pixels.iter().flat_map(|v| v.to_le_bytes()).collect();
        Ok(Thumbnail::of(&header(PixelFormat::DepthF32, m), &bytes)?)
    };
    let truth = depth(&loaded.truth)?;
    let seen = depth(prediction)?;
    let range = Thumbnail::range([&truth].into_iter());
    let error: Vec<u8> =
        prediction.pixels.iter().zip(&loaded.truth.pixels).flat_map(|(p, t)| error(*p, *t)).collect();
    let error = Thumbnail::of(&header(PixelFormat::Rgb8, prediction), &error)?;
    let mut out = Vec::new();
    if let Some((h, pixels)) = &loaded.color {
        out.push(("colour", Thumbnail::of(h, pixels)?.html(None, "colour")?));
    }
    out.push(("reference", truth.html(range, "reference")?));
    out.push(("prediction", seen.html(range, "prediction")?));
    out.push(("error", error.html(None, "error")?));
    Ok(out)
}

fn header(format: PixelFormat, m: &Metres) -> FrameHeader {
    let mut header = FrameHeader::default();
    header.set_image(format, m.width as u32, m.height as u32);
    header
}

/// Colour of an error: red is too far, blue too near, white correct; dark grey means no prediction, black no reference.
fn error(seen: f32, truth: f32) -> [u8; 3] {
    if !(truth.is_finite() && truth > 0.0) {
        return [0; 3];
    }
    if !(seen.is_finite() && seen > 0.0) {
        return [90; 3];
    }
    let e = ((seen - truth) / STRONG_M).clamp(-1.0, 1.0);
    let pale = (255.0 * (1.0 - e.abs())).round() as u8;
    if e > 0.0 { [255, pale, pale] } else { [pale, pale, 255] }
}

/// Renders the HTML report.
pub fn page(title: &str, evaluation: &Evaluation, options: &Options) -> String {
    let mut out = page::begin(&format!("{title} – depth evaluation"));
    let rows = &evaluation.rows;
    let _ =
        write!(out, "<header><h1>Depth evaluation</h1><div class=\"sub\">{}</div></header>", escape(title));
    problems(&mut out, evaluation);
    table(&mut out, rows, options);
    let names: Vec<String> = rows.iter().map(label).collect();
    let series = |of: &dyn Fn(&Row) -> Vec<Option<f64>>| -> Vec<Series> {
        rows.iter().zip(&names).map(|(r, n)| Series { name: n.clone(), values: of(r) }).collect()
    };
    // From the first distance that any reference has to the last.
    let used = |i: &usize| rows.iter().any(|r| r.by_distance[*i].metrics.counted > 0);
    let bins = rows.first().map_or(0, |r| r.by_distance.len());
    let first = (0..bins).find(used).unwrap_or(0);
    let last = (0..bins).rev().find(used).unwrap_or(0);
    let range = first..(last + 1).min(bins);
    let x: Vec<f64> = rows
        .first()
        .map(|r| r.by_distance[range.clone()].iter().map(|b| f64::midpoint(b.from_m, b.to_m)).collect())
        .unwrap_or_default();
    let by = |of: fn(&DepthMetrics) -> f64| {
        let range = range.clone();
        series(&move |r: &Row| {
            let bins = r.by_distance[range.clone()].iter();
            bins.map(|b| Some(of(&b.metrics)).filter(|v| v.is_finite())).collect()
        })
    };
    out.push_str("<section><h2>Error against distance</h2>");
    let axis = "distance of the reference, m";
    out.push_str(&curves("L1 by distance", axis, "L1, m", &x, &by(|m| m.l1_m)));
    out.push_str(&curves("Strict L1 by distance", axis, "strict L1, m", &x, &by(|m| m.strict_l1_m)));
    out.push_str(&curves("Relative error by distance", axis, "AbsRel", &x, &by(|m| m.abs_rel)));
    out.push_str(&curves(
        "Missing predictions by distance",
        axis,
        "missing, %",
        &x,
        &by(|m| m.missing_percent),
    ));
    out.push_str(
        "<p class=\"cap\">Of all pixels together, by the distance of the reference, from the first distance that has one to \
         the last.</p></section><section><h2>How large errors are</h2>",
    );
    let share = |r: &Row| {
        let n = r.metrics.pixel_pooled.counted.max(1) as f64;
        r.errors.counts.iter().chain([&r.errors.missing]).map(|c| Some(100.0 * *c as f64 / n)).collect()
    };
    out.push_str(&bars("How large errors are", "absolute error", "pixels, %", &classes(), &series(&share)));
    out.push_str("<p class=\"cap\">Share of the pixels that count; “none” are those without a prediction.</p></section>");
    worst(&mut out, rows);
    let _ = write!(out, "<footer><p>Generated by depthrig {}.</p></footer>", env!("CARGO_PKG_VERSION"));
    page::end(&mut out);
    out
}

/// The names of the classes of errors.
fn classes() -> Vec<String> {
    let mm = |m: f64| {
        if m < 1.0 { format!("{} mm", page::number(m * 1e3)) } else { format!("{} m", page::number(m)) }
    };
    let below = ERROR_BOUNDS_M.iter().map(|b| format!("<{}", mm(*b)));
    let last = ERROR_BOUNDS_M.last().map(|b| format!("≥{}", mm(*b)));
    below.chain(last).chain(["none".to_owned()]).collect()
}

fn problems(out: &mut String, evaluation: &Evaluation) {
    let lines: Vec<_> = evaluation.failed.iter().chain(&evaluation.left_out).take(20).collect();
    if lines.is_empty() {
        return;
    }
    out.push_str("<div class=\"verdict lost\"><strong>▲ Not everything was compared</strong><ul>");
    for line in lines {
        let _ = write!(out, "<li>{}</li>", escape(line));
    }
    out.push_str("</ul></div>");
}

fn table(out: &mut String, rows: &[Row], options: &Options) {
    const COLUMNS: [&str; 14] = [
        "prediction",
        "#L1 ↓",
        "#RMSE ↓",
        "#AbsRel ↓",
        "#δ0.5 ↑",
        "#δ1 ↑",
        "#strict L1 ↓",
        "#RMSE ↓",
        "#AbsRel ↓",
        "#δ0.5 ↑",
        "#δ1 ↑",
        "#missing %",
        "#filled %",
        "#images",
    ];
    type Pick = fn(&Row) -> &DepthMetrics;
    let forms: [(&str, Pick); 2] = [
        ("Mean over images", |r| &r.metrics.mean_of_images),
        ("All pixels together", |r| &r.metrics.pixel_pooled),
    ];
    for (name, of) in forms {
        let _ = write!(out, "<section><h2>{name}</h2>");
        page::table(out, &COLUMNS);
        for r in rows {
            let m = of(r);
            let mut cells = vec![label(r)];
            cells.extend([false, true].iter().flat_map(|strict| measures(m, *strict)).map(|(_, v)| value(v)));
            cells.push(format!("{:.2}", m.missing_percent));
            cells.push(format!("{:.2}", 100.0 * r.fill_rate));
            cells.push(r.metrics.images.to_string());
            page::row(out, &COLUMNS, &cells);
        }
        out.push_str(END_TABLE);
        out.push_str("</section>");
    }
    let _ = write!(
        out,
        "<p class=\"cap\">L1 and RMSE in metres. Plain measures are over pixels where reference and prediction both have \
         depth; δt is the share within a factor of 1.25^t. Strict measures are over all pixels whose reference counts: what \
         is missing is a prediction of 0 m, so that its error is the reference itself and its relative error 1. References \
         from {} m to {} m count.</p>",
        page::number(options.range.min_m),
        if options.range.max_m.is_finite() { page::number(options.range.max_m) } else { "∞".to_owned() }
    );
}

fn worst(out: &mut String, rows: &[Row]) {
    out.push_str("<section><h2>Worst images</h2><div class=\"wide\"><table class=\"images\"><tbody>");
    for r in rows {
        for w in &r.worst {
            let _ = write!(
                out,
                "<tr><th>{}<br/><span class=\"none\">{}<br/>strict L1 {} m</span></th>",
                escape(&label(r)),
                escape(&w.name),
                value(w.strict_l1_m)
            );
            for (what, html) in &w.html {
                let _ = write!(out, "<td>{html}<span class=\"none\">{what}</span></td>");
            }
            out.push_str("</tr>");
        }
    }
    out.push_str(END_TABLE);
    let _ = write!(
        out,
        "<p class=\"cap\">Depth in colours, near is light, in the range of the reference; black means no depth. Error: red is too \
         far, blue too near, strongest from {STRONG_M} m on; white is correct, grey means no prediction, black no reference.</p>\
         </section>"
    );
}
