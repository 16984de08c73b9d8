//! Calibration tables of a D400: a header of 16 bytes with a checksum, then the table.

use super::hwm::{HardwareMonitor, Request};
use super::protocol_error;
use depthrig_driver::Result;
use depthrig_driver::bytes::{array, put, u16_at, u32_at};

mod coefficients;
mod rgb;

pub use coefficients::{Coefficients, Pinhole, RectifiedItem, SIZES};
pub use rgb::RgbTable;

/// Number of the table of coefficients of the stereo pair.
pub const COEFFICIENTS: u16 = 25;
/// Number of the table of the colour sensor.
pub const RGB: u16 = 32;

/// Bytes of a table's header.
pub const HEADER: usize = 16;

/// The header of a calibration table (librealsense `src/ds/ds-private.h`, `table_header`).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Header {
    /// Version, major and minor.
    pub version: [u8; 2],
    /// Number of the table.
    pub id: u16,
    /// Bytes behind the header.
    pub size: u32,
    /// Version of the table's format.
    pub param: u32,
    /// CRC-32 (IEEE) of the bytes behind the header.
    pub crc32: u32,
}

impl Header {
    /// Takes a table apart into its header and what is behind it, after checking its number and its checksum. As in
    /// the vendor's software the checksum is that of everything that came, and the size that the header states is
    /// for information: firmware is known to count it in two ways.
    ///
    /// # Errors
    /// [`depthrig_driver::ErrorKind::Protocol`] when the table is short, is another than number `id`, or fails its checksum.
    pub fn open(table: &[u8], id: u16) -> Result<(Self, &[u8])> {
        let parts = (|| {
            let header = Self {
                version: array(table, 0)?,
                id: u16_at(table, 2)?,
                size: u32_at(table, 4)?,
                param: u32_at(table, 8)?,
                crc32: u32_at(table, 12)?,
            };
            Some((header, table.get(HEADER..)?))
        })();
        let (header, payload) = parts.ok_or_else(|| {
            protocol_error(format!("calibration table {id} has {} bytes, less than its header", table.len()))
        })?;
        if header.id != id {
            return Err(protocol_error(format!(
                "calibration table {id} was asked for and {} came",
                header.id
            )));
        }
        let is = crc32fast::hash(payload);
        let must = header.crc32;
        if is != must {
            return Err(protocol_error(format!(
                "calibration table {id} is damaged: its checksum is {is:08x} and should be {must:08x}. Read it again; \
                 if it stays, restore the factory calibration with the vendor's calibration tool"
            )));
        }
        Ok((header, payload))
    }

    /// A whole table around `payload`; size and checksum are computed.
    pub fn close(id: u16, version: [u8; 2], param: u32, payload: &[u8]) -> Vec<u8> {
        let mut table = vec![0; HEADER];
        put(&mut table, 0, &version);
        put(&mut table, 2, &id.to_le_bytes());
        put(&mut table, 4, &(payload.len() as u32).to_le_bytes());
        put(&mut table, 8, &param.to_le_bytes());
        put(&mut table, 12, &crc32fast::hash(payload).to_le_bytes());
        table.extend(payload);
        table
    }
}

/// Reads table `id` from a camera, as it is.
///
/// # Errors
/// Those of [`HardwareMonitor::command`].
pub fn read(monitor: &mut dyn HardwareMonitor, id: u16) -> Result<Vec<u8>> {
    monitor.command(&Request::calibration_table(id))
}

#[cfg(test)]
mod tests;
