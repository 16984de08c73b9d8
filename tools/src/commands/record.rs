//! `depthrig record`: controls recordings of the running daemon.

use crate::context::Context;
use crate::exit::Exit;
use crate::out;
use crate::printable;
use crate::view;
use anyhow::{Context as _, Result};
use depthrig_daemon::client::Client;
use depthrig_daemon::control::RecordRequest;
use depthrig_daemon::status::RecordingStatus;
use std::path::PathBuf;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
Examples:
  depthrig record start --scene kitchen --operator ada
  depthrig record start --for 10m       stops by itself; refused if the disk is too small
  depthrig record note \"the cup was moved\"
  depthrig record stop        exit code 3 if the recording lost anything

In a rig of several computers the others record when this one does; `start` ends with 3 when one of them does not.";

/// Subcommands of `depthrig record`.
#[derive(Debug, clap::Subcommand)]
pub enum RecordCommand {
    /// Start a recording
    Start(StartArgs),
    /// Stop the recording and close its files
    Stop {
        /// Print JSON
        #[arg(long)]
        json: bool,
    },
    /// Show the state of the current or last recording
    Status {
        /// Print JSON
        #[arg(long)]
        json: bool,
    },
    /// Add a timestamped note to the recording
    Note {
        /// Text of the note
        text: String,
    },
}

/// Settings of a new recording.
#[derive(Debug, clap::Args)]
pub struct StartArgs {
    /// Folder to create the dataset in [default: from the rig configuration]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Name of the dataset folder [default: from date, time and scene]
    #[arg(long)]
    name: Option<String>,
    /// Scene label
    #[arg(long, value_name = "LABEL", default_value = "")]
    scene: String,
    /// Operator
    #[arg(long, value_name = "NAME", default_value = "")]
    operator: String,
    /// Notes to store with the dataset
    #[arg(long, value_name = "TEXT", default_value = "")]
    notes: String,
    /// Stop after this time, such as 90s, 10m or 1h30m; refused if it will not fit
    #[arg(long = "for", value_name = "DURATION", value_parser = crate::args::duration_s)]
    duration_s: Option<f64>,
    /// Record even if the disk is expected to fill up too soon
    #[arg(long)]
    force: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Sends the command to the daemon and prints its answer.
pub fn run(command: &RecordCommand, context: &Context) -> Result<Exit> {
    let client = connect(context)?;
    match command {
        RecordCommand::Start(args) => {
            // The daemon may run in another folder than this command.
            let directory = args.out.as_deref().map(std::path::absolute).transpose()?;
            let request = RecordRequest {
                directory,
                name: args.name.clone(),
                scene: args.scene.clone(),
                operator: args.operator.clone(),
                notes: args.notes.clone(),
                max_duration_s: args.duration_s,
                force: args.force,
            };
            let status = client.record_start(&request)?;
            let hosts = client.status()?.hosts.unwrap_or_default();
            print_status(&status, args.json)?;
            if args.json {
                return Ok(if hosts.is_ill() { Exit::Lost } else { Exit::Good });
            }
            for host in &hosts.hosts {
                match (&host.recording, &host.why) {
                    (Some(part), None) => {
                        let clock = view::hosts::clock(host);
                        out::line(format_args!("host {}: recording {part}{clock}", host.host))?;
                    }
                    (_, why) => {
                        let why = why.as_deref().unwrap_or("records nothing yet");
                        out::line(format_args!("host {}: {}", host.host, printable::line(why)))?;
                    }
                }
            }
            Ok(if hosts.is_ill() { Exit::Lost } else { Exit::Good })
        }
        RecordCommand::Stop { json } => {
            let status = client.record_stop()?;
            print_status(&status, *json)?;
            let lost = status.error.is_some() || status.dropped.values().any(|n| *n > 0);
            Ok(if lost { Exit::Lost } else { Exit::Good })
        }
        RecordCommand::Status { json } => {
            let rig = client.status()?;
            let status =
                rig.recording.with_context(|| format!("rig {} has recorded nothing yet", rig.rig))?;
            print_status(&status, *json)
        }
        RecordCommand::Note { text } => {
            client.record_note(text)?;
            Ok(Exit::Good)
        }
    }
}

/// Connects to the running daemon that `context` selects.
pub fn connect(context: &Context) -> Result<Client> {
    let runtime = context.runtime()?;
    Ok(match &context.global.host {
        Some(host) => Client::of_host(&runtime, &context.running_rig(&runtime)?, host)?,
        None => Client::connect(&runtime, context.global.rig.as_ref())?,
    })
}

fn print_status(status: &RecordingStatus, json: bool) -> Result<Exit> {
    if json {
        out::json(status)?;
        return Ok(Exit::Good);
    }
    out::line(format_args!(
        "{} {}: {}, {}, {}, {}, lost {}",
        if status.active { "recording" } else { "recorded" },
        status.path,
        out::seconds(status.duration_s),
        out::count(status.sets, "set"),
        out::count(status.frames, "frame"),
        out::bytes(status.bytes),
        out::reasons(&status.dropped)
    ))?;
    if let Some(last) = &status.episode {
        let discarded = match status.episodes_discarded {
            0 => String::new(),
            n => format!(", {n} discarded"),
        };
        let kept = out::count(status.episodes, "episode");
        out::line(format_args!("{kept}{discarded}; {}", printable::line(&last.text())))?;
    }
    if let Some(e) = &status.error {
        out::line(format_args!("error: {e}"))?;
    }
    Ok(Exit::Good)
}
