//! `depthrig calibrate capture`: takes views of a board.

use crate::calibrate;
use crate::calibrate::capture::display;
use crate::calibrate::capture::events::{Reporter, event};
use crate::calibrate::capture::rounds::{Rounds, Sight, look};
use crate::calibrate::capture::store::{Opened, Store, Subject};
use crate::context::Context;
use crate::exit::{Exit, UsageError};
use crate::live::{Source, source};
use crate::out;
use crate::screen::{self, Screen};
use crate::signals::Stop;
use anyhow::Result;
use depthrig_bus::StreamId;
use depthrig_calibrate::board::Board;
use depthrig_calibrate::capture::{Capture, Progress, State, Step};
use depthrig_calibrate::detect::{Detector, detector};
use depthrig_daemon::client::Client;
use std::io::IsTerminal as _;
use std::path::PathBuf;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
Hold the board still at one place after the other; a view is taken by itself after three images without motion (0.3 px), unless one was taken
at the same place. The display shows what each camera sees, where its views lie, the next view that would help most, and what is missing.
It ends by itself when nothing is missing, at --views, or with Ctrl-C, and goes on when it is started again with the same --out.

Exit codes: 0 nothing is missing or --views are there, 1 failure, 2 wrong usage, 3 ended before.

Examples:
  depthrig calibrate capture                                   the only rig that is running
  depthrig calibrate capture mount --board board.toml -o views
  depthrig calibrate capture data/20261125_1015_board -o views   the places of a recording at which the board stands still
  depthrig calibrate capture --json | jq .progress.hint.text";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct CaptureArgs {
    /// Running rig (name or file) or dataset [default: the only rig running]
    #[arg(value_name = "RIG|DATASET")]
    source: Option<PathBuf>,
    /// Description of the board
    #[arg(long, value_name = "FILE", default_value = "board.toml")]
    board: PathBuf,
    /// Dataset of the views; one that holds views of the same cameras and board grows
    #[arg(short, long, value_name = "DIR", default_value = "views")]
    out: PathBuf,
    /// Stream of a camera to look at; repeatable [default: color, left or infrared]
    #[arg(long, value_name = "CAMERA/STREAM")]
    stream: Vec<StreamId>,
    /// End when there are N views, whatever is missing
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    views: Option<u32>,
    /// Print events, one JSON object a line
    #[arg(long)]
    json: bool,
}

/// Takes views until there are enough.
pub fn run(args: &CaptureArgs, context: &Context) -> Result<Exit> {
    let board = calibrate::board(&args.board)?;
    let source = source(args.source.as_deref(), context)?;
    if let Source::Dataset(path) = &source
        && is_same(path, &args.out)
    {
        return Err(UsageError(format!(
            "{}: is the input; name another folder with --out",
            args.out.display()
        ))
        .into());
    }
    let stop = Stop::on_signals()?;
    let Some(mut rounds) = Rounds::open(&source, &args.stream, &stop, context)? else {
        return Ok(Exit::Lost);
    };
    let subject = Subject { rig: &rounds.rig, streams: &rounds.streams, board: &board };
    let Opened { store, views } = Store::open(&args.out, &subject)?;
    let mut capture = Capture::new(rounds.cameras(), &board)?;
    let known = views.len();
    capture.restore(views);
    let reporter = match &source {
        Source::Rig(rig) => Reporter::new(Client::connect(&context.runtime()?, Some(rig))?),
        Source::Dataset(_) => Reporter::none(),
    };
    let mut session = CaptureSession {
        detector: detector(&board)?,
        board: &board,
        out: args.out.display().to_string(),
        most: args.views.map(|n| n as usize),
        capture,
        store,
        reporter,
        shown: Shown::new(args.json, known)?,
    };
    let ended = session.take(&mut rounds, &stop);
    session.end(ended, args)
}

/// A capture that goes on.
struct CaptureSession<'a> {
    detector: Box<dyn Detector>,
    board: &'a Board,
    out: String,
    most: Option<usize>,
    capture: Capture,
    store: Store,
    reporter: Reporter,
    shown: Shown,
}

impl CaptureSession<'_> {
    /// Takes views until there are enough, the source ends, or the end is asked for.
    fn take(&mut self, rounds: &mut Rounds, stop: &Stop) -> Result<()> {
        while !self.is_enough() {
            let Some(round) = rounds.next(stop)? else { break };
            let Sight { seen, refused } =
                look(self.detector.as_ref(), self.board, self.capture.cameras(), &round)?;
            let Step { view, .. } = self.capture.look(&seen);
            if let Some(view) = view
                && let Err(e) = self.store.push(&view, &round)
            {
                self.capture.forget_last();
                return Err(e);
            }
            let progress = self.capture.progress();
            self.shown.show(&self.out, &progress, &refused)?;
            self.reporter.send(event(&self.out, progress, false, &refused));
        }
        Ok(())
    }

    fn is_enough(&self) -> bool {
        self.most.is_some_and(|most| self.capture.views().len() >= most) || self.capture.is_enough()
    }

    /// Completes the dataset, whatever ended the capture, and says what comes next.
    fn end(self, ended: Result<()>, args: &CaptureArgs) -> Result<Exit> {
        let progress = self.capture.progress();
        let is_json = matches!(self.shown, Shown::Json { .. });
        drop(self.shown);
        let last = event(&self.out, progress.clone(), true, &[]);
        if is_json {
            out::json_line(&last)?;
        }
        self.reporter.finish(last);
        let stored = self.store.finish();
        ended?;
        let summary = stored?;
        if let Some(lost) = summary.as_ref().and_then(|s| s.lost.first()) {
            anyhow::bail!("{}: is not complete: {lost}", self.out);
        }
        if !is_json {
            out::line(format_args!("{} in {}", out::count(progress.views, "view"), self.out))?;
            for line in display::missing(&progress) {
                out::line(line)?;
            }
            if progress.missing.is_empty() {
                out::line("nothing is missing")?;
            }
            if progress.views > 0 {
                out::line(format_args!(
                    "next:     depthrig calibrate solve {} --board {}",
                    self.out,
                    args.board.display()
                ))?;
            }
        }
        let is_enough = progress.missing.is_empty() || self.most.is_some_and(|most| progress.views >= most);
        Ok(if is_enough { Exit::Good } else { Exit::Lost })
    }
}

/// How progress is shown.
enum Shown {
    Screen(Screen),
    Lines { last: Option<Last> },
    Json { last: Option<Last> },
}

/// The state that was shown last.
#[derive(PartialEq, Eq)]
struct Last {
    state: State,
    views: usize,
    hint: Option<String>,
    refused: Vec<String>,
}

impl Last {
    fn of(progress: &Progress, refused: &[String]) -> Self {
        Self {
            state: progress.state,
            views: progress.views,
            hint: progress.hint.as_ref().map(|h| h.text.clone()),
            refused: refused.to_vec(),
        }
    }
}

impl Shown {
    fn new(json: bool, known: usize) -> Result<Self> {
        if json {
            return Ok(Self::Json { last: None });
        }
        if std::io::stdout().is_terminal() {
            return Ok(Self::Screen(Screen::enter()?));
        }
        if known > 0 {
            out::line(format_args!("going on after {}", out::count(known, "view")))?;
        }
        Ok(Self::Lines { last: None })
    }

    fn show(&mut self, name: &str, progress: &Progress, refused: &[String]) -> Result<()> {
        let now = Last::of(progress, refused);
        match self {
            Self::Screen(screen) => {
                let width = screen::size().unwrap_or(screen::USUAL).0;
                screen.draw(&display::page(progress, name, refused.first().map(String::as_str), width))
            }
            Self::Json { last } => {
                if last.as_ref() == Some(&now) {
                    return Ok(());
                }
                *last = Some(now);
                out::json_line(&event(name, progress.clone(), false, refused))
            }
            Self::Lines { last } => {
                let is_new = last.as_ref().is_none_or(|l| l.views != now.views || l.hint != now.hint);
                if is_new && now.views > 0 {
                    let seen: Vec<String> = (progress.cameras.iter())
                        .filter(|c| c.corners > 0)
                        .map(|c| format!("{} {}", c.name, c.corners))
                        .collect();
                    out::line(format_args!("view {}: {}", now.views, seen.join(", ")))?;
                }
                if is_new && let Some(hint) = &now.hint {
                    out::line(format_args!("  next: {hint}"))?;
                }
                if let Some(why) =
                    now.refused.first().filter(|_| last.as_ref().is_none_or(|l| l.refused != now.refused))
                {
                    out::line(format_args!("  note: {why}"))?;
                }
                *last = Some(now);
                Ok(())
            }
        }
    }
}

fn is_same(a: &std::path::Path, b: &std::path::Path) -> bool {
    a.canonicalize().ok().is_some_and(|a| b.canonicalize().ok() == Some(a))
}
