//! The C interface of libk4a 1.4, as far as it is used: types, values and the table of functions.
//!
//! Facts from the public headers `include/k4a/k4a.h` and `k4atypes.h` (Azure-Kinect-Sensor-SDK 1.4.1, MIT). C
//! enumerations are 32 bits wide there; none that is used here has a negative value. The numbers in the tests were
//! printed by a C program that includes those headers.
// The table is read out of a foreign library, whose types can only be promised.
#![allow(unsafe_code)]

use core::ffi::{c_char, c_int, c_void};
use libloading::Library;

/// The opaque target of a handle; only libk4a reads it.
#[repr(C)]
pub struct Opaque {
    reserved: usize,
}

/// `k4a_device_t`.
pub type DeviceHandle = *mut Opaque;
/// `k4a_capture_t`.
pub type CaptureHandle = *mut Opaque;
/// `k4a_image_t`.
pub type ImageHandle = *mut Opaque;

/// `K4A_RESULT_SUCCEEDED`, and that of buffers and waits.
pub const SUCCEEDED: u32 = 0;
/// `K4A_WAIT_RESULT_TIMEOUT`.
pub const WAIT_TIMEOUT: u32 = 2;
/// `K4A_BUFFER_RESULT_TOO_SMALL`.
pub const BUFFER_TOO_SMALL: u32 = 2;
/// `K4A_LOG_LEVEL_WARNING`: this and what is worse.
pub const LOG_WARNING: u32 = 2;

/// `k4a_image_format_t`.
pub mod image_format {
    /// `K4A_IMAGE_FORMAT_COLOR_MJPG`.
    pub const MJPG: u32 = 0;
    /// `K4A_IMAGE_FORMAT_COLOR_NV12`.
    pub const NV12: u32 = 1;
    /// `K4A_IMAGE_FORMAT_COLOR_YUY2`.
    pub const YUY2: u32 = 2;
    /// `K4A_IMAGE_FORMAT_COLOR_BGRA32`.
    pub const BGRA32: u32 = 3;
    /// `K4A_IMAGE_FORMAT_DEPTH16`.
    pub const DEPTH16: u32 = 4;
    /// `K4A_IMAGE_FORMAT_IR16`.
    pub const IR16: u32 = 5;
}

/// `k4a_color_control_mode_t`.
pub mod control_mode {
    /// `K4A_COLOR_CONTROL_MODE_AUTO`.
    pub const AUTO: u32 = 0;
    /// `K4A_COLOR_CONTROL_MODE_MANUAL`.
    pub const MANUAL: u32 = 1;
}

/// `k4a_device_configuration_t`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(C)]
pub struct DeviceConfiguration {
    /// One of [`image_format`].
    pub color_format: u32,
    /// 0 is off, then 720p, 1080p, 1440p, 1536p, 2160p, 3072p.
    pub color_resolution: u32,
    /// 0 is off, then the modes in the order of the header.
    pub depth_mode: u32,
    /// 0, 1, 2: 5, 15, 30 Hz.
    pub camera_fps: u32,
    /// Hand over captures with all images only.
    pub synchronized_images_only: bool,
    /// Depth after colour, microseconds.
    pub depth_delay_off_color_usec: i32,
    /// 0, 1, 2: standalone, master, subordinate.
    pub wired_sync_mode: u32,
    /// Colour after the pulse of the master, microseconds.
    pub subordinate_delay_off_master_usec: u32,
    /// The light on the front stays dark.
    pub disable_streaming_indicator: bool,
}

/// `k4a_version_t`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[repr(C)]
pub struct Version {
    /// Major number.
    pub major: u32,
    /// Minor number.
    pub minor: u32,
    /// Iteration.
    pub iteration: u32,
}

/// `k4a_hardware_version_t`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[repr(C)]
pub struct HardwareVersion {
    /// Colour camera.
    pub rgb: Version,
    /// Depth camera.
    pub depth: Version,
    /// Microphones.
    pub audio: Version,
    /// The depth sensor's own.
    pub depth_sensor: Version,
    /// `k4a_firmware_build_t`.
    pub firmware_build: u32,
    /// `k4a_firmware_signature_t`.
    pub firmware_signature: u32,
}

/// `k4a_imu_sample_t`.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[repr(C)]
pub struct ImuSample {
    /// °C.
    pub temperature: f32,
    /// m/s² along the accelerometer's axes.
    pub acc_sample: [f32; 3],
    /// When it was measured, microseconds of the device's clock.
    pub acc_timestamp_usec: u64,
    /// rad/s about the gyroscope's axes.
    pub gyro_sample: [f32; 3],
    /// When it was measured, microseconds of the device's clock.
    pub gyro_timestamp_usec: u64,
}

/// `k4a_logging_message_cb_t`: context, level, file, line, message.
pub type MessageHandler = unsafe extern "C" fn(*mut c_void, u32, *const c_char, c_int, *const c_char);

/// Declares the table of functions: each by its name in the library without `k4a_`, with its type.
macro_rules! functions {
    ($($name:ident($($argument:ty),*) $(-> $result:ty)?;)*) => {
        /// The functions, as they came out of a library. They are valid for as long as it is loaded, which is for good.
        #[allow(missing_docs)] // each is documented in k4a.h
        pub struct Functions {
            $(pub $name: unsafe extern "C" fn($($argument),*) $(-> $result)?,)*
        }

        impl Functions {
            /// Looks them all up.
            ///
            /// # Errors
            /// The name of the first that `library` has not.
            ///
            /// # Safety
            /// `library` must be a libk4a of version 1.4 and stay loaded for as long as a function of the table is
            /// called.
            pub unsafe fn load(library: &Library) -> Result<Self, &'static str> {
                Ok(Self {
                    $($name: {
                        const SYMBOL: &str = concat!("k4a_", stringify!($name), "\0");
                        // SAFETY: the caller promises a libk4a 1.4, whose function of this name has this type.
                        let found = unsafe { library.get(SYMBOL.as_bytes()) };
                        *found.map_err(|_| SYMBOL.trim_end_matches('\0'))?
                    },)*
                })
            }
        }
    };
}

functions! {
    device_get_installed_count() -> u32;
    set_debug_message_handler(Option<MessageHandler>, *mut c_void, u32) -> u32;
    device_open(u32, *mut DeviceHandle) -> u32;
    device_close(DeviceHandle);
    device_get_capture(DeviceHandle, *mut CaptureHandle, i32) -> u32;
    device_start_cameras(DeviceHandle, *const DeviceConfiguration) -> u32;
    device_stop_cameras(DeviceHandle);
    device_start_imu(DeviceHandle) -> u32;
    device_stop_imu(DeviceHandle);
    device_get_imu_sample(DeviceHandle, *mut ImuSample, i32) -> u32;
    device_get_serialnum(DeviceHandle, *mut c_char, *mut usize) -> u32;
    device_get_version(DeviceHandle, *mut HardwareVersion) -> u32;
    device_get_raw_calibration(DeviceHandle, *mut u8, *mut usize) -> u32;
    device_get_sync_jack(DeviceHandle, *mut u8, *mut u8) -> u32;
    device_get_color_control_capabilities(
        DeviceHandle, u32, *mut u8, *mut i32, *mut i32, *mut i32, *mut i32, *mut u32
    ) -> u32;
    device_get_color_control(DeviceHandle, u32, *mut u32, *mut i32) -> u32;
    device_set_color_control(DeviceHandle, u32, u32, i32) -> u32;
    capture_release(CaptureHandle);
    capture_get_color_image(CaptureHandle) -> ImageHandle;
    capture_get_depth_image(CaptureHandle) -> ImageHandle;
    capture_get_ir_image(CaptureHandle) -> ImageHandle;
    capture_get_temperature_c(CaptureHandle) -> f32;
    image_release(ImageHandle);
    image_get_buffer(ImageHandle) -> *mut u8;
    image_get_size(ImageHandle) -> usize;
    image_get_format(ImageHandle) -> u32;
    image_get_width_pixels(ImageHandle) -> c_int;
    image_get_height_pixels(ImageHandle) -> c_int;
    image_get_stride_bytes(ImageHandle) -> c_int;
    image_get_device_timestamp_usec(ImageHandle) -> u64;
    image_get_system_timestamp_nsec(ImageHandle) -> u64;
    image_get_exposure_usec(ImageHandle) -> u64;
}

#[cfg(test)]
mod tests {
    use super::*;
    use core::mem::{align_of, offset_of, size_of};

    /// Sizes and offsets as gcc 14 printed them for x86-64 with the headers of 1.4.1.
    #[test]
    fn structs_lie_in_memory_as_the_header_has_them() {
        assert_eq!((size_of::<DeviceConfiguration>(), align_of::<DeviceConfiguration>()), (36, 4));
        let offsets = [
            offset_of!(DeviceConfiguration, color_format),
            offset_of!(DeviceConfiguration, color_resolution),
            offset_of!(DeviceConfiguration, depth_mode),
            offset_of!(DeviceConfiguration, camera_fps),
            offset_of!(DeviceConfiguration, synchronized_images_only),
            offset_of!(DeviceConfiguration, depth_delay_off_color_usec),
            offset_of!(DeviceConfiguration, wired_sync_mode),
            offset_of!(DeviceConfiguration, subordinate_delay_off_master_usec),
            offset_of!(DeviceConfiguration, disable_streaming_indicator),
        ];
        assert_eq!(offsets, [0, 4, 8, 12, 16, 20, 24, 28, 32]);
        assert_eq!((size_of::<HardwareVersion>(), align_of::<HardwareVersion>()), (56, 4));
        let offsets = [
            offset_of!(HardwareVersion, rgb),
            offset_of!(HardwareVersion, depth),
            offset_of!(HardwareVersion, audio),
            offset_of!(HardwareVersion, depth_sensor),
            offset_of!(HardwareVersion, firmware_build),
            offset_of!(HardwareVersion, firmware_signature),
        ];
        assert_eq!(offsets, [0, 12, 24, 36, 48, 52]);
        assert_eq!((size_of::<ImuSample>(), align_of::<ImuSample>()), (48, 8));
        let offsets = [
            offset_of!(ImuSample, temperature),
            offset_of!(ImuSample, acc_sample),
            offset_of!(ImuSample, acc_timestamp_usec),
            offset_of!(ImuSample, gyro_sample),
            offset_of!(ImuSample, gyro_timestamp_usec),
        ];
        assert_eq!(offsets, [0, 4, 16, 24, 40]);
    }
}
