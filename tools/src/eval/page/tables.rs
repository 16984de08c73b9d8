//! The tables of the report.

use super::super::records::Header;
use super::super::summary::{Evaluation, Row};
use super::super::text::{MEASURES, interval, measures as values, value};
use super::label;
use depthrig_cdm::metrics::{DepthMetrics, Rules};
use depthrig_recorder::report::page::{self, END_TABLE, escape};
use std::collections::BTreeSet;
use std::fmt::Write;

/// More scenes than these are left to JSON and CSV.
const SCENES: usize = 40;

/// Images and files that could not be compared.
pub fn problems(out: &mut String, evaluation: &Evaluation) {
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

/// The measures of every row.
pub fn measures(out: &mut String, rows: &[Row], header: &Header, rules: &Rules) {
    type Pick = fn(&Row) -> &DepthMetrics;
    let forms: [(&str, Pick); 2] = [
        ("Mean over images", |r| &r.metrics.mean_of_images),
        ("All pixels together", |r| &r.metrics.pixel_pooled),
    ];
    for (name, of) in forms {
        for strict in [true, false] {
            let kind = if strict { "strict" } else { "plain" };
            let _ = write!(out, "<section><h2>{name}, {kind}</h2>");
            let arrow = |i: usize| if i < 3 { "↓" } else { "↑" };
            let mut columns = vec!["prediction".to_owned()];
            columns.extend(MEASURES.iter().enumerate().map(|(i, m)| format!("#{m} {}", arrow(i))));
            columns.extend(["#missing %", "#filled %", "#images"].map(str::to_owned));
            let columns: Vec<&str> = columns.iter().map(String::as_str).collect();
            page::table(out, &columns);
            for r in rows {
                let m = of(r);
                let mut cells = vec![label(r)];
                cells.extend(values(m, strict).map(value));
                cells.push(format!("{:.2}", m.missing_percent));
                cells.push(format!("{:.2}", 100.0 * r.fill_rate));
                cells.push(r.metrics.images.to_string());
                page::row(out, &columns, &cells);
            }
            out.push_str(END_TABLE);
            out.push_str("</section>");
        }
    }
    let far = rules.range.max_m;
    let _ = write!(
        out,
        "<p class=\"cap\">L1 and RMSE in metres. Plain measures are over pixels where reference and prediction both have \
         depth; δ0.5 and δ1 are shares within a factor of 1.25^0.5 and 1.25, δ1.05 and δ1.10 within 1.05 and 1.10. Strict measures \
         are over all pixels whose reference counts: what is missing is a prediction of 0 m, so that its error is the reference \
         itself and its relative error 1. References from {} m to {} m count.{}{}</p>",
        page::number(rules.range.min_m),
        if far.is_finite() { page::number(far) } else { "∞".to_owned() },
        if header.like_cdm {
            " As the authors of CDM count: pixels whose prediction is NaN or infinite are left out."
        } else {
            ""
        },
        if header.resized { " Predictions of another size took the nearest pixels." } else { "" },
    );
    engines(out, header);
}

fn engines(out: &mut String, header: &Header) {
    let refined: Vec<_> = header.rows.iter().filter(|r| !r.input.is_empty()).collect();
    if refined.is_empty() {
        return;
    }
    let columns = ["refiner", "input", "engine", "model"];
    page::table(out, &columns);
    for r in refined {
        page::row(out, &columns, &[r.name.clone(), r.input.clone(), r.engine.clone(), r.model.clone()]);
    }
    out.push_str(END_TABLE);
    out.push_str("<p class=\"cap\">Holed: the refiner got raw depth as it is. Filled: each hole had the depth of the nearest \
                  measured pixel.</p>");
}

/// Differences to the first row of each group.
pub fn differences(out: &mut String, rows: &[Row]) {
    if rows.iter().all(|r| r.difference.is_none()) {
        return;
    }
    out.push_str("<section><h2>Difference to the first row, image by image</h2>");
    let columns = ["prediction", "to", "#strict L1, m", "", "#L1, m", "#images", "#sequences"];
    page::table(out, &columns);
    for r in rows {
        let Some(d) = &r.difference else { continue };
        let verdict = match (d.strict_l1_m.low, d.strict_l1_m.high) {
            (_, Some(high)) if high < 0.0 => "better",
            (Some(low), _) if low > 0.0 => "worse",
            (Some(_), Some(_)) => "not clear",
            _ => "one sequence",
        };
        let cells = [
            label(r),
            d.to.clone(),
            interval(&d.strict_l1_m),
            verdict.to_owned(),
            interval(&d.l1_m),
            d.images.to_string(),
            d.sequences.to_string(),
        ];
        page::row(out, &columns, &cells);
    }
    out.push_str(END_TABLE);
    out.push_str("<p class=\"cap\">Mean difference over images that both have, with its 95 % interval (bootstrap over sequences, \
                  fixed seed); below 0 is better.</p></section>");
}

/// Strict L1 of each scene.
pub fn by_scene(out: &mut String, rows: &[Row]) {
    let scenes: BTreeSet<&str> = rows.iter().flat_map(|r| &r.by_scene).map(|s| s.scene.as_str()).collect();
    if scenes.len() < 2 {
        return;
    }
    out.push_str("<section><h2>Strict L1 by scene, m</h2>");
    if scenes.len() > SCENES {
        let _ =
            write!(out, "<p class=\"cap\">The first {SCENES} of {} scenes; --csv has all.</p>", scenes.len());
    }
    let columns: Vec<String> = ["scene".to_owned()]
        .into_iter()
        .chain(rows.iter().map(|r| format!("#{}", escape(&label(r)))))
        .collect();
    let columns: Vec<&str> = columns.iter().map(String::as_str).collect();
    page::table(out, &columns);
    for scene in scenes.into_iter().take(SCENES) {
        let of = |r: &Row| {
            let found = r.by_scene.iter().find(|s| s.scene == scene);
            value(found.map_or(f64::NAN, |s| s.metrics.mean_of_images.strict_l1_m))
        };
        let cells: Vec<String> = [scene.to_owned()].into_iter().chain(rows.iter().map(of)).collect();
        page::row(out, &columns, &cells);
    }
    out.push_str(END_TABLE);
    out.push_str("</section>");
}
