//! The files that depthrig puts into a system: the udev rules, the limit of USB transfers, the service.
//!
//! Each begins with a line that holds a checksum of the rest. It distinguishes a file changed by hand from one that an
//! earlier version wrote: the second is replaced, the first only with `--overwrite`.

use anyhow::{Context, Result};
use depthrig_bus::files::NewFile;
use std::io;
use std::path::{Path, PathBuf};

const MARK: &str = "# Written by `depthrig install`, checksum ";

/// Settings of the service.
#[derive(Debug, Clone)]
pub struct Service {
    /// The user it runs as.
    pub user: String,
    /// The program.
    pub binary: PathBuf,
    /// The rig's configuration.
    pub rig_file: PathBuf,
    /// Where it may record.
    pub data: PathBuf,
}

/// A file to be installed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SystemFile {
    /// Where it goes, absolute.
    pub path: PathBuf,
    /// Its purpose, in a few words.
    pub what: &'static str,
    /// All of it, the first line included.
    pub text: String,
    /// Where the Debian package puts it, without the first line; the file at `path` takes its place.
    pub packaged: Option<PathBuf>,
}

/// How a file stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum State {
    /// Not there.
    Missing,
    /// Not there, and not needed: the package brings it with the same contents.
    Packaged,
    /// Not there; the package brings it with other contents.
    PackagedOther,
    /// There, as this version writes it.
    Current,
    /// There, as depthrig wrote it once.
    Older,
    /// There, but changed by hand.
    Changed,
}

/// Outcome for a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Done {
    /// It is new, or replaced.
    Written,
    /// It was as it should be already.
    Unchanged,
    /// Changed by hand, so it was kept.
    Refused,
    /// The package brings it, so nothing was written or removed.
    Packaged,
    /// It is gone.
    Removed,
    /// There was none.
    Absent,
}

/// Every file, in the order in which they are shown.
pub fn files(service: &Service) -> Vec<SystemFile> {
    let unit = include_str!("../systemd/depthrig.service")
        .replace("@USER@", &service.user)
        .replace("@BINARY@", &quoted(&service.binary).replace('$', "$$"))
        .replace("@RIG_FILE@", &quoted(&service.rig_file).replace('$', "$$"))
        .replace("@DATA@", &quoted(&service.data));
    let file = |path: &str, what, text: &str, packaged: Option<&str>| SystemFile {
        path: path.into(),
        what,
        text: marked(text),
        packaged: packaged.map(PathBuf::from),
    };
    vec![
        file(
            "/etc/udev/rules.d/70-depthrig.rules",
            "who may use cameras; no autosuspend",
            include_str!("../udev/70-depthrig.rules"),
            Some("/usr/lib/udev/rules.d/70-depthrig.rules"),
        ),
        file(
            "/etc/tmpfiles.d/depthrig.conf",
            "memory for USB transfers",
            include_str!("../tmpfiles/depthrig.conf"),
            Some("/usr/lib/tmpfiles.d/depthrig.conf"),
        ),
        // The package's service is one of a user's own systemd, which is another file.
        file("/etc/systemd/system/depthrig.service", "the daemon as a service", &unit, None),
    ]
}

/// A path as a unit file wants it: in double quotes, with `%`, `"` and `\` escaped (systemd.syntax(7), systemd.unit(5)
/// "Specifiers"). In command lines `$` is doubled besides (systemd.service(5) "Command lines").
fn quoted(path: &Path) -> String {
    let mut text = String::from("\"");
    for c in path.to_string_lossy().chars() {
        match c {
            '%' => text.push_str("%%"),
            '"' | '\\' => text.extend(['\\', c]),
            c => text.push(c),
        }
    }
    text + "\""
}

fn marked(text: &str) -> String {
    format!(
        "{MARK}{:08x}; a file that was changed by hand is left alone.\n{text}",
        crc32fast::hash(text.as_bytes())
    )
}

/// Whether `text` is as depthrig wrote it, this version or another.
fn is_ours(text: &str) -> bool {
    text.split_once('\n').is_some_and(|(_, rest)| marked(rest) == text)
}

impl SystemFile {
    /// Where it lies when the system is in the folder `root`.
    pub fn below(&self, root: &Path) -> PathBuf {
        below(root, &self.path)
    }

    /// The package's file, when it is there, in the folder `root`.
    pub fn packaged_below(&self, root: &Path) -> Option<PathBuf> {
        self.packaged.as_deref().map(|path| below(root, path)).filter(|path| path.is_file())
    }

    /// How it stands below `root`.
    ///
    /// # Errors
    /// When the existing file cannot be read.
    pub fn state(&self, root: &Path) -> Result<State> {
        let path = self.below(root);
        match depthrig_bus::files::read(&path, depthrig_bus::files::TEXT_MAX_BYTES) {
            Ok(bytes) if bytes == self.text.as_bytes() => Ok(State::Current),
            Ok(bytes) if std::str::from_utf8(&bytes).is_ok_and(is_ours) => Ok(State::Older),
            Ok(_) => Ok(State::Changed),
            Err(e) if e.kind() == io::ErrorKind::NotFound => self.state_of_packaged(root),
            Err(e) => Err(e).with_context(|| format!("{} cannot be read", path.display())),
        }
    }

    fn state_of_packaged(&self, root: &Path) -> Result<State> {
        let Some(path) = self.packaged_below(root) else { return Ok(State::Missing) };
        let bytes = depthrig_bus::files::read(&path, depthrig_bus::files::TEXT_MAX_BYTES)
            .with_context(|| format!("{} cannot be read", path.display()))?;
        let same = std::str::from_utf8(&bytes).is_ok_and(|text| marked(text) == self.text);
        Ok(if same { State::Packaged } else { State::PackagedOther })
    }

    /// Installs the file; replaces one changed by hand only with `overwrite`.
    ///
    /// # Errors
    /// When it cannot be written; an existing file is then unchanged.
    pub fn install(&self, root: &Path, overwrite: bool) -> Result<Done> {
        let state = self.state(root)?;
        match state {
            State::Current => return Ok(Done::Unchanged),
            State::Packaged => return Ok(Done::Packaged),
            State::Changed if !overwrite => return Ok(Done::Refused),
            _ => {}
        }
        let path = self.below(root);
        let write = || -> io::Result<()> {
            let folder = path.parent().unwrap_or(root);
            std::fs::create_dir_all(folder)?;
            // Written beside it and then renamed, so that no one reads a partial file.
            let mut file = NewFile::beside(&path)?;
            io::Write::write_all(&mut file, self.text.as_bytes())?;
            let mode = std::os::unix::fs::PermissionsExt::from_mode(0o644);
            file.file().set_permissions(mode)?;
            // A file created since the check is not ours.
            let absent = matches!(state, State::Missing | State::PackagedOther);
            if absent { file.create() } else { file.replace() }
        };
        write().map_err(|e| refused(e, &path))?;
        Ok(Done::Written)
    }

    /// Removes the file; one changed by hand only with `overwrite`.
    ///
    /// # Errors
    /// When it cannot be removed.
    pub fn remove(&self, root: &Path, overwrite: bool) -> Result<Done> {
        match self.state(root)? {
            State::Missing => return Ok(Done::Absent),
            State::Packaged | State::PackagedOther => return Ok(Done::Packaged),
            State::Changed if !overwrite => return Ok(Done::Refused),
            _ => {}
        }
        let path = self.below(root);
        std::fs::remove_file(&path).map_err(|e| refused(e, &path))?;
        Ok(Done::Removed)
    }
}

fn below(root: &Path, path: &Path) -> PathBuf {
    root.join(path.strip_prefix("/").unwrap_or(path))
}

fn refused(e: io::Error, path: &Path) -> anyhow::Error {
    let denied = e.kind() == io::ErrorKind::PermissionDenied;
    let what = if denied { "you may not write it; run this as root (sudo)" } else { "it cannot be written" };
    anyhow::Error::new(e).context(format!("{}: {what}", path.display()))
}

#[cfg(test)]
mod tests;
