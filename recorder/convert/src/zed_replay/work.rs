//! The folder beside the output in which it grows, and the facts that a later run needs about this one.

use depthrig_bus::sync::lock;
use depthrig_bus::{UtcPair, files};
use depthrig_recorder::fs::{Fs, RealFs};
use depthrig_recorder::{Error, ErrorKind, RecordSet, Result, UtcSource};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

const PLAN_FILE: &str = "plan.json";

/// `OUT.zedreplay`, locked against other runs.
pub(super) struct Work {
    dir: PathBuf,
    _lock: Box<dyn Send + Sync>,
}

fn write(path: &Path, plan: &Value) -> Result<()> {
    files::replace(path, format!("{plan:#}\n").as_bytes()).map_err(|e| failed("write", path, e))
}

fn failed(what: &str, path: &Path, e: std::io::Error) -> Error {
    let kind = match e.kind() {
        std::io::ErrorKind::PermissionDenied => ErrorKind::PermissionDenied,
        std::io::ErrorKind::StorageFull => ErrorKind::DiskFull,
        _ => ErrorKind::Io,
    };
    Error::new(kind, format!("cannot {what} {}: {e}", path.display())).with_source(e)
}

impl Work {
    /// Makes the folder or finds that of a run with the same `plan`.
    pub(super) fn open(out: &Path, plan: &Value) -> Result<Self> {
        let Some(name) = out.file_name() else {
            let what = format!("{} is not a valid name for a new dataset", out.display());
            return Err(Error::new(ErrorKind::BadInput, what));
        };
        let mut name = name.to_os_string();
        name.push(".zedreplay");
        let dir = out.with_file_name(name);
        depthrig_bus::umask::create_dir_all(&dir).map_err(|e| failed("create the folder", &dir, e))?;
        let lock = RealFs.lock(&dir).map_err(|e| {
            if e.kind() == std::io::ErrorKind::WouldBlock {
                let what =
                    format!("another run works in {}; wait for it, or choose another name", dir.display());
                return Error::new(ErrorKind::InUse, what);
            }
            failed("lock", &dir, e)
        })?;
        let work = Self { dir, _lock: lock };
        work.agree(plan)?;
        Ok(work)
    }

    fn agree(&self, plan: &Value) -> Result<()> {
        let path = self.dir.join(PLAN_FILE);
        let found = match files::read(&path, files::TEXT_MAX_BYTES) {
            Ok(bytes) => bytes,
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => {
                if self.dataset().exists() {
                    return Err(self.stranger("a dataset is there without its plan"));
                }
                return write(&path, plan);
            }
            Err(e) => return Err(failed("read", &path, e)),
        };
        let Ok(Value::Object(found)) = serde_json::from_slice(&found) else {
            return Err(self.stranger("its plan cannot be read"));
        };
        let differs =
            plan.as_object().and_then(|p| p.iter().find(|(key, value)| found.get(*key) != Some(value)));
        match differs {
            None => Ok(()),
            Some((key, _)) => Err(self.stranger(&format!("it was begun with another {key}"))),
        }
    }

    fn stranger(&self, why: &str) -> Error {
        let what = format!(
            "{} holds the remains of another run ({why}): finish that run, remove the folder, or choose another name",
            self.dir.display()
        );
        Error::new(ErrorKind::AlreadyExists, what)
    }

    pub(super) fn path(&self) -> &Path {
        &self.dir
    }

    /// Where the dataset grows.
    pub(super) fn dataset(&self) -> PathBuf {
        self.dir.join("dataset")
    }

    /// Gives the dataset its name and removes the rest.
    pub(super) fn finish(self, out: &Path) -> Result<()> {
        let copy = self.dataset();
        RealFs.rename(&copy, out).map_err(|e| failed("rename", &copy, e))?;
        files::sync_folder_of(out).map_err(|e| failed("sync the folder of", out, e))?;
        remove(&self.dir)
    }
}

/// Removes a folder, if it is there.
pub(super) fn remove(dir: &Path) -> Result<()> {
    match std::fs::remove_dir_all(dir) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(failed("remove", dir, e)),
        _ => Ok(()),
    }
}

/// The clock of the recording: the recorder's own readings must be of the recorded time, not of today's.
pub(super) struct RecordedClock(Arc<Mutex<UtcPair>>);

impl RecordedClock {
    pub(super) fn new(started_utc_ns: i64) -> Self {
        Self(Arc::new(Mutex::new(UtcPair { utc_ns: started_utc_ns, ..UtcPair::default() })))
    }

    pub(super) fn source(&self) -> UtcSource {
        let pair = Arc::clone(&self.0);
        Arc::new(move || *lock(&pair))
    }

    /// It is the time of this set.
    pub(super) fn set(&self, set: &RecordSet) {
        let now = UtcPair { mono: set.tick, utc_ns: set.utc.utc_ns(set.tick), width_ns: set.utc.width_ns };
        *lock(&self.0) = now;
    }
}

/// Memory that can be had without swapping, bytes; 4 GiB where the system does not report it.
pub(super) fn available_memory() -> u64 {
    let text = std::fs::read_to_string("/proc/meminfo").unwrap_or_default();
    let line = text.lines().find_map(|l| l.strip_prefix("MemAvailable:"));
    let kib = line.and_then(|l| l.trim().strip_suffix("kB")?.trim().parse::<u64>().ok());
    kib.map_or(4 << 30, |kib| kib.saturating_mul(1024))
}
