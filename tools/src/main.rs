//! The command line of depthrig: one binary that runs the rig, shows its state, and manages its datasets.
//!
//! Exit codes: 0 success, 1 failure, 2 wrong usage or configuration, 3 finished but something was lost.
#![cfg_attr(test, allow(clippy::unwrap_used, clippy::expect_used))]

mod args;
mod bench;
mod calibrate;
mod cli;
mod cloud_image;
mod collect;
mod commands;
mod context;
mod demo;
mod eval;
mod exit;
mod font;
mod image_file;
mod install;
mod live;
mod logging;
mod out;
mod outfile;
mod printable;
mod progress;
mod scratch;
mod screen;
mod signals;
mod turbo;
mod view;
mod wall;
mod watched;

fn main() {
    let cli = cli::parse(); // ends the process with 2 and a hint when the usage is wrong
    logging::start(&cli.global, cli.command.loudness());
    let exit = commands::run(cli).unwrap_or_else(|error| exit::report(&error));
    exit::leave(exit)
}
