//! The calibration of the mount: whether there is one, how old it is, and what it is worth.

use super::finding::{Finding, Severity};
use crate::config::RigConfig;
use depthrig_calibrate::file::{age_days, old};

/// Why poses matter.
const WHY: &str = "whatever joins two cameras, a fused cloud or a policy with several views, is wrong by as much as the poses";

/// Notes what is to be said of the rig's calibration at the moment `now_utc_ns`.
pub(super) fn check(config: &RigConfig, now_utc_ns: i64, findings: &mut Vec<Finding>) {
    let Some(path) = &config.calibration else {
        if config.cameras.len() > 1 {
            findings.push(Finding::new(
                Severity::Info,
                "mount_not_calibrated",
                "the mount is not calibrated: the cameras' poses are those of the rig file",
                WHY,
                "docs/calibration.md: `depthrig calibrate board`, `depthrig calibrate solve`, and calibration = \"calibration.toml\" at \
                 the top of the rig file",
            ));
        }
        return;
    };
    let mut read = config.clone();
    if let Err(e) = read.read_calibration() {
        findings.push(Finding::new(
            Severity::Error,
            "calibration_unreadable",
            e.to_string(),
            "the rig does not start with a calibration that it cannot read",
            "correct the file, or take calibration out of the rig file",
        ));
        return;
    }
    for camera in &read.cameras {
        let name = camera.name.as_str();
        let Some(calibration) = camera.calibration.first() else {
            findings.push(
                Finding::new(
                    Severity::Warning,
                    "mount_not_calibrated",
                    format!(
                        "{} has no entry of this camera: its pose is that of the rig file",
                        path.display()
                    ),
                    WHY,
                    "calibrate again with this camera among the others",
                )
                .of(name),
            );
            continue;
        };
        let entry = &calibration.camera;
        let age = age_days(&calibration.created, now_utc_ns);
        let since = age.map_or_else(|| format!("calibrated {}", calibration.created), days);
        let doubt = |id, why: String| {
            let (what, cure) =
                why.split_once("; ").map_or((why.as_str(), "calibrate again"), |(a, b)| (a, b));
            Finding::new(Severity::Warning, id, what, WHY, cure).of(name)
        };
        findings.extend(entry.poor().map(|why| doubt("calibration_poor", why)));
        findings.extend(age.and_then(old).map(|why| doubt("calibration_old", why)));
        findings.push(
            Finding::new(
                Severity::Info,
                "calibration",
                format!("{since}: {}", entry.worth()),
                "docs/calibration.md explains each of these numbers",
                "nothing to do; `depthrig calibrate check` tells whether a camera has moved since",
            )
            .of(name),
        );
    }
}

/// An age in words.
fn days(age_days: f64) -> String {
    match age_days {
        d if d < 1.0 => "calibrated today".to_owned(),
        d if d < 2.0 => "calibrated yesterday".to_owned(),
        d => format!("calibrated {d:.0} days ago"),
    }
}
