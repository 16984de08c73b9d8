//! The layout of the HAMMER dataset.
//!
//! HAMMER (Jung et al. 2023, arXiv 2303.14840; `_dataset_processed` as released) is a folder per sequence, such as
//! `scene2_traj1_1`, with `polarization/` in it: `rgb/`, `_gt/`, `depth_d435/`, `depth_l515/` and `depth_tof/`, whose files
//! `000000.png` belong together, and `intrinsics.txt`; depth is 16-bit millimetres in the view of `rgb`. These names and the
//! unit are those that programs reading it use; the dataset itself was not at hand when this was written.

use super::Place;
use super::files::{Files, Form, Item, Named, RAW, Sensor, by_stem};
use super::read::ENDINGS;
use super::scenes::Scenes;
use anyhow::{Context, Result, bail};
use depthrig_bus::{Intrinsics, files};
use std::path::{Path, PathBuf};

/// HAMMER's reference, and what its cameras measured.
const TRUTH: &str = "_gt";
const DEPTH: [&str; 3] = ["depth_d435", "depth_l515", "depth_tof"];
const COLOR: &str = "rgb";
const VIEW: &str = "polarization";
const INTRINSICS: &str = "intrinsics.txt";
/// Group of predictions that were read from folders.
const PREDICTED: &str = "HAMMER";
/// Metres per unit of HAMMER's files.
pub const UNIT_M: f64 = 0.001;
/// The scenes that evaluations use.
pub const TEST_SCENES: [&str; 3] = ["scene12", "scene13", "scene14"];

/// Everything below `root` that is laid out as HAMMER. Further `predictions` and `material` have the same folders,
/// `SEQUENCE/000000.png`, or `SEQUENCE/polarization/000000.png`.
pub fn open(
    root: &Path,
    predictions: &[Named],
    material: Option<&Path>,
    scenes: &Scenes,
    resize: bool,
) -> Result<Files> {
    let mut views = Vec::new();
    find_views(root, 0, &mut views)?;
    if views.is_empty() {
        bail!(
            "{}: neither a dataset, nor shards (NAME-000000.tar), nor in the layout of HAMMER: it contains no \
             SEQUENCE/{VIEW}/{TRUTH}/000000.png",
            root.display()
        );
    }
    views.sort();
    let mut items = Vec::new();
    for view in views {
        let sequence = view.parent().and_then(Path::file_name).unwrap_or_default().to_string_lossy();
        let lens = lens(&view.join(INTRINSICS))?;
        for (stem, truth) in by_stem(&view.join(TRUTH), &["png"])? {
            let png =
                |folder: &str| Some(view.join(folder).join(format!("{stem}.png"))).filter(|p| p.is_file());
            let sensor = |d: &&str| Some(Sensor { group: (**d).into(), row: 0, path: png(d)? });
            let beside = |folder: &Path| {
                let folders = [folder.join(&*sequence), folder.join(&*sequence).join(VIEW)];
                let paths = folders.iter().flat_map(|f| ENDINGS.map(|e| f.join(format!("{stem}.{e}"))));
                paths.into_iter().find(|p| p.is_file())
            };
            let predicted = predictions.iter().enumerate();
            items.push(Item {
                place: Place {
                    name: format!("{sequence}/{stem}"),
                    scene: sequence.split('_').next().unwrap_or_default().to_owned(),
                    sequence: sequence.to_string(),
                },
                truth,
                sensors: DEPTH.iter().filter_map(sensor).collect(),
                group: PREDICTED.into(),
                predictions: predicted.filter_map(|(k, p)| Some((k + 1, beside(&p.folder)?))).collect(),
                color: png(COLOR),
                material: material.and_then(beside),
                lens,
            });
        }
    }
    let items = scenes.keep(items, |i| &i.place)?;
    let names = [RAW.to_owned()].into_iter().chain(predictions.iter().map(|p| p.name.clone())).collect();
    let units = [UNIT_M].into_iter().chain(predictions.iter().map(|p| p.unit_m)).collect();
    Files::new(names, Form { units, truth_unit_m: UNIT_M, raw_unit_m: UNIT_M, resize }, items)
}

/// The lens in a file of 3x3 numbers; `None` without a file.
fn lens(path: &Path) -> Result<Option<Intrinsics>> {
    let text = match files::read_to_string(path, files::TEXT_MAX_BYTES) {
        Ok(text) => text,
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(None),
        Err(e) => return Err(e).with_context(|| format!("{}: cannot be read", path.display())),
    };
    let numbers: Vec<f64> = text.split_whitespace().map_while(|t| t.parse().ok()).collect();
    match numbers[..] {
        [fx, _, cx, _, fy, cy, _, _, _] if fx > 0.0 && fy > 0.0 => {
            Ok(Some(Intrinsics::pinhole(fx, fy, cx, cy)))
        }
        _ => bail!("{}: it is not a 3x3 matrix of a camera", path.display()),
    }
}

fn find_views(folder: &Path, depth: usize, views: &mut Vec<PathBuf>) -> Result<()> {
    if folder.file_name().is_some_and(|n| n == VIEW) && folder.join(TRUTH).is_dir() {
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
