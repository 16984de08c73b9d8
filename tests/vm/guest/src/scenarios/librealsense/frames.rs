//! Images and their times: of the library, of the driver, and of the emulator.

use super::Subject;
use super::vendor::{entries, text, whole};
use crate::scenarios::l515::{packed, turned_back};
use anyhow::Context;
use core::time::Duration;
use depthrig_bus::{HostTime, MetadataLevel, Name};
use depthrig_driver::{MemorySink, Stream, StreamRequest};
use depthrig_emulator::{Camera, Stamp};
use serde_json::{Value, json};
use std::collections::BTreeMap;

/// Images of each stream that are compared.
const FRAMES: u64 = 10;
const IMAGES: &str = "/tmp/librealsense-images.bin";
/// The driver's clock map has no answer of the camera's clock yet when its first frames come.
const LATENCY_NS: i64 = 60_000_000;

/// Streams that run together.
struct Set {
    what: &'static str,
    /// Names of sensors and their profiles, as the library has them.
    library: Value,
    /// Streams of the driver.
    driver: &'static [&'static str],
    size: (u32, u32),
    color: (u32, u32),
}

fn profile(stream: &str, index: u64, format: &str, (width, height): (u32, u32)) -> Value {
    json!({ "stream": stream, "index": index, "format": format, "width": width, "height": height, "rate": 30 })
}

fn sets(model: &str) -> Vec<Set> {
    let size = (424, 240);
    let depth = || profile("depth", 0, "z16", size);
    let color = || profile("color", 0, "yuyv", size);
    let infrared = |index| profile("infrared", index, "y8", size);
    if model == "l515" {
        let size = (320, 240);
        let color = (640, 360);
        let depth = [
            profile("depth", 0, "z16", size),
            profile("infrared", 0, "y8", size),
            profile("confidence", 0, "raw8", size),
        ];
        let library = json!([
            { "sensor": "L500 Depth Sensor", "profiles": depth },
            { "sensor": "RGB Camera", "profiles": [profile("color", 0, "yuyv", color)] },
        ]);
        return vec![Set {
            what: "all four streams",
            library,
            driver: &["depth", "ir", "confidence", "color"],
            size,
            color,
        }];
    }
    let all = match model {
        "d405" => json!([{ "sensor": "Stereo Module", "profiles": [depth(), infrared(1), color()] }]),
        _ => json!([
            { "sensor": "Stereo Module", "profiles": [depth(), infrared(1)] },
            { "sensor": "RGB Camera", "profiles": [color()] },
        ]),
    };
    let mut sets = vec![Set {
        what: "depth, infrared and colour",
        library: all,
        driver: &["depth", "ir_left", "color"],
        size,
        color: size,
    }];
    if model == "d435" {
        let both = json!([{ "sensor": "Stereo Module", "profiles": [depth(), infrared(1), infrared(2)] }]);
        sets.push(Set {
            what: "both infrared images",
            library: both,
            driver: &["depth", "ir_left", "ir_right"],
            size,
            color: size,
        });
    }
    sets
}

/// An image that somebody delivered.
struct Image<'a> {
    /// The emulator's stream.
    stream: &'static str,
    /// Which image of an interleaved pair.
    is_right: bool,
    width: usize,
    pixels: &'a [u8],
}

impl Image<'_> {
    /// Its number, and whether it is byte for byte what was sent; `None` without a stamp.
    fn check(&self, camera: &Camera) -> Option<(u64, bool)> {
        let is_l515 = camera.model().name == "l515";
        let upright =
            if self.stream == "confidence" { packed(self.pixels, self.width) } else { self.pixels.to_vec() };
        let index = Stamp::read(&upright)?.index;
        let sent = camera.expected(self.stream, index).ok()?;
        let wire = match self.stream {
            "depth" if is_l515 => turned_back(&upright, self.width, 2),
            "ir" | "confidence" if is_l515 => turned_back(&upright, self.width, 1),
            _ => upright,
        };
        let same = if sent.len() == 2 * wire.len() {
            sent.chunks_exact(2).map(|pair| pair[usize::from(self.is_right)]).eq(wire.iter().copied())
        } else {
            sent == wire
        };
        Some((index, same))
    }
}

/// Counts of one stream.
#[derive(Default)]
struct Tally {
    frames: u64,
    same: u64,
    /// Whose device time is not the truth, or that had none.
    off_time: u64,
    /// Smallest and largest difference to the true capture, nanoseconds.
    host_off: Option<(i64, i64)>,
}

impl Tally {
    fn note_host(&mut self, off: i64) {
        let (least, most) = self.host_off.unwrap_or((off, off));
        self.host_off = Some((least.min(off), most.max(off)));
    }
}

pub fn compare(subject: &mut Subject<'_>) -> anyhow::Result<()> {
    for set in sets(subject.model) {
        library(subject, &set)?;
        driver(subject, &set)?;
    }
    Ok(())
}

fn library(subject: &mut Subject<'_>, set: &Set) -> anyhow::Result<()> {
    let request =
        json!({ "do": "stream", "sensors": set.library, "frames": FRAMES, "seconds": 8.0, "file": IMAGES });
    let answer = subject.vendor.ask(&request)?;
    let images = std::fs::read(IMAGES).context("the library's images")?;
    let utc_ns = utc_offset_ns();
    let mut tallies: BTreeMap<String, Tally> = BTreeMap::new();
    for frame in entries(&answer["frames"]) {
        let name = format!("{} {}", text(frame, "stream"), whole(frame, "index"));
        let tally = tallies.entry(name).or_default();
        tally.frames += 1;
        let start = whole(frame, "offset") as usize;
        let pixels = images
            .get(start..start + whole(frame, "length") as usize)
            .context("an image that is not there")?;
        let stream = match text(frame, "stream") {
            "infrared" => "ir",
            "depth" => "depth",
            "confidence" => "confidence",
            _ => "color",
        };
        let image = Image {
            stream,
            is_right: whole(frame, "index") == 2,
            width: whole(frame, "width") as usize,
            pixels,
        };
        let Some((index, same)) = image.check(subject.camera) else { continue };
        tally.same += u64::from(same);
        let metadata = &frame["metadata"];
        let ticks = metadata["sensor_timestamp"].as_u64();
        tally.off_time += u64::from(ticks != Some(u64::from(subject.camera.true_ticks(stream, index)?)));
        if text(frame, "domain") == "global_time" {
            let at = (frame["time_ms"].as_f64().unwrap_or(0.0) * 1e6) as i64 - utc_ns;
            tally.note_host(at - subject.camera.true_capture(stream, index)?.ns());
        }
    }
    let expected: usize = entries(&set.library).iter().map(|s| entries(&s["profiles"]).len()).sum();
    subject.that(
        &format!("library, {}: every stream comes", set.what),
        tallies.len() == expected,
        format!("{:?}", tallies.keys()),
    );
    let depth = entries(&answer["frames"])
        .iter()
        .find(|f| text(f, "stream") == "depth")
        .map_or(&Value::Null, |f| &f["metadata"]);
    temperatures(subject, &answer["temperatures"]);
    if !subject.is_l515() {
        let has_projector = subject.model != "d405";
        let said = ["frame_laser_power", "frame_emitter_mode"].map(|key| depth.get(key).is_some());
        subject.that("metadata reports a projector where there is one", said == [has_projector; 2], depth);
    }
    for (name, tally) in tallies {
        judge(subject, &format!("library, {}: {name}", set.what), &tally);
    }
    Ok(())
}

/// Temperatures, which the cameras have only while they stream.
fn temperatures(subject: &mut Subject<'_>, said: &Value) {
    let given: &[(&str, f64)] = if subject.is_l515() {
        &[
            ("lld_temperature", 38.5),
            ("mc_temperature", 36.25),
            ("ma_temperature", 35.0),
            ("apd_temperature", 37.75),
            ("humidity_temperature", 30.0),
        ]
    } else {
        &[("asic_temperature", 41.0)]
    };
    let is_same = |(name, value): &(&str, f64)| said[name].as_f64() == Some(*value);
    subject.that("the library reads the camera's temperatures", given.iter().all(is_same), said);
}

/// The same streams by the driver, which has the camera as soon as the library let go of it.
fn driver(subject: &mut Subject<'_>, set: &Set) -> anyhow::Result<()> {
    let request = |stream: &str| -> anyhow::Result<StreamRequest> {
        let size = if stream == "color" { set.color } else { set.size };
        Ok(StreamRequest { size: Some(size), rate_hz: Some(30.0), ..StreamRequest::any(Name::new(stream)?) })
    };
    let requests = set.driver.iter().map(|s| request(s)).collect::<anyhow::Result<Vec<_>>>()?;
    let mut stream = subject.backend().open(Some(subject.camera.serial()))?.start(&requests)?;
    let sink = collect(stream.as_mut())?;
    let profiles = stream.profiles().to_vec();
    drop(stream);
    for (at, p) in profiles.iter().enumerate() {
        let mut tally = Tally::default();
        let name = p.stream.as_str();
        let sent_as = match name {
            "ir_left" | "ir_right" | "ir" => "ir",
            "depth" => "depth",
            "confidence" => "confidence",
            _ => "color",
        };
        for (_, meta, pixels) in sink.frames.iter().filter(|(s, ..)| *s == at).take(FRAMES as usize) {
            tally.frames += 1;
            let image =
                Image { stream: sent_as, is_right: name == "ir_right", width: p.width as usize, pixels };
            let Some((index, same)) = image.check(subject.camera) else { continue };
            tally.same += u64::from(same);
            let truth = subject.camera.true_ticks(sent_as, index)?;
            // Without the whole header the device's time is that of the end of the readout.
            tally.off_time +=
                u64::from(p.metadata == MetadataLevel::Full && meta.device_time as u32 != truth);
            tally.note_host(meta.capture_time.since_ns(subject.camera.true_capture(sent_as, index)?));
        }
        judge(subject, &format!("driver, {}: {name}", set.what), &tally);
    }
    Ok(())
}

fn judge(subject: &mut Subject<'_>, what: &str, tally: &Tally) {
    let Tally { frames, same, off_time, host_off } = tally;
    let holds = *frames >= FRAMES && same == frames;
    subject.that(&format!("{what}: images are what was sent"), holds, format!("{same} of {frames}"));
    // A stock kernel hands over no metadata of an L515, so the library has no time of the sensor.
    if !(subject.is_l515() && what.starts_with("library")) {
        subject.that(
            &format!("{what}: the device's time is that of mid-exposure"),
            *off_time == 0,
            format!("{off_time} are not"),
        );
    }
    if let Some((least, most)) = host_off {
        let holds = *least > -LATENCY_NS && *most < LATENCY_NS;
        subject.that(&format!("{what}: the host's time of it"), holds, format!("{least} to {most} ns off"));
    }
}

/// Nanoseconds from the monotonic clock to the clock of the day, which the library's times are on.
fn utc_offset_ns() -> i64 {
    let day = rustix::time::clock_gettime(rustix::time::ClockId::Realtime);
    day.tv_sec * 1_000_000_000 + day.tv_nsec - HostTime::now().ns()
}

fn collect(stream: &mut dyn Stream) -> anyhow::Result<MemorySink> {
    let mut sink = MemorySink::default();
    let streams = stream.profiles().len();
    let end = HostTime::now().plus(Duration::from_secs(8));
    while (0..streams).any(|s| sink.delivered(s) < FRAMES) && HostTime::now() < end {
        stream.poll(Duration::from_millis(200), &mut sink)?;
    }
    Ok(sink)
}
