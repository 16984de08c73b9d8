//! One camera is unplugged and plugged in again, twenty times, while six others and it are recorded.

use crate::Scenario;
use crate::checks::Checks;
use crate::daemon::{Daemon, streams};
use crate::feed::{Feed, Watched};
use crate::mount::{self, Mount, Size};
use anyhow::Context;
use depthrig_bus::HostTime;
use depthrig_daemon::status::{CameraStatus, RigStatus};
use depthrig_recorder::Dataset;
use std::path::Path;
use std::time::Duration;

/// See the module.
pub const SCENARIO: Scenario = Scenario {
    name: "replug",
    about: "one of seven cameras unplugged and replugged 20 times while all are recorded: the six lose nothing",
    cost: 40,
    limit_s: 180,
    needs: "",
    run,
};

const MODELS: [&str; 7] = ["d435", "d455", "d415", "d435", "d405", "d435", "d455"];
/// The camera that is unplugged.
const VICTIM: usize = 3;
/// Small, because only the events matter; the slowest rate that all models have.
const SIZE: Size = Size { width: 424, height: 240, rate_hz: 15 };
const TIMES: u64 = 20;
/// From the plug to the first frames of both streams.
const BACK_WITHIN: Duration = Duration::from_secs(2);

fn run(checks: &mut Checks) -> anyhow::Result<()> {
    let mount = Mount::plug(&MODELS, |_| 0)?;
    let daemon = Daemon::start(&mount.rig(SIZE))?;
    daemon.wait_until_settled()?;
    let six: Vec<usize> = (0..MODELS.len()).filter(|i| *i != VICTIM).collect();
    let before = daemon.status()?;
    let six = Mount::streams(six)?;
    let not_sent = mount::not_sent(&mount, &six)?;
    let feed = Feed::start(&daemon.runtime, &six, mount::stamped)?;
    let victim_feed = Feed::start(&daemon.runtime, &Mount::streams([VICTIM])?, mount::stamped)?;
    let path = daemon.record("replug")?;
    let port = mount.cameras[VICTIM].port_path();

    let mut back = Vec::new();
    for round in 0..TIMES {
        back.push(replug(&daemon, &mount, round)?);
    }
    let longest = back.iter().max().copied().unwrap_or_default();
    let mean = back.iter().sum::<Duration>() / TIMES as u32;
    let detail = format!("{} times; at most {longest:.2?}, mean {mean:.2?}", back.len());
    checks.that("it is back within 2 s each time", longest <= BACK_WITHIN, detail);
    checks.equal("in the same port", mount.cameras[VICTIM].port_path(), port);

    let recording = daemon.record_stop()?;
    let feed = feed.end()?;
    let victim_feed = victim_feed.end()?;
    let status = daemon.status()?;
    checks.equal("the daemon counts each return", victim(&status)?.reconnects, TIMES);
    mount::check_feed(checks, &feed, 100);
    mount::check_no_drops(checks, &before, &status, &[Mount::name(VICTIM)]);
    checks.equal("the emulator kept its times and was read", mount::not_sent(&mount, &six)?, not_sent);
    check_victim(checks, &mount, &victim_feed)?;
    checks.equal("no set is lost", recording.dropped, Default::default());
    // Its end is shown elsewhere; here it would first write the dataset's report, which takes seconds.
    daemon.kill()?;
    mount::check_dataset(checks, &mount, &path, false)?;
    check_accounts(checks, &path, recording.sets)
}

/// Unplugs the camera for a while and plugs it in again; how long it took until both streams had a frame.
fn replug(daemon: &Daemon, mount: &Mount, round: u64) -> anyhow::Result<Duration> {
    let camera = &mount.cameras[VICTIM];
    camera.unplug()?;
    let left = HostTime::now();
    daemon.wait_for(Duration::from_secs(2), "the unplugged camera is missed", |s| {
        !victim(s).is_ok_and(streams)
    })?;
    // Away for 25 ms to 1 s, so that it comes back at every moment of the daemon's pauses; every fourth time for long.
    let away = Duration::from_millis(50 + round * 370 % 950) / if round.is_multiple_of(4) { 1 } else { 3 };
    std::thread::sleep(left.plus(away).from_now());
    let delivered =
        |s: &RigStatus| victim(s).map(|c| c.streams.iter().map(|s| s.delivered).collect::<Vec<_>>());
    let before = delivered(&daemon.status()?)?;
    let plugged = HostTime::now();
    camera.replug()?;
    daemon.wait_for(Duration::from_secs(10), "the camera comes back", |status| {
        victim(status).is_ok_and(streams)
            && delivered(status).is_ok_and(|now| now.iter().zip(&before).all(|(now, before)| now > before))
    })?;
    Ok(plugged.elapsed())
}

/// The status of the camera that is unplugged.
fn victim(status: &RigStatus) -> anyhow::Result<&CameraStatus> {
    status.cameras.get(VICTIM).context("a rig of seven cameras")
}

/// The unplugged camera's frames: each at most once, none damaged, and its books balance.
fn check_victim(checks: &mut Checks, mount: &Mount, feed: &[Watched]) -> anyhow::Result<()> {
    for watched in feed {
        let accounts = mount.accounts(&watched.id)?;
        let frames = watched.frames.len() as u64;
        let detail = format!("{frames} seen of {} sent", accounts.good);
        // Frames on their way when the plug is pulled are lost: a few each time.
        let plausible = frames <= accounts.good && frames + (TIMES + 1) * 5 >= accounts.good;
        checks.that(
            &format!("{}: frames come once, in order", watched.id),
            watched.in_order() && plausible,
            detail,
        );
        let balanced = watched.frames.iter().all(|f| f.captured == f.sequence + f.dropped);
        checks.that(&format!("{}: captured = delivered + dropped in every header", watched.id), balanced, "");
    }
    Ok(())
}

/// The dataset's own accounts: they balance, and each set has each stream or says that it is missing.
fn check_accounts(checks: &mut Checks, path: &Path, sets: u64) -> anyhow::Result<()> {
    let info = Dataset::open(path)?.info()?;
    checks.equal("the dataset has the sets that the daemon counted", info.sets, sets);
    let counts = info.set_counts.unwrap_or_default();
    checks.that(
        "offered = recorded + dropped",
        counts.balances() && counts.recorded == sets,
        format!("{counts:?}"),
    );
    let unbalanced: Vec<_> =
        info.accounts.iter().filter(|a| !a.balances()).map(|a| a.stream.to_string()).collect();
    checks.equal("captured = delivered + dropped for each stream", unbalanced.join(", "), "");
    let name = Mount::name(VICTIM);
    let odd: Vec<_> = info
        .streams
        .iter()
        .filter(|s| s.frames + s.missing != sets || (!s.stream.starts_with(&name) && s.missing > 0))
        .map(|s| format!("{}: {} frames, {} missing", s.stream, s.frames, s.missing))
        .collect();
    checks.equal("only the unplugged camera is missing from sets", odd.join(", "), "");
    let missing: u64 = info.streams.iter().filter(|s| s.stream.starts_with(&name)).map(|s| s.missing).sum();
    checks.that("and it is", missing > 0, missing);
    Ok(())
}
