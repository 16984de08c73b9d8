//! The L515 backend against an emulated L515 under `uvcvideo`: who it is, its calibration, its four streams byte by
//! byte after they were turned, infrared that goes along unasked, unplugging.

use crate::checks::Checks;
use crate::{Scenario, system};
use anyhow::Context;
use depthrig_bus::{HostTime, MetadataLevel, Name, PixelFormat};
use depthrig_calib::PoseExt;
use depthrig_driver::{Backend, ErrorKind, MemorySink, Poll, Stream, StreamProfile, StreamRequest};
use depthrig_emulator::{Camera, Options, Stamp};
use depthrig_realsense::l515::{L515Backend, L515Config};
use glam::DVec3;
use std::time::Duration;

/// See the module.
pub const SCENARIO: Scenario = Scenario {
    name: "l515",
    about: "an emulated L515 by its backend: calibration, turned images, confidence, Y411, unplugging",
    cost: 2,
    limit_s: 60,
    needs: "",
    run,
};

const TIMEOUT: Duration = Duration::from_secs(5);
/// Frames of each stream that are compared.
const FRAMES: usize = 6;

fn run(checks: &mut Checks) -> anyhow::Result<()> {
    system::modprobe("vhci-hcd", &[])?;
    system::modprobe("uvcvideo", &[])?;
    let camera = Camera::plug("l515", Options { drift_ppm: 30.0, ..Options::default() })?;
    let eight = || system::video_nodes().is_ok_and(|nodes| nodes.len() == 8);
    checks.that("an L515 has eight nodes", system::wait_until(TIMEOUT, eight), "");

    let backend = L515Backend::new(L515Config {
        controls: [("laser_power".to_owned(), 60)].into(),
        ..L515Config::default()
    });
    let infos = backend.discover()?;
    checks.equal("it is found", infos.len(), 1);
    let info = infos.into_iter().next().context("no L515")?;
    checks.equal("its serial number", info.serial.as_str(), camera.serial());
    let said = (info.model.as_str(), info.firmware.as_str(), info.calibration.as_str());
    checks.equal("what it says of itself", said, ("L515", "1.5.8.1", "factory"));
    checks.equal("its port", Some(info.port), camera.port_path());
    let missing = backend.open(Some("00000000")).map(|_| ()).expect_err("no such camera");
    checks.that("another serial number is not found", missing.kind() == ErrorKind::NotFound, &missing);

    geometry(checks, backend.open(None)?.profiles(), &camera)?;
    all_streams(checks, &backend, &camera)?;
    y411(checks, &backend, &camera)?;

    let wrong = L515Config { controls: [("laser_power".to_owned(), 101)].into(), ..L515Config::default() };
    let refused = L515Backend::new(wrong).open(None)?.start(&[]).map(|_| ()).expect_err("out of range");
    checks.that("a control out of range names the range", refused.to_string().contains("0 to 100"), &refused);

    unplugged(checks, &backend, &camera, eight)
}

/// The request for a stream at 640x480 and 30 Hz.
fn request(stream: &str, format: Option<PixelFormat>) -> anyhow::Result<StreamRequest> {
    Ok(StreamRequest {
        size: Some((640, 480)),
        rate_hz: Some(30.0),
        format,
        ..StreamRequest::any(Name::new(stream)?)
    })
}

/// Intrinsics within 1e-6, the pose of colour within 1e-9 of what the emulator was given.
fn geometry(checks: &mut Checks, profiles: &[StreamProfile], camera: &Camera) -> anyhow::Result<()> {
    let given = camera.calibration().l515.context("an L515 without tables")?;
    let mut off = 0.0f64;
    let mut compared = 0;
    for p in profiles {
        let size = (p.width, p.height);
        let pinhole = match p.stream.as_str() {
            "color" => given.color.iter().find(|c| c.size == size).map(|c| c.pinhole),
            _ => given.depth.iter().find(|d| d.size == size).map(|d| d.pinhole),
        };
        let pinhole = pinhole.context("a size that the camera was not calibrated for")?.map(f64::from);
        let i = p.intrinsics;
        for (is, must) in [i.fx, i.fy, i.cx, i.cy].into_iter().zip(pinhole) {
            off = off.max((is - must).abs());
        }
        compared += 1;
    }
    checks.that(
        "intrinsics are what the camera was given",
        off < 1e-6 && compared >= 20,
        format!("{off} in {compared}"),
    );
    let color = profiles.iter().find(|p| p.stream.as_str() == "color").context("no colour")?;
    let row = |i: usize| DVec3::from_array([0, 1, 2].map(|k| f64::from(given.rotation[3 * i + k])));
    let t = DVec3::from_array(given.translation_mm.map(|v| f64::from(v) * 0.001));
    // The camera says p_color = R p_depth + t. Its rotation is of 32-bit floats, so it is one within 1e-7.
    let p_depth = DVec3::new(0.2, -0.1, 0.001);
    let p_color = DVec3::new(row(0).dot(p_depth), row(1).dot(p_depth), row(2).dot(p_depth)) + t;
    let off = (color.pose_in_device.transform_point(p_color) - p_depth).length();
    checks.that("colour is where the camera says", off < 1e-7, off);
    // The place of colour in depth's frame: -Rᵀ t.
    let place = -(row(0) * t.x + row(1) * t.y + row(2) * t.z);
    let off = (DVec3::from_array(color.pose_in_device.translation_m) - place).length();
    checks.that("its place is right within 1e-9 m", off < 1e-9, off);
    let depth = profiles.iter().find(|p| p.stream.as_str() == "depth").context("no depth")?;
    checks.that(
        "a unit is a quarter of a millimetre",
        (depth.depth_unit_m - 0.00025).abs() < 1e-12,
        depth.depth_unit_m,
    );
    Ok(())
}

/// Polls until every stream has delivered `frames`.
fn collect(stream: &mut dyn Stream, frames: usize) -> anyhow::Result<MemorySink> {
    let mut sink = MemorySink::default();
    let streams = stream.profiles().len();
    let end = HostTime::now().plus(TIMEOUT);
    while (0..streams).any(|s| sink.delivered(s) < frames as u64) && HostTime::now() < end {
        if stream.poll(Duration::from_millis(500), &mut sink)? == Poll::End {
            break;
        }
    }
    Ok(sink)
}

fn all_streams(checks: &mut Checks, backend: &L515Backend, camera: &Camera) -> anyhow::Result<()> {
    let requests = [
        request("depth", None)?,
        request("ir", None)?,
        request("confidence", None)?,
        request("color", Some(PixelFormat::Yuyv))?,
    ];
    let mut stream = backend.open(Some(camera.serial()))?.start(&requests)?;
    let sink = collect(stream.as_mut(), FRAMES)?;
    let profiles = stream.profiles().to_vec();
    drop(stream);
    for (at, p) in profiles.iter().enumerate() {
        let name = p.stream.as_str();
        // The kernel does not list the L515 among the cameras whose blocks it hands over.
        checks.equal(&format!("{name}: times are those of the header"), p.metadata, MetadataLevel::Header);
        checks.equal(&format!("{name}: nothing is dropped"), sink.drops_of(at).total(), 0);
        let mut equal = 0;
        let mut seen = 0;
        let mut off = 0i64;
        for (_, meta, pixels) in sink.frames.iter().filter(|(s, ..)| *s == at) {
            let upright = if name == "confidence" { packed(pixels, 640) } else { pixels.clone() };
            let stamp = Stamp::read(&upright).with_context(|| format!("{name}: a frame without a stamp"))?;
            let wire = match name {
                "depth" => turned_back(&upright, 640, 2),
                "color" => upright,
                _ => turned_back(&upright, 640, 1),
            };
            seen += 1;
            equal += usize::from(wire == camera.expected(name, stamp.index)?);
            off = off.max(meta.capture_time.since_ns(camera.true_capture(name, stamp.index)?).abs());
        }
        checks.that(
            &format!("{name}: frames are byte for byte what was sent"),
            seen >= FRAMES && equal == seen,
            format!("{equal} of {seen}"),
        );
        checks.that(&format!("{name}: capture times"), off < 60_000_000, format!("off by at most {off} ns"));
    }
    let before = camera.accounts("ir")?.sent;
    let mut stream = backend.open(None)?.start(&[request("depth", None)?])?;
    let sink = collect(stream.as_mut(), FRAMES)?;
    drop(stream);
    checks.that("depth alone comes", sink.delivered(0) >= FRAMES as u64, sink.delivered(0));
    checks.equal("and is the only stream", sink.frames.iter().filter(|(s, ..)| *s != 0).count(), 0);
    let along = camera.accounts("ir")?.sent - before;
    checks.that("infrared went along with it", along >= FRAMES as u64 - 2, along);
    Ok(())
}

/// Pixel (x, y) of an image of rows of `width` pixels back to row `width - 1 - x`, column `height - 1 - y`.
pub fn turned_back(upright: &[u8], width: usize, bytes: usize) -> Vec<u8> {
    let height = upright.len() / (width * bytes);
    let mut wire = vec![0; upright.len()];
    for y in 0..height {
        for x in 0..width {
            let from = (y * width + x) * bytes;
            let to = ((width - 1 - x) * height + height - 1 - y) * bytes;
            wire[to..to + bytes].copy_from_slice(&upright[from..from + bytes]);
        }
    }
    wire
}

/// Two pixels of confidence, one below the other, back into one byte: the upper one is its low half.
pub fn packed(pixels: &[u8], width: usize) -> Vec<u8> {
    let rows: Vec<_> = pixels.chunks(width).collect();
    rows.chunks(2)
        .flat_map(|pair| pair[0].iter().zip(pair[1]).map(|(above, below)| above >> 4 | below))
        .collect()
}

/// Colour as Y411, which the camera calls NV12.
fn y411(checks: &mut Checks, backend: &L515Backend, camera: &Camera) -> anyhow::Result<()> {
    let wanted = request("color", Some(PixelFormat::Nv12))?;
    let mut stream = backend.open(None)?.start(&[wanted])?;
    let sink = collect(stream.as_mut(), FRAMES)?;
    drop(stream);
    let mut equal = 0;
    let width = 640;
    let height = 480;
    for (_, _, pixels) in &sink.frames {
        let luma = |x: usize, y: usize| pixels[y * width + x];
        let chroma = |x: usize, y: usize| pixels[width * height + y / 2 * width + x];
        let mut wire = Vec::with_capacity(pixels.len());
        for y in (0..height).step_by(2) {
            for x in (0..width).step_by(2) {
                wire.extend([chroma(x, y), luma(x, y), luma(x + 1, y)]);
                wire.extend([chroma(x + 1, y), luma(x, y + 1), luma(x + 1, y + 1)]);
            }
        }
        let stamp = Stamp::read(&wire).context("colour without a stamp")?;
        equal += usize::from(wire == camera.expected("color", stamp.index)?);
    }
    let seen = sink.frames.len();
    checks.that(
        "Y411 becomes NV12 without a loss",
        seen >= FRAMES && equal == seen,
        format!("{equal} of {seen}"),
    );
    Ok(())
}

fn unplugged(
    checks: &mut Checks,
    backend: &L515Backend,
    camera: &Camera,
    there: impl Fn() -> bool,
) -> anyhow::Result<()> {
    let mut stream = backend.open(None)?.start(&[])?;
    let sink = collect(stream.as_mut(), 2)?;
    checks.that("depth and colour by default", sink.delivered(0) >= 2 && sink.delivered(1) >= 2, "");
    camera.unplug()?;
    let mut sink = MemorySink::default();
    let end = HostTime::now().plus(TIMEOUT);
    let error = loop {
        match stream.poll(Duration::from_millis(200), &mut sink) {
            Err(e) => break Some(e),
            Ok(_) if HostTime::now() >= end => break None,
            Ok(_) => {}
        }
    };
    let kind = error.as_ref().map(depthrig_driver::Error::kind);
    checks.equal("unplugged is disconnected", kind, Some(ErrorKind::Disconnected));
    drop(stream);
    let gone = backend.open(None).map(|_| ()).expect_err("it is not there");
    checks.that("it cannot be opened then", gone.kind() == ErrorKind::NotFound, &gone);
    camera.replug()?;
    checks.that("plugged in again, its nodes come back", system::wait_until(TIMEOUT, &there), "");
    let mut stream = backend.open(Some(camera.serial()))?.start(&[])?;
    let sink = collect(stream.as_mut(), 2)?;
    checks.that("and it streams again", sink.delivered(0) >= 2, sink.delivered(0));
    Ok(())
}
