//! `depthrig man`: the manual page, made from the same definition as `--help`.

use crate::cli::Cli;
use crate::exit::Exit;
use anyhow::{Context, Result};
use clap::CommandFactory;
use std::path::PathBuf;

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct ManArgs {
    /// Write depthrig.1, depthrig-run.1 and so on into this folder
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
}

/// Prints or writes it.
pub fn run(args: &ManArgs) -> Result<Exit> {
    if let Some(folder) = &args.out {
        let unwritable = || format!("{}: the manual pages cannot be written there", folder.display());
        std::fs::create_dir_all(folder).with_context(unwritable)?;
        clap_mangen::generate_to(Cli::command(), folder).with_context(unwritable)?;
    } else {
        let mut page = Vec::new();
        clap_mangen::Man::new(Cli::command()).render(&mut page)?;
        std::io::Write::write_all(&mut std::io::stdout().lock(), &page)?;
    }
    Ok(Exit::Good)
}
