//! Inputs and results of work that many machines share: folders of a file system, and prefixes of an S3 bucket.
//!
//! Objects are copied to this computer, worked on, and their results put: an object is complete or not there, and one
//! that is there is never written again.

use depthrig_bus::files::{self, NewFile};
use depthrig_recorder::{Error, ErrorKind, Result};
use std::io::{self, Write as _};
use std::path::{Path, PathBuf};

mod http;
mod s3;

pub use s3::{Listing, Remote};

/// Begins the address of a prefix in a bucket.
const SCHEME: &str = "s3://";

/// A folder.
#[derive(Debug, Clone)]
pub enum Place {
    /// Of a file system.
    Local(PathBuf),
    /// Of a bucket.
    Remote(Remote),
}

impl Place {
    /// Whether an argument names a bucket: it begins with `s3://`.
    pub fn is_remote(path: &Path) -> bool {
        path.to_str().is_some_and(|text| text.starts_with(SCHEME))
    }

    /// The place of an argument: a path, or `s3://BUCKET/PREFIX` with credentials and endpoint of the environment.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] for an address without a bucket, or with settings in the environment that contradict each other.
    pub fn parse(path: &Path) -> Result<Self> {
        let Some(address) = path.to_str().and_then(|text| text.strip_prefix(SCHEME)) else {
            return Ok(Self::Local(path.to_owned()));
        };
        let (bucket, prefix) = address.split_once('/').unwrap_or((address, ""));
        if bucket.is_empty() {
            let what = format!("{}: no bucket is named; write s3://BUCKET/PREFIX", path.display());
            return Err(Error::new(ErrorKind::BadInput, what));
        }
        Ok(Self::Remote(Remote::open(bucket, prefix)?))
    }

    /// The place `name` below this one.
    pub(crate) fn at(&self, name: &str) -> Self {
        match self {
            Self::Local(path) => Self::Local(path.join(name)),
            Self::Remote(remote) => Self::Remote(remote.at(name)),
        }
    }

    /// A small file; `None` when it is not there.
    pub(crate) fn read(&self, name: &str) -> Result<Option<Vec<u8>>> {
        match self {
            Self::Local(folder) => {
                let path = folder.join(name);
                match files::read(&path, files::TEXT_MAX_BYTES) {
                    Ok(bytes) => Ok(Some(bytes)),
                    Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(None),
                    Err(e) => Err(Error::reading("read", &path, e)),
                }
            }
            Self::Remote(remote) => remote.read(name),
        }
    }

    /// Writes a small file, unless one of that name is there; says whether it did.
    fn put_new(&self, name: &str, bytes: &[u8]) -> Result<bool> {
        match self {
            Self::Local(folder) => {
                let path = folder.join(name);
                let write = || {
                    let mut file = NewFile::beside(&path)?;
                    file.write_all(bytes)?;
                    file.create()
                };
                match write() {
                    Ok(()) => Ok(true),
                    Err(e) if e.kind() == io::ErrorKind::AlreadyExists => Ok(false),
                    Err(e) => Err(Error::io("write", &path, e)),
                }
            }
            Self::Remote(remote) => remote.put_new(name, bytes),
        }
    }

    /// Whether a file is there that says this; what all parts of a run must agree on.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] when it says something else; and as the place says.
    pub(crate) fn agrees_on(&self, name: &str, text: &[u8], cure: &str) -> Result<bool> {
        match self.read(name)? {
            None => Ok(false),
            Some(there) if there == text => Ok(true),
            Some(_) => {
                let what =
                    format!("{self}/{name} is of a run with other arguments or another version; {cure}");
                Err(Error::new(ErrorKind::BadInput, what))
            }
        }
    }

    /// The same, and writes the file if it is not there.
    ///
    /// # Errors
    /// As [`Self::agrees_on`].
    pub(crate) fn agree_on(&self, name: &str, text: &[u8], cure: &str) -> Result<()> {
        if !self.agrees_on(name, text, cure)? && !self.put_new(name, text)? {
            // Another part has just put it.
            self.agrees_on(name, text, cure)?;
        }
        Ok(())
    }
}

impl core::fmt::Display for Place {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Local(path) => path.display().fmt(f),
            Self::Remote(remote) => remote.fmt(f),
        }
    }
}
