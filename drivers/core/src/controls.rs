//! A camera's controls by name, and what may be written into them.

use crate::{Error, ErrorKind, Result};
use core::fmt;
use core::str::FromStr;
use serde::{Deserialize, Serialize};

/// Kind of a control's value (`enum v4l2_ctrl_type`).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ControlKind {
    /// A number.
    Integer,
    /// A number of 64 bits.
    Integer64,
    /// On or off.
    Boolean,
    /// One of the items.
    Menu,
    /// One of the items, which are numbers.
    IntegerMenu,
    /// Any combination of bits.
    Bitmask,
    /// Does something when it is written.
    Button,
    /// A text or a structure: shown, never written.
    Other,
}

/// A control of a camera.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Control {
    /// The kernel's number.
    pub id: u32,
    /// The name in rig files: that of the kernel in lower case, with `_` between words (as `v4l2-ctl` has it).
    pub name: String,
    /// Kind of its value.
    pub kind: ControlKind,
    /// The least value.
    pub minimum: i64,
    /// The greatest value.
    pub maximum: i64,
    /// The distance between values.
    pub step: u64,
    /// The value after power-on.
    pub default: i64,
    /// It can be read only.
    pub read_only: bool,
    /// It can be written only.
    pub write_only: bool,
    /// It has no effect now, mostly because an automatic has it.
    pub inactive: bool,
    /// The items of a menu with their values.
    pub items: Vec<(i64, String)>,
}

/// A control of a running camera.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ControlState {
    /// Where it is in the camera's table of a rig file: `gain`, or `color_controls.brightness`.
    pub key: String,
    /// Its range.
    pub control: Control,
    /// Its value; `None` when it cannot be read.
    pub value: Option<i64>,
}

/// The controls of a running camera, for use beside its images.
///
/// A call may take as long as the kernel's time-out of control transfers (5 s), so none belongs on a capture thread.
pub trait ControlPanel: Send + Sync {
    /// All that can be changed while it runs, with their present values.
    ///
    /// # Errors
    /// [`ErrorKind::Disconnected`], [`ErrorKind::Io`].
    fn list(&self) -> Result<Vec<ControlState>>;

    /// Changes one; `key` as in [`ControlState::key`].
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] for an unknown key and a value that it does not take, [`ErrorKind::Protocol`] when the camera keeps another
    /// value, [`ErrorKind::Disconnected`], [`ErrorKind::Io`].
    fn set(&self, key: &str, value: &ControlValue) -> Result<()>;
}

/// A value as a rig file gives it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum ControlValue {
    /// A number.
    Integer(i64),
    /// On or off.
    Boolean(bool),
    /// The item of a menu by its name, or by the name in lower case with `_` between words.
    Item(String),
}

impl ControlState {
    /// Its value as a rig file gives it: a menu's by the name of the item.
    pub fn file_value(&self) -> Option<ControlValue> {
        let value = self.value?;
        Some(match self.control.kind {
            ControlKind::Boolean => ControlValue::Boolean(value != 0),
            ControlKind::Menu => {
                let item = self.control.items.iter().find(|(v, _)| *v == value);
                item.map_or(ControlValue::Integer(value), |(_, name)| ControlValue::Item(name.clone()))
            }
            _ => ControlValue::Integer(value),
        })
    }
}

impl fmt::Display for ControlValue {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Integer(i) => write!(f, "{i}"),
            Self::Boolean(b) => write!(f, "{b}"),
            Self::Item(s) => write!(f, "\"{s}\""),
        }
    }
}

/// A name as rig files write it: lower case, one `_` for each run of other characters than letters and digits.
pub fn plain_name(name: &str) -> String {
    let words = name.split(|c: char| !c.is_ascii_alphanumeric()).filter(|w| !w.is_empty());
    words.map(str::to_ascii_lowercase).collect::<Vec<_>>().join("_")
}

impl Control {
    /// The number to write for `value`.
    ///
    /// # Errors
    /// [`ErrorKind::BadInput`] with what the control takes: range and step, or the items.
    pub fn check(&self, value: &ControlValue) -> Result<i64> {
        if self.read_only || self.kind == ControlKind::Other {
            return Err(self.refuse(value, "can only be read"));
        }
        let number = match (self.kind, value) {
            (ControlKind::Menu | ControlKind::IntegerMenu, ControlValue::Item(name)) => {
                let wanted = plain_name(name);
                let item = self.items.iter().find(|(_, n)| n == name || plain_name(n) == wanted);
                item.map(|(v, _)| *v)
            }
            (ControlKind::Menu | ControlKind::IntegerMenu, ControlValue::Integer(v)) => {
                self.items.iter().any(|(item, _)| item == v).then_some(*v)
            }
            (ControlKind::Button, _) => Some(0),
            (_, ControlValue::Boolean(b)) if self.kind == ControlKind::Boolean => Some((*b).into()),
            (ControlKind::Menu | ControlKind::IntegerMenu, ControlValue::Boolean(_))
            | (_, ControlValue::Item(_) | ControlValue::Boolean(_)) => None,
            (ControlKind::Bitmask, ControlValue::Integer(v)) => {
                // The maximum is the mask of the bits that exist.
                (*v >= 0 && v & !(self.maximum & 0xFFFF_FFFF) == 0).then_some(*v)
            }
            (_, ControlValue::Integer(v)) => {
                let from_least = i128::from(*v) - i128::from(self.minimum);
                let on_step = from_least % i128::from(self.step.max(1)) == 0;
                ((self.minimum..=self.maximum).contains(v) && on_step).then_some(*v)
            }
        };
        number.ok_or_else(|| self.refuse(value, &format!("takes {}", self.takes())))
    }

    /// Describes the values that can be written, for messages.
    pub fn takes(&self) -> String {
        match self.kind {
            ControlKind::Boolean => "true or false".to_owned(),
            ControlKind::Menu | ControlKind::IntegerMenu => {
                let items: Vec<_> = self.items.iter().map(|(v, name)| format!("{v} \"{name}\"")).collect();
                format!("one of: {}", items.join(", "))
            }
            ControlKind::Bitmask => format!("any bits of {:#x}", self.maximum),
            ControlKind::Button => "anything; it acts when written".to_owned(),
            ControlKind::Other => "nothing".to_owned(),
            ControlKind::Integer | ControlKind::Integer64 => {
                let least = self.minimum;
                let most = self.maximum;
                let step = self.step.max(1);
                let steps =
                    if step > 1 { format!(" in steps of {step} from {least}") } else { String::new() };
                format!("{least} to {most}{steps}, {} after power-on", self.default)
            }
        }
    }

    fn refuse(&self, value: &ControlValue, why: &str) -> Error {
        Error::new(ErrorKind::BadInput, format!("control {} cannot be {value}: it {why}", self.name))
    }
}

/// The control `name` of `controls`.
///
/// # Errors
/// [`ErrorKind::BadInput`] with the names there are.
pub fn find<'c>(controls: &'c [Control], name: &str) -> Result<&'c Control> {
    let wanted = plain_name(name);
    controls.iter().find(|c| c.name == wanted).ok_or_else(|| {
        let names: Vec<_> = controls.iter().map(|c| c.name.as_str()).collect();
        let has =
            if names.is_empty() { "it has none".to_owned() } else { format!("it has: {}", names.join(", ")) };
        Error::new(ErrorKind::BadInput, format!("unknown control \"{name}\"; {has}"))
    })
}

impl FromStr for ControlValue {
    type Err = core::convert::Infallible;

    /// A number, `true` or `false`, else the name of an item.
    fn from_str(s: &str) -> Result<Self, Self::Err> {
        Ok(match s {
            "true" => Self::Boolean(true),
            "false" => Self::Boolean(false),
            _ => s.parse().map_or_else(|_| Self::Item(s.to_owned()), Self::Integer),
        })
    }
}

#[cfg(test)]
mod tests;
