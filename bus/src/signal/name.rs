//! The name of a signal.

use crate::ids::Name;
use crate::{Error, ErrorKind, Result};
use core::fmt;
use core::str::FromStr;
use serde::{Deserialize, Serialize};

/// The name of a signal, written `DEVICE/SIGNAL`, such as `arm/joint_position`. Both parts follow the rule of
/// [`Name`].
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct SignalName {
    device: Name,
    signal: Name,
}

impl SignalName {
    /// The signal `signal` of `device`.
    ///
    /// # Errors
    /// [`ErrorKind::BadName`] when one of the names breaks the rule of [`Name`].
    pub fn new(device: &str, signal: &str) -> Result<Self> {
        Ok(Self { device: Name::new(device)?, signal: Name::new(signal)? })
    }

    /// The device that the signal belongs to, such as `arm`.
    pub const fn device(&self) -> &Name {
        &self.device
    }

    /// The signal's name on its device, such as `joint_position`.
    pub const fn signal(&self) -> &Name {
        &self.signal
    }
}

impl fmt::Display for SignalName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.device, self.signal)
    }
}

impl FromStr for SignalName {
    type Err = Error;
    fn from_str(s: &str) -> Result<Self> {
        let (device, signal) = s.split_once('/').ok_or_else(|| {
            let why = format!("invalid signal name \"{s}\": write DEVICE/SIGNAL, such as arm/joint_position");
            Error::new(ErrorKind::BadName, why)
        })?;
        Self::new(device, signal)
    }
}

impl TryFrom<String> for SignalName {
    type Error = Error;
    fn try_from(s: String) -> Result<Self> {
        s.parse()
    }
}

impl From<SignalName> for String {
    fn from(name: SignalName) -> Self {
        name.to_string()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_parse_and_print_and_bad_ones_say_why() {
        let name: SignalName = "arm/joint_position".parse().unwrap();
        assert_eq!(name.to_string(), "arm/joint_position");
        for (bad, why) in [
            ("arm", "DEVICE/SIGNAL"),
            ("arm/", "empty"),
            ("Arm/x", "begins with 'A'"),
            ("arm/x/y", "'/' is not one of"),
            ("arm/x.y", "'.' is not one of"),
        ] {
            let e = bad.parse::<SignalName>().unwrap_err();
            assert_eq!(e.kind(), ErrorKind::BadName);
            assert!(e.to_string().contains(why), "{e}");
        }
    }
}
