//! Faults on the bus, and their effects.

use super::{COLOR, DEPTH, Seen, Truth, nodes_become, small, take};
use crate::checks::Checks;
use depthrig_bus::HostTime;
use depthrig_driver::ErrorKind;
use depthrig_emulator as emulator;
use depthrig_libusb::{Camera, Settings, Source};
use depthrig_usb::video::ImageSource;
use emulator::{Damage, Fault};
use std::time::Duration;

const WHOLE: usize = 424 * 240 * 2;

pub(super) fn run(
    checks: &mut Checks,
    device: &emulator::Camera,
    truth: &mut Truth,
    camera: &Camera,
) -> anyhow::Result<()> {
    let mut source = Source::start(camera, &[small(DEPTH), small(COLOR)], Settings::default())?;
    take(device, truth, &mut source, &["depth", "color"], 2)?;
    let depth = |seen: Vec<Seen>| seen.into_iter().filter(|p| p.source == 0).collect::<Vec<_>>();
    let mut hit = |damage, frames| -> anyhow::Result<Vec<Seen>> {
        device.fault(Fault::Frames { stream: "depth".into(), damage, frames })?;
        Ok(depth(take(device, truth, &mut source, &["depth", "color"], 6)?))
    };
    let flagged = hit(Damage::ErrorBit, 2)?;
    checks.equal("flagged frames are damaged", flagged.iter().filter(|p| p.damaged).count(), 2);
    let short = hit(Damage::Short, 1)?;
    let lengths =
        short.iter().filter(|p| p.bytes != WHOLE && !p.damaged).map(|p| p.bytes).collect::<Vec<_>>();
    checks.equal("a short frame is handed on as long as it is", lengths, vec![WHOLE / 3]);
    let long = hit(Damage::Long, 1)?;
    let lengths = long.iter().filter(|p| p.bytes > WHOLE).map(|p| p.bytes).collect::<Vec<_>>();
    checks.equal("a frame that is too long shows by one byte", lengths, vec![WHOLE + 1]);
    let mut around = long;
    around.extend(hit(Damage::Skip, 1)?);
    let whole: Vec<_> = around.iter().filter_map(|p| Some((p.sequence, p.index?))).collect();
    let steps: Vec<_> = whole.windows(2).map(|w| (w[1].0 - w[0].0, w[1].1 - w[0].1)).collect();
    // The identifier bit changes with each frame that is sent. One that the device did not send shows in the frame
    // counter of its metadata alone, which is the backend's to read (`libusb-conformance` has the case).
    let skipped = steps.iter().filter(|(_, due)| *due == 2).count();
    checks.equal("the device skipped one frame", skipped, 1);
    checks.that(
        "the numbers rise with the frames that came",
        steps.iter().all(|(n, _)| *n == 1),
        format!("{steps:?}"),
    );

    device.fault(Fault::StallEndpoint { stream: "depth".into() })?;
    let began = HostTime::now();
    let after = take(device, truth, &mut source, &["depth", "color"], 3)?;
    checks.that(
        "after a stall depth comes again by itself",
        after.iter().filter(|p| p.source == 0 && p.index.is_some()).count() >= 2,
        format!("{} ms", began.elapsed().as_millis()),
    );
    let counts = source.statistics();
    checks.that(
        "the end point was cleared",
        counts.stalls >= 1 && counts.clearings == 1,
        format!("{counts:?}"),
    );

    device.fault(Fault::Silence)?;
    let began = HostTime::now();
    let mut came = 0;
    while began.elapsed() < Duration::from_millis(700) {
        source.poll(Duration::from_millis(50), &mut |_| came += 1)?;
    }
    device.fault(Fault::Clear)?;
    let after = take(device, truth, &mut source, &["depth", "color"], 3)?;
    let whole = after.iter().filter(|p| p.index.is_some()).count();
    checks.that(
        "after silence both streams come again",
        whole >= 6,
        format!("{whole} complete; {came} in the silence"),
    );
    let counts = source.statistics();
    checks.equal("silence cleared each end point once more", counts.clearings, 3);
    checks.note(format!("{counts:?}"));
    Ok(())
}

/// Pulls the plug in the middle of transfers, then in the middle of a stop, and plugs it in again.
pub(super) fn unplug(
    checks: &mut Checks,
    device: &emulator::Camera,
    truth: &mut Truth,
    camera: Camera,
) -> anyhow::Result<()> {
    let mut source = Source::start(&camera, &[small(DEPTH), small(COLOR)], Settings::default())?;
    take(device, truth, &mut source, &["depth", "color"], 2)?;
    device.unplug()?;
    let pulled = HostTime::now();
    let error = loop {
        match source.poll(Duration::from_millis(50), &mut |_| ()) {
            Ok(_) if pulled.elapsed() < Duration::from_secs(3) => {}
            Ok(_) => break None,
            Err(e) => break Some(e),
        }
    };
    let ms = pulled.elapsed().as_millis();
    let text = error.as_ref().map_or_else(|| "no error".to_owned(), ToString::to_string);
    checks.equal("an unplugged camera is an error", error.map(|e| e.kind()), Some(ErrorKind::Disconnected));
    checks.that("at once", ms < 200, format!("{ms} ms: {text}"));
    let began = HostTime::now();
    drop(source);
    drop(camera);
    let ms = began.elapsed().as_millis();
    checks.that("dropping what is left of it takes no time", ms < 500, format!("{ms} ms"));
    device.replug()?;
    checks.that("plugged in again, the kernel's driver has it", nodes_become(6), "");
    let camera = Camera::open(&Default::default(), &super::usb_device(device)?)?;
    let mut source = Source::start(&camera, &[small(DEPTH)], Settings::default())?;
    let seen = take(device, truth, &mut source, &["depth"], 3)?;
    checks.that(
        "and it streams through libusb",
        seen.iter().filter(|p| p.index.is_some()).count() >= 3,
        seen.len(),
    );
    Ok(())
}
