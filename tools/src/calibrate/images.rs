//! Sightings of a board from folders of images.

use super::{Looked, MIRROR_TRIES, Sightings, ViewedCamera, grey, is_mirrored, mirrored, seen};
use crate::exit::UsageError;
use crate::image_file;
use anyhow::{Context as _, Result, bail};
use depthrig_calibrate::board::Board;
use depthrig_calibrate::detect::{Detector, detector};
use depthrig_calibrate::file::Provenance;
use depthrig_calibrate::intrinsics::ImageSize;
use depthrig_calibrate::rig::RigView;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// A camera's folder: `NAME=FOLDER`.
#[derive(Debug, Clone)]
pub struct Folder {
    /// The camera's name.
    pub name: String,
    /// Its images.
    pub path: PathBuf,
}

/// Parses `NAME=FOLDER`.
///
/// # Errors
/// When the name is missing or not one.
pub fn folder(text: &str) -> Result<Folder, String> {
    let (name, path) = text.split_once('=').ok_or("write NAME=FOLDER, such as left=images/left")?;
    depthrig_bus::CameraName::new(name).map_err(|e| format!("invalid camera name {name}: {e}"))?;
    Ok(Folder { name: name.to_owned(), path: path.into() })
}

/// Extensions of images.
const EXTENSIONS: [&str; 5] = ["png", "jpg", "jpeg", "pgm", "ppm"];

/// Reads the folders and finds the board in each image. `progress` is called with images done and all; it returns whether to go on.
///
/// # Errors
/// When a folder cannot be read or has no images, images cannot be paired, or an image has another size than the others of
/// its camera.
pub fn read(
    folders: &[Folder],
    board: &Board,
    mut progress: impl FnMut(u64, u64) -> bool,
) -> Result<Option<Sightings>> {
    for (i, folder) in folders.iter().enumerate() {
        if folders[..i].iter().any(|f| f.name == folder.name) {
            return Err(UsageError(format!(
                "camera {} is there twice; give each camera one folder",
                folder.name
            ))
            .into());
        }
    }
    let files: Vec<Vec<PathBuf>> = folders.iter().map(|f| list(&f.path)).collect::<Result<_>>()?;
    let moments = paired(folders, &files)?;
    let detector = detector(board)?;
    let total = files.iter().map(Vec::len).sum::<usize>() as u64;
    let mut views = Sightings::default();
    let mut sizes: Vec<Option<ImageSize>> = vec![None; folders.len()];
    let mut done = 0;
    for moment in moments {
        let mut view = RigView { name: moment.name, seen: Vec::new() };
        for Shot { camera, path } in moment.shots {
            if !progress(done, total) {
                return Ok(None);
            }
            done += 1;
            let image = image_file::open(path)?.to_rgb8();
            let size = ImageSize { width: image.width(), height: image.height() };
            let known = *sizes[camera].get_or_insert(size);
            if known != size {
                bail!(
                    "{}: is {}x{}, other images of {} are {}x{}; a calibration is of one size",
                    path.display(),
                    size.width,
                    size.height,
                    folders[camera].name,
                    known.width,
                    known.height
                );
            }
            views.images += 1;
            let Looked { seen, refused } = seen(detector.as_ref(), board, camera, size, &grey(&image))?;
            match (seen, refused) {
                (Some(seen), _) => view.seen.push(seen),
                (None, Some(why)) => views.refused.push(format!("{}: {why}", path.display())),
                (None, None) => views.refused.push(format!(
                    "{}: no board as it is described; it may be hidden, blurred or another one",
                    path.display()
                )),
            }
        }
        if !view.seen.is_empty() {
            views.views.push(view);
        }
    }
    for (camera, of_camera) in files.iter().enumerate() {
        if !views.views.iter().any(|v| v.seen.iter().any(|s| s.camera == camera)) {
            refuse_mirrored(detector.as_ref(), board, &folders[camera].name, of_camera)?;
        }
    }
    for (folder, size) in folders.iter().zip(sizes) {
        let size = size.with_context(|| format!("{}: no image was read", folder.path.display()))?;
        views.cameras.push(ViewedCamera {
            name: folder.name.clone(),
            size,
            factory: None,
            provenance: Provenance { stream: "color".to_owned(), serial: String::new() },
        });
    }
    Ok(Some(views))
}

/// Refuses images that show the board in a mirror alone.
fn refuse_mirrored(detector: &dyn Detector, board: &Board, camera: &str, files: &[PathBuf]) -> Result<()> {
    for path in files.iter().take(MIRROR_TRIES) {
        let image = image_file::open(path)?.to_rgb8();
        let size = ImageSize { width: image.width(), height: image.height() };
        if is_mirrored(detector, board, size, &grey(&image))? {
            return Err(mirrored(camera));
        }
    }
    Ok(())
}

/// The images in a folder, in the order of their names.
///
/// # Errors
/// When it cannot be read or has no images.
pub fn list(folder: &Path) -> Result<Vec<PathBuf>> {
    let entries =
        folder.read_dir().with_context(|| format!("{}: cannot be read as a folder", folder.display()))?;
    let mut files = Vec::new();
    for entry in entries {
        let path = entry.with_context(|| format!("{}: cannot be read", folder.display()))?.path();
        let extension = path.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase);
        if extension.is_some_and(|e| EXTENSIONS.contains(&e.as_str())) {
            files.push(path);
        }
    }
    if files.is_empty() {
        bail!("{}: has no images ({})", folder.display(), EXTENSIONS.join(", "));
    }
    files.sort();
    Ok(files)
}

/// The last number in a file's name, which cameras that were triggered together share.
pub fn number(path: &Path) -> Option<u64> {
    let name = path.file_stem()?.to_str()?;
    let end = name.rfind(|c: char| c.is_ascii_digit())? + 1;
    // A character before the number may have several bytes.
    let before = name[..end].char_indices().rev().find(|(_, c)| !c.is_ascii_digit());
    let start = before.map_or(0, |(at, c)| at + c.len_utf8());
    name[start..end].parse().ok()
}

/// Images of one moment.
struct Moment<'a> {
    name: String,
    shots: Vec<Shot<'a>>,
}

/// An image of a camera.
struct Shot<'a> {
    camera: usize,
    path: &'a Path,
}

/// Images of one moment, by name: those with the same number in their names; without numbers, those at the same place in order.
fn paired<'a>(folders: &[Folder], files: &'a [Vec<PathBuf>]) -> Result<Vec<Moment<'a>>> {
    let numbered: Option<Vec<BTreeMap<u64, &Path>>> = files
        .iter()
        .map(|of_camera| {
            let by_number: Option<BTreeMap<u64, &Path>> =
                of_camera.iter().map(|p| Some((number(p)?, p.as_path()))).collect();
            by_number.filter(|m| m.len() == of_camera.len())
        })
        .collect();
    if let Some(numbered) = numbered {
        let mut moments: BTreeMap<u64, Vec<Shot<'_>>> = BTreeMap::new();
        for (camera, by_number) in numbered.into_iter().enumerate() {
            for (number, path) in by_number {
                moments.entry(number).or_default().push(Shot { camera, path });
            }
        }
        return Ok(moments
            .into_iter()
            .map(|(number, shots)| Moment { name: number.to_string(), shots })
            .collect());
    }
    let first = files.first().map_or(0, Vec::len);
    if let Some(k) = files.iter().position(|f| f.len() != first) {
        bail!(
            "{} has {} images, {} has {first}, and their names have no numbers to pair them by; name images of one moment \
             with the same number",
            folders[k].path.display(),
            files[k].len(),
            folders[0].path.display()
        );
    }
    Ok((0..first)
        .map(|i| {
            let shot = |(camera, f): (usize, &'a Vec<PathBuf>)| Shot { camera, path: f[i].as_path() };
            Moment { name: (i + 1).to_string(), shots: files.iter().enumerate().map(shot).collect() }
        })
        .collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folders(n: usize) -> Vec<Folder> {
        (0..n).map(|i| Folder { name: format!("cam{i}"), path: format!("cam{i}").into() }).collect()
    }

    fn files(names: &[&[&str]]) -> Vec<Vec<PathBuf>> {
        names.iter().map(|of| of.iter().map(PathBuf::from).collect()).collect()
    }

    #[test]
    fn images_are_paired_by_the_last_number_in_their_names() {
        let files =
            files(&[&["left01.jpg", "left02.jpg", "left10.jpg"], &["cam2_right_10.png", "cam2_right_2.png"]]);
        let moments = paired(&folders(2), &files).unwrap();
        let cameras: Vec<(&str, usize)> = moments.iter().map(|m| (m.name.as_str(), m.shots.len())).collect();
        assert_eq!(cameras, [("1", 1), ("2", 2), ("10", 2)]);
    }

    #[test]
    fn images_without_numbers_are_paired_by_order() {
        let same = files(&[&["a.png", "b.png"], &["x.png", "y.png"]]);
        assert_eq!(paired(&folders(2), &same).unwrap()[1].shots.len(), 2);
        let other = files(&[&["a.png", "b.png"], &["x.png"]]);
        let message = paired(&folders(2), &other).err().unwrap().to_string();
        assert!(message.contains("cam1 has 1 images, cam0 has 2"), "{message}");
    }

    #[test]
    fn numbers_stand_behind_any_letters() {
        for (name, expected) in
            [("ü7.png", Some(7)), ("12.png", Some(12)), ("a1b.png", Some(1)), ("ab.png", None)]
        {
            assert_eq!(number(Path::new(name)), expected, "{name}");
        }
    }
}
