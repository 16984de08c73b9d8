//! Checks of a scenario and where they are reported: a file that the host follows, or the terminal.

use anyhow::Context;
use serde_json::{Value, json};
use std::fmt::{Debug, Display};
use std::fs::File;
use std::io::Write;
use std::path::Path;

/// Names the report to the process of a scenario.
pub const REPORT_VARIABLE: &str = "DEPTHRIG_VM_REPORT";

/// One JSON object for each line, with the scenario and the `kind`: start, check, note or end.
pub struct Report {
    scenario: &'static str,
    file: Option<File>,
}

impl Report {
    /// The report of `scenario` at `path`, which others append to as well.
    ///
    /// # Errors
    /// When the file cannot be opened.
    pub fn at(path: &Path, scenario: &'static str) -> anyhow::Result<Self> {
        let file = File::options().create(true).append(true).open(path);
        Ok(Self { scenario, file: Some(file.with_context(|| path.display().to_string())?) })
    }

    /// The report that [`REPORT_VARIABLE`] names; without it, the terminal.
    ///
    /// # Errors
    /// When the file cannot be opened.
    pub fn of_environment(scenario: &'static str) -> anyhow::Result<Self> {
        match std::env::var_os(REPORT_VARIABLE) {
            Some(path) => Self::at(Path::new(&path), scenario),
            None => Ok(Self { scenario, file: None }),
        }
    }

    /// Adds `entry`.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn add(&mut self, kind: &str, mut entry: Value) -> anyhow::Result<()> {
        entry["kind"] = kind.into();
        entry["scenario"] = self.scenario.into();
        // In one write, so that lines of different processes stay whole.
        if let Some(file) = &mut self.file {
            file.write_all(format!("{entry}\n").as_bytes())?;
        }
        Ok(())
    }
}

/// Checks of a scenario, one line each.
pub struct Checks {
    report: Report,
    total: usize,
    failed: usize,
}

impl Checks {
    /// Checks that go to `report`.
    pub fn new(report: Report) -> Self {
        Self { report, total: 0, failed: 0 }
    }

    /// `what` should hold; `detail` is the observation. Returns whether it does.
    pub fn that(&mut self, what: &str, holds: bool, detail: impl Display) -> bool {
        self.total += 1;
        self.failed += usize::from(!holds);
        let detail = detail.to_string();
        println!("{} {what}: {detail}", if holds { "ok  " } else { "FAIL" });
        let entry = json!({ "check": what, "holds": holds, "detail": detail });
        if let Err(error) = self.report.add("check", entry) {
            // Without a report the host finds the scenario without a result, which is what it should find.
            eprintln!("the report cannot be written: {error:#}");
            std::process::exit(3);
        }
        holds
    }

    /// `got` should equal `wanted`.
    #[allow(clippy::needless_pass_by_value)] // a check reads `equal("...", frames.len(), 10)`
    pub fn equal<T: PartialEq<W> + Debug, W: Debug>(&mut self, what: &str, got: T, wanted: W) -> bool {
        let holds = got == wanted;
        let detail = if holds { format!("{got:?}") } else { format!("{got:?}, and not {wanted:?}") };
        self.that(what, holds, detail)
    }

    /// `outcome` should be a success; its value, then.
    pub fn done<T, E: Display>(&mut self, what: &str, outcome: Result<T, E>) -> Option<T> {
        match outcome {
            Ok(value) => {
                self.that(what, true, "");
                Some(value)
            }
            Err(error) => {
                self.that(what, false, format!("{error:#}"));
                None
            }
        }
    }

    /// A line for the log; checks nothing.
    pub fn note(&mut self, text: impl Display) {
        let text = text.to_string();
        println!("     {text}");
        let _ = self.report.add("note", json!({ "text": text }));
    }

    /// Whether there was a check and none has failed.
    pub fn all_hold(&self) -> bool {
        self.total > 0 && self.failed == 0
    }
}
