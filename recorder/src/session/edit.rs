//! Edits the session of a dataset after the recording, with a history of the earlier values.
//!
//! Only `session.toml` changes, in one step; the segments keep the state at recording time. The file is
//! edited as text: comments, order and keys that depthrig does not know stay as they are.

use super::{Edit, EpisodeEnd, Mark, Note, SESSION_FILE, Session, text_of};
use crate::dataset::segments_in;
use crate::fs::{self, Fs};
use crate::{Error, ErrorKind, Result};
use depthrig_bus::UtcPair;
use std::path::{Path, PathBuf};
use toml_edit::{ArrayOfTables, DocumentMut, InlineTable, Item, Table, Value};

mod calibration;

pub use calibration::{StreamCalibration, UnitCalibration};

/// Longest name of a dataset, bytes: file systems allow 255, and a suffix must fit.
const NAME_MAX_BYTES: usize = 240;

/// Changes to a session; `None` leaves a key as it is.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct SessionChanges {
    /// The scene in front of the cameras.
    pub scene: Option<String>,
    /// Who recorded it.
    pub operator: Option<String>,
    /// Notes to add.
    pub notes: Vec<String>,
    /// A person's judgement; `Some(None)` takes it back.
    pub mark: Option<Option<Mark>>,
    /// Judgements of episodes, by number.
    pub episodes: Vec<(u32, EpisodeEnd)>,
}

/// Changes the session of the dataset `dir` and returns what was changed; an equal value is not
/// a change. Every change goes into the session's history.
///
/// # Errors
/// [`ErrorKind::NotFound`] or [`ErrorKind::NotADataset`] without a session file, [`ErrorKind::BadInput`] while it is
/// being recorded or unfinished or for an empty note, [`ErrorKind::InUse`] while another process works on it,
/// [`ErrorKind::Corrupt`] when the file is not a session (it is left alone), and errors of the file system.
pub fn edit(fs: &dyn Fs, dir: &Path, changes: &SessionChanges) -> Result<Vec<Edit>> {
    if changes.notes.iter().any(|n| n.trim().is_empty()) {
        return Err(Error::new(ErrorKind::BadInput, "the note is empty"));
    }
    let mut file = SessionText::open(fs, dir)?;
    for (key, value) in [("scene", &changes.scene), ("operator", &changes.operator)] {
        if let Some(value) = value {
            if value.len() > super::NOTE_MAX_BYTES {
                let message =
                    format!("the {key} has {} bytes, {} is the limit", value.len(), super::NOTE_MAX_BYTES);
                return Err(Error::new(ErrorKind::BadInput, message));
            }
            file.set(key, value)?;
        }
    }
    for note in &changes.notes {
        file.note(note)?;
    }
    if let Some(mark) = changes.mark {
        file.mark(mark)?;
    }
    for (number, end) in &changes.episodes {
        file.episode(*number, *end)?;
    }
    file.save()
}

/// Gives the dataset `dir`, which was made of a recording, that recording's scene, operator, notes, episodes and judgement. Its times are those of
/// the recording.
///
/// # Errors
/// As [`edit`].
pub fn adopt(fs: &dyn Fs, dir: &Path, recording: &Session) -> Result<()> {
    let mut file = SessionText::open(fs, dir)?;
    let session = &mut file.session;
    session.scene.clone_from(&recording.scene);
    session.operator.clone_from(&recording.operator);
    session.notes.clone_from(&recording.notes);
    session.episodes.clone_from(&recording.episodes);
    session.mark = recording.mark;
    let text = session.to_toml()?;
    super::check_size(&text, &file.path)?;
    fs::replace(fs, &file.path, text.as_bytes()).map_err(|e| Error::io("write", &file.path, e))
}

/// Renames the dataset `dir`: its folder, and the name in its session. Returns the new folder.
///
/// # Errors
/// As [`edit`]; [`ErrorKind::BadInput`] for an invalid folder name, [`ErrorKind::AlreadyExists`] when
/// something has that name.
pub fn rename(fs: &dyn Fs, dir: &Path, name: &str) -> Result<(PathBuf, Vec<Edit>)> {
    check_name(name)?;
    let mut file = SessionText::open(fs, dir)?;
    let target = dir.parent().unwrap_or(Path::new("")).join(name);
    let same = target.file_name() == dir.file_name();
    if !same && (fs.read_dir(&target).is_ok() || fs.open(&target).is_ok()) {
        let what = format!("{} exists already; nothing was renamed", target.display());
        return Err(Error::new(ErrorKind::AlreadyExists, what));
    }
    file.set("name", name)?;
    // The name first: if killed in between, the dataset is complete under its old folder's name.
    let edits = file.save()?;
    if !same {
        fs.rename(dir, &target).map_err(|e| Error::io("rename", dir, e))?;
        let parent = target.parent().unwrap_or(Path::new(""));
        fs.sync_dir(parent).map_err(|e| Error::io("sync the folder", parent, e))?;
    }
    Ok((target, edits))
}

/// Checks that `name` is a valid name for a dataset's folder.
///
/// # Errors
/// [`ErrorKind::BadInput`] when it is empty, hidden, a path, or too long.
pub fn check_name(name: &str) -> Result<()> {
    let why = if name.trim().is_empty() {
        "it is empty"
    } else if name.starts_with('.') {
        "it begins with a dot"
    } else if name.contains(['/', '\0']) {
        "it is a path"
    } else if name.chars().any(char::is_control) {
        "it has control characters"
    } else if name.len() > NAME_MAX_BYTES {
        "it is longer than 240 bytes"
    } else {
        return Ok(());
    };
    let shown: String = name.chars().take(60).collect();
    let what = format!("\"{}\" cannot be the name of a dataset's folder: {why}", shown.escape_debug());
    Err(Error::new(ErrorKind::BadInput, what))
}

/// A `session.toml` being edited.
pub(crate) struct SessionText<'a> {
    fs: &'a dyn Fs,
    path: PathBuf,
    document: DocumentMut,
    session: Session,
    edits: Vec<Edit>,
    /// Keeps a recorder, a recovery and another edit out; `None` where the file system has no locks.
    _lock: Option<Box<dyn Send + Sync>>,
}

impl<'a> SessionText<'a> {
    pub(crate) fn open(fs: &'a dyn Fs, dir: &Path) -> Result<Self> {
        let lock = fs.lock(dir);
        let entries = fs.read_dir(dir).map_err(|e| Error::reading("open", dir, e))?;
        let part = |p: &PathBuf| p.extension().is_some_and(|e| e == "part");
        if let Some(part) = segments_in(&entries, dir).iter().find(|p| part(p)) {
            let file = part.file_name().unwrap_or_default().to_string_lossy().into_owned();
            let dir = dir.display();
            return Err(Error::new(
                ErrorKind::BadInput,
                format!(
                    "{dir} is being recorded or was not finished ({file}): add notes with `depthrig record note`, stop \
                     the recording first, or finish a broken one with `depthrig recover {dir}`"
                ),
            ));
        }
        // After the search, which has a better message for a dataset that is being recorded.
        let lock = match lock {
            Err(e) if e.kind() == std::io::ErrorKind::WouldBlock => {
                let what = format!(
                    "{} is in use: it is being recorded, recovered or edited; try again when that is done",
                    dir.display()
                );
                return Err(Error::new(ErrorKind::InUse, what).with_source(e));
            }
            lock => lock.ok(),
        };
        let path = dir.join(SESSION_FILE);
        if !entries.iter().any(|e| !e.is_dir && e.name == SESSION_FILE) {
            let what = format!("{} has no {SESSION_FILE} to edit", dir.display());
            return Err(Error::new(ErrorKind::NotADataset, what));
        }
        let text = text_of(fs, &path)?;
        let session = Session::from_toml(&text, &path)?;
        let document = text.parse::<DocumentMut>().map_err(|e| {
            Error::new(ErrorKind::Corrupt, format!("{} is not valid TOML: {e}", path.display()))
                .with_source(e)
        })?;
        Ok(Self { fs, path, document, session, edits: Vec::new(), _lock: lock })
    }

    /// Sets a text of the session.
    fn set(&mut self, key: &'static str, after: &str) -> Result<()> {
        let field = match key {
            "scene" => &mut self.session.scene,
            "operator" => &mut self.session.operator,
            _ => &mut self.session.name,
        };
        if field == after {
            return Ok(());
        }
        let before = std::mem::replace(field, after.to_owned());
        match self.document.get_mut(key).and_then(Item::as_value_mut) {
            // Spaces and comments around a value are kept with it.
            Some(value) => {
                let decor = value.decor().clone();
                *value = Value::from(after);
                *value.decor_mut() = decor;
            }
            None => {
                self.document.insert(key, toml_edit::value(after));
            }
        }
        self.log(key, before, after.to_owned())
    }

    fn mark(&mut self, mark: Option<Mark>) -> Result<()> {
        let before = core::mem::replace(&mut self.session.mark, mark);
        if before == mark {
            return Ok(());
        }
        match mark {
            Some(mark) => drop(self.document.insert("mark", toml_edit::value(mark.name()))),
            None => drop(self.document.remove("mark")),
        }
        let name = |mark: Option<Mark>| mark.map_or("", Mark::name).to_owned();
        self.log("mark", name(before), name(mark))
    }

    fn episode(&mut self, number: u32, end: EpisodeEnd) -> Result<()> {
        let before = self.session.episodes.iter().find(|e| e.number == number).cloned();
        let after = self.session.judge_episode(Some(number), end)?;
        if before.as_ref() == Some(&after) {
            return Ok(());
        }
        let is_it = |t: &Table| t.get("number").and_then(Item::as_integer) == Some(i64::from(number));
        let tables = self.document.get_mut("episodes").and_then(Item::as_array_of_tables_mut);
        // Without it the text is another session than it should be, and `save` refuses it.
        if let Some(table) = tables.and_then(|tables| tables.iter_mut().find(|t| is_it(t))) {
            match after.outcome {
                Some(outcome) => drop(table.insert("outcome", toml_edit::value(outcome.name()))),
                None => drop(table.remove("outcome")),
            }
            if after.discarded {
                table.insert("discarded", toml_edit::value(true));
            } else {
                table.remove("discarded");
            }
        }
        let before = before.map_or("", |e| e.state()).to_owned();
        self.log(&format!("episode {number}"), before, after.state().to_owned())
    }

    fn note(&mut self, text: &str) -> Result<()> {
        let utc_ns = UtcPair::sample().utc_ns;
        self.session.check_note(text)?;
        self.session.notes.push(Note { utc_ns, text: text.to_owned() });
        self.push("notes", [("utc_ns", Value::from(utc_ns)), ("text", Value::from(text))])?;
        self.log("notes", String::new(), text.to_owned())
    }

    fn log(&mut self, field: &str, before: String, after: String) -> Result<()> {
        let utc_ns = UtcPair::sample().utc_ns;
        let depthrig_version = env!("CARGO_PKG_VERSION").to_owned();
        let edit = Edit { utc_ns, field: field.to_owned(), before, after, depthrig_version };
        let entries = [
            ("utc_ns", Value::from(edit.utc_ns)),
            ("field", Value::from(&edit.field)),
            ("before", Value::from(&edit.before)),
            ("after", Value::from(&edit.after)),
            ("depthrig_version", Value::from(&edit.depthrig_version)),
        ];
        self.push("history", entries)?;
        self.session.history.push(edit.clone());
        self.edits.push(edit);
        Ok(())
    }

    /// Adds a table to an array of tables, in the form that the array has.
    fn push<const N: usize>(&mut self, key: &str, entries: [(&str, Value); N]) -> Result<()> {
        let array = self.document.entry(key).or_insert_with(|| Item::ArrayOfTables(ArrayOfTables::new()));
        if let Some(tables) = array.as_array_of_tables_mut() {
            let mut table = Table::new();
            for (key, value) in entries {
                table.insert(key, Item::Value(value));
            }
            tables.push(table);
            return Ok(());
        }
        let Some(inline) = array.as_array_mut() else {
            let what = format!("{}: \"{key}\" is not a list; nothing was changed", self.path.display());
            return Err(Error::new(ErrorKind::Corrupt, what));
        };
        inline.push(Value::InlineTable(entries.into_iter().collect::<InlineTable>()));
        Ok(())
    }

    /// Replaces the file, if anything changed, after reading the new text as a session.
    pub(crate) fn save(&mut self) -> Result<Vec<Edit>> {
        if self.edits.is_empty() {
            return Ok(Vec::new());
        }
        let text = self.document.to_string();
        super::check_size(&text, &self.path)?;
        // Compared as text, in which a NaN of a hand-written key equals itself.
        if Session::from_toml(&text, &self.path)?.to_toml()? != self.session.to_toml()? {
            let what = format!("{} cannot be edited as text; nothing was changed", self.path.display());
            return Err(Error::new(ErrorKind::Corrupt, what));
        }
        fs::replace(self.fs, &self.path, text.as_bytes()).map_err(|e| Error::io("write", &self.path, e))?;
        Ok(std::mem::take(&mut self.edits))
    }
}
