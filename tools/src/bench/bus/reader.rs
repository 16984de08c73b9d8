//! The subscriber process of the bus benchmark: this binary, started again with a hidden command.
//!
//! It prints `ready` to stdout when every channel is open, reads frames until stdin closes (so it also ends with its
//! parent), and then prints its counts as one line of JSON.

use super::raw::RawReceiver;
use super::{Channels, RIG};
use crate::bench::bus::place::{Place, place_of};
use anyhow::{Context, Result, bail};
use core::sync::atomic::{AtomicBool, Ordering};
use core::time::Duration;
use depthrig_bus::{Bus, ErrorKind, HostTime, RigName, RuntimeDir, StreamId, Subscriber};
use serde::{Deserialize, Serialize};
use std::io::{BufRead, Read, Write};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

const TIMEOUT: Duration = Duration::from_secs(20);
const POLL: Duration = Duration::from_millis(100);
/// As many frames as the bus lets one subscriber hold.
const HELD: usize = 16;

/// Behaviour of a reader.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Mode {
    /// Time every frame of the one stream and of the bare channel
    Latency,
    /// Count frames
    Count,
    /// Hold as many frames as allowed and never release them
    Hold,
    /// Report where in shared memory the frames of the first stream lie
    Place,
}

impl Mode {
    const fn name(self) -> &'static str {
        match self {
            Self::Latency => "latency",
            Self::Count => "count",
            Self::Hold => "hold",
            Self::Place => "place",
        }
    }
}

/// Arguments of the hidden command.
#[derive(Debug, clap::Args)]
pub struct ReaderArgs {
    /// Behaviour
    #[arg(long, value_enum)]
    mode: Mode,
    /// Number of streams to read
    #[arg(long)]
    streams: usize,
}

/// One timed frame.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub struct Timed {
    /// Number of the frame.
    pub sequence: u64,
    /// Right before it was sent to when the reader had it, nanoseconds.
    pub wire_ns: i64,
    /// Before its slot was lent to when the reader had it: with the writing of the pixels, nanoseconds.
    pub total_ns: i64,
}

/// Frames that a reader saw.
#[derive(Debug, Default, Serialize, Deserialize)]
pub struct Seen {
    /// Frames read.
    pub received: u64,
    /// Frames that were replaced before they were read.
    pub missed: u64,
    /// Times of the frames of the bus.
    pub ours: Vec<Timed>,
    /// Times of the frames of the bare loop.
    pub bare: Vec<Timed>,
    /// Locations of frames, by sequence number.
    pub places: Vec<(u64, Place)>,
}

/// Runs the hidden command.
pub fn run(args: &ReaderArgs, runtime: &RuntimeDir) -> Result<()> {
    let bus = Bus::open(runtime, &RigName::new(RIG)?)?;
    let mut subscribers = Vec::new();
    for id in Channels::ids()?.into_iter().take(args.streams) {
        subscribers.push(bus.subscriber_within(&id, TIMEOUT)?);
    }
    let stop = AtomicBool::new(false);
    let seen = std::thread::scope(|scope| -> Result<Seen> {
        let stop = &stop;
        // The ports of the bare loop must stay on the thread that made them.
        let (opened, is_open) = crossbeam::channel::bounded::<()>(1);
        let bare = (args.mode == Mode::Latency).then(|| {
            scope.spawn(move || {
                let receiver = RawReceiver::open(runtime)?;
                opened.send(())?;
                time_bare(&receiver, stop)
            })
        });
        if bare.is_some() {
            is_open.recv().context("the bare channel could not be opened")?;
        }
        let readers: Vec<_> =
            subscribers.into_iter().map(|s| scope.spawn(move || read(s, args.mode, stop))).collect();
        println!("ready");
        std::io::stdout().flush()?;
        std::io::stdin().read_to_end(&mut Vec::new())?;
        stop.store(true, Ordering::Relaxed);
        let mut all = Seen::default();
        for reader in readers {
            let mut seen = join(reader)??;
            all.received += seen.received;
            all.missed += seen.missed;
            all.ours.append(&mut seen.ours);
            all.places.append(&mut seen.places);
        }
        if let Some(bare) = bare {
            all.bare = join(bare)??;
        }
        Ok(all)
    })?;
    println!("{}", serde_json::to_string(&seen)?);
    Ok(())
}

fn join<T>(thread: std::thread::ScopedJoinHandle<'_, T>) -> Result<T> {
    thread.join().map_err(|_| anyhow::anyhow!("a reading thread panicked"))
}

fn read(mut subscriber: Subscriber, mode: Mode, stop: &AtomicBool) -> Result<Seen> {
    let mut seen = Seen::default();
    let mut held = Vec::new();
    while !stop.load(Ordering::Relaxed) {
        let frame = match subscriber.next_timeout(POLL) {
            Ok(Some(frame)) => frame,
            Ok(None) => continue,
            // This reader holds all frames it may and keeps requesting more, as a careless subscriber would.
            Err(e) if mode == Mode::Hold && e.kind() == ErrorKind::LimitReached => {
                std::thread::sleep(POLL);
                continue;
            }
            Err(e) => return Err(e.into()),
        };
        let now = HostTime::now().ns();
        let header = frame.header();
        seen.received += 1;
        match mode {
            Mode::Latency => seen.ours.push(Timed {
                sequence: header.sequence,
                wire_ns: now - header.publish_time_ns,
                total_ns: now - header.device_time as i64,
            }),
            Mode::Place => seen.places.push((header.sequence, place_of(frame.pixels())?)),
            Mode::Hold if held.len() < HELD => held.push(frame),
            Mode::Count | Mode::Hold => {}
        }
    }
    seen.missed = subscriber.missed();
    Ok(seen)
}

fn time_bare(receiver: &RawReceiver, stop: &AtomicBool) -> Result<Vec<Timed>> {
    let mut times = Vec::new();
    while !stop.load(Ordering::Relaxed) {
        receiver.wait(POLL, |header| {
            let now = HostTime::now().ns();
            times.push(Timed {
                sequence: header.sequence,
                wire_ns: now - header.publish_ns,
                total_ns: now - header.start_ns,
            });
        })?;
    }
    Ok(times)
}

/// A reader as its parent sees it. Dropping it kills the process.
pub struct Reader {
    child: Child,
    stdin: Option<ChildStdin>,
    stdout: std::io::BufReader<ChildStdout>,
}

impl Reader {
    /// Starts a reader of the first `streams` streams and waits until it is ready.
    pub fn start(runtime: &RuntimeDir, mode: Mode, streams: usize) -> Result<Self> {
        let mut reader = Self::start_at_once(runtime, mode, streams)?;
        let mut line = String::new();
        reader.stdout.read_line(&mut line)?;
        if line.trim() != "ready" {
            let status = reader.child.wait()?;
            bail!("the subscribing process did not get ready ({status})");
        }
        Ok(reader)
    }

    /// Starts a reader and does not wait for it.
    pub fn start_at_once(runtime: &RuntimeDir, mode: Mode, streams: usize) -> Result<Self> {
        let mut child = Command::new(std::env::current_exe()?)
            .arg("--runtime-dir")
            .arg(runtime.path())
            .args(["bench-reader", "--mode", mode.name(), "--streams", &streams.to_string()])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .context("the subscribing process could not be started")?;
        let stdin = child.stdin.take();
        let stdout = child.stdout.take().context("the subscribing process has no output")?;
        Ok(Self { child, stdin, stdout: std::io::BufReader::new(stdout) })
    }

    /// Asks it to end and returns the frames that it saw.
    pub fn finish(mut self) -> Result<Seen> {
        self.stdin = None;
        let mut line = String::new();
        self.stdout.read_line(&mut line)?;
        let status = self.child.wait()?;
        serde_json::from_str(&line)
            .with_context(|| format!("the subscribing process gave no result ({status})"))
    }

    /// Ends it with SIGKILL, as the kernel's out-of-memory killer would.
    pub fn kill(mut self) -> Result<()> {
        self.child.kill()?;
        self.child.wait()?;
        Ok(())
    }
}

impl Drop for Reader {
    fn drop(&mut self) {
        // Both fail if it has already ended, which is fine.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Channels {
    /// The streams of the bench in a fixed order.
    pub fn ids() -> Result<Vec<StreamId>> {
        let mut ids = Vec::new();
        for camera in 1..=Self::CAMERAS {
            for stream in ["color", "depth"] {
                ids.push(StreamId::new(&format!("cam{camera}"), stream)?);
            }
        }
        Ok(ids)
    }
}
