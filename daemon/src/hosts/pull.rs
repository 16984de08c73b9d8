//! Pulls the part of a recording that another computer made: a segment is only appended to, so that it is pulled while it grows, from where
//! the copy ends.
//!
//! The copy grows in a hidden folder, `.pulling/PART` beside the recordings, and gets its place when it is complete. Until then it is what
//! a computer leaves that was switched off: `depthrig recover` makes a dataset of it.

use crate::api::{BytesRequest, FileRequest, MAX_PART_BYTES, RecordingFile, digest_of, is_served};
use crate::client::Client;
use crate::{Error, ErrorKind, Result};
use core::time::Duration;
use depthrig_bus::{HostTime, shm, umask};
use depthrig_recorder::SESSION_FILE;
use std::fs::{self, File, OpenOptions};
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

/// The folder beside the recordings in which copies grow.
const FOLDER: &str = ".pulling";
/// The longest `session.toml`, as of any reader of datasets.
const MAX_SESSION_BYTES: u64 = 16 << 20;

/// The first piece that is asked for, bytes, and the smallest.
const PIECE_BYTES: u64 = 128 << 10;
/// Pieces become larger as long as they come within this: commands to the host wait behind one on a slow way.
const PIECE_TIME: Duration = Duration::from_millis(100);

/// A part, and for how long it is to be pulled.
pub(super) struct Pull<'a> {
    pub(super) client: &'a Client,
    /// Its name there.
    pub(super) name: &'a str,
    /// Its place here when it is complete.
    pub(super) folder: PathBuf,
    /// This stays free on the disk.
    pub(super) reserve_bytes: u64,
    pub(super) until: HostTime,
    pub(super) stop: &'a AtomicBool,
}

/// Where the copy grows of a part that is to be `folder`.
pub(super) fn growing(folder: &Path) -> PathBuf {
    folder.with_file_name(FOLDER).join(folder.file_name().unwrap_or_default())
}

/// Bytes of the next piece after one of `bytes` that took so long.
fn next_piece(bytes: u64, took: Duration) -> u64 {
    let next = if took < PIECE_TIME / 2 {
        bytes * 2
    } else if took > PIECE_TIME {
        bytes / 2
    } else {
        bytes
    };
    next.clamp(PIECE_BYTES, MAX_PART_BYTES)
}

/// Progress of a part.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct Pulled {
    /// Bytes of its segments there.
    pub(super) bytes: u64,
    /// Bytes of them here.
    pub(super) copied: u64,
    /// It is complete, and has its place.
    pub(super) is_complete: bool,
    /// There is more to pull now.
    pub(super) is_busy: bool,
}

impl Pull<'_> {
    /// Pulls until the time is over or everything is here.
    ///
    /// # Errors
    /// Those of the host's answers, `NoSpace` when the disk is to keep what it has, `Other` when a copy differs or cannot be written.
    pub(super) fn run(&self) -> Result<Pulled> {
        if self.folder.join(SESSION_FILE).is_file() {
            // It got its place, and the daemon ended before it wrote that down.
            return Ok(Pulled { is_complete: true, ..Pulled::default() });
        }
        let asked = HostTime::now();
        let listed = self.client.recording_files(self.name)?;
        let turn = asked.elapsed();
        let (segments, session): (Vec<_>, Vec<_>) =
            listed.files.into_iter().partition(|file| file.file != SESSION_FILE);
        let folder = growing(&self.folder);
        let failed = |e: io::Error| self.failed(&folder, &e);
        umask::create_dir_all(&folder).map_err(failed)?;
        let mut pulled = Pulled { bytes: segments.iter().map(|s| s.bytes).sum(), ..Pulled::default() };
        let mut all = listed.is_closed;
        for segment in &segments {
            if !is_served(&segment.file) {
                let what = format!("a file of {} is called {:?}", self.name, segment.file);
                return Err(Error::new(ErrorKind::BadInput, what));
            }
            let is_here = self.segment(&folder, segment, turn, &mut pulled)?;
            all &= is_here;
            if self.is_over() {
                pulled.is_busy = !is_here || all;
                break;
            }
        }
        let counted = segments.len() as u64;
        if all && !self.is_over() {
            let session = session.first().ok_or_else(|| {
                Error::new(ErrorKind::NotFound, format!("{} has no {SESSION_FILE}", self.name))
            })?;
            self.session(&folder, session)?;
            remove_strangers(&folder, &segments).map_err(failed)?;
            File::open(&folder).and_then(|dir| dir.sync_all()).map_err(failed)?;
            self.place(&folder)?;
            pulled.is_complete = true;
            pulled.is_busy = false;
            tracing::debug!("{counted} segments of {}", self.name);
        }
        Ok(pulled)
    }

    fn is_over(&self) -> bool {
        self.until.from_now().is_zero() || self.stop.load(Ordering::Relaxed)
    }

    /// Appends what its copy lacks; whether it is closed there and equal here. An answer without bytes takes `turn`.
    fn segment(
        &self,
        folder: &Path,
        segment: &RecordingFile,
        turn: Duration,
        pulled: &mut Pulled,
    ) -> Result<bool> {
        let closed = segment.file.strip_suffix(".part").unwrap_or(&segment.file);
        let done = folder.join(closed);
        let growing = folder.join(format!("{closed}.part"));
        let failed = |e: io::Error| self.failed(&growing, &e);
        let is_closed = closed == segment.file;
        match fs::metadata(&done) {
            Ok(facts) if is_closed && facts.len() == segment.bytes => {
                pulled.copied += segment.bytes;
                return Ok(true);
            }
            // The host recovered the segment, which made another one of it.
            Ok(_) => fs::remove_file(&done).map_err(failed)?,
            Err(e) if e.kind() == io::ErrorKind::NotFound => {}
            Err(e) => return Err(self.failed(&done, &e)),
        }
        let mut copy = OpenOptions::new().append(true).create(true).open(&growing).map_err(failed)?;
        let mut have = copy.metadata().map_err(failed)?.len();
        if have > segment.bytes {
            copy.set_len(0).map_err(failed)?;
            have = 0;
        }
        let mut piece = PIECE_BYTES;
        while have < segment.bytes && !self.is_over() {
            self.must_have_room(folder)?;
            let asked = HostTime::now();
            let length = (segment.bytes - have).min(piece);
            let part =
                BytesRequest { name: self.name.to_owned(), file: segment.file.clone(), offset: have, length };
            let bytes = match self.client.recording_bytes(&part) {
                // It was closed meanwhile and has another name; the next list has it.
                Err(e) if e.kind() == ErrorKind::NotFound => break,
                bytes => bytes?,
            };
            if bytes.is_empty() || bytes.len() as u64 > length {
                let what =
                    format!("{} of {}: {} bytes came for {length}", segment.file, self.name, bytes.len());
                return Err(Error::new(ErrorKind::Other, what));
            }
            copy.write_all(&bytes).map_err(failed)?;
            have += bytes.len() as u64;
            piece = next_piece(piece, asked.elapsed().saturating_sub(turn));
        }
        pulled.copied += have;
        if !is_closed || have < segment.bytes {
            return Ok(false);
        }
        copy.sync_all().map_err(failed)?;
        self.must_equal(&segment.file, &growing)?;
        fs::rename(&growing, &done).map_err(failed)?;
        Ok(true)
    }

    /// A copy that differs is removed, and pulled from its beginning.
    fn must_equal(&self, file: &str, copy: &Path) -> Result<()> {
        let of = FileRequest { name: self.name.to_owned(), file: file.to_owned() };
        let theirs = self.client.recording_digest(&of)?;
        let ours = digest_of(copy).map_err(|e| self.failed(copy, &e))?;
        if theirs == ours {
            return Ok(());
        }
        fs::remove_file(copy).map_err(|e| self.failed(copy, &e))?;
        let what = format!(
            "{file} of {} differs from its copy here, which is pulled again from its beginning",
            self.name
        );
        tracing::warn!("{what}");
        Err(Error::new(ErrorKind::Other, what))
    }

    fn session(&self, folder: &Path, session: &RecordingFile) -> Result<()> {
        if session.bytes > MAX_SESSION_BYTES {
            let what = format!("{SESSION_FILE} of {} has {} bytes", self.name, session.bytes);
            return Err(Error::new(ErrorKind::BadInput, what));
        }
        let mut text = Vec::new();
        while (text.len() as u64) < session.bytes {
            let offset = text.len() as u64;
            let length = session.bytes - offset;
            let part =
                BytesRequest { name: self.name.to_owned(), file: session.file.clone(), offset, length };
            let bytes = self.client.recording_bytes(&part)?;
            if bytes.is_empty() {
                break;
            }
            text.extend(bytes);
        }
        let path = folder.join(SESSION_FILE);
        let write = || -> io::Result<()> {
            let mut file = File::create(&path)?;
            file.write_all(&text)?;
            file.sync_all()
        };
        write().map_err(|e| self.failed(&path, &e))?;
        self.must_equal(SESSION_FILE, &path)
    }

    fn place(&self, folder: &Path) -> Result<()> {
        if self.folder.symlink_metadata().is_ok() {
            let what = format!(
                "{} is there already and is no part of this recording; rename it, or pull stays in {}",
                self.folder.display(),
                folder.display()
            );
            return Err(Error::new(ErrorKind::InUse, what));
        }
        fs::rename(folder, &self.folder).map_err(|e| self.failed(&self.folder, &e))?;
        // The last part takes the folder along.
        if let Some(parent) = folder.parent() {
            let _ = fs::remove_dir(parent);
        }
        Ok(())
    }

    fn must_have_room(&self, folder: &Path) -> Result<()> {
        let free = shm::free_bytes(folder)?;
        if free >= self.reserve_bytes.saturating_add(MAX_PART_BYTES) {
            return Ok(());
        }
        let what = format!(
            "{} has {} MB free, which recordings of this computer need; the part stays where it was recorded until there is room",
            folder.display(),
            free / 1_000_000
        );
        Err(Error::new(ErrorKind::NoSpace, what))
    }

    fn failed(&self, path: &Path, e: &io::Error) -> Error {
        let kind = match e.kind() {
            io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => ErrorKind::NoSpace,
            io::ErrorKind::PermissionDenied => ErrorKind::PermissionDenied,
            _ => ErrorKind::Other,
        };
        Error::new(kind, format!("part {}: {}: {e}", self.name, path.display()))
    }
}

/// Removes copies of segments that the host has no more.
fn remove_strangers(folder: &Path, segments: &[RecordingFile]) -> io::Result<()> {
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        let name = entry.file_name();
        let is_known = name == SESSION_FILE || segments.iter().any(|s| name == s.file.as_str());
        if !is_known {
            fs::remove_file(entry.path())?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pieces_are_as_large_as_the_way_carries_in_a_tenth_of_a_second() {
        for (bytes_s, least, most) in [
            (100_000, PIECE_BYTES, PIECE_BYTES),
            (12_500_000, 600_000, 1_250_000),
            (125_000_000, MAX_PART_BYTES, MAX_PART_BYTES),
        ] {
            let mut piece = PIECE_BYTES;
            for _ in 0..10 {
                piece = next_piece(piece, Duration::from_secs_f64(piece as f64 / f64::from(bytes_s)));
            }
            assert!((least..=most).contains(&piece), "{bytes_s} bytes/s: {piece}");
        }
    }
}
