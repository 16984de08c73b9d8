//! Every fault that vivid can inject, through the backend `v4l2`: the driver's report, and exact accounts.

use crate::Scenario;
use crate::checks::Checks;
use crate::vivid::{self, SIZE, Taken};
use anyhow::Context;
use depthrig_bus::{DropReason, HostTime, PixelFormat};
use depthrig_driver::{Error, ErrorKind, MemorySink};
use depthrig_usb::video::ImageSource;
use depthrig_v4l2::{
    DEFAULT_BUFFERS, FourCc, Interval, MemoryChoice, MetadataFormat, Mode, Node, Source, V4l2Config, Wanted,
};
use std::time::Duration;

/// See the module.
pub const SCENARIO: Scenario = Scenario {
    name: "v4l2-faults",
    about: "vivid's faults through the backend v4l2: error flags, lost buffers, refusals, a fatal error, unplug",
    cost: 2,
    limit_s: 90,
    needs: "",
    run,
};

fn run(checks: &mut Checks) -> anyhow::Result<()> {
    vivid::load(3)?;
    for memory in [MemoryChoice::Mmap, MemoryChoice::UserPointer] {
        error_flag(checks, memory)?;
        lost_buffers(checks, memory)?;
        slow_receiver(checks, memory)?;
        refusals(checks, memory)?;
        fatal(checks, memory)?;
    }
    no_memory(checks)?;
    busy(checks)?;
    two_in_one_thread(checks)?;
    unplug(checks, MemoryChoice::Mmap, 0)?;
    unplug(checks, MemoryChoice::UserPointer, 1)
}

fn take(memory: MemoryChoice, n: usize, count: u64, each: impl FnMut(&MemorySink)) -> anyhow::Result<Taken> {
    let config = V4l2Config { memory, clock: depthrig_v4l2::ClockChoice::Kernel, ..vivid::config(n) };
    let stream = vivid::start(config, &vivid::request(PixelFormat::Yuyv)?)?;
    vivid::take(stream, MemorySink::lending(), count, each)
}

/// Runs `then` once, when the sink has so many frames.
fn at<'a>(frames: u64, mut then: impl FnMut() -> Result<(), Error> + 'a) -> impl FnMut(&MemorySink) + 'a {
    let mut done = false;
    move |sink| {
        if !done && sink.delivered(0) >= frames {
            done = true;
            if let Err(e) = then() {
                println!("the fault could not be injected: {e}");
            }
        }
    }
}

/// Frames that the kernel counted between the first and the last that were delivered, both included.
fn counted(taken: &Taken) -> u64 {
    let sequence =
        |f: Option<&(usize, depthrig_driver::FrameMeta, Vec<u8>)>| f.map_or(0, |f| f.1.device_sequence);
    sequence(taken.sink.frames.last()) + 1 - sequence(taken.sink.frames.first())
}

fn error_flag(checks: &mut Checks, memory: MemoryChoice) -> anyhow::Result<()> {
    let node = vivid::capture_node(0)?;
    let flag = at(5, || vivid::set(&node, "inject_v4l2_buf_flag_error", 1));
    let taken = take(memory, 0, 15, flag)?;
    let drops = taken.sink.drops_of(0);
    checks.equal(
        &format!("{memory:?}: a buffer flagged as damaged is dropped"),
        drops.get(DropReason::DeviceError),
        1,
    );
    checks.equal(&format!("{memory:?}: and nothing else"), drops.total(), 1);
    checks.that(
        &format!("{memory:?}: the account is exact"),
        taken.balances() && counted(&taken) == taken.captured(),
        taken.captured(),
    );
    Ok(())
}

fn lost_buffers(checks: &mut Checks, memory: MemoryChoice) -> anyhow::Result<()> {
    let node = vivid::capture_node(0)?;
    vivid::set(&node, "percentage_of_dropped_buffers", 30)?;
    let taken = take(memory, 0, 40, |_| ());
    vivid::set(&node, "percentage_of_dropped_buffers", 0)?;
    let taken = taken?;
    let lost = taken.sink.drops_of(0).get(DropReason::DeviceGap);
    checks.that(
        &format!("{memory:?}: buffers that the kernel lost are gaps"),
        (3..=25).contains(&lost),
        lost,
    );
    checks.that(
        &format!("{memory:?}: lost and delivered are what the kernel counted"),
        taken.balances() && counted(&taken) == taken.captured(),
        format!("{} of {}", taken.sink.delivered(0), counted(&taken)),
    );
    Ok(())
}

fn slow_receiver(checks: &mut Checks, memory: MemoryChoice) -> anyhow::Result<()> {
    let taken = take(memory, 0, 40, |_| std::thread::sleep(Duration::from_millis(200)))?;
    let drops = taken.sink.drops_of(0);
    let gaps = drops.get(DropReason::DeviceGap);
    checks.that(
        &format!("{memory:?}: a slow receiver loses frames by count"),
        gaps > 5 && gaps == drops.total(),
        gaps,
    );
    checks.that(
        &format!("{memory:?}: and the count is exact"),
        taken.balances() && counted(&taken) == taken.captured(),
        format!("{} of {}", taken.sink.delivered(0), counted(&taken)),
    );
    Ok(())
}

/// One-time errors of single calls: the stream or its start ends with an error, and the next start works.
fn refusals(checks: &mut Checks, memory: MemoryChoice) -> anyhow::Result<()> {
    let node = vivid::capture_node(0)?;
    for (control, call) in [
        ("inject_vidioc_reqbufs_error", "VIDIOC_REQBUFS"),
        ("inject_vidioc_streamon_error", "VIDIOC_STREAMON"),
    ] {
        vivid::set(&node, control, 1)?;
        let refused = take(memory, 0, 3, |_| ());
        let shown = match &refused {
            Err(e) => format!("{e:#}"),
            Ok(_) => "it streamed".to_owned(),
        };
        // Into user memory, a refusal falls back to the kernel's buffers, which the one-time error does not reach.
        let as_it_should = match memory {
            MemoryChoice::Mmap => refused.as_ref().err().is_some_and(|e| e.to_string().contains(call)),
            MemoryChoice::UserPointer => refused.as_ref().is_ok_and(|t| t.end.is_none()),
        };
        checks.that(&format!("{memory:?}: a refused {call}"), as_it_should, shown);
        let again = take(memory, 0, 3, |_| ())?;
        checks.that(
            &format!("{memory:?}: the next start works"),
            again.balances() && again.end.is_none(),
            again.captured(),
        );
    }
    let queue = at(4, || vivid::set(&node, "inject_vidioc_qbuf_error", 1));
    let taken = take(memory, 0, 30, queue)?;
    let said = taken.end.as_ref().map(ToString::to_string).unwrap_or_default();
    checks.that(
        &format!("{memory:?}: a buffer that is not taken backends the stream"),
        !said.is_empty(),
        said,
    );
    checks.that(&format!("{memory:?}: with exact accounts"), taken.balances(), taken.captured());
    let again = take(memory, 0, 3, |_| ())?;
    checks.that(
        &format!("{memory:?}: and the next start works"),
        again.balances() && again.end.is_none(),
        again.captured(),
    );
    Ok(())
}

fn fatal(checks: &mut Checks, memory: MemoryChoice) -> anyhow::Result<()> {
    let node = vivid::capture_node(0)?;
    let inject = at(4, || vivid::set(&node, "inject_fatal_streaming_error", 1));
    let taken = take(memory, 0, 60, inject)?;
    let error = taken.end.as_ref().context("it streamed on")?;
    checks.that(
        &format!("{memory:?}: a fatal error of the queue ends the stream"),
        error.kind() == ErrorKind::Io && error.to_string().contains("VIDIOC_DQBUF"),
        error,
    );
    checks.that(&format!("{memory:?}: with exact accounts"), taken.balances(), taken.captured());
    let again = take(memory, 0, 5, |_| ())?;
    checks.that(
        &format!("{memory:?}: opening it again cures it"),
        again.balances() && again.end.is_none(),
        again.captured(),
    );
    Ok(())
}

/// A receiver that has no memory for a while, and one that never lends any.
fn no_memory(checks: &mut Checks) -> anyhow::Result<()> {
    let request = vivid::request(PixelFormat::Yuyv)?;
    let mut sink = MemorySink::lending();
    sink.refuse = 5;
    let taken = vivid::take(vivid::start(vivid::config(0), &request)?, sink, 10, |_| ())?;
    let drops = taken.sink.drops_of(0);
    checks.equal("Mmap: frames without memory are dropped", drops.get(DropReason::NoSlot), 5);
    checks.that("Mmap: and counted", taken.balances() && drops.total() == 5, taken.captured());
    let user = V4l2Config { memory: MemoryChoice::UserPointer, ..vivid::config(0) };
    let taken = vivid::take(vivid::start(user, &request)?, MemorySink::default(), 5, |_| ())?;
    checks.that(
        "UserPointer: a receiver that lends nothing gets copies",
        taken.balances() && taken.end.is_none() && taken.sink.delivered(0) == 5,
        taken.captured(),
    );
    Ok(())
}

fn busy(checks: &mut Checks) -> anyhow::Result<()> {
    let request = vivid::request(PixelFormat::Yuyv)?;
    let held = vivid::start(vivid::config(0), &request)?;
    let error = vivid::start(vivid::config(0), &request).err().context("two at once")?;
    checks.equal("a camera in use is busy", error.kind(), ErrorKind::Busy);
    checks.that("the message names who has it", error.to_string().contains("held by this process"), &error);
    drop(held);
    let again = vivid::start(vivid::config(0), &request);
    checks.that("and free when it is given back", again.is_ok(), "");
    Ok(())
}

/// Two cameras with their metadata in one [`Source`].
fn two_in_one_thread(checks: &mut Checks) -> anyhow::Result<()> {
    let mode = Mode {
        format: FourCc::YUYV,
        width: SIZE.0,
        height: SIZE.1,
        interval: Interval { numerator: 1, denominator: 30 },
    };
    let mut wanted = Vec::new();
    for n in 0..2 {
        let video = vivid::capture_node(n)?;
        video.set_mode(&mode)?;
        // D4XX is asked for; the kernel answers with what it has.
        wanted.push(Wanted { video, metadata: Some((vivid::metadata_node(n)?, MetadataFormat::D4xx)) });
    }
    let mut source = Source::start(wanted, DEFAULT_BUFFERS)?;
    checks.equal(
        "the kernel's own metadata format is reported",
        [source.metadata(0), source.metadata(1)],
        [MetadataFormat::Uvch; 2],
    );
    let mut seen = [0u32; 2];
    let mut headers = [0u32; 2];
    let until = HostTime::now().plus(Duration::from_secs(1));
    while !until.from_now().is_zero() {
        source.poll(Duration::from_millis(50), &mut |p| {
            seen[p.source] += 1;
            headers[p.source] += u32::from(p.header.is_some_and(|h| h.len() >= 12));
        })?;
    }
    let enough = seen.iter().all(|n| (28..=32).contains(n));
    checks.that("two cameras in one thread", enough, format!("{seen:?} in a second"));
    checks.equal("each image has its header", headers, seen);
    Ok(())
}

fn unplug(checks: &mut Checks, memory: MemoryChoice, n: usize) -> anyhow::Result<()> {
    let node: Node = vivid::capture_node(n)?;
    let mut pulled = None;
    let pull = at(5, || {
        pulled = Some(HostTime::now());
        vivid::set(&node, "disconnect", 1)
    });
    let taken = take(memory, n, 200, pull)?;
    let after = pulled.context("it was not unplugged")?.elapsed();
    let error = taken.end.as_ref().context("it streamed on")?;
    checks.equal(
        &format!("{memory:?}: an unplugged camera is disconnected"),
        error.kind(),
        ErrorKind::Disconnected,
    );
    checks.that(&format!("{memory:?}: at once"), after < Duration::from_millis(100), format!("{after:?}"));
    checks.that(&format!("{memory:?}: with exact accounts"), taken.balances(), taken.captured());
    Ok(())
}
