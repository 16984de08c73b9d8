//! The calibration of the colour sensor (calibration table 32).

use super::{HEADER, Header, RGB};
use crate::protocol::hwm::HardwareMonitor;
use crate::protocol::protocol_error;
use depthrig_driver::Result;
use depthrig_driver::bytes::{f32s_at, put, put_f32s, u16_at};

/// Bytes of the whole table.
pub const BYTES: usize = 256;

const K: usize = 16;
const DISTORTION: usize = 52;
const ROTATION: usize = 72;
const TRANSLATION: usize = 84;
const PROJECTION: usize = 96;
const CALIBRATED_WIDTH: usize = 144;
const CALIBRATED_HEIGHT: usize = 146;
const RECTIFIED_K: usize = 148;
const RECTIFIED_ROTATION: usize = 184;
const RECTIFIED_TRANSLATION: usize = 220;

/// The calibration of the colour sensor (librealsense `src/ds/d400/d400-private.h`, `d400_rgb_calibration_table`).
#[derive(Debug, Clone, PartialEq, Default)]
pub struct RgbTable {
    /// Version of the table, major and minor.
    pub version: [u8; 2],
    /// Version of the format.
    pub param: u32,
    /// Intrinsics, normalised to -1…1, row after row: fx at 0, ppx at 2, fy at 4, ppy at 5.
    pub k: [f32; 9],
    /// Distortion `k1 k2 p1 p2 k3`.
    pub distortion: [f32; 5],
    /// Rotation as Rodrigues' vector; for information.
    pub rotation: [f32; 3],
    /// Translation in millimetres; for information.
    pub translation_mm: [f32; 3],
    /// Projection from depth to colour, 3 rows of 4; for information.
    pub projection: [f32; 12],
    /// Size at which the sensor was calibrated; 0 when that is not known.
    pub calibrated: (u16, u16),
    /// Intrinsics after rectification; for information.
    pub rectified_k: [f32; 9],
    /// Rotation after rectification, row after row.
    pub rectified_rotation: [f32; 9],
    /// Translation after rectification in millimetres.
    pub rectified_translation_mm: [f32; 3],
}

impl RgbTable {
    /// Reads the table from a D400.
    ///
    /// # Errors
    /// Those of [`HardwareMonitor::command`] and [`Self::parse`].
    pub fn read(monitor: &mut dyn HardwareMonitor) -> Result<Self> {
        Self::parse(&super::read(monitor, RGB)?)
    }

    /// Reads a whole table. Its reserved end may be missing.
    ///
    /// # Errors
    /// [`depthrig_driver::ErrorKind::Protocol`]: see [`Header::open`].
    pub fn parse(table: &[u8]) -> Result<Self> {
        let (header, _) = Header::open(table, RGB)?;
        let fields = || {
            Some(Self {
                version: header.version,
                param: header.param,
                k: f32s_at(table, K)?,
                distortion: f32s_at(table, DISTORTION)?,
                rotation: f32s_at(table, ROTATION)?,
                translation_mm: f32s_at(table, TRANSLATION)?,
                projection: f32s_at(table, PROJECTION)?,
                calibrated: (u16_at(table, CALIBRATED_WIDTH)?, u16_at(table, CALIBRATED_HEIGHT)?),
                rectified_k: f32s_at(table, RECTIFIED_K)?,
                rectified_rotation: f32s_at(table, RECTIFIED_ROTATION)?,
                rectified_translation_mm: f32s_at(table, RECTIFIED_TRANSLATION)?,
            })
        };
        fields().ok_or_else(|| {
            let is = table.len();
            let must = RECTIFIED_TRANSLATION + 12;
            protocol_error(format!(
                "the table of the colour sensor has {is} bytes; at least {must} are needed"
            ))
        })
    }

    /// The whole table with its checksum, for an emulated camera.
    pub fn build(&self) -> Vec<u8> {
        let mut table = vec![0; BYTES];
        put_f32s(&mut table, K, &self.k);
        put_f32s(&mut table, DISTORTION, &self.distortion);
        put_f32s(&mut table, ROTATION, &self.rotation);
        put_f32s(&mut table, TRANSLATION, &self.translation_mm);
        put_f32s(&mut table, PROJECTION, &self.projection);
        put(&mut table, CALIBRATED_WIDTH, &self.calibrated.0.to_le_bytes());
        put(&mut table, CALIBRATED_HEIGHT, &self.calibrated.1.to_le_bytes());
        put_f32s(&mut table, RECTIFIED_K, &self.rectified_k);
        put_f32s(&mut table, RECTIFIED_ROTATION, &self.rectified_rotation);
        put_f32s(&mut table, RECTIFIED_TRANSLATION, &self.rectified_translation_mm);
        Header::close(RGB, self.version, self.param, table.get(HEADER..).unwrap_or_default())
    }
}
