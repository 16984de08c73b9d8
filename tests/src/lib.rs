//! Helpers for the tests that cross crates: rigs of cheap synthetic cameras in a private runtime folder.
#![allow(clippy::unwrap_used, clippy::expect_used)] // test support: a failure here is a failed test

pub mod disk;
pub mod expected;
pub mod fixture;
pub mod pairs;
pub mod scene;
pub mod synthetic_stereo;

pub use depthrig_kinect_fixture as kinect;

use depthrig_bus::{HostTime, RuntimeDir};
use depthrig_daemon::config::RigConfig;
use depthrig_daemon::rig::{Rig, RigOptions};
use depthrig_daemon::status::{CameraState, CameraStatus, RigStatus};
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// A temporary folder for a test's rigs; removed at the end.
pub struct Home {
    dir: tempfile::TempDir,
}

impl Default for Home {
    fn default() -> Self {
        // Short, because Unix sockets live below it.
        Self { dir: tempfile::Builder::new().prefix("dr").tempdir_in("/tmp").unwrap() }
    }
}

impl Home {
    /// The runtime folder.
    pub fn runtime(&self) -> RuntimeDir {
        RuntimeDir::at(&self.dir.path().join("r")).unwrap()
    }

    /// A folder for datasets and the like.
    pub fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    /// Starts the rig of `text`.
    ///
    /// # Errors
    /// Those of [`Rig::start`].
    pub fn start(&self, text: &str) -> depthrig_daemon::Result<Rig> {
        self.start_with(text, |_| {})
    }

    /// Starts the rig of `text` with options that `change` has changed.
    ///
    /// # Errors
    /// Those of [`Rig::start`].
    pub fn start_with(
        &self,
        text: &str,
        change: impl FnOnce(&mut RigOptions),
    ) -> depthrig_daemon::Result<Rig> {
        let config = RigConfig::parse(text, None).unwrap();
        let mut options = RigOptions {
            serve_api: false,
            cache_dir: Some(self.path("cache")),
            ..RigOptions::new(self.runtime())
        };
        change(&mut options);
        Rig::start(config, &options)
    }
}

/// A rig configuration of cheap synthetic cameras.
pub struct RigText(String);

impl Default for RigText {
    fn default() -> Self {
        Self("rig = \"test\"\n[supervisor]\nstall_s = 0.4\nbackoff_max_s = 0.5\n".into())
    }
}

impl RigText {
    /// Adds a cheap camera of 160x120 pixels at 30 Hz, with `extra` lines of TOML in its table.
    pub fn camera(mut self, name: &str, extra: &str) -> Self {
        write!(
            self.0,
            "[[camera]]\nname = \"{name}\"\nbackend = \"synthetic\"\nmodel = \"generic\"\ncheap = true\n{extra}\n\
             [[camera.stream]]\nname = \"color\"\nwidth = 160\nheight = 120\n\
             [[camera.stream]]\nname = \"depth\"\nwidth = 160\nheight = 120\n"
        )
        .unwrap();
        self
    }

    /// Adds a camera of the images that `manifest` names, with `extra` lines of TOML in its table.
    pub fn files(mut self, name: &str, manifest: &Path, extra: &str) -> Self {
        let manifest = manifest.display();
        write!(
            self.0,
            "[[camera]]\nname = \"{name}\"\nbackend = \"files\"\nmanifest = \"{manifest}\"\nloop = true\n{extra}\n"
        )
        .unwrap();
        self
    }

    /// Adds lines to the end of the text.
    pub fn and(mut self, more: &str) -> Self {
        self.0.push_str(more);
        self
    }

    /// Adds a fault to the camera added last.
    pub fn fault(mut self, kind: &str, at_s: f64, more: &str) -> Self {
        write!(self.0, "[[camera.fault]]\nkind = \"{kind}\"\nat_s = {at_s:?}\n{more}\n").unwrap();
        self
    }

    /// The TOML text.
    pub fn text(&self) -> &str {
        &self.0
    }
}

/// Width and height of an image, in pixels.
#[derive(Debug, Clone, Copy)]
pub struct ImageSize {
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

/// Writes the images of a camera without calibration into `dir` and returns its manifest. The first row of depth has no
/// depth, the second is saturated.
pub fn uncalibrated_camera(dir: &Path, color: ImageSize, depth: ImageSize) -> PathBuf {
    for i in 0..4u8 {
        let image =
            image::RgbImage::from_fn(color.width, color.height, |x, y| image::Rgb([x as u8, y as u8, i]));
        image.save(dir.join(format!("color_{i}.png"))).unwrap();
        let image = image::ImageBuffer::<image::Luma<u16>, _>::from_fn(depth.width, depth.height, |x, y| {
            image::Luma([match y {
                0 => 0,
                1 => u16::MAX,
                _ => 500 + x as u16,
            }])
        });
        image.save(dir.join(format!("depth_{i}.png"))).unwrap();
    }
    let manifest = dir.join("camera.toml");
    let text = "model = \"test\"\nrate_hz = 30.0\n[[stream]]\nname = \"color\"\nfiles = \"color_*.png\"\n\
         [[stream]]\nname = \"depth\"\nfiles = \"depth_*.png\"\ndepth_unit_m = 0.001\n";
    std::fs::write(&manifest, text).unwrap();
    manifest
}

/// Waits until `done` holds; panics with the last status after a minute.
pub fn wait_until(rig: &Rig, what: &str, mut done: impl FnMut(&RigStatus) -> bool) -> RigStatus {
    let deadline = HostTime::now().plus(Duration::from_mins(1));
    loop {
        let status = rig.control().status();
        if done(&status) {
            return status;
        }
        assert!(!deadline.from_now().is_zero(), "never came to pass: {what}; last status {status:#?}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// The camera `name` of a status.
pub fn camera<'s>(status: &'s RigStatus, name: &str) -> &'s CameraStatus {
    status.cameras.iter().find(|c| c.name == name).expect("a camera of that name")
}

/// Whether every camera streams.
pub fn all_stream(status: &RigStatus) -> bool {
    status.cameras.iter().all(|c| c.state == CameraState::Streaming)
}

/// Panics unless a simulated camera beside others streamed to the end and lost nothing. It leaves out what a busy computer
/// made it too late for, which is a gap in its own count and no loss of the daemon's.
pub fn assert_undisturbed(camera: &CameraStatus) {
    assert_eq!((camera.state, camera.reconnects), (CameraState::Stopped, 0), "{}", camera.name);
    for s in &camera.streams {
        let lost = s.dropped.keys().any(|reason| reason != "device_gap");
        assert!(s.delivered > 0 && !lost, "{} lost frames: {:?}", s.id, s.dropped);
    }
}

/// Panics unless the books of every stream balance.
pub fn assert_balanced(status: &RigStatus) {
    for s in status.cameras.iter().flat_map(|c| &c.streams) {
        let dropped: u64 = s.dropped.values().sum();
        assert_eq!(s.captured, s.delivered + dropped, "{}: {s:?}", s.id);
        assert_eq!(s.delivered, s.in_sets.taken(), "{} in sets: {s:?}", s.id);
    }
}
