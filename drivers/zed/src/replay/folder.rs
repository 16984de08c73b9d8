//! A folder of side-by-side images: PNG or JPEG, the left image in the left half, in the order of the numbers in their
//! names.
//!
//! If the last number of every name has 19 digits, it is the pair's time in nanoseconds.

use super::{DEFAULT_RATE_HZ, Next, OpenOptions, Pair, Source, SourceInfo, calibration};
use depthrig_bus::PixelFormat;
use depthrig_driver::file_pattern::Key;
use depthrig_driver::image_file::{Info, Kind, decode, io_error, probe};
use depthrig_driver::unpack::{Half, copy_half};
use depthrig_driver::{Error, ErrorKind, Result};
use std::path::{Path, PathBuf};

/// Digits of a time in nanoseconds since 1970, from 2001 to 2286.
const TIME_DIGITS: usize = 19;

/// An open folder.
pub(super) struct Folder {
    info: SourceInfo,
    image: Info,
    images: Vec<PathBuf>,
    times: Vec<i64>,
    next: usize,
    /// A complete side-by-side image.
    both: Vec<u8>,
}

impl Folder {
    pub(super) fn open(path: &Path, options: &OpenOptions) -> Result<Self> {
        let images = images(path)?;
        let image = alike(&images)?;
        let bad = |what: String| Error::new(ErrorKind::BadInput, format!("{}: {what}", path.display()));
        if !image.width.is_multiple_of(2) {
            return Err(bad(format!(
                "the images are {image}; a side-by-side image has an even width, with the left image in its left half"
            )));
        }
        let format = match image.kind {
            Kind::Rgb8 => PixelFormat::Rgb8,
            Kind::Grey8 => PixelFormat::Mono8,
            Kind::Grey16 => {
                return Err(bad(format!("the images are {image}; supported are 8-bit colour and grey")));
            }
        };
        let width = image.width / 2;
        let height = image.height;
        let wanted = options.serial.clone().unwrap_or_default();
        let (calibration, calibration_origin, of) = calibration(path, options, &wanted, width, height)?;
        let times = times(&images);
        let recorded = times.as_ref().and_then(|t| rate_of(t));
        let info = SourceInfo {
            path: path.to_owned(),
            kind: "folder",
            model: "ZED".to_owned(),
            serial: if wanted.is_empty() { of.unwrap_or_default() } else { wanted },
            width,
            height,
            format,
            rate_hz: options.rate_hz.or(recorded).unwrap_or(DEFAULT_RATE_HZ),
            timed: times.is_some(),
            calibration,
            calibration_origin,
        };
        let both = vec![0; image.bytes() as usize];
        let times = times.unwrap_or_else(|| {
            (0..images.len()).map(|i| (i as f64 * 1e9 / info.rate_hz).round() as i64).collect()
        });
        Ok(Self { info, image, images, times, next: 0, both })
    }
}

impl Source for Folder {
    fn info(&self) -> &SourceInfo {
        &self.info
    }

    fn len_hint(&self) -> Option<u64> {
        Some(self.images.len() as u64)
    }

    fn next(&mut self, pair: &mut Pair) -> Result<Next> {
        let i = self.next;
        let Some((image, time)) = self.images.get(i).zip(self.times.get(i)) else { return Ok(Next::End) };
        self.next += 1;
        (pair.index, pair.capture_time_ns) = (i as u64, *time);
        match decode(image, &self.image, &mut self.both) {
            Ok(()) => {}
            Err(e) if e.kind() == ErrorKind::BadInput => return Ok(Next::Damaged(e.to_string())),
            Err(e) => return Err(Error::new(ErrorKind::Io, e.to_string()).with_source(e)),
        }
        let bytes = self.info.image_bytes();
        let stride = self.info.format.row_bytes(self.image.width) as usize;
        for (half, pixels) in [(Half::Left, &mut pair.left), (Half::Right, &mut pair.right)] {
            pixels.resize(bytes, 0);
            if let Err(reason) = copy_half(&self.both, stride, stride / 2, half, pixels) {
                return Ok(Next::Damaged(format!("{}: {}", image.display(), reason.name())));
            }
        }
        Ok(Next::Pair)
    }

    fn seek(&mut self, index: u64) -> Result<()> {
        self.next = usize::try_from(index).unwrap_or(usize::MAX).min(self.images.len());
        Ok(())
    }
}

/// The images of the folder in the order of their names.
fn images(folder: &Path) -> Result<Vec<PathBuf>> {
    let entries = std::fs::read_dir(folder).map_err(|e| io_error(folder, e))?;
    let mut found = Vec::new();
    let mut dataset = false;
    for entry in entries {
        let path = entry.map_err(|e| io_error(folder, e))?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let extension = path.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
        if matches!(extension.as_str(), "png" | "jpg" | "jpeg") && !name.starts_with('.') {
            found.push((Key::new(&[&name]), path));
        }
        dataset |= extension == "mcap";
    }
    if found.is_empty() {
        let cure = if dataset {
            "it is a dataset; recompute its depth with depthrig zed replay, or replay it with depthrig replay"
        } else {
            "write each pair as one PNG or JPEG, the left image in its left half"
        };
        let what = format!("{} has no side-by-side images (*.png, *.jpg); {cure}", folder.display());
        return Err(Error::new(ErrorKind::BadInput, what));
    }
    found.sort();
    Ok(found.into_iter().map(|(_, path)| path).collect())
}

/// Format of the images, which must be the same in all.
fn alike(images: &[PathBuf]) -> Result<Info> {
    let mut first: Option<(&Path, Info)> = None;
    for path in images {
        let info = probe(path)?;
        let (first_path, first) = *first.get_or_insert((path, info));
        if info != first {
            let a = first_path.display();
            let b = path.display();
            let what = format!("{a} is {first}, but {b} is {info}; the images of a recording must be alike");
            return Err(Error::new(ErrorKind::BadInput, what));
        }
    }
    let none = || Error::new(ErrorKind::BadInput, "a folder without images");
    first.map(|(_, info)| info).ok_or_else(none)
}

/// The times in the images' names, when each has one and they rise.
fn times(images: &[PathBuf]) -> Option<Vec<i64>> {
    let time = |path: &PathBuf| {
        let stem = path.file_stem()?.to_str()?;
        let last = stem.rsplit(|c: char| !c.is_ascii_digit()).find(|piece| !piece.is_empty())?;
        (last.len() == TIME_DIGITS).then(|| last.parse::<i64>().ok())?
    };
    let times = images.iter().map(time).collect::<Option<Vec<_>>>()?;
    times.windows(2).all(|w| w[0] < w[1]).then_some(times)
}

/// The rate of rising times: of the median step between two.
pub(super) fn rate_of(times: &[i64]) -> Option<f64> {
    let mut steps: Vec<_> = times.windows(2).map(|w| w[1].saturating_sub(w[0])).collect();
    steps.sort_unstable();
    let median = *steps.get(steps.len() / 2)?;
    let rate = 1e9 / median as f64;
    (median > 0 && rate <= super::MAX_RATE_HZ).then_some((rate * 100.0).round() / 100.0).filter(|r| *r > 0.0)
}
