//! The least that shows that the machine works: two virtual cameras of the kernel, and frames from each.

use crate::checks::Checks;
use crate::{Scenario, system};
use anyhow::Context;
use std::path::Path;
use std::time::Duration;
use v4l::buffer::Type;
use v4l::io::traits::CaptureStream;
use v4l::video::Capture;
use v4l::{Device, FourCC};

/// See the module.
pub const SCENARIO: Scenario = Scenario {
    name: "vivid-smoke",
    about: "two virtual cameras of the kernel's own vivid driver: nodes, and ten frames of each",
    cost: 1,
    limit_s: 20,
    needs: "",
    run,
};

const FRAMES: u32 = 10;

fn run(checks: &mut Checks) -> anyhow::Result<()> {
    // Node types 0x1: a capture node and nothing else. Input type 0: a webcam.
    system::modprobe("vivid", &["n_devs=2", "node_types=0x1,0x1", "num_inputs=1,1", "input_types=0,0"])?;
    let nodes = system::video_nodes()?;
    checks.equal("a node for each camera", nodes.len(), 2);
    for node in &nodes {
        let missed = missed(node).with_context(|| node.display().to_string())?;
        checks.equal(&format!("no frame of {} is missed", node.display()), missed, 0);
    }
    Ok(())
}

/// How many of the first ten frames of a camera were lost, by the kernel's own count.
fn missed(node: &Path) -> anyhow::Result<u32> {
    let device = Device::with_path(node)?;
    let mut format = device.format()?;
    (format.width, format.height, format.fourcc) = (640, 360, FourCC::new(b"YUYV"));
    let format = device.set_format(&format)?;
    let mut stream = v4l::io::mmap::Stream::with_buffers(&device, Type::VideoCapture, 4)?;
    stream.set_timeout(Duration::from_secs(2));
    let mut first = None;
    let mut missed = 0;
    for expected in 0..FRAMES {
        let (_, described) = stream.next()?;
        anyhow::ensure!(described.bytesused == format.size, "a frame of {} bytes", described.bytesused);
        missed = described.sequence - *first.get_or_insert(described.sequence) - expected;
    }
    Ok(missed)
}
