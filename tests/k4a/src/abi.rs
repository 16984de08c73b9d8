//! Types and values of the C interface, from the public header.

/// `k4a_result_t`, and success of the others.
pub const SUCCEEDED: u32 = 0;
/// `K4A_RESULT_FAILED`, and failure of the others.
pub const FAILED: u32 = 1;
/// `K4A_WAIT_RESULT_TIMEOUT`.
pub const TIMEOUT: u32 = 2;
/// `K4A_BUFFER_RESULT_TOO_SMALL`.
pub const TOO_SMALL: u32 = 2;
/// `K4A_LOG_LEVEL_ERROR`.
pub const LOG_ERROR: u32 = 1;

/// `k4a_image_format_t` of colour.
pub const MJPG: u32 = 0;
/// See [`MJPG`].
pub const NV12: u32 = 1;
/// See [`MJPG`].
pub const YUY2: u32 = 2;
/// See [`MJPG`].
pub const BGRA32: u32 = 3;
/// `K4A_IMAGE_FORMAT_DEPTH16`.
pub const DEPTH16: u32 = 4;
/// `K4A_IMAGE_FORMAT_IR16`.
pub const IR16: u32 = 5;

/// `k4a_device_configuration_t`.
#[derive(Debug, Clone, Copy)]
#[repr(C)]
#[allow(missing_docs)] // named as in the header
pub struct Configuration {
    pub color_format: u32,
    pub color_resolution: u32,
    pub depth_mode: u32,
    pub camera_fps: u32,
    pub synchronized_images_only: u8,
    pub depth_delay_off_color_usec: i32,
    pub wired_sync_mode: u32,
    pub subordinate_delay_off_master_usec: u32,
    pub disable_streaming_indicator: u8,
}

/// `k4a_imu_sample_t`.
#[derive(Debug, Clone, Copy, Default)]
#[repr(C)]
#[allow(missing_docs)] // named as in the header
pub struct ImuSample {
    pub temperature: f32,
    pub acc_sample: [f32; 3],
    pub acc_timestamp_usec: u64,
    pub gyro_sample: [f32; 3],
    pub gyro_timestamp_usec: u64,
}

/// Width and height of `k4a_color_resolution_t`; `None` when it is off.
pub fn color_size(resolution: u32) -> Option<(u32, u32)> {
    let sizes = [(1280, 720), (1920, 1080), (2560, 1440), (2048, 1536), (3840, 2160), (4096, 3072)];
    sizes.get((resolution as usize).checked_sub(1)?).copied()
}

/// Width and height of `k4a_depth_mode_t`; `None` when it is off.
pub fn depth_size(mode: u32) -> Option<(u32, u32)> {
    let sizes = [(320, 288), (640, 576), (512, 512), (1024, 1024), (1024, 1024)];
    sizes.get((mode as usize).checked_sub(1)?).copied()
}

/// Images a second of `k4a_fps_t`.
pub fn rate_hz(fps: u32) -> Option<u64> {
    [5, 15, 30].get(fps as usize).copied()
}
