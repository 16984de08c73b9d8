//! `depthrig man`: generates the manual pages from the same definition as `--help`.

use crate::exit::Exit;
use crate::outfile::{OutFile, Overwrite};
use anyhow::{Context, Result};
use std::path::PathBuf;

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct ManArgs {
    /// Write depthrig.1, depthrig-run.1 and so on to DIR
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    #[command(flatten)]
    overwrite: Overwrite,
}

/// Prints or writes the manual of `program`.
pub fn run(args: &ManArgs, program: clap::Command) -> Result<Exit> {
    if let Some(folder) = &args.out {
        let unwritable = || format!("{}: cannot write the manual pages", folder.display());
        std::fs::create_dir_all(folder).with_context(unwritable)?;
        let generated = tempfile::tempdir().context("cannot create a temporary folder")?;
        clap_mangen::generate_to(program, generated.path()).context("cannot generate the manual pages")?;
        let mut pages = Vec::new();
        for entry in generated.path().read_dir()? {
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
