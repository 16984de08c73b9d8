//! `depthrig man`: the manual page, made from the same definition as `--help`.

use crate::exit::Exit;
use crate::outfile::{OutFile, Overwrite};
use anyhow::{Context, Result};
use std::path::PathBuf;

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct ManArgs {
    /// Write depthrig.1, depthrig-run.1 and so on into this folder
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
}

/// Prints or writes the manual of `program`.
pub fn run(args: &ManArgs, program: clap::Command) -> Result<Exit> {
    if let Some(folder) = &args.out {
        let unwritable = || format!("{}: the manual pages cannot be written there", folder.display());
        std::fs::create_dir_all(folder).with_context(unwritable)?;
        let made = tempfile::tempdir().context("no temporary folder can be made")?;
        clap_mangen::generate_to(program, made.path()).context("the manual pages cannot be made")?;
        let mut pages = Vec::new();
        for entry in made.path().read_dir()? {
            let entry = entry?;
            pages.push((entry.path(), OutFile::new(&folder.join(entry.file_name()), args.overwrite, &[])?));
        }
        for (from, to) in pages {
            to.write(&std::fs::read(from)?)?;
        }
    } else {
        let mut page = Vec::new();
        clap_mangen::Man::new(program).render(&mut page)?;
        std::io::Write::write_all(&mut std::io::stdout().lock(), &page)?;
    }
    Ok(Exit::Good)
}
