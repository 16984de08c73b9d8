//! Life of a daemon and its cameras: a hub that resets, a camera that comes late, SIGTERM, and a crash.

use crate::Scenario;
use crate::checks::Checks;
use crate::daemon::{self, Daemon};
use crate::feed::Feed;
use crate::mount::{self, Mount, Size};
use crate::system::wait_until;
use anyhow::Context;
use depthrig_bus::HostTime;
use depthrig_daemon::status::CameraState;
use depthrig_emulator::Hub;
use depthrig_recorder::Dataset;
use std::path::Path;
use std::time::Duration;

/// See the module.
pub const SCENARIO: Scenario = Scenario {
    name: "daemon-life",
    about: "a hub reset, a camera that comes late, SIGTERM while streaming, kill -9 and recovery",
    cost: 12,
    limit_s: 120,
    needs: "",
    run,
};

const MODELS: [&str; 4] = ["d435", "d455", "d415", "d435"];
/// The first three hang on one controller.
const HUB: usize = 3;
/// The camera that is not there at the start.
const LATE: usize = 1;
const SIZE: Size = Size { width: 424, height: 240, rate_hz: 15 };

fn run(checks: &mut Checks) -> anyhow::Result<()> {
    let mount = Mount::plug(&MODELS, |i| u32::from(i >= HUB))?;
    mount.cameras[LATE].unplug()?;
    let daemon = Daemon::start(&mount.rig(SIZE))?;
    late(checks, &daemon, &mount)?;
    hub_reset(checks, &daemon, &mount)?;
    terminated(checks, daemon, &mount)?;
    crashed(checks, &mount)
}

/// A camera that is absent at the start keeps nobody from streaming, is named, and is found when it comes.
fn late(checks: &mut Checks, daemon: &Daemon, mount: &Mount) -> anyhow::Result<()> {
    let present = |s: &depthrig_daemon::status::RigStatus| {
        s.cameras.iter().enumerate().all(|(i, c)| i == LATE || daemon::streams(c))
    };
    let status = daemon.wait_for(Duration::from_secs(20), "the others stream", present)?;
    let camera = &status.cameras[LATE];
    let message = camera.message.clone().unwrap_or_default();
    checks.that("an absent camera is waited for", camera.state != CameraState::Failed, camera.state.name());
    checks.that("its message names its serial", message.contains(mount.cameras[LATE].serial()), message);
    let plugged = HostTime::now();
    mount.cameras[LATE].replug()?;
    daemon.wait_until_streaming()?;
    let took = plugged.elapsed();
    checks.that("it streams soon after it has come", took <= Duration::from_secs(4), format!("{took:.2?}"));
    Ok(())
}

/// Three cameras of one hub go and come back at once; the fourth loses nothing.
fn hub_reset(checks: &mut Checks, daemon: &Daemon, mount: &Mount) -> anyhow::Result<()> {
    let feed = Feed::start(&daemon.runtime, &Mount::streams([HUB])?, mount::stamped)?;
    let before: Vec<u64> = daemon.status()?.cameras.iter().map(|c| c.reconnects).collect();
    let started = HostTime::now();
    let reset = Hub::reset(&mount.cameras, 0, Duration::from_millis(700))?;
    checks.equal("three cameras drop off the bus", reset, HUB);
    let all_back = |s: &depthrig_daemon::status::RigStatus| {
        s.cameras.iter().zip(&before).take(HUB).all(|(c, n)| daemon::streams(c) && c.reconnects > *n)
    };
    daemon.wait_for(Duration::from_secs(20), "the three come back", all_back)?;
    let took = started.elapsed();
    checks.that(
        "they are back soon",
        took <= Duration::from_secs(4),
        format!("{took:.2?}, 0.7 s of it away"),
    );
    let after: Vec<u64> = daemon.status()?.cameras.iter().map(|c| c.reconnects).collect();
    let grown: Vec<u64> = after.iter().zip(&before).map(|(after, before)| after - before).collect();
    checks.equal("each of them once, the fourth never", grown, vec![1, 1, 1, 0]);
    mount::check_feed(checks, &feed.end()?, 10);
    Ok(())
}

/// SIGTERM while cameras stream and are recorded: it ends well, the dataset is complete, and the cameras are released.
fn terminated(checks: &mut Checks, daemon: Daemon, mount: &Mount) -> anyhow::Result<()> {
    let path = daemon.record("terminated")?;
    std::thread::sleep(Duration::from_secs(1));
    let (status, took) = daemon.stop()?;
    // 3: something was lost on the way, and the hub reset has seen to that.
    checks.that(
        "SIGTERM ends it",
        matches!(status.code(), Some(0 | 3)),
        format!("{status} after {took:.2?}"),
    );
    checks.that("within 3 s", took <= Duration::from_secs(3), format!("{took:.2?}"));
    mount::check_dataset(checks, mount, &path, false)?;
    let started =
        |name| mount.cameras.iter().map(|c| c.accounts(name).map(|a| a.sent)).collect::<Result<Vec<_>, _>>();
    let before = started("depth")?;
    std::thread::sleep(Duration::from_millis(500));
    checks.equal("no camera sends any more", started("depth")?, before);
    Ok(())
}

/// A daemon that is killed while it records: the next one finds the cameras streaming, and mends the dataset.
fn crashed(checks: &mut Checks, mount: &Mount) -> anyhow::Result<()> {
    let daemon = Daemon::start(&mount.rig(SIZE))?;
    daemon.wait_until_streaming()?;
    let path = daemon.record("crashed")?;
    std::thread::sleep(Duration::from_millis(2500));
    daemon.kill()?;
    let started = HostTime::now();
    let again = Daemon::start(&mount.rig(SIZE))?;
    again.wait_until_streaming()?;
    let took = started.elapsed();
    checks.that(
        "after kill -9 the next daemon streams",
        took <= Duration::from_secs(10),
        format!("{took:.2?}"),
    );
    let mended = wait_until(Duration::from_secs(20), || is_mended(&path));
    checks.that("it has recovered the dataset", mended, path.display());
    let sets = Dataset::open(&path).context("the recovered dataset")?.info()?.sets;
    checks.that("which has lost its last second at most", sets >= 6, format!("{sets} sets of 12 or so"));
    mount::check_dataset(checks, mount, &path, true)?;
    let (status, _) = again.stop()?;
    checks.that("the next daemon ends well", matches!(status.code(), Some(0 | 3)), status);
    Ok(())
}

/// Whether a recording that was cut off is a closed dataset now.
fn is_mended(path: &Path) -> bool {
    Dataset::open(path).and_then(|d| d.info()).is_ok_and(|i| i.unfinished.is_empty() && i.problems.is_empty())
}
