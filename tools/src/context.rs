//! The rig that a command works on, and its output settings.

use crate::args::{ColorChoice, Global};
use crate::exit::UsageError;
use anyhow::Result;
use depthrig_bus::{RigName, RuntimeDir};
use std::io::IsTerminal;

/// Settings passed to every command.
#[derive(Debug, Clone)]
pub struct Context {
    /// The global options.
    pub global: Global,
}

impl Context {
    /// The runtime folder: the option, else the user's.
    ///
    /// # Errors
    /// When the folder cannot be used.
    pub fn runtime(&self) -> Result<RuntimeDir> {
        Ok(match &self.global.runtime_dir {
            Some(path) => RuntimeDir::at(path)?,
            None => RuntimeDir::of_user()?,
        })
    }

    /// The rig that a command talks to: the option, else the only one that runs.
    ///
    /// # Errors
    /// When none runs, or several do and none was named.
    pub fn running_rig(&self, runtime: &RuntimeDir) -> Result<RigName> {
        if let Some(rig) = &self.global.rig {
            return Ok(rig.clone());
        }
        let mut rigs = runtime.running_rigs();
        match rigs.len() {
            1 => Ok(rigs.remove(0)),
            0 => Err(anyhow::anyhow!(
                "no rig is running in {}; start one with `depthrig run RIG.toml` (or name its folder with --runtime-dir)",
                runtime.path().display()
            )),
            _ => {
                let names: Vec<_> = rigs.iter().map(ToString::to_string).collect();
                Err(UsageError(format!(
                    "several rigs are running, say which with --rig: {}",
                    names.join(", ")
                ))
                .into())
            }
        }
    }

    /// Whether the standard output may be coloured.
    pub fn color(&self) -> bool {
        let no_color = std::env::var_os("NO_COLOR").is_some_and(|v| !v.is_empty());
        wants_color(self.global.color, no_color, std::io::stdout().is_terminal())
    }
}

/// Creates a folder for a private rig, removed when the value is dropped. Its path is short, because
/// sockets below it must fit into 107 bytes.
///
/// # Errors
/// When no folder can be made.
pub fn private_folder() -> Result<tempfile::TempDir> {
    Ok(tempfile::Builder::new().prefix("depthrig-").tempdir_in("/tmp")?)
}

/// Decides by the option, then `NO_COLOR`, then whether stdout is a terminal.
pub const fn wants_color(choice: ColorChoice, no_color: bool, terminal: bool) -> bool {
    match choice {
        ColorChoice::Always => true,
        ColorChoice::Never => false,
        ColorChoice::Auto => terminal && !no_color,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_decides_on_color() {
        use ColorChoice::{Always, Auto, Never};
        assert!(wants_color(Always, true, false) && wants_color(Auto, false, true));
        assert!(!wants_color(Auto, true, true) && !wants_color(Auto, false, false));
        assert!(!wants_color(Never, false, true));
    }
}
