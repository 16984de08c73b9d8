//! Folders of depth images, and the layout of the HAMMER dataset.
//!
//! HAMMER (Jung et al. 2023, arXiv 2303.14840; `_dataset_processed` as released) is a folder per sequence, such as
//! `scene2_traj1_1`, with `polarization/` in it: `rgb/`, `_gt/`, `depth_d435/`, `depth_l515/` and `depth_tof/`, whose files
//! `000000.png` belong together; depth is 16-bit millimetres in the view of `rgb`. These names and the unit are those that
//! programs reading it use; the dataset itself was not at hand when this was written. Nor is it known whether the tables
//! of "Manipulation as in Simulation" bound the range of depth or count holes, so both forms are given here.

use super::read::{ENDINGS, depth};
use super::{Job, Loaded, Source};
use anyhow::{Context, Result, bail};
use depthrig_bus::{FrameHeader, PixelFormat};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// HAMMER's reference, and what its cameras measured.
const HAMMER_TRUTH: &str = "_gt";
const HAMMER_DEPTH: [&str; 3] = ["depth_d435", "depth_l515", "depth_tof"];
const HAMMER_COLOR: &str = "rgb";
const HAMMER_VIEW: &str = "polarization";
/// Metres per unit of HAMMER's files.
pub const HAMMER_UNIT_M: f64 = 0.001;
/// Depth that evaluations of HAMMER count, metres.
pub const HAMMER_RANGE_M: (f64, f64) = (0.1, 6.0);
/// How deep folders are searched.
const DEEPEST: usize = 8;

/// A folder of predictions with its name.
#[derive(Debug, Clone)]
pub struct Named {
    /// Name of the prediction.
    pub name: String,
    /// Its path.
    pub folder: PathBuf,
    /// Metres per unit of its integer files.
    pub unit_m: f64,
}

/// References with the files that belong to them.
pub struct Files {
    names: Vec<String>,
    units: Arc<Vec<f64>>,
    truth_unit_m: f64,
    group: String,
    items: std::vec::IntoIter<Item>,
    total: u64,
    left_out: Vec<String>,
}

struct Item {
    name: String,
    truth: PathBuf,
    predictions: Vec<(usize, PathBuf)>,
    color: Option<PathBuf>,
}

impl Files {
    /// Pairs the files of `truth` with those of the same path, but for the ending, in each of `predictions`.
    pub fn pairs(
        predictions: &[Named],
        (truth, truth_unit_m): (&Path, f64),
        color: Option<&Path>,
    ) -> Result<Self> {
        let truths = by_stem(truth, &ENDINGS)?;
        if truths.is_empty() {
            bail!("{}: contains no depth images; supported are {}", truth.display(), ENDINGS.join(", "));
        }
        let found = predictions.iter().map(|p| by_stem(&p.folder, &ENDINGS)).collect::<Result<Vec<_>>>()?;
        let colors = color.map(|c| by_stem(c, &["png", "jpg", "jpeg"])).transpose()?.unwrap_or_default();
        let items = truths.into_iter().map(|(stem, truth)| {
            let of = |(k, f): (usize, &BTreeMap<String, PathBuf>)| Some((k, f.get(&stem)?.clone()));
            let predictions = found.iter().enumerate().filter_map(of).collect();
            Item { color: colors.get(&stem).cloned(), name: stem, truth, predictions }
        });
        Self::new(predictions, truth_unit_m, "", items.collect())
    }

    /// Everything below `root` that is laid out as HAMMER. Further `predictions` have the same folders,
    /// `SEQUENCE/000000.png`, or `SEQUENCE/polarization/000000.png`.
    pub fn hammer(root: &Path, predictions: &[Named]) -> Result<Self> {
        let mut views = Vec::new();
        find_views(root, 0, &mut views)?;
        if views.is_empty() {
            let shape = format!("SEQUENCE/{HAMMER_VIEW}/{HAMMER_TRUTH}/000000.png");
            bail!("{}: not in the layout of HAMMER: it contains no {shape}", root.display());
        }
        views.sort();
        let raw = HAMMER_DEPTH.map(|name| Named {
            name: name.into(),
            folder: PathBuf::new(),
            unit_m: HAMMER_UNIT_M,
        });
        let named: Vec<Named> = raw.into_iter().chain(predictions.iter().cloned()).collect();
        let mut items = Vec::new();
        for view in views {
            let sequence = view.parent().and_then(Path::file_name).unwrap_or_default();
            for (stem, truth) in by_stem(&view.join(HAMMER_TRUTH), &["png"])? {
                let raw = HAMMER_DEPTH.iter().map(|d| view.join(d).join(format!("{stem}.png"))).enumerate();
                let mut files: Vec<_> = raw.filter(|(_, p)| p.is_file()).collect();
                for (k, p) in predictions.iter().enumerate() {
                    let folders = [p.folder.join(sequence), p.folder.join(sequence).join(HAMMER_VIEW)];
                    let paths = folders.iter().flat_map(|f| ENDINGS.map(|e| f.join(format!("{stem}.{e}"))));
                    files.extend(
                        paths.into_iter().find(|p| p.is_file()).map(|path| (HAMMER_DEPTH.len() + k, path)),
                    );
                }
                let color = Some(view.join(HAMMER_COLOR).join(format!("{stem}.png"))).filter(|p| p.is_file());
                items.push(Item {
                    name: format!("{}/{stem}", sequence.display()),
                    truth,
                    predictions: files,
                    color,
                });
            }
        }
        Self::new(&named, HAMMER_UNIT_M, "HAMMER", items)
    }

    fn new(predictions: &[Named], truth_unit_m: f64, group: &str, mut items: Vec<Item>) -> Result<Self> {
        let mut left_out = Vec::new();
        for (k, p) in predictions.iter().enumerate() {
            let has = |i: &&Item| i.predictions.iter().any(|(n, _)| *n == k);
            let n = items.iter().filter(has).count();
            let first = items.iter().find(|i| !has(i));
            if let Some(first) = first.filter(|_| n > 0 || !p.folder.as_os_str().is_empty()) {
                let missing = items.len() - n;
                left_out.push(format!(
                    "{}: {missing} of {} references have no prediction, {} first",
                    p.name,
                    items.len(),
                    first.name
                ));
            }
        }
        items.retain(|i| !i.predictions.is_empty());
        if items.is_empty() {
            bail!(
                "no reference has a prediction: files belong together when their paths are the same but for the ending"
            );
        }
        Ok(Self {
            names: predictions.iter().map(|p| p.name.clone()).collect(),
            units: Arc::new(predictions.iter().map(|p| p.unit_m).collect()),
            truth_unit_m,
            group: group.into(),
            total: items.len() as u64,
            items: items.into_iter(),
            left_out,
        })
    }
}

impl Source for Files {
    fn names(&self) -> &[String] {
        &self.names
    }

    fn total(&self) -> u64 {
        self.total
    }

    fn next(&mut self) -> Option<Result<Job>> {
        let item = self.items.next()?;
        let units = Arc::clone(&self.units);
        let unit_m = self.truth_unit_m;
        let group = self.group.clone();
        Some(Ok(Box::new(move || {
            let truth = depth(&item.truth, unit_m)?;
            let mut predictions = Vec::new();
            for (k, path) in &item.predictions {
                let p = depth(path, units[*k])?;
                if (p.width, p.height) != (truth.width, truth.height) {
                    bail!(
                        "{}: it has {}x{} pixels and its reference {}x{}; compare images of one view and size",
                        path.display(),
                        p.width,
                        p.height,
                        truth.width,
                        truth.height
                    );
                }
                predictions.push((*k, p));
            }
            let color = item.color.as_deref().map(color).transpose()?;
            Ok(vec![Loaded { group, name: item.name, truth, predictions, color }])
        })))
    }

    fn left_out(&self) -> Vec<String> {
        self.left_out.clone()
    }
}

fn color(path: &Path) -> Result<(FrameHeader, Vec<u8>)> {
    let image = crate::image_file::open(path)?.into_rgb8();
    let mut header = FrameHeader::default();
    header.set_image(PixelFormat::Rgb8, image.width(), image.height());
    Ok((header, image.into_raw()))
}

/// The files of `folder` and the folders in it, by path below it without the ending.
fn by_stem(folder: &Path, endings: &[&str]) -> Result<BTreeMap<String, PathBuf>> {
    let mut found = BTreeMap::new();
    collect(folder, folder, endings, 0, &mut found)?;
    Ok(found)
}

fn collect(
    root: &Path,
    folder: &Path,
    endings: &[&str],
    depth: usize,
    found: &mut BTreeMap<String, PathBuf>,
) -> Result<()> {
    let entries =
        std::fs::read_dir(folder).with_context(|| format!("{}: cannot be read", folder.display()))?;
    for entry in entries {
        let path = entry.with_context(|| format!("{}: cannot be read", folder.display()))?.path();
        if path.is_dir() {
            if depth < DEEPEST {
                collect(root, &path, endings, depth + 1, found)?;
            }
            continue;
        }
        let ending = path.extension().and_then(|e| e.to_str()).map(str::to_lowercase);
        if !ending.is_some_and(|e| endings.contains(&e.as_str())) {
            continue;
        }
        let stem = path.with_extension("");
        let stem = stem.strip_prefix(root).unwrap_or(&stem).to_string_lossy().into_owned();
        if let Some(other) = found.insert(stem, path.clone()) {
            bail!("{} and {} have one name; keep one of them", other.display(), path.display());
        }
    }
    Ok(())
}

fn find_views(folder: &Path, depth: usize, views: &mut Vec<PathBuf>) -> Result<()> {
    if folder.file_name().is_some_and(|n| n == HAMMER_VIEW) && folder.join(HAMMER_TRUTH).is_dir() {
        views.push(folder.to_owned());
        return Ok(());
    }
    if depth >= 4 {
        return Ok(());
    }
    let entries =
        std::fs::read_dir(folder).with_context(|| format!("{}: cannot be read", folder.display()))?;
    for entry in entries {
        let path = entry.with_context(|| format!("{}: cannot be read", folder.display()))?.path();
        if path.is_dir() {
            find_views(&path, depth + 1, views)?;
        }
    }
    Ok(())
}
