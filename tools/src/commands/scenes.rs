//! `depthrig scenes`: makes random scenes with true and measured depth.

use crate::context::Context;
use crate::exit::{Exit, UsageError};
use crate::out;
use crate::outfile::{OutFile, Overwrite};
use crate::progress::Progress;
use crate::scratch::{Scratch, path_of};
use crate::signals::Stop;
use crate::watched::usage;
use anyhow::{Result, bail};
use clap::ValueEnum;
use depthrig_convert::RunPart;
use depthrig_convert::scenes::{self, Plan, contact_sheet, write_world};
use depthrig_convert::store::Place;
use depthrig_sim::synthetic::scenes::{Family, Generator, Sensor, Settings, TriangleMesh, Triplet};
use std::path::{Path, PathBuf};

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
Each sample has colour, the true depth in colour's view, the depth that the camera measures, registered to colour, the
same without holes (as the refiner fill fills them), and the material of each pixel. Samples come in shards: tar files in the layout of WebDataset (docs/depth-lab.md).

A sample depends on the arguments, the seed and its number alone. A shard has its name once it is complete; a run that
was interrupted goes on where it was. --shard 0/4 makes the first of four parts, on this computer or another one.

--worlds DIR writes each world of the run as a folder DIR/NUMBER: meshes (PLY) with colours, camera, lamps, and what
the camera sees.

Families: box, ball, superquadric, cup, bottle, bowl, plate, cutlery, cable, cloth, and mesh with --meshes.
Cameras: d405, d415, d435, d455, l515, zed2i, kinect, generic.

Exit codes: 0 all shards are there, 1 failure, 2 wrong usage, 3 shards are missing because the run was interrupted.

Examples:
  depthrig scenes --count 20000 --camera d435,l515,zed2i --out train
  depthrig scenes --seed 8 --count 500 --without bottle,cup --out train
  depthrig scenes --count 20000 --hide 0.5 --out train
  depthrig scenes --count 20000 --sensor stereo --shard 2/8 --out train
  depthrig scenes --count 12 --preview sheet.png
  depthrig scenes --count 50 --camera d435 --dataset data/random
  depthrig scenes --count 8 --size 320x240 --worlds worlds";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct ScenesArgs {
    /// Folder of the shards, or s3://BUCKET/PREFIX
    #[arg(long, value_name = "DIR", required_unless_present_any = ["preview", "dataset", "worlds"])]
    out: Option<PathBuf>,
    /// New dataset, instead of shards: a world each set, one camera with its nominal lens, and true depth
    #[arg(long, value_name = "DIR", conflicts_with_all = ["out", "per_shard", "shard", "scratch", "name", "threads"])]
    dataset: Option<PathBuf>,
    /// Seed of the run
    #[arg(long, value_name = "N", default_value_t = 0)]
    seed: u64,
    /// Samples of the whole run
    #[arg(long, value_name = "N", default_value_t = 1000, value_parser = clap::value_parser!(u64).range(1..=9_999_999_999))]
    count: u64,
    /// Camera models, in turn
    #[arg(long, value_name = "NAME,...", default_value = "d435", value_delimiter = ',')]
    camera: Vec<String>,
    /// Measured depth of stereo cameras: drawn from statistics, or matched from infrared images
    #[arg(long, value_enum, default_value = "statistical")]
    sensor: SensorName,
    /// Share of the samples in which random regions of measured depth are hidden, 0 to 1
    #[arg(long, value_name = "SHARE", default_value_t = 0.0)]
    hide: f32,
    /// Number of the measurement: another one draws sensor and noise anew, of the same worlds
    #[arg(long, value_name = "N", default_value_t = 0)]
    again: u64,
    /// Width and height of the images, pixels
    #[arg(long, value_name = "WxH", default_value = "640x480", value_parser = size)]
    size: [u32; 2],
    /// Families of objects to use [default: all]
    #[arg(long, value_name = "NAME,...", value_delimiter = ',')]
    families: Vec<Family>,
    /// Families of objects to leave out
    #[arg(long, value_name = "NAME,...", value_delimiter = ',')]
    without: Vec<Family>,
    /// Folder of OBJ files for the family `mesh`
    #[arg(long, value_name = "DIR")]
    meshes: Option<PathBuf>,
    /// Samples of a shard
    #[arg(long, value_name = "N", default_value_t = 500, value_parser = clap::value_parser!(u64).range(1..=100_000))]
    per_shard: u64,
    /// Part of the run to make: K of N, from 0
    #[arg(long, value_name = "K/N", default_value_t = RunPart::ALL)]
    shard: RunPart,
    #[command(flatten)]
    scratch: Scratch,
    /// First part of the shards' names
    #[arg(long, value_name = "NAME", default_value = "scenes")]
    name: String,
    /// Image of the first samples: colour, true and measured depth
    #[arg(long, value_name = "FILE")]
    preview: Option<PathBuf>,
    /// Folder for the worlds as meshes, for other renderers
    #[arg(long, value_name = "DIR")]
    worlds: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Threads [default: all cores]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    threads: Option<u16>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// How depth of a stereo camera is measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum SensorName {
    Statistical,
    Stereo,
}

/// Samples on a contact sheet.
const PREVIEW: u64 = 12;

/// Parses a size such as `640x480`.
fn size(text: &str) -> Result<[u32; 2], String> {
    let wrong = || format!("write a size such as 640x480, not \"{text}\"");
    let (w, h) = text.split_once('x').ok_or_else(wrong)?;
    Ok([w.parse().map_err(|_| wrong())?, h.parse().map_err(|_| wrong())?])
}

/// Makes the samples.
pub fn run(args: &ScenesArgs, context: &Context) -> Result<Exit> {
    let generator = Generator::new(settings(args)?).map_err(|e| UsageError(e.to_string()))?;
    let preview = args.preview.as_ref().map(|path| OutFile::new(path, args.overwrite, &[])).transpose()?;
    let stop = Stop::on_signals()?;
    let mut bar = Progress::new(context.global.quiet > 0);
    if let Some(preview) = preview {
        let last = PREVIEW.min(args.count);
        let mut samples: Vec<Triplet> = Vec::new();
        for number in 0..last {
            bar.set("drawing the preview", number, last);
            samples.push(generator.sample(number)?);
            if stop.is_asked() {
                bail!("interrupted; the preview was not written");
            }
        }
        bar.clear();
        preview.write(&contact_sheet(&samples, generator.settings())?)?;
    }
    if let Some(folder) = &args.worlds {
        for number in 0..args.count {
            bar.set("writing worlds", number, args.count);
            write_world(&generator.world(number), generator.settings(), folder)?;
            if stop.is_asked() {
                bail!("interrupted after {} worlds", number + 1);
            }
        }
        bar.clear();
    }
    if let Some(dataset) = &args.dataset {
        return super::import::scenes(generator, args.count, dataset, args.json, context);
    }
    let Some(out) = &args.out else { return Ok(Exit::Good) };
    let place = Place::parse(out).map_err(usage)?;
    let scratch = args.scratch.folder(&[&place])?;
    let (folder, remote) = match place {
        Place::Local(folder) => (folder, None),
        Place::Remote(remote) => (path_of(scratch.as_ref()), Some(remote)),
    };
    let cores = || std::thread::available_parallelism().map_or(1, usize::from);
    let plan = Plan {
        folder,
        remote,
        name: args.name.clone(),
        count: args.count,
        per_shard: args.per_shard,
        part: args.shard,
        threads: args.threads.map_or_else(cores, usize::from),
    };
    let report = scenes::write(&generator, &plan, &mut |done, total| {
        bar.set("making scenes", done, total);
        !stop.is_asked()
    });
    bar.clear();
    let report = report.map_err(usage)?;
    if args.json {
        out::json(&report)?;
    } else {
        let found = match report.shards_found {
            0 => String::new(),
            n => format!(", {n} there before"),
        };
        out::line(format_args!("shards    {}{found}, {} missing", report.shards, report.shards_missing))?;
        out::line(format_args!(
            "samples   {} in {:.1} s, {:.2} per second and core, {}",
            report.samples,
            report.seconds,
            report.samples_per_core_second,
            out::bytes(report.bytes)
        ))?;
    }
    if report.shards_missing > 0 {
        out::note(format_args!("{} shards are missing; run the same command again", report.shards_missing));
        return Ok(Exit::Lost);
    }
    Ok(Exit::Good)
}

fn settings(args: &ScenesArgs) -> Result<Settings> {
    let meshes = args.meshes.as_deref().map(meshes).transpose()?.unwrap_or_default();
    let all: Vec<Family> = match args.families.as_slice() {
        [] => Family::ALL.into_iter().filter(|f| *f != Family::Mesh || !meshes.is_empty()).collect(),
        some => Family::ALL.into_iter().filter(|f| some.contains(f)).collect(),
    };
    Ok(Settings {
        seed: args.seed,
        width: args.size[0],
        height: args.size[1],
        cameras: args.camera.clone(),
        sensor: match args.sensor {
            SensorName::Statistical => Sensor::Statistical,
            SensorName::Stereo => Sensor::Stereo,
        },
        hide: args.hide,
        nominal_lens: args.dataset.is_some(),
        again: args.again,
        families: all.into_iter().filter(|f| !args.without.contains(f)).collect(),
        meshes,
    })
}

/// The OBJ files of a folder, by name.
fn meshes(folder: &Path) -> Result<Vec<TriangleMesh>> {
    let usage = |what: String| UsageError(format!("{}: {what}", folder.display()));
    let entries = folder.read_dir().map_err(|e| usage(format!("cannot be read ({e}); name a folder")))?;
    let mut paths: Vec<PathBuf> = entries.filter_map(|e| e.ok().map(|e| e.path())).collect();
    paths.retain(|p| p.extension().is_some_and(|e| e.eq_ignore_ascii_case("obj")));
    paths.sort();
    if paths.is_empty() {
        return Err(usage("it has no OBJ file".into()).into());
    }
    paths.iter().map(|path| mesh(path)).collect()
}

fn mesh(path: &Path) -> Result<TriangleMesh> {
    let wrong = |e: std::io::Error| UsageError(format!("{}: cannot be read as OBJ: {e}", path.display()));
    let bytes = depthrig_bus::files::read(path, depthrig_bus::files::IMAGE_MAX_BYTES).map_err(wrong)?;
    let scene = mesh_loader::obj::from_slice(&bytes, Some(path), |_| {
        Err::<&[u8], _>(std::io::Error::other("materials are not used"))
    })
    .map_err(wrong)?;
    let mut all = TriangleMesh { name: path.display().to_string(), ..TriangleMesh::default() };
    for mesh in &scene.meshes {
        let first = all.corners.len() as u32;
        all.corners.extend(&mesh.vertices);
        all.triangles.extend(mesh.faces.iter().map(|t| t.map(|i| i + first)));
    }
    Ok(all)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_checked() {
        assert_eq!(size("640x480"), Ok([640, 480]));
        for bad in ["640", "640x", "x", "640x480x3", "-1x4"] {
            assert!(size(bad).unwrap_err().contains("640x480"), "{bad}");
        }
    }
}
