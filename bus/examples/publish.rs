//! Publishes a test pattern without a camera: the smallest rig there is, and what the Python tests read.
//!
//! ```text
//! cargo run -p depthrig-bus --example publish -- RUNTIME_DIR [--rig NAME] [--formats rgb8,z16]
//!     [--size 64x48] [--pad BYTES] [--fps 30] [--frames N] [--step] [--dump FOLDER]
//! ```
//! Every pixel format given becomes the stream `pattern/<format>`; `--formats all` makes one of each. After every
//! round of frames the rig's frame set is published, with the stream `pattern/missing` absent. `--pad` appends bytes
//! to each row. `--step` waits for a number on stdin, publishes that many frames, prints the last sequence number, and
//! so on until stdin ends; times are invented then, and every field of the header is filled. `--dump` publishes
//! nothing and writes a header with a distinct value in every field: the bytes as they lie in shared memory, and as
//! JSON; mirrors in other languages are tested against it.

#![recursion_limit = "256"] // one JSON object with 42 fields

use depthrig_bus::{
    Bus, ClockDomain, Distortion, FrameFlags, FrameHeader, HostTime, Intrinsics, MemberRecord, PixelFormat,
    Pose, Publisher, RigName, RuntimeDir, SetHeader, StreamId,
};
use std::error::Error;
use std::io::BufRead;
use std::path::{Path, PathBuf};
use std::time::Duration;

struct Options {
    runtime: PathBuf,
    rig: RigName,
    formats: Vec<PixelFormat>,
    size: (u32, u32),
    pad: u32,
    fps: f64,
    frames: u64,
    step: bool,
    dump: Option<PathBuf>,
}

fn main() -> Result<(), Box<dyn Error>> {
    let options = options()?;
    if let Some(folder) = &options.dump {
        return dump(folder);
    }
    let runtime = RuntimeDir::at(&options.runtime)?;
    let _lock = runtime.lock(&options.rig, &format!("process {} (example publisher)", std::process::id()))?;
    let bus = Bus::open(&runtime, &options.rig)?;
    let streams = options
        .formats
        .iter()
        .map(|format| {
            let id = StreamId::new("pattern", format.name())?;
            // 160 slots: eight readers may hold all they are allowed to, and none of them stops the pattern.
            let publisher = bus.publisher(&id, image(&options, *format).payload_len as usize, 160)?;
            Ok((id, *format, publisher))
        })
        .collect::<Result<Vec<_>, depthrig_bus::Error>>()?;
    let sets = bus.set_publisher()?;
    let publish = |sequence: u64| -> Result<(), Box<dyn Error>> {
        let capture_ns = if options.step { step_ns(sequence) } else { HostTime::now().ns() };
        let mut members = vec![missing()?];
        for (id, format, publisher) in &streams {
            let sent = send(&options, (id, *format, publisher), sequence, capture_ns)?;
            // Sets exclude IMU streams.
            members.extend((!format.is_motion()).then_some(sent));
        }
        let header = SetHeader {
            set_id: sequence,
            tick_ns: capture_ns,
            spread_ns: 1_234,
            incomplete: sequence,
            ..SetHeader::default()
        };
        sets.send(header, &members)?;
        Ok(())
    };
    println!("ready");
    let mut sequence = 0;
    if options.step {
        for line in std::io::stdin().lock().lines() {
            for _ in 0..line?.trim().parse::<u64>()? {
                sequence += 1;
                publish(sequence)?;
            }
            println!("{sequence}");
        }
        return Ok(());
    }
    let start = HostTime::now();
    while sequence < options.frames {
        let due = start.plus(Duration::from_secs_f64(sequence as f64 / options.fps));
        std::thread::sleep(due.from_now());
        sequence += 1;
        publish(sequence)?;
        if sequence.is_multiple_of(30) {
            bus.clean_dead();
        }
    }
    Ok(())
}

/// Publishes frame `sequence` of one stream.
fn send(
    options: &Options,
    (id, format, publisher): (&StreamId, PixelFormat, &Publisher),
    sequence: u64,
    capture_ns: i64,
) -> Result<MemberRecord, depthrig_bus::Error> {
    let mut header = image(options, format);
    if !options.step {
        (header.flags, header.dropped) = (FrameFlags::SYNTHETIC.0, [0; 8]);
    }
    let mut frame = publisher.loan(header.payload_len as usize)?;
    *frame.header_mut() = header;
    frame.header_mut().set_names(options.rig.as_str(), id);
    frame.header_mut().sequence = sequence;
    frame.header_mut().captured = sequence + header.drops().total();
    frame.header_mut().capture_time_ns = capture_ns;
    fill(format, &header, sequence, frame.pixels_mut());
    publisher.send(frame)?;
    Ok(MemberRecord { id: id.clone(), sequence: Some(sequence), capture_time_ns: capture_ns })
}

fn missing() -> Result<MemberRecord, depthrig_bus::Error> {
    Ok(MemberRecord { id: StreamId::new("pattern", "missing")?, sequence: None, capture_time_ns: 0 })
}

/// Capture time of a frame that is published with `--step`: 30 Hz from the first second on.
const fn step_ns(sequence: u64) -> i64 {
    1_000_000_000 + sequence as i64 * 33_333_333
}

/// A header for `format` with a distinct value in every field and padded rows.
fn image(options: &Options, format: PixelFormat) -> FrameHeader {
    let mut header = distinct();
    let (width, height) = options.size;
    if format.is_motion() {
        // Samples follow each other without padding.
        header.set_image(format, width, 1);
        header.depth_unit_m = 0.0;
        return header;
    }
    header.set_image(format, width, height);
    if format == PixelFormat::Mjpeg {
        header.payload_len = 1000;
        return header;
    }
    header.stride += options.pad;
    let rows = if format == PixelFormat::Nv12 { height * 3 / 2 } else { height };
    header.payload_len = header.stride * rows;
    if !format.is_depth() {
        header.depth_unit_m = 0.0;
    }
    header
}

/// Byte `column` of row `row` is `13 row + 7 column + 31 sequence`, modulo 256; padding is 0xEE. Float depth is
/// `(row + column + sequence) / 1024` metres with NaN, 0 and -1 as its first three pixels.
fn fill(format: PixelFormat, header: &FrameHeader, sequence: u64, pixels: &mut [u8]) {
    let row_bytes = format.row_bytes(header.width) as usize;
    let stride = if header.stride == 0 { pixels.len() } else { header.stride as usize };
    for (row, line) in pixels.chunks_mut(stride).enumerate() {
        for (column, byte) in line.iter_mut().enumerate() {
            *byte = (row * 13 + column * 7).wrapping_add(sequence as usize * 31) as u8;
        }
        if format == PixelFormat::DepthF32 {
            for (column, pixel) in line[..row_bytes].chunks_exact_mut(4).enumerate() {
                let metres = match (row, column) {
                    (0, 0) => f32::NAN,
                    (0, 1) => 0.0,
                    (0, 2) => -1.0,
                    _ => (row + column + sequence as usize) as f32 / 1024.0,
                };
                pixel.copy_from_slice(&metres.to_le_bytes());
            }
        }
        if format != PixelFormat::Mjpeg {
            line[row_bytes..].fill(0xEE);
        }
    }
}

/// A header in which no two fields hold the same value, as far as their ranges allow.
fn distinct() -> FrameHeader {
    let mut header = FrameHeader {
        sequence: 0x0102_0304_0506_0708,
        device_sequence: 0x1112_1314_1516_1718,
        set_id: 0x2122_2324_2526_2728,
        device_time: 0xF1F2_F3F4_F5F6_F7F8,
        device_tick_ns: 1000.0625,
        capture_time_ns: -0x3132_3334_3536_3738,
        capture_uncertainty_ns: 41_000,
        arrival_time_ns: 0x4142_4344_4546_4748,
        publish_time_ns: 0x5152_5354_5556_5758,
        exposure_ns: 8_333_333,
        captured: 0x6162_6364_6566_6768,
        dropped: [101, 102, 103, 104, 105, 106, 107, 108],
        source_sequence: 0x7172_7374_7576_7778,
        depth_unit_m: 0.0001,
        intrinsics: Intrinsics {
            fx: 611.1,
            fy: 612.2,
            cx: 313.3,
            cy: 244.4,
            coeffs: [0.1, -0.2, 0.3, -0.4, 0.5, -0.6, 0.7, -0.8],
            model: Distortion::KannalaBrandt4 as u32,
            reserved: 0x8182_8384,
        },
        pose: Pose { translation_m: [0.011, -0.022, 0.033], rotation_xyzw: [0.5, -0.5, 0.5, -0.5] },
        clock_domain: ClockDomain::Kernel as u32,
        clock_epoch: 17,
        flags: FrameFlags::REPLAYED.with(FrameFlags::LATE).with(FrameFlags::SYNTHETIC).0,
        format: PixelFormat::Z16 as u32,
        width: 641,
        height: 482,
        stride: 1283,
        payload_len: 618_406,
        gain: 16.5,
        temperature_c: 36.625,
        source_color_sequence: 0xA1A2_A3A4_A5A6_A7A8,
        source_color_capture_time_ns: -0x2122_2324_2526_2728,
        stage_ns: [201, 202, 203, 204, 205, 206],
        latency_ns: 0xB1B2_B3B4_B5B6_B7B8,
        ..FrameHeader::default()
    };
    header.rig = text("rig-µ");
    header.camera = text("camera_of_thirty_one_characters");
    header.stream = text("depth_refined");
    header.set_refiner("onnxruntime 1.31.1 cpu fp32", "cdm-d435@1f2e3d4c");
    header.set_device("Modèle 深度", "SN-00042");
    for (i, word) in header.reserved.iter_mut().enumerate() {
        *word = 0x9192_9394_0000_0000 + i as u64;
    }
    header
}

fn text(s: &str) -> [u8; 32] {
    let mut field = [0; 32];
    field[..s.len()].copy_from_slice(s.as_bytes());
    field
}

/// Writes `header.bin` and `header.json` into `folder`.
fn dump(folder: &Path) -> Result<(), Box<dyn Error>> {
    let h = distinct();
    let bytes = h.to_bytes();
    // Each field by its name, not from the table of offsets that the mirrors are generated from.
    let json = serde_json::json!({
        "magic": h.magic, "version": h.version, "size": h.size, "sequence": h.sequence,
        "device_sequence": h.device_sequence, "set_id": h.set_id, "device_time": h.device_time,
        "device_tick_ns": h.device_tick_ns, "capture_time_ns": h.capture_time_ns,
        "capture_uncertainty_ns": h.capture_uncertainty_ns, "arrival_time_ns": h.arrival_time_ns,
        "publish_time_ns": h.publish_time_ns, "exposure_ns": h.exposure_ns, "captured": h.captured,
        "dropped": h.dropped, "source_sequence": h.source_sequence, "depth_unit_m": h.depth_unit_m,
        "intrinsics.fx": h.intrinsics.fx, "intrinsics.fy": h.intrinsics.fy, "intrinsics.cx": h.intrinsics.cx,
        "intrinsics.cy": h.intrinsics.cy, "intrinsics.coeffs": h.intrinsics.coeffs,
        "intrinsics.model": h.intrinsics.model, "intrinsics.reserved": h.intrinsics.reserved,
        "pose.translation_m": h.pose.translation_m, "pose.rotation_xyzw": h.pose.rotation_xyzw,
        "clock_domain": h.clock_domain, "clock_epoch": h.clock_epoch, "flags": h.flags, "format": h.format,
        "width": h.width, "height": h.height, "stride": h.stride, "payload_len": h.payload_len, "gain": h.gain,
        "temperature_c": h.temperature_c, "rig": h.rig(), "camera": h.camera(), "stream": h.stream(),
        "model": h.model(), "serial": h.serial(),
        "source_color_sequence": h.source_color_sequence,
        "source_color_capture_time_ns": h.source_color_capture_time_ns, "stage_ns": h.stage_ns,
        "refiner": h.refiner(), "refiner_model": h.refiner_model(), "latency_ns": h.latency_ns, "reserved": h.reserved,
    });
    std::fs::create_dir_all(folder)?;
    std::fs::write(folder.join("header.bin"), bytes)?;
    std::fs::write(folder.join("header.json"), serde_json::to_string_pretty(&json)?)?;
    Ok(())
}

fn options() -> Result<Options, Box<dyn Error>> {
    let mut options = Options {
        runtime: PathBuf::new(),
        rig: RigName::new("example")?,
        formats: vec![PixelFormat::Rgb8, PixelFormat::Z16],
        size: (64, 48),
        pad: 0,
        fps: 30.0,
        frames: u64::MAX,
        step: false,
        dump: None,
    };
    let mut args = std::env::args().skip(1);
    while let Some(arg) = args.next() {
        let mut value = || args.next().ok_or_else(|| format!("{arg} needs a value"));
        match arg.as_str() {
            "--rig" => options.rig = RigName::new(value()?)?,
            "--formats" => options.formats = formats(&value()?)?,
            "--size" => {
                let value = value()?;
                let (w, h) = value.split_once('x').ok_or("--size is WIDTHxHEIGHT")?;
                options.size = (w.parse()?, h.parse()?);
            }
            "--pad" => options.pad = value()?.parse()?,
            "--fps" => options.fps = value()?.parse()?,
            "--frames" => options.frames = value()?.parse()?,
            "--step" => options.step = true,
            "--dump" => options.dump = Some(value()?.into()),
            _ if arg.starts_with('-') => return Err(format!("unknown option {arg}").into()),
            _ => options.runtime = arg.into(),
        }
    }
    if options.runtime.as_os_str().is_empty() && options.dump.is_none() {
        return Err("which runtime folder? give a short path such as /tmp/rig".into());
    }
    Ok(options)
}

fn formats(list: &str) -> Result<Vec<PixelFormat>, String> {
    if list == "all" {
        return Ok(PixelFormat::ALL.to_vec());
    }
    list.split(',')
        .map(|name| {
            let known = PixelFormat::ALL.into_iter().find(|f| f.name() == name);
            known.ok_or_else(|| format!("unknown pixel format \"{name}\""))
        })
        .collect()
}
