//! The requests that depthrig knows, per family. Those that write calibration, flash or firmware have no name here,
//! so that none can be made.

macro_rules! opcodes {
    ($(#[$doc:meta])* $name:ident { $($(#[$each:meta])* $variant:ident = $code:literal,)* }) => {
        $(#[$doc])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
        #[repr(u32)]
        pub enum $name {
            $($(#[$each])* $variant = $code,)*
        }

        impl $name {
            /// Every opcode of the family that depthrig can send.
            pub const ALL: &'static [Self] = &[$(Self::$variant),*];

            /// The number on the wire.
            pub const fn code(self) -> u32 {
                self as u32
            }

            /// The opcode with this number, if depthrig knows it.
            pub fn from_code(code: u32) -> Option<Self> {
                Self::ALL.iter().copied().find(|o| o.code() == code)
            }
        }
    };
}

opcodes! {
    /// Requests to a D400 (librealsense `src/ds/ds-private.h`, `fw_cmd`).
    D4xxOpcode {
        /// MRD: reads memory from parameter 1 up to parameter 2.
        ReadMemory = 0x01,
        /// GVD: what the camera is.
        DeviceInfo = 0x10,
        /// GETINTCAL: the calibration table of parameter 1.
        CalibrationTable = 0x15,
        /// HWRST: restarts the camera, without a reply.
        Reset = 0x20,
        /// GTEMP: temperature of the processor.
        Temperature = 0x2A,
        /// SET_ADV: writes an advanced-mode group; lasts until the camera restarts.
        SetAdvanced = 0x2B,
        /// GET_ADV: reads an advanced-mode group.
        GetAdvanced = 0x2C,
        /// UAMG: whether advanced mode is on.
        AdvancedStatus = 0x30,
        /// MMER: reads the memory of the IMU, which has its calibration.
        ImuMemory = 0x4F,
        /// SET_CAM_SYNC: the mode of synchronisation between cameras.
        SetSync = 0x69,
        /// GET_CAM_SYNC.
        GetSync = 0x6A,
        /// RECPARAMSGET: rectified intrinsics by size.
        RectifiedParams = 0x7E,
        /// LASERONCONST: whether the projector stays on between exposures.
        LaserConstant = 0x7F,
    }
}

opcodes! {
    /// Requests to an L515 (librealsense v2.54 `src/l500/l500-private.h`, `fw_cmd`).
    L515Opcode {
        /// MRD: reads memory from parameter 1 up to parameter 2.
        ReadMemory = 0x01,
        /// GVD: what the camera is.
        DeviceInfo = 0x10,
        /// HW_RESET: restarts the camera, without a reply.
        Reset = 0x20,
        /// AMCSET: sets the control of parameter 1.
        SetControl = 0x2B,
        /// AMCGET: reads the control of parameter 1.
        GetControl = 0x2C,
        /// READ_TABLE: reads the table of parameter 1.
        ReadTable = 0x43,
        /// TEMPERATURES_GET.
        Temperatures = 0x6A,
        /// DPT_INTRINSICS_FULL_GET: intrinsics of depth by size.
        DepthIntrinsics = 0x7F,
        /// RGB_INTRINSIC_GET: intrinsics of colour by size.
        ColorIntrinsics = 0x81,
        /// RGB_EXTRINSIC_GET: from depth to colour.
        ColorExtrinsics = 0x82,
    }
}
