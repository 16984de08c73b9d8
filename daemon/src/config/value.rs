//! Checks of single values, and paths relative to the rig file.

use super::MAX_RATE_HZ;
use core::fmt::{Display, LowerExp};
use core::ops::RangeInclusive;
use std::path::{Path, PathBuf};

/// The highest rate of refined depth that can be asked for, Hz; 0 asks for all that the camera gives.
pub(crate) const MAX_REFINE_HZ: f64 = MAX_RATE_HZ;

/// A rate that a camera or the sets may have.
pub(crate) fn rate(hz: f64) -> Result<(), String> {
    above_zero(MAX_RATE_HZ)(&hz)
}

/// Accepts numbers above 0 and up to `most`.
pub(crate) fn above_zero(most: f64) -> impl Fn(&f64) -> Result<(), String> {
    move |v| {
        if *v > 0.0 && *v <= most {
            Ok(())
        } else {
            Err(format!("is {}; it must be above 0 and at most {most}", shown(v)))
        }
    }
}

/// A number as a message shows it: with an exponent where it would have hundreds of digits.
pub(crate) fn shown<T: Display + LowerExp>(number: &T) -> String {
    let plain = number.to_string();
    if plain.len() <= 24 { plain } else { format!("{number:e}") }
}

/// Accepts numbers in `range`.
pub(crate) fn within<T: PartialOrd + Display + LowerExp>(
    range: RangeInclusive<T>,
) -> impl FnOnce(&T) -> Result<(), String> {
    move |v| {
        let least = range.start();
        let most = range.end();
        if range.contains(v) {
            Ok(())
        } else {
            Err(format!("is {}; it must be within {least} and {most}", shown(v)))
        }
    }
}

/// Accepts a path that is not empty.
pub(crate) fn not_empty(path: &Path) -> Result<(), String> {
    if path.as_os_str().is_empty() { Err("is empty".to_owned()) } else { Ok(()) }
}

/// `path` as the file means it: `~/` is the home folder, anything relative starts at `base`.
pub(crate) fn resolve(base: &Path, path: &Path) -> PathBuf {
    let home = path
        .strip_prefix("~")
        .ok()
        .and_then(|rest| Some(PathBuf::from(std::env::var_os("HOME")?).join(rest)));
    let path = home.unwrap_or_else(|| base.join(path));
    // Without the `.` and double slashes that joining leaves behind.
    path.components().collect()
}
