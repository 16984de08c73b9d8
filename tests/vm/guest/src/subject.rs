//! An emulated D400 as a subject of the conformance suite, for either transport.

use crate::system;
use anyhow::Context;
use core::time::Duration;
use depthrig_bus::HostTime;
use depthrig_drivers::StreamRequest;
use depthrig_drivers::conformance::{Bench, Cannot, Rig, Sent, Subject, Trouble};
use depthrig_drivers::realsense::RealsenseBackend;
use depthrig_drivers::realsense::config::{RealsenseConfig, TransportChoice};
use depthrig_drivers::usb::{self, SysRoot};
use depthrig_drivers::v4l2::{FourCc, Node};
use depthrig_emulator::{Camera, Damage, Fault, Options, Stamp};
use std::sync::Arc;

/// How long a camera may take to be bound by its drivers.
const PATIENCE: Duration = Duration::from_secs(10);
/// Streams that are started: by their names in a rig, and by those of the emulator.
const STREAMS: [(&str, &str); 2] = [("depth", "depth"), ("color", "color")];
/// From mid-exposure to the last byte at most; capture times are late by it until the clock was probed.
const LATENCY_NS: u64 = 20_000_000;

/// An emulated camera of one model behind one transport.
pub struct EmulatedD400 {
    /// The emulator's name of the model.
    pub model: &'static str,
    /// Through which the back end reaches it.
    pub transport: TransportChoice,
}

impl Subject for EmulatedD400 {
    fn name(&self) -> String {
        let transport = match self.transport {
            TransportChoice::Libusb => "libusb",
            _ => "the kernel",
        };
        format!("realsense, an emulated {} through {transport}", self.model)
    }

    fn make(&self) -> Bench {
        let camera = match plug(self.model, Options { drift_ppm: 25.0, ..Options::default() }) {
            Ok(camera) => Arc::new(camera),
            // The suite has no way to say it, and nothing can be tested.
            Err(error) => panic!("no camera: {error:#}"),
        };
        let port = camera.port_path();
        let config = RealsenseConfig { port, transport: self.transport, ..RealsenseConfig::default() };
        let requests = STREAMS.iter().filter_map(|(stream, _)| small(stream)).collect();
        Bench {
            backend: Box::new(RealsenseBackend::new(config)),
            serial: camera.serial().to_owned(),
            requests,
            rig: Box::new(Hands { camera, transport: self.transport }),
        }
    }
}

/// A stream in a mode that costs the emulation little.
pub fn small(stream: &str) -> Option<StreamRequest> {
    let stream = depthrig_bus::Name::new(stream).ok()?;
    Some(StreamRequest { stream, size: Some((424, 240)), rate_hz: Some(30.0), format: None })
}

/// Plugs a camera in and waits until the kernel has made its nodes.
///
/// # Errors
/// When there is no such model, or its nodes do not come.
pub fn plug(model: &str, options: Options) -> anyhow::Result<Camera> {
    let camera = Camera::plug(model, options)?;
    let streams = camera.model().streams().count();
    let ready = || nodes_of(&camera).is_ok_and(|n| n.len() == 2 * streams);
    anyhow::ensure!(system::wait_until(PATIENCE, ready), "a {model} has {:?}", nodes_of(&camera));
    Ok(camera)
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
    transport: TransportChoice,
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

    /// Does it only where the back end sees the bytes itself.
    fn raw_frames(&self, damage: Damage, frames: u32) -> Result<(), Cannot> {
        if self.transport == TransportChoice::Libusb {
            self.frames(damage, frames)
        } else {
            Err(Cannot("uvcvideo drops such frames itself; the back end finds a gap in the frame counter"))
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
            Trouble::Hang(_) => Err(Cannot("no call of the back end waits for the camera without a limit")),
            Trouble::HalfFrame(n) => self.raw_frames(Damage::Short, n),
            Trouble::WrongSize(n) => self.raw_frames(Damage::Long, n),
            Trouble::Damaged(n) => self.raw_frames(Damage::ErrorBit, n),
            // A repeated frame does not toggle the frame bit, which uvcvideo takes for a stray payload.
            Trouble::Repeated(n) => self.raw_frames(Damage::Repeat, n),
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
        let (mut low, mut high) = (0, 1 << 32);
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
