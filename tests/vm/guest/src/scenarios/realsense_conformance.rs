//! The conformance suite on an emulated D435, behind the kernel's own driver and through libusb.

use crate::checks::Checks;
use crate::subject::EmulatedD400;
use crate::{Scenario, system};
use depthrig_drivers::conformance::{self, Verdict};
use depthrig_drivers::realsense::config::TransportChoice;

/// See the module.
pub const SCENARIO: Scenario = Scenario {
    name: "realsense-conformance",
    about: "the conformance suite on a D435 through uvcvideo",
    cost: 40,
    limit_s: 300,
    run,
};

/// The same through libusb.
pub const LIBUSB: Scenario = Scenario {
    name: "libusb-conformance",
    about: "the conformance suite on a D435 through libusb",
    cost: 40,
    limit_s: 300,
    run: through_libusb,
};

/// What each transport cannot show, and no more.
const NOT_APPLICABLE: [&str; 5] = ["half_frame", "wrong_size", "damaged", "repeated", "hang"];
const NOT_THROUGH_LIBUSB: [&str; 1] = ["hang"];

fn run(checks: &mut Checks) -> anyhow::Result<()> {
    over(checks, TransportChoice::Kernel, &NOT_APPLICABLE)
}

fn through_libusb(checks: &mut Checks) -> anyhow::Result<()> {
    over(checks, TransportChoice::Libusb, &NOT_THROUGH_LIBUSB)
}

fn over(checks: &mut Checks, transport: TransportChoice, cannot: &[&str]) -> anyhow::Result<()> {
    system::modprobe("vhci-hcd", &[])?;
    system::modprobe("uvcvideo", &[])?;
    let subject = EmulatedD400 { model: "d435", transport };
    let mut not_applicable = Vec::new();
    // One by one, so that each is reported when it is done.
    for case in conformance::cases() {
        let report = conformance::run_some(&subject, &[case]);
        for (name, verdict) in &report.verdicts {
            match verdict {
                Verdict::Passed => drop(checks.that(name, true, "")),
                Verdict::Failed(why) => drop(checks.that(name, false, why)),
                Verdict::NotApplicable(why) => {
                    checks.note(format!("{name} is not applicable: {why}"));
                    not_applicable.push(*name);
                }
            }
        }
    }
    checks.equal("what this transport cannot show", not_applicable, cannot);
    Ok(())
}
