//! The daemon in the guest, with simulated cameras: it starts, streams, records and ends as on any other computer.

use crate::Scenario;
use crate::checks::Checks;
use crate::daemon::{Daemon, drops};
use crate::feed::Feed;
use depthrig_recorder::{VerifyOptions, verify};
use std::time::Duration;

/// See the module.
pub const SCENARIO: Scenario = Scenario {
    name: "daemon-smoke",
    about: "the daemon with two simulated cameras: streams, records, ends",
    cost: 4,
    limit_s: 60,
    needs: "",
    run,
};

fn run(checks: &mut Checks) -> anyhow::Result<()> {
    let camera = |name: &str| {
        format!(
            "[[camera]]\nname = \"{name}\"\nbackend = \"synthetic\"\nmodel = \"d405\"\ncheap = true\n\
             [[camera.stream]]\nname = \"color\"\nwidth = 424\nheight = 240\nrate_hz = 30.0\n\
             [[camera.stream]]\nname = \"depth\"\nwidth = 424\nheight = 240\nrate_hz = 30.0\n"
        )
    };
    let daemon = Daemon::start(&(camera("one") + &camera("two")))?;
    let status = daemon.wait_until_streaming()?;
    let ids: Vec<_> = status.cameras.iter().flat_map(|c| &c.streams).map(|s| s.id.parse()).collect();
    let ids = ids.into_iter().collect::<Result<Vec<_>, _>>()?;
    let feed = Feed::start(&daemon.runtime, &ids, |header, _| Some(header.device_sequence))?;
    let path = daemon.record("smoke")?;
    std::thread::sleep(Duration::from_secs(2));
    let recording = daemon.record_stop()?;
    let feed = feed.end()?;
    checks.that("four streams are read", feed.len() == 4, feed.len());
    checks.that("every frame reaches a subscriber", feed.iter().all(|w| w.missed == 0 && w.lost() == 0), "");
    for camera in daemon.status()?.cameras {
        checks.equal(&format!("{} loses nothing", camera.name), drops(&camera), "");
    }
    checks.that("sets are recorded", recording.sets >= 9, recording.sets);
    let report = verify(&path, &VerifyOptions { decode: true, ..VerifyOptions::default() })?;
    checks.that("the dataset is complete", report.is_whole(), format!("{:?}", report.findings));
    let (status, took) = daemon.stop()?;
    checks.that("SIGTERM ends it well", status.success(), format!("{status} after {took:?}"));
    Ok(())
}
