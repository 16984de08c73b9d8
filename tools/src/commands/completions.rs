//! `depthrig completions`: prints shell completions.

use crate::exit::Exit;
use anyhow::Result;
use clap_complete::Shell;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
Examples:
  depthrig completions bash > ~/.local/share/bash-completion/completions/depthrig
  depthrig completions zsh > ~/.zfunc/_depthrig
  depthrig completions fish > ~/.config/fish/completions/depthrig.fish";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct CompletionsArgs {
    /// Shell
    shell: Shell,
}

/// Prints the completions of `program`.
pub fn run(args: &CompletionsArgs, mut program: clap::Command) -> Result<Exit> {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut program, "depthrig", &mut script);
    std::io::Write::write_all(&mut std::io::stdout().lock(), &script)?;
    Ok(Exit::Good)
}
