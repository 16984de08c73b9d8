//! How old a calibration is and what it is worth, for those who have to rely on it.

use super::{CalibratedCamera, Calibration};
use crate::mount::Source;

/// Days after which a mount is better checked: screws settle, somebody leans on it.
pub const OLD_DAYS: f64 = 60.0;
/// Uncertainty of a pose that is poor, millimetres and degrees.
const POOR_MM: f64 = 2.0;
const POOR_DEG: f64 = 0.1;
/// Difference between two halves of the views that is poor: their poses, millimetres; their projection, pixels.
const POOR_HALVES_MM: f64 = 5.0;
const POOR_HALVES_PX: f64 = 2.0;
/// Residual that is poor, pixels.
const POOR_RMS_PX: f64 = 1.0;

impl Calibration {
    /// Days from its making to a moment in UTC nanoseconds since 1970; `None` for a date that is not RFC 3339 in UTC.
    pub fn age_days(&self, now_utc_ns: i64) -> Option<f64> {
        age_days(&self.created, now_utc_ns)
    }
}

/// As [`Calibration::age_days`] for a date alone.
pub fn age_days(created: &str, now_utc_ns: i64) -> Option<f64> {
    let number = |from: usize, to: usize| created.get(from..to)?.parse::<i64>().ok();
    let year = number(0, 4)?;
    let month = number(5, 7).filter(|m| (1..=12).contains(m))?;
    let day = number(8, 10)?;
    let seconds = number(11, 13)? * 3600 + number(14, 16)? * 60 + number(17, 19)?;
    if !created.ends_with('Z') {
        return None;
    }
    // Days since 1970 of the proleptic Gregorian calendar (Hinnant, "chrono-compatible low-level date algorithms").
    let y = if month <= 2 { year - 1 } else { year };
    let era = y.div_euclid(400);
    let of_era = y.rem_euclid(400);
    let of_year = (153 * ((month + 9) % 12) + 2) / 5 + day - 1;
    let days = era * 146_097 + of_era * 365 + of_era / 4 - of_era / 100 + of_year - 719_468;
    let now_s = now_utc_ns as f64 / 1e9;
    Some((now_s - (days * 86_400 + seconds) as f64) / 86_400.0)
}

/// Why a calibration of that age is better checked, with the cure.
pub fn old(age_days: f64) -> Option<String> {
    if age_days < -1.0 {
        return Some("its date is in the future; set this computer's clock".to_owned());
    }
    (age_days > OLD_DAYS).then(|| {
        format!("it is {age_days:.0} days old; ten seconds with the board and `depthrig calibrate check` tell whether it still holds")
    })
}

impl CalibratedCamera {
    /// Its accuracy in words, on one line.
    pub fn worth(&self) -> String {
        let q = &self.quality;
        let mut parts = Vec::new();
        if self.pose.sigma_mm > 0.0 || self.pose.sigma_deg > 0.0 {
            parts.push(format!("pose ± {:.2} mm, ± {:.3} deg", self.pose.sigma_mm, self.pose.sigma_deg));
        } else {
            parts.push("the reference".to_owned());
        }
        let source = if self.source == Source::Calibrated { "calibrated" } else { "factory's" };
        parts.push(format!("{source} intrinsics, residual {:.2} px", q.rms_px));
        parts.push(format!(
            "projection ± {:.2} px, ± {:.2} at the edge",
            q.projection_middle_px, q.projection_worst_px
        ));
        let halves: Vec<String> = [
            q.halves_differ_px.map(|v| format!("{v:.2} px")),
            q.halves_differ_mm.map(|v| format!("{v:.2} mm")),
        ]
        .into_iter()
        .flatten()
        .collect();
        if !halves.is_empty() {
            parts.push(format!("its halves differ by {}", halves.join(", ")));
        }
        parts.join("; ")
    }

    /// Why it is poor, if it is, with the cure.
    pub fn poor(&self) -> Option<String> {
        let q = &self.quality;
        let above = |value: f64, limit: f64, what: &str, unit: &str| {
            (value > limit).then(|| format!("{what} is {value:.2} {unit}, {limit} is what to expect at most"))
        };
        let why = above(self.pose.sigma_mm, POOR_MM, "uncertainty of the pose", "mm")
            .or_else(|| above(self.pose.sigma_deg, POOR_DEG, "uncertainty of the direction", "degrees"))
            .or_else(|| above(q.rms_px, POOR_RMS_PX, "residual", "px"))
            .or_else(|| {
                let mm = q.halves_differ_mm.unwrap_or(0.0);
                above(mm, POOR_HALVES_MM, "difference between the halves of the views", "mm")
            })
            .or_else(|| {
                let px = q.halves_differ_px.unwrap_or(0.0);
                above(px, POOR_HALVES_PX, "difference between the halves of the views", "px")
            })?;
        Some(format!("{why}; calibrate again with more views, at the edges of the image and tilted"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ages_are_counted_in_the_calendar() {
        // 2026-11-25T03:00:00Z is 1 795 575 600 s after 1970 (date -u -d 2026-11-25T03:00:00Z +%s).
        let now = 1_795_575_600 * 1_000_000_000;
        assert_eq!(age_days("2026-11-25T03:00:00Z", now), Some(0.0));
        assert_eq!(age_days("2026-11-24T15:00:00Z", now), Some(0.5));
        assert_eq!(age_days("2024-02-29T03:00:00Z", now), Some(1000.0));
        assert_eq!(age_days("yesterday", now), None);
        assert_eq!(age_days("2026-11-25T03:00:00+01:00", now), None);
        assert!(old(3.0).is_none() && old(90.0).is_some() && old(-2.0).is_some());
    }
}
