//! The daemon with a ZED 2i: left and right recorded bit by bit with their calibration, every sample of the IMU on the
//! bus with its values and its time, and the camera pulled meanwhile.

use crate::checks::Checks;
use crate::daemon::{self, Daemon, streams};
use crate::{Scenario, system};
use anyhow::Context;
use depthrig_bus::{Bus, HostTime, MotionFlags, MotionSample, RigName, StreamId};
use depthrig_daemon::status::CameraState;
use depthrig_emulator::{Camera, Options, Stamp};
use depthrig_recorder::{Dataset, SetRange, VerifyOptions, verify};
use depthrig_zed::imu::NO_POSE;
use depthrig_zed::sensors::Record;
use std::time::Duration;

/// See the module.
pub const SCENARIO: Scenario = Scenario {
    name: "zed-records",
    about: "the daemon with a ZED 2i: recorded bit by bit with calibration; pulled and back while it records",
    cost: 13,
    limit_s: 90,
    needs: "",
    run,
};

const SERIAL: &str = "31234567";
const TIMEOUT: Duration = Duration::from_secs(10);

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
    for side in ["left", "right"] {
        text += &format!("[[camera.stream]]\nname = \"{side}\"\nwidth = 672\nheight = 376\nrate_hz = 30.0\n");
    }
    text += "[[camera.stream]]\nname = \"imu\"\n";
    let daemon = Daemon::start(&text)?;
    let status = daemon.wait_until_streaming()?;
    let zed = status.cameras.first().context("no camera")?;
    checks.equal(
        "its model and serial are known",
        (zed.model.as_str(), zed.serial.as_str()),
        ("ZED 2i", SERIAL),
    );
    let ids: Vec<_> = zed.streams.iter().map(|s| s.id.as_str()).collect();
    checks.equal("left, right and the IMU are streams", ids, ["zed/left", "zed/right", "zed/imu"]);
    motion(checks, &daemon)?;

    let path = daemon.record("stereo")?;
    std::thread::sleep(Duration::from_secs(2));
    camera.unplug()?;
    let gone = |c: CameraState| c != CameraState::Streaming;
    daemon.wait_for(TIMEOUT, "the camera is missed", |s| s.cameras.iter().all(|c| gone(c.state)))?;
    std::thread::sleep(Duration::from_millis(500));
    camera.replug()?;
    let back = HostTime::now();
    let again = daemon.wait_for(TIMEOUT, "it streams again", |s| s.cameras.iter().all(streams));
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
    checks.that("the dataset verifies", broken.is_empty(), format!("{:?}", report.findings));
    let dataset = Dataset::open(&path)?;
    let session = dataset.session().clone();
    let given = camera.calibration().zed.into_iter().find(|m| m.name == "VGA").context("no VGA")?;
    for (s, lens) in session.streams.iter().zip([given.left, given.right]) {
        let i = s.intrinsics;
        let same = [i.fx, i.fy, i.cx, i.cy] == lens.pinhole && i.coeffs[..5] == lens.distortion;
        checks.that(&format!("the session has the lens of {}", s.id), same, format!("{i:?}"));
        checks.equal(
            &format!("and its source, of {}", s.id),
            s.calibration.clone(),
            format!("factory {conf}{NO_POSE}"),
        );
    }
    let baseline = |axis: usize| {
        session.streams[1].pose.translation_m[axis] - session.streams[0].pose.translation_m[axis]
    };
    let length = (0..3).map(|a| baseline(a).powi(2)).sum::<f64>().sqrt();
    let truth = given.translation_mm.iter().map(|v| v * v).sum::<f64>().sqrt() / 1000.0;
    checks.that("and the baseline", (length - truth).abs() < 1e-9, format!("{length} m"));

    let mut frames = 0;
    let mut equal = 0;
    let mut pairs = 0;
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
    checks.equal("left and right images of a set are of one exposure", 2 * pairs, frames);
    Ok(())
}

/// A subscriber of the IMU gets every record of the emulated unit, in order, with its values, its temperature and its
/// time. The unit's ticks are the guest's own clock, so the truth of each sample is in itself.
fn motion(checks: &mut Checks, running: &Daemon) -> anyhow::Result<()> {
    const SAMPLES: usize = 2000;
    let bus = Bus::open(&running.runtime, &RigName::new(daemon::RIG)?)?;
    let mut reader = bus.subscriber_within(&StreamId::new("zed", "imu")?, TIMEOUT)?;
    let mut samples: Vec<MotionSample> = Vec::new();
    let mut batches: Vec<u64> = Vec::new();
    let mut headers: u64 = 0;
    let end = HostTime::now().plus(TIMEOUT);
    while samples.len() < SAMPLES && HostTime::now() < end {
        while let Some(frame) = reader.try_next()? {
            let h = frame.header();
            let newest = frame.motion().last().context("an empty batch")?;
            let holds = (h.device_sequence, h.device_time, h.capture_time_ns)
                == (newest.sequence, newest.device_time, newest.time_ns)
                && frame.motion().len() == h.width as usize
                && h.width <= 16;
            headers += u64::from(holds);
            batches.push(h.sequence);
            samples.extend(frame.motion());
        }
        std::thread::sleep(Duration::from_millis(10));
    }
    checks.that("samples of the IMU reach a subscriber", samples.len() >= SAMPLES, samples.len());
    checks.equal("each batch's header is that of its newest sample", headers, batches.len() as u64);
    checks.that("no batch is missed", batches.is_sorted_by(|a, b| a + 1 == *b), "");
    // The unit's wave goes up by one from record to record, from -200 to 199.
    let wave =
        |s: &MotionSample| (f64::from(s.gyro_rad_s[0]).to_degrees() / (1000.0 / 32_768.0)).round() as i64;
    let step = |w: &[MotionSample]| w[1].sequence.wrapping_sub(w[0].sequence);
    let counted = |w: &&[MotionSample]| {
        step(w) >= 1 && (wave(&w[1]) - wave(&w[0])).rem_euclid(400).cast_unsigned() == step(w) % 400
    };
    let known = samples.windows(2).filter(counted).count();
    checks.equal("none comes twice, and numbers show each that is missing", known, samples.len() - 1);
    // The kernel keeps 64 records for a reader, 160 ms, which so many processes on one slow processor may not be given in time.
    let missing: u64 = samples.windows(2).map(|w| step(w) - 1).sum();
    checks.that("hardly any is", missing <= SAMPLES as u64 / 100, missing);
    let wrong = samples.iter().filter(|s| {
        let record = Record {
            motion_valid: true,
            gyro_raw: [wave(s) as i16, -wave(s) as i16, 3],
            acceleration_raw: [0, 4096, wave(s) as i16],
            ..Record::default()
        };
        s.gyro_rad_s != record.gyro_rad_s().map(|v| v as f32)
            || s.accel_m_s2 != record.acceleration_m_s2().map(|v| v as f32)
            || (s.temperature_c - 31.5).abs() > 1e-6
    });
    checks.equal("values are those of the records", wrong.count(), 0);
    let synced = samples.iter().filter(|s| s.has(MotionFlags::FRAME_SYNC)).count();
    // 30 a second, of 400.
    checks.that("30 a second began an exposure", (135..=165).contains(&synced), synced);
    // Late by what the transport takes at least, which nobody can know, and right within what is claimed beyond that.
    let late: Vec<_> = samples.iter().map(|s| s.time_ns - (s.device_time as f64 * 39_062.5) as i64).collect();
    let least = late.iter().copied().min().unwrap_or(0);
    let within = late
        .iter()
        .zip(&samples)
        .filter(|(l, s)| (**l - least) as u64 <= u64::from(s.uncertainty_ns) + 39_063);
    let within = within.count();
    let claims: Vec<_> = samples.iter().map(|s| s.uncertainty_ns).collect();
    checks.that(
        "times are right within what they claim",
        within * 100 >= samples.len() * 99 && (-39_063..10_000_000).contains(&least),
        format!(
            "{within} of {}, least latency {least} ns, claims up to {:?} ns",
            samples.len(),
            claims.iter().max()
        ),
    );
    checks.that("times rise", samples.is_sorted_by(|a, b| a.time_ns < b.time_ns), "");
    Ok(())
}
