//! `depthrig calibrate time`: how late each camera's frames are stamped.

use crate::calibrate::dataset::DatasetOptions;
use crate::calibrate::timed::{self, TimedDataset};
use crate::calibrate::{self, ViewedCamera, known};
use crate::context::Context;
use crate::exit::{Exit, UsageError};
use crate::out;
use crate::outfile::{OutFile, Overwrite};
use crate::progress::Progress;
use crate::signals::Stop;
use anyhow::{Result, bail};
use depthrig_bus::StreamId;
use depthrig_calibrate::board::{Board, Pattern};
use depthrig_calibrate::check::KnownCamera;
use depthrig_calibrate::file::{Calibration, FileLatency};
use depthrig_calibrate::latency::{
    CameraLatency, Latencies, Subtracted, TimedFrame, Total, estimate, totals,
};
use serde::Serialize;
use std::path::PathBuf;
use time::OffsetDateTime;
use time::format_description::well_known::Rfc3339;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
Let the rig run for 15 seconds, then record 20 in which the board is waved to and fro where the cameras see it, with many sets a second:

  [sets]
  rate_hz = 30.0

Stamps of one way are late by a constant that nothing in them shows; the board's motion does. What is found is added to what the recording had
subtracted already, and the fastest camera gets 0. Cameras that are asked for their clock keep what that gives.

Exit codes: 0 found, 1 failure, 2 wrong usage, 3 found, but not for every camera, or a camera has moved.

Examples:
  depthrig calibrate time data/20261126_1030_wave
  depthrig calibrate time data/20261126_1030_wave -o calibration.toml --overwrite
  depthrig calibrate time data/20261126_1030_wave --reference d435 --json";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct TimeArgs {
    /// Dataset that shows the moving board
    dataset: PathBuf,
    /// Description of the board [default: that of the calibration]
    #[arg(long, value_name = "FILE")]
    board: Option<PathBuf>,
    /// Calibration of the mount
    #[arg(long, value_name = "FILE", default_value = "calibration.toml")]
    calibration: PathBuf,
    /// Camera to compare with [default: that of the calibration]
    #[arg(long, value_name = "CAMERA")]
    reference: Option<String>,
    /// Stream of a camera to look at; repeatable [default: color, else left or infrared]
    #[arg(long, value_name = "CAMERA/STREAM")]
    stream: Vec<StreamId>,
    /// Calibration to write, with the latencies; may be --calibration itself [default: none]
    #[arg(short, long, value_name = "FILE")]
    out: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Reads, estimates, prints and writes.
pub fn run(args: &TimeArgs, context: &Context) -> Result<Exit> {
    let mut file = calibrate::calibration(&args.calibration)?;
    let board = match &args.board {
        Some(path) => calibrate::board(path)?,
        None => file.board.clone(),
    };
    let inputs: Vec<_> = args.board.as_deref().into_iter().collect();
    let out = args.out.as_deref().map(|path| OutFile::new(path, args.overwrite, &inputs)).transpose()?;
    let options = DatasetOptions { streams: args.stream.clone(), ..DatasetOptions::default() };
    let mut dataset = timed::open(&args.dataset, &options)?;
    let viewed: Vec<ViewedCamera> = dataset.cameras.iter().map(|c| c.viewed.clone()).collect();
    let places = known::places(&viewed, &file, &args.calibration)?;
    let of_file = known::cameras(&file);
    let cameras: Vec<KnownCamera> = places.iter().map(|place| of_file[*place].clone()).collect();
    let reference = reference(args, &file, &cameras)?;
    let mut frames = sightings(&mut dataset, &board, context)?;
    for frame in &mut frames {
        let known = file.cameras[places[frame.camera]].latency.as_ref();
        frame.uncertainty_s =
            own_uncertainty_s(frame.uncertainty_s, known, &dataset.cameras[frame.camera].subtracted);
    }
    let found =
        estimate(&cameras, reference, &frames).map_err(|e| explained(&e.to_string(), &dataset, &cameras))?;
    let subtracted: Vec<Subtracted> = dataset.cameras.iter().map(|c| c.subtracted).collect();
    let totals = totals(&found.found, &subtracted);
    let report = Report::new(&found, &totals, &dataset, &cameras, reference);
    // Printed first: a file that cannot be written must not cost the result.
    if args.json {
        out::json(&report)?;
    } else {
        out::line(report.text())?;
    }
    if let Some(out) = &out {
        let created = OffsetDateTime::now_utc().replace_nanosecond(0)?.format(&Rfc3339)?;
        for (latency, total) in found.found.iter().zip(&totals) {
            let entry = &mut file.cameras[places[total.camera]];
            entry.latency = (!total.is_measured).then(|| FileLatency {
                latency_ms: rounded_ms(total.latency_s),
                sigma_ms: rounded_ms(latency.sigma_s),
                reference: cameras[reference].name.clone(),
                created: created.clone(),
                dataset: dataset.name().to_owned(),
                board: described(&board),
            });
        }
        out.write(file.to_toml()?.as_bytes())?;
    }
    if !args.json {
        out::line(match &out {
            Some(out) => format!("written   {}", out.path().display()),
            None => format!("not written; `-o {} --overwrite` does", args.calibration.display()),
        })?;
    }
    let lost = !report.refused.is_empty() || report.cameras.iter().any(|c| c.moved);
    Ok(if lost { Exit::Lost } else { Exit::Good })
}

/// Finds the board in all frames.
fn sightings(dataset: &mut TimedDataset, board: &Board, context: &Context) -> Result<Vec<TimedFrame>> {
    let stop = Stop::on_signals()?;
    let mut bar = Progress::new(context.global.quiet > 0);
    let frames = dataset.read(board, |done, total| {
        bar.set("looking for the board", done, total);
        !stop.is_asked()
    })?;
    bar.clear();
    let Some(frames) = frames else { bail!("interrupted; nothing was written") };
    if frames.is_empty() {
        let images: usize = dataset.cameras.iter().map(|c| c.images).sum();
        let untimed: usize = dataset.cameras.iter().map(|c| c.untimed).sum();
        bail!(
            "none of {} shows the board as it is described{}",
            out::count(images, "image"),
            unused(untimed)
        );
    }
    Ok(frames)
}

/// Says that frames were not used.
fn unused(untimed: usize) -> String {
    match untimed {
        0 => String::new(),
        n => format!(
            "; {} of the time in which its clock map was not settled not used: let the rig run for 15 s first, or record longer",
            out::count(n, "image")
        ),
    }
}

/// An estimate's error, with what was not used of each camera.
fn explained(why: &str, read: &TimedDataset, cameras: &[KnownCamera]) -> anyhow::Error {
    let mut lines = vec![why.to_owned()];
    for (camera, known) in read.cameras.iter().zip(cameras).filter(|(c, _)| c.untimed > 0) {
        lines.push(format!("camera {}: {}", known.name, unused(camera.untimed).trim_start_matches("; ")));
    }
    anyhow::anyhow!(lines.join("\n"))
}

/// Index of the camera to compare with.
fn reference(args: &TimeArgs, file: &Calibration, cameras: &[KnownCamera]) -> Result<usize> {
    let named = |name: &str| cameras.iter().position(|c| c.name == name);
    let Some(name) = &args.reference else { return Ok(named(&file.reference).unwrap_or(0)) };
    named(name).ok_or_else(|| {
        let all: Vec<&str> = cameras.iter().map(|c| c.name.as_str()).collect();
        UsageError(format!("no camera {name}; there are {}", all.join(", "))).into()
    })
}

/// The uncertainty of a stamp without that of the calibrated latency in it, which is replaced now.
fn own_uncertainty_s(stated_s: f64, known: Option<&FileLatency>, subtracted: &Subtracted) -> f64 {
    let is_applied = !subtracted.is_measured && subtracted.latency_s > 0.0;
    let of_latency_s = known.filter(|_| is_applied).map_or(0.0, |l| l.bound_ns() as f64 * 1e-9);
    (stated_s - of_latency_s / timed::CLAIMED_SIGMAS).max(0.0)
}

/// Milliseconds to the microsecond.
fn rounded_ms(seconds: f64) -> f64 {
    (seconds * 1e6).round() / 1e3
}

/// A board in words.
fn described(board: &Board) -> String {
    let pattern = match board.pattern {
        Pattern::Charuco => "charuco",
        Pattern::Chessboard => "chessboard",
        Pattern::Aprilgrid => "aprilgrid",
    };
    format!("{pattern} {}x{}, {} mm", board.columns, board.rows, board.square_mm)
}

/// The printed result.
#[derive(Serialize)]
struct Report<'a> {
    reference: &'a str,
    cameras: Vec<Line<'a>>,
    refused: Vec<Refusal<'a>>,
    /// Time that the board's trajectory covers, seconds.
    covered_s: f64,
    /// Time between its knots, seconds.
    knot_s: f64,
    /// Standard deviation of a corner's coordinate against the trajectory, pixels.
    sigma_px: f64,
    /// The same in single images.
    single_px: f64,
}

#[derive(Serialize)]
struct Line<'a> {
    camera: &'a str,
    /// How much later than the reference's its stamps are in the dataset.
    found_ms: f64,
    sigma_ms: f64,
    /// Latency that the dataset's stamps are free of.
    subtracted_ms: f64,
    /// Latency to subtract in all.
    latency_ms: f64,
    /// The device was asked for its clock; nothing is written for it.
    measured: bool,
    below_zero_ms: f64,
    images: usize,
    corners: usize,
    speed_px_s: f64,
    sigma_px: f64,
    /// Distance from where it was calibrated to stand.
    displaced_mm: Option<f64>,
    displaced_deg: Option<f64>,
    /// The same in standard deviations of six coordinates, squared.
    chi_squared: Option<f64>,
    moved: bool,
}

#[derive(Serialize)]
struct Refusal<'a> {
    camera: &'a str,
    why: String,
}

impl<'a> Report<'a> {
    fn new(
        found: &Latencies,
        totals: &[Total],
        read: &TimedDataset,
        cameras: &'a [KnownCamera],
        reference: usize,
    ) -> Self {
        let line = |(latency, total): (&CameraLatency, &Total)| Line {
            camera: &cameras[latency.camera].name,
            found_ms: latency.latency_s * 1e3,
            sigma_ms: latency.sigma_s * 1e3,
            subtracted_ms: read.cameras[latency.camera].subtracted.latency_s * 1e3,
            latency_ms: total.latency_s * 1e3,
            measured: total.is_measured,
            below_zero_ms: total.below_zero_s * 1e3,
            images: latency.frames,
            corners: latency.corners,
            speed_px_s: latency.speed_px_s,
            sigma_px: latency.sigma_px,
            displaced_mm: latency.displaced.map(|d| d.by.metres * 1e3),
            displaced_deg: latency.displaced.map(|d| d.by.radians.to_degrees()),
            chi_squared: latency.displaced.map(|d| d.chi_squared),
            moved: latency.has_moved(),
        };
        Self {
            reference: &cameras[reference].name,
            cameras: found.found.iter().zip(totals).map(line).collect(),
            refused: found
                .refused
                .iter()
                .map(|r| Refusal {
                    camera: &cameras[r.camera].name,
                    why: r.why.clone() + &unused(read.cameras[r.camera].untimed),
                })
                .collect(),
            covered_s: found.covered_s,
            knot_s: found.knot_s,
            sigma_px: found.sigma_px,
            single_px: found.single_px,
        }
    }

    fn text(&self) -> String {
        let header = [
            "CAMERA",
            "",
            "FOUND ms",
            "± ms",
            "SUBTRACTED ms",
            "LATENCY ms",
            "IMAGES",
            "SPEED px/s",
            "RESIDUAL px",
        ];
        let rows = self.cameras.iter().map(|l| {
            let state = match l {
                _ if l.camera == self.reference => "reference",
                _ if l.moved => "has moved",
                _ if l.measured => "measured by its clock",
                _ => "found",
            };
            vec![
                l.camera.to_owned(),
                state.to_owned(),
                format!("{:+.2}", l.found_ms),
                format!("{:.2}", l.sigma_ms),
                format!("{:.2}", l.subtracted_ms),
                format!("{:.2}", l.latency_ms),
                l.images.to_string(),
                format!("{:.0}", l.speed_px_s),
                format!("{:.2}", l.sigma_px),
            ]
        });
        let mut lines = vec![out::table(&header, 2, rows)];
        for line in self.cameras.iter().filter(|l| l.moved) {
            lines.push(format!(
                "moved     {} stands {:.1} mm and {:.2} degrees from where it was calibrated; its latency may be wrong: `depthrig calibrate check`",
                line.camera,
                line.displaced_mm.unwrap_or(0.0),
                line.displaced_deg.unwrap_or(0.0)
            ));
        }
        for line in self.cameras.iter().filter(|l| l.below_zero_ms > 3.0 * l.sigma_ms) {
            lines.push(format!(
                "early     {} is {:.1} ms earlier than the cameras that are asked for their clock, which cannot be; 0 is used",
                line.camera, line.below_zero_ms
            ));
        }
        for refusal in &self.refused {
            lines.push(format!("refused   {}: {}", refusal.camera, refusal.why));
        }
        lines.join("\n")
    }
}
