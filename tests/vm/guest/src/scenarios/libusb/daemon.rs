//! The daemon with `transport = "libusb"` in its rig file: a camera of each D400 model recorded, one pulled and back
//! meanwhile, every frame in the dataset the one that was sent, and the kernel's nodes there again afterwards.

use super::nodes_become;
use crate::checks::Checks;
use crate::daemon::{Daemon, streams};
use crate::feed::Feed;
use crate::mount::{self, Mount, Size};
use crate::{Scenario, system};
use anyhow::Context;
use depthrig_bus::{ClockDomain, HostTime};
use depthrig_daemon::status::{CameraState, CameraStatus, RigStatus};
use depthrig_recorder::{Dataset, PixelMode, SetRange};
use std::path::Path;
use std::time::Duration;

/// See the module.
pub const SCENARIO: Scenario = Scenario {
    name: "libusb-daemon",
    about: "the daemon with D405, D415, D435 and D455 through libusb: recorded byte by byte, one replugged",
    cost: 9,
    limit_s: 90,
    needs: "",
    run,
};

const MODELS: [&str; 4] = ["d405", "d415", "d435", "d455"];
/// The camera that is unplugged.
const VICTIM: usize = 2;
/// The slowest rate that all models have.
const SIZE: Size = Size { width: 424, height: 240, rate_hz: 15 };
const TIMEOUT: Duration = Duration::from_secs(10);
const BACK_WITHIN: Duration = Duration::from_secs(2);

fn run(checks: &mut Checks) -> anyhow::Result<()> {
    let mount = Mount::plug(&MODELS, |_| 0)?;
    let nodes = system::video_nodes()?.len();
    let kernel = "backend = \"realsense\"\n";
    let rig = mount.rig(SIZE).replace(kernel, &format!("{kernel}transport = \"libusb\"\n"));
    let daemon = Daemon::start(&rig)?;
    let before = daemon.wait_until_settled()?;
    checks.equal("the kernel's driver has none of them", system::video_nodes()?.len(), 0);
    for (camera, emulated) in before.cameras.iter().zip(&mount.cameras) {
        let model = emulated.model().name.to_uppercase();
        checks.equal(
            &format!("{model}: model, serial and calibration are known"),
            (camera.model.as_str(), camera.serial.as_str(), camera.calibration.as_str()),
            (model.as_str(), emulated.serial(), "factory"),
        );
        let levels: Vec<_> = camera.streams.iter().map(|s| s.clock.metadata.as_str()).collect();
        checks.equal(&format!("{model}: all metadata of both streams"), levels, ["full"; 2]);
    }
    let others = Mount::streams((0..MODELS.len()).filter(|i| *i != VICTIM))?;
    let not_sent = mount::not_sent(&mount, &others)?;
    let feed = Feed::start(&daemon.runtime, &others, mount::stamped)?;
    let path = daemon.record("libusb")?;
    std::thread::sleep(Duration::from_secs(1));
    let back = replug(&daemon, &mount)?;
    checks.that(
        "pulled and plugged in again, it is back within 2 s",
        back <= BACK_WITHIN,
        format!("{back:.2?}"),
    );
    std::thread::sleep(Duration::from_millis(500));
    let recording = daemon.record_stop()?;
    let feed = feed.end()?;
    let status = daemon.status()?;
    checks.equal("the daemon counts its return", victim(&status)?.reconnects, 1);
    mount::check_feed(checks, &feed, 20);
    mount::check_no_drops(checks, &before, &status, &[Mount::name(VICTIM)]);
    checks.equal("the emulator kept its times and was read", mount::not_sent(&mount, &others)?, not_sent);
    checks.equal("no set is lost", recording.dropped, Default::default());

    let (ended, took) = daemon.stop()?;
    // 3: frames were lost, those of the camera that was away.
    let well = matches!(ended.code(), Some(0 | 3));
    checks.that("SIGTERM ends it", well, format!("{ended} after {took:?}"));
    checks.that(
        "and the kernel's driver has all of them again",
        nodes_become(nodes),
        system::video_nodes()?.len(),
    );
    mount::check_dataset(checks, &mount, &path, false)?;
    headers(checks, &path, recording.sets)
}

/// The status of the camera that is unplugged.
fn victim(status: &RigStatus) -> anyhow::Result<&CameraStatus> {
    status.cameras.get(VICTIM).context("a rig of four cameras")
}

/// Pulls the camera and plugs it in again; how long it took until both streams had a frame.
fn replug(daemon: &Daemon, mount: &Mount) -> anyhow::Result<Duration> {
    let delivered = |s: &RigStatus| {
        victim(s).map(|c| c.streams.iter().map(|s| s.delivered).sum::<u64>()).unwrap_or_default()
    };
    mount.cameras[VICTIM].unplug()?;
    daemon.wait_for(TIMEOUT, "the unplugged camera is missed", |s| {
        victim(s).is_ok_and(|c| c.state == CameraState::Reconnecting)
    })?;
    let before = delivered(&daemon.status()?);
    let plugged = HostTime::now();
    mount.cameras[VICTIM].replug()?;
    daemon.wait_for(TIMEOUT, "the camera comes back", |s| {
        victim(s).is_ok_and(streams) && delivered(s) >= before + 2
    })?;
    Ok(plugged.elapsed())
}

/// Each recorded frame has the camera's own clock and exposure, and the number of sets is the daemon's.
fn headers(checks: &mut Checks, path: &Path, sets: u64) -> anyhow::Result<()> {
    let mut found = 0;
    let mut frames = 0;
    let mut other = Vec::new();
    for set in Dataset::open(path)?.sets_with(SetRange::ALL, PixelMode::None) {
        found += 1;
        for frame in set?.frames {
            frames += 1;
            let h = &frame.header;
            // After power-on; the metadata of colour have it in steps of 100 us.
            let exposure_us = if h.model() == "D405" { 33_000 } else { 8_500 };
            if h.clock_domain != ClockDomain::Device as u32 || h.exposure_ns != exposure_us * 1000 {
                other.push(format!("{} {}: {} ns", h.camera(), h.stream(), h.exposure_ns));
            }
        }
    }
    checks.equal("the dataset has the sets that the daemon counted", found, sets);
    checks.that(
        "every frame has the clock and the exposure of its camera",
        other.is_empty() && frames > 0,
        format!("{frames} frames; others: {other:?}"),
    );
    Ok(())
}
