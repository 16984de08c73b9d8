//! Plain USB cameras under the daemon, by the backend `v4l2` and the kernel's `uvcvideo`: Motion JPEG kept and decoded,
//! and depth. Every image in the dataset is the one that was sent.

use crate::checks::Checks;
use crate::daemon::{Daemon, drops};
use crate::subject::plug;
use crate::{Scenario, system};
use anyhow::Context;
use core::fmt::Write;
use depthrig_bus::{HostTime, PixelFormat};
use depthrig_emulator::{Camera, Options, Stamp, content};
use depthrig_recorder::{Dataset, DatasetFrame, PixelMode, SetRange, VerifyOptions, verify};
use std::time::Duration;

/// See the module.
pub const SCENARIO: Scenario = Scenario {
    name: "uvc",
    about: "the daemon with plain USB cameras: Motion JPEG kept as it came and decoded, Z16; recorded byte by byte",
    cost: 3,
    limit_s: 60,
    needs: "",
    run,
};

/// Name in the rig and what becomes of its JPEG; each has depth as well.
const CAMERAS: [(&str, &str); 2] = [("kept", "keep"), ("decoded", "decode")];
/// How far a decoded byte may be from the painted one, at quality 95 with colour at half the width.
const NEAR: u8 = 8;

fn run(checks: &mut Checks) -> anyhow::Result<()> {
    system::modprobe("vhci-hcd", &[])?;
    system::modprobe("uvcvideo", &[])?;
    let cameras: Vec<Camera> =
        CAMERAS.iter().map(|_| plug("uvc", Options::default())).collect::<anyhow::Result<_>>()?;
    let mut rig = String::new();
    for ((name, mjpeg), camera) in CAMERAS.iter().zip(&cameras) {
        let color = if *mjpeg == "keep" { "mjpeg" } else { "rgb8" };
        write!(
            rig,
            "[[camera]]\nname = \"{name}\"\nbackend = \"v4l2\"\nserial = \"{}\"\nmjpeg = \"{mjpeg}\"\n\
             depth_unit_m = 0.00025\n",
            camera.serial()
        )?;
        for (stream, format) in [("color", color), ("depth", "z16")] {
            write!(
                rig,
                "[[camera.stream]]\nname = \"{stream}\"\nwidth = 160\nheight = 120\nrate_hz = 30.0\nformat = \"{format}\"\n"
            )?;
        }
    }
    let daemon = Daemon::start(&rig)?;
    let before = daemon.wait_until_settled()?;
    let path = daemon.record("uvc")?;
    std::thread::sleep(Duration::from_secs(2));
    let recording = daemon.record_stop()?;
    let status = daemon.status()?;
    for (now, then) in status.cameras.iter().zip(&before.cameras) {
        checks.equal(&format!("{} loses nothing", now.name), drops(now), drops(then).as_str());
        let levels: Vec<_> = now.streams.iter().map(|s| s.clock.metadata.as_str()).collect();
        checks.equal(&format!("{}: times are the camera's", now.name), levels, ["header"; 2]);
    }
    checks.that("sets are recorded", recording.sets >= 8, recording.sets);
    let (ended, took) = daemon.stop()?;
    checks.that("SIGTERM ends it well", ended.success(), format!("{ended} after {took:?}"));
    let report = verify(&path, &VerifyOptions { decode: true, ..VerifyOptions::default() })?;
    checks.that("the dataset is complete", report.is_whole(), format!("{:?}", report.findings));

    let mut seen = Seen::default();
    let mut off_ns = 0;
    for set in Dataset::open(&path)?.sets_with(SetRange::ALL, PixelMode::DecodedAndStored) {
        for frame in &set?.frames {
            let at = CAMERAS.iter().position(|(name, _)| *name == frame.header.camera());
            let camera =
                cameras.get(at.context("a frame of a camera that is not there")?).context("no camera")?;
            let index = seen.compare(camera, frame)?;
            if let Some(index) = index {
                let truth: HostTime = camera.true_capture(frame.header.stream(), index)?;
                off_ns = frame.header.capture_time_ns.abs_diff(truth.ns()).max(off_ns);
            }
        }
    }
    for (what, tally) in
        [("depth", seen.depth), ("JPEG images that are kept", seen.kept), ("decoded images", seen.decoded)]
    {
        checks.that(
            &format!("{what}: each is the one that was sent"),
            tally.1 == 0 && tally.0 >= recording.sets - 2,
            format!("{} of {} differ", tally.1, tally.0),
        );
    }
    checks.note(format!("capture times are off by at most {:.1} ms", f64::from(off_ns as u32) / 1e6));
    Ok(())
}

/// Frames, and how many of them differ from what was sent.
#[derive(Default)]
struct Seen {
    depth: (u64, u64),
    kept: (u64, u64),
    decoded: (u64, u64),
}

impl Seen {
    /// Compares a frame with what `camera` sent; its index, if it has a stamp.
    fn compare(&mut self, camera: &Camera, frame: &DatasetFrame) -> anyhow::Result<Option<u64>> {
        let header = &frame.header;
        let (tally, is_same, index) = match header.pixel_format().context("a format that is not known")? {
            PixelFormat::Z16 => {
                let index = Stamp::read(&frame.pixels).context("depth without a stamp")?.index;
                let same = frame.pixels == camera.expected("depth", index)?;
                (&mut self.depth, same && (header.depth_unit_m - 0.000_25).abs() < 1e-12, Some(index))
            }
            PixelFormat::Mjpeg => {
                // As it came: not coded again, and not a byte taken away.
                let jpeg = &frame.pixels;
                let index = Stamp::read(jpeg).context("a JPEG without its comment")?.index;
                (&mut self.kept, *jpeg == camera.expected("color", index)?, Some(index))
            }
            PixelFormat::Rgb8 => {
                // The comment with the stamp is gone with the JPEG; all of a camera's images are one.
                let mode = camera.mode("color", 0)?;
                let painted = content::painted(camera.serial(), 0, &mode);
                let near = frame.pixels.iter().zip(&painted).all(|(a, b)| a.abs_diff(*b) <= NEAR);
                (&mut self.decoded, near && frame.pixels.len() == painted.len(), None)
            }
            other => anyhow::bail!("a frame in {other:?}"),
        };
        tally.0 += 1;
        tally.1 += u64::from(!is_same);
        Ok(index)
    }
}
