//! Controls of a camera by name, as rig files give them: numbers, on or off, or the name of a menu's item.

use super::read::{FromToml, Section, describe};
use depthrig_usb::controls::ControlValue;
use std::collections::BTreeMap;
use toml::de::DeValue;

/// The table `key`, whose keys are names that only the camera knows.
pub(crate) fn read(
    s: &Section<'_, '_>,
    key: &'static str,
    kind: &'static str,
) -> BTreeMap<String, ControlValue> {
    s.entries::<ControlValue>(key, kind).into_iter().map(|(name, found)| (name, found.value)).collect()
}

impl FromToml for ControlValue {
    fn from_toml(value: &DeValue<'_>) -> Result<Self, String> {
        let read = match value {
            DeValue::String(s) => Some(Self::Item(s.to_string())),
            DeValue::Boolean(b) => Some(Self::Boolean(*b)),
            DeValue::Integer(i) => i64::from_str_radix(i.as_str(), i.radix()).ok().map(Self::Integer),
            _ => None,
        };
        read.ok_or_else(|| {
            let is = describe(value);
            format!("must be a whole number, true, false or the name of an item; it is {is}")
        })
    }
}

/// A text that is given says something.
pub(crate) fn not_blank(text: Option<&str>) -> Result<(), String> {
    match text {
        Some(t) if t.trim().is_empty() => Err("is empty".to_owned()),
        _ => Ok(()),
    }
}
