//! Seven cameras at once through libusb, depth and colour of each.

use super::{COLOR, DEPTH, load, nodes_become, usb_device};
use crate::Scenario;
use crate::checks::Checks;
use depthrig_bus::HostTime;
use depthrig_emulator as emulator;
use depthrig_libusb::{Camera, Settings, Source, StreamMode};
use depthrig_usb::SysRoot;
use depthrig_usb::uvc::formats::FourCc;
use depthrig_usb::video::ImageSource;
use emulator::{Options, Stamp};
use std::time::Duration;

/// See the module.
pub const SCENARIO: Scenario = Scenario {
    name: "libusb-seven",
    about: "seven D435 through libusb at once, depth and colour at 640x480 and 30 Hz: nothing is lost",
    cost: 5,
    limit_s: 60,
    needs: "",
    run,
};

const CAMERAS: u32 = 7;
const SECONDS: f64 = 1.5;
/// Seven starts at once, each with patterns to be made, are more than the emulation can do in time: counted from here on.
const WARM_UP_S: f64 = 0.5;

const fn vga((interface, format, _): (u8, FourCc, &str)) -> StreamMode {
    StreamMode { interface, format, width: 640, height: 480, rate_hz: 30.0 }
}

/// Counts of one stream.
#[derive(Debug, Clone, Copy, Default)]
struct Tally {
    frames: u64,
    gaps: u64,
    wrong: u64,
    last: Option<u64>,
}

fn run(checks: &mut Checks) -> anyhow::Result<()> {
    load()?;
    let plugged: Result<Vec<_>, _> =
        (0..CAMERAS).map(|_| emulator::Camera::plug("d435", Options::default())).collect();
    let devices = plugged?;
    nodes_become(6 * devices.len());
    std::fs::write("/sys/module/usbcore/parameters/usbfs_memory_mb", "128")?;
    let root = SysRoot::default();
    let cameras: Vec<_> =
        devices.iter().map(|d| Ok(Camera::open(&root, &usb_device(d)?)?)).collect::<anyhow::Result<_>>()?;
    let mut before = 0;
    let tallies = std::thread::scope(|scope| {
        let threads: Vec<_> =
            devices.iter().zip(&cameras).map(|(d, c)| scope.spawn(|| stream(d, c))).collect();
        std::thread::sleep(Duration::from_secs_f64(WARM_UP_S));
        before = late(&devices);
        threads
            .into_iter()
            .map(|t| t.join().map_err(|_| anyhow::anyhow!("a thread panicked"))?)
            .collect::<anyhow::Result<Vec<_>>>()
    })?;
    let all = || tallies.iter().flatten();
    let least = (SECONDS * 30.0) as u64 - 5;
    checks.that(
        "every stream has its frames",
        all().all(|t| t.frames >= least),
        format!("{:?}", all().map(|t| t.frames).collect::<Vec<_>>()),
    );
    checks.equal("frames lost", all().map(|t| t.gaps).sum::<u64>(), 0);
    checks.equal("frames damaged or of another camera", all().map(|t| t.wrong).sum::<u64>(), 0);
    checks.equal("the emulator was never late", late(&devices) - before, 0);
    drop(cameras);
    checks.that("all are given back to the kernel", nodes_become(6 * devices.len()), "");
    Ok(())
}

/// Frames that the emulator itself came too late for.
fn late(devices: &[emulator::Camera]) -> u64 {
    let of = |d: &emulator::Camera, name| d.accounts(name).map_or(0, |a| a.late);
    devices.iter().map(|d| of(d, "depth") + of(d, "color")).sum()
}

fn stream(device: &emulator::Camera, camera: &Camera) -> anyhow::Result<[Tally; 2]> {
    let mut source = Source::start(camera, &[vga(DEPTH), vga(COLOR)], Settings::default())?;
    let mut tallies = [Tally::default(); 2];
    let mut slot = vec![0; 640 * 480 * 2];
    let began = HostTime::now();
    while began.elapsed().as_secs_f64() < SECONDS {
        source.poll(Duration::from_millis(50), &mut |image| {
            let tally = &mut tallies[image.source];
            tally.frames += 1;
            // The one copy of a frame, as a driver makes it.
            let whole = image.bytes.len() == slot.len();
            if whole {
                slot.copy_from_slice(image.bytes);
            }
            let stamp = Stamp::read(&slot).filter(|s| {
                s.serial_hash == device.serial_hash() && usize::from(s.stream) == [0, 2][image.source]
            });
            tally.wrong += u64::from(!whole || image.damaged || stamp.is_none());
            let index = stamp.map(|s| s.index);
            let warm = began.elapsed().as_secs_f64() > WARM_UP_S;
            tally.gaps += u64::from(warm && tally.last.is_some_and(|last| index != Some(last + 1)));
            tally.last = index.or(tally.last);
        })?;
    }
    Ok(tallies)
}
