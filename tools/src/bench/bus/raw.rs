//! The bare iceoryx2 loop that the bus is measured against: the least that a two-process frame channel can do.
//!
//! It follows iceoryx2's own example: default limits, a small header, the `ipc` flavour without locks.

use anyhow::{Context, Result};
use core::time::Duration;
use depthrig_bus::{HostTime, RuntimeDir};
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::{event, publish_subscribe};

/// The least header that the measurement needs.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, ZeroCopySend)]
#[type_name("depthrig.bench.RawHeader")]
pub struct RawHeader {
    /// Number of the frame.
    pub sequence: u64,
    /// Before the slot was lent.
    pub start_ns: i64,
    /// Right before it was sent.
    pub publish_ns: i64,
}

type Service = ipc::Service;
type Frames = publish_subscribe::PortFactory<Service, [u8], RawHeader>;
type Events = event::PortFactory<Service>;

fn service(runtime: &RuntimeDir) -> Result<(Node<Service>, Frames, Events)> {
    let mut config = Config::default();
    let root = runtime.path().join("raw").to_string_lossy().into_owned();
    let root =
        Path::new(root.as_bytes()).ok().context("the runtime folder is not a valid path for iceoryx2")?;
    config.global.set_root_path(&root);
    config.global.prefix =
        FileName::new(b"depthrig_bench_").ok().context("the prefix is not a valid file name")?;
    let node = NodeBuilder::new()
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .config(&config)
        .create::<Service>()?;
    let name: ServiceName = "bench/raw".try_into()?;
    let frames = node
        .service_builder(&name)
        .publish_subscribe::<[u8]>()
        .user_header::<RawHeader>()
        .open_or_create()?;
    let events = node.service_builder(&name).event().open_or_create()?;
    Ok((node, frames, events))
}

/// The writing end.
pub struct RawSender {
    port: Publisher<Service, [u8], RawHeader>,
    notifier: Notifier<Service>,
    _node: Node<Service>,
}

impl RawSender {
    /// Opens the channel for frames of `bytes` bytes.
    pub fn open(runtime: &RuntimeDir, bytes: usize) -> Result<Self> {
        let (node, frames, events) = service(runtime)?;
        let port = frames
            .publisher_builder()
            .initial_max_slice_len(bytes)
            .allocation_strategy(AllocationStrategy::Static)
            .create()?;
        Ok(Self { port, notifier: events.notifier_builder().create()?, _node: node })
    }

    /// Copies `pixels` into a slot and sends it.
    pub fn send(&self, sequence: u64, pixels: &[u8]) -> Result<()> {
        let start_ns = HostTime::now().ns();
        let slot = self.port.loan_slice_uninit(pixels.len())?;
        let mut sample = slot.write_from_slice(pixels);
        *sample.user_header_mut() = RawHeader { sequence, start_ns, publish_ns: HostTime::now().ns() };
        sample.send()?;
        self.notifier.notify()?;
        Ok(())
    }
}

/// The reading end.
pub struct RawReceiver {
    port: Subscriber<Service, [u8], RawHeader>,
    listener: Listener<Service>,
    _node: Node<Service>,
}

impl RawReceiver {
    /// Opens the channel.
    pub fn open(runtime: &RuntimeDir) -> Result<Self> {
        let (node, frames, events) = service(runtime)?;
        Ok(Self {
            port: frames.subscriber_builder().create()?,
            listener: events.listener_builder().create()?,
            _node: node,
        })
    }

    /// Sleeps until something is sent or `timeout` has passed, then hands `seen` the header of every unread
    /// frame.
    pub fn wait(&self, timeout: Duration, mut seen: impl FnMut(&RawHeader)) -> Result<()> {
        self.listener.timed_wait(|_| {}, timeout)?;
        while let Some(sample) = self.port.receive()? {
            seen(sample.user_header());
        }
        Ok(())
    }
}
