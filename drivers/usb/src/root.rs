//! Where `/sys`, `/proc` and `/dev` are: the running system's, or a fake tree's.

use std::path::{Path, PathBuf};

/// The root of the file system that is asked.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SysRoot(PathBuf);

impl Default for SysRoot {
    fn default() -> Self {
        Self::new("/")
    }
}

impl SysRoot {
    /// The tree below `root`, which holds `sys`, `proc` and `dev` as `/` does.
    pub fn new(root: impl Into<PathBuf>) -> Self {
        Self(root.into())
    }

    /// `path`, which is relative to the root, such as `sys/bus/usb`.
    pub fn join(&self, path: impl AsRef<Path>) -> PathBuf {
        self.0.join(path)
    }

    /// Where `path`, an absolute path such as `/dev/shm`, lies below this root.
    pub fn at(&self, path: &Path) -> PathBuf {
        self.0.join(path.strip_prefix("/").unwrap_or(path))
    }

    /// The text of a one-line file of the kernel, such as `sys/module/usbcore/parameters/usbfs_memory_mb`. `None`
    /// when it is not there or may not be read.
    ///
    /// A string that a device reports may hold anything; control characters become spaces.
    pub fn read(&self, path: impl AsRef<Path>) -> Option<String> {
        read_text(&self.join(path))
    }
}

/// See [`SysRoot::read`]. A string descriptor that is not UTF-8 is shown with replacement characters.
pub(super) fn read_text(path: &Path) -> Option<String> {
    let bytes = std::fs::read(path).ok()?;
    let text: String =
        String::from_utf8_lossy(&bytes).chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
    Some(text.trim().to_owned())
}
