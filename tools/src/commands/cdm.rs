//! `depthrig cdm`: camera depth models, and refined depth of pictures and datasets.

use crate::context::Context;
use crate::exit::Exit;
use anyhow::Result;

pub mod seeded;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
docs/cdm.md tells the way from a downloaded checkpoint to a policy that reads refined depth.

Exit codes: 0 good, 1 failed, 2 wrong usage or configuration.

Examples:
  depthrig cdm seeded vits --out untrained-vits.safetensors";

/// What to do.
#[derive(Debug, clap::Subcommand)]
pub enum CdmCommand {
    /// Write a model of random numbers, for demonstrations and tests: what it gives is no depth
    #[command(after_help = seeded::EXAMPLES)]
    Seeded(seeded::SeededArgs),
}

/// Runs the subcommand.
pub fn run(command: &CdmCommand, _context: &Context) -> Result<Exit> {
    match command {
        CdmCommand::Seeded(args) => seeded::run(args),
    }
}
