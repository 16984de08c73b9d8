//! A part of a run that many processes share, as `--shard K/N` names it.

use core::fmt;
use core::str::FromStr;
use serde::{Deserialize, Serialize};

/// More parts than a run has shards or segments are a slip of the pen.
const PARTS_MAX: u64 = 1_000_000;

/// Part `K/N` of a run: every Nth unit of work from the Kth on, counted from 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(try_from = "[u64; 2]", into = "[u64; 2]")]
pub struct RunPart {
    number: u64,
    parts: u64,
}

impl RunPart {
    /// All of a run: `0/1`.
    pub const ALL: Self = Self { number: 0, parts: 1 };

    /// Its number, from 0.
    pub const fn number(self) -> u64 {
        self.number
    }

    /// The number of parts that the run has; not 0.
    pub const fn parts(self) -> u64 {
        self.parts
    }

    /// Whether a unit of work, by its number in the run, belongs to it.
    pub const fn has(self, unit: u64) -> bool {
        unit % self.parts == self.number
    }
}

impl TryFrom<[u64; 2]> for RunPart {
    type Error = String;

    fn try_from([number, parts]: [u64; 2]) -> Result<Self, String> {
        if number < parts && parts <= PARTS_MAX {
            Ok(Self { number, parts })
        } else {
            Err(format!("invalid part {number}/{parts}; parts are 0/N to N-1/N, N at most {PARTS_MAX}"))
        }
    }
}

impl From<RunPart> for [u64; 2] {
    fn from(part: RunPart) -> Self {
        [part.number, part.parts]
    }
}

impl FromStr for RunPart {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = || format!("write a part such as 2/8 (0/8 to 7/8), not \"{text}\"");
        let (number, parts) = text.split_once('/').ok_or_else(wrong)?;
        let numbers = [number.parse().map_err(|_| wrong())?, parts.parse().map_err(|_| wrong())?];
        Self::try_from(numbers).map_err(|_| wrong())
    }
}

impl fmt::Display for RunPart {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.number, self.parts)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_are_checked_wherever_they_come_from() {
        let part: RunPart = "2/8".parse().unwrap();
        assert_eq!((part.number(), part.parts(), part.to_string().as_str()), (2, 8, "2/8"));
        for bad in ["8/8", "1", "-1/2", "a/b", "0/0", "1/2/3", "1/1000001"] {
            let why = bad.parse::<RunPart>().unwrap_err();
            assert!(why.contains("2/8") && why.contains(bad), "{why}");
        }
        assert_eq!(serde_json::to_string(&part).unwrap(), "[2,8]");
        assert_eq!(serde_json::from_str::<RunPart>("[2,8]").unwrap(), part);
        for bad in ["[8,8]", "[0,0]", "[1]"] {
            assert!(serde_json::from_str::<RunPart>(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn every_unit_belongs_to_one_part() {
        let parts: Vec<RunPart> = (0..3).map(|k| RunPart::try_from([k, 3]).unwrap()).collect();
        for unit in 0..10 {
            assert_eq!(parts.iter().filter(|p| p.has(unit)).count(), 1, "{unit}");
        }
        assert!(parts[1].has(4) && RunPart::ALL.has(7));
    }
}
