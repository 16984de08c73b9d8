//! How a camera that was used through libusb comes back to the kernel's driver, also when the program was killed; and
//! what happens when the kernel has too little memory for transfers.

use super::{COLOR, DEPTH, TIMEOUT, Truth, load, nodes_become, small, take, usb_device};
use crate::checks::Checks;
use crate::{Scenario, system};
use anyhow::Context;
use depthrig_bus::HostTime;
use depthrig_driver::{Backend, ErrorKind};
use depthrig_emulator as emulator;
use depthrig_libusb::{Camera, Settings, Source, give_to_kernel};
use depthrig_realsense::RealsenseBackend;
use depthrig_realsense::config::{RealsenseConfig, TransportChoice};
use depthrig_usb as usb;
use depthrig_usb::SysRoot;
use depthrig_usb::video::ImageSource;
use depthrig_v4l2::{FourCc, Node, Source as KernelSource, Wanted};
use emulator::{Fault, Options};
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

/// See the module.
pub const SCENARIO: Scenario = Scenario {
    name: "libusb-end",
    about: "after libusb: the kernel's nodes come back and stream, also after kill -9; too little memory for transfers",
    cost: 2,
    limit_s: 90,
    needs: "",
    run,
};

/// Makes this scenario the program that streams from the camera at this port until it is killed.
const CHILD_PORT: &str = "DEPTHRIG_VM_LIBUSB_PORT";
const LIMIT: &str = "/sys/module/usbcore/parameters/usbfs_memory_mb";

fn run(checks: &mut Checks) -> anyhow::Result<()> {
    if let Ok(port) = std::env::var(CHILD_PORT) {
        return stream_for_ever(&port);
    }
    load()?;
    let device = emulator::Camera::plug("d435", Options::default())?;
    nodes_become(6);
    let truth = &mut Truth::default();
    for round in 1..=2 {
        let camera = Camera::open(&SysRoot::default(), &usb_device(&device)?)?;
        let mut source = Source::start(&camera, &[small(DEPTH), small(COLOR)], Settings::default())?;
        take(&device, truth, &mut source, &["depth", "color"], 2)?;
        drop(source);
        drop(camera);
        checks.that(
            &format!("round {round}: given back, all nodes are there again"),
            nodes_become(6),
            format!("{:?}", system::video_nodes()?),
        );
        kernel_streams(checks, &device, truth, &format!("round {round}"))?;
    }
    busy(checks, &device)?;
    killed(checks, &device, truth)?;
    memory(checks, &device, truth)
}

/// The kernel's nodes give whole frames.
fn kernel_streams(
    checks: &mut Checks,
    device: &emulator::Camera,
    truth: &mut Truth,
    when: &str,
) -> anyhow::Result<()> {
    for (path, format, name) in [("/dev/video0", b"Z16 ", "depth"), ("/dev/video4", b"YUYV", "color")] {
        let node = Node::open(Path::new(path))?;
        let modes = node.modes(|f| f == FourCc(*format))?;
        let mode = modes.iter().find(|m| (m.width, m.height) == (424, 240));
        node.set_mode(mode.context("no 424x240")?)?;
        let mut source = KernelSource::start(vec![Wanted { video: node, metadata: None }], 4)?;
        let mut equal = 0;
        let end = HostTime::now().plus(TIMEOUT);
        while equal < 3 && HostTime::now() < end {
            source.poll(Duration::from_millis(100), &mut |image| {
                equal += usize::from(truth.index(device, name, image.bytes).is_some());
            })?;
        }
        checks.that(&format!("{when}: {name} streams through the kernel"), equal >= 3, equal);
    }
    Ok(())
}

/// A camera that somebody uses through the kernel is not taken from him.
fn busy(checks: &mut Checks, device: &emulator::Camera) -> anyhow::Result<()> {
    let held = Node::open(Path::new("/dev/video0"))?;
    let error = Camera::open(&SysRoot::default(), &usb_device(device)?).err();
    let text = error.as_ref().map_or_else(String::new, ToString::to_string);
    checks.equal("a camera in use is not taken", error.map(|e| e.kind()), Some(ErrorKind::Busy));
    checks.that("and the message names the node", text.contains("/dev/video0"), text);
    drop(held);
    checks.equal("its nodes are still there", system::video_nodes()?.len(), 6);
    Ok(())
}

fn child(device: &emulator::Camera) -> anyhow::Result<Child> {
    let mut child = Command::new(std::env::current_exe()?)
        .arg(SCENARIO.name)
        .env(CHILD_PORT, device.port_path().context("no port")?)
        .env_remove(crate::checks::REPORT_VARIABLE)
        .stdout(Stdio::piped())
        .spawn()?;
    let mut line = String::new();
    BufReader::new(child.stdout.take().context("no output")?).read_line(&mut line)?;
    anyhow::ensure!(line.trim() == "streaming", "the child says {line:?}");
    Ok(child)
}

fn stream_for_ever(port: &str) -> anyhow::Result<()> {
    let root = SysRoot::default();
    let device = usb::scan(&root)?.into_iter().find(|d| d.port == port).context("no such port")?;
    let camera = Camera::open(&root, &device)?;
    let mut source = Source::start(&camera, &[small(DEPTH), small(COLOR)], Settings::default())?;
    let mut frames = 0;
    loop {
        source.poll(Duration::from_millis(50), &mut |_| frames += 1)?;
        if frames >= 4 {
            frames = i32::MIN;
            println!("streaming");
        }
    }
}

/// kill -9 while transfers wait for data and none is half received, which would stop a guest of one processor for good
/// (`tests/vm/README.md`, "Consequences of the guest's single processor").
fn kill(device: &emulator::Camera, mut child: Child) -> anyhow::Result<()> {
    device.fault(Fault::Nak)?;
    // What was sent before has been read.
    std::thread::sleep(Duration::from_millis(50));
    child.kill()?;
    child.wait()?;
    Ok(device.fault(Fault::Clear)?)
}

/// kill -9 while transfers wait. The kernel takes them back by itself and leaves the interfaces without a driver;
/// one call binds it again.
fn killed(checks: &mut Checks, device: &emulator::Camera, truth: &mut Truth) -> anyhow::Result<()> {
    let child = child(device)?;
    let error = Camera::open(&SysRoot::default(), &usb_device(device)?).err();
    let text = error.as_ref().map_or_else(String::new, ToString::to_string);
    checks.equal("held by another program through libusb", error.map(|e| e.kind()), Some(ErrorKind::Busy));
    checks.that("the message names it", text.contains(&format!("process {}", child.id())), text);
    kill(device, child)?;
    std::thread::sleep(Duration::from_millis(300));
    checks.equal(
        "after kill -9 the kernel does not bind its driver by itself",
        system::video_nodes()?.len(),
        0,
    );
    let root = SysRoot::default();
    checks.equal("both functions are bound again", give_to_kernel(&root, &usb_device(device)?)?, 2);
    checks.that("and the nodes are back without a replug", nodes_become(6), "");
    checks.equal("a second call has nothing to do", give_to_kernel(&root, &usb_device(device)?)?, 0);
    kernel_streams(checks, device, truth, "after kill -9")?;
    // And by itself, when the backend next opens the camera through the kernel.
    let third = self::child(device)?;
    kill(device, third)?;
    let port = device.port_path();
    let transport = TransportChoice::Kernel;
    let backend = RealsenseBackend::new(RealsenseConfig { port, transport, ..RealsenseConfig::default() });
    let opened = backend.open(Some(device.serial())).map(|d| d.info().serial.clone());
    checks.that("the backend binds the driver itself", opened.is_ok(), format!("{opened:?}"));
    nodes_become(6);
    // The same once more, and straight into libusb again.
    let again = self::child(device)?;
    kill(device, again)?;
    let camera = Camera::open(&root, &usb_device(device)?)?;
    let mut source = Source::start(&camera, &[small(DEPTH)], Settings::default())?;
    let seen = take(device, truth, &mut source, &["depth"], 3)?;
    checks.that(
        "libusb itself works at once after a kill",
        seen.iter().filter(|p| p.index.is_some()).count() >= 3,
        seen.len(),
    );
    drop(source);
    drop(camera);
    checks.that("and gives the camera back to the kernel", nodes_become(6), "");
    Ok(())
}

/// The kernel's limit for transfers, too low before the start, and used up by another program.
fn memory(checks: &mut Checks, device: &emulator::Camera, truth: &mut Truth) -> anyhow::Result<()> {
    let root = SysRoot::default();
    let before = std::fs::read_to_string(LIMIT)?;
    std::fs::write(LIMIT, "1")?;
    let camera = Camera::open(&root, &usb_device(device)?)?;
    let error = Source::start(&camera, &[small(DEPTH), small(COLOR)], Settings::default()).err();
    let text = error.as_ref().map_or_else(String::new, ToString::to_string);
    checks.that(
        "a limit that is too low is reported before the start",
        text.contains("2 MB are needed"),
        &text,
    );
    checks.that("with what to write where", text.contains(&format!("> {LIMIT}")), &text);
    drop(camera);
    nodes_become(6);

    // Another program takes most of what is enough for one.
    std::fs::write(LIMIT, "2")?;
    let other = emulator::Camera::plug("d435", Options::default())?;
    nodes_become(12);
    let child = child(&other)?;
    let camera = Camera::open(&root, &usb_device(device)?)?;
    let error = Source::start(&camera, &[small(DEPTH), small(COLOR)], Settings::default()).err();
    let text = error.as_ref().map_or_else(String::new, ToString::to_string);
    checks.that(
        "a limit that another program has used up is reported as well",
        text.contains("the limit is 2 MB for all programs"),
        &text,
    );
    kill(&other, child)?;
    let mut source = Source::start(&camera, &[small(DEPTH), small(COLOR)], Settings::default())?;
    let seen = take(device, truth, &mut source, &["depth", "color"], 2)?;
    checks.that(
        "when it is gone there is room",
        seen.iter().filter(|p| p.index.is_some()).count() >= 4,
        seen.len(),
    );
    std::fs::write(LIMIT, before.trim())?;
    Ok(())
}
