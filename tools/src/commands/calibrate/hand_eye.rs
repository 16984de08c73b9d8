//! `depthrig calibrate hand-eye`: where a camera sits on a robot's hand, or beside the robot.

use crate::calibrate;
use crate::calibrate::images::{self, Folder};
use crate::context::Context;
use crate::exit::Exit;
use crate::out;
use crate::progress::Progress;
use crate::signals::Stop;
use anyhow::{Context as _, Result, bail};
use depthrig_bus::Pose;
use depthrig_calibrate::hand_eye::{Arrangement, HandEye, HandEyeView, Noise, hand_eye};
use depthrig_calibrate::{Distance, Rigid};
use glam::{DQuat, DVec3};
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
POSES is a CSV file with a header: `view`, then `x,y,z` in metres and `qx,qy,qz,qw`, or `x,y,z` and `rx,ry,rz` (a rotation vector in
radians, as Universal Robots print it): the hand in the robot's base. `view` is the number in the image's name.

--robot-mm and --robot-deg are how exactly the robot knows its hand's pose; its data sheet's accuracy, not its repeatability.

Exit codes: 0 found, 1 failure, 2 wrong usage, 3 found, but some views were left out.

Examples:
  depthrig calibrate hand-eye wrist=images --poses poses.csv --calibration calibration.toml
  depthrig calibrate hand-eye front=images --poses poses.csv --calibration calibration.toml --eye-to-hand";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct HandEyeArgs {
    /// Camera and its images
    #[arg(value_name = "CAMERA=FOLDER", value_parser = images::folder)]
    images: Folder,
    /// Poses of the hand in the robot's base, CSV
    #[arg(long, value_name = "FILE")]
    poses: PathBuf,
    /// Calibration with the camera's intrinsics
    #[arg(long, value_name = "FILE", default_value = "calibration.toml")]
    calibration: PathBuf,
    /// Description of the board
    #[arg(long, value_name = "FILE", default_value = "board.toml")]
    board: PathBuf,
    /// The camera is fixed beside the robot, the board is on its hand
    #[arg(long)]
    eye_to_hand: bool,
    /// Standard deviation of the robot's position, millimetres
    #[arg(long, value_name = "MM", default_value_t = 0.2, value_parser = crate::args::length_mm)]
    robot_mm: f64,
    /// Standard deviation of the robot's orientation, degrees
    #[arg(long, value_name = "DEG", default_value_t = 0.05, value_parser = crate::args::angle_deg)]
    robot_deg: f64,
    /// Standard deviation of a corner, pixels
    #[arg(long, value_name = "PX", default_value_t = 0.2, value_parser = crate::args::pixels)]
    corner_px: f64,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// A file of poses is no longer than this, bytes.
const POSES_MAX_BYTES: u64 = 16 << 20;

/// Reads, estimates and prints.
pub fn run(args: &HandEyeArgs, context: &Context) -> Result<Exit> {
    let board = calibrate::board(&args.board)?;
    let poses = poses(&calibrate::text(&args.poses, POSES_MAX_BYTES, "")?)
        .with_context(|| format!("{}: invalid poses", args.poses.display()))?;
    let camera = calibrate::camera(&args.calibration, &args.images.name)?;
    let stop = Stop::on_signals()?;
    let mut bar = Progress::new(context.global.quiet > 0);
    let views = images::read(std::slice::from_ref(&args.images), &board, |done, total| {
        bar.set("looking for the board", done, total);
        !stop.is_asked()
    })?;
    bar.clear();
    let Some(views) = views else { bail!("interrupted") };
    calibrate::check(&views)?;
    let size = views.cameras[0].size;
    if size != camera.size() {
        bail!(
            "the images are {}x{}, {} has intrinsics for {}x{}; calibrate at the size that you use",
            size.width,
            size.height,
            args.calibration.display(),
            camera.width,
            camera.height
        );
    }
    let mut left_out = views.refused.clone();
    let mut with_poses = Vec::new();
    for view in views.views {
        match poses.get(&view.name) {
            Some(pose) => with_poses.push(HandEyeView {
                base_from_hand: *pose,
                corners: view.seen.into_iter().flat_map(|s| s.corners).collect(),
                name: view.name,
            }),
            None => left_out.push(format!("view {}: {} has no pose of it", view.name, args.poses.display())),
        }
    }
    let arrangement = if args.eye_to_hand { Arrangement::EyeToHand } else { Arrangement::EyeInHand };
    let noise = Noise {
        corner_px: args.corner_px,
        robot_m: args.robot_mm * 1e-3,
        robot_rad: args.robot_deg.to_radians(),
    };
    let found = hand_eye(arrangement, &camera.intrinsics(), &with_poses, &noise)?;
    let result = Found::new(&found, arrangement, &with_poses, &left_out);
    if args.json {
        out::json(&result)?;
    } else {
        out::line(result.text(&noise))?;
    }
    Ok(if left_out.is_empty() { Exit::Good } else { Exit::Lost })
}

/// Poses by the name of their view.
fn poses(text: &str) -> Result<BTreeMap<String, Rigid>> {
    let mut lines = text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty() && !l.starts_with('#'));
    let (_, header) = lines.next().context("the file is empty")?;
    let names: Vec<&str> = header.split(',').map(str::trim).collect();
    let column = |name: &str| names.iter().position(|n| *n == name);
    let columns = |wanted: &[&str]| wanted.iter().map(|n| column(n)).collect::<Option<Vec<usize>>>();
    let view = column("view").context("the header has no column view")?;
    let position = columns(&["x", "y", "z"]).context("the header has no columns x, y, z")?;
    let quaternion = columns(&["qx", "qy", "qz", "qw"]);
    let vector = columns(&["rx", "ry", "rz"]);
    if quaternion.is_some() == vector.is_some() {
        bail!("the header needs either the columns qx, qy, qz, qw or the columns rx, ry, rz");
    }
    let mut poses = BTreeMap::new();
    for (i, line) in lines {
        let line_number = i + 1;
        let cells: Vec<&str> = line.split(',').map(str::trim).collect();
        let number = |at: &usize| -> Result<f64> {
            let cell = cells.get(*at).copied().unwrap_or("");
            let value: f64 =
                cell.parse().with_context(|| format!("line {line_number}: '{cell}' is not a number"))?;
            if value.is_finite() { Ok(value) } else { bail!("line {line_number}: {value} is not finite") }
        };
        let all = |at: &[usize]| at.iter().map(number).collect::<Result<Vec<f64>>>();
        let rotation = match (&quaternion, &vector) {
            (Some(q), _) => {
                let q = all(q)?;
                let q = DQuat::from_xyzw(q[0], q[1], q[2], q[3]);
                if (q.length() - 1.0).abs() > 1e-2 {
                    bail!(
                        "line {line_number}: qx, qy, qz, qw have the length {:.3}; a rotation has 1",
                        q.length()
                    );
                }
                q.normalize()
            }
            (None, Some(v)) => {
                let v = all(v)?;
                let v = DVec3::new(v[0], v[1], v[2]);
                if v.length() > core::f64::consts::TAU {
                    bail!(
                        "line {line_number}: a rotation of {:.1} rad; rx, ry, rz are radians, these look like degrees",
                        v.length()
                    );
                }
                DQuat::from_scaled_axis(v)
            }
            (None, None) => bail!("the header has no rotation"),
        };
        let t = all(&position)?;
        let translation = DVec3::new(t[0], t[1], t[2]);
        if translation.length() > MAX_REACH_M {
            bail!(
                "line {line_number}: a place {:.1} m away; x, y, z are metres, these look like millimetres",
                translation.length()
            );
        }
        let name = cells.get(view).copied().unwrap_or("").to_owned();
        // Numbers of views are compared as numbers are written without leading zeros.
        let name = name.parse::<u64>().map_or(name, |n| n.to_string());
        if poses.insert(name.clone(), Rigid { rotation, translation }).is_some() {
            bail!("line {line_number}: view {name} is there twice");
        }
    }
    Ok(poses)
}

/// No arm reaches further, metres.
const MAX_REACH_M: f64 = 10.0;

/// The printed result.
#[derive(Serialize)]
struct Found<'a> {
    /// `hand` or `base`: whose frame the camera's pose is in.
    camera_in: &'static str,
    camera: Pose,
    board: Pose,
    sigma_mm: f64,
    sigma_deg: f64,
    rms_px: f64,
    views: usize,
    held_out_median_mm: f64,
    held_out_median_deg: f64,
    views_held_out: Vec<HeldOut<'a>>,
    left_out: &'a [String],
}

#[derive(Serialize)]
struct HeldOut<'a> {
    view: &'a str,
    /// Of the board from where the other views put it.
    mm: f64,
    deg: f64,
    /// Of the robot's pose from what the adjustment believes.
    robot_mm: f64,
    robot_deg: f64,
}

impl<'a> Found<'a> {
    fn new(
        found: &HandEye,
        arrangement: Arrangement,
        views: &'a [HandEyeView],
        left_out: &'a [String],
    ) -> Self {
        let root = |from: usize| (from..from + 3).map(|i| found.covariance[(i, i)]).sum::<f64>().sqrt();
        let median = |value: fn(&Distance) -> f64| {
            let mut all: Vec<f64> = found.held_out.iter().map(value).collect();
            all.sort_by(f64::total_cmp);
            all.get(all.len() / 2).copied().unwrap_or(f64::NAN)
        };
        Self {
            camera_in: if arrangement == Arrangement::EyeInHand { "hand" } else { "base" },
            camera: Pose::from(&found.camera),
            board: Pose::from(&found.board),
            sigma_mm: root(3) * 1e3,
            sigma_deg: root(0).to_degrees(),
            rms_px: found.rms_px,
            views: views.len(),
            held_out_median_mm: median(|d| d.metres) * 1e3,
            held_out_median_deg: median(|d| d.radians).to_degrees(),
            views_held_out: views
                .iter()
                .zip(&found.held_out)
                .zip(&found.corrections)
                .map(|((view, held_out), correction)| HeldOut {
                    view: &view.name,
                    mm: held_out.metres * 1e3,
                    deg: held_out.radians.to_degrees(),
                    robot_mm: correction.metres * 1e3,
                    robot_deg: correction.radians.to_degrees(),
                })
                .collect(),
            left_out,
        }
    }

    fn text(&self, noise: &Noise) -> String {
        let t = self.camera.translation_m;
        let q = self.camera.rotation_xyzw;
        let mut lines = vec![format!(
            "camera    in the {}: translation_m = [{:.5}, {:.5}, {:.5}], rotation_xyzw = [{:.6}, {:.6}, {:.6}, {:.6}]\n\
             sigma     {:.2} mm, {:.3} degrees\n\
             residual  {:.3} px over {} views\n\
             held out  a view's board is {:.2} mm and {:.3} degrees (median) from where the other views put it, with the robot's poses \
             as given",
            self.camera_in,
            t[0],
            t[1],
            t[2],
            q[0],
            q[1],
            q[2],
            q[3],
            self.sigma_mm,
            self.sigma_deg,
            self.rms_px,
            self.views,
            self.held_out_median_mm,
            self.held_out_median_deg
        )];
        for view in &self.views_held_out {
            if view.robot_mm > 4.0 * noise.robot_m * 1e3
                || view.robot_deg > 4.0 * noise.robot_rad.to_degrees()
            {
                lines.push(format!(
                    "doubtful  view {}: the robot's pose is off by {:.2} mm and {:.3} degrees, more than it may be; check that view, or \
                     --robot-mm and --robot-deg",
                    view.view, view.robot_mm, view.robot_deg
                ));
            }
        }
        for line in self.left_out {
            lines.push(format!("left out  {line}"));
        }
        lines.join("\n")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn poses_are_read_in_both_forms() {
        let q = poses("view,x,y,z,qx,qy,qz,qw\n01,0.1,0.2,0.3,0,0,0,1\n").unwrap();
        let v = poses("# a robot\nview, x, y, z, rx, ry, rz\n1, 0.1, 0.2, 0.3, 0, 0, 0\n").unwrap();
        assert_eq!(q, v);
    }

    #[test]
    fn poses_in_other_units_are_refused() {
        let of = |line: &str| format!("{:#}", poses(&format!("view,x,y,z,rx,ry,rz\n{line}\n")).unwrap_err());
        assert!(of("1,0.1,0.2,0.3,90,0,0").contains("look like degrees"));
        assert!(of("1,412,20,300,0,0,0").contains("look like millimetres"));
        assert!(of("1,0.1,0.2,0.3,0,0,zero").contains("line 2: 'zero'"));
        assert!(of("1,0.1,0.2,0.3,0,0,0\n1,0.1,0.2,0.3,0,0,0").contains("twice"));
        let quaternion = poses("view,x,y,z,qx,qy,qz,qw\n1,0,0,0,0,0,0,2\n").unwrap_err().to_string();
        assert!(quaternion.contains("length 2.000"), "{quaternion}");
    }
}
