//! `depthrig cdm seeded`: a model of random numbers, labelled as such.

use crate::exit::Exit;
use crate::out;
use crate::outfile::{OutFile, Overwrite};
use anyhow::Result;
use depthrig_cdm::Encoder;
use depthrig_cdm::weights::write_seeded;
use serde::Serialize;
use std::path::PathBuf;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
The same seed gives the same numbers on every computer. Models made so are called untrained in every header,
report and list.

Examples:
  depthrig cdm seeded vits --out untrained-vits.safetensors
  depthrig cdm import untrained-vits.safetensors --name demo";

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct SeededArgs {
    /// The size of the network: vits (0.2 GB), vitb (0.8 GB), vitl (2.6 GB) or vitg (9.8 GB)
    #[arg(value_name = "ENCODER", value_parser = encoder)]
    encoder: Encoder,
    /// The file to write, .safetensors
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// What the numbers follow from
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Replace the file if it exists
    #[arg(long, alias = "replace")]
    overwrite: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct Report<'a> {
    path: &'a PathBuf,
    encoder: Encoder,
    seed: u64,
    trained: bool,
}

/// Reads the name of an encoder.
///
/// # Errors
/// When there is none of that name.
pub fn encoder(text: &str) -> Result<Encoder, String> {
    text.parse().map_err(|e: depthrig_cdm::Error| e.to_string())
}

/// Writes it.
pub fn run(args: &SeededArgs) -> Result<Exit> {
    let SeededArgs { encoder, out, seed, overwrite, json } = args;
    OutFile::new(out, Overwrite { overwrite: *overwrite }, &[])?;
    write_seeded(*encoder, *seed, out)?;
    if *json {
        out::json(&Report { path: out, encoder: *encoder, seed: *seed, trained: false })?;
    } else {
        out::line(format_args!(
            "{}: {encoder} of random numbers (seed {seed}), never trained: for demonstrations and tests alone",
            out.display()
        ))?;
    }
    Ok(Exit::Good)
}
