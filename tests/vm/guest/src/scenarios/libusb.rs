//! The libusb path against the kernel's usbfs: bulk transfers, faults on the bus, and the kernel's driver afterwards.

mod daemon;
mod end;
mod faults;
mod seven;

use crate::checks::Checks;
use crate::{Scenario, system};
use anyhow::Context;
use depthrig_bus::HostTime;
use depthrig_driver::{Error, ErrorKind};
use depthrig_emulator as emulator;
use depthrig_libusb::{Camera, Port, Settings, Source, StreamMode};
use depthrig_realsense::VendorBulk;
use depthrig_realsense::protocol::gvd::Gvd;
use depthrig_usb as usb;
use depthrig_usb::uvc::control::ControlPort;
use depthrig_usb::uvc::formats::FourCc;
use depthrig_usb::video::ImageSource;
use depthrig_usb::{SysRoot, UsbDevice};
use emulator::content::STAMP;
use emulator::{Options, Stamp};
use std::collections::BTreeMap;
use std::time::Duration;

pub use daemon::SCENARIO as DAEMON;
pub use end::SCENARIO as END;
pub use seven::SCENARIO as SEVEN;

/// See the module.
pub const SCENARIO: Scenario = Scenario {
    name: "libusb",
    about: "a D435 through libusb: frames byte by byte, controls, vendor channel, damaged frames, stall, silence, unplug",
    cost: 2,
    limit_s: 90,
    needs: "",
    run,
};

const TIMEOUT: Duration = Duration::from_secs(5);

/// Streaming interface, format and the emulator's name of a D435's streams.
const DEPTH: (u8, FourCc, &str) = (1, FourCc::Z16, "depth");
const COLOR: (u8, FourCc, &str) = (4, FourCc(*b"YUYV"), "color");

fn run(checks: &mut Checks) -> anyhow::Result<()> {
    load()?;
    let device = emulator::Camera::plug("d435", Options::default())?;
    checks.that("the kernel's driver has it first", nodes_become(6), format!("{:?}", system::video_nodes()?));
    let camera = Camera::open(&SysRoot::default(), &usb_device(&device)?)?;
    checks.that(
        "taken through libusb, its nodes go",
        nodes_become(0),
        format!("{:?}", system::video_nodes()?),
    );
    identity(checks, &device, &camera)?;
    let truth = &mut Truth::default();
    clean(checks, &device, truth, &camera)?;
    faults::run(checks, &device, truth, &camera)?;
    faults::unplug(checks, &device, truth, camera)
}

/// Loads the kernel modules that every scenario here needs.
fn load() -> anyhow::Result<()> {
    system::modprobe("vhci-hcd", &[])?;
    system::modprobe("uvcvideo", &[])
}

/// The camera as the kernel lists it.
fn usb_device(device: &emulator::Camera) -> anyhow::Result<UsbDevice> {
    let port = device.port_path().context("the kernel has not seen the camera")?;
    usb::scan(&SysRoot::default())?.into_iter().find(|d| d.port == port).context("it is not in the list")
}

fn nodes_become(count: usize) -> bool {
    system::wait_until(TIMEOUT, || system::video_nodes().is_ok_and(|nodes| nodes.len() == count))
}

/// The smallest mode of both streams: every byte that moves costs the host.
const fn small((interface, format, _): (u8, FourCc, &str)) -> StreamMode {
    StreamMode { interface, format, width: 424, height: 240, rate_hz: 30.0 }
}

/// Contents of the frames of a camera's streams behind their stamps, computed once for each stream.
#[derive(Default)]
struct Truth(BTreeMap<String, Vec<u8>>);

impl Truth {
    /// The index of a frame of stream `name`, if it is byte for byte what was sent.
    fn index(&mut self, device: &emulator::Camera, name: &str, bytes: &[u8]) -> Option<u64> {
        let stamp = Stamp::read(bytes)?;
        if !self.0.contains_key(name) {
            self.0.insert(name.to_owned(), device.expected(name, stamp.index).ok()?);
        }
        let whole = self.0.get(name)?;
        let same = bytes.len() == whole.len() && bytes.get(STAMP..) == whole.get(STAMP..);
        (same && stamp.serial_hash == device.serial_hash()).then_some(stamp.index)
    }
}

/// An image that came: everything but the pixels, which are compared at once.
struct Seen {
    source: usize,
    sequence: u64,
    /// The index of the frame at the emulator; `None` when it is not byte for byte what was sent.
    index: Option<u64>,
    bytes: usize,
    header: usize,
    damaged: bool,
}

/// Takes images of `streams` until `frames` have come of each, or timeout ends.
fn take(
    device: &emulator::Camera,
    truth: &mut Truth,
    source: &mut Source,
    streams: &[&str],
    frames: usize,
) -> Result<Vec<Seen>, Error> {
    let mut seen: Vec<Seen> = Vec::new();
    let end = HostTime::now().plus(TIMEOUT);
    let all_here =
        |seen: &[Seen]| (0..streams.len()).all(|s| seen.iter().filter(|p| p.source == s).count() >= frames);
    while !all_here(&seen) && HostTime::now() < end {
        source.poll(Duration::from_millis(100), &mut |image| {
            seen.push(Seen {
                source: image.source,
                sequence: image.sequence,
                index: truth.index(device, streams[image.source], image.bytes),
                bytes: image.bytes.len(),
                header: image.header.map_or(0, <[u8]>::len),
                damaged: image.damaged,
            });
        })?;
    }
    Ok(seen)
}

fn identity(checks: &mut Checks, device: &emulator::Camera, camera: &Camera) -> anyhow::Result<()> {
    let configuration = camera.configuration();
    let numbers: Vec<_> = configuration.streams.iter().map(|s| s.number).collect();
    checks.equal("its streaming interfaces are read from its descriptor", numbers, vec![1, 2, 4]);
    let mut monitor = VendorBulk::new(camera)?;
    let gvd = Gvd::read(&mut monitor)?;
    checks.equal("the vendor's channel gives the serial", gvd.serial.as_str(), device.serial());
    let mut port = Port::new(camera, 0)?;
    checks.equal("the extension unit says its length", port.length(3, 1)?, 1024);
    let kind = |result: Result<usize, Error>| result.err().map(|e| e.kind());
    let nothing = port.length(3, 0x7F);
    checks.that("a missing control is reported", nothing.is_err(), format!("{nothing:?}"));
    checks.equal("and its kind", kind(nothing), Some(ErrorKind::Unsupported));
    checks.equal("a unit that is not there", kind(port.length(99, 1)), Some(ErrorKind::Unsupported));
    let second = Camera::open(&SysRoot::default(), &usb_device(device)?);
    let text = second.as_ref().err().map_or_else(String::new, ToString::to_string);
    checks.that("a second opening is refused with its holder", text.contains("in use"), text);
    Ok(())
}

/// Depth and colour at once, twice: nothing is lost, every byte is right, and the device is asked to stop.
fn clean(
    checks: &mut Checks,
    device: &emulator::Camera,
    truth: &mut Truth,
    camera: &Camera,
) -> anyhow::Result<()> {
    for round in 1..=2 {
        let mut source = Source::start(camera, &[small(DEPTH), small(COLOR)], Settings::default())?;
        let seen = take(device, truth, &mut source, &["depth", "color"], 10)?;
        for (s, (name, header)) in [("depth", 232), ("color", 244)].into_iter().enumerate() {
            let mine: Vec<_> = seen.iter().filter(|p| p.source == s).collect();
            let what = format!("round {round}: {name}");
            checks.that(&format!("{what}: frames"), mine.len() >= 10, mine.len());
            let wrong = mine.iter().filter(|p| p.index.is_none() || p.damaged).count();
            checks.equal(&format!("{what}: frames that are not byte for byte what was sent"), wrong, 0);
            let headers = mine.iter().filter(|p| p.header != header).count();
            checks.equal(&format!("{what}: headers without all of the vendor's blocks"), headers, 0);
            let pairs = mine.windows(2);
            let lost = pairs.filter(|w| w[1].index != w[0].index.map(|i| i + 1)).count();
            checks.equal(&format!("{what}: gaps"), lost, 0);
            let numbers: Vec<_> = mine.iter().map(|p| p.sequence).collect();
            let want: Vec<_> = (0..numbers.len() as u64).collect();
            checks.equal(&format!("{what}: numbers from 0"), numbers, want);
        }
        let done = source.statistics();
        checks.note(format!("{done:?}"));
        checks.equal("no byte is copied to put frames together", done.assembled_bytes, 0);
        drop(source);
        let before = device.accounts("depth")?;
        std::thread::sleep(Duration::from_millis(200));
        checks.equal("a dropped source has stopped the camera", device.accounts("depth")?, before);
    }
    Ok(())
}
