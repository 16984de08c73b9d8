//! The plots of the report.

use super::super::summary::Row;
use super::Group;
use depthrig_cdm::metrics::{DepthMetrics, ERROR_BOUNDS_M};
use depthrig_recorder::report::curves::{Series, bars, curves};
use depthrig_recorder::report::page::{escape, number};
use std::collections::BTreeSet;
use std::fmt::Write;

/// A number of a row's metrics.
type Pick = fn(&DepthMetrics) -> f64;

fn series(group: &Group<'_>, of: impl Fn(&Row) -> Vec<Option<f64>>) -> Vec<Series> {
    group.rows.iter().map(|r| Series { name: r.info.name.clone(), values: of(r) }).collect()
}

fn known(v: f64) -> Option<f64> {
    Some(v).filter(|v| v.is_finite())
}

/// Bars of each row.
pub fn bars_of_rows(out: &mut String, groups: &[Group<'_>]) {
    out.push_str("<section><h2>L1 of each prediction</h2>");
    for group in groups {
        let names: Vec<String> = group.rows.iter().map(|r| r.info.name.clone()).collect();
        let of = |name: &str, pick: Pick| Series {
            name: name.to_owned(),
            values: group.rows.iter().map(|r| known(pick(&r.metrics.mean_of_images))).collect(),
        };
        let all = [of("strict L1", |m| m.strict_l1_m), of("L1", |m| m.l1_m)];
        out.push_str(&bars(
            &format!("L1 of each prediction{}", group.of()),
            group.name,
            "L1, m",
            &names,
            &all,
        ));
    }
    out.push_str("<p class=\"cap\">Mean over images.</p></section>");
}

/// Curves over the distance of the reference.
pub fn by_distance(out: &mut String, groups: &[Group<'_>]) {
    let forms: [(&str, &str, Pick); 4] = [
        ("L1 by distance", "L1, m", |m| m.l1_m),
        ("Strict L1 by distance", "strict L1, m", |m| m.strict_l1_m),
        ("Relative error by distance", "AbsRel", |m| m.abs_rel),
        ("Missing predictions by distance", "missing, %", |m| m.missing_percent),
    ];
    for group in groups {
        // From the first distance that any reference has to the last.
        let used = |i: &usize| group.rows.iter().any(|r| r.by_distance[*i].metrics.counted > 0);
        let bins = group.rows.first().map_or(0, |r| r.by_distance.len());
        let first = (0..bins).find(used).unwrap_or(0);
        let last = (0..bins).rev().find(used).unwrap_or(0);
        let range = first..(last + 1).min(bins);
        let middle = |r: &&Row| -> Vec<f64> {
            r.by_distance[range.clone()].iter().map(|b| f64::midpoint(b.from_m, b.to_m)).collect()
        };
        let x: Vec<f64> = group.rows.first().map(middle).unwrap_or_default();
        let _ = write!(out, "<section><h2>Error against distance{}</h2>", escape(&group.of()));
        for (name, axis, pick) in forms {
            let of = |r: &Row| r.by_distance[range.clone()].iter().map(|b| known(pick(&b.metrics))).collect();
            out.push_str(&curves(name, "distance of the reference, m", axis, &x, &series(group, of)));
        }
        out.push_str(
            "<p class=\"cap\">Of all pixels together, by the distance of the reference, from the first distance that has one to \
             the last.</p></section>",
        );
    }
}

/// Bars by material, where there are materials.
pub fn by_material(out: &mut String, groups: &[Group<'_>]) {
    for group in groups {
        let all = group.rows.iter().flat_map(|r| &r.by_material);
        let names: BTreeSet<&str> = all.map(|m| m.material.as_str()).collect();
        if names.is_empty() {
            continue;
        }
        let names: Vec<String> = names.into_iter().map(str::to_owned).collect();
        let _ = write!(out, "<section><h2>Error by material{}</h2>", escape(&group.of()));
        let forms: [(&str, Pick); 2] =
            [("strict L1, m", |m| m.strict_l1_m), ("missing, %", |m| m.missing_percent)];
        for (axis, pick) in forms {
            let of = |r: &Row| {
                let find = |name: &String| r.by_material.iter().find(|m| m.material == *name);
                names.iter().map(|n| find(n).and_then(|m| known(pick(&m.metrics)))).collect()
            };
            out.push_str(&bars("Error by material", "material", axis, &names, &series(group, of)));
        }
        out.push_str("<p class=\"cap\">Of all pixels together.</p></section>");
    }
}

/// How large errors are.
pub fn histogram(out: &mut String, groups: &[Group<'_>]) {
    out.push_str("<section><h2>How large errors are</h2>");
    for group in groups {
        let share = |r: &Row| {
            let n = r.metrics.pixel_pooled.counted.max(1) as f64;
            r.errors.counts.iter().chain([&r.errors.missing]).map(|c| Some(100.0 * *c as f64 / n)).collect()
        };
        let title = format!("How large errors are{}", group.of());
        out.push_str(&bars(&title, "absolute error", "pixels, %", &classes(), &series(group, share)));
    }
    out.push_str("<p class=\"cap\">Share of the pixels that count; “none” are those without a prediction.</p></section>");
}

/// The names of the classes of errors.
fn classes() -> Vec<String> {
    let mm = |m: f64| if m < 1.0 { format!("{} mm", number(m * 1e3)) } else { format!("{} m", number(m)) };
    let below = ERROR_BOUNDS_M.iter().map(|b| format!("<{}", mm(*b)));
    let last = ERROR_BOUNDS_M.last().map(|b| format!("≥{}", mm(*b)));
    below.chain(last).chain(["none".to_owned()]).collect()
}
