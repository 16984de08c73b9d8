//! Emulated cameras as subjects of the conformance suite: a D400 by either transport, a plain USB camera by the backend
//! `v4l2`.

use crate::checks::Checks;
use crate::system;
use anyhow::Context;
use core::time::Duration;
use depthrig_bus::{HostTime, PixelFormat};
use depthrig_driver::{Backend, StreamRequest};
use depthrig_emulator::{Camera, Damage, Fault, Options, Stamp};
use depthrig_realsense::RealsenseBackend;
use depthrig_realsense::config::{RealsenseConfig, TransportChoice};
use depthrig_sim::conformance::{Bench, Cannot, Rig, Sent, Subject, Trouble};
use depthrig_usb as usb;
use depthrig_usb::SysRoot;
use depthrig_v4l2::{FourCc, Node, V4l2Backend, V4l2Config};
use std::sync::Arc;

/// How long a camera may take to be bound by its drivers.
const TIMEOUT: Duration = Duration::from_secs(10);
/// Streams that are started: by their names in a rig, and by those of the emulator.
const STREAMS: [(&str, &str); 2] = [("depth", "depth"), ("color", "color")];
/// From mid-exposure to the last byte at most; capture times are late by it until the clock was probed.
const LATENCY_NS: u64 = 20_000_000;

/// Backend and transport for an emulated camera.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Way {
    /// The backend `realsense`.
    Realsense(TransportChoice),
    /// The backend `v4l2`.
    V4l2,
}

/// An emulated camera of one model behind one backend.
pub struct Emulated {
    /// The emulator's name of the model.
    pub model: &'static str,
    /// Backend and transport.
    pub way: Way,
}

impl Subject for Emulated {
    fn name(&self) -> String {
        let way = match self.way {
            Way::Realsense(TransportChoice::Libusb) => "realsense through libusb",
            Way::Realsense(_) => "realsense through the kernel",
            Way::V4l2 => "v4l2",
        };
        format!("{way}, an emulated {}", self.model)
    }

    fn make(&self) -> Bench {
        let camera = match plug(self.model, Options { drift_ppm: 25.0, ..Options::default() }) {
            Ok(camera) => Arc::new(camera),
            // The suite has no way to say it, and nothing can be tested.
            Err(error) => panic!("no camera: {error:#}"),
        };
        let port = camera.port_path();
        let backend: Box<dyn Backend> = match self.way {
            Way::Realsense(transport) => Box::new(RealsenseBackend::new(RealsenseConfig {
                port,
                transport,
                ..RealsenseConfig::default()
            })),
            Way::V4l2 => Box::new(V4l2Backend::new(V4l2Config { port, ..V4l2Config::default() })),
        };
        let request = match self.way {
            Way::Realsense(_) => small,
            Way::V4l2 => smallest,
        };
        Bench {
            backend,
            serial: camera.serial().to_owned(),
            requests: STREAMS.iter().filter_map(|(stream, _)| request(stream)).collect(),
            rig: Box::new(Hands { camera, way: self.way }),
        }
    }
}

/// A stream in a mode that costs the emulation little.
pub fn small(stream: &str) -> Option<StreamRequest> {
    let stream = depthrig_bus::Name::new(stream).ok()?;
    Some(StreamRequest { stream, size: Some((424, 240)), rate_hz: Some(30.0), format: None })
}

/// The smallest mode of the plain USB camera, unpacked.
fn smallest(stream: &str) -> Option<StreamRequest> {
    let format = if stream == "depth" { PixelFormat::Z16 } else { PixelFormat::Yuyv };
    Some(StreamRequest {
        size: Some((160, 120)),
        rate_hz: Some(60.0),
        format: Some(format),
        ..small(stream)?
    })
}

/// Plugs a camera in and waits until the kernel has made its nodes.
///
/// # Errors
/// When there is no such model, or its nodes do not come.
pub fn plug(model: &str, options: Options) -> anyhow::Result<Camera> {
    let camera = Camera::plug(model, options)?;
    let streams = camera.model().streams().count();
    let ready = || nodes_of(&camera).is_ok_and(|n| n.len() == 2 * streams);
    anyhow::ensure!(system::wait_until(TIMEOUT, ready), "a {model} has {:?}", nodes_of(&camera));
    Ok(camera)
}

/// Waits until the kernel has both sensors as devices of its industrial I/O.
pub fn wait_for_imu(checks: &mut Checks, model: &str) {
    let count = || {
        std::fs::read_dir("/sys/bus/iio/devices").map_or(0, |all| {
            all.flatten().filter(|e| e.file_name().to_string_lossy().starts_with("iio:device")).count()
        })
    };
    let there = system::wait_until(Duration::from_secs(10), || count() == 2);
    checks.that(&format!("{model}: the kernel's sensor hub has both sensors"), there, count());
}

/// The video nodes of a camera that can be opened.
fn nodes_of(camera: &Camera) -> anyhow::Result<Vec<std::path::PathBuf>> {
    let port = camera.port_path().context("the kernel has not seen it")?;
    let device = usb::scan(&SysRoot::default())?.into_iter().find(|d| d.port == port);
    let device = device.with_context(|| format!("nothing at port {port}"))?;
    Ok(device.video_nodes().map(|n| n.path.clone()).filter(|p| Node::open(p).is_ok()).collect())
}

struct Hands {
    camera: Arc<Camera>,
    way: Way,
}

impl Hands {
    fn frames(&self, damage: Damage, frames: u32) -> Result<(), Cannot> {
        for (_, stream) in STREAMS {
            self.fault(Fault::Frames { stream: stream.to_owned(), damage, frames })?;
        }
        Ok(())
    }

    fn fault(&self, fault: Fault) -> Result<(), Cannot> {
        self.camera.fault(fault).map_err(|_| Cannot("the emulated camera does not take the fault"))
    }

    /// Does it only where the backend sees the bytes itself.
    fn raw_frames(&self, damage: Damage, frames: u32) -> Result<(), Cannot> {
        if self.way == Way::Realsense(TransportChoice::Libusb) {
            self.frames(damage, frames)
        } else {
            Err(Cannot("uvcvideo drops such frames itself; the backend finds a gap in the frame counter"))
        }
    }
}

impl Rig for Hands {
    fn cause(&self, trouble: Trouble) -> Result<(), Cannot> {
        match trouble {
            Trouble::Unplug(time) => {
                self.camera.unplug_for(time).map_err(|_| Cannot("the emulated camera cannot be unplugged"))
            }
            Trouble::Stall(time) => {
                self.fault(Fault::Silence)?;
                let camera = Arc::clone(&self.camera);
                std::thread::spawn(move || {
                    std::thread::sleep(time);
                    // A camera that is gone by now stalls no more.
                    let _ = camera.fault(Fault::Clear);
                });
                Ok(())
            }
            Trouble::Hang(_) => Err(Cannot("no call of the backend waits for the camera without a limit")),
            Trouble::HalfFrame(n) => self.raw_frames(Damage::Short, n),
            Trouble::WrongSize(n) => self.raw_frames(Damage::Long, n),
            Trouble::Damaged(n) => self.raw_frames(Damage::ErrorBit, n),
            // A repeated frame does not toggle the frame bit, which uvcvideo takes for a stray payload.
            Trouble::Repeated(n) => self.raw_frames(Damage::Repeat, n),
            // Without a counter of the camera's own nobody knows of a frame that was never sent; the kernel counts those that
            // it throws away.
            Trouble::Skip(n) if self.way == Way::V4l2 => self.frames(Damage::ErrorBit, n),
            Trouble::Skip(n) => self.frames(Damage::Skip, n),
            Trouble::TimeBackwards(time) => self.fault(Fault::ClockJump(-(time.as_micros() as i64))),
            Trouble::ClockReset => self.fault(Fault::ClockReset),
            Trouble::Busy(time) => hold(&self.camera, time),
        }
    }

    /// Frames are on their way while the books are compared; the scenario `realsense-accounts` compares them at rest.
    fn sent(&self, _: usize) -> Option<Sent> {
        None
    }

    fn true_capture(&self, stream: usize, arrival: HostTime) -> Option<(HostTime, u64)> {
        let (_, name) = STREAMS.get(stream)?;
        let at = |index: u64| self.camera.true_capture(name, index).ok();
        // The newest frame that was captured before: one is on its way for less than a period.
        let mut low = 0;
        let mut high = 1 << 32;
        while high - low > 1 {
            let middle = u64::midpoint(low, high);
            if at(middle)? <= arrival { low = middle } else { high = middle }
        }
        Some((at(low)?, LATENCY_NS))
    }

    fn is_genuine(&self, stream: usize, pixels: &[u8]) -> Option<bool> {
        let (_, name) = STREAMS.get(stream)?;
        let Some(stamp) = Stamp::read(pixels) else { return Some(false) };
        Some(self.camera.expected(name, stamp.index).is_ok_and(|bytes| bytes == pixels))
    }
}

/// Somebody else streams from the camera for a while: through the kernel's node that means setting its mode.
fn hold(camera: &Camera, time: Duration) -> Result<(), Cannot> {
    let take = || -> anyhow::Result<Node> {
        for path in nodes_of(camera)? {
            let node = Node::open(&path)?;
            if let Some(mode) = node.modes(|f| f == FourCc(*b"Z16 "))?.first() {
                node.set_mode(mode)?;
                return Ok(node);
            }
        }
        anyhow::bail!("it has no depth node")
    };
    let node = take().map_err(|_| Cannot("nobody can hold the camera"))?;
    std::thread::spawn(move || {
        std::thread::sleep(time);
        drop(node);
    });
    Ok(())
}
