//! `depthrig config`: checks a rig configuration, or prints the default one.

use crate::exit::Exit;
use crate::out;
use anyhow::Result;
use depthrig_daemon::config::RigConfig;
use std::path::PathBuf;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
Examples:
  depthrig config show > rig.toml    the commented default: seven synthetic cameras
  depthrig config check rig.toml     every problem with its line; exit code 2 when there is one";

/// What to do.
#[derive(Debug, clap::Subcommand)]
pub enum ConfigCommand {
    /// Say whether a file is a configuration that can run, or every reason why not
    Check {
        /// The configuration
        file: PathBuf,
    },
    /// Print the commented default configuration, which runs as it is
    Show,
}

/// Checks or prints.
pub fn run(command: &ConfigCommand) -> Result<Exit> {
    match command {
        ConfigCommand::Show => out::line(RigConfig::default_text().trim_end())?,
        ConfigCommand::Check { file } => {
            let config = RigConfig::load(file).map_err(depthrig_daemon::Error::from)?;
            let streams: usize = config.cameras.iter().map(|c| c.streams.len()).sum();
            out::line(format_args!(
                "{}: good: rig \"{}\", {} cameras, {streams} streams, sets at {} Hz",
                file.display(),
                config.rig,
                config.cameras.len(),
                config.sets.rate_hz
            ))?;
        }
    }
    Ok(Exit::Good)
}
