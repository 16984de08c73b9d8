//! From a manifest to a checked list of images, stream by stream.

use super::FilesConfig;
use super::manifest::{Loaded, PairBy, StreamEntry};
use depthrig_bus::{ClockDomain, MetadataLevel, PixelFormat};
use depthrig_driver::file_pattern::{Key, captures};
use depthrig_driver::image_file::{Info, Kind, io_error, probe};
use depthrig_driver::{DeviceClock, DeviceInfo, Error, ErrorKind, Result, StreamProfile};
use std::path::{Path, PathBuf};
use toml::Spanned;

/// A camera from image files.
pub(super) struct Source {
    pub(super) info: DeviceInfo,
    pub(super) streams: Vec<SourceStream>,
    pub(super) playing: Playing,
}

/// How the images are played.
#[derive(Debug, Clone, Copy)]
pub(super) struct Playing {
    pub(super) rate_hz: f64,
    pub(super) looped: bool,
    pub(super) cache_bytes: u64,
}

/// One stream: all its images are what `image` says.
pub(super) struct SourceStream {
    pub(super) profile: StreamProfile,
    pub(super) image: Info,
    pub(super) paths: Vec<PathBuf>,
}

/// The fastest rate that is believed.
const MAX_RATE_HZ: f64 = 1000.0;

/// Reads the manifest, finds the images and checks them.
pub(super) fn load(config: &FilesConfig) -> Result<Source> {
    let loaded = Loaded::read(&config.manifest)?;
    let manifest = &loaded.manifest;
    let rate = &manifest.rate_hz;
    let rate_hz = config.rate_hz.unwrap_or(*rate.get_ref());
    if !(rate_hz > 0.0 && rate_hz <= MAX_RATE_HZ) {
        let what = format!(
            "a rate of {rate_hz} Hz is out of range: choose rate_hz above 0 and at most {MAX_RATE_HZ}"
        );
        return Err(match config.rate_hz {
            None => loaded.bad(rate.span().start, what),
            Some(_) => Error::new(ErrorKind::BadInput, format!("{}: {what}", loaded.path.display())),
        });
    }
    if manifest.streams.is_empty() {
        return Err(loaded.bad(0, "no [[stream]]: say which images there are"));
    }
    let folder = loaded.folder()?;
    let mut found = Vec::new();
    for (i, stream) in manifest.streams.iter().enumerate() {
        let name = &stream.get_ref().name;
        if manifest.streams[..i].iter().any(|s| s.get_ref().name == *name) {
            return Err(
                loaded.bad(stream.span().start, format!("a second stream \"{name}\"; names are unique"))
            );
        }
        found.push(find(&loaded, stream, &folder)?);
    }
    check_partners(manifest.pair_by, &found, &folder)?;
    let calibrated = manifest.streams.iter().any(|s| s.get_ref().has_intrinsics());
    let mut streams = Vec::new();
    for (stream, found) in manifest.streams.iter().zip(found) {
        let paths: Vec<_> = found.files.into_iter().map(|f| f.path).collect();
        let image = check_images(stream.get_ref(), &paths)?;
        let profile = profile(&loaded, stream, &folder, image, rate_hz)?;
        streams.push(SourceStream { profile, image, paths });
    }
    let place = std::fs::canonicalize(&folder).unwrap_or(folder);
    let of_folder = || place.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    let info = DeviceInfo {
        backend: "files",
        model: manifest.model.clone(),
        serial: manifest.serial.clone().unwrap_or_else(of_folder),
        firmware: String::new(),
        port: place.display().to_string(),
        calibration: if calibrated { format!("file {}", loaded.path.display()) } else { "none".to_owned() },
        motion: String::new(),
    };
    let looped = config.looped.unwrap_or(manifest.looped);
    let cache_bytes = manifest.cache_mb.saturating_mul(1_000_000);
    Ok(Source { info, streams, playing: Playing { rate_hz, looped, cache_bytes } })
}

/// The files of one stream, sorted.
struct StreamFiles<'a> {
    entry: &'a StreamEntry,
    files: Vec<FoundFile>,
}

#[derive(PartialEq, Eq, PartialOrd, Ord)]
struct FoundFile {
    key: Key,
    path: PathBuf,
    captures: Vec<String>,
}

/// Lists the files that fit the pattern of `stream`.
fn find<'a>(loaded: &Loaded, stream: &'a Spanned<StreamEntry>, folder: &Path) -> Result<StreamFiles<'a>> {
    let entry = stream.get_ref();
    let (below, pattern) = entry.files.rsplit_once('/').unwrap_or(("", &entry.files));
    if below.contains('*') {
        let what =
            format!("files = \"{}\": `*` can stand in the file name only, not in a folder", entry.files);
        return Err(loaded.bad(stream.span().start, what));
    }
    let place = folder.join(below);
    let mut files = Vec::new();
    for item in std::fs::read_dir(&place).map_err(|e| io_error(&place, e))? {
        let item = item.map_err(|e| io_error(&place, e))?;
        let name = item.file_name();
        if let Some(captures) = captures(pattern, &name.to_string_lossy())
            && !item.path().is_dir()
        {
            let key = Key::new(&captures);
            let captures = captures.into_iter().map(str::to_owned).collect();
            files.push(FoundFile { key, path: item.path(), captures });
        }
    }
    if files.is_empty() {
        let name = &entry.name;
        let place = place.display();
        let what =
            format!("stream \"{name}\": no file in {place} fits files = \"{pattern}\"; correct either");
        return Err(loaded.bad(stream.span().start, what));
    }
    files.sort();
    Ok(StreamFiles { entry, files })
}

/// Checks that every image of one stream has its partner in all the others.
fn check_partners(by: PairBy, found: &[StreamFiles<'_>], folder: &Path) -> Result<()> {
    if by == PairBy::Number {
        for f in found {
            let mut neighbours = f.files.iter().zip(f.files.iter().skip(1));
            if let Some((a, b)) = neighbours.find(|(a, b)| a.key == b.key) {
                let a = file_name(&a.path);
                let b = file_name(&b.path);
                let message = format!("{a} and {b} in {} have the same number; remove one", folder.display());
                return Err(Error::new(ErrorKind::BadInput, message));
            }
        }
    }
    for (a, b) in found.iter().flat_map(|a| found.iter().map(move |b| (a, b))) {
        let lonely = match by {
            _ if a.files.len() == 1 && b.files.len() == 1 => None,
            PairBy::Order => a.files.get(b.files.len()),
            PairBy::Number => {
                a.files.iter().find(|f| b.files.binary_search_by(|g| g.key.cmp(&f.key)).is_err())
            }
        };
        let Some(lonely) = lonely else { continue };
        let partner = match by {
            PairBy::Number => format!("{} is not there", partner_name(&b.entry.files, &lonely.captures)),
            PairBy::Order => "images are paired by their order".to_owned(),
        };
        let message = format!(
            "{}: {} has no partner in stream \"{}\": {partner} ({} of \"{}\", {} of \"{}\"); add the missing \
             image or remove this one",
            folder.display(),
            file_name(&lonely.path),
            b.entry.name,
            a.files.len(),
            a.entry.files,
            b.files.len(),
            b.entry.files,
        );
        return Err(Error::new(ErrorKind::BadInput, message));
    }
    Ok(())
}

/// The name that a partner would have, were its number spelt alike.
fn partner_name(pattern: &str, captures: &[String]) -> String {
    let mut captures = captures.iter();
    let pieces: Vec<_> = pattern.split('*').collect();
    let mut name = String::new();
    for (i, piece) in pieces.iter().enumerate() {
        name.push_str(piece);
        if i + 1 < pieces.len() {
            name.push_str(captures.next().map_or("*", String::as_str));
        }
    }
    name
}

fn file_name(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// Checks every image of a stream: complete, and of the same size and format as the others.
fn check_images(entry: &StreamEntry, paths: &[PathBuf]) -> Result<Info> {
    let mut first = None;
    for path in paths {
        let info = probe(path)?;
        let (first_path, first) = *first.get_or_insert((path, info));
        if info != first {
            let a = first_path.display();
            let b = path.display();
            let what = format!("stream \"{}\": {a} is {first}, but {b} is {info}", entry.name);
            return Err(Error::new(ErrorKind::BadInput, what + "; the images of a stream must be alike"));
        }
    }
    let nothing = || Error::new(ErrorKind::BadInput, format!("stream \"{}\" has no images", entry.name));
    first.map(|f| f.1).ok_or_else(nothing)
}

/// The profile of a stream's images.
fn profile(
    loaded: &Loaded,
    stream: &Spanned<StreamEntry>,
    folder: &Path,
    image: Info,
    rate_hz: f64,
) -> Result<StreamProfile> {
    let entry = stream.get_ref();
    let name = &entry.name;
    let bad = |what: String| loaded.bad(stream.span().start, format!("stream \"{name}\": {what}"));
    let format = format_of(entry, image.kind).map_err(bad)?;
    let depth_unit_m = match (format.is_depth(), entry.depth_unit_m) {
        (true, None) => {
            let what = format!("the images are {image} depth, but depth_unit_m is missing");
            return Err(bad(what + "; say how many metres one unit is, such as 0.001"));
        }
        // From a micrometre to a metre: no camera has 1 (a forgotten unit) or a negative unit.
        (true, Some(unit)) if !(1e-6..1.0).contains(&unit) => {
            return Err(bad(format!(
                "depth_unit_m = {unit} is out of range 0.000001..1; most cameras use 0.001"
            )));
        }
        (true, Some(unit)) => unit,
        (false, Some(_)) => {
            return Err(bad(format!("{} images have no depth_unit_m; remove it", format.name())));
        }
        (false, None) => 0.0,
    };
    let intrinsics = loaded.intrinsics(stream, folder)?;
    let outside = |c: f64, size: u32| !(0.0..f64::from(size)).contains(&c);
    if intrinsics.is_known() && (outside(intrinsics.cx, image.width) || outside(intrinsics.cy, image.height))
    {
        tracing::warn!(
            "{}: stream \"{name}\": the principal point ({}, {}) lies outside the {image} images; are the \
             intrinsics for another size?",
            loaded.path.display(),
            intrinsics.cx,
            intrinsics.cy
        );
    }
    Ok(StreamProfile {
        stream: name.clone(),
        format,
        width: image.width,
        height: image.height,
        rate_hz,
        depth_unit_m,
        intrinsics,
        pose_in_device: loaded.pose(stream)?,
        // The schedule is kept on the host's clock: see the documentation of the module `files`.
        clock: DeviceClock { counter_bits: 64, tick_ps: 1000, domain: ClockDomain::Kernel },
        sequence_bits: 64,
        metadata: MetadataLevel::Kernel,
    })
}

/// The pixel format of images of `kind`, as wished for or by the name of the stream.
fn format_of(entry: &StreamEntry, kind: Kind) -> Result<PixelFormat, String> {
    let name = entry.name.as_str();
    let (fitting, default): (&[PixelFormat], _) = match kind {
        Kind::Rgb8 => (&[PixelFormat::Rgb8], Some(PixelFormat::Rgb8)),
        Kind::Grey8 if name == "confidence" => {
            (&[PixelFormat::Confidence8, PixelFormat::Mono8], Some(PixelFormat::Confidence8))
        }
        Kind::Grey8 => (&[PixelFormat::Mono8, PixelFormat::Confidence8], Some(PixelFormat::Mono8)),
        Kind::Grey16 => {
            let depth = name.starts_with("depth") || entry.depth_unit_m.is_some();
            let ir = name.starts_with("ir");
            let default = if depth { Some(PixelFormat::Z16) } else { ir.then_some(PixelFormat::Mono16) };
            (&[PixelFormat::Z16, PixelFormat::Mono16], default)
        }
    };
    match entry.format {
        Some(wish) if fitting.contains(&wish) => Ok(wish),
        Some(wish) => {
            let names: Vec<_> = fitting.iter().map(|f| f.name()).collect();
            Err(format!("{kind} images cannot be {}, they can be {}", wish.name(), names.join(" or ")))
        }
        None if name.starts_with("depth") && kind != Kind::Grey16 => Err(format!(
            "the images are {kind}, but depth is 16-bit grey PNG; was a preview picked by `files`?"
        )),
        None => default.ok_or_else(|| {
            format!("is {kind} depth or infrared? Give it depth_unit_m = …, or format = \"mono16\"")
        }),
    }
}
