//! Capture times against the truth that the emulated camera knows: across the wrap of its clock, a restart of the clock,
//! and a restart of the camera.

use crate::checks::Checks;
use crate::subject::{plug, small};
use crate::tally::{Frame, Tally};
use crate::{Scenario, system};
use core::fmt::Write as _;
use core::time::Duration;
use depthrig_bus::{DropCounts, FrameFlags, HostTime, MetadataLevel};
use depthrig_driver::{Backend, ErrorKind, Stream, StreamRequest};
use depthrig_emulator::{Camera, Fault, Options};
use depthrig_realsense::RealsenseBackend;
use depthrig_realsense::config::{RealsenseConfig, TransportChoice};

/// See the module.
pub const SCENARIO: Scenario = Scenario {
    name: "realsense-clock",
    about: "capture times of a D435 stay within their stated uncertainty across a wrap, a clock reset and a restart",
    cost: 3,
    limit_s: 180,
    needs: "",
    run,
};

/// Long enough for a map to be warm (5 s) and probed, and for seconds of both after that.
const A_WHILE: Duration = Duration::from_secs(9);

fn run(checks: &mut Checks) -> anyhow::Result<()> {
    system::modprobe("vhci-hcd", &[])?;
    system::modprobe("uvcvideo", &[])?;
    let camera = plug("d435", Options { drift_ppm: 60.0, ..Options::default() })?;
    let backend = RealsenseBackend::new(RealsenseConfig {
        port: camera.port_path(),
        transport: TransportChoice::Kernel,
        ..RealsenseConfig::default()
    });
    let start = || -> depthrig_driver::Result<Box<dyn Stream>> {
        let request = |s: &str| small(s).map(|r| StreamRequest { rate_hz: Some(15.0), ..r });
        let requests: Vec<_> = ["depth", "color"].iter().filter_map(|s| request(s)).collect();
        backend.open(None)?.start(&requests)
    };
    let mut stream = start()?;
    // The clock is put 7 s before its end, so that it wraps when the map is warm and probed.
    camera.fault(Fault::ClockJump((1 << 32) - 7_000_000 - shown_us(&camera, stream.as_mut())?))?;
    let mut tally = Tally::default();
    let unsent = not_sent(&camera)?;
    tally.poll_for(stream.as_mut(), A_WHILE)?;
    let wraps = |s: usize| {
        let ticks: Vec<_> = tally.of(s).map(|f| f.meta.device_time).collect();
        ticks.windows(2).any(|t| t[0] < 1 << 32 && t[1] >= 1 << 32)
    };
    checks.that("the clock wrapped, and the unwrapped one went on", wraps(0) && wraps(1), "");
    judge(checks, &camera, "across the wrap", &tally.frames);

    let before = tally.frames.len();
    camera.fault(Fault::ClockReset)?;
    tally.poll_for(stream.as_mut(), A_WHILE)?;
    let after = &tally.frames[before..];
    let epochs: Vec<_> = after.iter().map(|f| f.meta.clock_epoch).collect();
    checks.that(
        "a clock that starts again begins a new epoch",
        epochs.last() > epochs.first(),
        format!("{:?} to {:?}", epochs.first(), epochs.last()),
    );
    judge(checks, &camera, "after the clock reset", after);
    // A guest that does too much else reads late, and what a camera could not send is a gap on any computer.
    let lost: u64 = tally.drops.iter().map(DropCounts::total).sum();
    let unsent = not_sent(&camera)? - unsent;
    let reasons: Vec<_> = tally.drops.iter().flat_map(DropCounts::nonzero).collect();
    checks.that(
        "what was lost meanwhile is what the camera could not send",
        lost == unsent,
        format!("{unsent} not sent, {reasons:?} lost"),
    );

    checks.done("a hardware reset is taken while it streams", backend.reset(None));
    let gone = tally.poll_for(stream.as_mut(), Duration::from_secs(10)).err();
    checks.that(
        "the stream finds the camera gone",
        gone.as_ref().is_some_and(|e| e.kind() == ErrorKind::Disconnected),
        gone.map_or_else(String::new, |e| e.to_string()),
    );
    drop(stream);
    let mut again = None;
    let back = system::wait_until(Duration::from_secs(20), || {
        again = start().ok();
        again.is_some()
    });
    checks.that("it can be opened when it is back", back, "");
    if let Some(mut stream) = again {
        let mut tally = Tally::default();
        tally.poll_for(stream.as_mut(), A_WHILE)?;
        judge(checks, &camera, "after the restart", &tally.frames);
    }
    checks.equal("the emulator was never late", camera.accounts("depth")?.late, 0);
    Ok(())
}

/// Frames that the host did not read in time, or the emulator did not make in time.
fn not_sent(camera: &Camera) -> anyhow::Result<u64> {
    let mut sum = 0;
    for name in ["depth", "color"] {
        let accounts = camera.accounts(name)?;
        sum += accounts.late + accounts.unread;
    }
    Ok(sum)
}

/// The camera's clock now: the time of its newest frame plus the time since its capture.
fn shown_us(camera: &Camera, stream: &mut dyn Stream) -> anyhow::Result<i64> {
    let mut tally = Tally::default();
    tally.poll_for(stream, Duration::from_millis(400))?;
    let frame = tally.of(0).last().ok_or_else(|| anyhow::anyhow!("no frame"))?;
    let index = frame.index.ok_or_else(|| anyhow::anyhow!("a frame without a stamp"))?;
    let since_us = HostTime::now().since_ns(camera.true_capture("depth", index)?) / 1000;
    Ok(frame.meta.device_time as i64 + since_us)
}

/// Of the frames whose time is claimed to be known, 99 of 100 are right within their claim: what the clock map promises
/// (its own tests hold it to that on simulated clocks), and what a busy host makes of this emulated one.
fn judge(checks: &mut Checks, camera: &Camera, when: &str, frames: &[Frame]) {
    let claimed = |f: &&Frame| !f.meta.flags.has(FrameFlags::TIME_UNCERTAIN);
    let mut judged = 0;
    let mut wrong = 0;
    let mut worst_us = 0.0_f64;
    let mut claim_us = 0.0_f64;
    let mut which = String::new();
    let began = frames.first().map(|f| f.meta.arrival);
    for f in frames.iter().filter(claimed) {
        let name = if f.stream == 0 { "depth" } else { "color" };
        let Some(truth) = f.index.and_then(|i| camera.true_capture(name, i).ok()) else { continue };
        let off_ns = f.meta.capture_time.since_ns(truth);
        judged += 1;
        if off_ns.unsigned_abs() > f.meta.capture_uncertainty_ns {
            wrong += 1;
            let at_ms = began.map_or(0, |b| f.meta.arrival.since_ns(b) / 1_000_000);
            let off_us = off_ns / 1000;
            let claim_us = f.meta.capture_uncertainty_ns / 1000;
            let _ = write!(
                which,
                "; {name} at {at_ms} ms, epoch {}: {off_us} of {claim_us} µs",
                f.meta.clock_epoch
            );
        }
        worst_us = worst_us.max(off_ns.unsigned_abs() as f64 / 1e3);
        claim_us = claim_us.max(f.meta.capture_uncertainty_ns as f64 / 1e3);
    }
    checks.that(
        &format!("{when} capture times are right within what they claim"),
        judged > 60 && wrong * 100 <= judged,
        format!("{wrong} of {judged} are not; off by {worst_us:.0} µs at most, the largest claim is {claim_us:.0} µs{which}"),
    );
    let full = |f: &Frame| MetadataLevel::of(f.meta.clock_domain, f.meta.flags) == MetadataLevel::Full;
    checks.that(&format!("{when} every frame has its metadata"), frames.iter().all(full), "");
}
