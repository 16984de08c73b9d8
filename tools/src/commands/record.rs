//! `depthrig record`: recordings of the running daemon.

use crate::context::Context;
use crate::exit::Exit;
use crate::out;
use anyhow::{Context as _, Result};
use depthrig_daemon::client::Client;
use depthrig_daemon::control::RecordRequest;
use depthrig_daemon::status::RecordingStatus;
use std::path::PathBuf;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
Examples:
  depthrig record start --scene kitchen --operator ada
  depthrig record start --for 10m       ends by itself, and is refused when it would not fit
  depthrig record note \"the cup was moved\"
  depthrig record stop        exit code 3 when the recording lost anything";

/// What to do.
#[derive(Debug, clap::Subcommand)]
pub enum RecordCommand {
    /// Start a recording
    Start(StartArgs),
    /// End the recording and close its files
    Stop {
        /// Print JSON
        #[arg(long)]
        json: bool,
    },
    /// Say how the recording in progress stands, or what became of the last one
    Status {
        /// Print JSON
        #[arg(long)]
        json: bool,
    },
    /// Add a note with its time to the recording
    Note {
        /// The note
        text: String,
    },
}

/// What a recording is to be.
#[derive(Debug, clap::Args)]
pub struct StartArgs {
    /// Folder in which the dataset's folder is made; the rig's own when left out
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Name of the dataset's folder; made of date, time and scene when left out
    #[arg(long)]
    name: Option<String>,
    /// What is in front of the cameras
    #[arg(long, value_name = "LABEL", default_value = "")]
    scene: String,
    /// Who records
    #[arg(long, value_name = "NAME", default_value = "")]
    operator: String,
    /// Free text that is kept with the dataset
    #[arg(long, value_name = "TEXT", default_value = "")]
    notes: String,
    /// End by itself after so long, such as 90s, 10m or 1h30m; refused when that is not expected to fit on the disk
    #[arg(long = "for", value_name = "DURATION", value_parser = crate::args::duration_s)]
    duration_s: Option<f64>,
    /// Begin even when the disk is expected to be full too soon
    #[arg(long)]
    force: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Talks to the daemon.
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
            tell(&client.record_start(&request)?, args.json)
        }
        RecordCommand::Stop { json } => {
            let status = client.record_stop()?;
            tell(&status, *json)?;
            let lost = status.error.is_some() || status.dropped.values().any(|n| *n > 0);
            Ok(if lost { Exit::Lost } else { Exit::Good })
        }
        RecordCommand::Status { json } => {
            let rig = client.status()?;
            let status =
                rig.recording.with_context(|| format!("rig {} has recorded nothing yet", rig.rig))?;
            tell(&status, *json)
        }
        RecordCommand::Note { text } => {
            client.record_note(text)?;
            Ok(Exit::Good)
        }
    }
}

/// The running daemon that `context` means.
pub fn connect(context: &Context) -> Result<Client> {
    Ok(Client::connect(&context.runtime()?, context.global.rig.as_ref())?)
}

fn tell(status: &RecordingStatus, json: bool) -> Result<Exit> {
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
    if let Some(e) = &status.error {
        out::line(format_args!("error: {e}"))?;
    }
    Ok(Exit::Good)
}
