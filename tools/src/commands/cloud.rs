//! `depthrig cloud`: the point cloud of all cameras at one moment, and how well their surfaces agree.

use crate::calibrate;
use crate::context::Context;
use crate::exit::{Exit, UsageError};
use crate::live::{self, Shot};
use crate::outfile::{OutFile, Overwrite};
use crate::{cloud_image, image_file, out};
use anyhow::{Context as _, Result, bail};
use depthrig_bus::{FrameHeader, Intrinsics, PixelFormat, Pose};
use depthrig_calib::{
    Deprojection, DepthView, PointCloud, PoseExt, Registration, agreement, same_view, write_ply,
};
use depthrig_calibrate::file::Calibration;
use depthrig_calibrate::mount::Source;
use depthrig_recorder::Dataset;
use serde::Serialize;
use std::path::PathBuf;

mod moment;

use moment::Moment;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
Depth of each camera as it was recorded, or as the running rig delivers it now, in the mount's coordinates, coloured. The table has for each pair
of cameras the median difference of depth on surfaces that both see: a good calibration shows the depth's own errors there, a bad one more. --calibration puts
another calibration's poses and intrinsics in place of the recorded ones; --corrected applies its corrections of depth, or those of the dataset's own; --by-camera gives each
camera a colour of its own, which shows seams.

Exit codes: 0 written, 1 failure, 2 wrong usage.

Examples:
  depthrig cloud mount --by-camera
  depthrig cloud data/20261125_1015_kitchen --out kitchen.ply
  depthrig cloud data/20261125_1015_kitchen --calibration calibration.toml --corrected --out corrected.ply
  depthrig cloud data/20261125_1015_kitchen --set 40 --depth depth_refined --calibration calibration.toml --out after.ply";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct CloudArgs {
    /// Dataset, segment file or running rig [default: the only rig running]
    #[arg(value_name = "RIG|DATASET")]
    source: Option<PathBuf>,
    /// Set of a dataset to show [default: the middle one, or one near it that lacks less]
    #[arg(long, value_name = "ID")]
    set: Option<u64>,
    /// Depth stream to show [default: depth_refined, else depth, else the first mode]
    #[arg(long, value_name = "STREAM")]
    depth: Option<String>,
    /// Calibration whose poses and intrinsics replace the recorded ones
    #[arg(long, value_name = "FILE")]
    calibration: Option<PathBuf>,
    /// Correct a dataset's depth as that calibration says, or else the dataset's own
    #[arg(long)]
    corrected: bool,
    /// Leave out points further away than this, metres
    #[arg(long, value_name = "M", default_value_t = 5.0, value_parser = crate::args::range_limit_m)]
    max_m: f64,
    /// Colour the points by camera
    #[arg(long)]
    by_camera: bool,
    /// Point cloud to write (PLY)
    #[arg(long, value_name = "FILE", default_value = "cloud.ply")]
    out: PathBuf,
    /// Image of the cloud to write (PNG), seen from beside the mount
    #[arg(long, value_name = "FILE")]
    image: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Colours of cameras that colour-blind people distinguish, too (Okabe and Ito).
const COLORS: [[u8; 3]; 7] = [
    [230, 159, 0],
    [86, 180, 233],
    [0, 158, 115],
    [240, 228, 66],
    [0, 114, 178],
    [213, 94, 0],
    [204, 121, 167],
];
/// A point without colour.
const GREY: [u8; 3] = [160, 160, 160];

/// Reads, joins, compares and writes.
pub fn run(args: &CloudArgs, context: &Context) -> Result<Exit> {
    let source = live::source(args.source.as_deref(), context)?;
    let calibration = args.calibration.as_deref().map(calibrate::calibration).transpose()?;
    let file = OutFile::new(&args.out, args.overwrite, &[])?;
    let image = args.image.as_ref().map(|path| OutFile::new(path, args.overwrite, &[])).transpose()?;
    let moment = match &source {
        live::Source::Dataset(path) => {
            let mut dataset = Dataset::open(path)?;
            if args.corrected {
                dataset = calibrate::corrected::corrected(dataset, args.calibration.as_deref())?;
            }
            Moment::recorded(&dataset, args.set)?
        }
        live::Source::Rig(_) if args.corrected => {
            return Err(UsageError("--corrected corrects a dataset; record one first".into()).into());
        }
        live::Source::Rig(_) if args.set.is_some() => {
            return Err(UsageError(
                "--set chooses a set of a dataset; a running rig has one, the next".into(),
            )
            .into());
        }
        live::Source::Rig(rig) => match Moment::live(rig, context)? {
            Some(moment) => moment,
            None => bail!("interrupted; nothing was written"),
        },
    };
    let mut views = Vec::new();
    for name in &moment.cameras {
        views.extend(View::new(&moment, name, args, calibration.as_ref(), views.len())?);
    }
    if views.is_empty() {
        bail!(
            "{}: has no depth{}",
            moment.name,
            args.depth.as_ref().map_or_else(String::new, |d| format!(" '{d}'"))
        );
    }
    let mut all = PointCloud::default();
    for view in &views {
        all.points.extend(&view.cloud.points);
        all.colors.extend(&view.cloud.colors);
    }
    let mut bytes = Vec::new();
    write_ply(&all, &mut bytes)?;
    file.write(&bytes)?;
    if let Some(image) = &image {
        image.write(&image_file::png(&cloud_image::draw(&all))?)?;
    }
    let report = Report {
        set: moment.set,
        missing: moment.missing.iter().map(ToString::to_string).collect(),
        points: all.points.len(),
        pairs: pairs(&views)?,
        cameras: views.iter().map(View::line).collect(),
    };
    if args.json {
        out::json(&report)?;
    } else {
        out::line(report.text())?;
        let image = image.map_or_else(String::new, |i| format!(", {}", i.path().display()));
        out::line(format_args!("written   {}{image}", file.path().display()))?;
    }
    Ok(Exit::Good)
}

/// A camera's depth in the mount's coordinates.
struct View {
    name: String,
    stream: String,
    depth_m: Vec<f32>,
    size: (u32, u32),
    intrinsics: Intrinsics,
    pose: Pose,
    cloud: PointCloud,
}

impl View {
    /// `None` for a camera without the depth asked for.
    fn new(
        moment: &Moment,
        name: &str,
        args: &CloudArgs,
        calibration: Option<&Calibration>,
        index: usize,
    ) -> Result<Option<Self>> {
        let of_camera: Vec<&Shot> = moment.shots.iter().filter(|f| f.header.camera() == name).collect();
        let named = |stream: &str| of_camera.iter().find(|f| f.header.stream() == stream).copied();
        let is_depth = |f: &&&Shot| f.header.pixel_format().is_some_and(PixelFormat::is_depth);
        let frame = match &args.depth {
            Some(stream) => named(stream),
            // Refined depth has no correction of its own.
            None => named("depth_refined")
                .filter(|_| !args.corrected)
                .or_else(|| named("depth"))
                .or_else(|| of_camera.iter().find(is_depth).copied()),
        };
        let Some(frame) = frame else { return Ok(None) };
        let geometry = Geometry::new(&of_camera, name, calibration)?;
        let header = &frame.header;
        let what = || format!("{name}/{}", header.stream());
        let Some(depth_m) = image_file::depth_m(header, &frame.pixels)? else {
            bail!("{}: is not depth", what())
        };
        let intrinsics = geometry.intrinsics(header);
        let pose = geometry.pose(header);
        let size = (header.width, header.height);
        let shown: Vec<f32> =
            depth_m.iter().map(|d| if f64::from(*d) <= args.max_m { *d } else { 0.0 }).collect();
        let color = match named("color") {
            Some(color) if !args.by_camera => colors(color, header, &depth_m, &geometry)?,
            _ => None,
        };
        let mut cloud = PointCloud::default();
        Deprojection::new(&intrinsics, size)
            .with_context(what)?
            .cloud_of_metres(&shown, color.as_deref(), &mut cloud)
            .with_context(what)?;
        if color.is_some() {
            // Black is what a place outside the colour image gets.
            for color in cloud.colors.iter_mut().filter(|c| **c == [0; 3]) {
                *color = GREY;
            }
        } else {
            let paint = if args.by_camera { COLORS[index % COLORS.len()] } else { GREY };
            cloud.colors = vec![paint; cloud.points.len()];
        }
        cloud.transform(&pose);
        Ok(Some(Self {
            name: name.to_owned(),
            stream: header.stream().to_owned(),
            depth_m: shown,
            size,
            intrinsics,
            pose,
            cloud,
        }))
    }

    fn line(&self) -> CameraLine {
        CameraLine { camera: self.name.clone(), stream: self.stream.clone(), points: self.cloud.points.len() }
    }
}

/// Poses and intrinsics of a camera's streams: as recorded, or as a calibration has them.
struct Geometry<'a> {
    calibrated: Option<Calibrated<'a>>,
}

struct Calibrated<'a> {
    entry: &'a depthrig_calibrate::file::CalibratedCamera,
    /// From a recorded pose to the calibrated one.
    correction: Pose,
}

impl<'a> Geometry<'a> {
    fn new(frames: &[&Shot], name: &str, calibration: Option<&'a Calibration>) -> Result<Self> {
        let Some(calibration) = calibration.filter(|c| !c.cameras.is_empty()) else {
            return Ok(Self { calibrated: None });
        };
        for entry in calibration.of_camera(name) {
            let Some(frame) = frames.iter().find(|f| f.header.stream() == entry.stream) else { continue };
            let header = &frame.header;
            if (header.width, header.height) != (entry.width, entry.height) {
                bail!(
                    "{name}/{}: was calibrated at {}x{}, the image has {}x{}",
                    entry.stream,
                    entry.width,
                    entry.height,
                    header.width,
                    header.height
                );
            }
            let correction = entry.pose().compose(&header.pose.inverse());
            return Ok(Self { calibrated: Some(Calibrated { entry, correction }) });
        }
        bail!("the calibration has no stream of camera {name} that there is, too")
    }

    fn pose(&self, header: &FrameHeader) -> Pose {
        self.calibrated.as_ref().map_or(header.pose, |c| c.correction.compose(&header.pose))
    }

    fn intrinsics(&self, header: &FrameHeader) -> Intrinsics {
        match &self.calibrated {
            Some(c) if c.entry.source == Source::Calibrated && c.entry.stream == header.stream() => {
                c.entry.intrinsics()
            }
            _ => header.intrinsics,
        }
    }
}

/// The colour of each pixel of depth; `None` where it cannot be found, as without intrinsics.
fn colors(
    color: &Shot,
    depth: &FrameHeader,
    depth_m: &[f32],
    geometry: &Geometry<'_>,
) -> Result<Option<Vec<u8>>> {
    let rgb = image_file::to_rgb(&color.header, &color.pixels)?;
    let of = |h: &FrameHeader| (geometry.intrinsics(h), (h.width, h.height), geometry.pose(h));
    let (color_k, color_size, color_pose) = of(&color.header);
    let (depth_k, depth_size, depth_pose) = of(depth);
    if same_view((&color_k, color_size, &color_pose), (&depth_k, depth_size, &depth_pose)) {
        return Ok(Some(rgb.into_raw()));
    }
    let between = color_pose.inverse().compose(&depth_pose);
    let Ok(mut registration) = Registration::new(&depth_k, depth_size, &color_k, color_size, &between) else {
        return Ok(None);
    };
    // In steps of 0.1 mm up to 6.5 m, enough to find a colour.
    let steps: Vec<u16> = depth_m.iter().map(|d| (d * 1e4).clamp(0.0, 65_535.0) as u16).collect();
    let mut out = vec![0; depth_m.len() * 3];
    registration.color_to_depth(&steps, 1e-4, rgb.as_raw(), &mut out)?;
    Ok(Some(out))
}

fn pairs(views: &[View]) -> Result<Vec<PairLine>> {
    let mut lines = Vec::new();
    for a in views {
        for b in views.iter().filter(|b| b.name != a.name) {
            let other =
                DepthView { depth_m: &b.depth_m, size: b.size, intrinsics: &b.intrinsics, pose: &b.pose };
            if let Some(found) = agreement(&a.cloud, &other)? {
                lines.push(PairLine {
                    points_of: a.name.clone(),
                    against: b.name.clone(),
                    points: found.points,
                    median_mm: found.median_m * 1e3,
                    median_abs_mm: found.median_abs_m * 1e3,
                });
            }
        }
    }
    Ok(lines)
}

#[derive(Serialize)]
struct Report {
    /// Number of the set; absent of a running rig.
    set: Option<u64>,
    /// Streams without an image.
    missing: Vec<String>,
    points: usize,
    cameras: Vec<CameraLine>,
    pairs: Vec<PairLine>,
}

#[derive(Serialize)]
struct CameraLine {
    camera: String,
    stream: String,
    points: usize,
}

/// Points of one camera against the depth of another.
#[derive(Serialize)]
struct PairLine {
    points_of: String,
    against: String,
    points: usize,
    /// Positive: the second camera sees the surface further away.
    median_mm: f64,
    median_abs_mm: f64,
}

impl Report {
    fn text(&self) -> String {
        let header = ["POINTS OF", "AGAINST", "POINTS", "MEDIAN mm", "|MEDIAN| mm"];
        let rows = self.pairs.iter().map(|p| {
            vec![
                p.points_of.clone(),
                p.against.clone(),
                p.points.to_string(),
                format!("{:+.2}", p.median_mm),
                format!("{:.2}", p.median_abs_mm),
            ]
        });
        let pairs = if self.pairs.is_empty() {
            "no two cameras see the same surface".to_owned()
        } else {
            out::table(&header, 2, rows)
        };
        let set = self.set.map_or_else(|| "now".to_owned(), |id| format!("set {id}"));
        let missing = match self.missing.as_slice() {
            [] => String::new(),
            missing => format!("; no image of {}", missing.join(", ")),
        };
        format!(
            "{pairs}\n{set}: {} of {}{missing}",
            out::count(self.points, "point"),
            out::count(self.cameras.len(), "camera")
        )
    }
}
