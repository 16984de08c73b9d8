//! The commands and options, with their `--help` texts.

use crate::args::Global;
use crate::commands::{
    bench, calibrate, cameras, cat, cdm, cloud, collect, compare, completions, config, demo, doctor, edit,
    episode, eval, export, import, info, install, man, merge, open, prune, record, recover, replay, report,
    run, scenes, sessions, status, stereo, tap, top, trim, verify, zed,
};
use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};

/// Capture, timestamp, group, share, record and replay the cameras of an RGB-D rig
#[derive(Debug, Parser)]
#[command(name = "depthrig", version, max_term_width = 100, after_help = EXIT_CODES)]
pub struct Cli {
    /// Options of every command.
    #[command(flatten)]
    pub global: Global,
    /// The subcommand.
    #[command(subcommand)]
    pub command: Command,
}

const EXIT_CODES: &str = "\
Exit codes:
  0  success
  1  failure
  2  wrong usage or configuration
  3  finished, but something was lost (the output says what)

Examples:
  depthrig demo                          full pipeline once, without a camera
  depthrig config show > rig.toml        commented configuration that runs as it is
  depthrig run rig.toml                  daemon in the foreground
  depthrig top                           watch it from another terminal
  depthrig record start --scene kitchen  record until `depthrig record stop`";

/// The commands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Capture, record, verify, replay and report seven synthetic cameras
    #[command(after_help = demo::EXAMPLES)]
    Demo(demo::DemoArgs),
    /// List attached cameras: model, serial number, port, speed, user, problems
    #[command(after_help = cameras::EXAMPLES)]
    Cameras(cameras::CamerasArgs),
    /// Draw boards; calibrate intrinsics, poses on the mount and hand-eye
    #[command(subcommand, after_help = calibrate::EXAMPLES)]
    Calibrate(calibrate::CalibrateCommand),
    /// Write the point cloud of all cameras at one moment, and compare their surfaces
    #[command(after_help = cloud::EXAMPLES)]
    Cloud(cloud::CloudArgs),
    /// Check cameras, USB, permissions, memory and disk before a session
    #[command(after_help = doctor::EXAMPLES)]
    Doctor(doctor::DoctorArgs),
    /// Run the daemon in the foreground until Ctrl-C
    #[command(after_help = run::EXAMPLES)]
    Run(run::RunArgs),
    /// Start, stop and annotate recordings of the running daemon
    #[command(subcommand, after_help = record::EXAMPLES)]
    Record(record::RecordCommand),
    /// Begin, end, discard and judge demonstrations within a recording
    #[command(subcommand, after_help = episode::EXAMPLES)]
    Episode(episode::EpisodeCommand),
    /// Collect demonstrations one after the other, with keys or a foot pedal
    #[command(after_help = collect::EXAMPLES)]
    Collect(collect::CollectArgs),
    /// Show cameras, rates, losses, clocks, recording and disk of the running daemon
    #[command(after_help = status::EXAMPLES)]
    Status(status::StatusArgs),
    /// Open the live page of the running daemon in a browser
    #[command(after_help = open::EXAMPLES)]
    Open(open::OpenArgs),
    /// Watch the running daemon, refreshed in place; q or Ctrl-C quits
    #[command(after_help = top::EXAMPLES)]
    Top(top::TopArgs),
    /// Replay datasets on the live channels, and control a running replay
    #[command(after_help = replay::EXAMPLES)]
    Replay(replay::ReplayArgs),
    /// Show the contents of a dataset
    Info(info::InfoArgs),
    /// Write the quality report of a dataset: rates, losses, spreads, clocks, images
    #[command(after_help = report::EXAMPLES)]
    Report(report::ReportArgs),
    /// List the datasets in a folder: scene, start, length, sets, size, health
    #[command(after_help = sessions::EXAMPLES)]
    Sessions(sessions::SessionsArgs),
    /// Change scene, operator, notes or name of a dataset, with a history of edits
    #[command(after_help = edit::EXAMPLES)]
    Edit(edit::EditArgs),
    /// Evaluate depth against a reference (metrics table, HTML report)
    #[command(after_help = eval::EXAMPLES)]
    Eval(Box<eval::EvalArgs>),
    /// Make random scenes with true and measured depth, to train depth models with
    #[command(after_help = scenes::EXAMPLES)]
    Scenes(scenes::ScenesArgs),
    /// Export datasets to other layouts: ByteCameraDepth, LeRobot
    #[command(subcommand, after_help = export::EXAMPLES)]
    Export(export::ExportCommand),
    /// Import recordings of other programs as datasets
    #[command(subcommand, after_help = import::EXAMPLES)]
    Import(import::ImportCommand),
    /// Check that a dataset is complete and undamaged
    #[command(after_help = verify::EXAMPLES)]
    Verify(verify::VerifyArgs),
    /// List frames of a dataset, or write them as PNG, NPY or JPEG files
    #[command(after_help = cat::EXAMPLES)]
    Cat(cat::CatArgs),
    /// Install camera depth models, and refine depth with them
    #[command(subcommand, after_help = cdm::EXAMPLES)]
    Cdm(cdm::CdmCommand),
    /// Recompute depth from recorded raw stereo
    #[command(subcommand, after_help = zed::EXAMPLES)]
    Zed(zed::ZedCommand),
    /// Compute the disparity of a rectified image pair
    #[command(after_help = stereo::EXAMPLES)]
    Stereo(stereo::StereoArgs),
    /// Cut a part of a dataset into a new dataset
    #[command(after_help = trim::EXAMPLES)]
    Trim(trim::TrimArgs),
    /// Remove the sets of discarded episodes from a dataset for good
    #[command(after_help = prune::EXAMPLES)]
    Prune(prune::PruneArgs),
    /// Join parts of one recording into one dataset
    #[command(after_help = merge::EXAMPLES)]
    Merge(merge::MergeArgs),
    /// Repair a dataset after a crash, a full disk or a damaged sector
    #[command(after_help = recover::EXAMPLES)]
    Recover(recover::RecoverArgs),
    /// Compare two datasets and list their differences
    #[command(after_help = compare::EXAMPLES)]
    Compare(compare::CompareArgs),
    /// Check a rig configuration, or print the commented default
    #[command(subcommand, after_help = config::EXAMPLES)]
    Config(config::ConfigCommand),
    /// Show, install or remove the udev rules and the systemd service
    #[command(after_help = install::EXAMPLES)]
    Install(install::InstallArgs),
    /// Watch one live stream: a line per frame, or image files
    #[command(after_help = tap::EXAMPLES)]
    Tap(tap::TapArgs),
    /// Measure performance and check it against depthrig's promises
    #[command(subcommand, after_help = bench::EXAMPLES)]
    Bench(bench::BenchCommand),
    /// Print shell completions
    #[command(after_help = completions::EXAMPLES)]
    Completions(completions::CompletionsArgs),
    /// Print the manual page, or write one page per command
    Man(man::ManArgs),
    /// Run the subscriber process of `bench bus`
    #[command(hide = true)]
    BenchReader(crate::bench::bus::reader::ReaderArgs),
}

impl Command {
    /// Log level relative to the default: one level more for the daemon, whose log is its output; one less for commands
    /// whose output already lists every problem.
    pub const fn loudness(&self) -> i32 {
        match self {
            Self::Run(_) => 1,
            Self::Cameras(_) | Self::Doctor(_) => -1,
            _ => 0,
        }
    }
}

/// Parses the command line of this process; on wrong usage prints a hint and exits with code 2.
pub fn parse() -> Cli {
    let matches = with_negative_numbers(Cli::command()).get_matches();
    Cli::from_arg_matches(&matches).unwrap_or_else(|e| e.exit())
}

/// Lets every option take a negative number as its value, so that it is rejected as a value and not as an unknown
/// option.
fn with_negative_numbers(mut command: clap::Command) -> clap::Command {
    let names: Vec<_> = command.get_subcommands().map(|c| c.get_name().to_owned()).collect();
    for name in names {
        command = command.mut_subcommand(name, with_negative_numbers);
    }
    command.mut_args(|arg| {
        let takes_value = arg.get_action().takes_values();
        if takes_value { arg.allow_negative_numbers(true) } else { arg }
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::error::ErrorKind;

    #[test]
    fn a_negative_number_is_a_value() {
        let parse = |line: &str| {
            let args = line.split_whitespace();
            with_negative_numbers(Cli::command()).try_get_matches_from(["depthrig"].into_iter().chain(args))
        };
        with_negative_numbers(Cli::command()).debug_assert();
        for line in [
            "verify ds --max-spread-ms -3",
            "cat ds --from -5",
            "trim ds out --to -1.5",
            "verify ds --threads -1",
            "export bytecameradepth ds out --depth-unit -0.001",
            "export bytecameradepth ds out --depth-unit 1e-300",
            "import bytecameradepth a out --depth-unit d405=-1",
            "cdm run --rgb a --depth b --depth-unit 1e-300 --model m --out o",
            "eval --truth a --pred b --unit 1e-300",
            "zed replay a --out out --modes quality --depth-unit 1e300",
        ] {
            let e = parse(line).expect_err(line);
            assert!(matches!(e.kind(), ErrorKind::ValueValidation | ErrorKind::InvalidValue), "{line}: {e}");
        }
        assert_eq!(parse("verify ds --nothing").unwrap_err().kind(), ErrorKind::UnknownArgument);
    }

    /// Covers every `f64` option and argument of every command.
    #[test]
    fn no_number_of_any_command_is_negative_infinite_or_not_a_number() {
        /// Collects the words before the value of each such argument of `command`; `path` holds the command's own
        /// words.
        fn fractions(command: &clap::Command, path: &[String], found: &mut Vec<Vec<String>>) {
            for arg in command.get_arguments() {
                if arg.get_value_parser().type_id() == std::any::TypeId::of::<f64>() {
                    let name = arg.get_long().map(|long| format!("--{long}"));
                    found.push(path.iter().cloned().chain(name).collect());
                }
            }
            for sub in command.get_subcommands() {
                let path: Vec<_> = path.iter().cloned().chain([sub.get_name().to_owned()]).collect();
                fractions(sub, &path, found);
            }
        }
        let cli = with_negative_numbers(Cli::command());
        let mut found = Vec::new();
        fractions(&cli, &["depthrig".to_owned()], &mut found);
        assert!(found.len() >= 25, "{found:?}");
        for words in found {
            for value in ["-3", "nan", "inf", "-inf", "1e308", "ten"] {
                // Behind `=` an option's value may begin with a minus in any form.
                let mut words = words.clone();
                match words.last_mut().filter(|last| last.starts_with("--")) {
                    Some(option) => {
                        option.push('=');
                        option.push_str(value);
                    }
                    None if value == "-inf" => continue,
                    None => words.push(value.to_owned()),
                }
                let e = cli.clone().try_get_matches_from(&words).expect_err(&words.join(" "));
                assert_eq!(e.kind(), ErrorKind::ValueValidation, "{words:?}: {e}");
            }
        }
        for (line, range) in [
            ("verify ds --max-spread-ms -3", "-3 ms is out of range 0..=3600000"),
            ("verify ds --max-spread-ms nan", "nan ms is out of range 0..=3600000"),
            ("report ds --max-spread-ms=inf", "inf ms is out of range 0..=3600000"),
            ("zed replay a --out b --memory -1", "-1 GB is out of range 0..=1000000"),
            ("replay rate 100", "100 times is out of range 0.1..=10"),
        ] {
            let words = ["depthrig"].into_iter().chain(line.split_whitespace());
            let e = cli.clone().try_get_matches_from(words).expect_err(line).to_string();
            assert!(e.contains(range), "{line}: {e}");
        }
    }

    #[test]
    fn the_definition_is_sound() {
        Cli::command().debug_assert();
    }

    /// clap finds a clash with a global option only when the command is run, and panics then.
    #[test]
    fn no_command_has_an_option_of_the_name_of_a_global_one() {
        fn check(command: &clap::Command, globals: &[&clap::Arg]) {
            for sub in command.get_subcommands() {
                for arg in sub.get_arguments() {
                    let long = |g: &clap::Arg| g.get_long().is_some() && g.get_long() == arg.get_long();
                    let clash = globals.iter().any(|g| g.get_id() == arg.get_id() || long(g));
                    assert!(!clash, "{}: {}", sub.get_name(), arg.get_id());
                }
                check(sub, globals);
            }
        }
        let cli = Cli::command();
        let globals: Vec<_> = cli.get_arguments().filter(|a| a.is_global_set()).collect();
        assert!(globals.iter().any(|g| g.get_id() == "color"));
        check(&cli, &globals);
    }
}
