//! An open Kinect, its captures and images: libk4a's handles, each given back exactly once.
// Every function of the table is foreign.
#![allow(unsafe_code)]

use super::ffi::{self, DeviceConfiguration, HardwareVersion, Opaque};
use super::journal::{self, Cause};
use super::library::Loaded;
use crate::motion::Measured;
use core::ffi::c_char;
use core::marker::PhantomData;
use core::ptr::NonNull;
use core::time::Duration;
use depthrig_driver::{Error, ErrorKind, Result};
use depthrig_usb::health::RULE_CURE;

/// The longest calibration that is read; those that are known have 4 KB.
const MAX_CALIBRATION: usize = 1 << 20;
/// The longest serial number that is read; they have 12 characters.
const MAX_SERIAL: usize = 256;

/// An open camera. Dropping it closes it, which stops it too.
pub struct Handle {
    library: &'static Loaded,
    raw: NonNull<Opaque>,
}

// SAFETY: libk4a's handles belong to no thread (k4a.h says nothing of one, and its own recorder uses a handle from
// several); a `Handle` is used by one thread at a time.
unsafe impl Send for Handle {}

/// The range and default of a colour control.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ControlRange {
    /// Whether the camera can regulate it.
    pub has_auto: bool,
    /// Least value.
    pub min: i32,
    /// Greatest value.
    pub max: i32,
    /// From one value to the next.
    pub step: i32,
    /// Its factory default.
    pub default: i32,
}

/// A value of a colour control.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ControlSetting {
    /// The camera regulates it.
    Auto,
    /// It stays at this.
    Manual(i32),
}

/// How many cameras libk4a sees.
pub fn count(library: &'static Loaded) -> u32 {
    // SAFETY: the function takes nothing.
    unsafe { (library.functions.device_get_installed_count)() }
}

impl Handle {
    /// Opens the camera at `index`, which is any number below [`count`]; libk4a orders them as it likes.
    ///
    /// # Errors
    /// [`ErrorKind::Busy`], [`ErrorKind::PermissionDenied`], [`ErrorKind::NotFound`], [`ErrorKind::Io`], as far as
    /// libk4a's messages show it.
    pub fn open(library: &'static Loaded, index: u32) -> Result<Self> {
        library.journal.clear();
        let mut raw = core::ptr::null_mut();
        // SAFETY: `raw` is written to during the call alone.
        let result = unsafe { (library.functions.device_open)(index, &raw mut raw) };
        match NonNull::new(raw) {
            Some(raw) if result == ffi::SUCCEEDED => Ok(Self { library, raw }),
            _ => Err(failed(library, "it cannot be opened", ErrorKind::NotFound)),
        }
    }

    /// The number that is printed on it.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] if the camera does not report it.
    pub fn serial(&self) -> Result<String> {
        let read = |data: *mut c_char, size: &mut usize| {
            // SAFETY: the handle is open; `data` has `size` bytes, or is null where only the size is asked for.
            unsafe { (self.library.functions.device_get_serialnum)(self.raw.as_ptr(), data, size) }
        };
        let bytes = self.read_sized("its serial number", MAX_SERIAL, |data, size| read(data.cast(), size))?;
        let text = bytes.split(|b| *b == 0).next().unwrap_or_default();
        let text = String::from_utf8_lossy(text).trim().to_owned();
        if text.is_empty() { Err(self.failed("it gives no serial number", ErrorKind::Io)) } else { Ok(text) }
    }

    /// `color 1.6.110, depth 1.6.79`; empty when it does not say.
    pub fn firmware(&self) -> String {
        let mut v = HardwareVersion::default();
        // SAFETY: the handle is open, and `v` is written to during the call alone.
        let result = unsafe { (self.library.functions.device_get_version)(self.raw.as_ptr(), &raw mut v) };
        if result != ffi::SUCCEEDED {
            return String::new();
        }
        let text = |v: ffi::Version| format!("{}.{}.{}", v.major, v.minor, v.iteration);
        format!("color {}, depth {}", text(v.rgb), text(v.depth))
    }

    /// The JSON text of the factory calibration.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] if the camera does not report it.
    pub fn raw_calibration(&self) -> Result<Vec<u8>> {
        let read = |data: *mut u8, size: &mut usize| {
            // SAFETY: the handle is open; `data` has `size` bytes, or is null where only the size is asked for.
            unsafe { (self.library.functions.device_get_raw_calibration)(self.raw.as_ptr(), data, size) }
        };
        self.read_sized("its calibration", MAX_CALIBRATION, read)
    }

    /// Reads data whose size libk4a reports first.
    fn read_sized(
        &self,
        what: &str,
        most: usize,
        read: impl Fn(*mut u8, &mut usize) -> u32,
    ) -> Result<Vec<u8>> {
        let mut size = 0;
        let asked = read(core::ptr::null_mut(), &mut size);
        if asked != ffi::BUFFER_TOO_SMALL || size == 0 || size > most {
            return Err(self.failed(&format!("{what} cannot be read"), ErrorKind::Io));
        }
        let mut bytes = vec![0; size];
        if read(bytes.as_mut_ptr(), &mut size) != ffi::SUCCEEDED {
            return Err(self.failed(&format!("{what} cannot be read"), ErrorKind::Io));
        }
        bytes.truncate(size);
        Ok(bytes)
    }

    /// Whether a cable is in "sync in" and in "sync out".
    ///
    /// # Errors
    /// [`ErrorKind::Io`] if the camera does not report it.
    pub fn sync_jacks(&self) -> Result<(bool, bool)> {
        let mut into = 0u8;
        let mut out = 0u8;
        let ask = self.library.functions.device_get_sync_jack;
        // SAFETY: the handle is open; both bytes, of the size of a C `bool`, are written to during the call alone.
        let result = unsafe { ask(self.raw.as_ptr(), &raw mut into, &raw mut out) };
        if result != ffi::SUCCEEDED {
            return Err(self.failed("its jacks cannot be read", ErrorKind::Io));
        }
        Ok((into != 0, out != 0))
    }

    /// The range of the colour control `command`; `None` if the camera has no such control.
    pub fn control_range(&self, command: u32) -> Option<ControlRange> {
        let mut auto = 0u8;
        let mut min = 0;
        let mut max = 0;
        let mut step = 0;
        let mut default = 0;
        let mut mode = 0u32;
        let ask = self.library.functions.device_get_color_control_capabilities;
        // SAFETY: the handle is open; everything is written to during the call alone, and has the size that k4a.h says.
        let result = unsafe {
            ask(
                self.raw.as_ptr(),
                command,
                &raw mut auto,
                &raw mut min,
                &raw mut max,
                &raw mut step,
                &raw mut default,
                &raw mut mode,
            )
        };
        (result == ffi::SUCCEEDED).then_some(ControlRange { has_auto: auto != 0, min, max, step, default })
    }

    /// The value of the colour control `command`.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] if the camera does not report it.
    pub fn control(&self, command: u32) -> Result<ControlSetting> {
        let mut mode = 0u32;
        let mut value = 0;
        let ask = self.library.functions.device_get_color_control;
        // SAFETY: the handle is open; both are written to during the call alone.
        let result = unsafe { ask(self.raw.as_ptr(), command, &raw mut mode, &raw mut value) };
        match (result, mode) {
            (ffi::SUCCEEDED, ffi::control_mode::AUTO) => Ok(ControlSetting::Auto),
            (ffi::SUCCEEDED, _) => Ok(ControlSetting::Manual(value)),
            _ => Err(self.failed("a colour control cannot be read", ErrorKind::Io)),
        }
    }

    /// Sets the colour control `command`.
    ///
    /// # Errors
    /// [`ErrorKind::Io`] when it refuses.
    pub fn set_control(&self, command: u32, setting: ControlSetting) -> Result<()> {
        self.library.journal.clear();
        let (mode, value) = match setting {
            ControlSetting::Auto => (ffi::control_mode::AUTO, 0),
            ControlSetting::Manual(value) => (ffi::control_mode::MANUAL, value),
        };
        let set = self.library.functions.device_set_color_control;
        // SAFETY: the handle is open.
        let result = unsafe { set(self.raw.as_ptr(), command, mode, value) };
        if result == ffi::SUCCEEDED {
            Ok(())
        } else {
            Err(self.failed("a colour control cannot be set", ErrorKind::Io))
        }
    }

    /// Starts the cameras.
    ///
    /// # Errors
    /// As [`Self::open`]; [`ErrorKind::Unsupported`] and [`ErrorKind::BadInput`] where trying again cannot help.
    pub fn start(&self, configuration: &DeviceConfiguration) -> Result<()> {
        self.library.journal.clear();
        let start = self.library.functions.device_start_cameras;
        // SAFETY: the handle is open, and the configuration is read during the call alone.
        let result = unsafe { start(self.raw.as_ptr(), configuration) };
        if result == ffi::SUCCEEDED {
            Ok(())
        } else {
            Err(self.failed("it cannot be started", ErrorKind::Io))
        }
    }

    /// Stops the cameras. May take as long as libk4a likes.
    pub fn stop(&self) {
        // SAFETY: the handle is open; a camera that does not run is left as it is.
        unsafe { (self.library.functions.device_stop_cameras)(self.raw.as_ptr()) }
    }

    /// Starts the IMU; the cameras must run, because that of colour sets the unit's clock when it starts.
    ///
    /// # Errors
    /// As [`Self::start`].
    pub fn start_imu(&self) -> Result<()> {
        self.library.journal.clear();
        // SAFETY: the handle is open.
        let result = unsafe { (self.library.functions.device_start_imu)(self.raw.as_ptr()) };
        if result == ffi::SUCCEEDED {
            Ok(())
        } else {
            Err(self.failed("its IMU cannot be started", ErrorKind::Io))
        }
    }

    /// Stops the IMU.
    pub fn stop_imu(&self) {
        // SAFETY: the handle is open; a unit that does not run is left as it is.
        unsafe { (self.library.functions.device_stop_imu)(self.raw.as_ptr()) }
    }

    /// The next IMU sample, if there is one now.
    ///
    /// # Errors
    /// [`ErrorKind::Disconnected`]: nothing more will come.
    pub fn imu_sample(&self) -> Result<Option<Measured>> {
        let mut sample = ffi::ImuSample::default();
        let get = self.library.functions.device_get_imu_sample;
        // SAFETY: the handle is open, and `sample` is written to during the call alone.
        match unsafe { get(self.raw.as_ptr(), &raw mut sample, 0) } {
            ffi::WAIT_TIMEOUT => Ok(None),
            ffi::SUCCEEDED => Ok(Some(Measured {
                gyroscope_ns: sample.gyro_timestamp_usec.saturating_mul(1000),
                accelerometer_ns: sample.acc_timestamp_usec.saturating_mul(1000),
                rotation: sample.gyro_sample,
                acceleration: sample.acc_sample,
                temperature_c: sample.temperature,
            })),
            _ => Err(self.failed("its IMU stopped sending", ErrorKind::Disconnected)),
        }
    }

    /// Waits at most `timeout` for the next capture.
    ///
    /// # Errors
    /// [`ErrorKind::Disconnected`]: nothing more will come.
    pub fn capture(&self, timeout: Duration) -> Result<Option<Capture<'_>>> {
        let mut raw = core::ptr::null_mut();
        let wait_ms = i32::try_from(timeout.as_millis()).unwrap_or(i32::MAX);
        let get = self.library.functions.device_get_capture;
        // SAFETY: the handle is open, and `raw` is written to during the call alone.
        match unsafe { get(self.raw.as_ptr(), &raw mut raw, wait_ms) } {
            ffi::WAIT_TIMEOUT => Ok(None),
            ffi::SUCCEEDED => Ok(NonNull::new(raw).map(|raw| Capture { handle: self, raw })),
            _ => Err(self.failed(
                "it stopped sending, and is unplugged or given up by libk4a",
                ErrorKind::Disconnected,
            )),
        }
    }

    fn failed(&self, what: &str, otherwise: ErrorKind) -> Error {
        failed(self.library, what, otherwise)
    }
}

impl Drop for Handle {
    fn drop(&mut self) {
        // SAFETY: it is open, and closed here alone; captures and images of it borrow it, so there are none.
        unsafe { (self.library.functions.device_close)(self.raw.as_ptr()) }
    }
}

/// The error for `what`, with its cause from libk4a's messages.
fn failed(library: &Loaded, what: &str, otherwise: ErrorKind) -> Error {
    let lines = library.journal.lines();
    let (kind, cure) = match journal::cause(&lines) {
        Cause::Busy => (ErrorKind::Busy, "; another program has it: end that".to_owned()),
        Cause::Denied => (ErrorKind::PermissionDenied, format!("; {RULE_CURE} and plug the camera in again")),
        Cause::NoEngine => (
            ErrorKind::BadInput,
            format!("; the depth engine was not found: {}", super::library::CURE),
        ),
        Cause::NoGraphics => (
            otherwise,
            "; the depth engine runs on the graphics card and needs OpenGL 4.4 and an X display: set DISPLAY (such as :0) \
             for a user who is logged in there, or run an X server of its own"
                .to_owned(),
        ),
        Cause::OldFirmware => {
            (ErrorKind::Unsupported, "; write newer firmware with Microsoft's AzureKinectFirmwareTool".to_owned())
        }
        Cause::NoSyncCable => (otherwise, "; a cable for synchronisation is missing".to_owned()),
        Cause::NoUsbMemory => (
            otherwise,
            format!("; the kernel gives no more memory for USB transfers: raise /{}", depthrig_usb::health::USBFS_LIMIT),
        ),
        Cause::Gone | Cause::Unknown => (otherwise, String::new()),
    };
    Error::new(kind, format!("{what}{cure}{}", journal::quote(&lines)))
}

/// The images that the camera took at one moment. Dropping it releases them.
pub struct Capture<'h> {
    handle: &'h Handle,
    raw: NonNull<Opaque>,
}

impl<'h> Capture<'h> {
    /// The colour image, if it came.
    pub fn color(&self) -> Option<Image<'h>> {
        self.image(self.handle.library.functions.capture_get_color_image)
    }

    /// The depth image, if it came.
    pub fn depth(&self) -> Option<Image<'h>> {
        self.image(self.handle.library.functions.capture_get_depth_image)
    }

    /// The infrared image, if it came.
    pub fn ir(&self) -> Option<Image<'h>> {
        self.image(self.handle.library.functions.capture_get_ir_image)
    }

    /// Temperature of the device in °C; NaN when it does not say.
    pub fn temperature_c(&self) -> f32 {
        // SAFETY: the capture is held.
        unsafe { (self.handle.library.functions.capture_get_temperature_c)(self.raw.as_ptr()) }
    }

    fn image(&self, get: unsafe extern "C" fn(ffi::CaptureHandle) -> ffi::ImageHandle) -> Option<Image<'h>> {
        // SAFETY: the capture is held. The image has a reference of its own.
        let raw = unsafe { get(self.raw.as_ptr()) };
        NonNull::new(raw).map(|raw| Image { library: self.handle.library, raw, of: PhantomData })
    }
}

impl Drop for Capture<'_> {
    fn drop(&mut self) {
        // SAFETY: it is held, and given back here alone.
        unsafe { (self.handle.library.functions.capture_release)(self.raw.as_ptr()) }
    }
}

/// One image. Dropping it gives it back; it must be gone before the cameras can stop.
pub struct Image<'h> {
    library: &'static Loaded,
    raw: NonNull<Opaque>,
    of: PhantomData<&'h Handle>,
}

impl Image<'_> {
    /// Its bytes; `None` when it has no memory.
    pub fn bytes(&self) -> Option<&[u8]> {
        // SAFETY: the image is held.
        let (data, size) = unsafe {
            let f = &self.library.functions;
            ((f.image_get_buffer)(self.raw.as_ptr()), (f.image_get_size)(self.raw.as_ptr()))
        };
        if data.is_null() || size > isize::MAX as usize {
            return None;
        }
        // SAFETY: libk4a says that there are `size` bytes at `data`, for as long as the image is held. It writes them
        // no more once it has handed the image over.
        Some(unsafe { core::slice::from_raw_parts(data, size) })
    }

    /// `k4a_image_format_t`.
    pub fn format(&self) -> u32 {
        // SAFETY: the image is held.
        unsafe { (self.library.functions.image_get_format)(self.raw.as_ptr()) }
    }

    /// Width and height of the image's header; 0 for an invalid one.
    pub fn size(&self) -> (u32, u32) {
        let f = &self.library.functions;
        // SAFETY: the image is held.
        let (width, height) = unsafe {
            ((f.image_get_width_pixels)(self.raw.as_ptr()), (f.image_get_height_pixels)(self.raw.as_ptr()))
        };
        (u32::try_from(width).unwrap_or(0), u32::try_from(height).unwrap_or(0))
    }

    /// Bytes from one row to the next; 0 when that means nothing.
    pub fn stride(&self) -> usize {
        // SAFETY: the image is held.
        let stride = unsafe { (self.library.functions.image_get_stride_bytes)(self.raw.as_ptr()) };
        usize::try_from(stride).unwrap_or(0)
    }

    /// The device's clock at mid-exposure, microseconds.
    pub fn device_us(&self) -> u64 {
        // SAFETY: the image is held.
        unsafe { (self.library.functions.image_get_device_timestamp_usec)(self.raw.as_ptr()) }
    }

    /// `CLOCK_MONOTONIC` when the last byte had come over the USB, nanoseconds; 0 when it does not say.
    pub fn system_ns(&self) -> u64 {
        // SAFETY: the image is held.
        unsafe { (self.library.functions.image_get_system_timestamp_nsec)(self.raw.as_ptr()) }
    }

    /// Exposure, microseconds; 0 when it does not say.
    pub fn exposure_us(&self) -> u64 {
        // SAFETY: the image is held.
        unsafe { (self.library.functions.image_get_exposure_usec)(self.raw.as_ptr()) }
    }
}

impl Drop for Image<'_> {
    fn drop(&mut self) {
        // SAFETY: it is held, and given back here alone.
        unsafe { (self.library.functions.image_release)(self.raw.as_ptr()) }
    }
}
