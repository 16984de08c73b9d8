//! Settings of a rig reach a D435, data that the kernel withholds is reported, and hanging controls do not stop images.

mod presets;

use crate::checks::Checks;
use crate::subject::{plug, small};
use crate::tally::Tally;
use crate::{Scenario, system};
use core::time::Duration;
use depthrig_bus::{DropReason, MetadataLevel};
use depthrig_driver::{Backend, ErrorKind, Stream};
use depthrig_emulator::{Camera, Damage, Fault, Options};
use depthrig_realsense::RealsenseBackend;
use depthrig_realsense::config::{Emitter, MetadataWish, RealsenseConfig, TransportChoice};
use depthrig_usb as usb;
use depthrig_usb::SysRoot;
use depthrig_usb::controls::{ControlState, ControlValue};
use depthrig_usb::uvc::control::{ControlPort, Query};
use depthrig_v4l2::Node;

/// See the module.
pub const SCENARIO: Scenario = Scenario {
    name: "realsense-control",
    about: "a D435: settings, presets and sync mode read back, metadata levels, controls that hang, exact accounts, what it reports of itself",
    cost: 10,
    limit_s: 120,
    needs: "",
    run,
};

const SECOND: Duration = Duration::from_secs(1);

fn run(checks: &mut Checks) -> anyhow::Result<()> {
    system::modprobe("vhci-hcd", &[])?;
    system::modprobe("uvcvideo", &[])?;
    let camera = plug("d435", Options::default())?;
    settings(checks, &camera)?;
    presets::run(checks, &camera)?;
    metadata_levels(checks, &camera)?;
    hanging_controls(checks, &camera)?;
    accounts(checks, &camera)?;
    drop(camera);
    health(checks)
}

fn config(camera: &Camera) -> RealsenseConfig {
    RealsenseConfig {
        port: camera.port_path(),
        transport: TransportChoice::Kernel,
        ..RealsenseConfig::default()
    }
}

fn start(config: RealsenseConfig) -> depthrig_driver::Result<Box<dyn Stream>> {
    let requests: Vec<_> = ["depth", "color"].iter().filter_map(|s| small(s)).collect();
    RealsenseBackend::new(config).open(None)?.start(&requests)
}

/// The nodes of depth and colour, for looking behind the backend.
fn nodes(camera: &Camera) -> anyhow::Result<(Node, Node)> {
    let port = camera.port_path();
    let devices = usb::scan(&SysRoot::default())?;
    let device = devices.iter().find(|d| Some(&d.port) == port.as_ref());
    let first = |number: u8| {
        let interfaces = device.into_iter().flat_map(|d| &d.interfaces);
        interfaces.filter(|i| i.number == number).flat_map(|i| &i.video_nodes).next()
    };
    match (first(0), first(3)) {
        (Some(depth), Some(color)) => Ok((Node::open(&depth.path)?, Node::open(&color.path)?)),
        _ => anyhow::bail!("the camera has no nodes"),
    }
}

/// Controls change while the camera streams.
fn running_controls(checks: &mut Checks, stream: &mut dyn Stream, tally: &mut Tally) -> anyhow::Result<()> {
    let panel = stream.controls().and_then(|weak| weak.upgrade());
    let Some(panel) = panel else { anyhow::bail!("a running D435 has no controls") };
    let value = |key: &str| -> anyhow::Result<Option<ControlValue>> {
        Ok(panel.list()?.iter().find(|c| c.key == key).and_then(ControlState::file_value))
    };
    checks.equal("the emitter is listed by name", value("emitter")?, Some(ControlValue::Item("off".into())));
    checks.equal("the exposure is listed", value("exposure_us")?, Some(ControlValue::Integer(5000)));
    for (key, new) in [
        ("exposure_us", ControlValue::Integer(7000)),
        ("emitter", ControlValue::Item("laser".into())),
        ("laser_power_mw", ControlValue::Integer(120)),
        ("gain", ControlValue::Integer(32)),
        ("color_controls.white_balance_temperature", ControlValue::Integer(4000)),
    ] {
        panel.set(key, &new)?;
        checks.equal(&format!("{key} changes while it streams"), value(key)?, Some(new));
    }
    for (key, wrong) in [
        ("laser_power_mw", ControlValue::Integer(100)),
        ("emitter", ControlValue::Item("sun".into())),
        ("color_controls.no_such", ControlValue::Integer(1)),
        ("no_such", ControlValue::Integer(1)),
    ] {
        let e = panel.set(key, &wrong).err().map(|e| e.kind());
        checks.equal(&format!("{key} = {wrong} is refused"), e, Some(ErrorKind::BadInput));
    }
    let before = tally.of(0).count();
    tally.poll_for(stream, SECOND)?;
    let exposures: Vec<_> = tally.of(0).skip(before).map(|f| f.meta.exposure_ns).collect();
    checks.that(
        "frames have the new exposure",
        exposures.last() == Some(&7_000_000),
        format!("{:?}", exposures.last()),
    );
    Ok(())
}

/// Settings are in the camera afterwards; invalid ones are refused with the accepted values.
fn settings(checks: &mut Checks, camera: &Camera) -> anyhow::Result<()> {
    let color = [
        ("white_balance_automatic".to_owned(), ControlValue::Boolean(false)),
        ("white_balance_temperature".to_owned(), ControlValue::Integer(3500)),
    ];
    let asked = RealsenseConfig {
        emitter: Some(Emitter::Off),
        laser_power_mw: Some(90),
        exposure_us: Some(5000),
        gain: Some(64),
        color_controls: color.into(),
        ..config(camera)
    };
    checks.equal("a rig's settings match the camera's colour controls", asked.color_controls.len(), 2);
    let Some(mut stream) = checks.done("it starts with every setting", start(asked)) else { return Ok(()) };
    let mut tally = Tally::default();
    tally.poll_for(stream.as_mut(), SECOND)?;
    let (mut depth, color) = nodes(camera)?;
    let mut read = |selector: u8, bytes: usize| -> anyhow::Result<u32> {
        let mut value = vec![0; bytes];
        depth.query(3, selector, Query::GetCur, &mut value)?;
        value.resize(4, 0);
        Ok(u32::from_le_bytes([value[0], value[1], value[2], value[3]]))
    };
    checks.equal("the emitter is off", read(2, 1)?, 0);
    checks.equal("the laser has its power", read(4, 2)?, 90);
    checks.equal("auto-exposure is off", read(0x0B, 1)?, 0);
    checks.equal("the exposure is the one asked for", read(3, 4)?, 5000);
    let (depth, _) = nodes(camera)?;
    for (node, name, value) in [
        (&depth, "gain", 64),
        (&color, "white_balance_automatic", 0),
        (&color, "white_balance_temperature", 3500),
    ] {
        let controls = node.controls()?;
        let now = controls.iter().find(|c| c.name == name).map(|c| node.read_control(c)).transpose()?;
        checks.equal(&format!("{name} is set"), now, Some(value));
    }
    let exposures: Vec<_> = tally.of(0).map(|f| f.meta.exposure_ns).collect();
    checks.that(
        "frames say their exposure",
        exposures.iter().all(|ns| *ns == 5_000_000),
        format!("{:?}", exposures.first()),
    );
    running_controls(checks, stream.as_mut(), &mut tally)?;
    drop(stream);
    let refused = |config: RealsenseConfig| start(config).err();
    let e = refused(RealsenseConfig { laser_power_mw: Some(100), ..config(camera) });
    let text = e.as_ref().map(ToString::to_string).unwrap_or_default();
    let holds = e.is_some_and(|e| e.kind() == ErrorKind::BadInput) && text.contains("in steps of 30");
    checks.that("a power between two steps is refused with range and step", holds, text);
    let unknown = [("sharpnes".to_owned(), ControlValue::Integer(1))];
    let e = refused(RealsenseConfig { color_controls: unknown.into(), ..config(camera) });
    let text = e.map(|e| e.to_string()).unwrap_or_default();
    checks.that("an unknown control is refused with those there are", text.contains("white_balance"), text);
    Ok(())
}

/// The kernel gives D4XX for a D435; asked for less, the frames say what they have.
fn metadata_levels(checks: &mut Checks, camera: &Camera) -> anyhow::Result<()> {
    for (wish, level) in [
        (MetadataWish::Full, MetadataLevel::Full),
        (MetadataWish::Header, MetadataLevel::Header),
        (MetadataWish::None, MetadataLevel::Kernel),
    ] {
        let mut stream = start(RealsenseConfig { metadata: wish, ..config(camera) })?;
        let said: Vec<_> = stream.profiles().iter().map(|p| p.metadata).collect();
        checks.equal(&format!("{wish:?}: the streams say their level"), said, vec![level; 2]);
        let mut tally = Tally::default();
        tally.poll_for(stream.as_mut(), 2 * SECOND)?;
        let other = tally.frames.iter().filter(|f| {
            let m = &f.meta;
            MetadataLevel::of(m.clock_domain, m.flags) != level
        });
        checks.equal(&format!("{wish:?}: frames of another level"), other.count(), 0);
        let n = tally.frames.len();
        checks.that(&format!("{wish:?}: frames came of both streams"), n > 100, n);
        let lost: u64 = tally.drops.iter().map(depthrig_bus::DropCounts::total).sum();
        checks.equal(&format!("{wish:?}: frames lost"), lost, 0);
        let late = tally.frames.iter().filter_map(|f| {
            let name = if f.stream == 0 { "depth" } else { "color" };
            Some(f.meta.capture_time.since_ns(camera.true_capture(name, f.index?).ok()?))
        });
        let mut off: Vec<_> = late.map(i64::unsigned_abs).collect();
        off.sort_unstable();
        // A host that stalls holds up the first frames before the map of the clock knows others: a tenth may be later.
        let most_ms = off.get(off.len() * 9 / 10).map_or(f64::INFINITY, |ns| *ns as f64 / 1e6);
        let worst_ms = off.last().map_or(f64::INFINITY, |ns| *ns as f64 / 1e6);
        let said = format!("90 %: {most_ms} ms, all: {worst_ms} ms");
        checks.that(&format!("{wish:?}: capture times are within a frame"), most_ms < 33.0, said);
    }
    Ok(())
}

/// The kernel waits 5 s for an answer; meanwhile every frame comes.
fn hanging_controls(checks: &mut Checks, camera: &Camera) -> anyhow::Result<()> {
    let mut stream = start(config(camera))?;
    let mut tally = Tally::default();
    tally.poll_for(stream.as_mut(), SECOND)?;
    camera.fault(Fault::ControlTimeout(Duration::from_secs(12)))?;
    let before = tally.frames.len();
    tally.poll_for(stream.as_mut(), 8 * SECOND)?;
    let arrivals: Vec<_> = tally.of(0).map(|f| f.meta.arrival).collect();
    let gap_ms = arrivals.windows(2).map(|w| w[1].since_ns(w[0])).max().unwrap_or(0) as f64 / 1e6;
    let came = tally.frames.len() - before;
    checks.that("while no control is answered, frames come", came > 2 * 8 * 29, came);
    checks.that("none of them late", gap_ms < 50.0, format!("the longest pause is {gap_ms:.1} ms"));
    let lost: u64 = tally.drops.iter().map(depthrig_bus::DropCounts::total).sum();
    checks.equal("and none is lost", lost, 0);
    let began = depthrig_bus::HostTime::now();
    drop(stream);
    let took = began.elapsed();
    checks.that("stopping does not wait for the controls either", took < SECOND, format!("{took:?}"));
    camera.fault(Fault::Clear)?;
    let again = system::wait_until(Duration::from_secs(15), || start(config(camera)).is_ok());
    checks.that("it can be started again when they answer", again, "");
    Ok(())
}

/// Delivered and lost frames add up to those that the camera sent, frame by frame.
fn accounts(checks: &mut Checks, camera: &Camera) -> anyhow::Result<()> {
    const STREAMS: [&str; 2] = ["depth", "color"];
    let at_start: Vec<_> = STREAMS.iter().map(|s| camera.accounts(s)).collect::<Result<_, _>>()?;
    let mut stream = start(config(camera))?;
    let mut tally = Tally::default();
    tally.poll_for(stream.as_mut(), SECOND)?;
    for (damage, frames) in
        [(Damage::Skip, 2), (Damage::ErrorBit, 2), (Damage::Short, 2), (Damage::Long, 1), (Damage::Skip, 2)]
    {
        for stream in STREAMS {
            camera.fault(Fault::Frames { stream: stream.to_owned(), damage, frames })?;
        }
        tally.poll_for(stream.as_mut(), SECOND)?;
    }
    // Frames not sent from here on are not counted. An odd number of skipped frames would cost one more: the
    // emulator's frame bit follows its counter, and uvcvideo takes two alike for one frame.
    let skipped: Vec<_> =
        STREAMS.iter().map(|s| camera.accounts(s).map(|a| a.skipped)).collect::<Result<_, _>>()?;
    // The camera falls silent, and whatever is on its way arrives.
    camera.fault(Fault::Silence)?;
    tally.poll_for(stream.as_mut(), SECOND)?;
    for (i, name) in STREAMS.iter().enumerate() {
        let now = camera.accounts(name)?;
        let then = at_start[i];
        let good = now.good - then.good;
        checks.equal(&format!("{name}: all complete frames are delivered"), tally.of(i).count() as u64, good);
        let damaged = (now.error_bit - then.error_bit) + (now.short - then.short) + (now.long - then.long);
        let skipped = skipped[i] - then.skipped;
        checks.equal(&format!("{name}: the camera spoiled and skipped"), (damaged, skipped), (5, 4));
        let lost = tally.drops.get(i).map_or(0, depthrig_bus::DropCounts::total);
        checks.equal(&format!("{name}: lost are all the others"), lost, damaged + skipped);
        // The kernel's driver keeps damaged frames to itself.
        checks.equal(&format!("{name}: as gaps"), tally.lost(i, DropReason::DeviceGap), lost);
        let captured = tally.captured.get(i).copied().unwrap_or(0);
        checks.equal(&format!("{name}: captured is delivered and lost"), captured, good + lost);
    }
    drop(stream);
    camera.fault(Fault::Clear)?;
    Ok(())
}

/// Temperatures reach the frames, and a silent camera is restarted when the rig wants that.
fn health(checks: &mut Checks) -> anyhow::Result<()> {
    let camera = plug("d435", Options::default())?;
    let mut stream = start(config(&camera))?;
    let mut tally = Tally::default();
    tally.poll_for(stream.as_mut(), 3 * SECOND)?;
    let last = tally.frames.last().map(|f| f.meta.temperature_c);
    checks.that("frames have the camera's temperature", last.is_some_and(|t| t > 0.0), format!("{last:?}"));
    drop(stream);

    let backend = RealsenseBackend::new(RealsenseConfig { reset_when_silent: true, ..config(&camera) });
    camera.fault(Fault::Silence)?;
    for _ in 0..2 {
        let mut stream = backend.open(None)?.start(&[])?;
        let mut tally = Tally::default();
        tally.poll_for(stream.as_mut(), 3 * SECOND)?;
        checks.equal("a silent camera sends nothing", tally.frames.len(), 0);
    }
    let e = backend.open(None).err();
    let text = e.as_ref().map(ToString::to_string).unwrap_or_default();
    let holds = e.is_some_and(|e| e.kind() == ErrorKind::Disconnected) && text.contains("restarted");
    checks.that("after two silent starts it is restarted", holds, text);
    camera.fault(Fault::Clear)?;
    let mut frames = 0;
    let back = system::wait_until(Duration::from_secs(20), || {
        let Ok(mut stream) = backend.open(None).and_then(|d| d.start(&[])) else { return false };
        let mut tally = Tally::default();
        frames = tally.poll_for(stream.as_mut(), SECOND).map_or(0, |()| tally.frames.len());
        frames > 0
    });
    checks.that("and sends frames again", back, frames);
    Ok(())
}
