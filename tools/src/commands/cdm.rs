//! `depthrig cdm`: camera depth models, and refined depth of pictures and datasets.

use crate::context::Context;
use crate::exit::Exit;
use anyhow::Result;

pub mod bench;
pub mod fetch;
pub mod relabel;
pub mod run;
pub mod store;

/// Examples for `--help`.
pub const EXAMPLES: &str = "\
docs/cdm.md tells the way from a downloaded checkpoint to a policy that reads refined depth.

Exit codes: 0 good, 1 failed, 2 wrong usage or configuration.

Examples:
  depthrig cdm fetch cdm-d435
  depthrig cdm import cdm_d435.ckpt
  depthrig cdm list
  depthrig cdm run --rgb color.png --depth depth.png --depth-unit 0.001 --model cdm-d435 --out refined.npy
  depthrig cdm relabel data/kitchen data/kitchen_cdm";

/// What to do.
#[derive(Debug, clap::Subcommand)]
pub enum CdmCommand {
    /// Install a checkpoint, all of which is verified
    #[command(after_help = store::IMPORT_EXAMPLES)]
    Import(store::ImportArgs),
    /// Fetch a published model and install it; what was cut goes on where it ended
    #[command(after_help = fetch::EXAMPLES)]
    Fetch(fetch::FetchArgs),
    /// List the installed models, or the published ones
    #[command(after_help = store::LIST_EXAMPLES)]
    List(store::ListArgs),
    /// Say where a model came from and what it wants
    #[command(after_help = store::INFO_EXAMPLES)]
    Info(store::InfoArgs),
    /// Remove an installed model; who uses it keeps it until they let go
    Remove(store::RemoveArgs),
    /// Refine the depth of one pair of pictures
    #[command(after_help = run::EXAMPLES)]
    Run(run::RunArgs),
    /// Measure how fast each engine refines, and with what memory
    #[command(after_help = bench::EXAMPLES)]
    Bench(bench::BenchArgs),
    /// Give a dataset refined depth, in a copy of it
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
