//! The manifest of a folder: its TOML, and the checks that need no image.

use depthrig_bus::{Distortion, Intrinsics, PixelFormat, Pose, StreamName, files};
use depthrig_driver::image_file::io_error;
use depthrig_driver::{Error, ErrorKind, Result};
use serde::Deserialize;
use std::path::{Path, PathBuf};
use toml::Spanned;

/// The manifest's TOML, key by key; `example_camera.toml` explains each.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Manifest {
    pub(super) model: String,
    pub(super) serial: Option<String>,
    folder: Option<Spanned<String>>,
    pub(super) rate_hz: Spanned<f64>,
    #[serde(rename = "loop", default = "yes")]
    pub(super) looped: bool,
    #[serde(default)]
    pub(super) pair_by: PairBy,
    #[serde(default = "default_cache_mb")]
    pub(super) cache_mb: u64,
    #[serde(rename = "stream", default)]
    pub(super) streams: Vec<Spanned<StreamEntry>>,
}

const fn yes() -> bool {
    true
}

const fn default_cache_mb() -> u64 {
    512
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum PairBy {
    #[default]
    Number,
    Order,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct StreamEntry {
    pub(super) name: StreamName,
    pub(super) files: String,
    pub(super) format: Option<PixelFormat>,
    pub(super) depth_unit_m: Option<f64>,
    intrinsics: Option<IntrinsicsEntry>,
    intrinsics_file: Option<PathBuf>,
    pose_in_device: Option<PoseEntry>,
}

impl StreamEntry {
    pub(super) const fn has_intrinsics(&self) -> bool {
        self.intrinsics.is_some() || self.intrinsics_file.is_some()
    }
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct IntrinsicsEntry {
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    #[serde(default = "no_distortion")]
    model: Distortion,
    #[serde(default)]
    coeffs: Vec<f64>,
}

const fn no_distortion() -> Distortion {
    Distortion::None
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct PoseEntry {
    translation_m: [f64; 3],
    rotation_xyzw: [f64; 4],
}

/// A manifest with what is needed to speak about it: its path, and its text for line numbers.
pub(super) struct Loaded {
    pub(super) manifest: Manifest,
    pub(super) path: PathBuf,
    text: String,
}

impl Loaded {
    /// Reads the manifest at `path`, or `camera.toml` in the folder `path`.
    pub(super) fn read(path: &Path) -> Result<Self> {
        let path = if path.is_dir() { path.join("camera.toml") } else { path.to_owned() };
        let text = files::read_to_string(&path, files::TEXT_MAX_BYTES).map_err(|e| {
            let error = io_error(&path, e);
            let message =
                format!("the manifest of the files camera cannot be read: {error}; it is a TOML file");
            Error::new(error.kind(), message + " that says what the images are").with_source(error)
        })?;
        let manifest = toml::from_str(&text).map_err(|e| {
            let message = format!("{}: {}", path.display(), e.to_string().trim_end());
            Error::new(ErrorKind::BadInput, message).with_source(e)
        })?;
        Ok(Self { manifest, path, text })
    }

    /// An error about what stands at byte `at` of the manifest.
    pub(super) fn bad(&self, at: usize, what: impl core::fmt::Display) -> Error {
        let line = 1 + self.text.bytes().take(at).filter(|b| *b == b'\n').count();
        Error::new(ErrorKind::BadInput, format!("{}, line {line}: {what}", self.path.display()))
    }

    /// The folder of the images.
    pub(super) fn folder(&self) -> Result<PathBuf> {
        let base = self.path.parent().unwrap_or(Path::new(""));
        let base = if base.as_os_str().is_empty() { Path::new(".") } else { base };
        let folder = match &self.manifest.folder {
            None => base.to_owned(),
            Some(f) => {
                let lookup = |name: &str| std::env::var(name).ok();
                base.join(expand(f.get_ref(), lookup).map_err(|why| self.bad(f.span().start, why))?)
            }
        };
        match std::fs::metadata(&folder) {
            Ok(m) if m.is_dir() => Ok(folder),
            Ok(_) => Err(self.about_folder(ErrorKind::BadInput, &folder, "is not a folder")),
            Err(e) => {
                let kind = io_error(&folder, e).kind();
                Err(self.about_folder(kind, &folder, "cannot be opened: no such folder, or no permission"))
            }
        }
    }

    fn about_folder(&self, kind: ErrorKind, folder: &Path, what: &str) -> Error {
        let said = self.manifest.folder.as_ref().map_or(".", |f| f.get_ref().as_str());
        let manifest = self.path.display();
        let folder = folder.display();
        let message = format!("{manifest}: the folder of the images, {folder} (folder = \"{said}\"), {what}");
        Error::new(kind, message)
    }

    /// The intrinsics of a stream; those of nobody when the manifest gives none.
    pub(super) fn intrinsics(&self, stream: &Spanned<StreamEntry>, folder: &Path) -> Result<Intrinsics> {
        let at = stream.span().start;
        let entry = stream.get_ref();
        let name = &entry.name;
        match (&entry.intrinsics, &entry.intrinsics_file) {
            (None, None) => Ok(Intrinsics::default()),
            (Some(_), Some(_)) => {
                Err(self
                    .bad(at, format!("stream \"{name}\" has both intrinsics and intrinsics_file; keep one")))
            }
            (Some(i), None) => {
                i.check().map_err(|why| self.bad(at, format!("intrinsics of stream \"{name}\": {why}")))
            }
            (None, Some(file)) => {
                let path = folder.join(file);
                let text =
                    files::read_to_string(&path, files::TEXT_MAX_BYTES).map_err(|e| io_error(&path, e))?;
                parse_matrix(&text)
                    .map_err(|why| Error::new(ErrorKind::BadInput, format!("{}: {why}", path.display())))
            }
        }
    }

    /// The pose of a stream in its device.
    pub(super) fn pose(&self, stream: &Spanned<StreamEntry>) -> Result<Pose> {
        let Some(p) = &stream.get_ref().pose_in_device else { return Ok(Pose::IDENTITY) };
        let norm = p.rotation_xyzw.iter().map(|q| q * q).sum::<f64>().sqrt();
        let finite = p.translation_m.iter().all(|t| t.is_finite());
        if !finite || !norm.is_finite() || (norm - 1.0).abs() > 1e-3 {
            let name = &stream.get_ref().name;
            let what = format!(
                "pose_in_device of stream \"{name}\": rotation_xyzw must be a quaternion of length 1 (it has \
                 {norm}), translation_m three numbers in metres"
            );
            return Err(self.bad(stream.span().start, what));
        }
        Ok(Pose { translation_m: p.translation_m, rotation_xyzw: p.rotation_xyzw.map(|q| q / norm) })
    }
}

impl IntrinsicsEntry {
    fn check(&self) -> Result<Intrinsics, String> {
        let most = match self.model {
            Distortion::Unknown => {
                return Err("model \"unknown\" says nothing; leave the intrinsics out".to_owned());
            }
            Distortion::None => 0,
            Distortion::BrownConrady | Distortion::InverseBrownConrady => 5,
            Distortion::KannalaBrandt4 => 4,
            _ => 8,
        };
        if self.coeffs.len() > most {
            let n = self.coeffs.len();
            return Err(format!("{n} coefficients, but this distortion model has at most {most}"));
        }
        if let Some(c) = self.coeffs.iter().find(|c| !c.is_finite()) {
            return Err(format!("invalid coefficient {c}; coefficients are finite numbers"));
        }
        let mut k = pinhole(self.fx, self.fy, self.cx, self.cy)?;
        k.model = self.model as u32;
        k.coeffs[..self.coeffs.len()].copy_from_slice(&self.coeffs);
        Ok(k)
    }
}

fn pinhole(fx: f64, fy: f64, cx: f64, cy: f64) -> Result<Intrinsics, String> {
    let good = [fx, fy, cx, cy].iter().all(|v| v.is_finite()) && fx > 0.0 && fy > 0.0;
    if good {
        Ok(Intrinsics::pinhole(fx, fy, cx, cy))
    } else {
        Err(format!(
            "invalid focal lengths or centre: fx {fx}, fy {fy}, cx {cx}, cy {cy}; they are in pixels, fx and fy above 0"
        ))
    }
}

/// Reads `fx 0 cx / 0 fy cy / 0 0 1`.
fn parse_matrix(text: &str) -> Result<Intrinsics, String> {
    const WANTED: &str = "expected a 3x3 matrix `fx 0 cx / 0 fy cy / 0 0 1`";
    let words = text.split(|c: char| c.is_whitespace() || c == ',').filter(|w| !w.is_empty());
    let numbers = words
        .map(|w| w.parse::<f64>().map_err(|_| format!("\"{w}\" is not a number; {WANTED}")))
        .collect::<Result<Vec<_>, _>>()?;
    match numbers[..] {
        [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0] => pinhole(fx, fy, cx, cy),
        [_, _, _, _, _, _, _, _, _] => {
            Err(format!("the matrix has other numbers where 0 and 1 belong; {WANTED}"))
        }
        _ => Err(format!("{} numbers; {WANTED}", numbers.len())),
    }
}

/// Replaces `${NAME}` and `${NAME:-default}` (also when the variable is empty, as a shell does).
fn expand(text: &str, lookup: impl Fn(&str) -> Option<String>) -> Result<String, String> {
    let mut out = String::new();
    let mut rest = text;
    while let Some((before, after)) = rest.split_once("${") {
        let Some((inside, tail)) = after.split_once('}') else {
            return Err(format!("\"{text}\": `${{` without `}}`"));
        };
        let (name, default) = inside.split_once(":-").map_or((inside, None), |(n, d)| (n, Some(d)));
        let value = lookup(name).filter(|v| !v.is_empty() || default.is_none());
        let Some(value) = value.or_else(|| default.map(str::to_owned)) else {
            return Err(format!("the environment variable {name} of \"{text}\" is not set"));
        };
        out.push_str(before);
        out.push_str(&value);
        rest = tail;
    }
    out.push_str(rest);
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn variables_expand_as_in_a_shell() {
        let vars = |name: &str| match name {
            "A" => Some("/data".to_owned()),
            "EMPTY" => Some(String::new()),
            _ => None,
        };
        assert_eq!(expand("${A}/x", vars).unwrap(), "/data/x");
        assert_eq!(expand("y${A}${A:-z}", vars).unwrap(), "y/data/data");
        assert_eq!(expand("${EMPTY:-z}${EMPTY}", vars).unwrap(), "z");
        assert_eq!(expand("${NOPE:-../d}/0", vars).unwrap(), "../d/0");
        assert_eq!(expand("$A {A}", vars).unwrap(), "$A {A}");
        assert!(expand("${NOPE}/0", vars).unwrap_err().contains("variable NOPE of \"${NOPE}/0\" is not set"));
        assert!(expand("${A", vars).unwrap_err().contains("without"));
    }

    #[test]
    fn matrices() {
        let k = parse_matrix("460.5 0.000 319.5\n0 461 237\n0 0 1.0").unwrap();
        assert_eq!(k, Intrinsics::pinhole(460.5, 461.0, 319.5, 237.0));
        assert_eq!(parse_matrix("460.5, 0, 319.5, 0, 461, 237, 0, 0, 1").unwrap(), k);
        for (text, wanted) in [
            ("1 0 2 0 1 3 0 0", "8 numbers"),
            ("1 0 2 0 1 3 0 0 x", "\"x\" is not a number"),
            ("1 0.1 2 0 1 3 0 0 1", "other numbers"),
            ("0 0 2 0 1 3 0 0 1", "invalid focal lengths"),
            ("nan 0 2 0 1 3 0 0 1", "invalid focal lengths"),
        ] {
            let error = parse_matrix(text).unwrap_err();
            assert!(error.contains(wanted), "{text}: {error}");
        }
    }
}
