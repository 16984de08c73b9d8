//! The settings of one camera behind an interface that every family has: the daemon opens, plans and watches a camera
//! through it and knows no family.

use super::source::Source;
use crate::doctor::Finding;
use core::any::Any;
use core::fmt::Debug;
use core::ops::{Deref, DerefMut};
use core::time::Duration;
use depthrig_bus::{CameraName, HostTime, Pose, RigName, RuntimeDir};
use depthrig_driver::{Backend, Result, StreamProfile, StreamRequest};
use depthrig_sim::synthetic::Drawing;
use std::path::Path;
use std::sync::Arc;

/// The settings of one camera of a family.
pub trait CameraSettings: AnySettings {
    /// The family's name in a rig file and in `status`.
    fn name(&self) -> &'static str;

    /// Creates the driver; the device is opened by the driver, not here.
    ///
    /// # Errors
    /// Those of settings that the driver refuses.
    fn driver(&self, context: &OpenContext<'_>) -> Result<Box<dyn Backend>>;

    /// Returns where the frames come from. Opens files, but no device.
    fn source(&self) -> Source<'_>;

    /// The streams to start when the rig file names none; empty: every stream in its default mode.
    fn default_streams(&self) -> Vec<StreamRequest> {
        Vec::new()
    }

    /// The highest rate among the camera's image streams, Hz, as far as the settings and the requested `streams` say.
    fn fastest_rate_hz(&self, streams: &[StreamRequest]) -> Option<f64> {
        let rates = streams.iter().map(|s| s.rate_hz).collect::<Option<Vec<_>>>()?;
        rates.into_iter().reduce(f64::max)
    }

    /// Whether the frames come from files: a missing one is a mistake and not an unplugged camera.
    fn reads_files(&self) -> bool {
        false
    }

    /// How much longer than a device an opening may take.
    fn extra_open_time(&self) -> Duration {
        Duration::ZERO
    }

    /// Checks the input files, as `depthrig config check` does.
    ///
    /// # Errors
    /// Those of files that are missing or damaged.
    fn check_input(&self) -> Result<()> {
        Ok(())
    }

    /// Prepares the camera for a session, before any is opened.
    ///
    /// # Errors
    /// Those of settings that the driver refuses, and of a folder that it cannot write.
    fn prepare(&mut self, _: &Preparation<'_>) -> Result<()> {
        Ok(())
    }

    /// Adds the camera's scenes to the shared drawing of simulated cameras.
    ///
    /// # Errors
    /// Those of settings that the driver refuses.
    fn add_to_drawing(&self, _: &Drawing) -> Result<()> {
        Ok(())
    }

    /// Load of a stream on the USB, bit/s, if it is not that of its images as they are published.
    fn wire_bits_per_s(&self, _: &StreamProfile, _with_depth: bool) -> Option<f64> {
        None
    }

    /// Returns the requirements of a session with the requested `streams` that this computer does not meet, apart from
    /// the device.
    fn unmet(&self, _streams: &[StreamRequest]) -> Vec<Unmet> {
        Vec::new()
    }
}

/// The surroundings of a camera's driver.
#[derive(Debug, Clone, Copy)]
pub struct OpenContext<'c> {
    /// Where the files of this user's rigs are.
    pub runtime: &'c RuntimeDir,
    /// The rig.
    pub rig: &'c RigName,
    /// The camera's name in it.
    pub camera: &'c CameraName,
    /// When the rig began: the beginning of time for all simulated cameras, or each would see the world at another moment.
    pub began: HostTime,
    /// Renders scenes while cameras stream, if they are to stream at once.
    pub drawing: Option<&'c Arc<Drawing>>,
}

/// The preparation of a camera for a session.
pub struct Preparation<'c> {
    /// Pose of the camera on the mount.
    pub pose: Pose,
    /// Folder for rendered images, if not that of the settings.
    pub cache_dir: Option<&'c Path>,
    /// Called with images done and images in all while they are rendered; `None`: they are rendered later.
    pub render: Option<&'c (dyn Fn(usize, usize) + Sync)>,
}

/// A requirement of a camera that this computer does not meet.
#[derive(Debug, Clone)]
pub struct Unmet {
    /// The missing thing, why it matters and how to get it.
    pub finding: Finding,
    /// Whether it also explains a failure to ask the device, which then needs no finding of its own.
    pub explains_failure: bool,
}

/// Copies and compares settings of a type that the caller does not know; every `Clone + PartialEq` type has it.
pub trait AnySettings: Any + Debug + Send + Sync {
    /// A copy.
    fn boxed(&self) -> Box<dyn CameraSettings>;

    /// Whether `other` is of the same type and equal.
    fn equals(&self, other: &dyn CameraSettings) -> bool;
}

impl<T: CameraSettings + Clone + PartialEq> AnySettings for T {
    fn boxed(&self) -> Box<dyn CameraSettings> {
        Box::new(self.clone())
    }

    fn equals(&self, other: &dyn CameraSettings) -> bool {
        let other: &dyn Any = other;
        other.downcast_ref() == Some(self)
    }
}

/// A camera's family with its settings.
#[derive(Debug)]
pub struct BackendConfig(Box<dyn CameraSettings>);

impl BackendConfig {
    /// Takes the settings of any family.
    pub fn new(settings: impl CameraSettings) -> Self {
        Self(Box::new(settings))
    }

    /// The settings if they are a `T`.
    pub fn settings<T: CameraSettings>(&self) -> Option<&T> {
        let any: &dyn Any = &*self.0;
        any.downcast_ref()
    }

    /// The settings, to change, if they are a `T`.
    pub fn settings_mut<T: CameraSettings>(&mut self) -> Option<&mut T> {
        let any: &mut dyn Any = &mut *self.0;
        any.downcast_mut()
    }
}

impl Deref for BackendConfig {
    type Target = dyn CameraSettings;

    fn deref(&self) -> &Self::Target {
        &*self.0
    }
}

impl DerefMut for BackendConfig {
    fn deref_mut(&mut self) -> &mut Self::Target {
        &mut *self.0
    }
}

impl Clone for BackendConfig {
    fn clone(&self) -> Self {
        Self(self.0.boxed())
    }
}

impl PartialEq for BackendConfig {
    fn eq(&self, other: &Self) -> bool {
        self.0.equals(&**other)
    }
}
