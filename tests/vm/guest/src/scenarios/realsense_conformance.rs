//! The conformance suite on emulated cameras: a D435 behind the kernel's own driver and through libusb, and a camera that is
//! nothing but a USB video camera by the backend `v4l2`.

use crate::checks::Checks;
use crate::subject::{Emulated, Way};
use crate::{Scenario, system};
use depthrig_realsense::config::TransportChoice;
use depthrig_sim::conformance::{self, Verdict};

/// See the module.
pub const SCENARIO: Scenario = Scenario {
    name: "realsense-conformance",
    about: "the conformance suite on a D435 through uvcvideo",
    cost: 10,
    limit_s: 300,
    needs: "",
    run,
};

/// The same through libusb.
pub const LIBUSB: Scenario = Scenario {
    name: "libusb-conformance",
    about: "the conformance suite on a D435 through libusb",
    cost: 18,
    limit_s: 300,
    needs: "",
    run: through_libusb,
};

/// The same by the backend for any camera.
pub const V4L2: Scenario = Scenario {
    name: "v4l2-conformance",
    about: "the conformance suite on a plain USB camera by the backend v4l2: YUYV and Z16",
    cost: 6,
    limit_s: 300,
    needs: "",
    run: by_v4l2,
};

/// Cases that each transport cannot show; all others must pass.
const NOT_APPLICABLE: [&str; 6] = ["half_frame", "wrong_size", "damaged", "repeated", "hang", "motion"];
const NOT_THROUGH_LIBUSB: [&str; 2] = ["hang", "motion"];

fn run(checks: &mut Checks) -> anyhow::Result<()> {
    over(checks, Emulated { model: "d435", way: Way::Realsense(TransportChoice::Kernel) }, &NOT_APPLICABLE)
}

fn through_libusb(checks: &mut Checks) -> anyhow::Result<()> {
    over(
        checks,
        Emulated { model: "d435", way: Way::Realsense(TransportChoice::Libusb) },
        &NOT_THROUGH_LIBUSB,
    )
}

fn by_v4l2(checks: &mut Checks) -> anyhow::Result<()> {
    over(checks, Emulated { model: "uvc", way: Way::V4l2 }, &NOT_APPLICABLE)
}

#[allow(clippy::needless_pass_by_value)] // made for the call
fn over(checks: &mut Checks, subject: Emulated, cannot: &[&str]) -> anyhow::Result<()> {
    system::modprobe("vhci-hcd", &[])?;
    system::modprobe("uvcvideo", &[])?;
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
    checks.equal("what this way cannot show", not_applicable, cannot);
    Ok(())
}
