//! Views of a robot's arm: joint positions from a CSV file, masks and depth from folders.

use crate::calibrate::images;
use crate::image_file;
use anyhow::{Context as _, Result, bail};
use depthrig_calibrate::align::{AlignView, DepthImage, JointKind, Kinematics, Limits, Mask};
use image::DynamicImage;
use std::collections::BTreeMap;
use std::f64::consts::TAU;
use std::path::{Path, PathBuf};

/// A position may be this far beyond its limits, radians or metres: encoders and descriptions round.
const LIMIT_SLACK: f64 = 0.02;

/// A joint that stands still in all views: `JOINT=POSITION`.
#[derive(Debug, Clone)]
pub struct Held {
    /// Name of the joint.
    pub joint: String,
    /// Radians or metres.
    pub position: f64,
}

/// Parses `JOINT=POSITION`.
///
/// # Errors
/// When the position is not a finite number.
pub fn held(text: &str) -> Result<Held, String> {
    let (joint, position) = text.split_once('=').ok_or("write JOINT=POSITION, such as finger=0.02")?;
    let number: f64 = position.parse().map_err(|_| format!("'{position}' is not a number"))?;
    if !number.is_finite() {
        return Err(format!("{number} is not finite"));
    }
    Ok(Held { joint: joint.to_owned(), position: number })
}

/// Positions of [`Kinematics::free_joints`] by the name of their view. `needed` says of a joint whether it moves anything visible.
///
/// # Errors
/// When a column or a position is missing, unknown, out of its range or looks like degrees; the message names line and joint.
pub fn joints(
    text: &str,
    kinematics: &Kinematics,
    held: &[Held],
    needed: impl Fn(&str) -> bool,
) -> Result<BTreeMap<String, Vec<f64>>> {
    let mut lines = text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty() && !l.starts_with('#'));
    let (_, header) = lines.next().context("the file is empty")?;
    let names: Vec<&str> = header.split(',').map(str::trim).collect();
    let view = names.iter().position(|n| *n == "view").context("the header has no column view")?;
    let free: Vec<&str> = kinematics.free_joints().map(|j| j.name.as_str()).collect();
    for (i, name) in names.iter().enumerate() {
        if names[..i].contains(name) {
            bail!("the header has the column {name} twice");
        }
        if i != view && !free.contains(name) {
            bail!("the robot has no moving joint {name}; its joints are {}", free.join(", "));
        }
    }
    for held in held {
        if !free.contains(&held.joint.as_str()) {
            bail!("--hold: the robot has no moving joint {}; its joints are {}", held.joint, free.join(", "));
        }
        if names.contains(&held.joint.as_str()) {
            bail!("--hold: joint {} has a column of its own", held.joint);
        }
    }
    let sources: Vec<Source> = kinematics
        .free_joints()
        .map(|joint| {
            if let Some(column) = names.iter().position(|n| *n == joint.name) {
                return Ok(Source::Column { column, limits: joint.limits, kind: joint.kind });
            }
            match held.iter().find(|h| h.joint == joint.name) {
                Some(held) => Ok(Source::Constant(held.position)),
                None if !needed(&joint.name) => Ok(Source::Constant(0.0)),
                None => bail!(
                    "the header has no column {0}; add it, or say where the joint stands in all views: --hold {0}=POSITION",
                    joint.name
                ),
            }
        })
        .collect::<Result<_>>()?;
    let mut all = BTreeMap::new();
    for (i, line) in lines {
        let cells: Vec<&str> = line.split(',').map(str::trim).collect();
        let at = || format!("line {}", i + 1);
        if cells.len() != names.len() {
            bail!("{}: {} values for {} columns", at(), cells.len(), names.len());
        }
        let positions = sources
            .iter()
            .map(|s| s.position(&cells, &names))
            .collect::<Result<Vec<f64>>>()
            .with_context(at)?;
        let name = view_name(cells[view]);
        if name.is_empty() {
            bail!("{}: has no view", at());
        }
        if all.insert(name.clone(), positions).is_some() {
            bail!("{}: view {name} is there twice", at());
        }
    }
    Ok(all)
}

/// Where a joint's positions come from.
enum Source {
    Constant(f64),
    Column { column: usize, limits: Option<Limits>, kind: JointKind },
}

impl Source {
    fn position(&self, cells: &[&str], names: &[&str]) -> Result<f64> {
        let (column, limits, kind) = match self {
            Self::Constant(position) => return Ok(*position),
            Self::Column { column, limits, kind } => (*column, limits, *kind),
        };
        let name = names[column];
        let cell = cells[column];
        let value: f64 = cell.parse().with_context(|| format!("joint {name}: '{cell}' is not a number"))?;
        if !value.is_finite() {
            bail!("joint {name}: {value} is not finite");
        }
        let within = limits.is_none_or(|l| (l.lower - LIMIT_SLACK..=l.upper + LIMIT_SLACK).contains(&value));
        match kind {
            // Joints without limits may have turned a few times.
            JointKind::Revolute if value.abs() > TAU * 1.02 && (!within || value.abs() > 3.0 * TAU) => bail!(
                "joint {name} is at {value} rad; positions are radians, these look like degrees: multiply them by 0.0174533"
            ),
            JointKind::Prismatic if !within && value.abs() > 1.0 => bail!(
                "joint {name} is at {value} m; positions of sliding joints are metres, these look like millimetres"
            ),
            _ => {}
        }
        if let Some(Limits { lower, upper }) = limits.filter(|_| !within) {
            bail!(
                "joint {name} is at {value}, out of its range {lower:.4}..={upper:.4}; check the order of the columns and the URDF"
            );
        }
        Ok(value)
    }
}

/// Numbers of views are compared as numbers are written without leading zeros.
fn view_name(text: &str) -> String {
    text.parse::<u64>().map_or_else(|_| text.to_owned(), |n| n.to_string())
}

/// The name of the view that an image is of: the last number in its name, or its name.
fn view_of(path: &Path) -> String {
    match images::number(path) {
        Some(number) => number.to_string(),
        None => path.file_stem().unwrap_or_default().to_string_lossy().into_owned(),
    }
}

/// Images of a folder by the name of their view. Where all names are among `known`, they are the views' names as they stand.
fn by_view(folder: &Path, known: &BTreeMap<String, Vec<f64>>) -> Result<BTreeMap<String, PathBuf>> {
    let files = images::list(folder)?;
    let stem = |p: &Path| view_name(&p.file_stem().unwrap_or_default().to_string_lossy());
    let as_they_stand = files.iter().any(|p| known.contains_key(&stem(p)));
    let mut all: BTreeMap<String, PathBuf> = BTreeMap::new();
    for path in files {
        let name = if as_they_stand { stem(&path) } else { view_of(&path) };
        if let Some(other) = all.get(&name) {
            bail!("{} and {} are both of view {name}; leave one", other.display(), path.display());
        }
        all.insert(name, path);
    }
    Ok(all)
}

/// Views of the arm.
#[derive(Debug)]
pub struct ArmViews {
    /// Views with a mask and positions.
    pub views: Vec<AlignView>,
    /// Views that lack one of both, and views without depth where others have it.
    pub left_out: Vec<String>,
}

/// Folders of images.
#[derive(Debug, Clone, Copy)]
pub struct Folders<'a> {
    /// Masks.
    pub masks: &'a Path,
    /// Depth, if there is any.
    pub depth: Option<&'a Path>,
    /// Metres of a depth image's unit.
    pub depth_unit_m: f64,
}

/// Reads masks and depth, and joins them with the joint positions.
///
/// # Errors
/// When a folder or an image cannot be read, is of another kind, or two images are of one view.
pub fn read(
    folders: &Folders,
    joints: &BTreeMap<String, Vec<f64>>,
    kinematics: &Kinematics,
) -> Result<ArmViews> {
    let masks = by_view(folders.masks, joints)?;
    let depths = folders.depth.map(|d| by_view(d, joints)).transpose()?;
    let mut all = ArmViews { views: Vec::new(), left_out: Vec::new() };
    for (name, positions) in joints {
        let Some(path) = masks.get(name) else {
            all.left_out.push(format!("view {name}: {} has no mask of it", folders.masks.display()));
            continue;
        };
        let depth = match depths.as_ref().map(|d| d.get(name)) {
            Some(Some(path)) => Some(depth(path, folders.depth_unit_m)?),
            Some(None) => {
                all.left_out.push(format!("view {name}: has no depth, its mask is used"));
                None
            }
            None => None,
        };
        let mask = mask(path)?;
        if let Some(depth) = &depth
            && (depth.width, depth.height) != (mask.width, mask.height)
        {
            bail!(
                "view {name}: depth is {}x{}, its mask {}x{}; use depth registered to the image that the masks are of",
                depth.width,
                depth.height,
                mask.width,
                mask.height
            );
        }
        all.views.push(AlignView {
            name: name.clone(),
            base_from_links: kinematics.poses(positions)?,
            mask,
            depth: depth.map(|d| d.image),
        });
    }
    for (name, path) in masks.iter().filter(|(name, _)| !joints.contains_key(*name)) {
        all.left_out.push(format!("{}: view {name} has no joint positions", path.display()));
    }
    Ok(all)
}

/// A mask: pixels above half of the brightest one, so that 0 and 1, 0 and 255 and probabilities all do.
fn mask(path: &Path) -> Result<Mask> {
    let image = image_file::open(path)?.to_luma16();
    let brightest = image.pixels().map(|p| p.0[0]).max().unwrap_or(0);
    let inside = image.pixels().map(|p| p.0[0] > brightest / 2).collect();
    Ok(Mask { width: image.width(), height: image.height(), inside })
}

struct Depth {
    width: u32,
    height: u32,
    image: DepthImage,
}

fn depth(path: &Path, unit_m: f64) -> Result<Depth> {
    let DynamicImage::ImageLuma16(image) = image_file::open(path)? else {
        bail!("{}: is no depth image; depth is a grey PNG of 16 bits, 0 where it is missing", path.display());
    };
    let metres = image.pixels().map(|p| (f64::from(p.0[0]) * unit_m) as f32).collect();
    Ok(Depth { width: image.width(), height: image.height(), image: DepthImage { metres } })
}

#[cfg(test)]
mod tests {
    use super::*;
    use depthrig_calibrate::Rigid;
    use depthrig_calibrate::align::Joint;
    use glam::DVec3;

    fn kinematics() -> Kinematics {
        let joint = |name: &str, parent: usize, kind| Joint {
            name: name.to_owned(),
            parent,
            child: parent + 1,
            origin: Rigid::IDENTITY,
            axis: DVec3::Z,
            kind,
            limits: Some(Limits { lower: -3.0, upper: 3.0 }),
            mimic: None,
        };
        let joints = vec![joint("turn", 0, JointKind::Revolute), joint("slide", 1, JointKind::Prismatic)];
        Kinematics::new((0..3).map(|i| i.to_string()).collect(), joints).unwrap()
    }

    fn read(text: &str, hold: &[&str]) -> Result<BTreeMap<String, Vec<f64>>> {
        let held: Vec<Held> = hold.iter().map(|h| held(h).unwrap()).collect();
        joints(text, &kinematics(), &held, |_| true)
    }

    fn refused(text: &str, hold: &[&str]) -> String {
        format!("{:#}", read(text, hold).unwrap_err())
    }

    #[test]
    fn positions_come_in_any_order_of_columns() {
        let all = read("slide,view,turn\n0.1,007,1.5\n", &[]).unwrap();
        assert_eq!(all["7"], [1.5, 0.1]);
        let held = read("view,turn\na,1.5\n", &["slide=0.2"]).unwrap();
        assert_eq!(held["a"], [1.5, 0.2]);
    }

    #[test]
    fn wrong_positions_are_refused_with_line_joint_and_cure() {
        assert!(refused("view,turn,slide\n1,90,0\n", &[]).contains("line 2: joint turn is at 90 rad"));
        assert!(refused("view,turn,slide\n1,0,200\n", &[]).contains("look like millimetres"));
        assert!(refused("view,turn,slide\n1,3.5,0\n", &[]).contains("out of its range -3.0000..=3.0000"));
        assert!(refused("view,turn\n1,0\n", &[]).contains("--hold slide=POSITION"));
        assert!(refused("view,turn,lift\n1,0,0\n", &[]).contains("its joints are turn, slide"));
        assert!(refused("view,turn,slide\n1,0\n", &[]).contains("2 values for 3 columns"));
        assert!(refused("view,turn,slide\n1,0,zero\n", &[]).contains("joint slide: 'zero'"));
        assert!(refused("view,turn,slide\n1,0,0\n01,0,0\n", &[]).contains("line 3: view 1 is there twice"));
        assert!(refused("turn,slide\n0,0\n", &[]).contains("no column view"));
        assert!(refused("view,turn,slide\n1,0,0\n", &["slide=1"]).contains("column of its own"));
        assert!(refused("", &[]).contains("empty"));
    }
}
