//! ByteCameraDepth folders as a dataset, with or without the times and calibration that an export of ours has.

use super::calibration::{Calibration, SessionFacts};
use super::images::{Image, read};
use super::rows::Row;
use super::{CALIBRATION_FILE, FORMAT, FRAMES_FILE};
use crate::{ImportFacts, ImportProgress, Importer};
use depthrig_recorder::fs::Fs;
use depthrig_recorder::{Error, ErrorKind, RecordSet, Result, Session};
use files::{list, read_file};
use std::collections::BTreeMap;
use std::io::BufRead;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use stream::Stream;

mod described;
mod files;
mod inferred;
mod numbers;
mod rows;
mod stream;

/// Metres per unit of depth that make sense.
const UNITS_M: core::ops::RangeInclusive<f64> = 1e-6..=1.0;

/// Facts that the folders do not hold.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ByteCameraOptions {
    /// Metres per unit of 16-bit depth, of all cameras.
    pub depth_unit_m: Option<f64>,
    /// The same of single cameras, by the name of the camera or of its folder.
    pub camera_depth_unit_m: BTreeMap<String, f64>,
    /// Sets in a second, where there is no `frames.csv`.
    pub rate_hz: Option<f64>,
    /// Name of the dataset.
    pub name: String,
}

/// The importer of one session's folder.
pub struct ByteCameraImport {
    fs: Arc<dyn Fs>,
    dir: PathBuf,
    options: ByteCameraOptions,
    session: SessionFacts,
    streams: Vec<Stream>,
    list: List,
    facts: ImportFacts,
    alpha_dropped: u64,
    done: u64,
    total: u64,
}

/// Where the sets come from.
enum List {
    /// `frames.csv`, at this line; the row is the first one of the next set.
    Rows { lines: Box<dyn BufRead + Send>, line: u64, next: Option<Box<Row>> },
    /// The numbers of the files.
    Numbers { numbers: Vec<u32>, at: usize, start_utc_ns: i64, period_ns: i64 },
}

fn bad(path: &Path, why: impl core::fmt::Display) -> Error {
    Error::new(ErrorKind::BadRecording, format!("{}: {why}", path.display()))
}

impl ByteCameraImport {
    /// Looks at the folder `dir` of a session, which holds `camera_…` folders. One image of each kind is read.
    ///
    /// # Errors
    /// [`ErrorKind::NotFound`], [`ErrorKind::BadRecording`] when it holds no such folders or they contradict
    /// `calibration.json` or `frames.csv`, [`ErrorKind::BadInput`] for an option out of its range, [`ErrorKind::Io`].
    pub fn open(fs: Arc<dyn Fs>, dir: &Path, options: ByteCameraOptions) -> Result<Self> {
        for unit in options.depth_unit_m.iter().chain(options.camera_depth_unit_m.values()) {
            if !UNITS_M.contains(unit) {
                let message = format!("invalid depth unit {unit} m; a millimetre is 0.001");
                return Err(Error::new(ErrorKind::BadInput, message));
            }
        }
        if let Some(rate) = options.rate_hz.filter(|r| !(1e-3..=1e4).contains(r)) {
            let message = format!("rate {rate} Hz is out of range 0.001..=10000");
            return Err(Error::new(ErrorKind::BadInput, message));
        }
        let found = list(&*fs, dir)?;
        let calibration = match read_file(&*fs, &dir.join(CALIBRATION_FILE))? {
            Some(text) => Some(Calibration::parse(&text, &dir.join(CALIBRATION_FILE))?),
            None => None,
        };
        let mut import = Self {
            fs,
            dir: dir.to_owned(),
            options,
            session: SessionFacts::default(),
            streams: Vec::new(),
            list: List::Numbers { numbers: Vec::new(), at: 0, start_utc_ns: 0, period_ns: 1 },
            facts: ImportFacts::default(),
            alpha_dropped: 0,
            done: 0,
            total: 0,
        };
        match calibration {
            Some(c) => import.described(c, found)?,
            None => import.inferred(found)?,
        }
        import.total = import.streams.iter().map(|s| s.files.len() as u64).sum();
        import.find_times()?;
        Ok(import)
    }

    fn state(&mut self, what: String) {
        self.facts.stated.push(what);
    }

    /// Where the sets come from.
    fn find_times(&mut self) -> Result<()> {
        let path = self.dir.join(FRAMES_FILE);
        match self.fs.open(&path) {
            Ok(file) => self.by_rows(file, &path),
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => {
                self.by_numbers();
                Ok(())
            }
            Err(e) => Err(Error::reading("open", &path, e)),
        }
    }

    fn given_unit(&self, camera: &str, folder: &str) -> Option<f64> {
        let part = folder.strip_prefix("camera_").unwrap_or(folder);
        let one = [camera, folder, part].into_iter().find_map(|n| self.options.camera_depth_unit_m.get(n));
        one.copied().or(self.options.depth_unit_m)
    }

    /// The file `n` of a stream; the inner error is of that file alone.
    fn image(&self, stream: &Stream, n: u32) -> Result<Result<Image, String>> {
        let path = self.dir.join(stream.path(n));
        match read_file(&*self.fs, &path) {
            Ok(Some(bytes)) => Ok(read(&bytes, &stream.ending, stream.want)),
            Ok(None) => Ok(Err("it is not there".to_owned())),
            Err(e) if e.kind() == ErrorKind::Io => Err(e),
            Err(e) => Ok(Err(e.to_string())),
        }
    }

    fn close(&self, set: &mut RecordSet) {
        set.missing =
            (0..self.streams.len()).filter(|i| !set.frames.iter().any(|f| f.stream == *i)).collect();
    }
}

impl Importer for ByteCameraImport {
    fn format(&self) -> &'static str {
        FORMAT
    }

    fn session(&mut self) -> Result<Session> {
        let rig = if self.session.rig.is_empty() { "rig" } else { &self.session.rig };
        let mut session = Session::new(self.options.name.clone(), rig);
        session.scene.clone_from(&self.session.scene);
        session.operator.clone_from(&self.session.operator);
        session.host.clone_from(&self.session.host);
        session.rig_config.clone_from(&self.session.rig_config);
        session.started_utc_ns = self.session.started_utc_ns;
        session.streams = self.streams.iter().map(|s| s.record.clone()).collect();
        session.extra.insert("import".to_owned(), crate::import::table(FORMAT, &self.dir, &self.facts));
        Ok(session)
    }

    fn next(&mut self) -> Result<Option<RecordSet>> {
        if matches!(self.list, List::Rows { .. }) { self.set_of_rows() } else { self.set_of_number() }
    }

    fn progress(&self) -> ImportProgress {
        ImportProgress { done: self.done.min(self.total), total: self.total }
    }

    fn facts(&self) -> ImportFacts {
        let mut facts = self.facts.clone();
        facts.accounts = self.streams.iter().map(Stream::account).collect();
        if self.alpha_dropped > 0 {
            facts
                .stated
                .push(format!("{} colour images had an opacity, which is left out", self.alpha_dropped));
        }
        facts
    }
}
