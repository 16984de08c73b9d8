//! Where views are kept: a dataset of one set for each view, which grows.
//!
//! Its times are UTC, because views of one calibration may be taken before and after a restart of the computer, and a frame's number is
//! that of its view.

use super::rounds::Round;
use crate::calibrate::dataset::{self, DatasetOptions, VIEWS_TABLE};
use crate::exit::UsageError;
use anyhow::{Context as _, Result, bail};
use core::ops::ControlFlow;
use core::time::Duration;
use depthrig_bus::sync::lock;
use depthrig_bus::{HostTime, UtcPair};
use depthrig_calibrate::board::Board;
use depthrig_calibrate::rig::RigView;
use depthrig_recorder::fs::{Fs, RealFs};
use depthrig_recorder::{
    ColorCodec, Dataset, PixelMode, PushError, RecordFrame, RecordSet, Recorder, RecorderOptions,
    RecoverOptions, SESSION_FILE, Session, SetRange, StreamRecord, Summary, UtcSource, recover,
};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

/// Time that a view may take to be stored.
const STORED: Duration = Duration::from_secs(20);
const LOOK: Duration = Duration::from_millis(2);

/// The views' dataset. Nothing is written before the first view, so that a capture that is ended before leaves nothing behind.
pub struct Store {
    path: PathBuf,
    /// The session of a new dataset; `None` of one that grows.
    new: Option<Session>,
    recorder: Option<Recorder>,
    clock: Arc<Mutex<UtcPair>>,
    next: u64,
    last_tick_ns: i64,
}

/// A store and the views that were in it.
pub struct Opened {
    /// The store.
    pub store: Store,
    /// The views, seen anew in their images.
    pub views: Vec<RigView>,
}

/// Rig, streams and board of the views.
pub struct Subject<'a> {
    /// Name of the rig.
    pub rig: &'a str,
    /// One stream of each camera.
    pub streams: &'a [StreamRecord],
    /// The board.
    pub board: &'a Board,
}

impl Store {
    /// Creates the dataset, or goes on with one that holds views of the same cameras and board.
    ///
    /// # Errors
    /// When `path` is something else, or views of other cameras or of another board; a usage error then.
    pub fn open(path: &Path, subject: &Subject<'_>) -> Result<Opened> {
        let mut store = Self {
            path: path.to_owned(),
            new: None,
            recorder: None,
            clock: Arc::new(Mutex::new(now())),
            next: 1,
            last_tick_ns: 0,
        };
        if path.symlink_metadata().is_err() || is_empty(path) {
            store.new = Some(session(path, subject)?);
            return Ok(Opened { store, views: Vec::new() });
        }
        check(path, subject)?;
        // A capture that was killed left its last segment unfinished; nothing happens to a complete one.
        let unfinished = RecoverOptions { unfinished_only: true, ..RecoverOptions::default() };
        recover(path, &unfinished, &mut |_| ControlFlow::Continue(()))?;
        let known =
            DatasetOptions { streams: subject.streams.iter().map(|s| s.id.clone()).collect(), moving: true };
        let seen = dataset::read(path, subject.board, &known, |_, _| true)?;
        let all = Dataset::open(path)?;
        for set in all.sets_with(SetRange::ALL, PixelMode::None) {
            let set = set?;
            store.next = set.id + 1;
            store.last_tick_ns = set.tick.ns();
        }
        Ok(Opened { store, views: seen.map_or_else(Vec::new, |s| s.views) })
    }

    /// The recorder, which is started for the first view.
    fn recorder(&mut self) -> Result<&Recorder> {
        if self.recorder.is_none() {
            let fs: Arc<dyn Fs> = Arc::new(RealFs);
            let clock = Arc::clone(&self.clock);
            let source: UtcSource = Arc::new(move || *lock(&clock));
            let options = RecorderOptions {
                // Losses of JPEG would move corners.
                color: ColorCodec::Png,
                segment_max_ns: i64::MAX / 4,
                ..RecorderOptions::default()
            };
            self.recorder = Some(match self.new.take() {
                Some(session) => Recorder::create_with(fs, source, &self.path, session, options)?,
                None => Recorder::append(fs, source, &self.path, options)?.0,
            });
        }
        self.recorder.as_ref().context("the recorder was not started")
    }

    /// Stores the images of a view, and returns when they are in the file.
    ///
    /// # Errors
    /// When they cannot be stored.
    pub fn push(&mut self, view: &RigView, round: &Round) -> Result<()> {
        let mut frames = Vec::new();
        let mut missing = Vec::new();
        for (stream, shot) in round.shots.iter().enumerate() {
            let is_in = view.seen.iter().any(|s| s.camera == stream);
            let Some(shot) = shot.as_ref().filter(|_| is_in) else {
                missing.push(stream);
                continue;
            };
            let mut header = shot.header;
            for time in
                [&mut header.capture_time_ns, &mut header.arrival_time_ns, &mut header.publish_time_ns]
            {
                *time = time.saturating_add(round.utc_offset_ns);
            }
            header.sequence = self.next;
            header.captured = self.next;
            header.dropped = [0; 8];
            frames.push(RecordFrame { stream, header, pixels: Box::new(shot.pixels.clone()) });
        }
        let times = || frames.iter().map(|f| f.header.capture_time_ns);
        let latest = times().max().context("a view without images")?;
        let spread_ns = latest - times().min().unwrap_or(latest);
        let tick_ns = latest.max(self.last_tick_ns + 1);
        let tick = HostTime::from_ns(tick_ns);
        let utc = UtcPair { mono: tick, utc_ns: tick_ns, width_ns: 0 };
        *lock(&self.clock) = utc;
        let set = RecordSet {
            id: self.next,
            tick,
            utc,
            frames,
            missing,
            motion: Vec::new(),
            signals: Vec::new(),
            spread_ns,
        };
        self.next += 1;
        self.last_tick_ns = tick_ns;
        let recorder = self.recorder()?;
        let before = recorder.progress().sets.recorded;
        recorder.push(set).map_err(|e: PushError| anyhow::anyhow!("{e}"))?;
        let began = HostTime::now();
        loop {
            let progress = recorder.progress();
            if let Some(e) = progress.error {
                bail!("{}: the view cannot be stored: {e}", recorder.path().display());
            }
            if progress.sets.recorded > before {
                return Ok(());
            }
            if began.elapsed() > STORED {
                let path = recorder.path().display();
                bail!("{path}: the view was not stored within {} s; is the disk busy?", STORED.as_secs());
            }
            std::thread::sleep(LOOK);
        }
    }

    /// Completes the dataset; `None` if no view was added.
    ///
    /// # Errors
    /// When it cannot be completed.
    pub fn finish(self) -> Result<Option<Summary>> {
        Ok(self.recorder.map(Recorder::finish).transpose()?)
    }
}

fn now() -> UtcPair {
    let utc_ns = UtcPair::sample().utc_ns;
    UtcPair { mono: HostTime::from_ns(utc_ns), utc_ns, width_ns: 0 }
}

fn is_empty(path: &Path) -> bool {
    path.read_dir().is_ok_and(|mut entries| entries.next().is_none())
}

fn session(path: &Path, subject: &Subject<'_>) -> Result<Session> {
    let name = path.file_name().map_or_else(|| "views".to_owned(), |n| n.to_string_lossy().into_owned());
    let mut session = Session::new(name, subject.rig);
    "calibration board".clone_into(&mut session.scene);
    session.streams = subject.streams.to_vec();
    let mut table = toml::Table::new();
    table.insert("board".to_owned(), subject.board.to_toml()?.into());
    session.extra.insert(VIEWS_TABLE.to_owned(), table.into());
    Ok(session)
}

/// Checks that `path` holds views of these cameras and this board.
fn check(path: &Path, subject: &Subject<'_>) -> Result<()> {
    let shown = path.display();
    let refused = |what: String| -> Result<()> { Err(UsageError(format!("{shown}: {what}")).into()) };
    if !path.join(SESSION_FILE).exists() {
        return refused("exists and holds no views; name a new folder with --out".into());
    }
    let dataset = Dataset::open(path)?;
    let session = dataset.session();
    let Some(board) =
        session.extra.get(VIEWS_TABLE).and_then(|t| t.get("board")).and_then(toml::Value::as_str)
    else {
        return refused("is a recording; name a new folder with --out".into());
    };
    if board != subject.board.to_toml()? {
        return refused("holds views of another board; name a new folder with --out".into());
    }
    let what = |s: &StreamRecord| format!("{} {}x{} {}", s.id, s.width, s.height, s.serial);
    let was: Vec<String> = session.streams.iter().map(what).collect();
    let is: Vec<String> = subject.streams.iter().map(what).collect();
    if was != is {
        return refused(format!(
            "holds views of {}; now there are {}; name a new folder with --out",
            was.join(", "),
            is.join(", ")
        ));
    }
    Ok(())
}
