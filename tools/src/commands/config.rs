//! `depthrig config`: checks a rig configuration, or prints the default one.

use crate::exit::Exit;
use crate::out;
use anyhow::Result;
use depthrig_daemon::ErrorKind;
use depthrig_daemon::config::RigConfig;
use std::path::PathBuf;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
Examples:
  depthrig config show > rig.toml    commented default: seven synthetic cameras
  depthrig config show paper         rig of the paper: seven real cameras, ten depth modes
  depthrig config check rig.toml     list every problem with its line; exit code 2 if there are any";

/// Subcommands of `depthrig config`.
#[derive(Debug, clap::Subcommand)]
pub enum ConfigCommand {
    /// Check a configuration file and list every problem
    Check {
        /// Configuration file
        file: PathBuf,
    },
    /// Print a commented configuration
    Show {
        /// Configuration to print
        #[arg(value_enum, default_value = "default")]
        which: Shown,
    },
}

/// A configuration that comes with depthrig.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Shown {
    /// Seven synthetic cameras; runs as it is
    Default,
    /// The paper's seven real cameras
    Paper,
}

/// Checks or prints.
pub fn run(command: &ConfigCommand) -> Result<Exit> {
    match command {
        ConfigCommand::Show { which: Shown::Default } => out::line(RigConfig::default_text().trim_end())?,
        ConfigCommand::Show { which: Shown::Paper } => out::line(RigConfig::paper_text().trim_end())?,
        ConfigCommand::Check { file } => {
            let config = RigConfig::load(file).map_err(depthrig_daemon::Error::from)?;
            // Checks input files, but no attached cameras: those may be unplugged at this time.
            for camera in &config.cameras {
                camera.backend.check_input().map_err(|e| {
                    let message = format!("camera \"{}\": {e}", camera.name);
                    depthrig_daemon::Error::new(ErrorKind::BadInput, message).with_source(e)
                })?;
            }
            out::line(format_args!(
                "{}: good: rig \"{}\", {}, sets at {} Hz",
                file.display(),
                config.rig,
                out::count(config.cameras.len(), "camera"),
                config.sets.rate_hz
            ))?;
        }
    }
    Ok(Exit::Good)
}
