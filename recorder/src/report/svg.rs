//! The few plots of the report as inline SVG: strips over time, a histogram, bars. Colours are CSS variables of the
//! page, and nothing depends on colour alone.
//!
//! Written here because it is short: `plotters` with its SVG backend brings fonts and colours of its own, which
//! neither dark mode nor paper could change.

use super::markup::escape;
use std::fmt::Write;
use std::ops::Range;

/// Width of every plot; the page scales it.
const WIDTH: f64 = 960.0;
/// Where the plots of strips begin and end.
const X: (f64, f64) = (196.0, 750.0);
/// Height of a strip and the space below it.
const STRIP: f64 = 27.0;
const GAP: f64 = 8.0;
/// Space for an axis with its title.
const AXIS: f64 = 38.0;

/// Values drawn over time.
pub(super) enum Trace {
    /// A value per bin, and the range that its values had.
    Steps(Vec<Option<(f64, f64, f64)>>),
    /// Values at times, nanoseconds.
    Points(Vec<(i64, f64)>),
}

/// One quantity over time.
pub(super) struct Strip {
    pub(super) label: String,
    /// A note in words at the right of the plot.
    pub(super) note: String,
    pub(super) trace: Trace,
    pub(super) y: (f64, f64),
    /// The nominal value.
    pub(super) nominal: Option<f64>,
    /// Bins that are marked below, and above.
    pub(super) marks: [Vec<usize>; 2],
}

/// The time that strips show.
#[derive(Clone, Copy)]
pub(super) struct Time {
    pub(super) span_ns: i64,
    pub(super) bin_ns: i64,
}

/// The least of 1, 2, 2.5, 5 times a power of ten that is not below `x`: a distance of ticks.
pub fn nice_step(x: f64) -> f64 {
    above(x, &[1.0, 2.0, 2.5, 5.0])
}

/// The end of an axis that includes `x`.
pub fn nice_end(x: f64) -> f64 {
    above(x, &[1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0])
}

fn above(x: f64, factors: &[f64]) -> f64 {
    if !(x.is_finite() && x > 0.0) {
        return 1.0;
    }
    let power = 10f64.powf(x.log10().floor());
    let factor = factors.iter().find(|f| *f * power >= x * (1.0 - 1e-9));
    factor.unwrap_or(&10.0) * power
}

/// A number without insignificant digits.
pub fn number(x: f64) -> String {
    let digits = match x.abs() {
        0.0 => 0,
        a if a < 0.1 => 3,
        a if a < 1.0 => 2,
        a if a < 100.0 => 1,
        _ => 0,
    };
    let text = format!("{x:.digits$}");
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_owned() } else { text }
}

pub(super) fn begin(out: &mut String, height: f64, title: &str) {
    let title = escape(title);
    let _ = write!(
        out,
        "<svg viewBox=\"0 0 {WIDTH} {height:.0}\" role=\"img\" aria-label=\"{title}\"><title>{title}</title>"
    );
}

pub(super) fn text(out: &mut String, x: f64, y: f64, class: &str, text: &str) {
    let _ = write!(out, "<text x=\"{x:.1}\" y=\"{y:.1}\" class=\"{class}\">{}</text>", escape(text));
}

pub(super) fn horizontal_line(out: &mut String, class: &str, x: Range<f64>, y: f64) {
    line(out, class, x, y..y);
}

pub(super) fn vertical_line(out: &mut String, class: &str, x: f64, y: Range<f64>) {
    line(out, class, x..x, y);
}

fn line(out: &mut String, class: &str, x: Range<f64>, y: Range<f64>) {
    let Range { start: x1, end: x2 } = x;
    let Range { start: y1, end: y2 } = y;
    let _ =
        write!(out, "<line class=\"{class}\" x1=\"{x1:.1}\" x2=\"{x2:.1}\" y1=\"{y1:.1}\" y2=\"{y2:.1}\"/>");
}

/// Strips one below the other on one axis of time.
pub(super) fn strips(title: &str, unit: &str, time: Time, strips: &[Strip]) -> String {
    let mut out = String::new();
    let bottom = strips.len() as f64 * (STRIP + GAP) + 4.0;
    begin(&mut out, bottom + AXIS, title);
    let span = time.span_ns.max(1) as f64;
    let x_of = |t_ns: f64| X.0 + (t_ns / span).clamp(0.0, 1.0) * (X.1 - X.0);
    let (step, scale, name) = time_axis(span);
    let mut tick = 0.0;
    while tick <= span * (1.0 + 1e-9) {
        vertical_line(&mut out, "grid", x_of(tick), 4.0..bottom);
        text(&mut out, x_of(tick), bottom + 14.0, "tick mid", &number(tick / scale));
        tick += step;
    }
    let middle = f64::midpoint(X.0, X.1);
    text(&mut out, middle, bottom + 31.0, "axis mid", &format!("time since the first set, {name}"));
    for (i, strip) in strips.iter().enumerate() {
        let top = 4.0 + i as f64 * (STRIP + GAP);
        draw(&mut out, strip, top, time, &x_of, unit, i == 0);
    }
    out.push_str("</svg>");
    out
}

/// Distance of ticks in nanoseconds, nanoseconds per unit, and the unit.
fn time_axis(span_ns: f64) -> (f64, f64, &'static str) {
    let (scale, name) = match span_ns * 1e-9 {
        s if s <= 180.0 => (1e9, "s"),
        s if s <= 10_800.0 => (60e9, "min"),
        _ => (3600e9, "h"),
    };
    (nice_step(span_ns / scale / 9.0) * scale, scale, name)
}

fn draw(
    out: &mut String,
    strip: &Strip,
    top: f64,
    time: Time,
    x_of: &dyn Fn(f64) -> f64,
    unit: &str,
    first: bool,
) {
    let bottom = top + STRIP;
    let (low, high) = strip.y;
    let y_of =
        |v: f64| bottom - ((v - low) / (high - low).max(f64::MIN_POSITIVE)).clamp(0.0, 1.0) * (bottom - top);
    let _ = write!(
        out,
        "<rect class=\"frame\" x=\"{}\" y=\"{top:.1}\" width=\"{}\" height=\"{:.1}\"/>",
        X.0,
        X.1 - X.0,
        bottom - top
    );
    text(out, 150.0, f64::midpoint(top, bottom) + 4.0, "label end", &strip.label);
    let high_text = if first { format!("{} {unit}", number(high)) } else { number(high) };
    text(out, X.0 - 5.0, top + 8.0, "tick end", &high_text);
    text(out, X.0 - 5.0, bottom, "tick end", &number(low));
    text(out, X.1 + 8.0, f64::midpoint(top, bottom) + 4.0, "note", &strip.note);
    if let Some(nominal) = strip.nominal {
        horizontal_line(out, "nominal", X.0..X.1, y_of(nominal));
    }
    match &strip.trace {
        Trace::Steps(bins) => steps(out, bins, time, x_of, &y_of),
        Trace::Points(points) => {
            let at: Vec<_> = points.iter().map(|(t, v)| (x_of(*t as f64), y_of(*v))).collect();
            let joined: Vec<_> = at.iter().map(|(x, y)| format!("{x:.1},{y:.1}")).collect();
            let _ = write!(out, "<polyline class=\"thin\" points=\"{}\"/>", joined.join(" "));
            for (x, y) in at {
                let _ = write!(out, "<circle class=\"dot\" cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"2\"/>");
            }
        }
    }
    for (marks, (y, dy), class) in
        [(&strip.marks[0], (bottom + 1.0, 5.0), "missing"), (&strip.marks[1], (top - 1.0, -5.0), "dropped")]
    {
        let mut path = String::new();
        for bin in marks {
            let x = x_of((*bin as f64 + 0.5) * time.bin_ns as f64);
            let _ = write!(path, "M{x:.1} {y:.1}l-2.5 {dy}h5z");
        }
        if !path.is_empty() {
            let _ = write!(out, "<path class=\"{class}\" d=\"{path}\"/>");
        }
    }
}

/// A line of steps, broken where nothing is known, and the range of each step behind it.
fn steps(
    out: &mut String,
    bins: &[Option<(f64, f64, f64)>],
    time: Time,
    x_of: &dyn Fn(f64) -> f64,
    y_of: &dyn Fn(f64) -> f64,
) {
    let mut line = String::new();
    let mut band = String::new();
    let mut joined = false;
    for (i, bin) in bins.iter().enumerate() {
        let from = x_of(i as f64 * time.bin_ns as f64);
        let to = x_of((i + 1) as f64 * time.bin_ns as f64);
        let Some((low, value, high)) = bin.filter(|_| to > from) else {
            joined = false;
            continue;
        };
        let y = y_of(value);
        let _ =
            if joined { write!(line, "V{y:.1}H{to:.1}") } else { write!(line, "M{from:.1} {y:.1}H{to:.1}") };
        joined = true;
        if high > low {
            let a = y_of(high);
            let b = y_of(low);
            let _ = write!(band, "M{from:.1} {a:.1}H{to:.1}V{b:.1}H{from:.1}z");
        }
    }
    if !band.is_empty() {
        let _ = write!(out, "<path class=\"band\" d=\"{band}\"/>");
    }
    if !line.is_empty() {
        let _ = write!(out, "<path class=\"line\" d=\"{line}\"/>");
    }
}

/// Bars of counts over a value, with values that are marked and named.
pub(super) fn histogram(
    title: &str,
    axis: &str,
    width: f64,
    counts: &[u64],
    marks: &[(f64, String)],
) -> String {
    let x0 = 60.0;
    let x1 = 930.0;
    let top = 14.0 + 13.0 * marks.len() as f64;
    let bottom = 190.0 + 13.0 * marks.len() as f64;
    let mut out = String::new();
    begin(&mut out, bottom + AXIS, title);
    let most = counts.iter().copied().max().unwrap_or(0).max(1);
    let end = (width * counts.len() as f64).max(f64::MIN_POSITIVE);
    let x_of = |v: f64| x0 + (v / end).clamp(0.0, 1.0) * (x1 - x0);
    let step = nice_step(most as f64 / 4.0).max(1.0);
    let high = (most as f64 / step).ceil() * step;
    let y_of = |n: f64| bottom - n / high * (bottom - top);
    let mut n = 0.0;
    while n <= high * (1.0 + 1e-9) {
        horizontal_line(&mut out, "grid", x0..x1, y_of(n));
        text(&mut out, x0 - 5.0, y_of(n) + 4.0, "tick end", &number(n));
        n += step;
    }
    text(&mut out, x0 - 5.0, top - 10.0, "axis end", "sets");
    let step = nice_step(end / 10.0);
    let mut v = 0.0;
    while v <= end * (1.0 + 1e-9) {
        text(&mut out, x_of(v), bottom + 14.0, "tick mid", &number(v));
        v += step;
    }
    text(&mut out, f64::midpoint(x0, x1), bottom + 31.0, "axis mid", axis);
    for (i, n) in counts.iter().enumerate().filter(|(_, n)| **n > 0) {
        let from = x_of(i as f64 * width);
        let to = x_of((i + 1) as f64 * width);
        let y = y_of(*n as f64).min(bottom - 1.0);
        let _ = write!(
            out,
            "<rect class=\"bar\" x=\"{:.1}\" y=\"{y:.1}\" width=\"{:.1}\" height=\"{:.1}\"/>",
            from + 0.5,
            (to - from - 1.0).max(0.5),
            bottom - y
        );
    }
    for (i, (value, name)) in marks.iter().enumerate() {
        let x = x_of(*value);
        let y = 12.0 + 13.0 * i as f64;
        vertical_line(&mut out, "nominal", x, y + 3.0..bottom);
        let (class, dx) = if x > f64::midpoint(x0, x1) { ("tick end", -4.0) } else { ("tick", 4.0) };
        text(&mut out, x + dx, y + 4.0, class, name);
    }
    out.push_str("</svg>");
    out
}

/// Bars with their names and numbers.
pub(super) fn bars(title: &str, rows: &[(String, u64)]) -> String {
    let mut out = String::new();
    let most = rows.iter().map(|(_, n)| *n).max().unwrap_or(0).max(1) as f64;
    begin(&mut out, rows.len() as f64 * 20.0 + 4.0, title);
    for (i, (name, n)) in rows.iter().enumerate() {
        let y = i as f64 * 20.0 + 2.0;
        let length = (*n as f64 / most * 560.0).max(1.0);
        text(&mut out, 292.0, y + 13.0, "label end", name);
        let _ =
            write!(out, "<rect class=\"bar\" x=\"300\" y=\"{y:.1}\" width=\"{length:.1}\" height=\"16\"/>");
        text(&mut out, 306.0 + length, y + 13.0, "tick", &n.to_string());
    }
    out.push_str("</svg>");
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_nice() {
        for (x, nice) in
            [(0.11, 0.2), (1.0, 1.0), (2.3, 2.5), (26.0, 50.0), (99.0, 100.0), (0.0, 1.0), (f64::NAN, 1.0)]
        {
            assert!((nice_step(x) - nice).abs() < 1e-12, "{x}: {}", nice_step(x));
        }
        assert_eq!(
            [0.0, 5.0, 0.25, 33.33, 1500.0, 0.004].map(number),
            ["0", "5", "0.25", "33.3", "1500", "0.004"]
        );
    }

    #[test]
    fn a_line_breaks_where_nothing_is_known() {
        let time = Time { span_ns: 400, bin_ns: 100 };
        let bin = |v| Some((v, v, v));
        let trace = Trace::Steps(vec![bin(1.0), None, bin(2.0), bin(3.0)]);
        let strip = Strip {
            label: "<a>".into(),
            note: String::new(),
            trace,
            y: (0.0, 4.0),
            nominal: Some(2.0),
            marks: [vec![1], vec![]],
        };
        let svg = strips("t", "Hz", time, &[strip]);
        let line = svg.split("class=\"line\" d=\"").nth(1).unwrap().split('"').next().unwrap();
        assert_eq!(line.matches('M').count(), 2, "{line}");
        assert!(svg.contains("&lt;a&gt;") && !svg.contains("<a>"));
        assert_eq!(svg.matches("class=\"missing\"").count(), 1);
        assert!(!svg.contains("class=\"dropped\"") && !svg.contains("NaN"));
    }
}
