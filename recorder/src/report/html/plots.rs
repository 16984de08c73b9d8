//! The sections of the report that are plots: rates, losses, spreads, clocks, fill rates.

use super::{END_TABLE, count, escape, ms, row, table};
use crate::catalog::Health;
use crate::report::svg::{self, Strip, Time, Trace, nice_end, number};
use crate::report::{FieldSeries, MotionReport, Quantiles, Range, Report, StreamReport};
use std::fmt::Write;

/// Acceleration that an IMU at rest measures, m/s² (standard gravity).
const GRAVITY: f64 = 9.806_65;

fn time(r: &Report) -> Time {
    Time { span_ns: r.bins.span_ns, bin_ns: r.bins.width_ns }
}

fn marked(counts: &[u64]) -> Vec<usize> {
    counts.iter().enumerate().filter(|(_, n)| **n > 0).map(|(i, _)| i).collect()
}

fn plain(series: &[Option<f64>]) -> Trace {
    Trace::Steps(series.iter().map(|v| v.map(|v| (v, v, v))).collect())
}

fn highest(series: &[Option<f64>]) -> f64 {
    series.iter().flatten().copied().fold(0.0, f64::max)
}

fn least(series: &[Option<f64>]) -> Option<f64> {
    series.iter().flatten().copied().reduce(f64::min)
}

fn too_short(out: &mut String, r: &Report) -> bool {
    if r.bins.span_ns == 0 {
        out.push_str("<p class=\"none\">Fewer than two sets: nothing over time.</p></section>");
    }
    r.bins.span_ns == 0
}

pub(super) fn rates(out: &mut String, r: &Report) {
    out.push_str("<section><h2>Rate over time</h2>");
    if too_short(out, r) {
        return;
    }
    let strip = |label: String, series: &[Option<f64>], nominal: f64, note: String, marks| Strip {
        label,
        note,
        trace: plain(series),
        y: (0.0, nice_end(highest(series).max(nominal) * 1.1)),
        nominal: (nominal > 0.0).then_some(nominal),
        marks,
    };
    let per_s = if r.sets.interval_ns.p50 > 0 { 1e9 / r.sets.interval_ns.p50 as f64 } else { 0.0 };
    let worst = ms(r.sets.interval_ns.max);
    let mut strips = vec![strip(
        "sets".to_owned(),
        &r.sets.per_second,
        per_s,
        format!("longest pause {worst}"),
        [Vec::new(), Vec::new()],
    )];
    for s in &r.streams {
        let note = match least(&s.live_hz_series) {
            Some(least) if s.frames > 1 => format!("{:.2} Hz, least {}", s.live_hz, number(least)),
            _ => format!("{} frames", s.frames),
        };
        let marks = [marked(&s.missing_series), marked(&s.dropped_series)];
        strips.push(strip(s.record.id.to_string(), &s.live_hz_series, s.record.rate_hz, note, marks));
    }
    let _ = write!(
        out,
        "<p class=\"cap\">Frames per second on each camera’s channel, in steps of {} s; dashed is the nominal rate, for \
         sets the usual one.<span class=\"key\"><svg viewBox=\"0 0 10 8\"><path class=\"missing\" d=\"M5 1l-4 6h8z\"/>\
         </svg>sets without a frame of the stream<svg viewBox=\"0 0 10 8\"><path class=\"dropped\" d=\"M5 7l-4 -6h8z\"/>\
         </svg>frames lost before the channel</span></p>",
        number(r.bins.width_ns as f64 / 1e9)
    );
    out.push_str(&svg::strips("Frames per second over time, per stream", "Hz", time(r), &strips));
    out.push_str("</section>");
}

/// Whether a sum is what it should be, as text and in colour.
fn check(out: &mut String, balances: bool) {
    out.push_str(if balances {
        "<td class=\"ok\">✓ exact</td>"
    } else {
        "<td class=\"no\">✕ NOT exact</td>"
    });
}

pub(super) fn losses(out: &mut String, r: &Report) {
    out.push_str("<section><h2>Losses by reason</h2>");
    let mut bars = Vec::new();
    out.push_str(
        "<div class=\"wide\"><table><thead><tr><th></th><th>account</th><th>checked</th></tr></thead><tbody>",
    );
    if let Some(c) = &r.sets.counts {
        let mut text = format!("{} offered = {} recorded", c.offered, c.recorded);
        for (reason, n) in &c.dropped {
            let _ = write!(text, " + {n} {reason}");
            bars.push((format!("sets · {reason}"), *n));
        }
        let _ = write!(out, "<tr><td>sets</td><td>{}</td>", escape(&text));
        check(out, c.balances());
        out.push_str("</tr>");
    }
    let units = r.motion.iter().map(|u| (&u.record.id, &u.account));
    let signals = r.signals.iter().map(|s| (&s.id, &s.account));
    let streams = r.streams.iter().map(|s| (&s.record.id, &s.account));
    for (id, account) in streams.chain(units).chain(signals) {
        let _ = write!(out, "<tr><td>{}</td>", escape(&id.to_string()));
        let Some(a) = account else {
            out.push_str("<td colspan=\"2\">no account in the file</td></tr>");
            continue;
        };
        let mut text = format!("{} captured = {} delivered", a.captured, a.delivered);
        for (reason, n) in a.dropped.nonzero() {
            let _ = write!(text, " + {n} {}", reason.name());
            bars.push((format!("{} · {}", a.stream, reason.name()), n));
        }
        let _ = write!(out, "<td>{text}</td>");
        check(out, a.balances());
        out.push_str("</tr>");
    }
    out.push_str(END_TABLE);
    if bars.is_empty() {
        let said = if r.verdict.health == Health::Whole {
            "Nothing was lost for any reason."
        } else {
            "No loss is counted; what is known of one stands in the verdict."
        };
        let _ = write!(out, "<p class=\"cap\">{said}</p>");
    } else {
        out.push_str("<p class=\"cap\">Sets, and frames before their channel, that were lost:</p>");
        out.push_str(&svg::bars("Losses by stream and reason", &bars));
    }
    out.push_str("</section>");
}

pub(super) fn spreads(out: &mut String, r: &Report) {
    let s = &r.sets;
    out.push_str("<section><h2>Spread of the sets</h2>");
    if s.spread_histogram.counts.is_empty() {
        out.push_str("<p class=\"none\">No set has two frames.</p></section>");
        return;
    }
    let at = |ns: i64| ns as f64 / 1e6;
    let mut marks = vec![
        (at(s.spread_ns.p50), format!("p50 {}", ms(s.spread_ns.p50))),
        (at(s.spread_ns.p95), format!("p95 {}", ms(s.spread_ns.p95))),
    ];
    if let Some(limit) = s.spread_limit_ns {
        marks.push((at(limit), format!("limit {}", ms(limit))));
    }
    let _ = write!(
        out,
        "<p class=\"cap\">Latest minus earliest capture time of the frames of a set. p99 {}, greatest {}; {} of {} sets \
         are beyond the limit, {} beyond the plot.</p>",
        ms(s.spread_ns.p99),
        ms(s.spread_ns.max),
        s.beyond_limit,
        s.count,
        s.spread_histogram.beyond
    );
    out.push_str(&svg::histogram(
        "Histogram of set spreads",
        "spread, ms",
        at(s.spread_histogram.width_ns),
        &s.spread_histogram.counts,
        &marks,
    ));
    out.push_str("</section>");
}

fn in_ms(series: &[Option<Range>]) -> Trace {
    Trace::Steps(series.iter().map(|v| v.map(|v| (v.min / 1e6, v.mean / 1e6, v.max / 1e6))).collect())
}

pub(super) fn clocks(out: &mut String, r: &Report) {
    const COLUMNS: [&str; 7] = [
        "stream",
        "capture time from",
        "#lag p50",
        "#lag p99",
        "#lag max",
        "#stated ± p50 (max)",
        "#map restarts",
    ];
    out.push_str("<section><h2>Clocks</h2>");
    table(out, &COLUMNS);
    for s in r.streams.iter().filter(|s| s.frames > 0) {
        let c = &s.clock;
        let us = |ns: i64| number(ns as f64 / 1e3);
        let cells = [
            s.record.id.to_string(),
            format!("{} clock", c.domain),
            ms(c.lag_ns.p50),
            ms(c.lag_ns.p99),
            ms(c.lag_ns.max),
            format!("{} ({}) µs", us(c.uncertainty_ns.p50), us(c.uncertainty_ns.max)),
            c.restarts.to_string(),
        ];
        row(out, &COLUMNS, &cells);
    }
    out.push_str(END_TABLE);
    out.push_str(
        "<p class=\"cap\">Lag is arrival minus mapped capture time (middle of the exposure): half the exposure, read-out \
         and transport. A map that is right makes it flat; drift in it is an error of the map, peaks are the transport.</p>",
    );
    if r.bins.span_ns > 0 {
        let strips: Vec<_> = r.streams.iter().filter(|s| s.frames > 0).map(lag_strip).collect();
        out.push_str(&svg::strips("Arrival minus capture time, per stream", "ms", time(r), &strips));
        host_clock(out, r);
    }
    out.push_str("</section>");
}

fn lag_strip(s: &StreamReport) -> Strip {
    let q: &Quantiles = &s.clock.lag_ns;
    let top = s.clock.lag_series.iter().flatten().map(|v| v.max / 1e6).fold(0.0, f64::max);
    let restarts = if s.clock.restarts > 0 {
        format!(", {}", count(s.clock.restarts, "restart"))
    } else {
        String::new()
    };
    Strip {
        label: s.record.id.to_string(),
        note: format!("p50 {} max {}{restarts}", ms(q.p50), ms(q.max)),
        trace: in_ms(&s.clock.lag_series),
        y: (0.0, nice_end(top * 1.05)),
        nominal: None,
        marks: [Vec::new(), Vec::new()],
    }
}

fn host_clock(out: &mut String, r: &Report) {
    let c = &r.host_clock;
    if c.pairs < 2 {
        return;
    }
    let values = c.series.iter().flatten();
    let (low, high) = values.fold((0.0f64, 0.0f64), |(a, b), v| (a.min(v.min / 1e6), b.max(v.max / 1e6)));
    let span = nice_end((high - low).max(0.01));
    let middle = f64::midpoint(low, high);
    let at = |i: usize| i as i64 * r.bins.width_ns + r.bins.width_ns / 2;
    let readings: Vec<_> = c
        .series
        .iter()
        .enumerate()
        .filter_map(|(i, v)| Some((at(i).min(r.bins.span_ns), (*v)?.mean / 1e6)))
        .collect();
    let strip = Strip {
        label: "UTC − monotonic".to_owned(),
        note: format!(
            "{:+.3} ms, {:+.2} ppm, {} steps",
            c.change_ns as f64 / 1e6,
            c.drift_ppm,
            c.steps.len()
        ),
        trace: Trace::Points(readings),
        y: (middle - span * 0.6, middle + span * 0.6),
        nominal: Some(0.0),
        marks: [Vec::new(), Vec::new()],
    };
    let _ = write!(
        out,
        "<p class=\"cap\">The host’s wall clock against its monotonic one, change since the first of {} readings (each \
         read within {} µs). Recorded times follow the monotonic clock and the first reading.</p>",
        c.pairs,
        number(c.width_ns as f64 / 1e3)
    );
    out.push_str(&svg::strips("Wall clock against monotonic clock", "ms", time(r), &[strip]));
}

pub(super) fn motion(out: &mut String, r: &Report) {
    const COLUMNS: [&str; 6] =
        ["unit", "#samples", "#samples/s", "#nominal", "#batches not recorded", "#samples never given"];
    if r.motion.is_empty() {
        return;
    }
    out.push_str("<section><h2>Motion</h2>");
    table(out, &COLUMNS);
    for u in &r.motion {
        let cells = [
            u.record.id.to_string(),
            u.samples.to_string(),
            format!("{:.1}", u.samples_hz),
            number(u.record.rate_hz),
            u.lost_batches.to_string(),
            u.never_given.to_string(),
        ];
        row(out, &COLUMNS, &cells);
    }
    out.push_str(END_TABLE);
    if r.bins.span_ns > 0 {
        out.push_str(
            "<p class=\"cap\">Length of the angular velocity and of the acceleration, least, mean and greatest in steps; \
             dashed is gravity.</p>",
        );
        let strip = |u: &MotionReport, what: &str, series: &[Option<Range>], nominal: Option<f64>| {
            let top = series.iter().flatten().map(|v| v.max).fold(nominal.unwrap_or(0.0), f64::max);
            Strip {
                label: u.record.id.to_string(),
                note: format!(
                    "{what}, at most {}",
                    number(series.iter().flatten().map(|v| v.max).fold(0.0, f64::max))
                ),
                trace: Trace::Steps(series.iter().map(|v| v.map(|v| (v.min, v.mean, v.max))).collect()),
                y: (0.0, nice_end(top * 1.05)),
                nominal,
                marks: [Vec::new(), Vec::new()],
            }
        };
        let turns: Vec<_> = r.motion.iter().map(|u| strip(u, "rotation", &u.rotation_series, None)).collect();
        out.push_str(&svg::strips("Angular velocity over time, per IMU", "rad/s", time(r), &turns));
        let pushes = r.motion.iter().map(|u| strip(u, "acceleration", &u.acceleration_series, Some(GRAVITY)));
        let pushes: Vec<_> = pushes.collect();
        out.push_str(&svg::strips("Acceleration over time, per IMU", "m/s²", time(r), &pushes));
    }
    out.push_str("</section>");
}

pub(super) fn signals(out: &mut String, r: &Report) {
    const COLUMNS: [&str; 6] = ["signal", "kind", "#samples", "#samples/s", "#not recorded", "#restarts"];
    if r.signals.is_empty() {
        return;
    }
    out.push_str("<section><h2>Signals</h2>");
    table(out, &COLUMNS);
    for s in &r.signals {
        let cells = [
            s.id.to_string(),
            s.kind.to_owned(),
            s.samples.to_string(),
            format!("{:.1}", s.samples_hz),
            s.lost.to_string(),
            s.restarts.to_string(),
        ];
        row(out, &COLUMNS, &cells);
    }
    out.push_str(END_TABLE);
    if r.bins.span_ns > 0 {
        out.push_str("<p class=\"cap\">The values of each signal, least, mean and greatest in steps.</p>");
        for s in r.signals.iter().filter(|s| !s.fields.is_empty()) {
            let strip = |field: &FieldSeries| {
                let values = || field.series.iter().flatten();
                let least = values().map(|v| v.min).fold(f64::INFINITY, f64::min);
                let most = values().map(|v| v.max).fold(f64::NEG_INFINITY, f64::max);
                let (note, y) = if least <= most {
                    // A constant needs room around it.
                    let margin = (0.05 * (most - least)).max(1e-9 * (1.0 + most.abs()));
                    (format!("{} to {}", number(least), number(most)), (least - margin, most + margin))
                } else {
                    ("no number".to_owned(), (0.0, 1.0))
                };
                Strip {
                    label: field.name.clone(),
                    note,
                    trace: Trace::Steps(
                        field.series.iter().map(|v| v.map(|v| (v.min, v.mean, v.max))).collect(),
                    ),
                    y,
                    nominal: None,
                    marks: [Vec::new(), Vec::new()],
                }
            };
            let strips: Vec<_> = s.fields.iter().map(strip).collect();
            let _ = write!(out, "<h3>{}</h3>", escape(&s.id.to_string()));
            out.push_str(&svg::strips(&format!("{} over time", s.id), &escape(&s.unit), time(r), &strips));
        }
    }
    out.push_str("</section>");
}

pub(super) fn fill(out: &mut String, r: &Report) {
    let depth: Vec<_> = r.streams.iter().filter_map(|s| Some((s, s.fill.as_ref()?))).collect();
    if depth.is_empty() {
        return;
    }
    let strips: Vec<_> = depth
        .iter()
        .map(|(s, fill)| Strip {
            label: s.record.id.to_string(),
            note: format!(
                "mean {:.1} %, {:.1} to {:.1} %",
                100.0 * fill.mean,
                100.0 * fill.min,
                100.0 * fill.max
            ),
            trace: Trace::Points(fill.samples.iter().map(|(t, share)| (*t, 100.0 * share)).collect()),
            y: (0.0, 100.0),
            nominal: None,
            marks: [Vec::new(), Vec::new()],
        })
        .collect();
    let _ = write!(
        out,
        "<section><h2>Fill rate of depth</h2><p class=\"cap\">Share of the pixels that have a depth, in {} of {} sets, \
         evenly chosen.</p>{}</section>",
        r.sampled.sets,
        r.sets.count,
        svg::strips("Fill rate of depth, per stream", "%", time(r), &strips)
    );
}
