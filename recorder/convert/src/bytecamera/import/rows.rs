//! Sets, times and counters from `frames.csv`, read line by line.

use super::files::{Bytes, Key, key_of};
use super::{ByteCameraImport, FRAMES_FILE, List, bad};
use crate::bytecamera::rows::{Row, is_head};
use depthrig_bus::{HostTime, UtcPair};
use depthrig_recorder::fs::ReadFile;
use depthrig_recorder::{Error, RecordFrame, RecordSet, Result};
use std::collections::{BTreeMap, BTreeSet};
use std::io::{self, BufRead, BufReader, Read};
use std::path::Path;

/// Longest line of `frames.csv`, bytes; ours have a few hundred.
const LINE_MAX: u64 = 64 << 10;

impl ByteCameraImport {
    /// Begins to read `frames.csv`, whose first line names the columns.
    fn begin_rows(&mut self, file: Box<dyn ReadFile>, path: &Path) -> Result<()> {
        let size = file.size().map_err(|e| Error::reading("read", path, e))?;
        let lines = Box::new(BufReader::with_capacity(64 << 10, Bytes { file, at: 0, size }));
        self.list = List::Rows { lines, line: 0, next: None };
        if self.line()?.is_some_and(|line| is_head(&line)) {
            return Ok(());
        }
        Err(bad(
            path,
            "its first line does not name the columns that depthrig writes; remove the file to import without times",
        ))
    }

    /// The depth unit of each of these streams from the first line with a file of it, if there is a `frames.csv`.
    /// The list is read from the start, no further than needed.
    pub(super) fn units_of_rows(&mut self, mut wanted: BTreeSet<Key>) -> Result<BTreeMap<Key, f64>> {
        let mut units = BTreeMap::new();
        let path = self.dir.join(FRAMES_FILE);
        let file = match self.fs.open(&path) {
            Ok(file) => file,
            Err(e) if e.kind() == io::ErrorKind::NotFound => return Ok(units),
            Err(e) => return Err(Error::reading("open", &path, e)),
        };
        self.begin_rows(file, &path)?;
        while !wanted.is_empty()
            && let Some(row) = self.row()?
        {
            if let Some(key) = key_of(&row.file)
                && wanted.remove(&key)
            {
                units.insert(key, row.header.depth_unit_m);
            }
        }
        Ok(units)
    }

    /// Sets from `frames.csv`, whose first lines are read.
    pub(super) fn by_rows(&mut self, file: Box<dyn ReadFile>, path: &Path) -> Result<()> {
        self.begin_rows(file, path)?;
        let row = self.row()?;
        let Some(row) = row else { return Err(bad(path, "it names no frames")) };
        if self.session.started_utc_ns == 0 {
            self.session.started_utc_ns = row.set_utc_ns;
        }
        self.put_back(row);
        self.state(format!("times, counters and set numbers are those of {FRAMES_FILE}"));
        Ok(())
    }

    /// The next line of `frames.csv`.
    fn line(&mut self) -> Result<Option<String>> {
        let path = self.dir.join(FRAMES_FILE);
        let List::Rows { lines, line, .. } = &mut self.list else { return Ok(None) };
        *line += 1;
        let mut bytes = Vec::new();
        lines
            .by_ref()
            .take(LINE_MAX)
            .read_until(b'\n', &mut bytes)
            .map_err(|e| Error::reading("read", &path, e))?;
        if bytes.is_empty() {
            return Ok(None);
        }
        if bytes.pop_if(|b| *b == b'\n').is_none() {
            return Err(bad(&path, format_args!("line {line} has no end: the file was cut")));
        }
        bytes.pop_if(|b| *b == b'\r');
        String::from_utf8(bytes)
            .map(Some)
            .map_err(|_| bad(&path, format_args!("line {line} is not valid UTF-8")))
    }

    fn row(&mut self) -> Result<Option<Box<Row>>> {
        if let List::Rows { next, .. } = &mut self.list
            && let Some(row) = next.take()
        {
            return Ok(Some(row));
        }
        let Some(text) = self.line()? else { return Ok(None) };
        let List::Rows { line, .. } = &self.list else { return Ok(None) };
        let path = self.dir.join(FRAMES_FILE);
        Row::parse(&text).map(|r| Some(Box::new(r))).map_err(|e| bad(&path, format_args!("line {line}: {e}")))
    }

    fn put_back(&mut self, row: Box<Row>) {
        if let List::Rows { next, .. } = &mut self.list {
            *next = Some(row);
        }
    }

    /// The next set of `frames.csv`.
    pub(super) fn set_of_rows(&mut self) -> Result<Option<RecordSet>> {
        let Some(first) = self.row()? else {
            let unnamed = self.total.saturating_sub(self.done);
            if unnamed > 0 {
                self.facts.lost += unnamed;
                self.facts.problems.push(format!("{unnamed} files are not named in {FRAMES_FILE}"));
                self.done = self.total;
            }
            return Ok(None);
        };
        let mut set = RecordSet {
            id: first.set,
            tick: HostTime::from_ns(first.tick_ns),
            utc: UtcPair { utc_ns: first.utc_offset_ns, ..UtcPair::default() },
            frames: Vec::new(),
            missing: Vec::new(),
            motion: Vec::new(),
            signals: Vec::new(),
            spread_ns: first.spread_ns,
        };
        let id = first.set;
        let mut row = Some(first);
        while let Some(r) = row {
            if r.set != id {
                self.put_back(r);
                break;
            }
            if !r.file.is_empty() {
                self.frame_of_row(&r, &mut set)?;
            }
            row = self.row()?;
        }
        self.close(&mut set);
        Ok(Some(set))
    }

    fn frame_of_row(&mut self, row: &Row, set: &mut RecordSet) -> Result<()> {
        let Some(i) = self.streams.iter().position(|s| s.path(row.n) == row.file) else {
            self.facts.lose(format!("set {}: {} is of no stream that is imported", row.set, row.file));
            return Ok(());
        };
        if set.frames.iter().any(|f| f.stream == i) {
            return Err(bad(
                &self.dir.join(FRAMES_FILE),
                format_args!("set {} names {} twice", row.set, row.file),
            ));
        }
        self.done += u64::from(self.streams[i].files.contains_key(&row.n));
        match self.image(&self.streams[i], row.n)? {
            Ok(image) => {
                let s = &mut self.streams[i];
                let mut header = row.header;
                s.fill(&mut header, &self.session.rig, &image);
                s.last_header = Some(header);
                self.alpha_dropped += u64::from(image.alpha_dropped);
                set.frames.push(RecordFrame { stream: i, header, pixels: Box::new(image.pixels) });
            }
            Err(why) => self.facts.lose(format!("{}: {why}", row.file)),
        }
        Ok(())
    }
}
