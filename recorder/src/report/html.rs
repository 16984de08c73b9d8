//! The report as HTML. Every text from outside goes through [`escape`].

use super::markup::{END_TABLE, escape, row, table};
use super::pixels::ramp;
use super::svg::number;
use super::{Report, Shown};
use crate::catalog::Health;
use crate::clock::utc_text;
use depthrig_bus::Distortion;
use std::fmt::Write;

mod plots;

/// Notes and edits that are shown.
const LISTED_MAX: usize = 50;

fn length(ns: i64) -> String {
    let s = ns as f64 / 1e9;
    let whole = s.max(0.0) as u64;
    match whole {
        0..60 => format!("{s:.1} s"),
        60..3600 => format!("{} min {:02} s", whole / 60, whole % 60),
        _ => format!("{} h {:02} min", whole / 3600, whole / 60 % 60),
    }
}

fn size(bytes: u64) -> String {
    match bytes as f64 {
        b if b < 1e6 => format!("{:.1} kB", b / 1e3),
        b if b < 1e9 => format!("{:.1} MB", b / 1e6),
        b => format!("{:.2} GB", b / 1e9),
    }
}

fn ms(ns: i64) -> String {
    match ns as f64 / 1e6 {
        x if x.abs() < 1.0 => format!("{x:.2} ms"),
        x => format!("{x:.1} ms"),
    }
}

/// `1 set`, `2 sets`.
pub(super) fn count(n: u64, what: &str) -> String {
    format!("{n} {what}{}", if n == 1 { "" } else { "s" })
}

fn or_none(text: &str) -> &str {
    if text.is_empty() { "–" } else { text }
}

pub(super) fn page(r: &Report) -> String {
    let mut out = super::page::begin(&format!("{} – depthrig report", r.name));
    head(&mut out, r);
    streams(&mut out, r);
    plots::rates(&mut out, r);
    plots::losses(&mut out, r);
    plots::spreads(&mut out, r);
    plots::clocks(&mut out, r);
    plots::fill(&mut out, r);
    plots::motion(&mut out, r);
    plots::signals(&mut out, r);
    images(&mut out, r);
    calibration(&mut out, r);
    footer(&mut out, r);
    super::page::end(&mut out);
    out
}

fn list(out: &mut String, lines: &[String]) {
    if lines.is_empty() {
        return;
    }
    out.push_str("<ul>");
    for line in lines {
        let _ = write!(out, "<li>{}</li>", escape(line));
    }
    out.push_str("</ul>");
}

fn head(out: &mut String, r: &Report) {
    let v = &r.verdict;
    let (tone, sign) = match v.health {
        Health::Whole if v.remarks.is_empty() => ("whole", "✓"),
        Health::Whole => ("remarks", "✓"),
        Health::Recording => ("remarks", "●"),
        Health::Lost => ("lost", "▲"),
        Health::Unfinished | Health::Damaged => ("bad", "✕"),
    };
    let scene = if r.scene.is_empty() { r.name.as_str() } else { r.scene.as_str() };
    let _ = write!(
        out,
        "<header><h1>{}</h1><div class=\"sub\">{} · {}</div></header><div class=\"verdict {tone}\"><strong>{sign} {}\
         </strong>",
        escape(scene),
        escape(&r.name),
        utc_text(r.started_utc_ns),
        escape(&v.headline)
    );
    list(out, &v.why);
    if !v.remarks.is_empty() {
        out.push_str("<p class=\"sub\">Remarks</p>");
        list(out, &v.remarks);
    }
    out.push_str("</div><dl>");
    let rate = r.bytes as f64 / (r.sets.duration_ns.max(1) as f64 * 1e-9) / 1e6;
    let per_s = if r.sets.interval_ns.p50 > 0 { 1e9 / r.sets.interval_ns.p50 as f64 } else { 0.0 };
    for (name, value) in [
        ("Length", length(r.sets.duration_ns)),
        ("Sets", format!("{} at {} Hz", r.sets.count, number(per_s))),
        ("Sets lost", sets_lost(r)),
        ("Incomplete sets", r.sets.incomplete.to_string()),
        ("Size", format!("{} in {}", size(r.bytes), count(r.segments as u64, "segment"))),
        ("Data rate", if r.sets.duration_ns > 0 { format!("{rate:.1} MB/s") } else { "–".to_owned() }),
        ("Rig, host", format!("{}, {}", r.rig, or_none(&r.host))),
        ("Operator", or_none(&r.operator).to_owned()),
    ] {
        let _ = write!(out, "<div><dt>{name}</dt><dd>{}</dd></div>", escape(&value));
    }
    out.push_str("</dl>");
    let notes = r.notes.iter().map(|n| format!("{}: {}", utc_text(n.utc_ns), n.text));
    named_list(out, "Notes", notes.collect());
    named_list(out, "Episodes", r.episodes.iter().map(crate::Episode::text).collect());
    named_list(out, "Computed, not captured", r.computed.iter().map(ToString::to_string).collect());
    let edits = r.history.iter().map(|e| match e.field.as_str() {
        "notes" => format!("{}: note added: {}", utc_text(e.utc_ns), e.after),
        "calibration" => format!("{}: {}", utc_text(e.utc_ns), e.text()),
        field => format!("{}: {field} “{}” became “{}”", utc_text(e.utc_ns), e.before, e.after),
    });
    named_list(out, "Changed after the recording", edits.collect());
}

fn sets_lost(r: &Report) -> String {
    match &r.sets.counts {
        None => "–".to_owned(),
        Some(c) if r.verdict.health == Health::Lost && c.dropped_total() == 0 => "none counted".to_owned(),
        Some(c) => format!("{} of {}", c.dropped_total(), c.offered),
    }
}

fn named_list(out: &mut String, name: &str, mut lines: Vec<String>) {
    if lines.is_empty() {
        return;
    }
    if lines.len() > LISTED_MAX {
        let more = lines.len() - LISTED_MAX;
        lines.truncate(LISTED_MAX);
        lines.push(format!("… and {more} more in session.toml"));
    }
    let _ = write!(out, "<p class=\"sub\">{name}</p>");
    list(out, &lines);
}

fn streams(out: &mut String, r: &Report) {
    const COLUMNS: [&str; 9] = [
        "stream",
        "camera",
        "images",
        "stored as",
        "#frames",
        "#missing",
        "#live Hz (nominal)",
        "#size",
        "#of raw",
    ];
    out.push_str("<section><h2>Streams</h2>");
    table(out, &COLUMNS);
    for s in &r.streams {
        let share = 100.0 * s.packed_bytes as f64 / s.raw_bytes.max(1) as f64;
        let packed = if s.is_packed { " + zstd" } else { "" };
        let serial =
            if s.record.serial.is_empty() { String::new() } else { format!(" #{}", s.record.serial) };
        let cells = [
            s.record.id.to_string(),
            format!("{}{serial}", or_none(&s.record.model)),
            format!("{}×{} {}", s.record.width, s.record.height, s.record.format.name()),
            format!("{}{packed}", or_none(s.codec)),
            s.frames.to_string(),
            s.missing.to_string(),
            format!("{:.2} ({})", s.live_hz, number(s.record.rate_hz)),
            size(s.packed_bytes),
            format!("{share:.0} %"),
        ];
        row(out, &COLUMNS, &cells);
    }
    out.push_str(END_TABLE);
    out.push_str(
        "<p class=\"cap\">Size is that of the stored images as they lie in the file; live Hz is the rate on the \
         camera’s channel, of which sets take a part.</p></section>",
    );
}

fn images(out: &mut String, r: &Report) {
    let Some(columns) =
        r.streams.chunk_by(|a, b| a.record.id.camera == b.record.id.camera).map(<[_]>::len).max()
    else {
        return;
    };
    out.push_str("<section><h2>Images</h2><div class=\"wide\"><table class=\"images\"><thead><tr><th></th>");
    for set in &r.images {
        let at = length(set.at_ns);
        let _ = write!(out, "<th colspan=\"{columns}\">{} set (no. {}, {at})</th>", set.title, set.number);
    }
    out.push_str("</tr></thead><tbody>");
    let mut at = 0;
    for camera in r.streams.chunk_by(|a, b| a.record.id.camera == b.record.id.camera) {
        let _ = write!(out, "<tr><th>{}", escape(&camera[0].record.id.camera.to_string()));
        for i in at..at + camera.len() {
            let range = r.images.iter().find_map(|set| set.images.get(&i)?.range_m);
            if let Some((near, far)) = range {
                let _ = write!(out, "<br/><span class=\"none\">{} to {} m</span>", metres(near), metres(far));
            }
        }
        out.push_str("</th>");
        for set in &r.images {
            for k in 0..columns {
                let shown = if k < camera.len() { set.images.get(&(at + k)) } else { None };
                let name = camera.get(k).map(|s| format!("{}, {} set", s.record.id, set.title));
                image(out, shown, name.as_deref());
            }
        }
        out.push_str("</tr>");
        at += camera.len();
    }
    let _ = write!(
        out,
        "{END_TABLE}<p class=\"cap\">Depth in colours: near {} far, in the range beside each camera, the same in all sets; black \
         is no depth.</p></section>",
        ramp()
    );
}

fn metres(m: f32) -> String {
    if m < 1.0 { format!("{m:.2}") } else { format!("{m:.1}") }
}

fn image(out: &mut String, shown: Option<&Shown>, name: Option<&str>) {
    let _ = match (shown, name) {
        (Some(p), Some(name)) => write!(
            out,
            "<td><img width=\"{}\" height=\"{}\" alt=\"{}\" src=\"{}\"/></td>",
            p.width,
            p.height,
            escape(name),
            p.data_uri
        ),
        (None, Some(_)) => write!(out, "<td class=\"none\">none</td>"),
        _ => write!(out, "<td></td>"),
    };
}

fn calibration(out: &mut String, r: &Report) {
    const COLUMNS: [&str; 8] = [
        "stream",
        "size",
        "fx, fy (px)",
        "cx, cy (px)",
        "distortion",
        "depth unit",
        "position on the mount (m)",
        "comes from",
    ];
    out.push_str("<section><h2>Calibration</h2>");
    table(out, &COLUMNS);
    for s in &r.streams {
        let i = &s.record.intrinsics;
        let record = &s.record;
        let known = i.is_known();
        let pair = |a: f64, b: f64| if known { format!("{a:.2},\u{a0}{b:.2}") } else { "unknown".to_owned() };
        let unit = if record.depth_unit_m > 0.0 {
            format!("{} mm", number(record.depth_unit_m * 1e3))
        } else {
            "–".into()
        };
        let t = record.pose.translation_m.map(|v| format!("{v:.4}")).join(",\u{a0}");
        let cells = [
            record.id.to_string(),
            format!("{}×{}", record.width, record.height),
            pair(i.fx, i.fy),
            pair(i.cx, i.cy),
            distortion(i),
            unit,
            t,
            or_none(&record.calibration).to_owned(),
        ];
        row(out, &COLUMNS, &cells);
    }
    out.push_str(END_TABLE);
    out.push_str(
        "<p class=\"cap\">Rotations are in session.toml and in /tf_static of each segment.</p></section>",
    );
}

fn distortion(i: &depthrig_bus::Intrinsics) -> String {
    let name = match i.distortion() {
        Distortion::None => return "none".to_owned(),
        Distortion::BrownConrady => "Brown-Conrady",
        Distortion::InverseBrownConrady => "inverse Brown-Conrady",
        Distortion::KannalaBrandt4 => "Kannala-Brandt",
        Distortion::Rational => "rational",
        _ => return "unknown".to_owned(),
    };
    let last = i.coeffs.iter().rposition(|c| *c != 0.0).map_or(0, |n| n + 1);
    let coefficients: Vec<_> = i.coeffs[..last].iter().map(|c| format!("{c:.5}")).collect();
    if coefficients.is_empty() {
        format!("{name}, all 0")
    } else {
        format!("{name}: {}", coefficients.join(", "))
    }
}

fn footer(out: &mut String, r: &Report) {
    let _ = write!(
        out,
        "<footer><p>Made by depthrig {} from every number of {} sets and {} of their images ({} sets looked at for \
         depth). Recorded by depthrig {}. Checksums of images that were not looked at are checked by \
         <code>depthrig verify {}</code>.</p></footer>",
        env!("CARGO_PKG_VERSION"),
        r.sets.count,
        r.sampled.images,
        r.sampled.sets,
        escape(or_none(&r.depthrig_version)),
        escape(&r.path.display().to_string())
    );
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_read_well() {
        assert_eq!([length(8_240_000_000), length(249_000_000_000)], ["8.2 s", "4 min 09 s"]);
        assert_eq!([size(1500), size(2_500_000), size(3_210_000_000)], ["1.5 kB", "2.5 MB", "3.21 GB"]);
        assert_eq!(utc_text(1_709_210_096_789_000_000), "2024-02-29 12:34:56 UTC");
    }
}
