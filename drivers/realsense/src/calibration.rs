//! The factory calibration of a camera, and what follows from it for a stream at its size.

use super::config::RealsenseConfig;
use super::models::Model;
use super::protocol::hwm::HardwareMonitor;
use super::protocol::intrinsics::{self, Basis};
use super::protocol::tables::{Coefficients, RectifiedItem, RgbTable};
use depthrig_bus::{Intrinsics, Pose};
use depthrig_driver::{Error, ErrorKind, Result};

/// [`depthrig_driver::DeviceInfo::calibration`] of a camera with its tables.
pub(super) const FACTORY: &str = "factory";
/// [`depthrig_driver::DeviceInfo::calibration`] of a camera without.
pub(super) const NONE: &str = "none";

/// How often a table is read before it is called damaged or missing: a reply can be cut or belong to another program's
/// request, and a refusal can be a wrong reply too. A camera that is called uncalibrated is not opened again.
const READINGS: usize = 3;

/// Reads a table again when what came is no such table, or a refusal.
fn until_sound<T>(mut read: impl FnMut() -> Result<T>) -> Result<T> {
    let is_answer =
        |e: &Error| matches!(e.kind(), ErrorKind::Protocol | ErrorKind::Unsupported | ErrorKind::NotFound);
    for _ in 1..READINGS {
        match read() {
            Err(e) if is_answer(&e) => tracing::debug!("a calibration table is read again: {e}"),
            done => return done,
        }
    }
    read().map_err(|e| {
        let text = format!("asked {READINGS} times: {e}");
        if is_answer(&e) { Error::new(e.kind(), text).with_source(e) } else { e }
    })
}

/// A stream of the device, as far as its geometry goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum View {
    /// Depth and the left imager, which depth is registered to.
    Left,
    /// The right imager.
    Right,
    /// Colour.
    Color,
}

/// The tables of a calibrated camera.
#[derive(Debug, Clone)]
pub(super) struct Calibration {
    stereo: Coefficients,
    sizes: Vec<RectifiedItem>,
    rgb: RgbTable,
    color_module: bool,
}

/// Where a stream looks from and how, at one size.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Geometry {
    pub(super) intrinsics: Intrinsics,
    pub(super) pose_in_device: Pose,
    /// Whether the intrinsics were scaled from another shape and so are off by what the camera cuts away.
    pub(super) is_scaled: bool,
}

impl Geometry {
    /// Nothing is known.
    pub(super) const UNKNOWN: Self = Self {
        intrinsics: Intrinsics {
            fx: 0.0,
            fy: 0.0,
            cx: 0.0,
            cy: 0.0,
            coeffs: [0.0; 8],
            model: 0,
            reserved: 0,
        },
        pose_in_device: Pose::IDENTITY,
        is_scaled: false,
    };
}

impl Calibration {
    /// Reads the tables of a camera of `model`; `None` when it has none and `config` allows that.
    ///
    /// # Errors
    /// [`ErrorKind::Unsupported`] when it is not calibrated, [`ErrorKind::Protocol`] when its tables are damaged, with
    /// what to do about either; those of the hardware monitor.
    pub(super) fn read(
        monitor: &mut dyn HardwareMonitor,
        model: &Model,
        config: &RealsenseConfig,
        label: &str,
    ) -> Result<Option<Self>> {
        match Self::read_all(monitor, model) {
            Ok(calibration) => Ok(Some(calibration)),
            // The camera went away, or does not answer at all: not a missing calibration.
            Err(e)
                if !matches!(
                    e.kind(),
                    ErrorKind::Unsupported | ErrorKind::Protocol | ErrorKind::NotFound
                ) =>
            {
                Err(e)
            }
            Err(e) if config.allow_uncalibrated => {
                tracing::warn!(camera = %label, "its intrinsics are unknown, which the rig allows: {e}");
                Ok(None)
            }
            Err(e) => {
                let text =
                    format!("{e}; `allow_uncalibrated = true` in the rig file uses the camera without");
                Err(Error::new(ErrorKind::Unsupported, text).with_source(e))
            }
        }
    }

    /// Where the calibration of a camera comes from, as [`depthrig_driver::DeviceInfo::calibration`] has it.
    pub(super) fn word(monitor: &mut dyn HardwareMonitor, model: &Model) -> &'static str {
        if Self::read_all(monitor, model).is_ok() { FACTORY } else { NONE }
    }

    fn read_all(monitor: &mut dyn HardwareMonitor, model: &Model) -> Result<Self> {
        let stereo = until_sound(|| Coefficients::read(monitor))?;
        let sizes = match until_sound(|| RectifiedItem::read_all(monitor)) {
            Ok(sizes) => sizes,
            // Firmware before 5.11.9.5 has the table of coefficients alone.
            Err(e) if matches!(e.kind(), ErrorKind::Unsupported | ErrorKind::NotFound) => Vec::new(),
            Err(e) if e.kind() == ErrorKind::Protocol => {
                tracing::warn!(
                    "its list of intrinsics by size is of no use, the table of coefficients is taken: {e}"
                );
                Vec::new()
            }
            Err(e) => return Err(e),
        };
        let rgb = until_sound(|| RgbTable::read(monitor))?;
        let read = Self { stereo, sizes, rgb, color_module: model.color_module };
        // A camera that was never calibrated has tables too; the sizes that it is used at show it.
        for (view, (width, height)) in
            [(View::Left, model.depth_size), (View::Right, model.depth_size), (View::Color, model.color_size)]
        {
            read.geometry(view, width, height)?;
        }
        Ok(read)
    }

    /// Geometry of `view` at a size.
    ///
    /// # Errors
    /// Those of [`intrinsics::depth`] and [`intrinsics::color`].
    pub(super) fn geometry(&self, view: View, width: u32, height: u32) -> Result<Geometry> {
        let rectified = || intrinsics::depth(&self.stereo, &self.sizes, width, height);
        let (intrinsics, basis, pose_in_device) = match view {
            View::Left => {
                let (i, basis) = rectified()?;
                (i, basis, Pose::IDENTITY)
            }
            // After rectification both imagers have the same intrinsics.
            View::Right => {
                let (i, basis) = rectified()?;
                (i, basis, intrinsics::right_in_depth(&self.stereo)?)
            }
            View::Color if self.color_module => (
                intrinsics::color(&self.rgb, width, height)?,
                Basis::Entry,
                intrinsics::color_in_depth(&self.rgb)?,
            ),
            View::Color => (
                intrinsics::d405_color(&self.rgb, width, height)?,
                Basis::Entry,
                intrinsics::color_in_depth(&self.rgb)?,
            ),
        };
        Ok(Geometry { intrinsics, pose_in_device, is_scaled: basis == Basis::Scaled })
    }
}

#[cfg(test)]
mod tests;
