//! Folders of depth images: references, predictions, raw depth, colour and materials with the same file names.

use super::read::{ENDINGS, Metres, depth, png8, raw};
use super::scenes::Scenes;
use super::{Images, Job, Loaded, Place, Source, same_size};
use anyhow::{Context, Result, bail};
use depthrig_bus::{Intrinsics, files};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// How deep folders are searched.
const DEEPEST: usize = 8;
/// Name of the row of raw depth.
pub const RAW: &str = "raw";

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

/// Folders beside each other.
pub struct Pairs<'a> {
    /// References.
    pub truth: &'a Path,
    /// Metres per unit of integer references.
    pub truth_unit_m: f64,
    /// Folders to compare.
    pub predictions: &'a [Named],
    /// Raw depth for refiners.
    pub raw: Option<&'a Named>,
    /// Colour.
    pub color: Option<&'a Path>,
    /// Materials.
    pub material: Option<&'a Path>,
    /// Lens of every image.
    pub lens: Option<Intrinsics>,
    /// The chosen scenes: folders.
    pub scenes: &'a Scenes,
    /// Resize predictions to their reference.
    pub resize: bool,
}

/// References with the files that belong to them.
pub struct Files {
    names: Vec<String>,
    /// How every file is read.
    form: Arc<Form>,
    items: std::vec::IntoIter<Item>,
    total: u64,
    left_out: Vec<String>,
}

/// How files are read.
pub struct Form {
    /// Metres per unit of predictions, by row.
    pub units: Vec<f64>,
    /// Metres per unit of references.
    pub truth_unit_m: f64,
    /// Metres per unit of raw depth.
    pub raw_unit_m: f64,
    /// Resize predictions to their reference.
    pub resize: bool,
}

/// Raw depth of a reference from one sensor.
pub struct Sensor {
    /// Group of its rows.
    pub group: String,
    /// Row of the raw depth.
    pub row: usize,
    /// Its file.
    pub path: PathBuf,
}

/// A reference.
pub struct Item {
    /// Where it comes from.
    pub place: Place,
    /// The file.
    pub truth: PathBuf,
    /// Raw depth.
    pub sensors: Vec<Sensor>,
    /// Group of the predictions, which is also a sensor's if they are of it.
    pub group: String,
    /// Predictions by row.
    pub predictions: Vec<(usize, PathBuf)>,
    /// Colour.
    pub color: Option<PathBuf>,
    /// Materials.
    pub material: Option<PathBuf>,
    /// Lens.
    pub lens: Option<Intrinsics>,
}

impl Files {
    /// Pairs the files of `truth` with those of the same path, but for the ending, in each of the other folders.
    pub fn pairs(of: &Pairs<'_>) -> Result<Self> {
        let truths = by_stem(of.truth, &ENDINGS)?;
        if truths.is_empty() {
            bail!("{}: contains no depth images; supported are {}", of.truth.display(), ENDINGS.join(", "));
        }
        let found =
            of.predictions.iter().map(|p| by_stem(&p.folder, &ENDINGS)).collect::<Result<Vec<_>>>()?;
        let optional = |folder: Option<&Path>, endings: &[&str]| -> Result<BTreeMap<String, PathBuf>> {
            Ok(folder.map(|f| by_stem(f, endings)).transpose()?.unwrap_or_default())
        };
        let raws = optional(of.raw.map(|r| r.folder.as_path()), &ENDINGS)?;
        let colors = optional(of.color, &["png", "jpg", "jpeg"])?;
        let materials = optional(of.material, &["png"])?;
        let first = usize::from(of.raw.is_some());
        let items = truths.into_iter().map(|(stem, truth)| {
            let path = |(k, f): (usize, &BTreeMap<String, PathBuf>)| Some((first + k, f.get(&stem)?.clone()));
            let predictions = found.iter().enumerate().filter_map(path).collect();
            let sensor = |path: &PathBuf| Sensor { group: String::new(), row: 0, path: path.clone() };
            let folder = Path::new(&stem).parent().map(|p| p.display().to_string()).unwrap_or_default();
            Item {
                sensors: raws.get(&stem).map(sensor).into_iter().collect(),
                color: colors.get(&stem).cloned(),
                material: materials.get(&stem).cloned(),
                place: Place { name: stem, scene: folder.clone(), sequence: folder },
                truth,
                group: String::new(),
                predictions,
                lens: of.lens,
            }
        });
        let items = of.scenes.keep(items.collect(), |i| &i.place)?;
        let form = Form {
            units: of.raw.iter().copied().chain(of.predictions).map(|p| p.unit_m).collect(),
            truth_unit_m: of.truth_unit_m,
            raw_unit_m: of.raw.map_or(of.truth_unit_m, |r| r.unit_m),
            resize: of.resize,
        };
        let names = of.raw.iter().copied().chain(of.predictions).map(|p| p.name.clone()).collect();
        Self::new(names, form, items)
    }

    /// From items; those without any prediction are left out.
    pub fn new(names: Vec<String>, form: Form, mut items: Vec<Item>) -> Result<Self> {
        let mut left_out = Vec::new();
        let mut missing = |name: &str, has: &dyn Fn(&Item) -> bool, known: bool| {
            let n = items.iter().filter(|i| has(i)).count();
            let first = items.iter().find(|i| !has(i));
            if let Some(first) = first.filter(|_| n > 0 || known) {
                left_out.push(format!(
                    "{name}: {} of {} references have no prediction, {} first",
                    items.len() - n,
                    items.len(),
                    first.place.name
                ));
            }
        };
        let mut groups: Vec<&str> = items.iter().flat_map(|i| &i.sensors).map(|s| s.group.as_str()).collect();
        groups.sort_unstable();
        groups.dedup();
        for group in &groups {
            let name = if group.is_empty() { RAW } else { group };
            missing(name, &|i| i.sensors.iter().any(|s| s.group == *group), false);
        }
        for (k, name) in names.iter().enumerate() {
            let is_raw = items.iter().flat_map(|i| &i.sensors).any(|s| s.row == k);
            if !is_raw {
                missing(name, &|i| i.predictions.iter().any(|(n, _)| *n == k), true);
            }
        }
        items.retain(|i| !i.predictions.is_empty() || !i.sensors.is_empty());
        if items.is_empty() {
            bail!(
                "no reference has a prediction: files belong together when their paths are the same but for the ending"
            );
        }
        let total = items.len() as u64;
        Ok(Self { names, form: Arc::new(form), items: items.into_iter(), total, left_out })
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
        let form = Arc::clone(&self.form);
        Some(Ok(Box::new(move || read(item, &form))))
    }

    fn left_out(&self) -> Vec<String> {
        self.left_out.clone()
    }
}

/// Reads a reference and what belongs to it.
fn read(item: Item, form: &Form) -> Result<Images> {
    let truth = Arc::new(depth(&item.truth, form.truth_unit_m)?);
    let mut predictions = Vec::new();
    for (k, path) in &item.predictions {
        let mut p = depth(path, form.units[*k])?;
        let size = (truth.width, truth.height);
        if form.resize && (p.width, p.height) != size && p.width > 0 && p.height > 0 {
            p = p.resized(size);
        }
        same_size(&path.display().to_string(), (p.width, p.height), &truth)?;
        predictions.push((*k, p));
    }
    let color = item.color.as_deref().map(crate::image_file::open).transpose()?;
    let color = color.map(|c| Arc::new(c.into_rgb8()));
    let material = item.material.as_deref().map(|p| material(p, &truth)).transpose()?.map(Arc::new);
    let loaded = |group: String, predictions: Vec<(usize, Metres)>| Loaded {
        group,
        place: item.place.clone(),
        truth: Arc::clone(&truth),
        predictions,
        raw: None,
        color: color.clone(),
        material: material.clone(),
        lens: item.lens,
    };
    let mut images = Images::default();
    for sensor in item.sensors {
        let raw = raw(&sensor.path, form.raw_unit_m)?;
        same_size(&sensor.path.display().to_string(), (raw.width, raw.height), &truth)?;
        let own = if sensor.group == item.group { std::mem::take(&mut predictions) } else { Vec::new() };
        images.loaded.push(Loaded { raw: Some((sensor.row, raw)), ..loaded(sensor.group, own) });
    }
    if !predictions.is_empty() {
        images.loaded.push(loaded(item.group.clone(), predictions));
    }
    Ok(images)
}

fn material(path: &Path, truth: &Metres) -> Result<Vec<u8>> {
    let what = || format!("{}: cannot be read as materials", path.display());
    let bytes = files::read(path, files::IMAGE_MAX_BYTES).with_context(what)?;
    let (size, numbers) = png8(&bytes).with_context(what)?;
    same_size(&path.display().to_string(), size, truth)?;
    Ok(numbers)
}

/// The files of `folder` and the folders in it, by path below it without the ending.
pub fn by_stem(folder: &Path, endings: &[&str]) -> Result<BTreeMap<String, PathBuf>> {
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
