//! Measures how long a frame takes from publishing to a Rust subscriber: the counterpart of
//! `python/benchmarks/latency.py`, for the comparison in `tests/peers/feed.py`.
//!
//! ```text
//! cargo run --release -p depthrig-bus --example latency -- RUNTIME_DIR CAMERA/STREAM [FRAMES [WARM_UP]]
//! ```
//! Prints one JSON array: for each frame the nanoseconds from the header's `publish_time_ns` until the header and the
//! pixels can be read. Reading the pixels is not part of it.

use depthrig_bus::{Bus, HostTime, RuntimeDir};
use std::error::Error;
use std::time::Duration;

const PATIENCE: Duration = Duration::from_secs(10);

fn main() -> Result<(), Box<dyn Error>> {
    let mut args = std::env::args().skip(1);
    let folder = args.next().ok_or("which runtime folder?")?;
    let stream = args.next().ok_or("which stream? CAMERA/STREAM")?.parse()?;
    let frames: usize = args.next().map_or(Ok(300), |n| n.parse())?;
    let warm_up: usize = args.next().map_or(Ok(30), |n| n.parse())?;
    let runtime = RuntimeDir::at(folder.as_ref())?;
    let rig = runtime.running_rigs().into_iter().next().ok_or("no rig is running there")?;
    let mut subscriber = Bus::open(&runtime, &rig)?.subscriber_within(&stream, PATIENCE)?;
    let mut samples = Vec::with_capacity(frames);
    for i in 0..frames + warm_up {
        let frame = subscriber.next_timeout(PATIENCE)?.ok_or("no frame came for 10 s")?;
        let pixels = frame.pixels();
        let now = HostTime::now().ns();
        // The pixels must have been found before the clock is read.
        if !core::hint::black_box(pixels).is_empty() && i >= warm_up {
            samples.push(now - frame.header().publish_time_ns);
        }
    }
    println!("{samples:?}");
    Ok(())
}
