//! Sends images, or measures how long they take to a Rust subscriber: depthrig's part of `tests/peers/feed.py`.
//!
//! ```text
//! cargo run --release -p depthrig-bus --example latency -- send RUNTIME_DIR z16|rgb8 WIDTHxHEIGHT FPS
//! cargo run --release -p depthrig-bus --example latency -- receive RUNTIME_DIR CAMERA/STREAM FRAMES WARM_UP
//! ```
//! `send` copies images out of buffers that take turns into the stream `feed/image` until it is ended; `device_time`
//! of the header is when the copy began. `receive` prints a JSON object of two lists with a number for each frame, in
//! nanoseconds: `publish`, from right before sending (`publish_time_ns`) until header and pixels can be read, and
//! `total`, from before the copy. Reading the pixels is part of neither.

use depthrig_bus::{Bus, FrameHeader, HostTime, PixelFormat, RigName, RuntimeDir, StreamId};
use std::error::Error;
use std::time::Duration;

const TIMEOUT: Duration = Duration::from_secs(10);
/// Images that take turns, so that none is in a cache because it was just sent.
const IMAGES: usize = 8;

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let args: Vec<&str> = args.iter().map(String::as_str).collect();
    match args[..] {
        ["send", folder, format, size, fps] => send(folder, format, size, fps.parse()?),
        ["receive", folder, stream, frames, warm_up] => {
            receive(folder, stream, frames.parse()?, warm_up.parse()?)
        }
        _ => {
            Err("send RUNTIME_DIR FORMAT WIDTHxHEIGHT FPS, or receive RUNTIME_DIR STREAM FRAMES WARM_UP"
                .into())
        }
    }
}

fn send(folder: &str, format: &str, size: &str, fps: f64) -> Result<(), Box<dyn Error>> {
    let format = PixelFormat::ALL.into_iter().find(|f| f.name() == format).ok_or("no such format")?;
    let (width, height) = size.split_once('x').ok_or("the size is WIDTHxHEIGHT")?;
    let mut header = FrameHeader::default();
    header.set_image(format, width.parse()?, height.parse()?);
    header.depth_unit_m = 0.001;
    let rig = RigName::new("feed")?;
    let runtime = RuntimeDir::at(folder.as_ref())?;
    let _lock = runtime.lock(&rig, "the feed benchmark")?;
    let bus = Bus::open(&runtime, &rig)?;
    let id = StreamId::new("feed", "image")?;
    header.set_names(rig.as_str(), &id);
    let length = header.payload_len as usize;
    let images: Vec<Vec<u8>> =
        (0..IMAGES).map(|p| (0..length).map(|i| (i * 7 + i / 251 + p * 31) as u8).collect()).collect();
    let publisher = bus.publisher(&id, length, 48)?;
    println!("ready");
    let start = HostTime::now();
    for sequence in 1.. {
        std::thread::sleep(start.plus(Duration::from_secs_f64(sequence as f64 / fps)).from_now());
        let before = HostTime::now().ns();
        let mut frame = publisher.loan(length)?;
        *frame.header_mut() = header;
        frame.header_mut().sequence = sequence;
        frame.header_mut().capture_time_ns = before;
        frame.header_mut().device_time = before.unsigned_abs();
        frame.pixels_mut().copy_from_slice(&images[sequence as usize % IMAGES]);
        publisher.send(frame)?;
        if sequence % 30 == 0 {
            bus.clean_dead();
        }
    }
    Ok(())
}

fn receive(folder: &str, stream: &str, frames: usize, warm_up: usize) -> Result<(), Box<dyn Error>> {
    let runtime = RuntimeDir::at(folder.as_ref())?;
    let rig = runtime.running_rigs().into_iter().next().ok_or("no rig is running there")?;
    let mut subscriber = Bus::open(&runtime, &rig)?.subscriber_within(&stream.parse()?, TIMEOUT)?;
    let mut publish = Vec::with_capacity(frames);
    let mut total = Vec::with_capacity(frames);
    for i in 0..frames + warm_up {
        let frame = subscriber.next_timeout(TIMEOUT)?.ok_or("no frame came for 10 s")?;
        // The pixels must have been found before the clock is read.
        core::hint::black_box(frame.pixels());
        let now = HostTime::now().ns();
        if i >= warm_up {
            publish.push(now - frame.header().publish_time_ns);
            total.push(now - frame.header().device_time.cast_signed());
        }
    }
    println!(r#"{{"publish": {publish:?}, "total": {total:?}, "missed": {}}}"#, subscriber.missed());
    Ok(())
}
