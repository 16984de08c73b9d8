//! `depthrig replay`: a dataset on the same channels as if the cameras were there.

use crate::context::Context;
use crate::exit::Exit;
use crate::out;
use crate::progress::Progress;
use crate::signals::Stop;
use anyhow::Result;
use core::time::Duration;
use depthrig_daemon::replay::{Replay, ReplayOptions};
use std::path::PathBuf;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
Frames carry their original times and the flag `replayed`; nothing else tells them from live ones.

Examples:
  depthrig replay data/20261121_1015_kitchen
  depthrig replay data/20261121_1015_kitchen --rate 0.5 --from 10 --to 20 --loop
  depthrig replay data/20261121_1015_kitchen --as-fast-as-possible --rig bench2";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct ReplayArgs {
    /// The dataset's folder
    dataset: PathBuf,
    /// Speed against the original
    #[arg(long, value_name = "R", default_value = "1", conflicts_with = "as_fast_as_possible")]
    rate: f64,
    /// Begin again at the end
    #[arg(long = "loop")]
    looped: bool,
    /// Begin so many seconds after the first set
    #[arg(long, value_name = "T")]
    from: Option<f64>,
    /// End so many seconds after the first set
    #[arg(long, value_name = "T")]
    to: Option<f64>,
    /// Do not wait between sets; slow subscribers miss frames then
    #[arg(long)]
    as_fast_as_possible: bool,
    /// Print JSON at the end
    #[arg(long)]
    json: bool,
}

/// Time that subscribers get to read the last frames before the channels go.
const LINGER: Duration = Duration::from_millis(300);

/// Replays until the end or a signal.
pub fn run(args: &ReplayArgs, context: &Context) -> Result<Exit> {
    let stop = Stop::on_signals()?;
    let options = ReplayOptions {
        rate: args.rate,
        looped: args.looped,
        from_s: args.from,
        to_s: args.to,
        as_fast_as_possible: args.as_fast_as_possible,
    };
    let replay = Replay::start(&args.dataset, &context.runtime()?, context.global.rig.clone(), options)?;
    let mut bar = Progress::new(context.global.quiet > 0);
    loop {
        let progress = replay.progress();
        let what =
            if progress.rounds > 1 { format!("replay, round {}", progress.rounds) } else { "replay".into() };
        bar.set(&what, (progress.position_s * 10.0) as u64, (progress.length_s * 10.0) as u64);
        if progress.done || stop.wait(Duration::from_millis(100)) {
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
        out::line(format_args!(
            "replayed {} sets, {} frames, {} of {}",
            result.sets,
            result.frames,
            out::seconds(result.position_s),
            out::seconds(result.length_s)
        ))?;
        for lost in &result.lost {
            out::line(format_args!("lost: {lost}"))?;
        }
    }
    Ok(if result.lost.is_empty() { Exit::Good } else { Exit::Lost })
}
