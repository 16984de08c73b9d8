//! The clock of a session of several computers.

use super::finding::{Finding, Severity};
use crate::config::LinkConfig;
use crate::link::Link;
use crate::status::{LinkState, LinkStatus};
use core::time::Duration;
use depthrig_bus::HostTime;

/// Time for the other computer to answer; a second of answers gives a bound that sets need.
const WAIT: Duration = Duration::from_millis(1500);
/// Frames of two computers whose clocks are known worse than this are not of one moment, microseconds.
const LOOSE_US: f64 = 1000.0;

/// Asks the recorder's computer for its clock, or tries this one's address; `Err` says why that cannot work.
pub(super) fn ask(config: &LinkConfig) -> Result<LinkStatus, String> {
    let link = Link::start(config).map_err(|e| e.to_string())?;
    if link.status(HostTime::now()).state != LinkState::Own {
        std::thread::sleep(WAIT);
    }
    Ok(link.status(HostTime::now()))
}

/// Judges the answer.
pub(super) fn check(link: &Result<LinkStatus, String>, findings: &mut Vec<Finding>) {
    let why =
        "sets of this computer lie on no grid with those of the others, and their datasets are joined by UTC";
    let status = match link {
        Ok(status) => status,
        Err(e) => {
            let cure = "correct the address in [link]";
            findings.push(Finding::new(Severity::Error, "link_address", e, why, cure));
            return;
        }
    };
    let Some(recorder) = &status.recorder else { return };
    if status.state == LinkState::Unkeyed {
        let what = format!(
            "{recorder} answers within {:.0} us; a computer gets its clock once it has its key",
            status.round_trip_us.unwrap_or_default()
        );
        let (why, cure) = (
            "the key comes over ssh from the daemon there to the one here, while both run",
            "see there with `depthrig status` that it reaches this computer",
        );
        findings.push(Finding::new(Severity::Info, "link_answers", what, why, cure));
        return;
    }
    let Some(within_us) = status.uncertainty_us else {
        let what = format!("the clock of {recorder} does not answer");
        let cure = format!(
            "run depthrig there with listen = \"{recorder}\" in [link], let its firewall pass UDP to that port, and try \
             `ping` to its address"
        );
        findings.push(Finding::new(Severity::Error, "link_silent", what, why, cure));
        return;
    };
    let what = format!(
        "the clock of {recorder} is {:+.6} s from this one, within {within_us:.0} us, round trip {:.0} us",
        status.offset_s.unwrap_or_default(),
        status.round_trip_us.unwrap_or_default()
    );
    let (severity, id, why, cure) = if within_us > LOOSE_US {
        (
            Severity::Warning,
            "link_loose",
            "times of both computers are compared within that, and frames of one moment may be taken for those of two",
            "connect both by cable, without Wi-Fi, and keep other traffic off it until the clocks are known",
        )
    } else {
        (Severity::Info, "link_clock", "sets of both computers lie on one grid", "nothing to do")
    };
    findings.push(Finding::new(severity, id, what, why, cure));
}
