//! `depthrig cat`: lists frames of a dataset or writes them as image files.

use crate::calibrate::corrected::Corrected;
use crate::context::Context;
use crate::exit::{Exit, UsageError};
use crate::out;
use crate::progress::Progress;
use crate::signals::Stop;
use anyhow::Result;
use clap::ValueEnum;
use core::ops::ControlFlow;
use depthrig_bus::StreamId;
use depthrig_recorder::fs::RealFs;
use depthrig_recorder::{
    Dataset, Edge, FrameChoice, FrameRow, FramesDone, Moment, SampleForm, SetChoice, SetSpan, StillFormat,
    export_frames, export_samples, list_frames, list_samples, sampled,
};
use std::path::PathBuf;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
Without --out the frames are listed, one per line; with --json as one object per frame with all header fields.
With --out DIR each frame becomes a file DIR/CAM/STREAM/SET.png (.npy, .jpg), and DIR/frames.csv lists set,
times, counters and depth unit of each. DIR is new or empty; a list named frames.csv.part is unfinished.

A time T is a number of seconds after the first set, or a date and time such as 2026-11-21T10:15:03.2Z.
PNG has 8 or 16 bits; depth is in the camera's units (multiply by depth_unit_m of frames.csv for metres; 0 is
no depth). NPY is the array as published on the channel. Without --format each stream becomes PNG, or NPY
where PNG would lose bits (depth_f32, yuyv, uyvy, nv12).

An IMU (--stream zed2i/imu) has samples instead of images: without --out they are printed as CSV (--json: one object
each), with --out DIR they are written to DIR/CAM/imu.csv, or with --format npy to .npy as a record array. Columns: the
set they belong to, UTC, host monotonic time, device time, number, uncertainty, angular velocity in rad/s, acceleration
in m/s2, temperature and flags; a missing value is empty (NaN in NPY).

A signal of a robot (--stream arm/joint_position) is written in the same way. Columns: set, UTC, host monotonic time,
time of publishing, publisher, number, uncertainty, flags, then each field by its name. A text needs CSV or JSON.

Exit codes: 0 success, 1 failure, 2 wrong usage, 3 written, but some frames of the dataset could not be read.

Examples:
  depthrig cat data/20261121_1015_kitchen | head
  depthrig cat data/20261121_1015_kitchen --at 12.5 --out shot
  depthrig cat data/20261121_1015_kitchen --stream d435/depth --from 10 --to 20 --every 5 --format npy --out d
  depthrig cat data/20261121_1015_kitchen --set 17 --stream d435/color --format jpg --out as_stored
  depthrig cat data/20261121_1015_kitchen --stream zed2i/imu > imu.csv";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct CatArgs {
    /// Dataset folder, or one segment file
    dataset: PathBuf,
    /// Only this stream, IMU or signal; repeatable
    #[arg(long = "stream", value_name = "CAM/STREAM")]
    streams: Vec<StreamId>,
    /// Only the set with this id
    #[arg(long, value_name = "ID", conflicts_with_all = ["from", "to", "at"])]
    set: Option<u64>,
    /// Only the set nearest to this time
    #[arg(long, value_name = "T", conflicts_with_all = ["from", "to"])]
    at: Option<Moment>,
    /// Only sets from this time on
    #[arg(long, value_name = "T")]
    from: Option<Moment>,
    /// Only sets up to this time
    #[arg(long, value_name = "T")]
    to: Option<Moment>,
    /// Only every Nth set
    #[arg(long, value_name = "N", default_value = "1", value_parser = clap::value_parser!(u32).range(1..))]
    every: u32,
    /// Format of the image files [default: png, or npy where PNG would lose bits]
    #[arg(long, value_enum, requires = "out")]
    format: Option<Form>,
    /// New folder for the image files
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    #[command(flatten)]
    corrected: Corrected,
    /// Print JSON; without --out one object per frame and line
    #[arg(long)]
    json: bool,
}

/// Format of the image files.
#[derive(Debug, Clone, Copy, ValueEnum)]
enum Form {
    /// PNG of 8 or 16 bits
    Png,
    /// NumPy array
    Npy,
    /// The stored JPEG, byte for byte
    Jpg,
}

/// Lists or writes frames.
pub fn run(args: &CatArgs, context: &Context) -> Result<Exit> {
    if args.corrected.is_asked() && args.out.is_none() {
        return Err(UsageError("--corrected is for images; write them with --out DIR".into()).into());
    }
    let dataset = args.corrected.of(Dataset::open(&args.dataset)?)?;
    let sets = match (args.set, args.at) {
        (Some(id), _) => SetChoice::Id(id),
        (_, Some(moment)) => SetChoice::Nearest(moment),
        _ => SetChoice::Span(SetSpan { from: args.from.map(Edge::Moment), to: args.to.map(Edge::Moment) }),
    };
    let choice = FrameChoice { sets, every: args.every as usize, streams: args.streams.clone() };
    let units = sampled(dataset.session());
    let units: Vec<_> = units.filter(|id| args.streams.contains(id)).cloned().collect();
    if !units.is_empty() && args.streams.iter().all(|s| units.contains(s)) {
        return samples(args, &dataset, &units, sets);
    }
    let done = match &args.out {
        None => list(args, &dataset, &choice)?,
        Some(_) => export(args, context, &dataset, &choice)?,
    };
    for problem in &done.problems {
        out::note(format_args!("lost: {problem}"));
    }
    Ok(match done {
        _ if done.ended => Exit::Failed,
        _ if done.lost > 0 => Exit::Lost,
        _ => Exit::Good,
    })
}

/// Lists or writes samples of IMUs and signals.
fn samples(args: &CatArgs, dataset: &Dataset, units: &[StreamId], sets: SetChoice) -> Result<Exit> {
    let form = match args.format {
        None => SampleForm::Csv,
        Some(Form::Npy) => SampleForm::Npy,
        Some(Form::Png | Form::Jpg) => {
            return Err(
                UsageError(format!("{} has no images; leave out --format or say npy", units[0])).into()
            );
        }
    };
    if args.every > 1 {
        return Err(UsageError("--every chooses images; samples are listed whole".into()).into());
    }
    let done = if let Some(dir) = &args.out {
        let stop = Stop::on_signals()?;
        let mut go = |_| if stop.is_asked() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) };
        let done = export_samples(&RealFs, dataset, units, sets, form, dir, &mut go).map_err(usage)?;
        if args.json {
            out::json(&done)?;
        } else {
            let samples = out::count(done.frames, "sample");
            let bytes = out::bytes(done.bytes);
            out::line(format_args!("{}: {samples}, {bytes}", dir.display()))?;
        }
        done
    } else {
        let [unit] = units else {
            let what = "one IMU or signal at a time is listed; name a folder with --out";
            return Err(UsageError(what.into()).into());
        };
        list_rows(args, dataset, unit, sets)?
    };
    for problem in &done.problems {
        out::note(format_args!("lost: {problem}"));
    }
    Ok(match done {
        _ if done.ended => Exit::Failed,
        _ if done.lost > 0 => Exit::Lost,
        _ => Exit::Good,
    })
}

fn list_rows(args: &CatArgs, dataset: &Dataset, unit: &StreamId, sets: SetChoice) -> Result<FramesDone> {
    let mut failed = None;
    let mut head_failed = None;
    let mut head = |line| {
        if !args.json {
            head_failed = out::line(line).err();
        }
    };
    let done = list_samples(dataset, unit, sets, &mut head, &mut |row| {
        let written = if args.json { out::json_line(&row) } else { out::line(row.csv()) };
        match written {
            Ok(()) => ControlFlow::Continue(()),
            Err(e) => {
                failed = Some(e);
                ControlFlow::Break(())
            }
        }
    })
    .map_err(usage)?;
    head_failed.or(failed).map_or(Ok(done), Err)
}

fn list(args: &CatArgs, dataset: &Dataset, choice: &FrameChoice) -> Result<FramesDone> {
    if !args.json {
        out::line(columns(
            "set",
            "stream",
            "captured (UTC)",
            "device frame",
            "after tick",
            "image",
            "stored",
        ))?;
    }
    let mut failed = None;
    let done = list_frames(dataset, choice, &mut |row| {
        let written = if args.json { out::json_line(&row) } else { out::line(text(&row)) };
        match written {
            Ok(()) => ControlFlow::Continue(()),
            Err(e) => {
                failed = Some(e);
                ControlFlow::Break(())
            }
        }
    })
    .map_err(usage)?;
    failed.map_or(Ok(done), Err)
}

/// A table row. Widths are fixed, so that rows are printed before all of them are known.
fn text(row: &FrameRow) -> String {
    let late_ms = (row.capture_time_ns - row.tick_ns) as f64 / 1e6;
    columns(
        &row.set.to_string(),
        &row.stream,
        &utc_ms(row.capture_utc_ns),
        &row.device_sequence.to_string(),
        &format!("{late_ms:+.3} ms"),
        &format!("{}x{} {}", row.width, row.height, row.format),
        &format!("{} {}", row.codec, out::bytes(row.stored_bytes)),
    )
}

/// `2026-08-21 14:05:09.250`.
fn utc_ms(ns: i64) -> String {
    let whole = depthrig_recorder::utc_text(ns);
    format!("{}.{:03}", whole.trim_end_matches(" UTC"), ns.rem_euclid(1_000_000_000) / 1_000_000)
}

fn columns(
    set: &str,
    stream: &str,
    time: &str,
    frame: &str,
    offset: &str,
    image: &str,
    stored: &str,
) -> String {
    format!("{set:>7}  {stream:<20}  {time:<23}  {frame:>12}  {offset:>11}  {image:<21}  {stored}")
}

fn export(args: &CatArgs, context: &Context, dataset: &Dataset, choice: &FrameChoice) -> Result<FramesDone> {
    let Some(dir) = &args.out else { return Ok(FramesDone::default()) };
    let form = args.format.map(|form| match form {
        Form::Png => StillFormat::Png,
        Form::Npy => StillFormat::Npy,
        Form::Jpg => StillFormat::Jpeg,
    });
    let stop = Stop::on_signals()?;
    let mut bar = Progress::new(context.global.quiet > 0);
    let done = export_frames(&RealFs, dataset, choice, form, dir, &mut |n, total| {
        bar.set("cat", n, total);
        if stop.is_asked() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    })
    .map_err(usage)?;
    bar.clear();
    if args.json {
        out::json(&done)?;
    } else {
        let ended =
            if done.ended { " (ended before all were written; frames.csv.part lists them)" } else { "" };
        out::line(format_args!(
            "{}: {} of {}, {}{ended}",
            dir.display(),
            out::count(done.frames, "frame"),
            out::count(done.sets, "set"),
            out::bytes(done.bytes)
        ))?;
    }
    Ok(done)
}

/// Turns an error about the input into a usage error (exit code 2).
fn usage(e: depthrig_recorder::Error) -> anyhow::Error {
    use depthrig_recorder::ErrorKind;
    match e.kind() {
        ErrorKind::BadInput => UsageError(e.to_string()).into(),
        _ => e.into(),
    }
}
