//! The commands and options, and what `--help` says of them.

use crate::args::Global;
use crate::commands::{
    bench, cameras, cat, cdm, compare, completions, config, demo, doctor, edit, eval, export, import, info,
    install, man, merge, record, recover, replay, report, run, sessions, status, stereo, tap, top, trim,
    verify, zed,
};
use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};

/// Captures, stamps, groups, shares, records and replays the cameras of a multi-camera RGB-D mount.
#[derive(Debug, Parser)]
#[command(name = "depthrig", version, max_term_width = 100, after_help = EXIT_CODES)]
pub struct Cli {
    /// Options of every command.
    #[command(flatten)]
    pub global: Global,
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

const EXIT_CODES: &str = "\
Exit codes:
  0  good
  1  failed
  2  wrong usage or configuration
  3  finished, but something was lost (the output says what)

Examples:
  depthrig demo                          see everything once, without a camera
  depthrig config show > rig.toml        a commented configuration that runs as it is
  depthrig run rig.toml                  the daemon, in the foreground
  depthrig top                           watch it from another terminal
  depthrig record start --scene kitchen  record until `depthrig record stop`";

/// The commands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Run the seven-camera mount with synthetic cameras once through: capture, record, verify, replay, report
    #[command(after_help = demo::EXAMPLES)]
    Demo(demo::DemoArgs),
    /// List the cameras that are attached: model, serial number, port, speed, who has it, what is wrong
    #[command(after_help = cameras::EXAMPLES)]
    Cameras(cameras::CamerasArgs),
    /// Examine a session before it begins: cameras, modes, USB, permissions, memory, disk; each finding with its cure
    #[command(after_help = doctor::EXAMPLES)]
    Doctor(doctor::DoctorArgs),
    /// Run the daemon in the foreground; Ctrl-C ends it cleanly, twice ends it at once
    #[command(after_help = run::EXAMPLES)]
    Run(run::RunArgs),
    /// Start, stop and annotate recordings of the running daemon
    #[command(subcommand, after_help = record::EXAMPLES)]
    Record(record::RecordCommand),
    /// Show cameras, rates, losses, clocks, sets, recording and disk of the running daemon
    #[command(after_help = status::EXAMPLES)]
    Status(status::StatusArgs),
    /// Watch the running daemon, refreshed in place; q or Ctrl-C leaves
    Top(top::TopArgs),
    /// Publish datasets on the same channels as if the cameras were there, and steer that
    #[command(after_help = replay::EXAMPLES)]
    Replay(replay::ReplayArgs),
    /// Say what is in a dataset
    Info(info::InfoArgs),
    /// Write the quality report of a dataset: verdict, rates, losses, spreads, clocks, fill rate, pictures
    #[command(after_help = report::EXAMPLES)]
    Report(report::ReportArgs),
    /// List the datasets of a folder: scene, start, length, sets, size, health
    #[command(after_help = sessions::EXAMPLES)]
    Sessions(sessions::SessionsArgs),
    /// Change scene, operator, notes or name of a dataset; what it said before stays in its history
    #[command(after_help = edit::EXAMPLES)]
    Edit(edit::EditArgs),
    /// Tell how good depth is against a reference: a table as in papers, and a page
    #[command(after_help = eval::EXAMPLES)]
    Eval(eval::EvalArgs),
    /// Write datasets in the layouts of others: ByteCameraDepth, LeRobot
    #[command(subcommand, after_help = export::EXAMPLES)]
    Export(export::ExportCommand),
    /// Make a dataset of what others recorded
    #[command(subcommand, after_help = import::EXAMPLES)]
    Import(import::ImportCommand),
    /// Check that a dataset is whole
    #[command(after_help = verify::EXAMPLES)]
    Verify(verify::VerifyArgs),
    /// List single frames of a dataset, or write them as PNG, NPY or JPEG files
    #[command(after_help = cat::EXAMPLES)]
    Cat(cat::CatArgs),
    /// Install camera depth models, and refine depth with them
    #[command(subcommand, after_help = cdm::EXAMPLES)]
    Cdm(cdm::CdmCommand),
    /// Make depth of recorded raw stereo
    #[command(subcommand, after_help = zed::EXAMPLES)]
    Zed(zed::ZedCommand),
    /// Find the disparity of a rectified pair of pictures
    #[command(after_help = stereo::EXAMPLES)]
    Stereo(stereo::StereoArgs),
    /// Write a part of a dataset as a dataset of its own
    #[command(after_help = trim::EXAMPLES)]
    Trim(trim::TrimArgs),
    /// Join parts of one recording again
    #[command(after_help = merge::EXAMPLES)]
    Merge(merge::MergeArgs),
    /// Make a dataset whole again after a crash, a full disk or a damaged sector
    #[command(after_help = recover::EXAMPLES)]
    Recover(recover::RecoverArgs),
    /// Say whether two datasets hold the same, and where they differ
    #[command(after_help = compare::EXAMPLES)]
    Compare(compare::CompareArgs),
    /// Check a rig configuration, or print the commented default
    #[command(subcommand, after_help = config::EXAMPLES)]
    Config(config::ConfigCommand),
    /// Show, write or remove the udev rules and the service that a computer with cameras needs
    #[command(after_help = install::EXAMPLES)]
    Install(install::InstallArgs),
    /// Look at one live stream: a line per frame, or pictures
    #[command(after_help = tap::EXAMPLES)]
    Tap(tap::TapArgs),
    /// Measure what depthrig promises about speed
    #[command(subcommand, after_help = bench::EXAMPLES)]
    Bench(bench::BenchCommand),
    /// Print completions for a shell
    #[command(after_help = completions::EXAMPLES)]
    Completions(completions::CompletionsArgs),
    /// Print the manual page, or write one page per command
    Man(man::ManArgs),
    /// The subscribing process of `bench bus`
    #[command(hide = true)]
    BenchReader(crate::bench::bus::reader::ReaderArgs),
}

impl Command {
    /// By how much its log is louder than others': what runs until somebody ends it shows itself by its log, and what
    /// tells all that is wrong in its output does not tell it twice.
    pub const fn loudness(&self) -> i32 {
        match self {
            Self::Run(_) => 1,
            Self::Cameras(_) | Self::Doctor(_) => -1,
            _ => 0,
        }
    }
}

/// The command line of this process. Ends it with 2 and a hint when the usage is wrong.
pub fn parse() -> Cli {
    let matches = with_negative_numbers(Cli::command()).get_matches();
    Cli::from_arg_matches(&matches).unwrap_or_else(|e| e.exit())
}

/// Lets each option take a negative number as its value, to be refused for what it is and not as an unknown option.
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

    /// Every option and argument of every command that is a number with a fraction.
    #[test]
    fn no_number_of_any_command_is_negative_infinite_or_not_a_number() {
        /// The words before the value of each such argument of `command`, whose own words are `path`.
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
                // Of an option the value may begin with a minus in any form behind `=`.
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
