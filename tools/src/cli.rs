//! The commands and options, and what `--help` says of them.

use crate::commands::{
    bench, cameras, cat, cdm, compare, completions, config, demo, doctor, edit, eval, export, import, info,
    install, man, merge, record, recover, replay, report, run, sessions, status, stereo, tap, top, trim,
    verify, zed,
};
use clap::{ArgAction, CommandFactory, FromArgMatches, Parser, Subcommand, ValueEnum};
use depthrig_bus::RigName;
use std::ops::RangeInclusive;
use std::path::PathBuf;

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

/// Options of every command.
#[derive(Debug, Clone, clap::Args)]
pub struct Global {
    /// The rig that is meant; without it the only one that is running
    #[arg(long, global = true, value_name = "NAME", help_heading = "Global options")]
    pub rig: Option<RigName>,
    /// Folder of the locks, sockets and names of your rigs [env: DEPTHRIG_RUNTIME_DIR]
    #[arg(long, global = true, value_name = "DIR", help_heading = "Global options")]
    pub runtime_dir: Option<PathBuf>,
    /// Log more (twice: everything)
    #[arg(short, long, global = true, action = ArgAction::Count, help_heading = "Global options")]
    pub verbose: u8,
    /// Log less, and show no progress
    #[arg(short, long, global = true, action = ArgAction::Count, help_heading = "Global options")]
    pub quiet: u8,
    /// Form of the log lines on stderr
    #[arg(long, global = true, value_enum, default_value = "text", help_heading = "Global options")]
    pub log_format: LogFormat,
    /// When to use colour; NO_COLOR is honoured
    #[arg(
        long,
        global = true,
        value_enum,
        default_value = "auto",
        value_name = "WHEN",
        help_heading = "Global options"
    )]
    pub color: ColorChoice,
}

/// Form of the log lines.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum LogFormat {
    /// For people.
    Text,
    /// One JSON object a line.
    Json,
}

/// When to use colour.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum ColorChoice {
    /// On a terminal.
    Auto,
    /// In any case.
    Always,
    /// In no case.
    Never,
}

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

/// A number within `range`, in `unit`; infinity and what is not a number are out of every range.
///
/// # Errors
/// When `text` is not a number, or out of `range`.
fn number_within(text: &str, unit: &str, range: RangeInclusive<f64>) -> Result<f64, String> {
    let number: f64 = text.trim().parse().map_err(|_| format!("write a number of {unit}"))?;
    if range.contains(&number) {
        return Ok(number);
    }
    Err(format!("{text} {unit} is out of range {}..={}", range.start(), range.end()))
}

/// How far apart frames of a set may be captured, milliseconds.
///
/// # Errors
/// When `text` is out of range 0..=3600000.
pub fn spread_ms(text: &str) -> Result<f64, String> {
    number_within(text, "ms", 0.0..=3.6e6)
}

/// A distance, metres.
///
/// # Errors
/// When `text` is out of range 0..=1000000.
pub fn distance_m(text: &str) -> Result<f64, String> {
    number_within(text, "m", 0.0..=1e6)
}

/// A distance that is not 0, metres.
///
/// # Errors
/// When `text` is out of range 0.001..=1000000.
pub fn range_limit_m(text: &str) -> Result<f64, String> {
    number_within(text, "m", 1e-3..=1e6)
}

/// A rate of frames, sets or pairs.
///
/// # Errors
/// When `text` is out of range 0.001..=10000.
pub fn rate_hz(text: &str) -> Result<f64, String> {
    number_within(text, "Hz", 1e-3..=1e4)
}

/// Memory, GB.
///
/// # Errors
/// When `text` is out of range 0..=1000000.
pub fn memory_gb(text: &str) -> Result<f64, String> {
    number_within(text, "GB", 0.0..=1e6)
}

/// Speed of a replay against the original.
///
/// # Errors
/// When `text` is out of range 0.1..=10.
pub fn replay_rate(text: &str) -> Result<f64, String> {
    number_within(text, "times", depthrig_daemon::replay::RATES)
}

/// A number of seconds, such as after the first set.
///
/// # Errors
/// When `text` is out of range 0..=9000000.
pub fn seconds(text: &str) -> Result<f64, String> {
    number_within(text, "s", 0.0..=9e6)
}

/// How far the engine `fill` fills holes, as a part of the image's width.
///
/// # Errors
/// When it is out of range 0..=1.
pub fn fill_reach(text: &str) -> Result<f64, String> {
    number_within(text, "image widths", 0.0..=1.0)
}

/// Metres per unit of depth, as cameras and files have it.
///
/// # Errors
/// When `text` is none, or out of a micrometre to a metre.
pub fn depth_unit_m(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(unit) if (1e-6..=1.0).contains(&unit) => Ok(unit),
        Ok(_) => Err(format!("{text} m is out of range 0.000001..=1; write metres, such as 0.001")),
        Err(_) => Err("write metres, such as 0.001".to_owned()),
    }
}

/// A number of seconds above 0 and below ten years.
///
/// # Errors
/// When `text` is none.
pub fn positive_seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(s) if s > 0.0 && s < 3.2e8 => Ok(s),
        _ => Err("write a number of seconds above 0, such as 10 or 0.5".to_owned()),
    }
}

/// A time as people write it, in seconds: hours, minutes and seconds, each once at most and in this order, such as
/// `90s`, `10m`, `1h30m` or `1.5h`.
///
/// # Errors
/// When `text` is none, is 0 or is ten years.
pub fn duration_s(text: &str) -> Result<f64, String> {
    let wrong = || format!("write a time such as 90s, 10m or 1h30m, not \"{text}\"");
    let (mut rest, mut total_s) = (text, 0.0);
    for (unit, seconds) in [('h', 3600.0), ('m', 60.0), ('s', 1.0)] {
        let Some((number, after)) = rest.split_once(unit) else { continue };
        // No sign, exponent or word for infinity, which a float may have.
        if !number.bytes().all(|b| b.is_ascii_digit() || b == b'.') {
            return Err(wrong());
        }
        total_s += number.parse::<f64>().map_err(|_| wrong())? * seconds;
        rest = after;
    }
    if rest.is_empty() && total_s > 0.0 && total_s < 3.2e8 { Ok(total_s) } else { Err(wrong()) }
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

    #[test]
    fn a_time_has_units_in_their_order() {
        for (text, s) in [
            ("90s", 90.0),
            ("10m", 600.0),
            ("1h30m", 5400.0),
            ("1h0m5s", 3605.0),
            ("1.5h", 5400.0),
            ("0.5s", 0.5),
        ] {
            assert_eq!(duration_s(text), Ok(s), "{text}");
        }
        for bad in [
            "", "10", "m", "0s", "-5m", "1e3s", "infs", "nans", "30m1h", "1m1m", "5 m", "10m5", "9999999h",
            "1ms",
        ] {
            assert!(duration_s(bad).unwrap_err().contains("1h30m"), "{bad}");
        }
    }

    #[test]
    fn seconds_are_positive() {
        assert_eq!(positive_seconds("0.5"), Ok(0.5));
        for bad in ["0", "-1", "nan", "inf", "1e300", "ten"] {
            assert!(positive_seconds(bad).is_err(), "{bad}");
        }
    }
}
