//! The backend `v4l2` against vivid: cameras, formats, controls, times and copies, with the crate `v4l`'s own stream as
//! the witness of what an image must be.

use crate::Scenario;
use crate::checks::Checks;
use crate::tally::Tally;
use crate::vivid::{self, SIZE, Taken};
use anyhow::Context;
use core::time::Duration;
use depthrig_bus::{ClockDomain, FrameFlags, MetadataLevel, PixelFormat};
use depthrig_driver::{Backend, ErrorKind, MemorySink, unpack};
use depthrig_usb::controls::ControlValue;
use depthrig_v4l2::{ClockChoice, MemoryChoice, Node, V4l2Backend, V4l2Config};
use v4l::buffer::Type;
use v4l::io::traits::CaptureStream;
use v4l::video::Capture;

/// See the module.
pub const SCENARIO: Scenario = Scenario {
    name: "v4l2-formats",
    about: "vivid through the backend v4l2: every format to the byte, controls, clocks, one copy or none",
    cost: 1,
    limit_s: 60,
    needs: "",
    run,
};

const FRAMES: u64 = 8;
const FORMATS: [(PixelFormat, &[u8; 4]); 5] = [
    (PixelFormat::Yuyv, b"YUYV"),
    (PixelFormat::Uyvy, b"UYVY"),
    (PixelFormat::Nv12, b"NV12"),
    (PixelFormat::Mono8, b"GREY"),
    (PixelFormat::Mono16, b"Y16 "),
];

fn run(checks: &mut Checks) -> anyhow::Result<()> {
    vivid::load(2)?;
    cameras(checks)?;
    controls(checks)?;
    formats(checks)?;
    no_device_clock(checks)
}

fn cameras(checks: &mut Checks) -> anyhow::Result<()> {
    let found = V4l2Backend::new(V4l2Config::default()).discover()?;
    let ports: Vec<_> = found.iter().map(|info| info.port.as_str()).collect();
    checks.equal("both cameras are found", ports, ["platform:vivid-000", "platform:vivid-001"]);
    let error = V4l2Backend::new(V4l2Config::default()).open(None).err().context("a choice of two")?;
    checks.equal("a camera that is not named is not guessed", error.kind(), ErrorKind::NotFound);
    let text = error.to_string();
    checks.that(
        "the message lists what there is",
        text.contains(&vivid::port(0)) && text.contains(&vivid::port(1)),
        &text,
    );
    let device = V4l2Backend::new(vivid::config(1)).open(None)?;
    checks.that("its modes are listed", device.profiles().len() > 50, device.profiles().len());
    let request = vivid::request(PixelFormat::Rgb8)?;
    let error = device.start(&[request]).err().context("a format that it lacks")?;
    checks.equal("a mode that it lacks is refused", error.kind(), ErrorKind::Unsupported);
    Ok(())
}

fn controls(checks: &mut Checks) -> anyhow::Result<()> {
    let node = vivid::capture_node(0)?;
    let all = node.controls()?;
    let set = |name: &str, value: ControlValue| node.set_control(&all, name, &value);
    set("brightness", ControlValue::Integer(77))?;
    let brightness = all.iter().find(|c| c.name == "brightness").context("brightness")?;
    checks.equal("a control holds what was written", node.read_control(brightness)?, 77);
    let error = set("brigthness", ControlValue::Integer(1)).err().context("an unknown control")?;
    checks.that(
        "an unknown name lists the names",
        error.kind() == ErrorKind::BadInput && error.to_string().contains("brightness, contrast"),
        &error,
    );
    let error = set("brightness", ControlValue::Integer(256)).err().context("out of range")?;
    checks.that(
        "a value out of range is refused with the range",
        error.to_string().contains("0 to 255"),
        &error,
    );
    let error = set("osd_text_mode", ControlValue::Item("Some".into())).err().context("no such item")?;
    checks.that(
        "an unknown item lists the items",
        error.to_string().contains("\"All\"") && error.to_string().contains("\"None\""),
        &error,
    );
    set("brightness", ControlValue::Integer(128))?;
    running_controls(checks, &node)?;
    let mut config = vivid::config(0);
    config.controls.push(("no_such".to_owned(), ControlValue::Boolean(true)));
    let started = vivid::start(config, &vivid::request(PixelFormat::Yuyv)?);
    let error = started.err().context("a bad control")?;
    checks.equal("a rig with an unknown control does not start", error.kind(), ErrorKind::BadInput);
    Ok(())
}

/// Controls change while it streams, and are gone with the stream.
fn running_controls(checks: &mut Checks, node: &Node) -> anyhow::Result<()> {
    let mut stream = vivid::start(vivid::config(0), &vivid::request(PixelFormat::Yuyv)?)?;
    let mut tally = Tally::default();
    tally.poll_for(stream.as_mut(), Duration::from_millis(300))?;
    let weak = stream.controls().context("no controls")?;
    let panel = weak.upgrade().context("the controls are gone")?;
    panel.set("controls.brightness", &ControlValue::Integer(99))?;
    let listed = panel.list()?;
    let brightness = listed.iter().find(|c| c.key == "controls.brightness").context("brightness")?;
    checks.equal("a control of a running camera changes", brightness.value, Some(99));
    checks.equal("another program reads the same", node.read_control(&brightness.control)?, 99);
    checks.that("its list has what a rig file can set", listed.len() > 8, listed.len());
    let refused = panel.set("controls.brightness", &ControlValue::Integer(256));
    checks.that("a value out of range is refused while it runs", refused.is_err(), "");
    checks.that("so is an unknown key", panel.set("brightness", &ControlValue::Integer(1)).is_err(), "");
    // A switch and a menu, read by other code than ours.
    let witness = v4l::Device::with_path(node.path())?;
    for (key, value, raw) in [
        ("controls.horizontal_flip", ControlValue::Boolean(true), v4l::control::Value::Boolean(true)),
        ("controls.osd_text_mode", ControlValue::Item("None".into()), v4l::control::Value::Integer(2)),
    ] {
        let state = listed.iter().find(|c| c.key == key).context(key)?;
        panel.set(key, &value)?;
        let now = panel.list()?.into_iter().find(|c| c.key == key).context(key)?;
        checks.equal(&format!("{key} has its value of a rig file"), now.file_value(), Some(value));
        checks.equal(&format!("{key} as v4l reads it"), witness.control(state.control.id)?.value, raw);
        let before = state.file_value().context(key)?;
        panel.set(key, &before)?;
        let now = panel.list()?.into_iter().find(|c| c.key == key).context(key)?;
        checks.equal(&format!("{key} goes back"), now.file_value(), Some(before));
    }
    let before = tally.of(0).count();
    tally.poll_for(stream.as_mut(), Duration::from_millis(300))?;
    checks.that("it streams on", tally.of(0).count() > before, before);
    panel.set("controls.brightness", &ControlValue::Integer(128))?;
    drop((panel, stream));
    checks.that("the controls go with the stream", weak.upgrade().is_none(), "");
    Ok(())
}

/// The image that vivid paints, taken by other code than ours.
fn witness(fourcc: [u8; 4]) -> anyhow::Result<Vec<u8>> {
    let node = vivid::capture_node(0)?;
    let device = v4l::Device::with_path(node.path())?;
    let mut format = device.format()?;
    (format.width, format.height, format.fourcc) = (SIZE.0, SIZE.1, v4l::FourCC::new(&fourcc));
    (format.stride, format.size) = (0, 0);
    device.set_format(&format)?;
    let mut stream = v4l::io::mmap::Stream::with_buffers(&device, Type::VideoCapture, 4)?;
    let (bytes, described) = stream.next()?;
    Ok(bytes.get(..described.bytesused as usize).context("an incomplete image")?.to_vec())
}

fn formats(checks: &mut Checks) -> anyhow::Result<()> {
    vivid::set(&vivid::capture_node(0)?, "osd_text_mode", 2)?;
    for (format, fourcc) in FORMATS {
        let wanted = witness(*fourcc)?;
        checks.that(
            &format!("the {} image is no plain one", format.name()),
            wanted.iter().any(|b| *b != wanted[0]),
            wanted.len(),
        );
        for memory in [MemoryChoice::Mmap, MemoryChoice::UserPointer] {
            let config = V4l2Config { memory, clock: ClockChoice::Kernel, ..vivid::config(0) };
            let before = unpack::copied_bytes();
            let stream = vivid::start(config, &vivid::request(format)?)?;
            let taken = vivid::take(stream, MemorySink::lending(), FRAMES, |_| ())?;
            let copied = unpack::copied_bytes() - before;
            let name = format!("{} {memory:?}", format.name());
            let equal = taken.sink.frames.iter().filter(|(_, _, pixels)| *pixels == wanted).count();
            checks.equal(&format!("{name}: every image is the witness's"), equal as u64, FRAMES);
            checks.that(
                &format!("{name}: nothing is lost"),
                taken.balances() && taken.sink.drops_of(0).total() == 0,
                taken.captured(),
            );
            let copies = if memory == MemoryChoice::Mmap { FRAMES } else { 0 };
            checks.equal(&format!("{name}: bytes copied"), copied, copies * wanted.len() as u64);
            times(checks, &name, &taken, ClockDomain::Kernel);
        }
    }
    Ok(())
}

/// Frames follow each other at 30 Hz, and none is stamped after it came.
fn times(checks: &mut Checks, name: &str, taken: &Taken, domain: ClockDomain) {
    let metas: Vec<_> = taken.sink.frames.iter().map(|f| f.1).collect();
    let ahead = metas.iter().filter(|m| m.capture_time > m.arrival).count();
    checks.equal(&format!("{name}: no frame is captured after it came"), ahead, 0);
    let steps: Vec<_> =
        metas.windows(2).map(|w| w[1].capture_time.since_ns(w[0].capture_time) / 1000).collect();
    let near = steps.iter().all(|us| (20_000..=45_000).contains(us));
    checks.that(&format!("{name}: 33 ms from frame to frame"), near, format!("{steps:?} us"));
    checks.that(
        &format!("{name}: the clock is said"),
        metas.iter().all(|m| m.clock_domain == domain),
        format!("{domain:?}"),
    );
    if domain == ClockDomain::Kernel {
        // vivid stamps 30 ms ahead of time.
        let flagged = metas.iter().filter(|m| m.flags.has(FrameFlags::TIME_UNCERTAIN)).count();
        checks.equal(
            &format!("{name}: times from a driver that stamps ahead are flagged"),
            flagged,
            metas.len(),
        );
    }
}

/// vivid's metadata node gives payload headers, but writes one byte of their time stamps and leaves the rest as it was: a
/// clock that must not be believed, whatever is said of it.
fn no_device_clock(checks: &mut Checks) -> anyhow::Result<()> {
    let request = vivid::request(PixelFormat::Mono8)?;
    for device_clock_hz in [None, Some(100_000_000)] {
        let config = V4l2Config { device_clock_hz, ..vivid::config(0) };
        let taken = vivid::take(vivid::start(config, &request)?, MemorySink::default(), FRAMES, |_| ())?;
        let what = format!("a clock that does not tick is not used ({device_clock_hz:?} Hz said)");
        checks.equal(&what, taken.profile.metadata, MetadataLevel::Kernel);
        times(checks, "kernel's stamps instead", &taken, ClockDomain::Kernel);
    }
    Ok(())
}
