//! The ways to the other computers that record with this one.

use super::finding::{Finding, Severity};
use crate::config::{LinkConfig, Reach};
use depthrig_bus::Name;
use depthrig_link::rates::{self, Rates};

/// Half of a mount of seven cameras at 5 Hz records about so much, bytes a second; a slower way delivers it after the session.
const PART_BYTES_S: f64 = 8e6;

/// The way to another computer.
#[derive(Debug, Clone)]
pub struct Way {
    /// The computer.
    pub host: Name,
    /// As `ssh` names it.
    pub destination: String,
    /// Its rates, or the reason that nothing came through.
    pub rates: Result<Rates, String>,
}

/// Moves 5 MB each way between this computer and each of the others.
pub(super) fn measure(config: &LinkConfig) -> Vec<Way> {
    let way = |host: &crate::config::HostConfig| match &host.reach {
        Reach::Ssh { destination, .. } => Some(Way {
            host: host.name.clone(),
            destination: destination.clone(),
            rates: rates::measure(destination),
        }),
        Reach::Socket(_) => None,
    };
    config.hosts.iter().filter_map(way).collect()
}

/// Judges them.
pub(super) fn check(ways: &[Way], findings: &mut Vec<Finding>) {
    findings.extend(ways.iter().map(|way| {
        let Way { host, destination, rates } = way;
        let rates = match rates {
            Ok(rates) => rates,
            Err(e) => {
                let why = "it does not record when this computer does";
                let cure = format!("`ssh {destination} true` must work without a password: ssh-copy-id {destination}");
                let what = format!("host {host} is not reached: {e}");
                return Finding::new(Severity::Error, "host_unreachable", what, why, cure);
            }
        };
        let what = format!(
            "host {host}: {:.0} MB/s from there, {:.0} MB/s to there",
            rates.from_there / 1e6,
            rates.to_there / 1e6
        );
        if rates.from_there < PART_BYTES_S {
            let why = "half of a mount at 5 Hz records about 8 MB/s: the rest of its part is pulled after the session";
            let cure = "connect both by cable, without Wi-Fi";
            return Finding::new(Severity::Warning, "host_slow", what, why, cure);
        }
        let why = "half of a mount at 5 Hz records about 8 MB/s: its part is pulled while it is recorded";
        Finding::new(Severity::Info, "host_reached", what, why, "nothing to do")
    }));
}
