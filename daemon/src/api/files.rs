//! Files of recordings, for the computer that pulls the parts of a session ([`crate::hosts`]).
//!
//! A segment is only appended to while it is recorded, so that what was read of it stays true.

use super::recordings::folder;
use crate::control::Control;
use crate::{Error, ErrorKind, Result};
use depthrig_recorder::fs::RealFs;
use depthrig_recorder::{Health, SESSION_FILE, Session, look_at};
use serde::{Deserialize, Serialize};
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// Bytes of one answer at the most.
pub const MAX_PART_BYTES: u64 = 2 << 20;
/// Bytes that are read at once for a checksum.
const READ_BYTES: usize = 1 << 20;

/// A file of a recording.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FileRequest {
    /// The path of the recording's folder below that of the recordings.
    pub name: String,
    /// Name of the file in it.
    pub file: String,
}

/// A range of bytes of such a file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BytesRequest {
    /// The path of the recording's folder below that of the recordings.
    pub name: String,
    /// Name of the file in it.
    pub file: String,
    /// First byte.
    pub offset: u64,
    /// Number of bytes; an answer has [`MAX_PART_BYTES`] at the most, and fewer at the file's end.
    pub length: u64,
}

/// The files of a recording.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RecordingFiles {
    /// Its segments will not change any more.
    pub is_closed: bool,
    /// Session file and segments.
    pub files: Vec<RecordingFile>,
}

/// A file and its length.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RecordingFile {
    /// Its name.
    pub file: String,
    /// Its length so far, bytes.
    pub bytes: u64,
}

/// Length and checksum that a copy must have.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct FileDigest {
    /// Length, bytes.
    pub bytes: u64,
    /// CRC-32 (ISO-HDLC) of all of them.
    pub crc32: u32,
}

/// Recognises the names of files that are served: the session or a segment, complete or not.
pub fn is_served(file: &str) -> bool {
    let number = |name: &str| {
        let digits = name.strip_prefix("seg_")?.strip_suffix(".mcap")?;
        Some((4..=9).contains(&digits.len()) && digits.bytes().all(|b| b.is_ascii_digit()))
    };
    file == SESSION_FILE || number(file.strip_suffix(".part").unwrap_or(file)) == Some(true)
}

/// Length and checksum of the file at `path`.
///
/// # Errors
/// Those of reading it.
pub fn digest_of(path: &Path) -> std::io::Result<FileDigest> {
    let mut file = File::open(path)?;
    let mut buffer = vec![0; READ_BYTES];
    let mut crc = crc32fast::Hasher::new();
    let mut bytes = 0;
    loop {
        let n = file.read(&mut buffer)?;
        if n == 0 {
            return Ok(FileDigest { bytes, crc32: crc.finalize() });
        }
        crc.update(&buffer[..n]);
        bytes += n as u64;
    }
}

/// Whether a recording was closed or recovered, so that none of its files grows or is written anew.
fn is_closed(folder: &Path) -> bool {
    let says_how_it_ended = || {
        let text = std::fs::read_to_string(folder.join(SESSION_FILE)).ok()?;
        toml::from_str::<Session>(&text).ok()?.outcome
    };
    !matches!(look_at(&RealFs, folder).health, Health::Recording | Health::Unfinished)
        && says_how_it_ended().is_some()
}

/// The files of the recording `name`.
pub(super) fn list(rig: &dyn Control, name: &str) -> Result<RecordingFiles> {
    let folder = folder(rig, name)?;
    // Before the files are listed: those of a recording that is closed meanwhile are asked for again.
    let is_closed = is_closed(&folder);
    let failed = |e: std::io::Error| {
        Error::new(ErrorKind::Other, format!("{} cannot be read", folder.display())).with_source(e)
    };
    let mut files = Vec::new();
    for entry in std::fs::read_dir(&folder).map_err(failed)? {
        let entry = entry.map_err(failed)?;
        let Ok(file) = entry.file_name().into_string() else { continue };
        if !is_served(&file) {
            continue;
        }
        match entry.metadata() {
            Ok(facts) if facts.is_file() => files.push(RecordingFile { file, bytes: facts.len() }),
            // A segment has just been closed, which renames it, or it is no file.
            _ => {}
        }
    }
    files.sort_by(|a, b| a.file.cmp(&b.file));
    Ok(RecordingFiles { is_closed, files })
}

/// Bytes of a file.
pub(super) fn bytes(rig: &dyn Control, request: &BytesRequest) -> Result<Vec<u8>> {
    let path = path_of(rig, &request.name, &request.file)?;
    let read = || -> std::io::Result<Vec<u8>> {
        let mut file = File::open(&path)?;
        file.seek(SeekFrom::Start(request.offset))?;
        let mut found = Vec::new();
        file.take(request.length.min(MAX_PART_BYTES)).read_to_end(&mut found)?;
        Ok(found)
    };
    read().map_err(|e| unreadable(&path, e))
}

/// Length and checksum of a file.
pub(super) fn digest(rig: &dyn Control, request: &FileRequest) -> Result<FileDigest> {
    let path = path_of(rig, &request.name, &request.file)?;
    digest_of(&path).map_err(|e| unreadable(&path, e))
}

fn path_of(rig: &dyn Control, name: &str, file: &str) -> Result<PathBuf> {
    if !is_served(file) {
        let what = format!("{file:?} is not the session file or a segment");
        return Err(Error::new(ErrorKind::BadInput, what));
    }
    Ok(folder(rig, name)?.join(file))
}

fn unreadable(path: &Path, e: std::io::Error) -> Error {
    let kind = if e.kind() == std::io::ErrorKind::NotFound { ErrorKind::NotFound } else { ErrorKind::Other };
    Error::new(kind, format!("{} cannot be read: {e}", path.display())).with_source(e)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_sessions_and_segments_are_served() {
        for good in ["session.toml", "seg_0000.mcap", "seg_0017.mcap.part", "seg_123456789.mcap"] {
            assert!(is_served(good), "{good}");
        }
        for bad in [
            "",
            "..",
            "../seg_0000.mcap",
            "seg_0000.mcap/..",
            "seg_.mcap",
            "seg_000.mcap",
            "seg_+001.mcap",
            "seg_0000.mcap.part.part",
            "session.toml.part",
            "report.html",
            ".reserve",
            "seg_0000.mcap\0",
        ] {
            assert!(!is_served(bad), "{bad}");
        }
    }

    #[test]
    fn a_digest_is_of_all_bytes() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("file");
        let bytes: Vec<u8> = (0..READ_BYTES * 2 + 77).map(|i| (i * 31 % 251) as u8).collect();
        std::fs::write(&path, &bytes).unwrap();
        let expected = FileDigest { bytes: bytes.len() as u64, crc32: crc32fast::hash(&bytes) };
        assert_eq!(digest_of(&path).unwrap(), expected);
        std::fs::write(&path, b"123456789").unwrap();
        // The check value of this CRC in the catalogue of parametrised CRC algorithms.
        assert_eq!(digest_of(&path).unwrap().crc32, 0xcbf4_3926);
    }
}
