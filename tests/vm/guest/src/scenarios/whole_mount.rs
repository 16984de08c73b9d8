//! The mount of seven cameras, as far as it can be had without one: emulated RealSense and ZED through the kernel's own
//! drivers, the ZED's depth by our stereo, a Kinect's recording, and an eighth camera that another process serves. All of
//! it in one recording, which is brought out of the guest.

use crate::checks::Checks;
use crate::daemon::{self, Daemon, streams};
use crate::mount::{Compared, Mount};
use crate::stereo_reference::StereoReference;
use crate::{Scenario, outside, system};
use anyhow::Context;
use depthrig_bus::{Bus, HostTime, RigName, StreamId};
use depthrig_calib::stereo::Preset;
use depthrig_daemon::status::RigStatus;
use depthrig_emulator::{Camera, Stamp};
use depthrig_kinect::{ColorFormat, ColorMode, ColorResolution, DepthMode};
use depthrig_kinect_fixture::{Fixture, Images, Pattern};
use depthrig_recorder::{Dataset, PixelMode, SetRange, Severity, VerifyOptions, verify};
use depthrig_zed::mode::Mode;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;
use std::path::Path;
use std::time::Duration;

/// See the module.
pub const SCENARIO: Scenario = Scenario {
    name: "whole-mount",
    about: "five RealSense, a ZED with stereo, a Kinect's recording and another process's camera, in one recording",
    cost: 38,
    limit_s: 120,
    needs: "",
    run,
};

/// Models that are plugged in.
const MODELS: [&str; 6] = ["d405", "d415", "d435", "d455", "l515", "zed2i"];
const KINECT: &str = "/tmp/kinect.mkv";
/// Images of the recording, which is played again and again. To make one takes the guest half a second.
const PLAYED: u32 = 3;
/// The nearest that stereo looks for. Few disparities: the guest has one slow processor.
const NEAR_M: f64 = 3.0;
/// Depth images that are recomputed, and stereo pairs that are kept until their depth comes.
const COMPARED: usize = 2;
const KEPT: usize = 24;
const TIMEOUT: Duration = Duration::from_secs(5);
/// How long is recorded at least, and how many sets a second.
const SECONDS: u64 = 3;
/// Recorded sets that shall have depth by stereo, and how long is recorded at most until they do: how many pairs it has time
/// for depends on the host, whose one core emulates stereo and every camera.
const WITH_DEPTH: u64 = 2;
const AT_MOST_S: u64 = 30;
const SET_RATE_HZ: u64 = 1;

fn run(checks: &mut Checks) -> anyhow::Result<()> {
    system::modprobe("usbhid", &[])?;
    system::modprobe("hid-generic", &[])?;
    let mount = Mount::plug(&MODELS, |_| 0)?;
    let cameras: BTreeMap<_, _> = MODELS.into_iter().zip(&mount.cameras).collect();
    let mut images = kinect()?;

    let daemon = Daemon::start(&rig(&mount)?)?;
    let status = daemon.wait_until_settled()?;
    checks.equal("eight cameras stream", status.cameras.len(), 8);
    let path = daemon.record("mount")?;
    let pairs = pairs(&daemon)?;
    let recording = daemon.record_stop()?;
    let before = status;
    let status = daemon.status()?;
    checks.that("all of them still do", status.cameras.iter().all(streams), daemon::summary(&status));
    books(checks, &daemon, &status)?;
    lost(checks, &before, &status);
    checks.that("sets are recorded", recording.sets >= SET_RATE_HZ * SECONDS - 1, recording.sets);
    checks.equal("none is dropped", recording.dropped, BTreeMap::new());
    // Its end is shown elsewhere; here it would first write the dataset's report, which takes seconds.
    daemon.kill()?;

    let report = verify(&path, &VerifyOptions { decode: true, ..VerifyOptions::default() })?;
    let broken: Vec<_> = report.findings.iter().filter(|f| f.severity > Severity::Lost).collect();
    let what = "every image of the dataset decodes, and the dataset verifies";
    checks.that(what, broken.is_empty(), format!("{broken:?}"));
    for finding in &report.findings {
        checks.note(&finding.message);
    }
    stereo(checks, cameras["zed2i"], &pairs)?;
    contents(checks, &cameras, &path, recording.frames, &Shown::new(&mut images))?;
    if let Some(images) = outside::bring(SCENARIO.name, &path)? {
        checks.note(format!("{images} images are brought to the host"));
    }
    Ok(())
}

/// A recording of an Azure Kinect: 720p Motion JPEG and the binned narrow view, 5 Hz. Its images.
fn kinect() -> anyhow::Result<Pattern> {
    let color = ColorMode { format: ColorFormat::Mjpg, resolution: ColorResolution::P720 };
    let fixture = Fixture {
        color: Some(color),
        depth: Some(DepthMode::Nfov2x2Binned),
        rate_hz: 5,
        captures: PLAYED,
        ..Fixture::default()
    };
    let mut images = Pattern::new(&fixture);
    fixture.write(Path::new(KINECT), &mut images)?;
    Ok(images)
}

/// The rig file's part after the head that every scenario has.
fn rig(mount: &Mount) -> anyhow::Result<String> {
    let mut text = format!("[sets]\nrate_hz = {SET_RATE_HZ}.0\n");
    for (model, camera) in MODELS.iter().zip(&mount.cameras) {
        let serial = camera.serial();
        // The slowest that each has: stereo shall get the guest's one processor. `fourteen` has them at 30 Hz.
        let (backend, modes): (_, &[(&str, u32, u32, u32)]) = match *model {
            "l515" => ("l515", &[("depth", 320, 240, 30), ("color", 640, 360, 15)]),
            "zed2i" => ("zed", &[("left", 672, 376, 15), ("right", 672, 376, 15)]),
            "d405" | "d455" => ("realsense", &[("depth", 424, 240, 5), ("color", 424, 240, 5)]),
            _ => ("realsense", &[("depth", 424, 240, 6), ("color", 424, 240, 6)]),
        };
        write!(text, "[[camera]]\nname = \"{model}\"\nbackend = \"{backend}\"\nserial = \"{serial}\"\n")?;
        if *model == "zed2i" {
            // Pairs of sets alone: one that waits for another to be matched comes too late for its set on this processor.
            let conf = format!("/tmp/SN{serial}.conf");
            std::fs::write(&conf, camera.calibration().zed_conf())?;
            write!(
                text,
                "calibration = \"{conf}\"\n[camera.stereo]\nmodes = [\"performance\"]\nmin_depth_m = {NEAR_M:?}\n\
                 rate_hz = {SET_RATE_HZ}.0\n\
                 [[camera.stream]]\nname = \"depth_performance\"\n"
            )?;
        }
        for (stream, width, height, rate) in modes {
            write!(
                text,
                "[[camera.stream]]\nname = \"{stream}\"\nwidth = {width}\nheight = {height}\nrate_hz = {rate}.0\n"
            )?;
        }
    }
    write!(
        text,
        "[[camera]]\nname = \"kinect\"\nbackend = \"kinect\"\nrecording = \"{KINECT}\"\nloop = true\n\
         [[camera.stream]]\nname = \"color\"\nformat = \"mjpeg\"\n[[camera.stream]]\nname = \"depth\"\n"
    )?;
    write!(
        text,
        "[[camera]]\nname = \"other\"\nbackend = \"external\"\ncommand = [\"/bin/external\", \"--size\", \"320x240\", \"--rate\", \"5\"]\n"
    )?;
    Ok(text)
}

/// Every frame that a camera captured was delivered or counted as lost, and every delivered one has an end in the sets:
/// at once, or as soon as the set thread has read it.
fn books(checks: &mut Checks, daemon: &Daemon, status: &RigStatus) -> anyhow::Result<()> {
    let of = |status: &RigStatus| -> Vec<_> {
        status.cameras.iter().flat_map(|c| c.streams.iter().cloned()).collect()
    };
    let all = of(status);
    let unbalanced = all.iter().filter(|s| {
        s.captured != s.delivered + s.dropped.values().sum::<u64>()
            || s.delivered != s.in_sets.taken() + s.in_sets.unread
    });
    let unbalanced: Vec<_> = unbalanced.map(|s| format!("{s:?}")).collect();
    let what = format!(
        "captured = delivered + dropped in {} streams, and delivered = in sets + left out",
        all.len()
    );
    checks.equal(&what, unbalanced.join(", "), "");

    let mut unread: BTreeSet<_> = all.into_iter().filter(|s| s.in_sets.unread > 0).map(|s| s.id).collect();
    let end = HostTime::now().plus(TIMEOUT);
    while !unread.is_empty() && HostTime::now() < end {
        std::thread::sleep(Duration::from_millis(20));
        for read in of(&daemon.status()?).iter().filter(|s| s.in_sets.unread == 0) {
            unread.remove(&read.id);
        }
    }
    checks.equal("no frame stays unread", unread, BTreeSet::new());
    Ok(())
}

/// While it was recorded, nothing was lost but pairs that stereo had no time for.
fn lost(checks: &mut Checks, before: &RigStatus, after: &RigStatus) {
    let drops = |status: &RigStatus| -> BTreeMap<String, u64> {
        let streams = status.cameras.iter().flat_map(|c| &c.streams);
        streams.map(|s| (s.id.clone(), s.dropped.values().sum())).collect()
    };
    let was = drops(before);
    let mut is = drops(after);
    is.retain(|id, n| was.get(id) != Some(n));
    let skipped = is.remove("zed2i/depth_performance").unwrap_or_default();
    checks.note(format!("stereo had no time for {skipped} pairs"));
    checks.equal("no other stream has lost a frame since all streamed", is, BTreeMap::new());
}

/// Left and right image, and the depth computed from them.
type Matched = ([Vec<u8>; 2], Vec<u8>);

/// Reads the ZED's images and depth from the bus until enough is recorded. Returns some depth images with their pairs.
fn pairs(daemon: &Daemon) -> anyhow::Result<Vec<Matched>> {
    let bus = Bus::open(&daemon.runtime, &RigName::new(daemon::RIG)?)?;
    let subscribe =
        |name| -> anyhow::Result<_> { Ok(bus.subscriber_within(&StreamId::new("zed2i", name)?, TIMEOUT)?) };
    let mut left = subscribe("left")?;
    let mut right = subscribe("right")?;
    let mut depth = subscribe("depth_performance")?;
    let before = in_sets(daemon)?;
    let began = HostTime::now();
    let mut looked = 0;
    let mut waiting = BTreeMap::<u64, [Vec<u8>; 2]>::new();
    let mut pairs = Vec::new();
    loop {
        let passed = began.elapsed().as_secs();
        if passed > looked {
            looked = passed;
            let enough = passed >= SECONDS && !pairs.is_empty() && in_sets(daemon)? >= before + WITH_DEPTH;
            if enough || passed >= AT_MOST_S {
                return Ok(pairs);
            }
        }
        for (i, side) in [&mut left, &mut right].into_iter().enumerate() {
            while let Some(frame) = side.try_next()? {
                let both = waiting.entry(frame.header().device_sequence).or_default();
                both[i] = frame.pixels().to_vec();
            }
        }
        while let Some(frame) = depth.try_next()? {
            if let Some(pair) =
                waiting.remove(&frame.header().device_sequence).filter(|_| pairs.len() < COMPARED)
            {
                pairs.push((pair, frame.pixels().to_vec()));
            }
        }
        while waiting.len() > KEPT {
            waiting.pop_first();
        }
        std::thread::sleep(Duration::from_millis(10));
    }
}

/// How many recorded sets have had depth by stereo.
fn in_sets(daemon: &Daemon) -> anyhow::Result<u64> {
    let status = daemon.status()?;
    let mut streams = status.cameras.iter().flat_map(|c| &c.streams);
    let depth = streams.find(|s| s.id == "zed2i/depth_performance").context("a ZED without depth")?;
    Ok(depth.in_sets.used)
}

/// Recomputes depth from the pairs and compares it.
fn stereo(checks: &mut Checks, zed: &Camera, pairs: &[Matched]) -> anyhow::Result<()> {
    let mut reference =
        StereoReference::new(&zed.calibration().zed_conf(), Mode::Vga, Preset::Performance, NEAR_M)?;
    let mut matched = Tally::default();
    let mut seen = 0;
    for ([left, right], depth) in pairs {
        let (wanted, pixels) = reference.depth(left, right)?;
        matched.add(*depth == wanted);
        seen += pixels;
    }
    matched.check(checks, "depth of the ZED is what the engine makes of its pair, bit by bit");
    checks.note(format!("{seen} pixels of it have a depth"));
    Ok(())
}

/// Each frame in the dataset is what its camera sent.
fn contents(
    checks: &mut Checks,
    cameras: &BTreeMap<&str, &Camera>,
    path: &Path,
    frames: u64,
    shown: &Shown,
) -> anyhow::Result<()> {
    let dataset = Dataset::open(path)?;
    let session = dataset.session().clone();
    let mut found = BTreeMap::<String, u64>::new();
    let mut compared = Compared::default();
    let mut stamped = Tally::default();
    let mut halves = Tally::default();
    let mut played = Tally::default();
    let mut beside: Vec<f64> = Vec::new();
    for set in dataset.sets_with(SetRange::ALL, PixelMode::DecodedAndStored) {
        let set = set?;
        let captured = |name: &str| {
            let frame = set.frames.iter().find(|f| session.streams[f.stream].id.to_string() == name);
            frame.map(|f| f.header.capture_time_ns)
        };
        if let (Some(left), Some(depth)) = (captured("zed2i/left"), captured("zed2i/depth_performance")) {
            beside.push((left - depth).abs() as f64 / 1e6);
        }
        for frame in &set.frames {
            let stream = &session.streams[frame.stream].id;
            *found.entry(stream.to_string()).or_default() += 1;
            let name = stream.camera.as_str();
            let stream = stream.stream.as_str();
            match (name, stream) {
                ("zed2i", "left" | "right") => {
                    let stamp = Stamp::read(&frame.pixels).context("an image without a stamp")?;
                    let sent = cameras[name].expected("stereo", stamp.index)?;
                    let row = sent.len() / frame.header.height as usize;
                    let at = if stream == "left" { 0 } else { row / 2 };
                    let half = sent.chunks_exact(row).flat_map(|r| &r[at..at + row / 2]);
                    halves.add(half.eq(&frame.pixels));
                }
                ("kinect", "depth") => played.add(shown.depth.contains(&frame.pixels)),
                ("kinect", "color") => {
                    played.add(shown.color.contains(frame.stored.as_ref().unwrap_or(&frame.pixels)));
                }
                ("zed2i" | "kinect" | "other", _) => {}
                // An L515 turns depth; its scenario compares the bytes.
                ("l515", _) => {
                    let stamp = Stamp::read(&frame.pixels);
                    stamped.add(stamp.is_some_and(|s| s.serial_hash == cameras[name].serial_hash()));
                }
                _ => compared.frame(cameras[name], frame)?,
            }
        }
    }
    checks.equal("the dataset has every frame that was recorded", found.values().sum::<u64>(), frames);
    let none: Vec<_> =
        session.streams.iter().map(|s| s.id.to_string()).filter(|id| !found.contains_key(id)).collect();
    checks.equal("and some of every stream", none.join(", "), "");
    checks.note(found.iter().map(|(id, n)| format!("{id} {n}")).collect::<Vec<_>>().join(", "));
    checks.that("some sets have depth by stereo", beside.len() as u64 >= WITH_DEPTH, beside.len());
    let near = beside.iter().all(|ms| *ms < 1100.0 / 15.0);
    checks.that("of the set's own pair, or of the one beside it", near, format!("{beside:?} ms apart"));
    compared.check(checks, "frames of D405, D415, D435 and D455 are those that were sent, byte by byte");
    stamped.check(checks, "frames of the L515 have their stamps");
    halves.check(checks, "left and right images of the ZED are those that were sent, byte by byte");
    played.check(checks, "depth and JPEGs of the Kinect are those of its recording, byte by byte");
    Ok(())
}

/// The images that the Kinect's recording shows again and again.
struct Shown {
    color: Vec<Vec<u8>>,
    depth: Vec<Vec<u8>>,
}

impl Shown {
    fn new(images: &mut Pattern) -> Self {
        let all = 0..PLAYED;
        let color = all.clone().map(|n| images.color(n)).collect();
        let depth = all.map(|n| images.depth(n).iter().flat_map(|d| d.to_le_bytes()).collect());
        Self { color, depth: depth.collect() }
    }
}

/// How many were right.
#[derive(Default)]
struct Tally {
    right: u64,
    all: u64,
}

impl Tally {
    fn add(&mut self, right: bool) {
        self.all += 1;
        self.right += u64::from(right);
    }

    fn check(&self, checks: &mut Checks, what: &str) {
        checks.that(what, self.all > 0 && self.right == self.all, format!("{} of {}", self.right, self.all));
    }
}
