//! Problems of a configuration, each with its place, in the order of the file.

use crate::{Error, ErrorKind};
use core::fmt;
use std::path::Path;

/// One problem of a configuration.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Problem {
    /// Line, from 1.
    pub line: usize,
    /// Character of that line, from 1.
    pub column: usize,
    /// The problem, and how to correct it.
    pub message: String,
}

/// A configuration that cannot be used.
#[derive(Debug)]
pub struct ConfigError {
    file: String,
    problems: Vec<Problem>,
    unreadable: Option<std::io::Error>,
}

impl ConfigError {
    pub(super) fn new(file: String, mut problems: Vec<Problem>) -> Self {
        problems.sort_by_key(|p| (p.line, p.column));
        Self { file, problems, unreadable: None }
    }

    pub(super) fn unreadable(path: &Path, e: std::io::Error) -> Self {
        Self { file: path.display().to_string(), problems: Vec::new(), unreadable: Some(e) }
    }

    /// Every problem, in the order of the file; none when the file could not be read at all.
    pub fn problems(&self) -> &[Problem] {
        &self.problems
    }

    /// The kind, for callers that decide on it.
    pub fn kind(&self) -> ErrorKind {
        match self.unreadable.as_ref().map(std::io::Error::kind) {
            Some(std::io::ErrorKind::NotFound) => ErrorKind::NotFound,
            Some(std::io::ErrorKind::PermissionDenied) => ErrorKind::PermissionDenied,
            _ => ErrorKind::BadInput,
        }
    }
}

/// One line per problem: `rig.toml:14:3: unknown key "reslution" in [[camera]] "d435"; did you mean "resolution"?`
impl fmt::Display for ConfigError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(e) = &self.unreadable {
            let what = match e.kind() {
                std::io::ErrorKind::NotFound => {
                    "there is no such file; `depthrig config show` prints one to begin with"
                }
                std::io::ErrorKind::PermissionDenied => "you may not read it",
                std::io::ErrorKind::IsADirectory => "it is a folder; name the TOML file in it",
                std::io::ErrorKind::InvalidData => "it is not text (a rig configuration is a TOML file)",
                _ => return write!(f, "{}: cannot be read: {e}", self.file),
            };
            return write!(f, "{}: {what}", self.file);
        }
        for (i, p) in self.problems.iter().enumerate() {
            let newline = if i == 0 { "" } else { "\n" };
            write!(f, "{newline}{}:{}:{}: {}", self.file, p.line, p.column, p.message)?;
        }
        Ok(())
    }
}

impl std::error::Error for ConfigError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        self.unreadable.as_ref().map(|e| e as _)
    }
}

impl From<ConfigError> for Error {
    fn from(e: ConfigError) -> Self {
        Self::new(e.kind(), e.to_string()).with_source(e)
    }
}
