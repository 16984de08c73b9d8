//! Conditions under which a camera was calibrated, and whether another moment's are the same.

use serde::{Deserialize, Serialize};

/// Degrees that a camera may be warmer or colder than at its calibration without a remark: its lens moves by a pixel or so over 20.
pub const MAX_TEMPERATURE_CHANGE: f64 = 10.0;

/// State that a camera reported while it was calibrated; empty where it does not say.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Conditions {
    /// Firmware version.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub firmware: String,
    /// Temperature of the device, mean over the views, °C.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub temperature_c: Option<f64>,
    /// Position of the lens of a camera with a focus, in the camera's own steps.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub lens_position: Option<i64>,
}

impl Conditions {
    /// Whether nothing is known.
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }

    /// Why a calibration under these conditions is not one of a camera under the conditions `now`, with the cure.
    pub fn refused(&self, now: &Self) -> Option<String> {
        let then = self.lens_position?;
        let now = now.lens_position?;
        (then != now).then(|| {
            format!(
                "is of lens position {then}, the camera is at {now}: every focus has intrinsics of its own; set focus_absolute = {then} \
                 in the camera's controls"
            )
        })
    }

    /// Differences that may make a calibration worse, with the cure.
    pub fn doubts(&self, now: &Self) -> Vec<String> {
        let mut doubts = Vec::new();
        if !self.firmware.is_empty() && !now.firmware.is_empty() && self.firmware != now.firmware {
            doubts.push(format!(
                "calibrated with firmware {}, it now has {}; check with `depthrig calibrate check`",
                self.firmware, now.firmware
            ));
        }
        if let (Some(then), Some(now)) = (self.temperature_c, now.temperature_c)
            && (then - now).abs() > MAX_TEMPERATURE_CHANGE
        {
            doubts.push(format!(
                "calibrated at {then:.0} °C, it is now at {now:.0} °C; let it warm up, or calibrate at this temperature"
            ));
        }
        if self.lens_position.is_some() && now.lens_position.is_none() {
            doubts.push(
                "calibrated at a fixed lens position, its focus is now its own; set focus_absolute in the camera's controls"
                    .to_owned(),
            );
        }
        doubts
    }
}

/// The lens position that a rig file, given as text, sets for a camera; `None` for a camera without a focus, or with one that the
/// camera moves by itself.
pub fn lens_position(rig: &str, camera: &str) -> Option<i64> {
    let rig: toml::Table = rig.parse().ok()?;
    let cameras = rig.get("camera")?.as_array()?;
    let found = cameras.iter().find(|c| c.get("name").and_then(toml::Value::as_str) == Some(camera))?;
    let tables = found.as_table()?.iter().filter(|(key, _)| key.ends_with("controls"));
    let mut positions = tables.filter_map(|(_, controls)| controls.get("focus_absolute")?.as_integer());
    positions.next()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(firmware: &str, temperature_c: f64, lens_position: Option<i64>) -> Conditions {
        Conditions { firmware: firmware.to_owned(), temperature_c: Some(temperature_c), lens_position }
    }

    #[test]
    fn another_focus_is_refused_and_the_rest_is_doubted() {
        let then = at("5.1", 30.0, Some(120));
        assert_eq!(then.refused(&then), None);
        assert!(then.doubts(&then).is_empty());
        let moved = then.refused(&at("5.1", 30.0, Some(121))).unwrap();
        assert!(moved.contains("lens position 120") && moved.contains("focus_absolute = 120"), "{moved}");
        let doubts = then.doubts(&at("5.2", 41.0, None));
        assert_eq!(doubts.len(), 3, "{doubts:?}");
        assert!(then.doubts(&at("", 39.0, Some(120))).is_empty());
        assert_eq!(Conditions::default().refused(&then), None);
    }

    #[test]
    fn the_lens_position_is_that_of_the_rig_file() {
        let rig = "[[camera]]\nname = \"a\"\n[[camera]]\nname = \"b\"\ncontrols = { focus_absolute = 30 }\n";
        assert_eq!(lens_position(rig, "b"), Some(30));
        assert_eq!(lens_position(rig, "a"), None);
        assert_eq!(lens_position("not toml [", "a"), None);
    }
}
