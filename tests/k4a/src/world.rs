//! Every camera and everything that was handed out, behind one lock.

use crate::camera::{Camera, Image};
use core::ffi::{c_char, c_int, c_void};
use std::collections::BTreeMap;
use std::sync::{Mutex, MutexGuard, PoisonError};

/// `k4a_logging_message_cb_t`.
pub type MessageHandler = unsafe extern "C" fn(*mut c_void, u32, *const c_char, c_int, *const c_char);

/// Counts of what was handed out and what came back.
#[derive(Debug, Clone, Copy, Default)]
#[repr(C)]
pub struct Census {
    /// Cameras that are open.
    pub cameras: u64,
    /// Captures that are held.
    pub captures: u64,
    /// Images that are held.
    pub images: u64,
    /// Captures ever handed out.
    pub all_captures: u64,
    /// Images ever handed out.
    pub all_images: u64,
    /// Calls with an invalid or released handle; and stops and closes of a camera whose images are held.
    pub misuse: u64,
}

/// The object of a handle.
pub enum Thing {
    Camera {
        serial: String,
        is_dead: bool,
    },
    /// `of` is the handle of the camera that it came from.
    Capture {
        references: u32,
        of: usize,
        images: [Option<usize>; 3],
    },
    Image {
        references: u32,
        of: usize,
        image: Image,
    },
}

#[derive(Default)]
pub struct World {
    pub cameras: Vec<Camera>,
    pub things: BTreeMap<usize, Thing>,
    last_handle: usize,
    pub census: Census,
    pub handler: Option<(MessageHandler, usize)>,
    is_set_up: bool,
}

static WORLD: Mutex<World> = Mutex::new(World {
    cameras: Vec::new(),
    things: BTreeMap::new(),
    last_handle: 0,
    census: Census { cameras: 0, captures: 0, images: 0, all_captures: 0, all_images: 0, misuse: 0 },
    handler: None,
    is_set_up: false,
});

/// The world; its cameras are those of the environment until a test makes others.
pub fn world() -> MutexGuard<'static, World> {
    let mut world = WORLD.lock().unwrap_or_else(PoisonError::into_inner);
    if !core::mem::replace(&mut world.is_set_up, true) {
        let listed = std::env::var("DEPTHRIG_FAKE_K4A").unwrap_or_default();
        let serials = listed.split(',').map(str::trim).filter(|s| !s.is_empty());
        world.cameras = serials.map(Camera::new).collect();
    }
    world
}

/// `CLOCK_MONOTONIC`, nanoseconds.
pub fn now() -> i64 {
    let t = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    t.tv_sec * 1_000_000_000 + t.tv_nsec
}

impl World {
    /// A handle for `thing`.
    pub fn hand_out(&mut self, thing: Thing) -> usize {
        // Far apart, so that a handle that was computed with is invalid.
        self.last_handle += 0x1000;
        self.things.insert(self.last_handle, thing);
        self.last_handle
    }

    /// Notes a call with an invalid handle.
    pub fn misuse<T>(&mut self) -> Option<T> {
        self.census.misuse += 1;
        None
    }

    /// The camera behind an open handle, if it has not been pulled out since.
    pub fn camera(&mut self, handle: usize) -> Option<&mut Camera> {
        let now = now();
        let Some(Thing::Camera { serial, is_dead }) = self.things.get_mut(&handle) else {
            return self.misuse();
        };
        let camera = self.cameras.iter_mut().find(|c| c.serial == *serial)?;
        *is_dead |= camera.absent_until > now;
        (!*is_dead).then_some(camera)
    }

    /// The cameras that are plugged in.
    pub fn present(&self) -> Vec<usize> {
        let now = now();
        (0..self.cameras.len()).filter(|i| self.cameras[*i].absent_until <= now).collect()
    }

    /// Notes a stop or close of a camera while something is held that came from it.
    pub fn note_if_held(&mut self, camera: usize) {
        let is_held = |thing: &Thing| matches!(thing, Thing::Capture { of, .. } | Thing::Image { of, .. } if *of == camera);
        if self.things.values().any(is_held) {
            self.census.misuse += 1;
        }
    }

    /// Gives one reference of an image back.
    pub fn release_image(&mut self, handle: usize) {
        match self.things.get_mut(&handle) {
            Some(Thing::Image { references, .. }) if *references > 1 => *references -= 1,
            Some(Thing::Image { .. }) => {
                self.things.remove(&handle);
                self.census.images -= 1;
            }
            _ => self.census.misuse += 1,
        }
    }

    /// Gives one reference of a capture back, and with the last its own of its images.
    pub fn release_capture(&mut self, handle: usize) {
        let images = match self.things.get_mut(&handle) {
            Some(Thing::Capture { references, .. }) if *references > 1 => {
                *references -= 1;
                return;
            }
            Some(Thing::Capture { images, .. }) => *images,
            _ => {
                self.census.misuse += 1;
                return;
            }
        };
        self.things.remove(&handle);
        self.census.captures -= 1;
        images.into_iter().flatten().for_each(|i| self.release_image(i));
    }
}

/// Sends a message to the registered callback, as the real library does: without its own lock on the cameras.
pub fn say(level: u32, message: &str) {
    let handler = world().handler;
    let Ok(text) = std::ffi::CString::new(message) else { return };
    match handler {
        // SAFETY: the caller of `k4a_set_debug_message_handler` promises that both are good until others are set; the
        // text ends with a zero byte.
        Some((handler, context)) => unsafe {
            handler(context as *mut c_void, level, c"fake.rs".as_ptr(), 1, text.as_ptr());
        },
        // As the real library does, which is why the driver sets a handler.
        None => println!("[error] {message}"),
    }
}
