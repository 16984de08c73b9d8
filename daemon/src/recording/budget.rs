//! Whether a recording will fit on its disk: asked before it begins, so that it need not end in the middle.

use crate::config::{ColorCodec, DepthCodec, RecordingConfig};
use crate::control::RecordRequest;
use crate::{Error, ErrorKind, Result};
use depthrig_bus::PixelFormat;
use depthrig_recorder::fs::Fs;
use std::io;
use std::path::Path;

/// The longest time that can be asked for, seconds: ten years.
const MAX_DURATION_S: f64 = 3.2e8;

/// Bytes of an IMU sample on the disk: its 64 exact ones, and the message for other readers (about 330 bytes, most
/// of them zero).
const SAMPLE_BYTES: f64 = 160.0;

/// By how much a codec is taken to shrink an image. Each is about two thirds of the ratio measured on recordings of
/// real cameras (depth: zstd 3.5, rank 7.0; colour: JPEG of quality 95 with 4:4:4 11, PNG 2.4, zstd 2.0): a busier
/// scene packs worse, and an estimate that is too low costs a recording. Above quality 95 JPEG grows fast.
fn ratio(format: PixelFormat, config: &RecordingConfig) -> f64 {
    match (format, config.color, config.depth) {
        (PixelFormat::Z16, _, DepthCodec::Zstd) => 2.5,
        (PixelFormat::Z16, _, DepthCodec::Rank) => 4.5,
        (PixelFormat::Rgb8 | PixelFormat::Bgr8, ColorCodec::Jpeg, _) if config.jpeg_quality > 95 => 3.0,
        (PixelFormat::Rgb8 | PixelFormat::Bgr8, ColorCodec::Jpeg, _) => 7.0,
        (PixelFormat::Rgb8 | PixelFormat::Bgr8, ColorCodec::Png, _) => 1.6,
        // Cameras send a JPEG of 2 bits a pixel or so; this is the driver's bound on it.
        (PixelFormat::Mjpeg, ..) => 4.0,
        // Infrared, floats and packed colour were not measured; noise in the low bits packs badly.
        _ => 1.4,
    }
}

/// About how many bytes a second a recording of streams with these formats and raw frame sizes (bytes) writes, when
/// each is in every one of the `sets_hz` sets a second.
pub fn bytes_per_s(
    streams: impl Iterator<Item = (PixelFormat, usize)>,
    sets_hz: f64,
    config: &RecordingConfig,
) -> f64 {
    streams.map(|(format, bytes)| bytes as f64 / ratio(format, config)).sum::<f64>() * sets_hz
}

/// About how many bytes a second the IMUs write that measure `samples_hz` times a second together.
pub fn motion_bytes_per_s(samples_hz: f64) -> f64 {
    samples_hz * SAMPLE_BYTES
}

/// Refuses a time that no recording can have.
///
/// # Errors
/// `BadInput` for a time that is not above 0 and below ten years.
pub fn check_duration(request: &RecordRequest) -> Result<()> {
    match request.max_duration_s {
        Some(s) if !(s > 0.0 && s < MAX_DURATION_S) => Err(Error::new(
            ErrorKind::BadInput,
            format!("a recording cannot last {s} s; max_duration_s must be above 0 and below ten years"),
        )),
        _ => Ok(()),
    }
}

/// Refuses a recording into the folder `dir`, which need not exist, that will not fit above `reserve` bytes: all of
/// the time it asks for, or `recording.min_minutes` when it asks for none.
///
/// # Errors
/// `NoSpace`, with the numbers.
pub fn check(
    fs: &dyn Fs,
    dir: &Path,
    request: &RecordRequest,
    bytes_per_s: f64,
    reserve: u64,
    config: &RecordingConfig,
) -> Result<()> {
    let wanted_s = request.max_duration_s.unwrap_or(config.min_minutes as f64 * 60.0);
    if request.force || wanted_s <= 0.0 || bytes_per_s <= 0.0 {
        return Ok(());
    }
    // Free space that the disk does not report cannot be compared; the recorder reports problems of the folder.
    let Some(free) = free_above(fs, dir) else { return Ok(()) };
    let room = free.saturating_sub(reserve) as f64;
    let needed = wanted_s * bytes_per_s;
    if needed <= room {
        return Ok(());
    }
    let what = match request.max_duration_s {
        Some(_) => format!("recording for {}", minutes(wanted_s)),
        None => format!("a recording of {} (min_minutes in [recording])", minutes(wanted_s)),
    };
    Err(Error::new(
        ErrorKind::NoSpace,
        format!(
            "{what} needs about {:.1} GB, {:.1} GB are free above the reserve of {:.1} GB for {}, so about {} fit: free \
             some space, record to another disk, or begin all the same with --force",
            needed / 1e9,
            room / 1e9,
            reserve as f64 / 1e9,
            dir.display(),
            minutes(room / bytes_per_s),
        ),
    ))
}

/// Bytes free where `dir` is or will be.
pub fn free_above(fs: &dyn Fs, dir: &Path) -> Option<u64> {
    for dir in dir.ancestors() {
        let dir = if dir.as_os_str().is_empty() { Path::new(".") } else { dir };
        match fs.available_space(dir) {
            Ok(free) => return Some(free),
            Err(e) if e.kind() == io::ErrorKind::NotFound => {}
            Err(_) => return None,
        }
    }
    None
}

fn minutes(s: f64) -> String {
    let minutes = s / 60.0;
    if minutes < 10.0 { format!("{minutes:.1} minutes") } else { format!("{minutes:.0} minutes") }
}

#[cfg(test)]
mod tests {
    use super::*;
    use depthrig_recorder::fs::{MemFs, RealFs};

    fn config() -> RecordingConfig {
        RecordingConfig::default()
    }

    fn asks(max_duration_s: Option<f64>, force: bool) -> RecordRequest {
        RecordRequest { max_duration_s, force, ..RecordRequest::default() }
    }

    #[test]
    fn the_estimate_is_raw_bytes_by_set_rate_by_codec() {
        let streams = [(PixelFormat::Z16, 2_500_000), (PixelFormat::Rgb8, 7_000_000)];
        let of = |config: &RecordingConfig| bytes_per_s(streams.into_iter(), 5.0, config).round();
        assert_eq!(of(&config()), 10e6);
        let rank = RecordingConfig { depth: DepthCodec::Rank, color: ColorCodec::Raw, ..config() };
        assert_eq!(of(&rank), (5.0 * (2.5e6 / 4.5 + 7e6 / 1.4_f64)).round());
        let png = RecordingConfig { color: ColorCodec::Png, ..config() };
        let best = RecordingConfig { jpeg_quality: 100, ..config() };
        assert!(of(&png) > of(&best) && of(&best) > of(&config()));
    }

    #[test]
    fn what_does_not_fit_is_refused_with_the_numbers() {
        let free = 8_000_000_000;
        let fs = MemFs::new().with_capacity(free);
        // Room for two minutes at this rate.
        let reserve = free / 4;
        let rate = (free - reserve) as f64 / 120.0;
        let dir = Path::new("/data/new/deeper");
        let ask = |request: &RecordRequest, config: &RecordingConfig| {
            check(&fs, dir, request, rate, reserve, config).map_err(|e| (e.kind(), e.to_string()))
        };
        let least = |min_minutes| RecordingConfig { min_minutes, ..config() };
        assert_eq!(ask(&asks(Some(119.0), false), &least(1)), Ok(()));
        assert_eq!(
            ask(&asks(Some(119.0), false), &least(9)),
            Ok(()),
            "who says how long is taken at the word"
        );
        let (kind, said) = ask(&asks(Some(600.0), false), &least(1)).unwrap_err();
        assert_eq!(kind, ErrorKind::NoSpace);
        let gb = |bytes: u64| format!("{:.1} GB", bytes as f64 / 1e9);
        for part in [&gb((free - reserve) * 5), &gb(free - reserve), &gb(reserve), "about 2.0 minutes fit"] {
            assert!(said.contains(part), "{part} in {said}");
        }
        assert_eq!(ask(&asks(Some(600.0), true), &least(1)), Ok(()));
        assert_eq!(ask(&asks(None, false), &least(1)), Ok(()));
        let (kind, said) = ask(&asks(None, false), &least(3)).unwrap_err();
        assert!(kind == ErrorKind::NoSpace && said.contains("min_minutes"), "{said}");
        assert_eq!(ask(&asks(None, true), &least(3)), Ok(()));
        assert_eq!(ask(&asks(None, false), &least(0)), Ok(()), "0 is off");
    }

    #[test]
    fn a_folder_that_is_not_there_yet_is_on_the_disk_of_the_one_above() {
        let home = tempfile::tempdir().unwrap();
        assert!(free_above(&RealFs, &home.path().join("a/b/c")).is_some_and(|free| free > 0));
        assert!(free_above(&RealFs, Path::new("none-such/b")).is_some(), "relative to here");
    }

    #[test]
    fn a_time_that_is_none_is_refused() {
        for bad in [0.0, -1.0, f64::NAN, f64::INFINITY, 1e9] {
            assert_eq!(
                check_duration(&asks(Some(bad), true)).unwrap_err().kind(),
                ErrorKind::BadInput,
                "{bad}"
            );
        }
        assert!(
            check_duration(&asks(Some(0.5), false)).is_ok() && check_duration(&asks(None, false)).is_ok()
        );
    }
}
