//! `depthrig tap`: prints or saves one live stream.

mod motion;

use crate::context::Context;
use crate::exit::Exit;
use crate::outfile::Overwrite;
use crate::signals::Stop;
use crate::{image_file, out};
use anyhow::{Context as _, Result};
use core::time::Duration;
use depthrig_bus::{Bus, Frame, FrameFlags, FrameHeader, HostTime, PixelFormat, StreamId, Subscriber};
use std::path::PathBuf;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
Examples:
  depthrig tap d435/depth                          one line per frame until Ctrl-C
  depthrig tap d435/depth --count 1                only the next frame
  depthrig tap d435/depth --png images --count 5 16-bit PNGs with colour previews
  depthrig tap zed/imu --json | jq .samples[].gyro_rad_s  every sample of an IMU";

/// Silence of a stream after which a line says so.
const SILENCE: Duration = Duration::from_secs(2);
const POLL: Duration = Duration::from_millis(200);

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct TapArgs {
    /// Stream, such as d435/depth
    stream: StreamId,
    /// Write each frame to DIR as PNG; depth as 16 bits with a colour preview
    #[arg(long, value_name = "DIR")]
    png: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
    /// Print every IMU sample, one JSON object per batch
    #[arg(long, conflicts_with = "png")]
    json: bool,
    /// Stop after N frames
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    count: Option<u64>,
}

/// Prints frames until `--count` is reached, the stream ends or a signal arrives.
pub fn run(args: &TapArgs, context: &Context) -> Result<Exit> {
    let runtime = context.runtime()?;
    let bus = Bus::open(&runtime, &context.running_rig(&runtime)?)?;
    let mut subscriber = bus.subscriber(&args.stream)?;
    let mut newest = None;
    let stop = Stop::on_signals()?;
    let mut seen = 0;
    while args.count.is_none_or(|count| seen < count) {
        let Some(frame) = next(&mut subscriber, &stop, args)? else { break };
        seen += 1;
        let is_motion = frame.header().pixel_format().is_some_and(PixelFormat::is_motion);
        anyhow::ensure!(
            is_motion || !args.json,
            "{} is an image stream; --json prints IMU samples",
            args.stream
        );
        anyhow::ensure!(
            !is_motion || args.png.is_none(),
            "{} is an IMU and has no images; leave out --png, or print its samples with --json",
            args.stream
        );
        match (is_motion, args.json) {
            (true, true) => out::json_line(&motion::Batch::of(&frame))?,
            (true, false) => out::line(motion::describe(&frame, &mut newest))?,
            _ => out::line(describe(frame.header()))?,
        }
        if let Some(folder) = &args.png {
            if seen == 1 {
                depthrig_bus::umask::create_dir_all(folder)
                    .with_context(|| format!("{}: cannot be made", folder.display()))?;
            }
            let header = frame.header();
            let stem = format!("{}_{}_{:08}", header.camera(), header.stream(), header.sequence);
            for path in image_file::write_png(header, frame.pixels(), folder, &stem, args.overwrite)? {
                out::line(format_args!("  {}", path.display()))?;
            }
        }
    }
    let short = args.count.is_some_and(|count| seen < count) && !stop.is_asked();
    if short {
        anyhow::bail!("{}: the stream ended after {seen} of {} frames", args.stream, args.count.unwrap_or(0));
    }
    if args.png.is_some() && subscriber.missed() > 0 {
        tracing::warn!(frames = subscriber.missed(), "images were written slower than frames came");
    }
    Ok(Exit::Good)
}

/// Returns the next frame; `None` after a signal or when the publisher is gone.
fn next(subscriber: &mut Subscriber, stop: &Stop, args: &TapArgs) -> Result<Option<Frame>> {
    let began = HostTime::now();
    let mut announced = false;
    while !stop.is_asked() {
        if let Some(frame) = subscriber.next_timeout(POLL)? {
            return Ok(Some(frame));
        }
        if !subscriber.is_live() {
            return Ok(None);
        }
        if began.elapsed() > SILENCE && !announced {
            tracing::warn!(stream = %args.stream, "no frame for {} s; the camera may be lost", SILENCE.as_secs());
            announced = true;
        }
    }
    Ok(None)
}

/// Describes a frame on one line: format, capture time, latency, losses, flags.
fn describe(h: &FrameHeader) -> String {
    let ms = |ns: i64| ns as f64 / 1e6;
    let unit =
        if h.depth_unit_m > 0.0 { format!(" unit {} mm", h.depth_unit_m * 1e3) } else { String::new() };
    format!(
        "{}/{} #{} {}x{} {}{unit} capture {:.3} ms ±{:.3} latency {:.2} ms epoch {} dropped {} flags {}",
        h.camera(),
        h.stream(),
        h.sequence,
        h.width,
        h.height,
        h.pixel_format().map_or("unknown", PixelFormat::name),
        ms(h.capture_time_ns),
        h.capture_uncertainty_ns as f64 / 1e6,
        ms(h.publish_time_ns - h.capture_time_ns),
        h.clock_epoch,
        drops(h),
        flags(h),
    )
}

/// Drop reasons with their counts; `0` without losses.
fn drops(h: &FrameHeader) -> String {
    let drops: Vec<_> = h.drops().nonzero().map(|(why, n)| format!("{} {n}", why.name())).collect();
    if drops.is_empty() { "0".to_owned() } else { drops.join(",") }
}

/// Names of the flags; `-` without flags.
fn flags(h: &FrameHeader) -> String {
    let flags: Vec<_> = FrameFlags::ALL.iter().filter(|(_, f)| h.has(*f)).map(|(name, _)| *name).collect();
    if flags.is_empty() { "-".to_owned() } else { flags.join(",") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_says_what_matters() {
        let mut h = FrameHeader::default();
        h.set_image(PixelFormat::Z16, 640, 480);
        h.set_names("mount", &StreamId::new("d405", "depth").unwrap());
        (h.sequence, h.capture_time_ns, h.publish_time_ns) = (7, 1_000_000_000, 1_012_500_000);
        (h.capture_uncertainty_ns, h.depth_unit_m) = (250_000, 0.0001);
        h.dropped[0] = 2;
        h.flags = FrameFlags::SYNTHETIC.with(FrameFlags::REPLAYED).0;
        assert_eq!(
            describe(&h),
            "d405/depth #7 640x480 z16 unit 0.1 mm capture 1000.000 ms ±0.250 latency 12.50 ms epoch 0 \
             dropped device_gap 2 flags replayed,synthetic"
        );
    }
}
