//! One module per command.

pub mod bench;
pub mod calibrate;
pub mod cameras;
pub mod cat;
pub mod cdm;
pub mod cloud;
pub mod collect;
pub mod compare;
pub mod completions;
pub mod config;
pub mod demo;
pub mod doctor;
pub mod edit;
pub mod episode;
pub mod eval;
pub mod export;
pub mod import;
pub mod info;
pub mod install;
pub mod man;
pub mod merge;
pub mod open;
pub mod prune;
pub mod record;
pub mod recover;
pub mod replay;
pub mod report;
pub mod run;
pub mod scenes;
pub mod sessions;
pub mod status;
pub mod stereo;
pub mod tap;
pub mod top;
pub mod trim;
pub mod verify;
pub mod zed;

use crate::cli::{Cli, Command};
use crate::context::Context;
use crate::exit::Exit;
use anyhow::Result;
use clap::CommandFactory;

/// Runs the command that was asked for.
///
/// # Errors
/// The command's error; [`crate::exit::report`] prints it.
pub fn run(cli: Cli) -> Result<Exit> {
    let context = Context { global: cli.global };
    match cli.command {
        Command::Demo(args) => demo::run(&args, &context),
        Command::Run(args) => run::run(&args, &context),
        Command::Record(command) => record::run(&command, &context),
        Command::Episode(command) => episode::run(&command, &context),
        Command::Collect(args) => collect::run(&args, &context),
        Command::Status(args) => status::run(&args, &context),
        Command::Open(args) => open::run(&args, &context),
        Command::Top(args) => top::run(&args, &context),
        Command::Replay(args) => replay::run(&args, &context),
        Command::Info(args) => info::run(&args),
        Command::Install(args) => install::run(&args),
        Command::Report(args) => report::run(&args, &context),
        Command::Sessions(args) => sessions::run(&args, &context),
        Command::Edit(args) => edit::run(&args, &context),
        Command::Eval(args) => eval::run(&args, &context),
        Command::Scenes(args) => scenes::run(&args, &context),
        Command::Export(command) => export::run(&command, &context),
        Command::Import(command) => import::run(&command, &context),
        Command::Verify(args) => verify::run(&args, &context),
        Command::Cameras(args) => cameras::run(&args, &context),
        Command::Doctor(args) => doctor::run(&args, &context),
        Command::Cat(args) => cat::run(&args, &context),
        Command::Cdm(command) => cdm::run(&command, &context),
        Command::Zed(command) => zed::run(&command, &context),
        Command::Calibrate(command) => calibrate::run(&command, &context),
        Command::Cloud(args) => cloud::run(&args, &context),
        Command::Stereo(args) => stereo::run(&args),
        Command::Trim(args) => trim::run(&args, &context),
        Command::Prune(args) => prune::run(&args, &context),
        Command::Merge(args) => merge::run(&args, &context),
        Command::Recover(args) => recover::run(&args, &context),
        Command::Compare(args) => compare::run(&args, &context),
        Command::Config(command) => config::run(&command),
        Command::Tap(args) => tap::run(&args, &context),
        Command::Bench(command) => bench::run(&command, &context),
        Command::Completions(args) => completions::run(&args, Cli::command()),
        Command::Man(args) => man::run(&args, Cli::command()),
        Command::BenchReader(args) => {
            crate::bench::bus::reader::run(&args, &context.runtime()?)?;
            Ok(Exit::Good)
        }
    }
}
