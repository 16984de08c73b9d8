//! The kernel's virtual cameras for scenarios: loading, faults, and capturing frames.

use crate::system;
use anyhow::Context;
use depthrig_bus::{HostTime, StreamName};
use depthrig_driver::{Backend, Error, MemorySink, Poll, Stream, StreamProfile, StreamRequest};
use depthrig_usb::controls::ControlValue;
use depthrig_v4l2::{Node, V4l2Backend, V4l2Config};
use std::path::PathBuf;
use std::process::Command;
use std::time::Duration;

/// The smallest image that vivid has.
pub const SIZE: (u32, u32) = (320, 180);

/// Loads vivid with `n` cameras, each a capture node and a metadata node; whatever was loaded goes.
///
/// # Errors
/// When it cannot be loaded.
pub fn load(n: usize) -> anyhow::Result<()> {
    // Fails when it was not loaded, which is as good.
    let _ = system::run(Command::new("modprobe").args(["-r", "vivid"]));
    let list = |value: &str| vec![value; n].join(",");
    let options = [
        format!("n_devs={n}"),
        // Video capture 0x1 and metadata capture 0x20000; the one input a webcam.
        format!("node_types={}", list("0x20001")),
        format!("num_inputs={}", list("1")),
        format!("input_types={}", list("0")),
    ];
    system::modprobe("vivid", &options.each_ref().map(String::as_str))
}

/// The port of camera number `n`.
pub fn port(n: usize) -> String {
    format!("platform:vivid-{n:03}")
}

/// Settings that mean camera number `n`, without the counters that it draws into its images: they are all alike then.
pub fn config(n: usize) -> V4l2Config {
    V4l2Config {
        port: Some(port(n)),
        controls: vec![("osd_text_mode".to_owned(), ControlValue::Item("None".to_owned()))],
        ..V4l2Config::default()
    }
}

/// The request for one format at [`SIZE`] and 30 Hz.
pub fn request(format: depthrig_bus::PixelFormat) -> anyhow::Result<StreamRequest> {
    let stream = StreamName::new("color").context("a stream name")?;
    Ok(StreamRequest {
        format: Some(format),
        size: Some(SIZE),
        rate_hz: Some(30.0),
        ..StreamRequest::any(stream)
    })
}

/// Opens and starts a camera.
///
/// # Errors
/// Those of the driver.
pub fn start(config: V4l2Config, request: &StreamRequest) -> Result<Box<dyn Stream>, Error> {
    V4l2Backend::new(config).open(None)?.start(std::slice::from_ref(request))
}

/// Result of taking frames.
pub struct Taken {
    /// The frames and the accounts.
    pub sink: MemorySink,
    /// The profile that was streamed.
    pub profile: StreamProfile,
    /// The error that ended it before there were enough frames.
    pub end: Option<Error>,
}

impl Taken {
    /// Whether captured frames equal delivered plus dropped ones.
    pub fn balances(&self) -> bool {
        let captured = self.sink.captured.first().copied().unwrap_or(0);
        captured > 0 && captured == self.sink.delivered(0) + self.sink.drops_of(0).total()
    }

    /// Frames that were captured.
    pub fn captured(&self) -> u64 {
        self.sink.captured.first().copied().unwrap_or(0)
    }
}

/// Takes frames until `count` were captured, `each` being called after every poll.
///
/// # Errors
/// When nothing comes for 2 s.
pub fn take(
    mut stream: Box<dyn Stream>,
    mut sink: MemorySink,
    count: u64,
    mut each: impl FnMut(&MemorySink),
) -> anyhow::Result<Taken> {
    let profile = stream.profiles().first().cloned().context("a stream")?;
    let mut last = HostTime::now();
    let mut end = None;
    while sink.captured.first().copied().unwrap_or(0) < count {
        match stream.poll(Duration::from_millis(100), &mut sink) {
            Ok(Poll::Frame) => last = HostTime::now(),
            Ok(Poll::Idle | Poll::End) => {
                anyhow::ensure!(last.elapsed() < Duration::from_secs(2), "no frame for 2 s");
            }
            Err(e) => {
                end = Some(e);
                break;
            }
        }
        each(&sink);
    }
    drop(stream);
    Ok(Taken { sink, profile, end })
}

/// The capture node of camera number `n`, for its faults and for looking beside the driver.
///
/// # Errors
/// When the node does not exist.
pub fn capture_node(n: usize) -> anyhow::Result<Node> {
    node(n, |node| node.capability().is_capture())
}

/// The metadata node of camera number `n`.
///
/// # Errors
/// When the node does not exist.
pub fn metadata_node(n: usize) -> anyhow::Result<Node> {
    node(n, |node| node.capability().is_metadata())
}

fn node(n: usize, is_it: impl Fn(&Node) -> bool) -> anyhow::Result<Node> {
    let nodes: Vec<PathBuf> = system::video_nodes()?;
    let opened = nodes.iter().filter_map(|path| Node::open(path).ok());
    opened
        .into_iter()
        .find(|node| node.capability().bus == port(n) && is_it(node))
        .with_context(|| format!("a node of {}", port(n)))
}

/// Writes a control of a node by name.
///
/// # Errors
/// Those of the driver.
pub fn set(node: &Node, name: &str, value: i64) -> Result<(), Error> {
    node.set_control(&node.controls()?, name, &ControlValue::Integer(value))
}
