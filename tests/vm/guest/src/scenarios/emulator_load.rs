//! Cost of seven emulated cameras: fourteen streams at 640x480 and 30 Hz through the kernel, with nobody but a bare
//! reader. The guest has one processor of 1e9 instructions a second, so the share is a count of instructions.

use crate::checks::Checks;
use crate::{Scenario, system};
use anyhow::Context;
use depthrig_bus::HostTime;
use depthrig_emulator::{Camera, Options};
use depthrig_usb::video::ImageSource;
use depthrig_v4l2::{FourCc, Node, Source, Wanted};
use std::path::Path;
use std::time::Duration;

/// See the module.
pub const SCENARIO: Scenario = Scenario {
    name: "emulator-load",
    about: "seven emulated cameras, fourteen streams, a bare reader: what the emulator costs, and that it is never late",
    cost: 3,
    limit_s: 60,
    needs: "",
    run,
};

const CAMERAS: usize = 7;
const TIME: Duration = Duration::from_secs(2);

/// Frames so far that the emulator made too late, and that the kernel did not take.
fn missed(cameras: &[Camera]) -> anyhow::Result<(u64, u64)> {
    let mut late = 0;
    let mut unread = 0;
    for camera in cameras {
        for stream in ["depth", "color"] {
            let accounts = camera.accounts(stream)?;
            late += accounts.late;
            unread += accounts.unread;
        }
    }
    Ok((late, unread))
}

fn run(checks: &mut Checks) -> anyhow::Result<()> {
    system::modprobe("vhci-hcd", &[])?;
    system::modprobe("uvcvideo", &[])?;
    let mut cameras = Vec::new();
    for _ in 0..CAMERAS {
        cameras.push(Camera::plug("d435", Options::default())?);
    }
    let all = || system::video_nodes().is_ok_and(|nodes| nodes.len() == 6 * CAMERAS);
    anyhow::ensure!(system::wait_until(Duration::from_secs(15), all), "not every camera has its nodes");
    let mut sources = Vec::new();
    for camera in 0..CAMERAS {
        let nodes = [(6 * camera, *b"Z16 "), (6 * camera + 4, *b"YUYV")];
        let wanted: anyhow::Result<Vec<Wanted>> =
            nodes.into_iter().map(|(n, f)| wanted(n, FourCc(f))).collect();
        sources.push(Source::start(wanted?, 4)?);
    }
    // Nobody reads the first cameras while the last are being started.
    for source in &mut sources {
        source.poll(Duration::from_millis(1), &mut |_| ())?;
    }
    let (late_before, unread_before) = missed(&cameras)?;
    let before = emulator_ns()?;
    let started = HostTime::now();
    let end = HostTime::now().plus(TIME);
    let mut read = 0u64;
    while HostTime::now() < end {
        for source in &mut sources {
            source.poll(Duration::from_millis(1), &mut |_| read += 1)?;
        }
    }
    let took = started.elapsed();
    let share = (emulator_ns()? - before) as f64 / took.as_nanos() as f64;
    let (late, unread) = missed(&cameras)?;
    checks.note(format!(
        "{:.1} % of the processor for {read} frames in {:.2} s",
        share * 100.0,
        took.as_secs_f64()
    ));
    checks.equal("frames that the emulator sent too late", late - late_before, 0);
    checks.equal("frames that the kernel did not take", unread - unread_before, 0);
    let full = (2 * CAMERAS as u64 * 30 * took.as_millis() as u64) / 1000;
    checks.that(
        "all frames are read",
        read + 2 * 2 * CAMERAS as u64 >= full,
        format!("{read} of about {full}"),
    );
    checks.that("the emulator takes less than a fifth of the processor", share < 0.2, share);
    Ok(())
}

fn wanted(number: usize, format: FourCc) -> anyhow::Result<Wanted> {
    let node = Node::open(Path::new(&format!("/dev/video{number}")))?;
    let modes = node.modes(|f| f == format)?;
    let mode =
        modes.iter().find(|m| (m.width, m.height) == (640, 480) && m.interval.rate_hz().round() == 30.0);
    node.set_mode(mode.context("no 640x480 at 30 Hz")?)?;
    Ok(Wanted::plain(node))
}

/// Processor time of the threads of all emulated cameras, nanoseconds, that of the kernel on their behalf included.
fn emulator_ns() -> anyhow::Result<u64> {
    let mut sum = 0;
    for task in std::fs::read_dir("/proc/self/task")? {
        let path = task?.path();
        if std::fs::read_to_string(path.join("comm"))?.starts_with("emu ") {
            let text = std::fs::read_to_string(path.join("schedstat"))?;
            sum += text.split_whitespace().next().context("schedstat is empty")?.parse::<u64>()?;
        }
    }
    Ok(sum)
}
