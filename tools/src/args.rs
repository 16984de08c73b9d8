//! Global options, and parsers for option values that several commands share.

use clap::{ArgAction, ValueEnum};
use depthrig_bus::{Name, RigName};
use std::ops::RangeInclusive;
use std::path::PathBuf;

/// Options of every command.
#[derive(Debug, Clone, clap::Args)]
pub struct Global {
    /// Rig to use [default: the only one running]
    #[arg(long, global = true, value_name = "NAME", help_heading = "Global options")]
    pub rig: Option<RigName>,
    /// Computer whose daemon to use, in a rig of several [default: this one]
    #[arg(long, global = true, value_name = "NAME", help_heading = "Global options")]
    pub host: Option<Name>,
    /// Folder with the locks and sockets of your rigs [env: DEPTHRIG_RUNTIME_DIR]
    #[arg(long, global = true, value_name = "DIR", help_heading = "Global options")]
    pub runtime_dir: Option<PathBuf>,
    /// Log more (-vv: everything)
    #[arg(short, long, global = true, action = ArgAction::Count, help_heading = "Global options")]
    pub verbose: u8,
    /// Log less, without progress bars
    #[arg(short, long, global = true, action = ArgAction::Count, help_heading = "Global options")]
    pub quiet: u8,
    /// Format of the log lines on stderr
    #[arg(long, global = true, value_enum, default_value = "text", help_heading = "Global options")]
    pub log_format: LogFormat,
    /// When to use colour; NO_COLOR is respected
    #[arg(
        long,
        global = true,
        value_enum,
        default_value = "auto",
        value_name = "WHEN",
        help_heading = "Global options"
    )]
    pub color: ColorChoice,
}

/// Format of the log lines.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum LogFormat {
    /// Text for people
    Text,
    /// One JSON object per line
    Json,
}

/// When to use colour.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum ColorChoice {
    /// On a terminal
    Auto,
    /// Always
    Always,
    /// Never
    Never,
}

/// Parses a number within `range`, in `unit`; infinity and NaN are out of every range.
///
/// # Errors
/// When `text` is not a number, or out of `range`.
fn number_within(text: &str, unit: &str, range: RangeInclusive<f64>) -> Result<f64, String> {
    let number: f64 = text.trim().parse().map_err(|_| format!("write a number of {unit}"))?;
    if range.contains(&number) {
        return Ok(number);
    }
    Err(format!("{text} {unit} is out of range {}..={}", range.start(), range.end()))
}

/// Parses the largest allowed spread of the capture times in a set, milliseconds.
///
/// # Errors
/// When `text` is out of range 0..=3600000.
pub fn spread_ms(text: &str) -> Result<f64, String> {
    number_within(text, "ms", 0.0..=3.6e6)
}

/// Parses a distance, metres.
///
/// # Errors
/// When `text` is out of range 0..=1000000.
pub fn distance_m(text: &str) -> Result<f64, String> {
    number_within(text, "m", 0.0..=1e6)
}

/// Parses a non-zero distance, metres.
///
/// # Errors
/// When `text` is out of range 0.001..=1000000.
pub fn range_limit_m(text: &str) -> Result<f64, String> {
    number_within(text, "m", 1e-3..=1e6)
}

/// Parses a length on paper or an uncertainty, millimetres.
///
/// # Errors
/// When `text` is out of range 0.001..=10000.
pub fn length_mm(text: &str) -> Result<f64, String> {
    number_within(text, "mm", 1e-3..=1e4)
}

/// Parses an uncertainty of an angle, degrees.
///
/// # Errors
/// When `text` is out of range 0.0001..=45.
pub fn angle_deg(text: &str) -> Result<f64, String> {
    number_within(text, "degrees", 1e-4..=45.0)
}

/// Parses an uncertainty of a place in an image, pixels.
///
/// # Errors
/// When `text` is out of range 0.001..=100.
pub fn pixels(text: &str) -> Result<f64, String> {
    number_within(text, "px", 1e-3..=100.0)
}

/// Parses a rate of frames, sets or pairs, Hz.
///
/// # Errors
/// When `text` is out of range 0.001..=10000.
pub fn rate_hz(text: &str) -> Result<f64, String> {
    number_within(text, "Hz", 1e-3..=1e4)
}

/// Parses an amount of memory, GB.
///
/// # Errors
/// When `text` is out of range 0..=1000000.
pub fn memory_gb(text: &str) -> Result<f64, String> {
    number_within(text, "GB", 0.0..=1e6)
}

/// Parses the speed of a replay relative to the original.
///
/// # Errors
/// When `text` is out of range 0.1..=10.
pub fn replay_rate(text: &str) -> Result<f64, String> {
    number_within(text, "times", depthrig_daemon::replay::RATES)
}

/// Parses a number of seconds, such as the time after the first set.
///
/// # Errors
/// When `text` is out of range 0..=9000000.
pub fn seconds(text: &str) -> Result<f64, String> {
    number_within(text, "s", 0.0..=9e6)
}

/// Parses the distance over which the engine `fill` fills holes, as a fraction of the image width.
///
/// # Errors
/// When `text` is out of range 0..=1.
pub fn fill_reach(text: &str) -> Result<f64, String> {
    number_within(text, "image widths", 0.0..=1.0)
}

/// Parses the metres per depth unit of a camera or file.
///
/// # Errors
/// When `text` is not a number or out of range 0.000001..=1.
pub fn depth_unit_m(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(unit) if (1e-6..=1.0).contains(&unit) => Ok(unit),
        Ok(_) => Err(format!("{text} m is out of range 0.000001..=1; write metres, such as 0.001")),
        Err(_) => Err("write metres, such as 0.001".to_owned()),
    }
}

/// Parses a number of seconds above 0 and below ten years.
///
/// # Errors
/// When `text` is not a number or out of that range.
pub fn positive_seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(s) if s > 0.0 && s < 3.2e8 => Ok(s),
        _ => Err("write a number of seconds above 0, such as 10 or 0.5".to_owned()),
    }
}

/// Parses a duration into seconds: hours, minutes and seconds, each at most once and in this order, such as
/// `90s`, `10m`, `1h30m` or `1.5h`.
///
/// # Errors
/// When `text` has another form, is 0, or is ten years or more.
pub fn duration_s(text: &str) -> Result<f64, String> {
    let wrong = || format!("write a time such as 90s, 10m or 1h30m, not \"{text}\"");
    let mut rest = text;
    let mut total_s = 0.0;
    for (unit, seconds) in [('h', 3600.0), ('m', 60.0), ('s', 1.0)] {
        let Some((number, after)) = rest.split_once(unit) else { continue };
        // `f64::from_str` would also take signs, exponents and "inf".
        if !number.bytes().all(|b| b.is_ascii_digit() || b == b'.') {
            return Err(wrong());
        }
        total_s += number.parse::<f64>().map_err(|_| wrong())? * seconds;
        rest = after;
    }
    if rest.is_empty() && total_s > 0.0 && total_s < 3.2e8 { Ok(total_s) } else { Err(wrong()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_time_has_units_in_their_order() {
        for (text, s) in [
            ("90s", 90.0),
            ("10m", 600.0),
            ("1h30m", 5400.0),
            ("1h0m5s", 3605.0),
            ("1.5h", 5400.0),
            ("0.5s", 0.5),
        ] {
            assert_eq!(duration_s(text), Ok(s), "{text}");
        }
        for bad in [
            "", "10", "m", "0s", "-5m", "1e3s", "infs", "nans", "30m1h", "1m1m", "5 m", "10m5", "9999999h",
            "1ms",
        ] {
            assert!(duration_s(bad).unwrap_err().contains("1h30m"), "{bad}");
        }
    }

    #[test]
    fn seconds_are_positive() {
        assert_eq!(positive_seconds("0.5"), Ok(0.5));
        for bad in ["0", "-1", "nan", "inf", "1e300", "ten"] {
            assert!(positive_seconds(bad).is_err(), "{bad}");
        }
    }
}
