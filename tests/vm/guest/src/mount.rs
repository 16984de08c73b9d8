//! A mount of emulated cameras, the rig file for it, and what must hold of everything that it sent.

use crate::checks::Checks;
use crate::feed::Watched;
use crate::{daemon, system};
use anyhow::{Context, ensure};
use core::fmt::Write;
use depthrig_bus::{FrameFlags, FrameHeader, HostTime, StreamId};
use depthrig_daemon::status::RigStatus;
use depthrig_emulator::content::STAMP;
use depthrig_emulator::{Accounts, Camera, Options, Stamp};
use depthrig_recorder::{Dataset, DatasetFrame, PixelMode, SetRange};
use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

/// The streams that every camera of a mount sends.
pub const STREAMS: [&str; 2] = ["depth", "color"];

/// How big the images are.
#[derive(Debug, Clone, Copy)]
pub struct Size {
    /// Pixels per row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Frames per second.
    pub rate_hz: u32,
}

/// Emulated cameras with their names in the rig.
pub struct Mount {
    /// The cameras; `camera_0` is the first.
    pub cameras: Vec<Camera>,
}

impl Mount {
    /// Loads the kernel's drivers and plugs in a camera of each of `models`, each with a clock of its own; `hub` says on
    /// which controller the camera of an index hangs.
    ///
    /// # Errors
    /// When a module or a camera is refused.
    pub fn plug(models: &[&str], hub: impl Fn(usize) -> u32) -> anyhow::Result<Self> {
        system::modprobe("vhci-hcd", &[])?;
        system::modprobe("uvcvideo", &[])?;
        let mut cameras = Vec::new();
        for (i, model) in models.iter().enumerate() {
            let options = Options {
                drift_ppm: 20.0 * i as f64 - 50.0,
                start_ticks: 1_000_000 + 777_777 * i as u32,
                hub: hub(i),
                ..Options::default()
            };
            cameras.push(Camera::plug(model, options).with_context(|| format!("{model}, camera {i}"))?);
        }
        // Two nodes for each video stream: images and metadata.
        let nodes: usize = cameras.iter().map(|c| 2 * c.model().streams().count()).sum();
        let there = || system::video_nodes().is_ok_and(|there| there.len() == nodes);
        ensure!(
            system::wait_until(Duration::from_secs(20), there),
            "{nodes} nodes are due, there are {:?}",
            system::video_nodes()?
        );
        Ok(Self { cameras })
    }

    /// The name of a camera in the rig.
    pub fn name(index: usize) -> String {
        format!("camera_{index}")
    }

    /// The `[[camera]]` tables of the rig file: depth and colour of each camera, found by serial.
    pub fn rig(&self, size: Size) -> String {
        let mut text = String::new();
        for (i, camera) in self.cameras.iter().enumerate() {
            let name = Self::name(i);
            let serial = camera.serial();
            let _ = write!(
                text,
                "[[camera]]\nname = \"{name}\"\nbackend = \"realsense\"\nserial = \"{serial}\"\n"
            );
            for stream in STREAMS {
                let Size { width, height, rate_hz } = size;
                let _ = write!(
                    text,
                    "[[camera.stream]]\nname = \"{stream}\"\nwidth = {width}\nheight = {height}\nrate_hz = {rate_hz}.0\n"
                );
            }
        }
        text
    }

    /// The streams of the cameras of `indexes`.
    ///
    /// # Errors
    /// None: the names are valid.
    pub fn streams(indexes: impl IntoIterator<Item = usize>) -> anyhow::Result<Vec<StreamId>> {
        let mut ids = Vec::new();
        for i in indexes {
            for stream in STREAMS {
                ids.push(StreamId::new(&Self::name(i), stream)?);
            }
        }
        Ok(ids)
    }

    /// The camera with a name in the rig, and its index.
    ///
    /// # Errors
    /// When the rig has no such camera.
    pub fn camera(&self, name: &str) -> anyhow::Result<(usize, &Camera)> {
        let found = self.cameras.iter().enumerate().find(|(i, _)| Self::name(*i) == name);
        found.with_context(|| format!("no camera is called {name}"))
    }

    /// The accounts of a stream.
    ///
    /// # Errors
    /// When there is no such stream.
    pub fn accounts(&self, id: &StreamId) -> anyhow::Result<Accounts> {
        Ok(self.camera(id.camera.as_str())?.1.accounts(id.stream.as_str())?)
    }
}

/// The index that the emulator stamped into a frame.
pub fn stamped(_header: &FrameHeader, pixels: &[u8]) -> Option<u64> {
    Stamp::read(pixels).map(|stamp| stamp.index)
}

/// Frames of `streams` that the emulator could not send, because it was late or because nobody read.
///
/// # Errors
/// When a stream is not of this mount.
pub fn not_sent(mount: &Mount, streams: &[StreamId]) -> anyhow::Result<(u64, u64)> {
    let mut sum = (0, 0);
    for id in streams {
        let accounts = mount.accounts(id)?;
        sum = (sum.0 + accounts.late, sum.1 + accounts.unread);
    }
    Ok(sum)
}

/// Checks that a subscriber of all of `feed` got every frame that the cameras sent in the meantime, in order.
pub fn check_feed(checks: &mut Checks, feed: &[Watched], at_least: usize) {
    let frames: usize = feed.iter().map(|w| w.frames.len()).sum();
    let lost: u64 = feed.iter().map(|w| w.lost() + w.missed).sum();
    let detail = format!("{frames} frames of {} streams, {lost} lost", feed.len());
    checks.that("a subscriber gets every frame of every stream", lost == 0 && frames > 0, detail);
    let unordered: Vec<_> = feed.iter().filter(|w| !w.in_order()).map(|w| w.id.to_string()).collect();
    checks.equal("each with its stamp, in order", unordered.join(", "), "");
    let few = feed.iter().filter(|w| w.frames.len() < at_least);
    let few: Vec<_> = few.map(|w| format!("{} {}", w.id, w.frames.len())).collect();
    checks.equal(&format!("each stream has at least {at_least}"), few.join(", "), "");
}

/// Checks that the dataset at `path` is complete and that each frame equals the one that the emulator sent, byte by byte.
/// A `recovered` dataset reports that its end is missing.
///
/// # Errors
/// When it cannot be read.
pub fn check_dataset(checks: &mut Checks, mount: &Mount, path: &Path, recovered: bool) -> anyhow::Result<()> {
    // With the command that a person would use.
    let done = Command::new("depthrig")
        .args(["verify", "--decode"])
        .arg(path)
        .output()
        .context("depthrig verify")?;
    let said = String::from_utf8_lossy(&done.stdout).trim().to_owned();
    let code = done.status.code();
    // 3: intact, and it states itself that not everything was recorded.
    checks.that("depthrig verify passes", code == Some(0) || (recovered && code == Some(3)), said);
    let mut compared = Compared::default();
    for set in Dataset::open(path)?.sets_with(SetRange::ALL, PixelMode::Decoded) {
        for frame in &set?.frames {
            compared.frame(mount.camera(frame.header.camera())?.1, frame)?;
        }
    }
    compared.check(checks, "each recorded frame is the one that was sent, byte by byte");
    compared.times.check(checks, "recorded capture times");
    Ok(())
}

/// The first of some complaints, and how many there are.
fn first(complaints: &[String]) -> String {
    complaints
        .first()
        .map_or_else(|| "none differs".into(), |one| format!("{} differ: {one}", complaints.len()))
}

/// A comparison of recorded frames with those sent.
#[derive(Default)]
pub struct Compared {
    frames: u64,
    wrong: Vec<String>,
    times: Times,
    /// Of each stream: the pixels below the stamp, which are the same in every frame of one mode, and the last index.
    seen: BTreeMap<(String, String), (Vec<u8>, u64)>,
}

impl Compared {
    /// Compares one with what `camera` sent. It travels as it is: neither turned, nor two images in one.
    ///
    /// # Errors
    /// When the camera has no such stream.
    pub fn frame(&mut self, camera: &Camera, frame: &DatasetFrame) -> anyhow::Result<()> {
        self.frames += 1;
        let header = &frame.header;
        let name = header.camera();
        let stream = header.stream();
        let what = || format!("{name}/{stream} {}", header.device_sequence);
        let Some(stamp) = Stamp::read(&frame.pixels) else {
            self.wrong.push(format!("{}: no stamp", what()));
            return Ok(());
        };
        if stamp.serial_hash != camera.serial_hash() || header.serial() != camera.serial() {
            self.wrong.push(format!("{}: of another camera", what()));
            return Ok(());
        }
        let key = (name.to_owned(), stream.to_owned());
        if let Some((rest, last)) = self.seen.get_mut(&key) {
            if stamp.index <= *last {
                self.wrong.push(format!("{}: frame {} comes after {last}", what(), stamp.index));
            }
            if frame.pixels[..STAMP] != stamp.bytes() || frame.pixels[STAMP..] != *rest {
                self.wrong.push(format!("{}: other bytes", what()));
            }
            *last = stamp.index;
        } else {
            let expected = camera.expected(stream, stamp.index)?;
            if frame.pixels != expected {
                self.wrong.push(format!("{}: other bytes", what()));
            }
            self.seen.insert(key, (expected[STAMP..].to_vec(), stamp.index));
        }
        self.times.add(header, camera.true_capture(stream, stamp.index)?);
        Ok(())
    }

    /// Checks that all of them were equal, and that there were some.
    pub fn check(&self, checks: &mut Checks, what: &str) {
        let Self { frames, wrong, .. } = self;
        checks.that(what, wrong.is_empty() && *frames > 0, format!("{frames} frames; {}", first(wrong)));
    }
}

/// Capture times beside when the emulator captured.
#[derive(Default)]
struct Times {
    judged: usize,
    /// Frames that say themselves that their time may be wrong.
    uncertain: usize,
    beyond: Vec<String>,
    off_ns: u64,
    claims_ns: Vec<u64>,
}

impl Times {
    fn add(&mut self, header: &FrameHeader, truth: HostTime) {
        if header.has(FrameFlags::TIME_UNCERTAIN) {
            self.uncertain += 1;
            return;
        }
        let off_ns = header.capture_time_ns - truth.ns();
        let claim_ns = header.capture_uncertainty_ns;
        self.judged += 1;
        self.off_ns = self.off_ns.max(off_ns.unsigned_abs());
        self.claims_ns.push(claim_ns);
        if off_ns.unsigned_abs() > claim_ns {
            let camera = header.camera();
            let stream = header.stream();
            let number = header.device_sequence;
            let off_us = off_ns / 1000;
            let claim_us = claim_ns / 1000;
            self.beyond.push(format!("{camera}/{stream} {number}: {off_us} of {claim_us} us"));
        }
    }

    /// Checks that 99 of 100 frames are right within what they state, which is what the clock map promises.
    fn check(&mut self, checks: &mut Checks, what: &str) {
        let judged = self.judged;
        let wrong = self.beyond.len();
        self.claims_ns.sort_unstable();
        let claim = |share: usize| {
            self.claims_ns.get(judged.saturating_sub(1) * share / 100).map_or(0.0, |ns| *ns as f64 / 1e6)
        };
        let detail = format!(
            "{wrong} of {judged} are not; off by {:.2} ms at most, stated {:.2} ms in the middle and {:.2} ms at most; {} more \
             are flagged as uncertain; {}",
            self.off_ns as f64 / 1e6,
            claim(50),
            claim(100),
            self.uncertain,
            first(&self.beyond),
        );
        checks.that(
            &format!("{what} are right within their stated uncertainty"),
            judged > 2 * self.uncertain && wrong * 100 <= judged,
            detail,
        );
    }
}

/// Checks that from `before` to `after` no camera but those in `except` has dropped a frame.
pub fn check_no_drops(checks: &mut Checks, before: &RigStatus, after: &RigStatus, except: &[String]) {
    let mut drops = Vec::new();
    for (before, after) in before.cameras.iter().zip(&after.cameras) {
        let was = daemon::drops(before);
        let is = daemon::drops(after);
        if !except.contains(&after.name) && was != is {
            drops.push(format!("{is} (before: {was})"));
        }
    }
    let cameras = after.cameras.len() - except.len();
    checks.equal(&format!("the books of {cameras} cameras show no loss"), drops.join(", "), "");
}
