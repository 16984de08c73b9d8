//! `depthrig compare`: compares two datasets.

use crate::context::Context;
use crate::exit::Exit;
use crate::out;
use crate::printable;
use crate::progress::Progress;
use crate::signals::Stop;
use anyhow::{Result, bail};
use clap::ValueEnum;
use core::ops::ControlFlow;
use depthrig_recorder::{
    CompareOptions, Comparison, Dataset, Difference, PixelCheck, PixelDifference, compare_with,
};
use std::path::PathBuf;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
Sets are matched by tick and streams by name; segments, packing and the order within a set are ignored. So are
the fields that a replay changes: sequence, captured, set ids, the flag `replayed`, the offset to UTC; --strict
compares these as well.

Exit codes: 0 equal, 1 different (or a dataset cannot be opened), 2 wrong usage.

Examples:
  depthrig compare data/20261121_1015_kitchen data/replayed
  depthrig compare before after --strict --pixels stored
  depthrig compare a b --json | jq .pixel_differences";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct CompareArgs {
    /// First dataset folder or segment file
    a: PathBuf,
    /// Second dataset folder or segment file
    b: PathBuf,
    /// Comparison of pixels
    #[arg(long, value_enum, default_value = "exact", value_name = "HOW")]
    pixels: Pixels,
    /// Also compare the fields that a replay changes
    #[arg(long)]
    strict: bool,
    /// Number of differences to list
    #[arg(long, value_name = "N", default_value = "20")]
    list: usize,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Comparison of pixels.
#[derive(Debug, Clone, Copy, ValueEnum)]
enum Pixels {
    /// Decoded, bit by bit
    Exact,
    /// As stored: codec and bytes
    Stored,
    /// Not compared; no image is read
    None,
}

/// Compares and reports.
pub fn run(args: &CompareArgs, context: &Context) -> Result<Exit> {
    let a = Dataset::open(&args.a)?;
    let b = Dataset::open(&args.b)?;
    let pixels = match args.pixels {
        Pixels::Exact => PixelCheck::Exact,
        Pixels::Stored => PixelCheck::Stored,
        Pixels::None => PixelCheck::None,
    };
    let options = CompareOptions { pixels, strict: args.strict, listed: args.list };
    let stop = Stop::on_signals()?;
    let mut bar = Progress::new(context.global.quiet > 0);
    let total =
        [&a, &b].map(|d| d.session().outcome.as_ref().map_or(0, |o| o.sets_recorded)).into_iter().max();
    let comparison = compare_with(&a, &b, &options, &mut |p| {
        if let Some(total) = total.filter(|total| *total >= p.sets) {
            bar.set("compare", p.sets, total);
        }
        if stop.is_asked() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    })?;
    bar.clear();
    if stop.is_asked() {
        bail!("interrupted after comparing {} sets", comparison.sets);
    }
    if args.json {
        out::json(&comparison)?;
    } else {
        out::line(text(&comparison))?;
    }
    Ok(if comparison.equal { Exit::Good } else { Exit::Failed })
}

/// Describes the comparison as text.
fn text(c: &Comparison) -> String {
    let pixels = match c.pixels {
        PixelCheck::Exact => "pixels bit by bit",
        PixelCheck::Stored => "pixels as stored",
        PixelCheck::None => "pixels not compared",
    };
    let verdict = if c.equal { "equal" } else { "DIFFERENT" };
    let mut lines = vec![format!(
        "{verdict}: {} sets and {} frames are in both ({pixels}); {} sets in {}, {} in {}",
        c.sets,
        c.frames,
        c.sets_a,
        printable::path(&c.a),
        c.sets_b,
        printable::path(&c.b)
    )];
    if c.equal {
        return lines.remove(0);
    }
    lines.push(String::new());
    let or_set = |stream: &str| if stream.is_empty() { "(sets)".to_owned() } else { stream.to_owned() };
    lines.push(out::table(
        &["stream", "differs in", "times"],
        2,
        c.counts.iter().map(|n| vec![or_set(&n.stream), n.field.clone(), n.count.to_string()]),
    ));
    if !c.pixel_differences.is_empty() {
        lines.push(String::new());
        lines.push(out::table(
            &["pixels of", "frames", "samples differ", "max", "mean", "PSNR dB"],
            1,
            c.pixel_differences.iter().map(row),
        ));
    }
    lines.push(String::new());
    lines.extend(c.differences.iter().map(line));
    let total: u64 = c.counts.iter().map(|n| n.count).sum();
    let left = total - c.differences.len() as u64;
    if left > 0 {
        lines.push(format!("… and {left} more (--list N shows more)"));
    }
    lines.join("\n")
}

fn row(p: &PixelDifference) -> Vec<String> {
    let share = 100.0 * p.samples_differing as f64 / p.samples.max(1) as f64;
    vec![
        p.stream.clone(),
        p.frames_differing.to_string(),
        format!("{share:.2} %"),
        p.max_abs.to_string(),
        format!("{:.4}", p.mean_abs),
        p.psnr_db.map_or_else(|| "-".to_owned(), |db| format!("{db:.1}")),
    ]
}

fn line(d: &Difference) -> String {
    let set = match (d.set_a, d.set_b) {
        (Some(a), Some(b)) if a != b => format!("set {a}/{b} "),
        (Some(n), _) | (None, Some(n)) => format!("set {n} "),
        (None, None) => String::new(),
    };
    let stream = if d.stream.is_empty() { String::new() } else { format!("{} ", d.stream) };
    printable::line(&format!("{set}{stream}{}: {} | {}", d.field, d.a, d.b))
}
