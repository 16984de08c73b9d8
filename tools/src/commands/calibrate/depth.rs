//! `depthrig calibrate depth`: the error of depth on a wall, and its correction.

use crate::calibrate;
use crate::calibrate::baseline::{self, Given};
use crate::calibrate::wall::{self, Place, PlaceDepth, Wall, WallCamera};
use crate::context::Context;
use crate::exit::{Exit, UsageError};
use crate::out;
use crate::outfile::{OutFile, Overwrite};
use crate::progress::Progress;
use crate::signals::Stop;
use anyhow::{Result, bail};
use depthrig_bus::{Distortion, Intrinsics, StreamId};
use depthrig_calibrate::board::Board;
use depthrig_calibrate::depth::{
    Choice, MIN_DISTANCES, Measured, Observation, PlaneMeter, choose, distinct, plane_sigma_m,
};
use depthrig_calibrate::file::{Calibration, DepthCorrection, DepthPlace, FORMAT};
use depthrig_calibrate::intrinsics::ImageSize;
use depthrig_calibrate::mount::Source;
use depthrig_calibrate::{Rigid, board_pose};
use depthrig_recorder::{Dataset, StreamRecord};
use glam::DVec3;
use serde::Serialize;
use std::path::PathBuf;
use time::OffsetDateTime;
use time::format_description::well_known::Rfc3339;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
Put the board flat on a wall and record it from five distances or more, nearest to farthest as the camera is used, facing the wall, at rest for a
second at each. The truth is the board's plane from its corners; calibrate intrinsics first. Depth is measured on the board alone.

The correction goes into the calibration as [[depth]]. It never changes what is recorded or published: `depthrig cloud --corrected` and
others apply it where they are asked to.

Exit codes: 0 measured, 1 failure, 2 wrong usage, 3 measured, but places or streams were left out (the output says which).

Examples:
  depthrig calibrate depth data/20261126_1000_wall --board board.toml
  depthrig calibrate depth data/20261126_1000_wall --calibration calibration.toml --out calibration.toml --overwrite
  depthrig calibrate depth data/20261126_1000_wall --stream d435/depth --baseline-mm d435=50 --json";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct DepthArgs {
    /// Dataset that shows the board on a wall
    dataset: PathBuf,
    /// Description of the board
    #[arg(long, value_name = "FILE", default_value = "board.toml")]
    board: PathBuf,
    /// Calibration with the intrinsics to use, and whose entries are kept
    #[arg(long, value_name = "FILE")]
    calibration: Option<PathBuf>,
    /// Stream to look at or depth stream to measure; repeatable [default: all]
    #[arg(long, value_name = "CAMERA/STREAM")]
    stream: Vec<StreamId>,
    /// Baseline of a stereo camera; repeatable [default: as recorded or of the model]
    #[arg(long, value_name = "CAMERA=MM", value_parser = baseline::given)]
    baseline_mm: Vec<Given>,
    /// Calibration to write
    #[arg(short, long, value_name = "FILE", default_value = "calibration.toml")]
    out: PathBuf,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Print JSON instead of the tables
    #[arg(long)]
    json: bool,
}

/// A board tilted more than this against the optical axis is left out: its plane's depth hangs on the tilt then.
const MAX_TILT_DEG: f64 = 25.0;
/// A place with less depth than this is left out.
const MIN_FILL: f64 = 0.5;

/// Reads, measures, chooses and writes.
pub fn run(args: &DepthArgs, context: &Context) -> Result<Exit> {
    let board = calibrate::board(&args.board)?;
    let dataset = Dataset::open(&args.dataset)?;
    let known = args.calibration.as_deref().map(calibrate::calibration).transpose()?;
    check_out(args)?;
    let file = OutFile::new(&args.out, args.overwrite, &[args.board.as_path()])?;
    let wall = read(args, &dataset, &board, context)?;
    if wall.cameras.iter().all(|c| c.seen == 0) {
        bail!(
            "none of {} images shows the board of {}; light it, hold the camera nearer, and compare the board's file with the print",
            wall.images,
            args.board.display()
        );
    }
    let created = OffsetDateTime::now_utc().replace_nanosecond(0)?.format(&Rfc3339)?;
    let mut report = Report { streams: Vec::new(), left_out: Vec::new() };
    for camera in &wall.cameras {
        for (number, stream) in camera.depth.iter().enumerate() {
            let records = &dataset.session().streams;
            let measure = Measure {
                camera,
                number,
                look: &records[camera.look],
                record: &records[*stream],
                baseline_m: baseline::of_camera(
                    records,
                    &camera.name,
                    &records[*stream].model,
                    &args.baseline_mm,
                ),
                known: known.as_ref(),
            };
            match measure.stream(&created, &mut report.left_out) {
                Ok(line) => report.streams.push(line),
                Err(e) => report.left_out.push(format!("{}: {e:#}", records[*stream].id)),
            }
        }
    }
    if report.streams.is_empty() {
        bail!("no depth was calibrated; {}", report.left_out.join("; "));
    }
    let mut calibration = known.unwrap_or_else(|| Calibration {
        format: FORMAT.to_owned(),
        created,
        by: None,
        reference: String::new(),
        rms_px: 0.0,
        board,
        cameras: Vec::new(),
        depth: Vec::new(),
    });
    for line in &report.streams {
        let new = &line.correction;
        calibration.depth.retain(|d| d.camera != new.camera || d.stream != new.stream);
        calibration.depth.push(new.clone());
    }
    file.write(calibration.to_toml()?.as_bytes())?;
    if args.json {
        out::json(&report)?;
    } else {
        out::line(report.text())?;
        out::line(format_args!("written   {}", file.path().display()))?;
    }
    Ok(if report.left_out.is_empty() { Exit::Good } else { Exit::Lost })
}

/// Refuses to replace a calibration whose entries would be lost.
fn check_out(args: &DepthArgs) -> Result<()> {
    let is_known = args.calibration.as_ref().is_some_and(|known| {
        known.canonicalize().ok().is_some_and(|known| args.out.canonicalize().is_ok_and(|out| out == known))
    });
    if args.overwrite.overwrite && !is_known && calibrate::calibration(&args.out).is_ok() {
        let out = args.out.display();
        return Err(UsageError(format!(
            "{out}: is a calibration, whose poses would be lost; keep them with --calibration {out}, or name another file with --out"
        ))
        .into());
    }
    Ok(())
}

fn read(args: &DepthArgs, dataset: &Dataset, board: &Board, context: &Context) -> Result<Wall> {
    let stop = Stop::on_signals()?;
    let mut bar = Progress::new(context.global.quiet > 0);
    let wall = wall::read(dataset, &args.dataset, board, &args.stream, |done, total| {
        bar.set("looking for the board", done, total);
        !stop.is_asked()
    })?;
    bar.clear();
    let Some(wall) = wall else { bail!("interrupted; nothing was written") };
    Ok(wall)
}

/// One depth stream of a camera.
struct Measure<'a> {
    camera: &'a WallCamera,
    /// Index in the camera's depth streams.
    number: usize,
    look: &'a StreamRecord,
    record: &'a StreamRecord,
    baseline_m: Option<f64>,
    known: Option<&'a Calibration>,
}

/// The lens that the board is seen with.
struct Lens {
    intrinsics: Intrinsics,
    /// Standard deviation of the focal length, of itself; 0 if unknown.
    focal_sigma: f64,
}

/// A place and what was measured there.
struct PlaceResult {
    measured: Measured,
    sigma_m: f64,
    focal_baseline: Option<f64>,
}

impl Measure<'_> {
    fn stream(&self, created: &str, left_out: &mut Vec<String>) -> Result<StreamLine> {
        let lens = self.lens()?;
        let mut results = Vec::new();
        for place in &self.camera.places {
            match self.place(place, &lens) {
                Ok(result) => results.push(result),
                Err(e) => left_out.push(format!("{}, set {}: {e:#}", self.record.id, place.set)),
            }
        }
        results.sort_by(|a, b| a.measured.truth_m.total_cmp(&b.measured.truth_m));
        let distances = distinct(results.iter().map(|r| r.measured.truth_m));
        if distances < MIN_DISTANCES {
            bail!(
                "the board rests at {} that can be used, {MIN_DISTANCES} are needed; hold it still for a second at each of {MIN_DISTANCES} to \
                 10 distances, each farther than the last by a fifth or more",
                out::count(distances, "distance")
            );
        }
        let observations: Vec<Observation> = results
            .iter()
            .map(|r| Observation {
                sensed_m: r.measured.truth_m + r.measured.error_m,
                truth_m: r.measured.truth_m,
                sigma_m: r.sigma_m,
                windows: r.measured.windows(),
            })
            .collect();
        let choice = choose(&observations, self.baseline_m.is_some())?;
        Ok(self.line(created, &lens, &choice, &results))
    }

    /// The calibrated lens, else the camera's own.
    fn lens(&self) -> Result<Lens> {
        let entry = self
            .known
            .into_iter()
            .flat_map(|k| k.of_camera(&self.camera.name))
            .find(|e| e.stream == self.look.id.stream.as_str() && e.source == Source::Calibrated);
        let Some(entry) = entry else {
            if self.look.intrinsics.distortion() == Distortion::Unknown || !self.look.intrinsics.is_known() {
                bail!(
                    "the intrinsics of {} are unknown; run `depthrig calibrate solve` first and give its file with --calibration",
                    self.look.id
                );
            }
            return Ok(Lens { intrinsics: self.look.intrinsics, focal_sigma: 0.0 });
        };
        if (entry.width, entry.height) != (self.look.width, self.look.height) {
            bail!(
                "{} was calibrated at {}x{}, the dataset has {}x{}; calibrate at the size that is used",
                self.look.id,
                entry.width,
                entry.height,
                self.look.width,
                self.look.height
            );
        }
        if !entry.serial.is_empty() && !self.look.serial.is_empty() && entry.serial != self.look.serial {
            bail!(
                "{} was calibrated with serial number {}, the dataset is of {}; calibrate this camera",
                self.look.id,
                entry.serial,
                self.look.serial
            );
        }
        let intrinsics = entry.intrinsics();
        let focal_sigma = entry.intrinsics.sigmas.first().map_or(0.0, |s| s / intrinsics.fx);
        Ok(Lens { intrinsics, focal_sigma })
    }

    fn place(&self, place: &Place, lens: &Lens) -> Result<PlaceResult> {
        let pose = board_pose(&lens.intrinsics, &place.corners)?.camera_from_board;
        let Some(depth) = place.depth.get(self.number).and_then(Option::as_ref) else {
            bail!("no depth frame was recorded there");
        };
        let measured = measured(depth, &pose, place, self.record)?;
        if measured.tilt_deg > MAX_TILT_DEG {
            bail!(
                "the board is tilted by {:.0} degrees, at most {MAX_TILT_DEG} can be used; turn the camera to face the wall",
                measured.tilt_deg
            );
        }
        if measured.fill < MIN_FILL {
            bail!(
                "depth is missing on {:.0} % of the board at {:.2} m; stay within the camera's range, and light the wall or give it texture",
                (1.0 - measured.fill) * 100.0,
                measured.truth_m
            );
        }
        Ok(PlaceResult {
            sigma_m: plane_sigma_m(&lens.intrinsics, &place.corners, &pose)?.hypot(measured.noise_sigma_m),
            focal_baseline: self.baseline_m.map(|b| b * depth.intrinsics.fx),
            measured,
        })
    }

    fn line(&self, created: &str, lens: &Lens, choice: &Choice, results: &[PlaceResult]) -> StreamLine {
        let best = choice.best;
        let has_scale = best.sigma.scale > 0.0;
        let corrected = |m: &Measured| {
            let sensed = m.truth_m + m.error_m;
            f64::from(best.correction.apply(sensed as f32)) - m.truth_m
        };
        let places: Vec<DepthPlace> = results
            .iter()
            .map(|r| DepthPlace {
                distance_m: r.measured.truth_m,
                tilt_deg: r.measured.tilt_deg,
                fill: r.measured.fill,
                bias_mm: r.measured.error_m * 1e3,
                sigma_mm: r.sigma_m * 1e3,
                corrected_mm: corrected(&r.measured) * 1e3,
                plane_rms_mm: r.measured.plane_rms_m * 1e3,
                subpixel_rms_px: r.focal_baseline.map(|fb| fb * r.measured.inverse_rms_per_m),
                temporal_mm: r.measured.temporal_m.map(|t| t * 1e3),
                frames: r.measured.frames,
            })
            .collect();
        let rms = |of: fn(&DepthPlace) -> f64| {
            (places.iter().map(|p| of(p).powi(2)).sum::<f64>() / places.len().max(1) as f64).sqrt()
        };
        StreamLine {
            before_mm: rms(|p| p.bias_mm),
            after_mm: rms(|p| p.corrected_mm),
            excess: choice.excess,
            candidates: choice
                .candidates
                .iter()
                .map(|c| CandidateLine { model: c.model.name(), bic: c.bic })
                .collect(),
            correction: DepthCorrection {
                camera: self.camera.name.clone(),
                stream: self.record.id.stream.to_string(),
                serial: self.record.serial.clone(),
                width: self.record.width,
                height: self.record.height,
                created: created.to_owned(),
                model: best.model,
                scale: best.correction.scale,
                offset_mm: best.correction.offset_m * 1e3,
                inverse_per_m: best.correction.inverse_per_m,
                // A focal length that is wrong by a share makes every true depth wrong by it.
                sigma_scale: if has_scale { best.sigma.scale.hypot(lens.focal_sigma) } else { 0.0 },
                sigma_offset_mm: best.sigma.offset_m * 1e3,
                sigma_inverse_per_m: best.sigma.inverse_per_m,
                places,
            },
        }
    }
}

fn measured(depth: &PlaceDepth, pose: &Rigid, place: &Place, record: &StreamRecord) -> Result<Measured> {
    let depth_from_board = Rigid::from(&depth.depth_from_look).after(pose);
    let points: Vec<DVec3> = place.corners.iter().map(|c| c.point).collect();
    let size = ImageSize { width: record.width, height: record.height };
    let mut meter = PlaneMeter::new(&depth.intrinsics, size, &depth_from_board, &points)?;
    for frame in &depth.frames {
        meter.add(frame)?;
    }
    Ok(meter.finish()?)
}

/// The printed result.
#[derive(Serialize)]
struct Report {
    streams: Vec<StreamLine>,
    /// Places and streams that were left out, and why.
    left_out: Vec<String>,
}

#[derive(Serialize)]
struct StreamLine {
    #[serde(flatten)]
    correction: DepthCorrection,
    /// Root mean square of the places' bias.
    before_mm: f64,
    /// The same after the correction.
    after_mm: f64,
    /// How much more the places scatter than their sigmas say; 1: not more.
    excess: f64,
    candidates: Vec<CandidateLine>,
}

#[derive(Serialize)]
struct CandidateLine {
    model: &'static str,
    bic: f64,
}

impl Report {
    fn text(&self) -> String {
        let mut lines: Vec<String> = self.streams.iter().map(StreamLine::text).collect();
        lines.extend(self.left_out.iter().map(|l| format!("left out: {l}")));
        lines.join("\n")
    }
}

impl StreamLine {
    fn text(&self) -> String {
        let header = [
            "DEPTH m",
            "TILT deg",
            "FILL %",
            "BIAS mm",
            "± mm",
            "BIAS %",
            "CORRECTED mm",
            "PLANE RMS mm",
            "SUB-PIXEL px",
            "TEMPORAL mm",
        ];
        let some = |value: Option<f64>, digits: usize| {
            value.map_or_else(|| "-".to_owned(), |v| format!("{v:.digits$}"))
        };
        let rows = self.correction.places.iter().map(|p| {
            vec![
                format!("{:.3}", p.distance_m),
                format!("{:.1}", p.tilt_deg),
                format!("{:.1}", p.fill * 100.0),
                format!("{:+.2}", p.bias_mm),
                format!("{:.2}", p.sigma_mm),
                format!("{:+.2}", p.bias_mm / p.distance_m * 0.1),
                format!("{:+.2}", p.corrected_mm),
                format!("{:.2}", p.plane_rms_mm),
                some(p.subpixel_rms_px, 3),
                some(p.temporal_mm, 2),
            ]
        });
        let c = &self.correction;
        let bic: Vec<String> = self.candidates.iter().map(|c| format!("{} {:.0}", c.model, c.bic)).collect();
        format!(
            "{}/{}\n{}\n{}\nBIC: {}; bias {:.2} mm before, {:.2} mm after (root mean square of {})\n",
            c.camera,
            c.stream,
            out::table(&header, 0, rows),
            self.formula(),
            bic.join(", "),
            self.before_mm,
            self.after_mm,
            out::count(c.places.len(), "place")
        )
    }

    fn formula(&self) -> String {
        use depthrig_calibrate::depth::Model;
        let c = &self.correction;
        let scale = format!("({:.5} ± {:.5}) * depth", c.scale, c.sigma_scale);
        let offset = format!("({:.2} ± {:.2}) mm", c.offset_mm, c.sigma_offset_mm);
        match c.model {
            Model::None => "no correction: no error is larger than its uncertainty".to_owned(),
            Model::Offset => format!("corrected = depth + {offset}"),
            Model::Scale => format!("corrected = {scale}"),
            Model::ScaleOffset => format!("corrected = {scale} + {offset}"),
            Model::Disparity => {
                format!(
                    "1 / corrected = 1 / depth + ({:.6} ± {:.6}) / m",
                    c.inverse_per_m, c.sigma_inverse_per_m
                )
            }
        }
    }
}
