//! `depthrig replay`: replays datasets on the live channels and controls a running replay.

use crate::context::Context;
use crate::exit::Exit;
use crate::out;
use crate::progress::Progress;
use crate::signals::Stop;
use anyhow::Result;
use core::time::Duration;
use depthrig_cdm::stage::EngineChoice;
use depthrig_daemon::client::Client;
use depthrig_daemon::config::Port;
use depthrig_daemon::control::{RecordRequest, SeekRequest};
use depthrig_daemon::replay::{Replay, ReplayOptions, ReplaySummary};
use depthrig_daemon::status::ReplayStatus;
use std::path::PathBuf;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
Frames carry their original times and the flag `replayed`; otherwise they equal live frames. Several datasets are
replayed as one rig: in parallel if their cameras differ, one after the other if they are the same.

Examples:
  depthrig replay data/20261121_1015_kitchen
  depthrig replay data/20261121_1015_kitchen --rate 0.5 --from 10 --to 20 --loop
  depthrig replay data/left data/right --rig bench2
  depthrig replay data/20261121_1015_kitchen --as-fast-as-possible --paused    no set is missed, not even the first
  depthrig replay data/20261121_1015_kitchen --as-fast-as-possible --record data/again
  depthrig replay data/20261121_1015_kitchen --refine           adds depth_refined to the dataset's streams

From another terminal, while it runs:
  depthrig replay pause
  depthrig replay seek 12.5    go to the first set at or after 12.5 s and publish it
  depthrig replay step         one set forward; -1 goes back
  depthrig replay rate 0.1
  depthrig status              the dataset's cameras, shown like live ones";

/// Arguments.
#[derive(Debug, clap::Args)]
#[command(args_conflicts_with_subcommands = true, subcommand_negates_reqs = true)]
pub struct ReplayArgs {
    #[command(subcommand)]
    command: Option<ReplayCommand>,
    #[command(flatten)]
    start: StartArgs,
}

/// Options of a new replay.
#[derive(Debug, clap::Args)]
#[allow(clippy::struct_excessive_bools)] // options of a command line
struct StartArgs {
    /// Dataset folders
    #[arg(required = true, value_name = "DATASET")]
    datasets: Vec<PathBuf>,
    /// Speed relative to the original, 0.1 to 10
    #[arg(long, value_name = "R", default_value = "1", value_parser = crate::args::replay_rate,
          conflicts_with = "as_fast_as_possible")]
    rate: f64,
    /// Restart at the end
    #[arg(long = "loop")]
    looped: bool,
    /// Start T seconds after the first set
    #[arg(long, value_name = "T", value_parser = crate::args::seconds)]
    from: Option<f64>,
    /// Stop T seconds after the first set
    #[arg(long, value_name = "T", value_parser = crate::args::seconds)]
    to: Option<f64>,
    /// Publish as fast as subscribers read, without loss, instead of by the clock
    #[arg(long)]
    as_fast_as_possible: bool,
    /// Publish nothing until `depthrig replay resume`, `step` or `seek`
    #[arg(long)]
    paused: bool,
    /// Pause at the end instead of exiting
    #[arg(long, conflicts_with = "looped")]
    hold: bool,
    /// Record the replay into a new folder in DIR, without encoding again
    #[arg(long, value_name = "DIR", conflicts_with = "looped")]
    record: Option<PathBuf>,
    /// Record even if the disk is expected to fill up too soon
    #[arg(long, requires = "record")]
    force: bool,
    /// Name of the recording's folder [default: from date, time and scene]
    #[arg(long, requires = "record")]
    name: Option<String>,
    /// Refine depth with auto, fill, tiny or onnxruntime [default without ENGINE: auto]
    #[arg(long, value_name = "ENGINE", num_args = 0..=1, default_missing_value = "auto", require_equals = true,
          value_parser = engine, conflicts_with = "as_fast_as_possible")]
    refine: Option<EngineChoice>,
    /// Serve Foxglove and Lichtblick on this loopback port [default without PORT: 8765]
    #[arg(long, value_name = "PORT", num_args = 0..=1, default_missing_value = "8765", require_equals = true)]
    foxglove: Option<u16>,
    /// Print JSON at the end
    #[arg(long)]
    json: bool,
}

fn engine(text: &str) -> Result<EngineChoice, String> {
    Ok(match text {
        "auto" => EngineChoice::Auto,
        "fill" => EngineChoice::Fill,
        "tiny" => EngineChoice::Tiny,
        "onnxruntime" => EngineChoice::OnnxRuntime,
        _ => return Err("use auto, fill, tiny or onnxruntime".to_owned()),
    })
}

/// Controls of a running replay.
#[derive(Debug, clap::Subcommand)]
enum ReplayCommand {
    /// Show the position of the running replay
    Status(AnswerFormat),
    /// Pause the replay
    Pause(AnswerFormat),
    /// Resume the replay
    Resume(AnswerFormat),
    /// Go to a set and publish it, paused or not
    Seek(SeekArgs),
    /// Publish the next set, or N more, then pause; negative: go back
    Step {
        /// Number of sets
        #[arg(default_value = "1", allow_negative_numbers = true)]
        sets: i64,
        #[command(flatten)]
        answer: AnswerFormat,
    },
    /// Change the speed
    Rate {
        /// Speed relative to the original, 0.1 to 10
        #[arg(allow_negative_numbers = true, value_parser = crate::args::replay_rate)]
        rate: f64,
        #[command(flatten)]
        answer: AnswerFormat,
    },
    /// Turn looping on or off
    Loop {
        /// Restart at the end
        #[arg(value_enum)]
        on: Switch,
        #[command(flatten)]
        answer: AnswerFormat,
    },
}

/// Format of the printed answer.
#[derive(Debug, Clone, Copy, clap::Args)]
struct AnswerFormat {
    /// Print JSON
    #[arg(long)]
    json: bool,
}

#[derive(Debug, clap::Args)]
#[group(id = "place", required = true, multiple = false, args = ["seconds", "set", "id"])]
struct SeekArgs {
    /// Seconds after the first set; selects the first set at or after
    #[arg(allow_negative_numbers = true, value_parser = crate::args::seconds)]
    seconds: Option<f64>,
    /// Number of the set, counted from 0
    #[arg(long, value_name = "N")]
    set: Option<u64>,
    /// Id of the set in its dataset
    #[arg(long)]
    id: Option<u64>,
    #[command(flatten)]
    answer: AnswerFormat,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Switch {
    On,
    Off,
}

/// Starts a replay, or controls a running one.
pub fn run(args: &ReplayArgs, context: &Context) -> Result<Exit> {
    match &args.command {
        None => replay(&args.start, context),
        Some(command) => control(command, &super::record::connect(context)?),
    }
}

fn control(command: &ReplayCommand, replay: &Client) -> Result<Exit> {
    let (status, answer) = match command {
        ReplayCommand::Status(answer) => (replay.replay()?, answer),
        ReplayCommand::Pause(answer) => (replay.replay_pause()?, answer),
        ReplayCommand::Resume(answer) => (replay.replay_resume()?, answer),
        ReplayCommand::Seek(a) => {
            let place = SeekRequest { seconds: a.seconds, set: a.set, id: a.id };
            (replay.replay_seek(&place)?, &a.answer)
        }
        ReplayCommand::Step { sets, answer } => (replay.replay_step(*sets)?, answer),
        ReplayCommand::Rate { rate, answer } => (replay.replay_rate(*rate)?, answer),
        ReplayCommand::Loop { on, answer } => (replay.replay_loop(*on == Switch::On)?, answer),
    };
    if answer.json {
        out::json(&status)?;
    } else {
        out::line(crate::view::replay(&status))?;
    }
    Ok(if status.lost.is_empty() { Exit::Good } else { Exit::Lost })
}

/// Time for subscribers to read the last frames before the channels close.
const LINGER: Duration = Duration::from_millis(300);

/// Replays until the end or a signal.
fn replay(args: &StartArgs, context: &Context) -> Result<Exit> {
    let stop = Stop::on_signals()?;
    let options = ReplayOptions {
        by_utc: true,
        in_background: false,
        rate: args.rate,
        looped: args.looped,
        from_s: args.from,
        to_s: args.to,
        as_fast_as_possible: args.as_fast_as_possible,
        // The recording must start before the first set is published.
        paused: args.paused || args.record.is_some(),
        hold: args.hold,
        refine: args.refine,
        foxglove: args.foxglove.map_or(Port::Off, Port::loopback),
        serve_api: true,
    };
    let replay = Replay::start(&args.datasets, &context.runtime()?, context.global.rig.clone(), options)?;
    if let Some(directory) = &args.record {
        let request = RecordRequest {
            directory: Some(directory.clone()),
            name: args.name.clone(),
            force: args.force,
            ..RecordRequest::default()
        };
        let control = replay.control();
        control.record_start(&request)?;
        if let (Some(replay), false) = (control.replay(), args.paused) {
            replay.resume()?;
        }
    }
    let mut bar = Progress::new(context.global.quiet > 0);
    loop {
        let over = replay.wait(Duration::from_millis(100));
        let progress = replay.progress();
        bar.set(&headline(&progress), (progress.position_s * 10.0) as u64, (progress.length_s * 10.0) as u64);
        if over || stop.is_asked() {
            break;
        }
    }
    if !stop.is_asked() {
        stop.wait(LINGER);
    }
    let result = replay.stop();
    bar.clear();
    if args.json {
        out::json(&result)?;
    } else {
        print_summary(&result)?;
    }
    let recorded = result.recording.as_ref().is_none_or(|r| r.error.is_none() && r.dropped.is_empty());
    Ok(if result.status.lost.is_empty() && recorded { Exit::Good } else { Exit::Lost })
}

/// Label of the progress bar.
fn headline(progress: &ReplayStatus) -> String {
    match (&progress.waiting_for, progress.paused) {
        (Some(channel), _) => format!("replay, waiting for {channel}"),
        (None, true) => "replay, paused".into(),
        (None, false) if progress.rounds > 1 => format!("replay, round {}", progress.rounds),
        (None, false) => "replay".into(),
    }
}

fn print_summary(result: &ReplaySummary) -> Result<()> {
    let status = &result.status;
    out::line(format_args!(
        "replayed {}, {}, {} of {}",
        out::count(status.sets, "set"),
        out::count(status.frames, "frame"),
        out::seconds(status.position_s),
        out::seconds(status.length_s)
    ))?;
    if let Some(r) = &result.recording {
        let lost = out::reasons(&r.dropped);
        let size = out::bytes(r.bytes);
        out::line(format_args!(
            "recorded {}: {}, {}, {size}, lost {lost}",
            r.path,
            out::count(r.sets, "set"),
            out::count(r.frames, "frame")
        ))?;
        if let Some(e) = &r.error {
            out::line(format_args!("lost: {e}"))?;
        }
    }
    for lost in &status.lost {
        out::line(format_args!("lost: {lost}"))?;
    }
    Ok(())
}
