//! The models that are installed on this computer: one folder each, with the weights and where they came from.
//!
//! A folder holds `weights.safetensors` and `model.toml` ([`Record`]). It appears under its name in one step, when both
//! are on the disk, so that whatever is killed in between leaves nothing that counts; names that begin with a dot are
//! work in progress and are swept up by the next that changes something. What is removed or replaced while somebody has
//! it mapped stays theirs until they let go.

use crate::durable::{self, Written};
use crate::weights::{self, Report, verify_names};
use crate::{ChannelOrder, Encoder, Error, ErrorKind, Model, Result, Weights};
use core::ops::ControlFlow;
use depthrig_bus::files;
use rustix::fs::{CWD, FlockOperation, RenameFlags, flock, renameat_with};
use rustix::io::Errno;
use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};

mod record;

#[cfg(any(test, feature = "testing"))]
pub(crate) use record::fuzz as fuzz_record;
pub use record::{Record, Source, WeightsRecord};

/// The weights within a model's folder.
const WEIGHTS: &str = "weights.safetensors";
/// The record within a model's folder.
const RECORD: &str = "model.toml";

/// The models of this computer.
#[derive(Debug, Clone)]
pub struct ModelStore {
    dir: PathBuf,
}

/// A model that is installed.
#[derive(Debug, Clone, PartialEq)]
pub struct Installed {
    /// Name of the model.
    pub name: String,
    /// Its folder.
    pub path: PathBuf,
    /// Its record.
    pub record: Record,
}

impl Installed {
    /// Id in headers and reports, [`Model::id`].
    pub fn id(&self) -> String {
        crate::model::model_id(&self.name, &self.record.weights.sha256, self.record.trained)
    }
}

/// How weights are to be installed.
#[derive(Debug, Clone)]
pub struct Import {
    /// Name of the new model; see [`check_name`].
    pub name: String,
    /// Required encoder; `None` accepts any.
    pub encoder: Option<Encoder>,
    /// The order of the colour channels.
    pub channel_order: ChannelOrder,
    /// The shorter side of the network's input, pixels.
    pub input_size: u32,
    /// Raw depth beyond this is taken for a hole, metres.
    pub max_depth_m: f64,
    /// The cameras that it is for, as in [`crate::published::Published::cameras`].
    pub cameras: Vec<String>,
    /// Leave out superfluous tensors and record their names; otherwise they are an error.
    pub drop_extra: bool,
    /// Replace a model of that name.
    pub replace: bool,
    /// Where the weights came from.
    pub source: Source,
}

impl Import {
    /// The settings of the official script, for weights from `source`.
    pub fn new(name: impl Into<String>, source: Source) -> Self {
        let name = name.into();
        let published = crate::published::published(&name);
        let cameras = published.map(|p| p.cameras.iter().map(|c| (*c).to_owned()).collect());
        Self {
            name,
            encoder: None,
            channel_order: ChannelOrder::default(),
            input_size: crate::INPUT_SIZE,
            max_depth_m: crate::MAX_DEPTH_M,
            cameras: cameras.unwrap_or_default(),
            drop_extra: false,
            replace: false,
            source,
        }
    }
}

/// Receives the step, the bytes done and their total; decides whether to continue.
pub type Watch<'a> = &'a mut dyn FnMut(&'static str, u64, u64) -> ControlFlow<()>;

/// Where models are when nothing is said: `$DEPTHRIG_MODELS`, else `$XDG_DATA_HOME/depthrig/models`, else
/// `~/.local/share/depthrig/models`.
///
/// # Errors
/// [`ErrorKind::NotFound`] when none of these is set.
pub fn default_dir() -> Result<PathBuf> {
    let set = |name: &str| std::env::var_os(name).filter(|v| !v.is_empty()).map(PathBuf::from);
    let absolute = |name: &str| set(name).filter(|p| p.is_absolute());
    set("DEPTHRIG_MODELS")
        .or_else(|| Some(absolute("XDG_DATA_HOME")?.join("depthrig/models")))
        .or_else(|| Some(absolute("HOME")?.join(".local/share/depthrig/models")))
        .ok_or_else(|| {
            let message =
                "it is not known where models are: set DEPTHRIG_MODELS to a folder (HOME is not set)";
            Error::new(ErrorKind::NotFound, message)
        })
}

/// Whether a model may have this name: 1 to 22 letters, digits, `-`, `_` and `.`, beginning with a letter or digit.
///
/// # Errors
/// [`ErrorKind::BadInput`] when not.
pub fn check_name(name: &str) -> Result<()> {
    let good = |b: u8| b.is_ascii_alphanumeric() || b"-_.".contains(&b);
    let begins = name.bytes().next().is_some_and(|b| b.is_ascii_alphanumeric());
    if begins && name.len() <= crate::model::MAX_NAME && name.bytes().all(good) {
        return Ok(());
    }
    let message = format!(
        "{name:?} cannot be the name of a model: 1 to {} letters, digits, -, _ and ., beginning with a letter or digit",
        crate::model::MAX_NAME
    );
    Err(Error::new(ErrorKind::BadInput, message))
}

/// Whether `text` can only mean a file: it has a folder or the ending of a checkpoint. Anything else is the name of an
/// installed model first.
pub fn names_a_file(text: &str) -> bool {
    let ending = Path::new(text).extension().and_then(|e| e.to_str()).unwrap_or_default();
    text.contains('/') || ["safetensors", "pth", "pt", "ckpt", "bin", "onnx"].contains(&ending)
}

impl ModelStore {
    /// The models in `dir`, or in [`default_dir`]. The folder need not be there.
    ///
    /// # Errors
    /// As [`default_dir`].
    pub fn open(dir: Option<&Path>) -> Result<Self> {
        Ok(Self { dir: dir.map_or_else(default_dir, |d| Ok(d.to_owned()))? })
    }

    /// The folder.
    pub fn dir(&self) -> &Path {
        &self.dir
    }

    /// Every model, by name; with an error where a folder holds none that can be used.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] when the folder cannot be read.
    pub fn list(&self) -> Result<Vec<(String, Result<Installed>)>> {
        let failed = |e: io::Error| {
            Error::new(ErrorKind::Io, format!("{}: cannot be listed: {e}", self.dir.display())).with_source(e)
        };
        let entries = match std::fs::read_dir(&self.dir) {
            Ok(entries) => entries,
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
            Err(e) => return Err(failed(e)),
        };
        let mut names = Vec::new();
        for entry in entries {
            let entry = entry.map_err(failed)?;
            let name = entry.file_name().to_string_lossy().into_owned();
            if check_name(&name).is_ok() && entry.path().is_dir() {
                names.push(name);
            }
        }
        names.sort_unstable();
        Ok(names.into_iter().map(|name| (name.clone(), self.info(&name))).collect())
    }

    /// Reads the record of a model.
    ///
    /// # Errors
    /// [`ErrorKind::NotFound`] with the names that there are, [`ErrorKind::BadModel`] when its record cannot be read.
    pub fn info(&self, name: &str) -> Result<Installed> {
        check_name(name)?;
        let path = self.dir.join(name);
        let file = path.join(RECORD);
        let text = match depthrig_bus::files::read_to_string(&file, depthrig_bus::files::TEXT_MAX_BYTES) {
            Ok(text) => text,
            Err(e) if e.kind() == io::ErrorKind::NotFound && !path.exists() => {
                return Err(self.not_installed(name));
            }
            Err(e) => {
                let message =
                    format!("{}: cannot be read: {e}; install the model {name} anew", file.display());
                return Err(Error::new(ErrorKind::BadModel, message).with_source(e));
            }
        };
        let record = Record::from_toml(&text).map_err(|what| {
            let message = format!("{}: {what}; install the model {name} anew", file.display());
            Error::new(ErrorKind::BadModel, message)
        })?;
        Ok(Installed { name: name.to_owned(), path, record })
    }

    fn not_installed(&self, name: &str) -> Error {
        let names: Vec<_> = self
            .list()
            .unwrap_or_default()
            .into_iter()
            .filter_map(|(n, info)| info.is_ok().then_some(n))
            .collect();
        let there =
            if names.is_empty() { "none is".to_owned() } else { format!("there are {}", names.join(", ")) };
        let cure = if crate::published::published(name).is_some() {
            format!(
                "`depthrig cdm fetch {name}` fetches it, `depthrig cdm import FILE --name {name}` takes a file"
            )
        } else {
            format!("`depthrig cdm import FILE --name {name}` installs one")
        };
        let message = format!("no model {name} is installed in {} ({there}); {cure}", self.dir.display());
        Error::new(ErrorKind::NotFound, message)
    }

    /// A model, ready for an engine. Its names and shapes are checked; its numbers were when it was installed.
    ///
    /// # Errors
    /// Those of [`Self::info`], and [`ErrorKind::BadModel`] when its weights are not those of the record.
    pub fn get(&self, name: &str) -> Result<Model> {
        let installed = self.info(name)?;
        let weights = Self::weights(&installed)?;
        let id = installed.id();
        let record = installed.record;
        Ok(Model {
            channel_order: record.channel_order,
            input_size: record.input_size,
            max_depth_m: record.max_depth_m,
            ..Model::new(id, record.encoder, weights)
        })
    }

    /// The model of this name, or in this file: what has a folder or the ending of a checkpoint in it is a file, and what
    /// is not installed and there as a file as well.
    ///
    /// # Errors
    /// Those of [`Self::get`] and [`Model::from_file`].
    pub fn model(&self, name_or_file: &str) -> Result<Model> {
        let path = Path::new(name_or_file);
        if !names_a_file(name_or_file) && (self.dir.join(name_or_file).is_dir() || !path.is_file()) {
            return self.get(name_or_file);
        }
        Model::from_file(path)
    }

    /// The installed model for a camera, by its model: the published one for it, else the first that names it.
    ///
    /// # Errors
    /// Those of [`Self::list`].
    pub fn for_camera(&self, model: &str) -> Result<Option<String>> {
        let installed: Vec<_> = self.list()?.into_iter().filter_map(|(_, info)| info.ok()).collect();
        let published = crate::published::PUBLISHED.iter();
        let mut published =
            published.filter(|p| p.cameras.iter().any(|c| crate::published::serves(c, model)));
        if let Some(p) = published.find(|p| installed.iter().any(|i| i.name == p.name)) {
            return Ok(Some(p.name.to_owned()));
        }
        let names_it = |i: &Installed| i.record.cameras.iter().any(|c| crate::published::serves(c, model));
        Ok(installed.into_iter().find(names_it).map(|i| i.name))
    }

    fn weights(installed: &Installed) -> Result<Weights> {
        let weights = Weights::open(installed.path.join(WEIGHTS))?;
        let Record { encoder, weights: recorded, .. } = &installed.record;
        let changed = |what: String| {
            let message = format!(
                "{}: {what}; it was changed or damaged since it was installed: install the model {} anew",
                weights.path().display(),
                installed.name
            );
            Error::new(ErrorKind::BadModel, message)
        };
        if weights.file_bytes() != recorded.bytes {
            let has = weights.file_bytes();
            let said = recorded.bytes;
            return Err(changed(format!("has {has} bytes and its record says {said}")));
        }
        let found = verify_names(&weights)?;
        if found != *encoder {
            return Err(changed(format!("has the encoder {found} and its record says {encoder}")));
        }
        Ok(weights)
    }

    /// Checks every byte and number of an installed model.
    ///
    /// # Errors
    /// Those of [`Self::get`], and [`ErrorKind::BadModel`] for a hash other than that of the record and for NaN or
    /// infinite numbers.
    pub fn check(&self, name: &str) -> Result<Report> {
        let installed = self.info(name)?;
        let weights = Self::weights(&installed)?;
        let has = weights.sha256()?;
        let said = &installed.record.weights.sha256;
        if has != *said {
            let path = weights.path().display();
            let message = format!(
                "{path}: has the SHA-256 {has} and its record says {said}; it was changed or damaged since it was \
                 installed: install the model {name} anew"
            );
            return Err(Error::new(ErrorKind::BadModel, message));
        }
        let report = weights::examine(&weights, Some(installed.record.encoder))?;
        if report.is_good() { Ok(report) } else { Err(report.error(&weights)) }
    }

    /// Installs weights after every name, shape and number of them was verified.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] for a name that is taken or none, [`ErrorKind::BadModel`] with all that is wrong with the
    /// weights, [`ErrorKind::Io`] when they cannot be written.
    pub fn import(&self, weights: &Weights, import: Import, watch: Watch<'_>) -> Result<Installed> {
        check_name(&import.name)?;
        check_settings(&import)?;
        let _lock = self.lock()?;
        let path = self.dir.join(&import.name);
        if path.exists() && !import.replace {
            let message = format!(
                "a model {} is installed already in {}; take another name, or replace it (--replace)",
                import.name,
                self.dir.display()
            );
            return Err(Error::new(ErrorKind::BadInput, message));
        }
        report_progress(watch, "check", 0, 1)?;
        let report = weights::examine(weights, import.encoder)?;
        let good = report.is_good() || (import.drop_extra && report.is_good_but_for_extra());
        if !good {
            return Err(report.error(weights));
        }
        let part = self.dir.join(format!(".import-{}", import.name));
        let part = TemporaryFolder::new(part)?;
        let written = self.write_weights(&part.0.join(WEIGHTS), weights, &report, watch)?;
        let record = record::of(&import, weights, &report, written);
        durable::create(&part.0.join(RECORD), |out| out.write_all(record.to_toml().as_bytes()))?;
        self.put(&part.0, &path)?;
        Ok(Installed { name: import.name, path, record })
    }

    fn write_weights(
        &self,
        path: &Path,
        weights: &Weights,
        report: &Report,
        watch: Watch<'_>,
    ) -> Result<Written> {
        let keep = |name: &str| !report.extra.iter().any(|e| e.name == name);
        let kept = weights.entries().iter().filter(|(name, _)| keep(name));
        let total: u64 = kept.map(|(_, e)| (e.count() * weights::kept_as(e.dtype).bytes()) as u64).sum();
        if let Ok(disk) = rustix::fs::statvfs(&self.dir) {
            let free = disk.f_bavail * disk.f_frsize;
            if free < total {
                let e = io::Error::new(
                    io::ErrorKind::StorageFull,
                    format!("{total} bytes are needed and {free} are free"),
                );
                return Err(durable::cannot_write(path, e));
            }
        }
        let mut stopped = false;
        let written = durable::create(path, |out| {
            weights::copy(out, weights, keep, weights.metadata(), &mut |done| {
                stopped = watch("install", done, total).is_break();
                !stopped
            })
        });
        if stopped { Err(ended()) } else { written }
    }

    /// Gives the folder `part` the name `path`, in one step also when there is one already.
    fn put(&self, part: &Path, path: &Path) -> Result<()> {
        let failed = |e: io::Error| durable::cannot_write(path, e);
        files::sync_folder_of(&part.join(RECORD)).map_err(failed)?;
        if path.exists() {
            match renameat_with(CWD, part, CWD, path, RenameFlags::EXCHANGE) {
                // Some network file systems cannot exchange names: there the name is gone for a moment.
                Err(Errno::INVAL | Errno::NOSYS | Errno::OPNOTSUPP) => {
                    let old = self.dir.join(".removed-replaced");
                    std::fs::rename(path, &old).and_then(|()| std::fs::rename(part, path)).map_err(failed)?;
                    drop(std::fs::remove_dir_all(old)); // leftovers are removed under the next lock
                }
                exchanged => exchanged.map_err(|e| failed(e.into()))?,
            }
        } else {
            std::fs::rename(part, path).map_err(failed)?;
        }
        files::sync_folder_of(path).map_err(failed)
    }

    /// Removes a model; who uses it keeps it until they let go.
    ///
    /// # Errors
    /// [`ErrorKind::NotFound`] with the names that there are, [`ErrorKind::Io`] when it cannot be removed.
    pub fn remove(&self, name: &str) -> Result<()> {
        check_name(name)?;
        let path = self.dir.join(name);
        if !path.exists() {
            return Err(self.not_installed(name));
        }
        let _lock = self.lock()?;
        let gone = self.dir.join(format!(".removed-{name}"));
        let failed = |e: io::Error| {
            Error::new(ErrorKind::Io, format!("{}: cannot be removed: {e}", path.display())).with_source(e)
        };
        std::fs::rename(&path, &gone).map_err(failed)?;
        files::sync_folder_of(&path).map_err(failed)?;
        std::fs::remove_dir_all(&gone).map_err(failed)
    }

    /// One at a time changes the folder; whoever holds this finds nobody's work in progress, and removes what was left of
    /// any.
    fn lock(&self) -> Result<File> {
        let path = self.dir.join(".lock");
        depthrig_bus::umask::create_dir_all(&self.dir).map_err(|e| durable::cannot_write(&self.dir, e))?;
        let file = File::create(&path).map_err(|e| durable::cannot_write(&path, e))?;
        flock(&file, FlockOperation::NonBlockingLockExclusive).map_err(|e| {
            let message = format!(
                "{}: another `depthrig cdm` is changing the models there; try again when it is done",
                self.dir.display()
            );
            Error::new(ErrorKind::Io, message).with_source(io::Error::from(e))
        })?;
        let entries = std::fs::read_dir(&self.dir).map_err(|e| durable::cannot_write(&self.dir, e))?;
        for entry in entries.flatten() {
            let name = entry.file_name();
            let name = name.to_string_lossy();
            if name.starts_with(".import-") || name.starts_with(".removed-") {
                // A leftover that cannot be removed only takes up space.
                drop(std::fs::remove_dir_all(entry.path()));
            }
        }
        Ok(file)
    }
}

/// A folder that is removed when it is let go of; it does nothing when the folder has another name by then, and removes
/// the old model when it was exchanged for it.
struct TemporaryFolder(PathBuf);

impl TemporaryFolder {
    fn new(path: PathBuf) -> Result<Self> {
        std::fs::create_dir(&path).map_err(|e| durable::cannot_write(&path, e))?;
        Ok(Self(path))
    }
}

impl Drop for TemporaryFolder {
    fn drop(&mut self) {
        drop(std::fs::remove_dir_all(&self.0)); // it may be gone; leftovers are removed under the next lock
    }
}

fn check_settings(import: &Import) -> Result<()> {
    let wrong = |message: String| Err(Error::new(ErrorKind::BadInput, message));
    if !(14..=8192).contains(&import.input_size) {
        return wrong(format!("an input size of {} pixels; it must be 14 to 8192", import.input_size));
    }
    if !(import.max_depth_m.is_finite() && import.max_depth_m > 0.0) {
        return wrong(format!("a largest depth of {} m; it must be above 0, such as 6", import.max_depth_m));
    }
    Ok(())
}

fn report_progress(watch: Watch<'_>, what: &'static str, done: u64, total: u64) -> Result<()> {
    if watch(what, done, total).is_break() { Err(ended()) } else { Ok(()) }
}

pub(crate) fn ended() -> Error {
    Error::new(ErrorKind::Io, "interrupted; nothing was installed")
}

#[cfg(test)]
mod tests;
