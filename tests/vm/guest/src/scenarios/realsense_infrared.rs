//! Infrared of a D435: the left imager's own image, and both imagers out of one interleaved frame, beside depth.

use crate::checks::Checks;
use crate::subject::{plug, small};
use crate::{Scenario, system};
use anyhow::Context;
use core::time::Duration;
use depthrig_bus::{HostTime, PixelFormat};
use depthrig_driver::{Backend, MemorySink};
use depthrig_emulator::{Camera, Options, Stamp};
use depthrig_realsense::RealsenseBackend;
use depthrig_realsense::config::{RealsenseConfig, TransportChoice};

/// See the module.
pub const SCENARIO: Scenario = Scenario {
    name: "realsense-infrared",
    about: "a D435's imagers, one alone and both out of one frame, by the kernel and libusb: every byte is right",
    cost: 1,
    limit_s: 60,
    needs: "",
    run,
};

const FRAMES: u64 = 5;
const TIMEOUT: Duration = Duration::from_secs(5);
const STARTS: u32 = 2;

fn run(checks: &mut Checks) -> anyhow::Result<()> {
    system::modprobe("vhci-hcd", &[])?;
    system::modprobe("uvcvideo", &[])?;
    let camera = plug("d435", Options::default())?;
    for transport in [TransportChoice::Kernel, TransportChoice::Libusb] {
        streams(checks, &camera, transport, &["depth", "ir_left"], *b"GREY")?;
        streams(checks, &camera, transport, &["depth", "ir_left", "ir_right"], *b"Y8I ")?;
    }
    Ok(())
}

/// Streams `names`, for which the imagers send `format`.
fn streams(
    checks: &mut Checks,
    camera: &Camera,
    transport: TransportChoice,
    names: &[&str],
    format: [u8; 4],
) -> anyhow::Result<()> {
    let what = format!("{transport:?}, {}", names.join(" and "));
    let config = RealsenseConfig { port: camera.port_path(), transport, ..RealsenseConfig::default() };
    let requests: Vec<_> = names.iter().filter_map(|s| small(s)).collect();
    let mut sink = MemorySink::default();
    for start in 1..=STARTS {
        sink = MemorySink::default();
        let mut stream = RealsenseBackend::new(config.clone()).open(None)?.start(&requests)?;
        let grey = stream.profiles().iter().filter(|p| p.format == PixelFormat::Mono8).count();
        checks.equal(&format!("{what}: grey images"), grey, names.len() - 1);
        let end = HostTime::now().plus(TIMEOUT);
        let short = |sink: &MemorySink| (0..names.len()).any(|i| sink.delivered(i) < FRAMES);
        while short(&sink) && HostTime::now() < end {
            stream.poll(Duration::from_millis(100), &mut sink)?;
        }
        drop(stream);
        if !short(&sink) {
            break;
        }
        // The daemon opens a silent stream again, and so does this, which is about the bytes.
        let counts: Vec<_> = (0..names.len()).map(|i| (sink.delivered(i), sink.drops_of(i))).collect();
        let sent: Vec<_> = ["depth", "ir"].iter().map(|s| camera.accounts(s)).collect();
        checks.note(format!("{what}: start {start} was short: {counts:?}; the camera: {sent:?}"));
    }
    for (i, name) in names.iter().enumerate() {
        checks.that(&format!("{what}: frames of {name}"), sink.delivered(i) >= FRAMES, sink.delivered(i));
        checks.equal(&format!("{what}: {name} loses none"), sink.drops_of(i).total(), 0);
    }
    let mut wrong = Vec::new();
    let mut formats = Vec::new();
    // Of the first frames of each stream: to make one again costs more than to send it.
    for (i, name) in names.iter().enumerate() {
        for (_, meta, pixels) in sink.frames.iter().filter(|f| f.0 == i).take(FRAMES as usize) {
            let index = Stamp::read(pixels).context("an image without a stamp")?.index;
            let source = if *name == "depth" { "depth" } else { "ir" };
            let sent = camera.expected(source, index)?;
            let mode = camera.mode(source, index)?;
            let wanted: Vec<u8> = match (&mode.fourcc, *name) {
                (b"Y8I ", "ir_left") => sent.into_iter().step_by(2).collect(),
                (b"Y8I ", _) => sent.into_iter().skip(1).step_by(2).collect(),
                _ => sent,
            };
            if *pixels != wanted {
                wrong.push(format!("{name} {}", meta.device_sequence));
            }
            if source == "ir" && !formats.contains(&mode.fourcc) {
                formats.push(mode.fourcc);
            }
        }
    }
    checks.equal(&format!("{what}: the imagers send"), formats, vec![format]);
    checks.equal(&format!("{what}: images that differ from what was sent"), wrong.join(", "), "");
    // Halves of one frame have one number and one time; the two imagers do not see the same.
    let of = |i: usize| sink.frames.iter().filter(move |f| f.0 == i);
    if names.len() == 3 {
        let same = of(1)
            .zip(of(2))
            .all(|(l, r)| (l.1.device_sequence, l.1.capture_time) == (r.1.device_sequence, r.1.capture_time));
        checks.that(&format!("{what}: both halves are of one moment"), same, "");
        let differ = of(1).zip(of(2)).all(|(l, r)| l.2 != r.2);
        checks.that(&format!("{what}: and of two imagers"), differ, "");
    }
    Ok(())
}
