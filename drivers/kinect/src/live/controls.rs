//! The colour camera's controls by name: checked against the camera's own range, set, and read back.

use super::handle::{ControlRange, ControlSetting, Handle};
use depthrig_driver::{Error, ErrorKind, Result};
use depthrig_usb::controls::ControlValue;
use std::collections::BTreeMap;

/// Names with `k4a_color_control_command_t`. The one between `exposure_us` and `brightness` is not supported by any
/// firmware that was sold.
pub const NAMES: [(&str, u32); 9] = [
    ("exposure_us", 0),
    ("brightness", 2),
    ("contrast", 3),
    ("saturation", 4),
    ("sharpness", 5),
    ("white_balance_k", 6),
    ("backlight_compensation", 7),
    ("gain", 8),
    ("power_line_frequency", 9),
];

/// The items of `power_line_frequency`, with their values.
const POWER_LINE: [(&str, i32); 2] = [("50 Hz", 1), ("60 Hz", 2)];

/// Sets the controls of `wanted`; `name` is the camera's, for messages. Those that are set to `"auto"` come first.
///
/// # Errors
/// [`ErrorKind::BadInput`] naming the controls there are, or the range, when a control cannot be what is asked for;
/// [`ErrorKind::Io`] when the camera refuses.
pub fn apply(name: &str, camera: &Handle, wanted: &BTreeMap<String, ControlValue>) -> Result<()> {
    let mut settings = Vec::new();
    for (key, value) in wanted {
        let command =
            command(key).map_err(|why| Error::new(ErrorKind::BadInput, format!("{name}: {why}")))?;
        let range = camera.control_range(command);
        let setting = check(key, value, range);
        let setting = setting.map_err(|why| Error::new(ErrorKind::BadInput, format!("{name}: {why}")))?;
        settings.push((key, command, setting));
    }
    settings.sort_by_key(|(.., setting)| *setting != ControlSetting::Auto);
    for (key, command, setting) in settings {
        let in_control =
            |e: Error| Error::new(e.kind(), format!("{name}: color_controls.{key}: {e}")).with_source(e);
        camera.set_control(command, setting).map_err(in_control)?;
        match camera.control(command).map_err(in_control)? {
            is if is == setting => tracing::info!(camera = name, control = key, "set to {}", describe(is)),
            // The camera has a few exposures and takes the nearest.
            is => tracing::info!(
                camera = name,
                control = key,
                "asked for {}, the camera took {}",
                describe(setting),
                describe(is)
            ),
        }
    }
    Ok(())
}

fn describe(setting: ControlSetting) -> String {
    match setting {
        ControlSetting::Auto => "auto".to_owned(),
        ControlSetting::Manual(value) => value.to_string(),
    }
}

/// The number of the control `key`.
///
/// # Errors
/// The names there are.
pub fn command(key: &str) -> core::result::Result<u32, String> {
    let found = NAMES.iter().find(|(name, _)| *name == key);
    found.map(|(_, command)| *command).ok_or_else(|| {
        let names: Vec<_> = NAMES.iter().map(|(name, _)| *name).collect();
        format!("a Kinect has no colour control \"{key}\"; it has: {}", names.join(", "))
    })
}

fn check(
    key: &str,
    value: &ControlValue,
    range: Option<ControlRange>,
) -> core::result::Result<ControlSetting, String> {
    let Some(range) = range else {
        return Err(format!("color_controls.{key}: this camera's firmware has no such control"));
    };
    let value = match value {
        ControlValue::Item(item) if item == "auto" => {
            return if range.has_auto {
                Ok(ControlSetting::Auto)
            } else {
                Err(format!("color_controls.{key} cannot be \"auto\": the camera does not regulate it"))
            };
        }
        ControlValue::Item(item) if key == "power_line_frequency" => {
            let found = POWER_LINE.iter().find(|(name, _)| name == item);
            let items = || format!("color_controls.{key} = \"{item}\": it is \"50 Hz\" or \"60 Hz\"");
            i64::from(found.ok_or_else(items)?.1)
        }
        ControlValue::Item(item) => {
            let auto = if range.has_auto { ", or \"auto\"" } else { "" };
            return Err(format!("color_controls.{key} = \"{item}\" is not a number{auto}"));
        }
        ControlValue::Boolean(on) => i64::from(*on),
        ControlValue::Integer(value) => *value,
    };
    let ControlRange { min, max, step, .. } = range;
    let outside = value < i64::from(min) || value > i64::from(max);
    let between = !outside && step > 1 && (value - i64::from(min)) % i64::from(step) != 0;
    if outside || between {
        let steps = if step > 1 { format!(", in steps of {step}") } else { String::new() };
        return Err(format!("color_controls.{key} = {value}: it goes from {min} to {max}{steps}"));
    }
    i32::try_from(value).map(ControlSetting::Manual).map_err(|e| e.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    const RANGE: ControlRange =
        ControlRange { has_auto: true, min: 2500, max: 12_500, step: 10, default: 4500 };

    #[test]
    fn values_are_held_against_the_range() {
        let white = |v| check("white_balance_k", &v, Some(RANGE));
        assert_eq!(white(ControlValue::Integer(4500)), Ok(ControlSetting::Manual(4500)));
        assert_eq!(white(ControlValue::Item("auto".into())), Ok(ControlSetting::Auto));
        for wrong in [2490, 12_510, 4505, i64::MAX, i64::MIN] {
            let why = white(ControlValue::Integer(wrong)).unwrap_err();
            assert!(why.contains("2500 to 12500, in steps of 10"), "{why}");
        }
        assert!(white(ControlValue::Item("warm".into())).unwrap_err().contains("\"auto\""));
        let fixed = ControlRange { has_auto: false, min: 0, max: 1, step: 1, default: 0 };
        let backlight = |v| check("backlight_compensation", &v, Some(fixed));
        assert_eq!(backlight(ControlValue::Boolean(true)), Ok(ControlSetting::Manual(1)));
        assert!(backlight(ControlValue::Item("auto".into())).unwrap_err().contains("does not regulate"));
        assert!(check("gain", &ControlValue::Integer(1), None).unwrap_err().contains("firmware"));
    }

    #[test]
    fn names_and_items_are_known() {
        assert_eq!(command("gain"), Ok(8));
        assert!(command("exposure").unwrap_err().contains("exposure_us"));
        let range = ControlRange { has_auto: false, min: 1, max: 2, step: 1, default: 2 };
        let line = |v: &str| check("power_line_frequency", &ControlValue::Item(v.into()), Some(range));
        assert_eq!(line("50 Hz"), Ok(ControlSetting::Manual(1)));
        assert!(line("55 Hz").unwrap_err().contains("60 Hz"));
    }
}
