//! The C functions of the header that a program needs which reads images.
//!
//! More than 500 lines, because they are one interface, function by function as the header has them.

use crate::abi::{self, Configuration, FAILED, ImuSample, LOG_ERROR, SUCCEEDED, TIMEOUT, TOO_SMALL};
use crate::camera::{Camera, Image, Moved, Step};
use crate::world::{MessageHandler, Thing, now, say, world};
use core::ffi::{c_char, c_int};
use core::time::Duration;

type Handle = *mut core::ffi::c_void;

/// Colour controls: command, whether it can be automatic, least, greatest, step, default.
const CONTROLS: [(u32, bool, i32, i32, i32, i32); 9] = [
    (0, true, 500, 133_330, 1, 16_670),
    (2, false, 0, 255, 1, 128),
    (3, false, 0, 10, 1, 5),
    (4, false, 0, 63, 1, 32),
    (5, false, 0, 4, 1, 2),
    (6, true, 2500, 12_500, 10, 4500),
    (7, false, 0, 1, 1, 0),
    (8, false, 0, 255, 1, 128),
    (9, false, 1, 2, 1, 2),
];
/// Exposures that the camera has, microseconds; it takes the next longer one.
const EXPOSURES: [i32; 8] = [500, 1250, 2500, 8330, 16_670, 33_330, 66_670, 133_330];

fn fails(message: &str) -> u32 {
    say(LOG_ERROR, message);
    FAILED
}

/// Waits until the moment `until`.
fn sleep_until(until: i64) {
    if let Ok(left) = u64::try_from(until - now()) {
        std::thread::sleep(Duration::from_nanos(left));
    }
}

/// # Safety
/// None is needed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn k4a_device_get_installed_count() -> u32 {
    world().present().len() as u32
}

/// # Safety
/// `handler` may be called with `context` until another is set.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn k4a_set_debug_message_handler(
    handler: Option<MessageHandler>,
    context: Handle,
    _level: u32,
) -> u32 {
    let mut world = world();
    match (world.handler, handler) {
        (Some((had, _)), Some(new)) if !core::ptr::fn_addr_eq(had, new) => return FAILED,
        _ => world.handler = handler.map(|h| (h, context as usize)),
    }
    SUCCEEDED
}

/// # Safety
/// `handle` must be writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn k4a_device_open(index: u32, handle: *mut Handle) -> u32 {
    let mut world = world();
    let now = now();
    let found = world.present().get(index as usize).copied();
    let Some(camera) = found.map(|i| &mut world.cameras[i]) else {
        drop(world);
        return fails("usb_cmd_create(). Unable to open LIBUSB at index: LIBUSB_ERROR_NO_DEVICE");
    };
    let refused = if camera.denied {
        Some("libusb device(s) are all unavalable. Is the device being used by another application?")
    } else if camera.open.is_some() || camera.busy_until > now {
        Some("usb_cmd_create (421): libusb_claim_interface returned LIBUSB_ERROR_BUSY in usb_cmd_create")
    } else {
        None
    };
    if let Some(why) = refused {
        drop(world);
        return fails(why);
    }
    let serial = camera.serial.clone();
    let takes_ns = camera.open_takes_ns;
    let new = world.hand_out(Thing::Camera { serial: serial.clone(), is_dead: false });
    world.census.cameras += 1;
    if let Some(camera) = world.cameras.iter_mut().find(|c| c.serial == serial) {
        camera.open = Some(new);
        camera.running = None;
    }
    drop(world);
    sleep_until(now + takes_ns);
    // SAFETY: the caller promises that it is writable.
    unsafe { handle.write(new as Handle) };
    SUCCEEDED
}

/// # Safety
/// None is needed: a handle is a number.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn k4a_device_close(handle: Handle) {
    let at = handle as usize;
    let mut world = world();
    let Some(Thing::Camera { serial, .. }) = world.things.get(&at) else {
        world.census.misuse += 1;
        return;
    };
    let serial = serial.clone();
    let hang = world.cameras.iter_mut().find(|c| c.serial == serial && c.open == Some(at)).map(|camera| {
        camera.running = None;
        core::mem::take(&mut camera.troubles.close_hang_ns)
    });
    world.note_if_held(at);
    drop(world);
    if let Some(ns) = hang.filter(|ns| *ns > 0) {
        sleep_until(now() + ns);
    }
    let mut world = crate::world::world();
    world.things.remove(&at);
    world.census.cameras -= 1;
    if let Some(camera) = world.cameras.iter_mut().find(|c| c.open == Some(at)) {
        camera.open = None;
    }
}

/// # Safety
/// `capture` must be writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn k4a_device_get_capture(
    handle: Handle,
    capture: *mut Handle,
    timeout_ms: i32,
) -> u32 {
    let deadline = if timeout_ms < 0 { i64::MAX } else { now() + i64::from(timeout_ms) * 1_000_000 };
    loop {
        let mut world = world();
        let now = now();
        let has_master = world.cameras.iter().any(|c| c.absent_until <= now && c.plays(1));
        let next = |c: &mut Camera| {
            // A subordinate takes its images by the master's pulse.
            let waits = c.plays(2) && c.troubles.needs_master && !has_master;
            if waits { Some(Step::Wait(now + 5_000_000)) } else { c.step(now) }
        };
        let Some(step) = world.camera(handle as usize).and_then(next) else {
            drop(world);
            return fails(
                "usb_stream_callback(). LibUSB transfer status of LIBUSB_TRANSFER_NO_DEVICE unexpected",
            );
        };
        match step {
            Step::Ready(ready) => {
                let of = handle as usize;
                let mut images = [None; 3];
                for (stream, image) in ready {
                    images[stream] = Some(world.hand_out(Thing::Image { references: 1, of, image }));
                    world.census.images += 1;
                }
                let new = world.hand_out(Thing::Capture { references: 1, of, images });
                world.census.captures += 1;
                world.census.all_captures += 1;
                // SAFETY: the caller promises that it is writable.
                unsafe { capture.write(new as Handle) };
                return SUCCEEDED;
            }
            Step::Hang(until) => {
                drop(world);
                sleep_until(until);
            }
            Step::Wait(until) => {
                drop(world);
                if now >= deadline {
                    return TIMEOUT;
                }
                // Short naps, because a test may change what comes next.
                sleep_until(until.min(deadline).min(now + 5_000_000));
            }
        }
    }
}

/// # Safety
/// `configuration` must be readable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn k4a_device_start_cameras(
    handle: Handle,
    configuration: *const Configuration,
) -> u32 {
    // SAFETY: the caller promises that it is readable; every bit pattern is a value of its fields.
    let Some(configuration) = (unsafe { configuration.as_ref() }) else { return FAILED };
    let mut world = world();
    let started = world.camera(handle as usize).map(|c| c.start(configuration, now()));
    drop(world);
    match started {
        Some(Ok(())) => SUCCEEDED,
        Some(Err(why)) => fails(&why),
        None => fails("depthmcu_depth_start_streaming(). LIBUSB_ERROR_NO_DEVICE"),
    }
}

/// # Safety
/// None is needed: a handle is a number.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn k4a_device_stop_cameras(handle: Handle) {
    let mut world = world();
    // The real one waits for its images for good.
    world.note_if_held(handle as usize);
    let hang = world.camera(handle as usize).map(|c| {
        c.running = None;
        core::mem::take(&mut c.troubles.stop_hang_ns)
    });
    drop(world);
    if let Some(ns) = hang.filter(|ns| *ns > 0) {
        sleep_until(now() + ns);
    }
}

/// # Safety
/// None is needed: a handle is a number.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn k4a_device_start_imu(handle: Handle) -> u32 {
    let mut world = world();
    let started = world.camera(handle as usize).map(|c| c.start_imu(now()));
    drop(world);
    match started {
        Some(Ok(())) => SUCCEEDED,
        Some(Err(why)) => fails(&why),
        None => fails("colormcu_imu_start_streaming(). LIBUSB_ERROR_NO_DEVICE"),
    }
}

/// # Safety
/// None is needed: a handle is a number.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn k4a_device_stop_imu(handle: Handle) {
    if let Some(camera) = world().camera(handle as usize) {
        camera.stop_imu();
    }
}

/// # Safety
/// `sample` must be writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn k4a_device_get_imu_sample(
    handle: Handle,
    sample: *mut ImuSample,
    timeout_ms: i32,
) -> u32 {
    let deadline = if timeout_ms < 0 { i64::MAX } else { now() + i64::from(timeout_ms) * 1_000_000 };
    loop {
        let mut world = world();
        let now = now();
        let step = world.camera(handle as usize).and_then(|c| c.imu_step(now));
        drop(world);
        match step {
            Some(Moved::Sample(found)) => {
                // SAFETY: the caller promises that it is writable.
                unsafe { sample.write(found) };
                return SUCCEEDED;
            }
            Some(Moved::Wait(_)) if now >= deadline => return TIMEOUT,
            Some(Moved::Wait(until)) => sleep_until(until.min(deadline).min(now + 5_000_000)),
            Some(Moved::Over) | None => return fails("imu_get_sample(). queue_pop failed: it was stopped"),
        }
    }
}

/// Hands `text` over as the header says: its size first, then the text.
///
/// # Safety
/// `size` must be readable and writable, `to` null or writable for so many bytes.
unsafe fn give(text: &[u8], to: *mut u8, size: *mut usize) -> u32 {
    // SAFETY: the caller promises both.
    unsafe {
        let has = size.read();
        size.write(text.len());
        if to.is_null() || has < text.len() {
            return TOO_SMALL;
        }
        to.copy_from_nonoverlapping(text.as_ptr(), text.len());
    }
    SUCCEEDED
}

/// # Safety
/// As the header says: `size` is read and written, and `to` has so many bytes or is null.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn k4a_device_get_serialnum(handle: Handle, to: *mut c_char, size: *mut usize) -> u32 {
    let mut world = world();
    let Some(camera) = world.camera(handle as usize) else { return FAILED };
    let text = [camera.serial.as_bytes(), &[0]].concat();
    // SAFETY: as the caller promises.
    unsafe { give(&text, to.cast(), size) }
}

/// # Safety
/// As the header says: `size` is read and written, and `to` has so many bytes or is null.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn k4a_device_get_raw_calibration(
    handle: Handle,
    to: *mut u8,
    size: *mut usize,
) -> u32 {
    let mut world = world();
    let Some(camera) = world.camera(handle as usize) else { return FAILED };
    // SAFETY: as the caller promises.
    unsafe { give(&camera.calibration, to, size) }
}

/// # Safety
/// `version` must be writable: 14 numbers of 32 bits.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn k4a_device_get_version(handle: Handle, version: *mut [u32; 14]) -> u32 {
    if world().camera(handle as usize).is_none() {
        return FAILED;
    }
    let numbers = [1, 6, 110, 1, 6, 79, 1, 6, 14, 6109, 7, 0, 0, 0];
    // SAFETY: as the caller promises.
    unsafe { version.write(numbers) };
    SUCCEEDED
}

/// # Safety
/// Both must be writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn k4a_device_get_sync_jack(handle: Handle, into: *mut bool, out: *mut bool) -> u32 {
    let mut world = world();
    let Some(camera) = world.camera(handle as usize) else { return FAILED };
    // SAFETY: as the caller promises.
    unsafe {
        into.write(camera.jacks.0);
        out.write(camera.jacks.1);
    }
    SUCCEEDED
}

/// # Safety
/// All but the first two must be writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn k4a_device_get_color_control_capabilities(
    handle: Handle,
    command: u32,
    has_auto: *mut bool,
    min: *mut i32,
    max: *mut i32,
    step: *mut i32,
    default: *mut i32,
    mode: *mut u32,
) -> u32 {
    if world().camera(handle as usize).is_none() {
        return FAILED;
    }
    let Some(c) = CONTROLS.iter().find(|c| c.0 == command) else {
        return fails("color_get_control_capabilities(). Unsupported control");
    };
    // SAFETY: as the caller promises.
    unsafe {
        has_auto.write(c.1);
        min.write(c.2);
        max.write(c.3);
        step.write(c.4);
        default.write(c.5);
        mode.write(u32::from(!c.1));
    }
    SUCCEEDED
}

/// # Safety
/// `mode` and `value` must be writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn k4a_device_get_color_control(
    handle: Handle,
    command: u32,
    mode: *mut u32,
    value: *mut i32,
) -> u32 {
    let mut world = world();
    let Some(camera) = world.camera(handle as usize) else { return FAILED };
    let Some(c) = CONTROLS.iter().find(|c| c.0 == command) else { return FAILED };
    let (auto, number) = camera.controls.get(&command).copied().unwrap_or((c.1, c.5));
    // SAFETY: as the caller promises.
    unsafe {
        mode.write(u32::from(!auto));
        value.write(number);
    }
    SUCCEEDED
}

/// # Safety
/// None is needed: a handle is a number.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn k4a_device_set_color_control(
    handle: Handle,
    command: u32,
    mode: u32,
    value: i32,
) -> u32 {
    let mut world = world();
    let Some(camera) = world.camera(handle as usize) else { return FAILED };
    let Some(c) = CONTROLS.iter().find(|c| c.0 == command) else { return FAILED };
    let auto = mode == 0;
    if auto && !c.1 || !auto && !(c.2..=c.3).contains(&value) {
        drop(world);
        return fails("color_set_control(). Invalid argument");
    }
    let value = match command {
        0 if !auto => EXPOSURES.into_iter().find(|e| *e >= value).unwrap_or(133_330),
        _ => value,
    };
    camera.controls.insert(command, (auto, value));
    camera.set.push(command);
    SUCCEEDED
}

/// # Safety
/// None is needed: a handle is a number.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn k4a_capture_release(handle: Handle) {
    world().release_capture(handle as usize);
}

fn image_of(handle: Handle, stream: usize) -> Handle {
    let mut world = world();
    let Some(Thing::Capture { images, .. }) = world.things.get(&(handle as usize)) else {
        world.census.misuse += 1;
        return core::ptr::null_mut();
    };
    let Some(image) = images[stream] else { return core::ptr::null_mut() };
    world.census.all_images += 1;
    if let Some(Thing::Image { references, .. }) = world.things.get_mut(&image) {
        *references += 1;
    }
    image as Handle
}

/// # Safety
/// None is needed: a handle is a number.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn k4a_capture_get_color_image(handle: Handle) -> Handle {
    image_of(handle, 0)
}

/// # Safety
/// None is needed: a handle is a number.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn k4a_capture_get_depth_image(handle: Handle) -> Handle {
    image_of(handle, 1)
}

/// # Safety
/// None is needed: a handle is a number.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn k4a_capture_get_ir_image(handle: Handle) -> Handle {
    image_of(handle, 2)
}

/// # Safety
/// None is needed: a handle is a number.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn k4a_capture_get_temperature_c(handle: Handle) -> f32 {
    let mut world = world();
    if let Some(Thing::Capture { .. }) = world.things.get(&(handle as usize)) {
        31.5
    } else {
        world.census.misuse += 1;
        f32::NAN
    }
}

/// # Safety
/// None is needed: a handle is a number.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn k4a_image_release(handle: Handle) {
    world().release_image(handle as usize);
}

fn of_image<T>(handle: Handle, otherwise: T, read: impl FnOnce(&Image) -> T) -> T {
    let mut world = world();
    if let Some(Thing::Image { image, .. }) = world.things.get(&(handle as usize)) {
        read(image)
    } else {
        world.census.misuse += 1;
        otherwise
    }
}

/// # Safety
/// The result may be read for as long as the image is held.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn k4a_image_get_buffer(handle: Handle) -> *mut u8 {
    of_image(handle, core::ptr::null_mut(), |p| {
        p.bytes.as_ref().map_or(core::ptr::null_mut(), |b| b.as_ptr().cast_mut())
    })
}

/// # Safety
/// None is needed: a handle is a number.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn k4a_image_get_size(handle: Handle) -> usize {
    of_image(handle, 0, |p| p.bytes.as_ref().map_or(1, |b| b.len()))
}

/// # Safety
/// None is needed: a handle is a number.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn k4a_image_get_format(handle: Handle) -> u32 {
    of_image(handle, 8, |p| p.format)
}

/// # Safety
/// None is needed: a handle is a number.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn k4a_image_get_width_pixels(handle: Handle) -> c_int {
    of_image(handle, 0, |p| p.size.0 as c_int)
}

/// # Safety
/// None is needed: a handle is a number.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn k4a_image_get_height_pixels(handle: Handle) -> c_int {
    of_image(handle, 0, |p| p.size.1 as c_int)
}

/// # Safety
/// None is needed: a handle is a number.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn k4a_image_get_stride_bytes(handle: Handle) -> c_int {
    of_image(handle, 0, |p| p.stride as c_int)
}

/// # Safety
/// None is needed: a handle is a number.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn k4a_image_get_device_timestamp_usec(handle: Handle) -> u64 {
    of_image(handle, 0, |p| p.device_us)
}

/// # Safety
/// None is needed: a handle is a number.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn k4a_image_get_system_timestamp_nsec(handle: Handle) -> u64 {
    of_image(handle, 0, |p| p.system_ns)
}

/// # Safety
/// None is needed: a handle is a number.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn k4a_image_get_exposure_usec(handle: Handle) -> u64 {
    of_image(handle, 0, |p| p.exposure_us)
}

/// The symbol of a depth engine, so that a copy of this file can stand for one. It is never called.
///
/// # Safety
/// None is needed.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn k4a_register_plugin() -> bool {
    false
}

const _: () = assert!(size_of::<Configuration>() == 36 && abi::FAILED == 1 && size_of::<Camera>() > 0);
