//! The emulator itself: a camera on the kernel's own bus, its nodes, its frames byte by byte, its accounts.

use crate::checks::Checks;
use crate::{Scenario, system};
use anyhow::Context;
use depthrig_bus::HostTime;
use depthrig_emulator::{Camera, Damage, Fault, Options, Stamp};
use depthrig_usb::uvc::control::{ControlPort, Query};
use depthrig_usb::video::ImageSource;
use depthrig_v4l2::{FourCc, MetadataFormat, Node, Source, Wanted};
use std::path::Path;
use std::time::Duration;

/// See the module.
pub const SCENARIO: Scenario = Scenario {
    name: "emulator",
    about: "an emulated D435 under uvcvideo: nodes, frames and metadata, identity, faults, unplugging",
    cost: 1,
    limit_s: 60,
    needs: "",
    run,
};

const TIMEOUT: Duration = Duration::from_secs(5);

fn run(checks: &mut Checks) -> anyhow::Result<()> {
    system::modprobe("vhci-hcd", &[])?;
    system::modprobe("uvcvideo", &[])?;
    let plugged = HostTime::now();
    let camera = Camera::plug("d435", Options { drift_ppm: 40.0, start_ticks: 0, ..Options::default() })?;
    let six = || system::video_nodes().is_ok_and(|nodes| nodes.len() == 6);
    checks.that(
        "a D435 has six nodes",
        system::wait_until(TIMEOUT, six),
        format!("{:?}", system::video_nodes()?),
    );

    identity(checks, &camera)?;
    let depth = FourCc(*b"Z16 ");
    // The clock is set to 0.2 s before it wraps, which is in the middle of the next frames.
    let shown_us = plugged.elapsed().as_micros() as i64;
    camera.fault(Fault::ClockJump((1 << 32) - 200_000 - shown_us))?;
    let seen = stream(checks, &camera, "depth", "/dev/video0", depth, 12, None)?;
    checks.equal("a stream alone loses nothing", seen.lost, 0);
    checks.that("the clock wraps within the run", seen.pts_fell == 1, seen.pts_fell);
    for (name, node, format) in
        [("ir", "/dev/video2", FourCc(*b"GREY")), ("color", "/dev/video4", FourCc(*b"YUYV"))]
    {
        let seen = stream(checks, &camera, name, node, format, 5, None)?;
        checks.equal(&format!("{name} loses nothing"), seen.lost, 0);
    }
    let skip = Fault::Frames { stream: "depth".into(), damage: Damage::Skip, frames: 2 };
    let seen = stream(checks, &camera, "depth", "/dev/video0", depth, 6, Some(skip))?;
    checks.equal("skipped frames are missing", seen.lost, 2);
    checks.equal("and are in the accounts", camera.accounts("depth")?.skipped, 2);

    let port = camera.port_path();
    camera.unplug()?;
    let none = || system::video_nodes().is_ok_and(|nodes| nodes.is_empty());
    checks.that("unplugged, its nodes go", system::wait_until(TIMEOUT, none), "");
    camera.replug()?;
    checks.that("plugged in again, they come back", system::wait_until(TIMEOUT, six), "");
    checks.equal("at the same port", camera.port_path(), port);
    stream(checks, &camera, "depth", "/dev/video0", depth, 3, None)?;
    checks.equal("the emulator was never late", camera.accounts("depth")?.late, 0);
    drop(camera);
    checks.that("dropped, it is gone", system::wait_until(TIMEOUT, none), "");
    models(checks)
}

/// Every model is taken for a camera by the kernel, at both speeds.
fn models(checks: &mut Checks) -> anyhow::Result<()> {
    use depthrig_emulator::Speed::{High, Super};
    // Two nodes for each streaming interface; the L515 has four (the kernel knows the format of its confidence).
    for (model, speed, nodes) in [
        ("d405", Super, 6),
        ("d415", Super, 6),
        ("d435", High, 6),
        ("d435i", Super, 6),
        ("d455", Super, 6),
        ("l515", Super, 8),
        ("zed2i", Super, 2),
        ("zed2i", High, 2),
    ] {
        let camera = Camera::plug(model, Options { speed, ..Options::default() })?;
        let there = || system::video_nodes().is_ok_and(|found| found.len() == nodes);
        let settled = system::wait_until(TIMEOUT, there);
        checks.that(
            &format!("{model} at {speed:?} speed: nodes"),
            settled,
            format!("{}", system::video_nodes()?.len()),
        );
        drop(camera);
        let none = || system::video_nodes().is_ok_and(|found| found.is_empty());
        system::wait_until(TIMEOUT, none);
    }
    Ok(())
}

/// The hardware monitor reports the camera's identity through the kernel.
fn identity(checks: &mut Checks, camera: &Camera) -> anyhow::Result<()> {
    let mut node = Node::open(Path::new("/dev/video0"))?;
    checks.equal("the hardware monitor takes 1024 bytes", node.length(3, 1)?, 1024);
    let mut bytes = vec![0; 1024];
    bytes[..8].copy_from_slice(&[0x14, 0, 0xAB, 0xCD, 0x10, 0, 0, 0]);
    node.query(3, 1, Query::SetCur, &mut bytes)?;
    node.query(3, 1, Query::GetCur, &mut bytes)?;
    checks.equal("GVD is echoed", bytes[0], 0x10);
    // Two digits a byte: six bytes are a number of twelve hexadecimal digits.
    let serial = bytes[4 + 48..4 + 54].iter().fold(0u64, |all, byte| all << 8 | u64::from(*byte));
    checks.equal("GVD has the serial", format!("{serial:012x}").as_str(), camera.serial());
    Ok(())
}

struct Seen {
    lost: u64,
    pts_fell: u32,
}

/// Takes frames of a stream and compares each with the one sent; the fault happens after the second of them.
fn stream(
    checks: &mut Checks,
    camera: &Camera,
    name: &str,
    path: &str,
    format: FourCc,
    frames: usize,
    mut fault: Option<Fault>,
) -> anyhow::Result<Seen> {
    let number: u32 = path.trim_start_matches("/dev/video").parse()?;
    let node = Node::open(Path::new(path))?;
    let modes = node.modes(|f| f == format)?;
    let mode =
        modes.iter().find(|m| (m.width, m.height) == (640, 480) && m.interval.rate_hz().round() == 30.0);
    node.set_mode(mode.context("no 640x480 at 30 Hz")?)?;
    let metadata = Node::open(Path::new(&format!("/dev/video{}", number + 1)))?;
    let wanted = Wanted { video: node, metadata: Some((metadata, MetadataFormat::D4xx)) };
    let mut source = Source::start(vec![wanted], 4)?;
    let mut images: Vec<(Vec<u8>, Vec<u8>, Option<HostTime>)> = Vec::new();
    let end = HostTime::now().plus(TIMEOUT);
    while images.len() < frames && HostTime::now() < end {
        source.poll(Duration::from_millis(500), &mut |image| {
            images.push((image.bytes.to_vec(), image.header.unwrap_or_default().to_vec(), image.kernel_time));
        })?;
        if images.len() >= 2
            && let Some(fault) = fault.take()
        {
            camera.fault(fault)?;
        }
    }
    drop(source);
    checks.equal(&format!("{name}: frames"), images.len(), frames);
    let mut last = None;
    let mut last_pts = None;
    let mut seen = Seen { lost: 0, pts_fell: 0 };
    let mut equal = 0;
    let mut whole = 0;
    let mut off = 0;
    for (bytes, header, kernel_time) in &images {
        let stamp = Stamp::read(bytes).context("a frame without a stamp")?;
        equal += usize::from(*bytes == camera.expected(name, stamp.index)?);
        if let Some(last) = last {
            seen.lost += stamp.index - last - 1;
        }
        last = Some(stamp.index);
        whole += usize::from(header.len() == if name == "color" { 244 } else { 232 });
        let pts = header.get(2..6).and_then(|b| b.first_chunk()).map_or(0, |b| u32::from_le_bytes(*b));
        seen.pts_fell += u32::from(last_pts.is_some_and(|last| pts < last));
        last_pts = Some(pts);
        let arrival =
            kernel_time.context("no kernel time")?.since_ns(camera.true_capture(name, stamp.index)?);
        off += usize::from(!(0..40_000_000).contains(&arrival));
    }
    checks.equal(&format!("{name}: frames that are byte for byte what was sent"), equal, frames);
    checks.equal(&format!("{name}: headers that have all of the vendor's blocks"), whole, frames);
    checks.equal(&format!("{name}: frames that come before or long after their capture"), off, 0);
    Ok(seen)
}
