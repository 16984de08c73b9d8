//! `depthrig cdm`: camera depth models, and refined depth of images and datasets.

use crate::context::Context;
use crate::exit::Exit;
use anyhow::Result;

pub mod bench;
pub mod fetch;
mod pieces;
pub mod relabel;
pub mod run;
pub mod store;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
docs/cdm.md shows the steps from a downloaded checkpoint to a policy that reads refined depth.

Exit codes: 0 success, 1 failure, 2 wrong usage or configuration.

Examples:
  depthrig cdm fetch cdm-d435
  depthrig cdm import cdm_d435.ckpt
  depthrig cdm list
  depthrig cdm run --rgb color.png --depth depth.png --depth-unit 0.001 --model cdm-d435 --out refined.npy
  depthrig cdm relabel data/kitchen data/kitchen_cdm";

/// Subcommands of `depthrig cdm`.
#[derive(Debug, clap::Subcommand)]
pub enum CdmCommand {
    /// Verify and install a checkpoint
    #[command(after_help = store::IMPORT_EXAMPLES)]
    Import(store::ImportArgs),
    /// Download and install a published model; resumes an interrupted download
    #[command(after_help = fetch::EXAMPLES)]
    Fetch(fetch::FetchArgs),
    /// List the installed or the published models
    #[command(after_help = store::LIST_EXAMPLES)]
    List(store::ListArgs),
    /// Show a model's origin and settings
    #[command(after_help = store::INFO_EXAMPLES)]
    Info(store::InfoArgs),
    /// Remove an installed model; running processes keep it until they exit
    Remove(store::RemoveArgs),
    /// Refine the depth of one colour and depth image
    #[command(after_help = run::EXAMPLES)]
    Run(run::RunArgs),
    /// Measure speed and memory of each engine
    #[command(after_help = bench::EXAMPLES)]
    Bench(bench::BenchArgs),
    /// Copy a dataset and add refined depth to the copy
    #[command(after_help = relabel::EXAMPLES)]
    Relabel(relabel::RelabelArgs),
}

/// Runs the subcommand.
pub fn run(command: &CdmCommand, context: &Context) -> Result<Exit> {
    match command {
        CdmCommand::Import(args) => store::import(args, context),
        CdmCommand::Fetch(args) => fetch::run(args, context),
        CdmCommand::List(args) => store::list(args),
        CdmCommand::Info(args) => store::info(args),
        CdmCommand::Remove(args) => store::remove(args),
        CdmCommand::Run(args) => run::run(args),
        CdmCommand::Bench(args) => bench::run(args),
        CdmCommand::Relabel(args) => relabel::run(args, context),
    }
}
