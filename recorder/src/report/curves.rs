//! Plots with several series side by side: curves over a value, and bars by class. Each series has a colour, a dash and
//! its name, so that nothing depends on colour alone.

use super::markup::escape;
use super::svg::{begin, horizontal_line, nice_step, number, text, vertical_line};
use std::fmt::Write;

/// One series of values, one per place on the axis; `None` where nothing is known.
#[derive(Debug, Clone, PartialEq)]
pub struct Series {
    /// Its name in the legend.
    pub name: String,
    /// Its values.
    pub values: Vec<Option<f64>>,
}

/// Distinct styles of series; further series repeat them.
const LOOKS: usize = 6;
/// Left, right, top and bottom of a plot.
const FRAME: (f64, f64, f64, f64) = (64.0, 940.0, 34.0, 250.0);
/// Space below a plot for its axis.
const AXIS: f64 = 40.0;

/// Curves of `series` over `x`, which rises. The axis of values begins at 0.
pub fn curves(title: &str, x_axis: &str, y_axis: &str, x: &[f64], series: &[Series]) -> String {
    let (left, right, _, bottom) = FRAME;
    let mut out = String::new();
    begin(&mut out, bottom + AXIS, title);
    let y_of = frame(&mut out, y_axis, series);
    let low = x.first().copied().unwrap_or(0.0);
    let high = x.last().copied().unwrap_or(1.0);
    let span = (high - low).max(f64::MIN_POSITIVE);
    let x_of = |v: f64| left + (v - low) / span * (right - left);
    let step = nice_step(span / 10.0);
    let mut tick = (low / step).ceil() * step;
    while tick <= high * (1.0 + 1e-9) {
        vertical_line(&mut out, "grid", x_of(tick), bottom..bottom + 4.0);
        text(&mut out, x_of(tick), bottom + 16.0, "tick mid", &number(tick));
        tick += step;
    }
    text(&mut out, f64::midpoint(left, right), bottom + 33.0, "axis mid", x_axis);
    for (k, one) in series.iter().enumerate() {
        let mut path = String::new();
        let mut joined = false;
        for (v, x) in one.values.iter().zip(x) {
            let Some(v) = v.filter(|v| v.is_finite()) else {
                joined = false;
                continue;
            };
            let _ = write!(path, "{}{:.1} {:.1}", if joined { 'L' } else { 'M' }, x_of(*x), y_of(v));
            let _ = write!(
                out,
                "<circle class=\"s{}\" cx=\"{:.1}\" cy=\"{:.1}\" r=\"2\"/>",
                k % LOOKS,
                x_of(*x),
                y_of(v)
            );
            joined = true;
        }
        if !path.is_empty() {
            let _ = write!(out, "<path class=\"curve s{}\" d=\"{path}\"/>", k % LOOKS);
        }
    }
    out.push_str("</svg>");
    out
}

/// Bars of `series`, side by side in each of `classes`.
pub fn bars(title: &str, x_axis: &str, y_axis: &str, classes: &[String], series: &[Series]) -> String {
    let (left, right, _, bottom) = FRAME;
    let mut out = String::new();
    begin(&mut out, bottom + AXIS, title);
    let y_of = frame(&mut out, y_axis, series);
    let width = (right - left) / classes.len().max(1) as f64;
    let bar = width * 0.84 / series.len().max(1) as f64;
    for (i, class) in classes.iter().enumerate() {
        let from = left + i as f64 * width;
        text(&mut out, from + width / 2.0, bottom + 16.0, "tick mid", class);
        for (k, one) in series.iter().enumerate() {
            let Some(v) = one.values.get(i).copied().flatten().filter(|v| *v > 0.0) else { continue };
            let x = from + width * 0.08 + k as f64 * bar;
            let y = y_of(v).min(bottom - 0.5);
            let w = (bar - 1.0).max(0.5);
            let h = bottom - y;
            let _ = write!(
                out,
                "<rect class=\"s{}\" x=\"{x:.1}\" y=\"{y:.1}\" width=\"{w:.1}\" height=\"{h:.1}\"><title>{}, {}: {}</title></rect>",
                k % LOOKS,
                escape(&one.name),
                escape(class),
                number(v)
            );
        }
    }
    text(&mut out, f64::midpoint(left, right), bottom + 33.0, "axis mid", x_axis);
    out.push_str("</svg>");
    out
}

/// Draws the axis of values with its grid and the names of the series; returns the position of a value.
fn frame(out: &mut String, y_axis: &str, series: &[Series]) -> impl Fn(f64) -> f64 + use<> {
    let (left, right, top, bottom) = FRAME;
    let most = series
        .iter()
        .flat_map(|s| &s.values)
        .flatten()
        .copied()
        .filter(|v| v.is_finite())
        .fold(0.0, f64::max);
    let step = nice_step(most / 5.0);
    let high = (most / step).ceil().max(1.0) * step;
    let y_of = move |v: f64| bottom - (v / high).clamp(0.0, 1.0) * (bottom - top);
    let mut v = 0.0;
    while v <= high * (1.0 + 1e-9) {
        horizontal_line(out, "grid", left..right, y_of(v));
        text(out, left - 6.0, y_of(v) + 4.0, "tick end", &number(v));
        v += step;
    }
    text(out, left - 52.0, top - 22.0, "axis", y_axis);
    let mut x = left + 150.0;
    let mut y = 8.0;
    for (k, one) in series.iter().enumerate() {
        let k = k % LOOKS;
        let width = 60.0 + 7.0 * one.name.chars().count() as f64;
        // Two lines of names fit above the plot.
        if x + width > right + 20.0 && y < 20.0 {
            x = left + 150.0;
            y += 14.0;
        }
        let _ = write!(
            out,
            "<line class=\"curve s{k}\" x1=\"{x:.0}\" x2=\"{:.0}\" y1=\"{y:.0}\" y2=\"{y:.0}\"/><rect class=\"s{k}\" x=\"{:.0}\" \
             y=\"{:.0}\" width=\"8\" height=\"8\"/>",
            x + 26.0,
            x + 9.0,
            y - 4.0
        );
        text(out, x + 32.0, y + 4.0, "label", &one.name);
        x += width;
    }
    y_of
}

#[cfg(test)]
mod tests {
    use super::*;

    fn series() -> Vec<Series> {
        vec![
            Series { name: "<raw>".into(), values: vec![Some(1.0), None, Some(3.0), Some(f64::NAN)] },
            Series { name: "fill".into(), values: vec![Some(0.5), Some(0.6), Some(0.7), Some(0.0)] },
        ]
    }

    #[test]
    fn curves_break_where_nothing_is_known() {
        let svg = curves("t", "m", "L1", &[0.0, 1.0, 2.0, 3.0], &series());
        let path = |k: usize| {
            svg.split(&format!("curve s{k}\" d=\"")).nth(1).unwrap().split('"').next().unwrap().to_owned()
        };
        assert_eq!((path(0).matches('M').count(), path(0).matches('L').count()), (2, 0));
        assert_eq!((path(1).matches('M').count(), path(1).matches('L').count()), (1, 3));
        assert!(svg.contains("&lt;raw&gt;") && !svg.contains("<raw>") && !svg.contains("NaN"));
        // Twice the value is twice as high.
        let y = |text: &str, i: usize| {
            text.split(['M', 'L']).nth(i).unwrap().split(' ').nth(1).unwrap().parse::<f64>().unwrap()
        };
        let height = |v: f64| FRAME.3 - v;
        assert!((height(y(&path(0), 1)) - 2.0 * height(y(&path(1), 1))).abs() < 0.2);
    }

    #[test]
    fn bars_leave_out_what_is_nothing() {
        let classes = ["a", "b", "c", "d"].map(String::from);
        let svg = bars("t", "x", "%", &classes, &series());
        assert_eq!(svg.matches("<title>").count(), 1 + 2 + 3, "the plot's own, and one of each bar");
        assert!(svg.contains("fill, c: 0.7"));
        assert!(!bars("t", "x", "%", &[], &[]).contains("NaN"));
    }
}
