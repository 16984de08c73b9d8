//! The `files` backend: a folder of colour and depth images that plays as a camera.
//!
//! A small TOML file, the manifest, says what the images are. All of it:
//!
//! ```toml
#![doc = include_str!("files/example_camera.toml")]
//! ```
//!
//! **Checked on opening**, for every image: it exists, is PNG or JPEG to its last byte, has a size and depth
//! that a frame can have and its stream's other images have, and each stream has a partner for it. Damage
//! *inside* a PNG (its checksums) shows when the image is decoded, just before it is played; JPEG has no
//! checksums. Images are decoded once and kept while `cache_mb` lasts; from then on, playing costs one copy
//! into the sink's memory, and files that are kept may be deleted unnoticed.
//!
//! **Pixels** are those of the file: no scaling, no colour management, no rotation by EXIF. PNG is exact; JPEG is
//! decoded to the pixels that libjpeg-turbo gives, which are those of Pillow and OpenCV. Images with an alpha channel
//! or a palette are refused, because what is under transparent pixels is anybody's guess.
//!
//! **Time**: no device clock exists, and none is simulated. Image `k` is due at `start + k / rate_hz` on the
//! host's monotonic clock, and that moment is its capture time, the same for all its streams; hence
//! [`ClockDomain::Kernel`](depthrig_bus::ClockDomain::Kernel), whose counter is host time in nanoseconds, with
//! no uncertainty. When the host cannot keep the rate, the schedule moves and nothing is skipped: a stream's
//! frame `n` is always image `n mod count`.

use depthrig_driver::{
    Backend, Device, DeviceInfo, Error, ErrorKind, Result, Stream, StreamProfile, StreamRequest,
    choose_profiles,
};
use std::path::PathBuf;

mod manifest;
mod play;
mod source;

/// The commented manifest that the documentation of this module shows; a test keeps it valid.
pub const EXAMPLE_MANIFEST: &str = include_str!("files/example_camera.toml");

/// Which folder to play, and how.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct FilesConfig {
    /// The manifest, or the folder that holds it as `camera.toml`.
    pub manifest: PathBuf,
    /// Instead of the manifest's `rate_hz`.
    pub rate_hz: Option<f64>,
    /// Instead of the manifest's `loop`.
    pub looped: Option<bool>,
}

impl FilesConfig {
    /// Plays `manifest` as it says itself.
    pub fn new(manifest: impl Into<PathBuf>) -> Self {
        Self { manifest: manifest.into(), rate_hz: None, looped: None }
    }
}

/// The backend `files`: one manifest, one camera.
#[derive(Debug, Clone)]
pub struct FilesBackend {
    config: FilesConfig,
}

impl FilesBackend {
    /// A backend for the one camera of `config`. Nothing is read before it is opened.
    pub const fn new(config: FilesConfig) -> Self {
        Self { config }
    }

    fn load(&self) -> Result<FilesDevice> {
        let source = source::load(&self.config)?;
        let profiles = source.streams.iter().map(|s| s.profile.clone()).collect();
        Ok(FilesDevice { profiles, source })
    }
}

impl Backend for FilesBackend {
    fn name(&self) -> &'static str {
        "files"
    }

    /// The one camera, checked as if it were opened.
    ///
    /// # Errors
    /// Those of [`Self::open`]: a manifest that was named and cannot be played is worth saying.
    fn discover(&self) -> Result<Vec<DeviceInfo>> {
        Ok(vec![self.load()?.source.info])
    }

    fn open(&self, serial: Option<&str>) -> Result<Box<dyn Device>> {
        let device = self.load()?;
        match serial {
            Some(wanted) if wanted != device.source.info.serial => Err(Error::new(
                ErrorKind::NotFound,
                format!(
                    "{} plays the camera with serial number \"{}\", not \"{wanted}\"",
                    device.source.info.port, device.source.info.serial
                ),
            )),
            _ => Ok(Box::new(device)),
        }
    }
}

/// A folder that was checked and is ready to play.
struct FilesDevice {
    profiles: Vec<StreamProfile>,
    source: source::Source,
}

impl Device for FilesDevice {
    fn info(&self) -> &DeviceInfo {
        &self.source.info
    }

    fn profiles(&self) -> &[StreamProfile] {
        &self.profiles
    }

    fn start(self: Box<Self>, requests: &[StreamRequest]) -> Result<Box<dyn Stream>> {
        let Self { profiles, mut source } = *self;
        let name = format!("files camera {} ({})", source.info.serial, source.info.port);
        let chosen = choose_profiles(&name, &profiles, requests)?;
        let streams = chosen
            .iter()
            .filter_map(|p| {
                let i = source.streams.iter().position(|s| s.profile.stream == p.stream)?;
                Some(source.streams.swap_remove(i))
            })
            .collect();
        Ok(Box::new(play::Player::new(name, streams, source.playing)?))
    }
}
