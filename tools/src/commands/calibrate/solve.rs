//! `depthrig calibrate solve`: intrinsics and poses from views of a board.

use crate::calibrate::input::Input;
use crate::calibrate::{self, Sightings, page};
use crate::context::Context;
use crate::exit::{Exit, UsageError};
use crate::out;
use crate::outfile::{OutFile, Overwrite};
use anyhow::Result;
use depthrig_bus::Distortion;
use depthrig_calibrate::board::Board;
use depthrig_calibrate::file::Calibration;
use depthrig_calibrate::mount::{CameraInput, MountOptions, MountResult, Source, calibrate_mount, usable};
use serde::Serialize;
use std::path::PathBuf;
use time::OffsetDateTime;
use time::format_description::well_known::Rfc3339;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
Of a dataset the moments are taken at which the board stands still (0.3 px over three sets), one for each of its places. Images in
folders are of one moment if their names end in the same number.

The first camera is the reference: its optical frame is the mount's. Intrinsics of the factory are kept where they predict the
views better than new ones predict views that they were not fitted to.

Exit codes: 0 calibrated, 1 failure, 2 wrong usage, 3 calibrated, but views were refused or left out (the output says which).

Examples:
  depthrig calibrate solve data/20261125_1015_board --board board.toml
  depthrig calibrate solve --images left=left --images right=right --board board.toml --out stereo.toml
  depthrig calibrate solve --images wrist=views --board board.toml --model kannala_brandt4 --json";

/// Arguments.
#[derive(Debug, clap::Args)]
#[allow(clippy::struct_excessive_bools)] // options of a command line
pub struct SolveArgs {
    #[command(flatten)]
    input: Input,
    /// Description of the board
    #[arg(long, value_name = "FILE", default_value = "board.toml")]
    board: PathBuf,
    /// Camera whose frame is the mount's [default: the first]
    #[arg(long, value_name = "CAMERA")]
    reference: Option<String>,
    /// Distortion model of cameras without factory intrinsics: brown_conrady, rational or kannala_brandt4
    #[arg(long, value_name = "MODEL", default_value = "brown_conrady", value_parser = model)]
    model: Distortion,
    /// Use the factory's intrinsics even where new ones are better
    #[arg(long)]
    keep_factory: bool,
    /// Estimate how far the board is from flat
    #[arg(long)]
    board_warp: bool,
    /// Name of the operator, for the file
    #[arg(long, value_name = "NAME")]
    by: Option<String>,
    /// Calibration to write
    #[arg(long, value_name = "FILE", default_value = "calibration.toml")]
    out: PathBuf,
    /// HTML report to write [default: as --out, with .html]
    #[arg(long, value_name = "FILE")]
    report: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Print JSON instead of the summary
    #[arg(long)]
    json: bool,
}

fn model(text: &str) -> Result<Distortion, String> {
    match text {
        "brown_conrady" => Ok(Distortion::BrownConrady),
        "rational" => Ok(Distortion::Rational),
        "kannala_brandt4" => Ok(Distortion::KannalaBrandt4),
        _ => Err("use brown_conrady, rational or kannala_brandt4 (fisheye)".to_owned()),
    }
}

/// Reads, calibrates and writes.
pub fn run(args: &SolveArgs, context: &Context) -> Result<Exit> {
    let board = calibrate::board(&args.board)?;
    let inputs = [args.board.as_path()];
    let file = OutFile::new(&args.out, args.overwrite, &inputs)?;
    let report = args.report.clone().unwrap_or_else(|| args.out.with_extension("html"));
    let report = OutFile::new(&report, args.overwrite, &inputs)?;
    let mut views = args.input.read(&board, context)?;
    refer_to(&mut views, args.reference.as_deref())?;
    let cameras: Vec<CameraInput> = views
        .cameras
        .iter()
        .map(|c| CameraInput { name: c.name.clone(), size: c.size, factory: c.factory, model: args.model })
        .collect();
    let found = usable(&cameras, core::mem::take(&mut views.views))?;
    let refused: Vec<String> = views
        .refused
        .iter()
        .cloned()
        .chain(
            found.refused.iter().map(|r| format!("view {}, {}: {}", r.view, cameras[r.camera].name, r.why)),
        )
        .collect();
    let options = MountOptions { board_warp: args.board_warp, keep_factory: args.keep_factory };
    let result = calibrate_mount(&cameras, &found.views, options)?;
    let provenance: Vec<_> = views.cameras.iter().map(|c| c.provenance.clone()).collect();
    let created = OffsetDateTime::now_utc().replace_nanosecond(0)?.format(&Rfc3339)?;
    let mut calibration = Calibration::new(&result, &board, &provenance, created, args.by.clone());
    for camera in &mut calibration.cameras {
        camera.conditions = views.conditions.get(&camera.name).cloned().unwrap_or_default();
    }
    // A file that cannot be read any more has nothing to keep.
    let before = args.out.exists().then(|| calibrate::calibration(&args.out).ok()).flatten();
    let kept = before.map_or_else(Vec::new, |before| calibration.keep_from(&before));
    report.write(page::page(&calibration, &result, &refused, views.images).as_bytes())?;
    file.write(calibration.to_toml()?.as_bytes())?;
    if args.json {
        out::json(&Json::new(&calibration, &result, &refused))?;
    } else {
        out::line(summary(&result, &board, &refused))?;
        if !kept.is_empty() {
            out::line(format_args!("kept      {}, from the file before", kept.join(", ")))?;
        }
        out::line(format_args!("written   {}, {}", file.path().display(), report.path().display()))?;
    }
    let lost = !refused.is_empty() || result.cameras.iter().any(|c| c.views == 0);
    Ok(if lost { Exit::Lost } else { Exit::Good })
}

/// Makes the named camera the first.
fn refer_to(views: &mut Sightings, name: Option<&str>) -> Result<()> {
    let Some(name) = name else { return Ok(()) };
    let Some(at) = views.cameras.iter().position(|c| c.name == name) else {
        let all: Vec<&str> = views.cameras.iter().map(|c| c.name.as_str()).collect();
        return Err(UsageError(format!("no camera {name}; there are {}", all.join(", "))).into());
    };
    views.cameras.swap(0, at);
    for seen in views.views.iter_mut().flat_map(|v| &mut v.seen) {
        seen.camera = match seen.camera {
            0 => at,
            c if c == at => 0,
            c => c,
        };
    }
    Ok(())
}

/// Every number of the report.
#[derive(Serialize)]
struct Json<'a> {
    calibration: &'a Calibration,
    sigma_px: f64,
    warp_mm: Option<[f64; 2]>,
    cameras: Vec<JsonCamera<'a>>,
    views: Vec<JsonView<'a>>,
    refused: &'a [String],
    advice: &'a [String],
}

#[derive(Serialize)]
struct JsonCamera<'a> {
    name: &'a str,
    outliers: usize,
    /// Corners in each cell of the image, row by row.
    coverage: &'a [u32],
    coverage_columns: usize,
    distance_m: f64,
    /// Standard deviation of the projection at `distance_m`, row by row, pixels; null where the lens shows nothing.
    uncertainty_px: &'a [f64],
    uncertainty_columns: usize,
    /// Largest difference of projection between the calibrations of two halves of the views, pixels.
    halves_differ_most_px: Option<f64>,
}

#[derive(Serialize)]
struct JsonView<'a> {
    name: &'a str,
    residuals_px: Vec<JsonResidual<'a>>,
}

#[derive(Serialize)]
struct JsonResidual<'a> {
    camera: &'a str,
    rms_px: f64,
    outliers: usize,
}

impl<'a> Json<'a> {
    fn new(calibration: &'a Calibration, result: &'a MountResult, refused: &'a [String]) -> Self {
        Self {
            calibration,
            sigma_px: result.sigma_px,
            warp_mm: result.warp.map(|w| [w.x_m * 1e3, w.y_m * 1e3]),
            cameras: result
                .cameras
                .iter()
                .map(|c| JsonCamera {
                    name: &c.name,
                    outliers: c.outliers,
                    coverage: &c.coverage.corners,
                    coverage_columns: c.coverage.columns,
                    distance_m: c.uncertainty.distance_m,
                    uncertainty_px: &c.uncertainty.sigma_px,
                    uncertainty_columns: c.uncertainty.columns,
                    halves_differ_most_px: c
                        .cross_validation
                        .as_ref()
                        .and_then(|v| v.projection.as_ref())
                        .map(|p| p.max_px),
                })
                .collect(),
            views: result
                .views
                .iter()
                .map(|v| JsonView {
                    name: &v.name,
                    residuals_px: v
                        .seen
                        .iter()
                        .map(|s| JsonResidual {
                            camera: &result.cameras[s.camera].name,
                            rms_px: s.rms_px,
                            outliers: s.outliers,
                        })
                        .collect(),
                })
                .collect(),
            refused,
            advice: &result.advice,
        }
    }
}

/// Sightings that were refused and are named.
const LISTED: usize = 10;

fn summary(result: &MountResult, board: &Board, refused: &[String]) -> String {
    let header = [
        "CAMERA",
        "INTRINSICS",
        "VIEWS",
        "RMS px",
        "HELD OUT px",
        "±PROJECTION px",
        "HALVES px",
        "POSE ± mm",
        "± deg",
        "HALVES mm",
    ];
    let number =
        |v: Option<f64>| v.filter(|v| v.is_finite()).map_or_else(|| "–".to_owned(), |v| format!("{v:.3}"));
    let rows = result.cameras.iter().enumerate().map(|(i, c)| {
        let halves = c.cross_validation.as_ref();
        vec![
            c.name.clone(),
            if c.source == Source::Factory { "factory" } else { "calibrated" }.to_owned(),
            c.views.to_string(),
            number(Some(c.rms_px)),
            number(if c.source == Source::Factory { c.factory_px } else { c.held_out_px }),
            format!(
                "{}..{}",
                number(Some(c.uncertainty.middle_px())),
                number(Some(c.uncertainty.worst_px()))
            ),
            number(halves.and_then(|h| h.projection.as_ref()).map(|p| p.mean_px)),
            if i == 0 { "reference".to_owned() } else { number(Some(c.pose_sigma.metres * 1e3)) },
            number((i > 0).then(|| c.pose_sigma.radians.to_degrees())),
            number(halves.and_then(|h| h.pose).map(|p| p.metres * 1e3)),
        ]
    });
    let mut lines = vec![out::table(&header, 2, rows), String::new()];
    if board.measured_ruler_mm.is_none() {
        lines.push(
            "ruler     the board's ruler was not measured: if the printer scaled by 1 %, every distance is wrong by 1 % \
             (measured_ruler_mm in the board's file)"
                .to_owned(),
        );
    }
    if let Some(warp) = result.warp {
        lines.push(format!(
            "board     bent by {:.2} mm along x, {:.2} mm along y",
            warp.x_m * 1e3,
            warp.y_m * 1e3
        ));
    }
    for line in refused.iter().take(LISTED) {
        lines.push(format!("refused   {line}"));
    }
    if refused.len() > LISTED {
        lines.push(format!("refused   and {} more (--json lists all)", refused.len() - LISTED));
    }
    for line in &result.advice {
        lines.push(format!("advice    {line}"));
    }
    lines.join("\n")
}
