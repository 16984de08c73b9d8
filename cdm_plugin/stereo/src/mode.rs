//! The modes that depth is computed in: presets of the repository's own matching, and a network that the user has.

use core::fmt;
use core::str::FromStr;
use depthrig_calib::stereo::Preset;
use depthrig_driver::{Error, ErrorKind, Result};

/// A way to make depth, named after the vendor's mode that it stands in for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Mode {
    /// A preset of the stereo engine: `performance`, `quality` or `ultra`.
    Preset(Preset),
    /// A stereo network that the user has.
    Neural,
}

impl Mode {
    /// All of them.
    pub const ALL: [Self; 4] = [
        Self::Preset(Preset::Performance),
        Self::Preset(Preset::Ultra),
        Self::Preset(Preset::Quality),
        Self::Neural,
    ];

    /// Its name, which ends the names of its streams.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Preset(preset) => preset.name(),
            Self::Neural => "neural",
        }
    }

    /// Its name in recordings: it is nobody's closed algorithm.
    pub fn recorded_name(self) -> String {
        format!("mimic_{}", self.name())
    }
}

impl fmt::Display for Mode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

impl FromStr for Mode {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        Self::ALL.into_iter().find(|m| m.name() == text).ok_or_else(|| {
            let known: Vec<_> = Self::ALL.iter().map(|m| m.name()).collect();
            let what = format!("there is no mode {text:?}; it is one of: {}", known.join(", "));
            Error::new(ErrorKind::BadInput, what)
        })
    }
}
