//! Seven cameras with depth and colour through the kernel's own USB and video drivers, into the bus and the recorder.

use crate::Scenario;
use crate::checks::Checks;
use crate::daemon::Daemon;
use crate::feed::Feed;
use crate::mount::{self, Mount, Size};
use std::time::Duration;

/// See the module.
pub const SCENARIO: Scenario = Scenario {
    name: "fourteen",
    about: "seven cameras, depth and colour, 640x480 at 30 Hz, recorded: nothing is lost, every byte is right",
    cost: 20,
    limit_s: 120,
    needs: "",
    run,
};

const MODELS: [&str; 7] = ["d405", "d415", "d435", "d455", "d435", "d405", "d455"];
const SIZE: Size = Size { width: 640, height: 480, rate_hz: 30 };
const SECONDS: u64 = 3;

fn run(checks: &mut Checks) -> anyhow::Result<()> {
    let mount = Mount::plug(&MODELS, |_| 0)?;
    let daemon = Daemon::start(&mount.rig(SIZE))?;
    daemon.wait_until_settled()?;
    let ids = Mount::streams(0..MODELS.len())?;
    let (late, unread) = mount::not_sent(&mount, &ids)?;
    checks.note(format!("while the cameras opened, {late} frames were sent late and {unread} were not read"));
    let before = daemon.status()?;
    let feed = Feed::start(&daemon.runtime, &ids, mount::stamped)?;
    let path = daemon.record("fourteen")?;
    std::thread::sleep(Duration::from_secs(SECONDS));
    let recording = daemon.record_stop()?;
    let feed = feed.end()?;
    let status = daemon.status()?;

    mount::check_feed(checks, &feed, (u64::from(SIZE.rate_hz) * SECONDS) as usize - 3);
    mount::check_no_drops(checks, &before, &status, &[]);
    checks.equal("the emulator kept its times and was read", mount::not_sent(&mount, &ids)?, (late, unread));
    let wanted = 5 * SECONDS - 2;
    checks.that("sets are recorded at 5 Hz", recording.sets >= wanted, recording.sets);
    checks.equal(
        "all of them",
        (recording.dropped, recording.frames),
        (Default::default(), 14 * recording.sets),
    );
    // Its end is shown elsewhere; here it would first write the dataset's report, which takes seconds.
    daemon.kill()?;
    mount::check_dataset(checks, &mount, &path, false)
}
