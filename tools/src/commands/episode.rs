//! `depthrig episode`: demonstrations within a recording of the running daemon.

use super::record::connect;
use crate::context::Context;
use crate::exit::Exit;
use crate::out;
use crate::printable;
use anyhow::Result;
use clap::ValueEnum;
use depthrig_daemon::control::EpisodeRequest;
use depthrig_recorder::{EpisodeEnd, EpisodeOutcome};

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
An episode is a span of a recording, so start one first: depthrig record start. A discarded episode stays on disk; exports
leave it out. Episodes of a finished dataset are judged with depthrig edit --episode.

Examples:
  depthrig episode start --task \"put the cup on the plate\"
  depthrig episode stop success
  depthrig episode discard        the one that runs, else the last one
  depthrig episode mark failure --episode 3";

/// Subcommands of `depthrig episode`.
#[derive(Debug, clap::Subcommand)]
pub enum EpisodeCommand {
    /// Begin an episode
    Start {
        /// Task
        #[arg(long, value_name = "TEXT", default_value = "")]
        task: String,
        /// Print JSON
        #[arg(long)]
        json: bool,
    },
    /// End the episode that runs, and keep it
    Stop {
        /// Whether the task was done
        #[arg(value_enum)]
        outcome: Option<Outcome>,
        /// Print JSON
        #[arg(long)]
        json: bool,
    },
    /// Mark an episode as not to be used; one that runs ends
    Discard {
        /// Its number [default: the one that runs, else the last one]
        #[arg(long, value_name = "N")]
        episode: Option<u32>,
        /// Print JSON
        #[arg(long)]
        json: bool,
    },
    /// Judge an episode that has ended, and keep it
    Mark {
        /// Whether the task was done
        #[arg(value_enum)]
        outcome: Outcome,
        /// Its number [default: the last one]
        #[arg(long, value_name = "N")]
        episode: Option<u32>,
        /// Print JSON
        #[arg(long)]
        json: bool,
    },
}

/// A judgement.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Outcome {
    /// The task was done
    Success,
    /// It was not
    Failure,
    /// No judgement
    None,
}

impl Outcome {
    const fn outcome(self) -> Option<EpisodeOutcome> {
        match self {
            Self::Success => Some(EpisodeOutcome::Success),
            Self::Failure => Some(EpisodeOutcome::Failure),
            Self::None => None,
        }
    }
}

/// Parses a judgement of a numbered episode, such as `3=success` or `3=discard`.
///
/// # Errors
/// When it is not one.
pub fn judgement(text: &str) -> Result<(u32, EpisodeEnd), String> {
    let wrong = || format!("write N=success, N=failure, N=none or N=discard, not \"{text}\"");
    let (number, what) = text.split_once('=').ok_or_else(wrong)?;
    let number = number.parse().map_err(|_| wrong())?;
    if what == "discard" {
        return Ok((number, EpisodeEnd::Discarded));
    }
    let outcome = Outcome::from_str(what, false).map_err(|_| wrong())?;
    Ok((number, EpisodeEnd::Kept(outcome.outcome())))
}

/// Sends the command to the daemon and prints the episode.
pub fn run(command: &EpisodeCommand, context: &Context) -> Result<Exit> {
    let (request, json) = match command {
        EpisodeCommand::Start { task, json } => (EpisodeRequest::Start { task: task.clone() }, *json),
        EpisodeCommand::Stop { outcome, json } => {
            (EpisodeRequest::Stop { outcome: outcome.and_then(Outcome::outcome) }, *json)
        }
        EpisodeCommand::Discard { episode, json } => (EpisodeRequest::Discard { number: *episode }, *json),
        EpisodeCommand::Mark { outcome, episode, json } => {
            (EpisodeRequest::Mark { outcome: outcome.outcome(), number: *episode }, *json)
        }
    };
    let episode = connect(context)?.episode(&request)?;
    if json {
        out::json(&episode)?;
    } else {
        out::line(format_args!("episode {}", printable::line(&episode.text())))?;
    }
    Ok(Exit::Good)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn judgements_are_read() {
        assert_eq!(judgement("3=success"), Ok((3, EpisodeEnd::Kept(Some(EpisodeOutcome::Success)))));
        assert_eq!(judgement("12=none"), Ok((12, EpisodeEnd::Kept(None))));
        assert_eq!(judgement("1=discard"), Ok((1, EpisodeEnd::Discarded)));
        for bad in ["3", "=success", "x=success", "3=good", "-1=discard", "3=SUCCESS"] {
            assert!(judgement(bad).unwrap_err().contains("N=success"), "{bad}");
        }
    }
}
