//! The coefficients of the stereo pair (calibration table 25), and the newer list of rectified intrinsics by size.

use super::{COEFFICIENTS, HEADER, Header};
use crate::protocol::hwm::{HardwareMonitor, Request};
use crate::protocol::protocol_error;
use depthrig_driver::Result;
use depthrig_driver::bytes::{f32_at, f32s_at, put, put_f32s, u16_at, u32_at};

/// Sizes of [`Coefficients::rectified`], in the order of the table (librealsense `src/ds/ds-private.h`,
/// `ds_rect_resolutions`); `None` is reserved.
pub const SIZES: [Option<(u32, u32)>; 16] = [
    Some((1920, 1080)),
    Some((1280, 720)),
    Some((640, 480)),
    Some((848, 480)),
    Some((640, 360)),
    Some((424, 240)),
    Some((320, 240)),
    Some((480, 270)),
    Some((1280, 800)),
    Some((960, 540)),
    None,
    None,
    Some((640, 400)),
    Some((576, 576)),
    Some((720, 720)),
    Some((1152, 1152)),
];

/// Bytes of the whole table.
pub const BYTES: usize = 576;

const LEFT: usize = 16;
const RIGHT: usize = 52;
const WORLD_TO_LEFT: usize = 88;
const WORLD_TO_RIGHT: usize = 124;
const BASELINE: usize = 160;
const MODEL: usize = 164;
const RECTIFIED: usize = 256;

/// Focal lengths and principal point, pixels.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Pinhole {
    /// Focal length along x.
    pub fx: f32,
    /// Focal length along y.
    pub fy: f32,
    /// Principal point x.
    pub ppx: f32,
    /// Principal point y.
    pub ppy: f32,
}

/// The coefficients of the stereo pair (librealsense `src/ds/d400/d400-private.h`, `d400_coefficients_table`).
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Coefficients {
    /// Version of the table, major and minor.
    pub version: [u8; 2],
    /// Version of the format.
    pub param: u32,
    /// Left intrinsics before rectification, normalised, row after row.
    pub left: [f32; 9],
    /// Right intrinsics before rectification, likewise.
    pub right: [f32; 9],
    /// Inverse of the rotation that rectifies the left imager.
    pub world_to_left: [f32; 9],
    /// Inverse of the rotation that rectifies the right imager.
    pub world_to_right: [f32; 9],
    /// From left to right in millimetres, negative on cameras as they are sold.
    pub baseline_mm: f32,
    /// Distortion model of the imagers: 0 the vendor's, 1 Brown.
    pub distortion_model: u32,
    /// Intrinsics after rectification for each of [`SIZES`].
    pub rectified: [Pinhole; 16],
}

impl Coefficients {
    /// Reads the table from a D400.
    ///
    /// # Errors
    /// Those of [`HardwareMonitor::command`] and [`Self::parse`].
    pub fn read(monitor: &mut dyn HardwareMonitor) -> Result<Self> {
        Self::parse(&super::read(monitor, COEFFICIENTS)?)
    }

    /// Reads a whole table. Its reserved end may be missing.
    ///
    /// # Errors
    /// [`depthrig_driver::ErrorKind::Protocol`]: see [`Header::open`].
    pub fn parse(table: &[u8]) -> Result<Self> {
        let (header, _) = Header::open(table, COEFFICIENTS)?;
        let fields = || {
            let mut rectified = [Pinhole::default(); 16];
            for (i, entry) in rectified.iter_mut().enumerate() {
                let [fx, fy, ppx, ppy] = f32s_at(table, RECTIFIED + 16 * i)?;
                *entry = Pinhole { fx, fy, ppx, ppy };
            }
            Some(Self {
                version: header.version,
                param: header.param,
                left: f32s_at(table, LEFT)?,
                right: f32s_at(table, RIGHT)?,
                world_to_left: f32s_at(table, WORLD_TO_LEFT)?,
                world_to_right: f32s_at(table, WORLD_TO_RIGHT)?,
                baseline_mm: f32_at(table, BASELINE)?,
                distortion_model: u32_at(table, MODEL)?,
                rectified,
            })
        };
        fields().ok_or_else(|| {
            let is = table.len();
            let must = RECTIFIED + 16 * SIZES.len();
            protocol_error(format!("the table of coefficients has {is} bytes; at least {must} are needed"))
        })
    }

    /// The whole table with its checksum, for an emulated camera.
    pub fn build(&self) -> Vec<u8> {
        let mut table = vec![0; BYTES];
        put_f32s(&mut table, LEFT, &self.left);
        put_f32s(&mut table, RIGHT, &self.right);
        put_f32s(&mut table, WORLD_TO_LEFT, &self.world_to_left);
        put_f32s(&mut table, WORLD_TO_RIGHT, &self.world_to_right);
        put_f32s(&mut table, BASELINE, &[self.baseline_mm]);
        put(&mut table, MODEL, &self.distortion_model.to_le_bytes());
        for (i, e) in self.rectified.iter().enumerate() {
            put_f32s(&mut table, RECTIFIED + 16 * i, &[e.fx, e.fy, e.ppx, e.ppy]);
        }
        Header::close(COEFFICIENTS, self.version, self.param, table.get(HEADER..).unwrap_or_default())
    }

    /// The entry of exactly this size.
    pub fn entry(&self, width: u32, height: u32) -> Option<Pinhole> {
        let at = SIZES.iter().position(|s| *s == Some((width, height)))?;
        self.rectified.get(at).copied()
    }
}

/// One item of `RECPARAMSGET`: rectified intrinsics at one size (librealsense `src/ds/ds-private.h`,
/// `new_calibration_item`).
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct RectifiedItem {
    /// Pixels per row.
    pub width: u16,
    /// Rows.
    pub height: u16,
    /// The intrinsics.
    pub pinhole: Pinhole,
}

/// Bytes of one [`RectifiedItem`].
const ITEM: usize = 20;

impl RectifiedItem {
    /// Asks a D400 for all of them.
    ///
    /// # Errors
    /// Those of [`HardwareMonitor::command`]; [`depthrig_driver::ErrorKind::Unsupported`] with firmware before 5.11.9.5.
    pub fn read_all(monitor: &mut dyn HardwareMonitor) -> Result<Vec<Self>> {
        Ok(Self::parse_all(&monitor.command(&Request::rectified_params())?))
    }

    /// Reads the data of a reply; an item that is cut off at the end is left out.
    pub fn parse_all(data: &[u8]) -> Vec<Self> {
        let item = |b: &[u8]| {
            let [fx, fy, ppx, ppy] = f32s_at(b, 4)?;
            Some(Self { width: u16_at(b, 0)?, height: u16_at(b, 2)?, pinhole: Pinhole { fx, fy, ppx, ppy } })
        };
        data.chunks_exact(ITEM).filter_map(item).collect()
    }

    /// The data of a reply, for an emulated camera.
    pub fn build_all(items: &[Self]) -> Vec<u8> {
        let mut data = vec![0; ITEM * items.len()];
        for (i, item) in items.iter().enumerate() {
            let p = item.pinhole;
            put(&mut data, ITEM * i, &item.width.to_le_bytes());
            put(&mut data, ITEM * i + 2, &item.height.to_le_bytes());
            put_f32s(&mut data, ITEM * i + 4, &[p.fx, p.fy, p.ppx, p.ppy]);
        }
        data
    }
}
