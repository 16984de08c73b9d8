//! Parses the command line.

use crate::Error;

/// How to call the program.
const USAGE: &str = "usage: depthrig-oak [--serial SERIAL] [--size 1280x720] [--fps 30] [--dots 0..1] [--no-depth]; which \
                     camera of which rig it is, the daemon says (DEPTHRIG_RIG, DEPTHRIG_CAMERA)";

/// The requested camera settings.
#[derive(Debug, Clone, PartialEq)]
pub struct Wishes {
    /// Serial number; `None` selects the only camera.
    pub serial: Option<String>,
    /// Width and height of colour, and so of depth, which is aligned to it.
    pub size: (u32, u32),
    /// Frames per second.
    pub rate_hz: f32,
    /// Intensity of the infrared dot projector, 0 to 1; `None` leaves it as it is.
    pub dots: Option<f32>,
    /// Depth as well.
    pub depth: bool,
}

impl Default for Wishes {
    fn default() -> Self {
        Self { serial: None, size: (1280, 720), rate_hz: 30.0, dots: None, depth: true }
    }
}

/// Reads the arguments behind the program's name.
///
/// # Errors
/// For an argument that is unknown, lacks its value, or has an invalid one.
pub fn read(mut arguments: impl Iterator<Item = String>) -> Result<Wishes, Error> {
    let mut wishes = Wishes::default();
    while let Some(name) = arguments.next() {
        let mut value = || arguments.next().ok_or_else(|| format!("{name} needs a value; {USAGE}"));
        match name.as_str() {
            "--serial" => wishes.serial = Some(value()?),
            "--size" => wishes.size = size(&value()?)?,
            "--fps" => wishes.rate_hz = number(&value()?, 0.1..=240.0)?,
            "--dots" => wishes.dots = Some(number(&value()?, 0.0..=1.0)?),
            "--no-depth" => wishes.depth = false,
            _ => return Err(format!("{name} is unknown; {USAGE}").into()),
        }
    }
    Ok(wishes)
}

fn size(text: &str) -> Result<(u32, u32), Error> {
    let parts = text.split_once('x').and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
    let possible = |(w, h): &(u32, u32)| (1..=16_384).contains(w) && (1..=16_384).contains(h);
    parts.filter(possible).ok_or_else(|| format!("invalid size {text}; write 1280x720").into())
}

fn number(text: &str, range: std::ops::RangeInclusive<f32>) -> Result<f32, Error> {
    let value = text.parse().ok().filter(|v| range.contains(v));
    value.ok_or_else(|| format!("{text} is not a number from {} to {}", range.start(), range.end()).into())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(text: &str) -> Result<Wishes, String> {
        read(text.split_whitespace().map(str::to_owned)).map_err(|e| e.to_string())
    }

    #[test]
    fn every_argument_is_read() {
        assert_eq!(of(""), Ok(Wishes::default()));
        let all = of("--serial 1844 --size 640x400 --fps 15 --dots 0.5 --no-depth");
        let expected = Wishes {
            serial: Some("1844".into()),
            size: (640, 400),
            rate_hz: 15.0,
            dots: Some(0.5),
            depth: false,
        };
        assert_eq!(all, Ok(expected));
    }

    #[test]
    fn what_cannot_be_is_refused() {
        for (text, why) in [
            ("--size 640", "invalid size 640"),
            ("--size 0x400", "invalid size 0x400"),
            ("--size 640x20000", "invalid size 640x20000"),
            ("--fps 0", "is not a number from 0.1 to 240"),
            ("--fps NaN", "is not a number"),
            ("--dots 2", "from 0 to 1"),
            ("--serial", "--serial needs a value"),
            ("--speed 3", "--speed is unknown"),
        ] {
            assert!(of(text).is_err_and(|e| e.contains(why)), "{text}");
        }
    }
}
