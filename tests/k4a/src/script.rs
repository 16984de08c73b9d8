//! The functions by which a test commands the cameras of the library that it loaded.

use crate::abi::Configuration;
use crate::camera::{Camera, Ledger};
use crate::world::{Census, now, world};
use core::ffi::{CStr, c_char};

/// The text at `at`; empty if `at` is null.
///
/// # Safety
/// `at` must be null or end with a zero byte.
unsafe fn text<'a>(at: *const c_char) -> &'a str {
    if at.is_null() {
        return "";
    }
    // SAFETY: as the caller promises.
    unsafe { CStr::from_ptr(at) }.to_str().unwrap_or_default()
}

/// Commands the camera `serial`: `what` says what, `n` how long (nanoseconds) or how often. 0 when it was understood.
///
/// # Safety
/// Both texts must end with a zero byte.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fake_k4a_command(serial: *const c_char, what: *const c_char, n: u64) -> u32 {
    // SAFETY: as the caller promises.
    let (serial, what) = unsafe { (text(serial), text(what)) };
    let mut world = world();
    if what == "add" {
        world.cameras.push(Camera::new(serial));
        return 0;
    }
    let Some(camera) = world.cameras.iter_mut().find(|c| c.serial == serial) else { return 1 };
    let until = now() + n as i64;
    let t = &mut camera.troubles;
    match what {
        "unplug" => camera.absent_until = until,
        "busy" => camera.busy_until = until,
        "denied" => camera.denied = n != 0,
        "open_takes" => camera.open_takes_ns = n as i64,
        "stall" => t.stall_until = until,
        "hang" => t.hang_until = until,
        "stop_hang" => t.stop_hang_ns = n as i64,
        "close_hang" => t.close_hang_ns = n as i64,
        "half" => t.half += n,
        "wrong_size" => t.wrong_size += n,
        "damaged" => t.damaged += n,
        "repeated" => t.repeated += n,
        "skip" => t.skip += n,
        "engine" => t.engine = n,
        "only_color" => t.only_color += n,
        "only_depth" => t.only_depth += n,
        "no_host_stamp" => t.no_host_stamp += n,
        "padding" => t.padding = n,
        "needs_master" => t.needs_master = n != 0,
        "imu_skip" => t.imu_skip += n,
        "imu_ends" => t.imu_ends = n != 0,
        "wrong_format" => t.wrong_format += n,
        "clock_back" => camera.set_clock(Some(n as i64 / 1000)),
        "clock_reset" => camera.set_clock(None),
        "sync_in" => camera.jacks.0 = n != 0,
        "sync_out" => camera.jacks.1 = n != 0,
        _ => return 1,
    }
    0
}

/// Has the camera report `size` bytes at `at` as its calibration.
///
/// # Safety
/// `serial` must end with a zero byte, `at` be readable for `size` bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fake_k4a_calibration(serial: *const c_char, at: *const u8, size: usize) -> u32 {
    // SAFETY: as the caller promises.
    let (serial, bytes) = unsafe { (text(serial), core::slice::from_raw_parts(at, size)) };
    let mut world = world();
    let Some(camera) = world.cameras.iter_mut().find(|c| c.serial == serial) else { return 1 };
    camera.calibration = bytes.to_vec();
    0
}

/// Counts of the images of a stream (0 colour, 1 depth, 2 infrared) since it was last started.
///
/// # Safety
/// `serial` must end with a zero byte, `to` be writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fake_k4a_ledger(serial: *const c_char, stream: usize, to: *mut Ledger) -> u32 {
    // SAFETY: as the caller promises.
    let serial = unsafe { text(serial) };
    let world = world();
    let found = world.cameras.iter().find(|c| c.serial == serial);
    let Some(ledger) = found.and_then(|c| c.ledgers.get(stream)) else { return 1 };
    // SAFETY: as the caller promises.
    unsafe { to.write(*ledger) };
    0
}

/// True mid-exposure, nanoseconds of `CLOCK_MONOTONIC`, of the newest image that had arrived at `at`; 0 when the
/// camera does not stream.
///
/// # Safety
/// `serial` must end with a zero byte.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fake_k4a_exposed(serial: *const c_char, at: i64) -> i64 {
    // SAFETY: as the caller promises.
    let serial = unsafe { text(serial) };
    world().cameras.iter().find(|c| c.serial == serial).and_then(|c| c.exposed(at)).unwrap_or(0)
}

/// The value of a colour control of the camera; -1 when it is automatic, -2 when it was never set.
///
/// # Safety
/// `serial` must end with a zero byte.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fake_k4a_control(serial: *const c_char, command: u32) -> i32 {
    // SAFETY: as the caller promises.
    let serial = unsafe { text(serial) };
    let world = world();
    let set = world.cameras.iter().find(|c| c.serial == serial).and_then(|c| c.controls.get(&command));
    set.map_or(-2, |(auto, value)| if *auto { -1 } else { *value })
}

/// The command of the colour control that was set as number `i`; -1 when there were not so many.
///
/// # Safety
/// `serial` must end with a zero byte.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fake_k4a_set(serial: *const c_char, i: usize) -> i32 {
    // SAFETY: as the caller promises.
    let serial = unsafe { text(serial) };
    let world = world();
    let set = world.cameras.iter().find(|c| c.serial == serial).and_then(|c| c.set.get(i).copied());
    set.map_or(-1, |command| command as i32)
}

/// Writes the configuration that the camera streams with; returns nonzero if it does not stream.
///
/// # Safety
/// `serial` must end with a zero byte, `to` be writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fake_k4a_configuration(serial: *const c_char, to: *mut Configuration) -> u32 {
    // SAFETY: as the caller promises.
    let serial = unsafe { text(serial) };
    let world = world();
    let found = world.cameras.iter().find(|c| c.serial == serial);
    let Some(configuration) = found.and_then(Camera::configuration) else { return 1 };
    // SAFETY: as the caller promises.
    unsafe { to.write(configuration) };
    0
}

/// Counts of what was handed out and what came back.
///
/// # Safety
/// `to` must be writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn fake_k4a_census(to: *mut Census) {
    // SAFETY: as the caller promises.
    unsafe { to.write(world().census) };
}
