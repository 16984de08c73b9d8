//! The daemon with two of the kernel's virtual cameras: one copied, one written into shared memory by the kernel itself.
//! Frames reach subscribers and the recording; a fatal error of one is cured by opening it again, beside the other.

use crate::checks::Checks;
use crate::daemon::{Daemon, drops, streams, summary};
use crate::feed::Feed;
use crate::{Scenario, vivid};
use anyhow::Context;
use depthrig_recorder::{VerifyOptions, verify};
use std::time::Duration;

/// See the module.
pub const SCENARIO: Scenario = Scenario {
    name: "v4l2-daemon",
    about: "the daemon with two vivid cameras, mmap and userptr: streams, records, reopens after a fatal error",
    cost: 2,
    limit_s: 60,
    needs: "",
    run,
};

fn run(checks: &mut Checks) -> anyhow::Result<()> {
    vivid::load(2)?;
    let camera = |name: &str, n: usize, memory: &str, format: &str| {
        format!(
            "[[camera]]\nname = \"{name}\"\nbackend = \"v4l2\"\nport = \"{}\"\nmemory = \"{memory}\"\nclock = \"kernel\"\n\
             controls = {{ osd_text_mode = \"None\", brightness = 99 }}\n\
             [[camera.stream]]\nname = \"color\"\nwidth = 320\nheight = 180\nrate_hz = 30.0\nformat = \"{format}\"\n",
            vivid::port(n)
        )
    };
    let daemon =
        Daemon::start(&(camera("copied", 0, "mmap", "yuyv") + &camera("lent", 1, "userptr", "mono16")))?;
    let status = daemon.wait_until_streaming()?;
    let ids: Vec<_> = status.cameras.iter().flat_map(|c| &c.streams).map(|s| s.id.parse()).collect();
    let ids = ids.into_iter().collect::<Result<Vec<_>, _>>()?;
    let feed = Feed::start(&daemon.runtime, &ids, |header, pixels| {
        let sum: u64 = pixels.iter().map(|b| u64::from(*b)).sum();
        (sum > 0).then_some(header.device_sequence)
    })?;
    let path = daemon.record("vivid")?;
    std::thread::sleep(Duration::from_secs(2));
    let recording = daemon.record_stop()?;
    let feed = feed.end()?;
    checks.that("both streams are read", feed.len() == 2, feed.len());
    let whole = feed.iter().all(|w| w.missed == 0 && w.lost() == 0 && w.in_order() && w.frames.len() > 55);
    let counts: Vec<_> = feed.iter().map(|w| (w.frames.len(), w.missed, w.lost())).collect();
    checks.that("every frame reaches a subscriber", whole, format!("{counts:?} (read, missed, lost)"));
    let status = daemon.status()?;
    for camera in &status.cameras {
        checks.equal(&format!("{} loses nothing", camera.name), drops(camera), "");
        let level = camera.streams.first().map(|s| s.clock.metadata.clone()).unwrap_or_default();
        checks.equal(&format!("{}: status says whose stamps", camera.name), level.as_str(), "kernel");
    }
    checks.that("sets are recorded", recording.sets >= 8, recording.sets);
    let report = verify(&path, &VerifyOptions { decode: true, ..VerifyOptions::default() })?;
    checks.that("the dataset is complete", report.is_whole(), format!("{:?}", report.findings));

    vivid::set(&vivid::capture_node(1)?, "inject_fatal_streaming_error", 1)?;
    let back = daemon.wait_for(Duration::from_secs(5), "the camera is opened again", |status| {
        status.cameras.iter().any(|c| c.name == "lent" && c.reconnects == 1 && streams(c))
    })?;
    checks.that("a fatal error is cured by opening the camera again", true, summary(&back));
    let other = back.cameras.iter().find(|c| c.name == "copied").context("the other camera")?;
    checks.equal("the other camera loses nothing", drops(other), "");
    let (status, took) = daemon.stop()?;
    checks.that("SIGTERM ends it well", status.success(), format!("{status} after {took:?}"));
    Ok(())
}
