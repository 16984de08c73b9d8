//! Names of rigs, cameras and streams, and the channel name built from them.

use crate::{Error, ErrorKind, Result};
use core::fmt;
use core::str::FromStr;
use serde::{Deserialize, Serialize};

/// The longest name, bytes: a name fills at most 31 of the 32 bytes that it has in a header.
pub const MAX_NAME_LEN: usize = 31;

/// A name of 1 to 31 characters out of `a-z`, `0-9` and `_`, beginning with a letter.
///
/// The rule is that of ROS 2 names, so that a stream can be a topic without renaming.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Name(String);

/// The name of a rig: one mount on one computer.
pub type RigName = Name;
/// The name of a camera of a rig.
pub type CameraName = Name;
/// The name of a stream of a camera: `color`, `depth`, `ir_left`, `depth_refined`, …
pub type StreamName = Name;

impl Name {
    /// Checks `s` against the rule.
    ///
    /// # Errors
    /// [`ErrorKind::BadName`] saying which rule `s` breaks.
    pub fn new(s: impl Into<String>) -> Result<Self> {
        let s = s.into();
        let problem = match s.chars().next() {
            None => Some("it is empty".to_owned()),
            Some(c) if !c.is_ascii_lowercase() => {
                Some(format!("it begins with '{c}', not with a letter a-z"))
            }
            _ if s.len() > MAX_NAME_LEN => {
                Some(format!("it has {} characters, {MAX_NAME_LEN} is the most", s.len()))
            }
            _ => s
                .chars()
                .find(|c| !(c.is_ascii_lowercase() || c.is_ascii_digit() || *c == '_'))
                .map(|c| format!("'{c}' is not one of a-z, 0-9 and _")),
        };
        match problem {
            None => Ok(Self(s)),
            Some(why) => Err(Error::new(ErrorKind::BadName, format!("\"{s}\" cannot be a name: {why}"))),
        }
    }

    /// The name as text.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for Name {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl FromStr for Name {
    type Err = Error;
    fn from_str(s: &str) -> Result<Self> {
        Self::new(s)
    }
}

impl TryFrom<String> for Name {
    type Error = Error;
    fn try_from(s: String) -> Result<Self> {
        Self::new(s)
    }
}

impl From<Name> for String {
    fn from(n: Name) -> Self {
        n.0
    }
}

/// One stream of one camera, written `camera/stream`.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct StreamId {
    /// The camera.
    pub camera: CameraName,
    /// Its stream.
    pub stream: StreamName,
}

impl StreamId {
    /// The stream `stream` of `camera`.
    ///
    /// # Errors
    /// [`ErrorKind::BadName`] when one of the names breaks the rule of [`Name`].
    pub fn new(camera: &str, stream: &str) -> Result<Self> {
        Ok(Self { camera: Name::new(camera)?, stream: Name::new(stream)? })
    }
}

impl fmt::Display for StreamId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.camera, self.stream)
    }
}

impl FromStr for StreamId {
    type Err = Error;
    fn from_str(s: &str) -> Result<Self> {
        let (camera, stream) = s.split_once('/').ok_or_else(|| {
            Error::new(
                ErrorKind::BadName,
                format!("\"{s}\" is no stream: write CAMERA/STREAM, such as d435/depth"),
            )
        })?;
        Self::new(camera, stream)
    }
}

impl TryFrom<String> for StreamId {
    type Error = Error;
    fn try_from(s: String) -> Result<Self> {
        s.parse()
    }
}

impl From<StreamId> for String {
    fn from(id: StreamId) -> Self {
        id.to_string()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn good_names_pass_and_bad_ones_say_why() {
        for good in ["d435", "ir_left", "a", &"x".repeat(31)] {
            assert_eq!(Name::new(good).unwrap().as_str(), good);
        }
        for (bad, why) in [
            ("", "empty"),
            ("4cam", "begins with '4'"),
            ("Cam", "begins with 'C'"),
            ("a-b", "'-' is not one of"),
            (&"x".repeat(32), "32 characters"),
        ] {
            let e = Name::new(bad).unwrap_err();
            assert_eq!(e.kind(), ErrorKind::BadName);
            assert!(e.to_string().contains(why), "{e}");
        }
    }

    #[test]
    fn stream_ids_parse_and_print() {
        let id: StreamId = "d435/depth".parse().unwrap();
        assert_eq!(id.to_string(), "d435/depth");
        assert!("d435".parse::<StreamId>().unwrap_err().to_string().contains("CAMERA/STREAM"));
    }
}
