//! Conformance suite: the behaviour that every backend must have, as tests that run against any of them.
//!
//! Implement [`Subject`] for the backend: how to make a device of it, how to make that device fail in each of
//! the ways that it can, and the device's own record of the frames it sent. Then, in a test of the backend:
//!
//! ```no_run
//! use depthrig_sim::conformance::{self, Subject};
//! # fn subject() -> Box<dyn Subject> { unimplemented!() }
//! let report = conformance::run(subject().as_ref());
//! // Every case is listed: passed, failed and why, or not applicable and why.
//! println!("{report}");
//! assert!(report.is_good(), "{report}");
//! // Cases must not become inapplicable unnoticed.
//! assert_eq!(report.not_applicable(), ["clock"]);
//! ```
//!
//! A case never assumes how fast the machine is; its waits are generous bounds on liveness.

use core::fmt;
use core::time::Duration;
use depthrig_bus::{DropCounts, HostTime};
use depthrig_driver::{Backend, StreamRequest};

mod cases;
mod probe;

/// A backend under test.
pub trait Subject {
    /// Its name in reports.
    fn name(&self) -> String;

    /// A fresh backend with exactly one device, which has not failed yet and will deliver at least some
    /// seconds of frames, with the means to make that device fail.
    fn make(&self) -> Bench;
}

/// One device of the subject on the bench.
pub struct Bench {
    /// The backend.
    pub backend: Box<dyn Backend>,
    /// Serial number of the device.
    pub serial: String,
    /// Streams to start; empty for the default modes. An IMU that is not among them is started for the case `motion`.
    pub requests: Vec<StreamRequest>,
    /// Fault injection and ground truth for the device.
    pub rig: Box<dyn Rig>,
}

/// Fault injection and ground truth for a device under test.
///
/// A subject answers `None` or [`Cannot`] where it has no means; the case is then reported as not applicable.
pub trait Rig {
    /// Makes `trouble` happen now.
    ///
    /// # Errors
    /// [`Cannot`] with the reason when this device cannot fail in this way.
    fn cause(&self, trouble: Trouble) -> Result<(), Cannot>;

    /// The device's own record of what it did with the frames of a stream since it was last started.
    fn sent(&self, stream: usize) -> Option<Sent>;

    /// True mid-exposure of the frame of a stream that arrived at `arrival`, and by how much the clock map may
    /// be off in its first seconds, nanoseconds.
    fn true_capture(&self, stream: usize, arrival: HostTime) -> Option<(HostTime, u64)>;

    /// Whether `pixels` are exactly a frame that the device sent.
    fn is_genuine(&self, stream: usize, pixels: &[u8]) -> Option<bool>;
}

/// This device cannot fail in this way, and why.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Cannot(pub &'static str);

/// A way to fail.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Trouble {
    /// Pulled out, and plugged in again after this long.
    Unplug(Duration),
    /// Sends nothing for this long.
    Stall(Duration),
    /// Does not let the driver return from a call for this long.
    Hang(Duration),
    /// Sends so many frames of every stream with half of their bytes.
    HalfFrame(u32),
    /// Sends so many frames of every stream with too many bytes.
    WrongSize(u32),
    /// Sends so many frames of every stream flagged or evident as damaged.
    Damaged(u32),
    /// Sends so many frames of every stream twice.
    Repeated(u32),
    /// Loses so many frames of every stream.
    Skip(u32),
    /// Sets its clock back by this much.
    TimeBackwards(Duration),
    /// Restarts its clock and its frame counter.
    ClockReset,
    /// Is held by somebody else for this long.
    Busy(Duration),
}

/// A device's record of the frames of one stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Sent {
    /// Frames that the host could know of.
    pub captured: u64,
    /// Frames that came whole and once.
    pub good: u64,
    /// Frames that did not, by the reason that the driver must find.
    pub drops: DropCounts,
}

/// How one case ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Verdict {
    /// As it must.
    Passed,
    /// Not as it must, and how.
    Failed(String),
    /// The subject cannot do what the case needs, and why.
    NotApplicable(String),
}

/// The verdicts on a backend.
#[derive(Debug)]
pub struct Report {
    /// The backend.
    pub subject: String,
    /// Every case with its verdict, in the order of the suite.
    pub verdicts: Vec<(&'static str, Verdict)>,
}

impl Report {
    /// Whether no case failed.
    pub fn is_good(&self) -> bool {
        !self.verdicts.iter().any(|(_, v)| matches!(v, Verdict::Failed(_)))
    }

    /// The cases that the subject cannot do.
    pub fn not_applicable(&self) -> Vec<&'static str> {
        let cannot = self.verdicts.iter().filter(|(_, v)| matches!(v, Verdict::NotApplicable(_)));
        cannot.map(|(name, _)| *name).collect()
    }

    /// The cases that failed.
    pub fn failed(&self) -> Vec<&'static str> {
        let failed = self.verdicts.iter().filter(|(_, v)| matches!(v, Verdict::Failed(_)));
        failed.map(|(name, _)| *name).collect()
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "conformance of {}:", self.subject)?;
        for (case, verdict) in &self.verdicts {
            match verdict {
                Verdict::Passed => writeln!(f, "  passed          {case}")?,
                Verdict::Failed(why) => writeln!(f, "  FAILED          {case}: {why}")?,
                Verdict::NotApplicable(why) => writeln!(f, "  not applicable  {case}: {why}")?,
            }
        }
        Ok(())
    }
}

/// The names of all cases, in order.
pub fn cases() -> Vec<&'static str> {
    cases::ALL.iter().map(|(name, _)| *name).collect()
}

/// Runs every case, each on a fresh device.
pub fn run(subject: &dyn Subject) -> Report {
    run_some(subject, &cases())
}

/// Runs the named cases only, for looking into one of them.
pub fn run_some(subject: &dyn Subject, names: &[&str]) -> Report {
    let chosen = cases::ALL.iter().filter(|(name, _)| names.contains(name));
    let verdicts = chosen.map(|(name, case)| (*name, judge(*case, subject))).collect();
    Report { subject: subject.name(), verdicts }
}

fn judge(case: cases::Case, subject: &dyn Subject) -> Verdict {
    match case(&subject.make()) {
        Ok(()) => Verdict::Passed,
        Err(cases::Stop::Failed(why)) => Verdict::Failed(why),
        Err(cases::Stop::NotApplicable(why)) => Verdict::NotApplicable(why),
    }
}
