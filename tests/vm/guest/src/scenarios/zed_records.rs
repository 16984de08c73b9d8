//! The daemon with a ZED 2i: both eyes recorded bit by bit with their calibration, and the camera pulled meanwhile.

use crate::checks::Checks;
use crate::daemon::{Daemon, streams};
use crate::{Scenario, system};
use anyhow::Context;
use depthrig_bus::HostTime;
use depthrig_daemon::status::CameraState;
use depthrig_emulator::{Camera, Options, Stamp};
use depthrig_recorder::{Dataset, SetRange, VerifyOptions, verify};
use std::time::Duration;

/// See the module.
pub const SCENARIO: Scenario = Scenario {
    name: "zed-records",
    about: "the daemon with a ZED 2i: recorded bit by bit with calibration; pulled and back while it records",
    cost: 14,
    limit_s: 90,
    run,
};

const SERIAL: &str = "31234567";
const PATIENCE: Duration = Duration::from_secs(10);

fn run(checks: &mut Checks) -> anyhow::Result<()> {
    for module in ["vhci-hcd", "uvcvideo", "usbhid", "hid-generic"] {
        system::modprobe(module, &[])?;
    }
    let camera = Camera::plug("zed2i", Options { serial: Some(SERIAL.into()), ..Options::default() })?;
    let conf = format!("/tmp/SN{SERIAL}.conf");
    std::fs::write(&conf, camera.calibration().zed_conf())?;
    let mut text = format!(
        "[[camera]]\nname = \"zed\"\nbackend = \"zed\"\nserial = \"{SERIAL}\"\ncalibration = \"{conf}\"\n\
         exposure_percent = 40\n"
    );
    for eye in ["left", "right"] {
        text += &format!("[[camera.stream]]\nname = \"{eye}\"\nwidth = 672\nheight = 376\nrate_hz = 30.0\n");
    }
    let daemon = Daemon::start(&text)?;
    let status = daemon.wait_until_streaming()?;
    let zed = status.cameras.first().context("no camera")?;
    checks.equal(
        "its model and serial are known",
        (zed.model.as_str(), zed.serial.as_str()),
        ("ZED 2i", SERIAL),
    );
    let told: Vec<_> = zed.streams.iter().map(|s| s.id.as_str()).collect();
    checks.equal("both eyes are streams", told, ["zed/left", "zed/right"]);

    let path = daemon.record("stereo")?;
    std::thread::sleep(Duration::from_secs(2));
    camera.unplug()?;
    let gone = |c: CameraState| c != CameraState::Streaming;
    daemon.wait_for(PATIENCE, "the camera is missed", |s| s.cameras.iter().all(|c| gone(c.state)))?;
    std::thread::sleep(Duration::from_millis(500));
    camera.replug()?;
    let back = HostTime::now();
    let again = daemon.wait_for(PATIENCE, "it streams again", |s| s.cameras.iter().all(streams));
    let took = back.elapsed();
    checks.that(
        "plugged in again, it streams within 2 s",
        again.is_ok() && took < Duration::from_secs(2),
        format!("{took:?}"),
    );
    std::thread::sleep(Duration::from_secs(1));
    let recording = daemon.record_stop()?;
    checks.that("sets are recorded", recording.sets >= 12, recording.sets);
    let status = daemon.status()?;
    let zed = status.cameras.first().context("no camera")?;
    for s in &zed.streams {
        let lost: u64 = s.dropped.values().sum();
        checks.equal(&format!("the account of {} is exact", s.id), s.captured, s.delivered + lost);
    }
    let (ended, took) = daemon.stop()?;
    checks.that("SIGTERM ends it well", ended.success(), format!("{ended} after {took:?}"));

    let report = verify(&path, &VerifyOptions { decode: true, ..VerifyOptions::default() })?;
    let broken: Vec<_> =
        report.findings.iter().filter(|f| f.severity > depthrig_recorder::Severity::Lost).collect();
    checks.that("the dataset is what it says", broken.is_empty(), format!("{:?}", report.findings));
    let dataset = Dataset::open(&path)?;
    let session = dataset.session().clone();
    let given = camera.calibration().zed.into_iter().find(|m| m.name == "VGA").context("no VGA")?;
    for (s, eye) in session.streams.iter().zip([given.left, given.right]) {
        let i = s.intrinsics;
        let same = [i.fx, i.fy, i.cx, i.cy] == eye.pinhole && i.coeffs[..5] == eye.distortion;
        checks.that(&format!("the session has the lens of {}", s.id), same, format!("{i:?}"));
        checks.equal(
            &format!("and its source, of {}", s.id),
            s.calibration.clone(),
            format!("factory {conf}"),
        );
    }
    let baseline = |axis: usize| {
        session.streams[1].pose.translation_m[axis] - session.streams[0].pose.translation_m[axis]
    };
    let length = (0..3).map(|a| baseline(a).powi(2)).sum::<f64>().sqrt();
    let truth = given.translation_mm.iter().map(|v| v * v).sum::<f64>().sqrt() / 1000.0;
    checks.that("and the baseline", (length - truth).abs() < 1e-9, format!("{length} m"));

    let (mut frames, mut equal, mut pairs) = (0, 0, 0);
    for set in dataset.sets(SetRange::ALL) {
        let set = set?;
        let mut indexes = Vec::new();
        for f in &set.frames {
            let stamp = Stamp::read(&f.pixels).context("a frame without a stamp")?;
            let sent = camera.expected("stereo", stamp.index)?;
            let row = sent.len() / 376;
            let at = f.stream * row / 2;
            let half: Vec<u8> = sent.chunks_exact(row).flat_map(|r| r[at..at + row / 2].to_vec()).collect();
            frames += 1;
            equal += usize::from(f.pixels == half);
            indexes.push(stamp.index);
        }
        pairs += usize::from(indexes.len() == 2 && indexes[0] == indexes[1]);
    }
    checks.that("frames are in the dataset", frames >= 24, frames);
    checks.equal("each is byte for byte what was sent", equal, frames);
    checks.equal("both eyes of a set are of one exposure", 2 * pairs, frames);
    Ok(())
}
