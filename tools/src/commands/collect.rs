//! `depthrig collect`: demonstration after demonstration, with keys or a foot pedal.

use super::record::connect;
use crate::collect::cycle::{Action, Cycle, Input, Key, Phase, Plan};
use crate::collect::display::{Display, View};
use crate::collect::pedal::{Pedal, Press};
use crate::collect::rig::Rig;
use crate::context::Context;
use crate::exit::Exit;
use crate::out;
use crate::screen;
use crate::signals::Stop;
use anyhow::Result;
use core::time::Duration;
use depthrig_bus::HostTime;
use depthrig_daemon::control::RecordRequest;
use depthrig_recorder::EpisodeOutcome;
use std::path::PathBuf;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
Each episode follows a pause in which the scene is put back; the terminal's bell sounds at its begin and end. Without a
terminal there are no keys, and times alone decide. A recording that goes on already is joined, and goes on afterwards.

Keys, most of them as in LeRobot's recorder:
  right arrow, n, space   end the pause, or the episode, which is kept
  left arrow, r           do it again: discard the episode that runs, or in the pause the last one
  s, f                    the episode that runs, or in the pause the last one, is a success or a failure
  Esc, q, Ctrl-C          end; finished episodes are kept, the one that runs is discarded

A pedal is an input device of Linux, whose keys no other program gets meanwhile. The key that is pressed first means the
right arrow, whatever its code; that key for a second, or any other key, means the left arrow. It counts on release.

A discarded episode stays on disk, and exports leave it out; depthrig edit --episode takes a judgement back.

Examples:
  depthrig collect --task \"put the cup on the plate\" --episodes 50 --length 20s --reset 10s
  depthrig collect --task \"open the drawer\" --pedal /dev/input/by-id/usb-PCsensor_FootSwitch-event-kbd";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct CollectArgs {
    /// Task of the episodes
    #[arg(long, value_name = "TEXT")]
    task: String,
    /// Episodes to keep
    #[arg(long, value_name = "N", default_value_t = 50, value_parser = clap::value_parser!(u32).range(1..=4096))]
    episodes: u32,
    /// Length of an episode, such as 20s or 1m30s
    #[arg(long, value_name = "DURATION", default_value = "60s", value_parser = crate::args::duration_s)]
    length: f64,
    /// Length of the pause before each episode
    #[arg(long, value_name = "DURATION", default_value = "60s", value_parser = crate::args::duration_s)]
    reset: f64,
    /// Scene label
    #[arg(long, value_name = "LABEL", default_value = "")]
    scene: String,
    /// Operator
    #[arg(long, value_name = "NAME", default_value = "")]
    operator: String,
    /// Event device of a foot pedal, below /dev/input/by-id
    #[arg(long, value_name = "PATH")]
    pedal: Option<PathBuf>,
    /// Print the summary as JSON
    #[arg(long)]
    json: bool,
}

/// Polling interval of the pedal and of signals.
const LOOK: Duration = Duration::from_millis(50);
/// Polling interval of the rig.
const RIG: Duration = Duration::from_secs(1);

/// Collects until there are enough episodes or somebody ends it, and prints a summary.
pub fn run(args: &CollectArgs, context: &Context) -> Result<Exit> {
    let client = connect(context)?;
    let pedal = args.pedal.as_deref().map(Pedal::open).transpose()?;
    let stop = Stop::on_signals()?;
    let display = Display::open()?;
    let request = RecordRequest {
        scene: args.scene.clone(),
        operator: args.operator.clone(),
        ..RecordRequest::default()
    };
    let rig = Rig::open(client, &request, args.task.clone())?;
    let plan = Plan {
        episodes: args.episodes,
        length_ns: (args.length * 1e9) as i64,
        reset_ns: (args.reset * 1e9) as i64,
    };
    let cycle = Cycle::new(plan, HostTime::now());
    let mut session = Session { rig, cycle, display, pedal, stop, notes: Vec::new(), troubles: Vec::new() };
    session.greet(!args.scene.is_empty() || !args.operator.is_empty());
    let failure = session.run().err();
    let Session { rig, display, .. } = session;
    drop(display);
    let (summary, failure) = rig.finish(args.episodes, failure);
    if args.json {
        out::json(&summary.json())?;
    } else {
        out::line(summary.text())?;
    }
    failure.map_or_else(|| Ok(summary.exit()), Err)
}

/// A session.
struct Session {
    rig: Rig,
    cycle: Cycle,
    display: Display,
    pedal: Option<Pedal>,
    stop: Stop,
    /// Events that are reported once.
    notes: Vec<String>,
    /// Troubles that need attention now.
    troubles: Vec<String>,
}

impl Session {
    fn greet(&mut self, has_labels: bool) {
        if self.rig.is_joined() {
            let unused = if has_labels { "; --scene and --operator are not used" } else { "" };
            let path = self.rig.path();
            self.note(format!("joins the recording {path}, which goes on afterwards{unused}"));
        }
        if !self.display.has_keys() {
            let pedal = if self.pedal.is_some() { "the pedal and times" } else { "times alone" };
            self.note(format!("no terminal, so no keys: {pedal} decide, and Ctrl-C ends"));
        }
    }

    fn note(&mut self, note: String) {
        if let Display::Lines { .. } = self.display {
            out::note(&note);
        }
        self.notes.push(note);
    }

    fn run(&mut self) -> Result<()> {
        let mut look = HostTime::now();
        while self.cycle.phase() != Phase::Done {
            self.show()?;
            let inputs = self.inputs();
            let is_due = self.cycle.due().is_some_and(|due| due.from_now().is_zero());
            // Also before each change: an episode that somebody else has ended is not ended again.
            if is_due || !inputs.is_empty() || look.from_now().is_zero() {
                self.look()?;
                look = HostTime::now().plus(RIG);
            }
            for input in inputs.into_iter().chain([Input::Tick]) {
                self.step(input)?;
            }
        }
        self.show()
    }

    fn show(&mut self) -> Result<()> {
        let Self { rig, cycle, display, notes, troubles, .. } = self;
        display.show(&View { cycle, rig, troubles, notes })
    }

    /// Waits a moment for what people ask for.
    fn inputs(&mut self) -> Vec<Input> {
        let wait = self.cycle.due().map_or(LOOK, |due| due.from_now().min(LOOK));
        let key = self.display.key(wait, &self.stop).and_then(key_of);
        let presses = match self.pedal.as_mut().map_or(Ok(Vec::new()), Pedal::presses) {
            Ok(presses) => presses,
            Err(gone) => {
                self.note(gone.to_string());
                Vec::new()
            }
        };
        let stop = self.stop.is_asked().then_some(Key::Stop);
        let pressed = presses.into_iter().map(|press| match press {
            Press::Next => Key::Next,
            Press::Again => Key::Again,
        });
        stop.into_iter().chain(key).chain(pressed).map(Input::Key).collect()
    }

    fn look(&mut self) -> Result<()> {
        let look = self.rig.look()?;
        self.troubles = look.troubles;
        if let Some(episode) = look.ended {
            self.note(format!("episode {} was ended by somebody else", episode.number));
            self.step(Input::EndedElsewhere { is_discarded: episode.discarded })?;
        }
        Ok(())
    }

    fn step(&mut self, input: Input) -> Result<()> {
        for action in self.cycle.step(HostTime::now(), input) {
            match action {
                Action::Begin => {
                    self.rig.begin()?;
                    self.cycle.step(HostTime::now(), Input::Begun);
                }
                Action::Keep(outcome) => self.rig.keep(outcome)?,
                Action::Discard | Action::DiscardLast => self.rig.discard()?,
                Action::JudgeLast(outcome) => self.rig.judge(outcome)?,
                Action::Bell => self.display.bell()?,
                Action::Finish => {}
            }
        }
        Ok(())
    }
}

fn key_of(key: screen::Key) -> Option<Key> {
    match (key, key.letter()) {
        (screen::Key::Right, _) | (_, Some('n' | ' ')) => Some(Key::Next),
        (screen::Key::Left, _) | (_, Some('r')) => Some(Key::Again),
        (screen::Key::Escape, _) | (_, Some('q')) => Some(Key::Stop),
        (_, Some('s')) => Some(Key::Judge(EpisodeOutcome::Success)),
        (_, Some('f')) => Some(Key::Judge(EpisodeOutcome::Failure)),
        _ => None,
    }
}
