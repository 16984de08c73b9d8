//! `depthrig calibrate align`: where a camera sits beside a robot, from masks of its arm.

use crate::calibrate;
use crate::calibrate::arm::{self, ArmViews, Folders, Held};
use crate::calibrate::robot::{self, MeshFolder, Robot};
use crate::exit::{Exit, UsageError};
use crate::image_file;
use crate::out;
use crate::outfile::{OutFile, Overwrite};
use anyhow::{Context as _, Result, bail};
use depthrig_bus::{Intrinsics, Pose};
use depthrig_calibrate::Rigid;
use depthrig_calibrate::align::{AlignView, Alignment, Mask, align, drawing};
use glam::DVec3;
use image::{Rgb, RgbImage};
use rustix::time::ClockId;
use serde::Serialize;
use std::f64::consts::TAU;
use std::path::{Path, PathBuf};

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
JOINTS is a CSV file with a header: `view`, then the robot's joints by the names that the URDF has for them; radians, and metres for
sliding joints. `view` is the number in the mask's name, or the name. Masks are grey images, bright where the arm is.

The start is the camera's pose in the robot's base, within 10 cm and 15 degrees: metres, and roll, pitch, yaw in radians as in a
URDF, of the optical axes: x right, y down, z forward. `-1.5708 0 -1.5708` looks along the base's x axis, `-1.5708 0 1.5708` against it.

Exit codes: 0 found, 1 failure, 2 wrong usage, 3 found, but some views were left out.

Examples:
  depthrig calibrate align --camera front --urdf ur5.urdf --joints joints.csv --masks masks --start '1.2 0 0.6 -1.9 0 1.57'
  depthrig calibrate align --intrinsics 610,610,319.5,239.5,640,480 --urdf panda.urdf --meshes franka_description=meshes
      --joints joints.csv --masks masks --depth depth --start '1.2 0 0.6 -1.9 0 1.57' -o front.toml --overlay overlay";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct AlignArgs {
    /// Description of the robot
    #[arg(long, value_name = "FILE")]
    urdf: PathBuf,
    /// Folder with meshes or packages, may be given several times [default: around the URDF]
    #[arg(long, value_name = "[PACKAGE=]FOLDER", value_parser = robot::mesh_folder)]
    meshes: Vec<MeshFolder>,
    /// Joint positions, one row a view, CSV
    #[arg(long, value_name = "FILE")]
    joints: PathBuf,
    /// Joint that stands still in all views
    #[arg(long, value_name = "JOINT=POSITION", value_parser = arm::held)]
    hold: Vec<Held>,
    /// Masks of the arm, one image a view
    #[arg(long, value_name = "FOLDER")]
    masks: PathBuf,
    /// Depth of the same images, PNG of 16 bits
    #[arg(long, value_name = "FOLDER")]
    depth: Option<PathBuf>,
    /// Unit of the depth, metres
    #[arg(long, value_name = "M", default_value_t = 0.001, value_parser = crate::args::depth_unit_m)]
    depth_unit: f64,
    /// Camera of the calibration whose intrinsics are used
    #[arg(long, value_name = "NAME", conflicts_with = "intrinsics", required_unless_present = "intrinsics")]
    camera: Option<String>,
    /// Calibration with the camera's intrinsics
    #[arg(long, value_name = "FILE", default_value = "calibration.toml", conflicts_with = "intrinsics")]
    calibration: PathBuf,
    /// Intrinsics of images without distortion, pixels
    #[arg(long, value_name = "FX,FY,CX,CY,WIDTH,HEIGHT", value_parser = intrinsics)]
    intrinsics: Option<Lens>,
    /// Assumed pose of the camera in the robot's base
    #[arg(long, value_name = "X Y Z ROLL PITCH YAW", value_parser = start, allow_hyphen_values = true)]
    start: Rigid,
    /// Write the result as TOML
    #[arg(short, long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Write an image a view: mask and arm, at the pose found
    #[arg(long, value_name = "FOLDER")]
    overlay: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// A file of joint positions is no longer than this, bytes.
const JOINTS_MAX_BYTES: u64 = 16 << 20;
/// No camera sees an arm from further away, metres.
const MAX_REACH_M: f64 = 20.0;
/// A side of an image has at most this many pixels.
const MAX_SIDE: f64 = 16384.0;
/// A view that overlaps by less than this share of the median's is doubtful.
const DOUBTFUL: f64 = 0.85;

/// Intrinsics and the size of the images.
#[derive(Debug, Clone, Copy)]
struct Lens {
    intrinsics: Intrinsics,
    width: u32,
    height: u32,
}

/// Numbers between commas or spaces.
fn numbers<const N: usize>(text: &str, form: &str) -> Result<[f64; N], String> {
    let parts: Vec<&str> = text.split([',', ' ']).filter(|p| !p.is_empty()).collect();
    let wrong = || format!("write {N} numbers: {form}");
    let parsed: Vec<f64> = parts.iter().map(|p| p.parse()).collect::<Result<_, _>>().map_err(|_| wrong())?;
    if parsed.iter().any(|n| !n.is_finite()) {
        return Err(wrong());
    }
    parsed.try_into().map_err(|_| wrong())
}

fn intrinsics(text: &str) -> Result<Lens, String> {
    let [fx, fy, cx, cy, width, height] = numbers(text, "fx,fy,cx,cy,width,height")?;
    if fx <= 0.0 || fy <= 0.0 {
        return Err(format!("focal lengths of {fx} and {fy} px; they are positive"));
    }
    for side in [width, height] {
        if side.fract() != 0.0 || !(16.0..=MAX_SIDE).contains(&side) {
            return Err(format!("a side of {side} px is out of range 16..={MAX_SIDE}"));
        }
    }
    if !(-width..=2.0 * width).contains(&cx) || !(-height..=2.0 * height).contains(&cy) {
        return Err(format!("the principal point {cx}, {cy} is far outside of {width}x{height}"));
    }
    Ok(Lens { intrinsics: Intrinsics::pinhole(fx, fy, cx, cy), width: width as u32, height: height as u32 })
}

fn start(text: &str) -> Result<Rigid, String> {
    let [x, y, z, roll, pitch, yaw] = numbers(text, "x y z (metres) roll pitch yaw (radians)")?;
    let translation = DVec3::new(x, y, z);
    let rpy = DVec3::new(roll, pitch, yaw);
    if rpy.abs().max_element() > TAU {
        return Err(
            "roll, pitch and yaw are radians, these look like degrees: multiply them by 0.0174533".into()
        );
    }
    if translation.length() > MAX_REACH_M {
        return Err(format!(
            "a place {:.0} m away; x, y, z are metres, these look like millimetres",
            translation.length()
        ));
    }
    Ok(robot::rigid(translation, rpy))
}

/// Reads, searches, writes and prints.
pub fn run(args: &AlignArgs) -> Result<Exit> {
    let mut inputs: Vec<&Path> = vec![&args.urdf, &args.joints];
    if args.camera.is_some() {
        inputs.push(&args.calibration);
    }
    let out = args.out.as_deref().map(|o| OutFile::new(o, args.overwrite, &inputs)).transpose()?;
    let lens = args.lens()?;
    let Robot { kinematics, meshes } = robot::read(&args.urdf, &args.meshes)?;
    let visible = |joint: &str| kinematics.moves(joint, |link| !meshes[link].triangles().is_empty());
    let text = calibrate::text(&args.joints, JOINTS_MAX_BYTES, "")?;
    let joints = arm::joints(&text, &kinematics, &args.hold, visible)
        .with_context(|| format!("{}: invalid joint positions", args.joints.display()))?;
    let folders = Folders { masks: &args.masks, depth: args.depth.as_deref(), depth_unit_m: args.depth_unit };
    let ArmViews { views, left_out } = arm::read(&folders, &joints, &kinematics)?;
    if views.is_empty() {
        bail!(
            "no view has both a mask and joint positions; {}",
            left_out.first().map_or("there are none", String::as_str)
        );
    }
    let overlays = args.overlays(&views)?;
    let before = rustix::time::clock_gettime(ClockId::ThreadCPUTime);
    let found = align(&lens.intrinsics, lens.width, lens.height, &meshes, &views, &args.start)?;
    let after = rustix::time::clock_gettime(ClockId::ThreadCPUTime);
    let mut result = Found::new(&found, &views, &args.start, &left_out);
    result.search_cpu_ms =
        (after.tv_sec - before.tv_sec) as f64 * 1e3 + (after.tv_nsec - before.tv_nsec) as f64 * 1e-6;
    for (file, view) in overlays.iter().zip(&views) {
        let drawn = drawing(
            &lens.intrinsics,
            lens.width,
            lens.height,
            &meshes,
            &view.base_from_links,
            &found.base_from_camera,
        )?;
        file.write(&image_file::png(&overlay(&view.mask, &drawn))?)?;
    }
    if let Some(out) = &out {
        out.write(toml::to_string(&result).context("the result cannot be written as TOML")?.as_bytes())?;
    }
    if args.json {
        out::json(&result)?;
    } else {
        out::line(result.text())?;
    }
    Ok(if left_out.is_empty() { Exit::Good } else { Exit::Lost })
}

impl AlignArgs {
    fn lens(&self) -> Result<Lens> {
        let Some(name) = &self.camera else {
            return self.intrinsics.context("neither --camera nor --intrinsics");
        };
        let camera = calibrate::camera(&self.calibration, name)?;
        Ok(Lens { intrinsics: camera.intrinsics(), width: camera.width, height: camera.height })
    }

    /// The images to write, checked to destroy nothing.
    fn overlays(&self, views: &[AlignView]) -> Result<Vec<OutFile>> {
        let Some(folder) = &self.overlay else { return Ok(Vec::new()) };
        let same =
            |other: &Path| folder.canonicalize().ok().is_some_and(|f| other.canonicalize().ok() == Some(f));
        if same(&self.masks) || self.depth.as_deref().is_some_and(same) {
            return Err(UsageError(format!("{}: is an input; name another folder", folder.display())).into());
        }
        std::fs::create_dir_all(folder)
            .with_context(|| format!("{}: cannot be created", folder.display()))?;
        views
            .iter()
            .map(|view| OutFile::new(&folder.join(format!("{}.png", view.name)), self.overwrite, &[]))
            .collect()
    }
}

/// Mask and drawing in one image: light where both are, red where the mask is alone, blue where the drawing is.
fn overlay(mask: &Mask, drawn: &Mask) -> RgbImage {
    RgbImage::from_fn(mask.width, mask.height, |x, y| {
        let i = y as usize * mask.width as usize + x as usize;
        match (mask.inside[i], drawn.inside[i]) {
            (true, true) => Rgb([200, 200, 200]),
            (true, false) => Rgb([230, 60, 40]),
            (false, true) => Rgb([40, 110, 230]),
            (false, false) => Rgb([0, 0, 0]),
        }
    })
}

/// The printed result.
#[derive(Serialize)]
struct Found<'a> {
    /// Whose frame the camera's pose is in, as `hand-eye` says it.
    camera_in: &'static str,
    sigma_mm: f64,
    sigma_deg: f64,
    /// Between the outlines of masks and arm, from their median.
    outline_px: f64,
    /// How far the masks reach beyond the arm on all sides.
    outset_px: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    depth_mm: Option<f64>,
    /// Processor time of the search, after loading.
    search_cpu_ms: f64,
    /// From the start.
    moved_mm: f64,
    moved_deg: f64,
    /// Rotation (radians) and place (metres) about and along the camera's axes.
    covariance: Vec<[f64; 6]>,
    left_out: &'a [String],
    camera: Pose,
    views: Vec<OfView<'a>>,
}

#[derive(Serialize)]
struct OfView<'a> {
    view: &'a str,
    /// Pixels in both mask and arm over pixels in either.
    overlap: f64,
    median_px: f64,
}

impl<'a> Found<'a> {
    fn new(found: &Alignment, views: &'a [AlignView], start: &Rigid, left_out: &'a [String]) -> Self {
        let root = |from: usize| (from..from + 3).map(|i| found.covariance[(i, i)]).sum::<f64>().sqrt();
        let moved = found.base_from_camera.distance(start);
        Self {
            camera_in: "base",
            sigma_mm: root(3) * 1e3,
            sigma_deg: root(0).to_degrees(),
            outline_px: found.outline_px,
            outset_px: found.outset_px,
            depth_mm: found.depth_m.map(|d| d * 1e3),
            search_cpu_ms: 0.0,
            moved_mm: moved.metres * 1e3,
            moved_deg: moved.radians.to_degrees(),
            covariance: (0..6).map(|i| core::array::from_fn(|k| found.covariance[(i, k)])).collect(),
            left_out,
            camera: Pose::from(&found.base_from_camera),
            views: views
                .iter()
                .zip(&found.views)
                .map(|(view, fit)| OfView {
                    view: &view.name,
                    overlap: fit.overlap,
                    median_px: fit.median_px,
                })
                .collect(),
        }
    }

    fn text(&self) -> String {
        let t = self.camera.translation_m;
        let q = self.camera.rotation_xyzw;
        let mut overlaps: Vec<f64> = self.views.iter().map(|v| v.overlap).collect();
        overlaps.sort_by(f64::total_cmp);
        let median = overlaps[overlaps.len() / 2];
        let depth = self.depth_mm.map_or(String::new(), |d| format!(", depth {d:.1} mm"));
        let mut lines = vec![format!(
            "camera    in the {}: translation_m = [{:.5}, {:.5}, {:.5}], rotation_xyzw = [{:.6}, {:.6}, {:.6}, {:.6}]\n\
             sigma     {:.2} mm, {:.3} degrees\n\
             residual  {:.2} px between outlines{depth}, over {}; masks reach {:.2} px beyond the arm\n\
             overlap   {:.1} % of mask and arm (median view), {:.1} % in the worst\n\
             start     was off by {:.0} mm and {:.1} degrees",
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
            self.outline_px,
            out::count(self.views.len(), "view"),
            self.outset_px,
            median * 1e2,
            overlaps[0] * 1e2,
            self.moved_mm,
            self.moved_deg
        )];
        for view in self.views.iter().filter(|v| v.overlap < DOUBTFUL * median) {
            lines.push(format!(
                "doubtful  view {}: mask and arm overlap by {:.0} %; check its joint positions and its mask",
                view.view,
                view.overlap * 1e2
            ));
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
    fn a_start_looks_where_it_says() {
        let pose = start("1.2 0 0.6 -1.5707963267948966 0 1.5707963267948966").unwrap();
        // Against the base's x axis, the image upright.
        assert!((pose.rotation * DVec3::Z + DVec3::X).length() < 1e-9);
        assert!((pose.rotation * DVec3::Y + DVec3::Z).length() < 1e-9);
        assert!(start("1,0,0,-90,0,90").unwrap_err().contains("look like degrees"));
        assert!(start("1200 0 600 0 0 0").unwrap_err().contains("look like millimetres"));
        assert!(start("1 2 3").unwrap_err().contains("write 6 numbers"));
    }

    #[test]
    fn intrinsics_are_checked() {
        assert_eq!(intrinsics("600,600,319.5,239.5,640,480").unwrap().width, 640);
        for wrong in [
            "600,600,319.5,239.5",
            "0,600,319.5,239.5,640,480",
            "600,600,319.5,239.5,640.5,480",
            "600,600,nan,239.5,640,480",
            "600,600,1e9,239.5,640,480",
        ] {
            assert!(intrinsics(wrong).is_err(), "{wrong}");
        }
    }
}
