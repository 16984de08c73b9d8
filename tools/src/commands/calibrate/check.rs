//! `depthrig calibrate check`: whether a mount is still as it was calibrated.

use crate::calibrate::capture::live_views::{Wanted, live_views};
use crate::calibrate::input::Input;
use crate::calibrate::{self, known};
use crate::context::Context;
use crate::exit::Exit;
use crate::out;
use anyhow::{Context as _, Result};
use core::time::Duration;
use depthrig_bus::StreamId;
use depthrig_calibrate::check::{Checked, KnownCamera, Motion, check};
use depthrig_calibrate::rig::RigView;
use serde::Serialize;
use std::path::PathBuf;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
Hold the board still where several cameras see it, at a few places: for ten seconds before the running rig, or in a recording. A camera has moved if its motion is
significant (one false alarm in 2,000 checks of a camera) and above 0.5 mm or 0.05 degrees.

Exit codes: 0 nothing moved, 1 failure, 2 wrong usage, 3 a camera has moved.

Examples:
  depthrig calibrate check                                     the only rig that is running
  depthrig calibrate check mount --seconds 20
  depthrig calibrate check data/20261126_0900
  depthrig calibrate check --images left=left --images right=right --calibration stereo.toml";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct CheckArgs {
    #[command(flatten)]
    input: Input,
    /// Calibration to compare with
    #[arg(long, value_name = "FILE", default_value = "calibration.toml")]
    calibration: PathBuf,
    /// How long to look at a running rig, seconds
    #[arg(long, value_name = "S", default_value_t = 10.0, value_parser = crate::args::positive_seconds)]
    seconds: f64,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Reads, compares and prints.
pub fn run(args: &CheckArgs, context: &Context) -> Result<Exit> {
    let file = calibrate::calibration(&args.calibration)?;
    let mut views = match args.input.rig(context)? {
        Some(rig) => {
            let calibrated: Result<Vec<StreamId>, _> =
                file.cameras.iter().map(|c| format!("{}/{}", c.name, c.stream).parse()).collect();
            let calibrated = calibrated.with_context(|| args.calibration.display().to_string())?;
            let named = args.input.streams();
            let wanted = Wanted {
                rig: &rig,
                streams: if named.is_empty() { &calibrated } else { named },
                board: &file.board,
                length: Duration::from_secs_f64(args.seconds),
            };
            live_views(&wanted, context)?
        }
        None => args.input.read(&file.board, context)?,
    };
    let known = known::cameras(&file);
    let places = known::places(&views.cameras, &file, &args.calibration)?;
    known::compare_conditions(&views, &file, &args.calibration)?;
    // The calibration's order, whose first camera is the reference.
    for seen in views.views.iter_mut().flat_map(|v| &mut v.seen) {
        seen.camera = places[seen.camera];
    }
    let found = check(&known, &views.views)?;
    let report = Report::new(&found, &known, &views.views);
    if args.json {
        out::json(&report)?;
    } else {
        out::line(report.text())?;
    }
    Ok(if found.moved.is_empty() { Exit::Good } else { Exit::Lost })
}

/// The printed result.
#[derive(Serialize)]
struct Report<'a> {
    views: usize,
    moved: Vec<Line<'a>>,
    unmoved: Vec<Line<'a>>,
    unchecked: Vec<&'a str>,
    /// With two cameras, either may be the one that moved.
    either: bool,
}

#[derive(Serialize)]
struct Line<'a> {
    camera: &'a str,
    mm: f64,
    sigma_mm: f64,
    deg: f64,
    sigma_deg: f64,
    /// Of six coordinates: 6 on average of a camera that did not move.
    chi_squared: f64,
}

impl Line<'_> {
    fn cells(&self, state: &str) -> Vec<String> {
        vec![
            self.camera.to_owned(),
            state.to_owned(),
            format!("{:.2}", self.mm),
            format!("{:.2}", self.sigma_mm),
            format!("{:.3}", self.deg),
            format!("{:.3}", self.sigma_deg),
            format!("{:.0}", self.chi_squared),
        ]
    }
}

impl<'a> Report<'a> {
    fn new(found: &Checked, known: &'a [KnownCamera], views: &[RigView]) -> Self {
        let line = |motion: &Motion| Line {
            camera: &known[motion.camera].name,
            mm: motion.by.metres * 1e3,
            sigma_mm: motion.sigma.metres * 1e3,
            deg: motion.by.radians.to_degrees(),
            sigma_deg: motion.sigma.radians.to_degrees(),
            chi_squared: motion.chi_squared,
        };
        Self {
            views: views.len(),
            moved: found.moved.iter().map(line).collect(),
            unmoved: found.unmoved.iter().map(line).collect(),
            unchecked: found.unchecked.iter().map(|c| known[*c].name.as_str()).collect(),
            either: found.either,
        }
    }

    fn text(&self) -> String {
        let header = ["CAMERA", "", "mm", "± mm", "deg", "± deg", "CHI²"];
        let moved = self.moved.iter().map(|l| l.cells("moved"));
        let unmoved = self.unmoved.iter().map(|l| l.cells("as calibrated"));
        let mut lines = vec![out::table(&header, 2, moved.chain(unmoved))];
        if self.either && !self.moved.is_empty() {
            lines.push(
                "two cameras: it may as well be the other one that moved; check with a third".to_owned(),
            );
        }
        if !self.unchecked.is_empty() {
            lines.push(format!(
                "not checked, because no other camera saw the board at once: {}",
                self.unchecked.join(", ")
            ));
        }
        lines.push(match self.moved.len() {
            0 => format!("nothing moved, by {}", out::count(self.views, "view")),
            _ => "calibrate again: `depthrig calibrate solve`".to_owned(),
        });
        lines.join("\n")
    }
}
