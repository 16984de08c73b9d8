//! One request to the hardware monitor. There is a constructor for each that depthrig has a use for and no other way
//! to make one: nothing that writes calibration, flash or firmware can be sent.

use super::{D4xxOpcode, HEADER, L515Opcode, MAGIC, MAX_DATA, UNIT_BYTES};
use core::fmt;
use depthrig_driver::{Error, ErrorKind, Result};

/// Register of a D400's microsecond clock (librealsense `src/ds/ds-private.h`).
const D4XX_CLOCK: u32 = 0x0001_613C;
/// Register of an L515's microsecond clock (librealsense v2.54 `src/l500/l500-private.h`).
const L515_CLOCK: u32 = 0x9003_021C;

/// Size of the larger of the two layouts that a D400's IMU memory may have (`eeprom_imu_table_size`).
const IMU_MEMORY: u32 = 520;
/// Number of an L515's table of the IMU (librealsense v2.54 `L515_IMU_TABLE`).
const L515_IMU_TABLE: u32 = 0x243;

/// One request, ready to be sent.
#[derive(Clone, PartialEq, Eq)]
pub struct Request {
    opcode: u32,
    name: &'static str,
    params: [u32; 4],
    data: Vec<u8>,
    answered: bool,
}

impl Request {
    fn new(opcode: u32, name: &'static str, params: [u32; 4]) -> Self {
        Self { opcode, name, params, data: Vec::new(), answered: true }
    }

    fn d4xx(opcode: D4xxOpcode, name: &'static str, params: [u32; 4]) -> Self {
        Self::new(opcode.code(), name, params)
    }

    fn l515(opcode: L515Opcode, name: &'static str, params: [u32; 4]) -> Self {
        Self::new(opcode.code(), name, params)
    }

    /// Asks for the camera's identity; the same on both families.
    pub fn device_info() -> Self {
        Self::d4xx(D4xxOpcode::DeviceInfo, "GVD", [0; 4])
    }

    /// Restarts the camera, on both families. It leaves the bus without a reply and comes back after some seconds.
    pub fn reset() -> Self {
        Self { answered: false, ..Self::d4xx(D4xxOpcode::Reset, "HWRST", [0; 4]) }
    }

    /// The clock of a D400 now: 32 bits of microseconds.
    pub fn clock() -> Self {
        Self::d4xx(D4xxOpcode::ReadMemory, "MRD (clock)", [D4XX_CLOCK, D4XX_CLOCK + 4, 0, 0])
    }

    /// The clock of an L515 now: 32 bits of microseconds.
    pub fn l515_clock() -> Self {
        Self::l515(L515Opcode::ReadMemory, "MRD (clock)", [L515_CLOCK, L515_CLOCK + 4, 0, 0])
    }

    /// The calibration table `id` of a D400.
    pub fn calibration_table(id: u16) -> Self {
        Self::d4xx(D4xxOpcode::CalibrationTable, "GETINTCAL", [id.into(), 0, 0, 0])
    }

    /// Rectified intrinsics of a D400 by size; firmware 5.11.9.5 or later.
    pub fn rectified_params() -> Self {
        Self::d4xx(D4xxOpcode::RectifiedParams, "RECPARAMSGET", [0; 4])
    }

    /// Temperature of a D400's processor.
    pub fn temperature() -> Self {
        Self::d4xx(D4xxOpcode::Temperature, "GTEMP", [0; 4])
    }

    /// Whether advanced mode is on.
    pub fn advanced_status() -> Self {
        Self::d4xx(D4xxOpcode::AdvancedStatus, "UAMG", [0; 4])
    }

    /// The advanced-mode group with the number `group`; `bound` is 0 for the value, 1 for the least, 2 for the
    /// greatest.
    pub(crate) fn get_advanced(group: u32, bound: u32) -> Self {
        Self::d4xx(D4xxOpcode::GetAdvanced, "GET_ADV", [group, bound, 0, 0])
    }

    /// Writes an advanced-mode group.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] when there is more data than a request holds.
    pub(crate) fn set_advanced(group: u32, data: &[u8]) -> Result<Self> {
        if data.len() > MAX_DATA {
            let text =
                format!("advanced-mode group {group} with {} bytes; a request holds {MAX_DATA}", data.len());
            return Err(Error::new(ErrorKind::BadInput, text));
        }
        let request = Self::d4xx(D4xxOpcode::SetAdvanced, "SET_ADV", [group, 0, 0, 0]);
        Ok(Self { data: data.to_vec(), ..request })
    }

    /// The memory of a D400's IMU: as many bytes as the vendor's software asks for.
    pub fn imu_memory() -> Self {
        Self::d4xx(D4xxOpcode::ImuMemory, "MMER", [0, IMU_MEMORY, 0, 0])
    }

    /// The IMU's table of an L515.
    pub fn l515_imu_table() -> Self {
        Self::l515(L515Opcode::ReadTable, "READ_TABLE (IMU)", [L515_IMU_TABLE, 0, 0, 0])
    }

    /// The mode of synchronisation between cameras, as [`crate::protocol::sync`] codes it.
    pub(crate) fn set_sync(code: u32) -> Self {
        Self::d4xx(D4xxOpcode::SetSync, "SET_CAM_SYNC", [code, 0, 0, 0])
    }

    /// Reads the mode of synchronisation.
    pub fn sync() -> Self {
        Self::d4xx(D4xxOpcode::GetSync, "GET_CAM_SYNC", [0; 4])
    }

    /// The control `control` of an L515: `what` is 0 for its value, then least, greatest, step and default.
    pub(crate) fn l515_control(control: u32, what: u32, sensor_mode: u32) -> Self {
        Self::l515(L515Opcode::GetControl, "AMCGET", [control, what, sensor_mode, 0])
    }

    /// Sets the control `control` of an L515.
    pub(crate) fn set_l515_control(control: u32, value: i32, sensor_mode: u32) -> Self {
        Self::l515(L515Opcode::SetControl, "AMCSET", [control, value as u32, sensor_mode, 0])
    }

    /// Temperatures of an L515.
    pub fn l515_temperatures() -> Self {
        Self::l515(L515Opcode::Temperatures, "TEMPERATURES_GET", [0; 4])
    }

    /// Depth intrinsics of an L515.
    pub fn l515_depth_intrinsics() -> Self {
        Self::l515(L515Opcode::DepthIntrinsics, "DPT_INTRINSICS_FULL_GET", [0; 4])
    }

    /// Colour intrinsics of an L515.
    pub fn l515_color_intrinsics() -> Self {
        Self::l515(L515Opcode::ColorIntrinsics, "RGB_INTRINSIC_GET", [0; 4])
    }

    /// From depth to colour of an L515.
    pub fn l515_color_extrinsics() -> Self {
        Self::l515(L515Opcode::ColorExtrinsics, "RGB_EXTRINSIC_GET", [0; 4])
    }

    /// The number on the wire.
    pub const fn opcode(&self) -> u32 {
        self.opcode
    }

    /// The four parameters.
    pub const fn params(&self) -> [u32; 4] {
        self.params
    }

    /// The data behind them.
    pub fn data(&self) -> &[u8] {
        &self.data
    }

    /// Whether the camera replies.
    pub const fn is_answered(&self) -> bool {
        self.answered
    }

    /// The request as the vendor's bulk endpoint takes it: 24 bytes and the data.
    pub fn to_bytes(&self) -> Vec<u8> {
        let length = (HEADER - 4 + self.data.len()) as u16;
        let mut bytes = Vec::with_capacity(HEADER + self.data.len());
        bytes.extend(length.to_le_bytes());
        bytes.extend(MAGIC.to_le_bytes());
        bytes.extend(self.opcode.to_le_bytes());
        bytes.extend(self.params.iter().flat_map(|p| p.to_le_bytes()));
        bytes.extend(&self.data);
        bytes
    }

    /// The request as the extension unit takes it: padded with zeros to [`UNIT_BYTES`].
    pub fn to_unit_frame(&self) -> [u8; UNIT_BYTES] {
        let mut frame = [0; UNIT_BYTES];
        depthrig_driver::bytes::put(&mut frame, 0, &self.to_bytes());
        frame
    }
}

/// Name and opcode, for messages.
impl fmt::Display for Request {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} ({:#04x})", self.name, self.opcode)
    }
}

impl fmt::Debug for Request {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{self} {:x?} + {} bytes", self.params, self.data.len())
    }
}
